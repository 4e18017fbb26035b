"""A worker process: runs the episodes that it is asked for, one after the other. Free of torch.

Parent and worker talk in frames of JSON and arrays over pipes: nothing is ever unpickled.

Started by `unjam.worlds.workers` as `python -m unjam.worlds.worker`.
"""

import gc
import json
import os
import signal
import struct
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from safetensors.numpy import load, save

from unjam.drivers.registry import driver_from_recipe
from unjam.errors import DISK_ERRNOS, UnjamError, disk_error
from unjam.processes import end_with_parent
from unjam.sandbox import confine, limit
from unjam.scenarios import scenario_from_recipe
from unjam.scenarios.own_network import OwnNetwork
from unjam.tree import Arrays, pack
from unjam.worlds.episode import run_episode
from unjam.worlds.record import failed_episode
from unjam.worlds.sumo.simulation import Simulation

NETWORK_MEMORY = 16 * 2**30
"""bytes that a worker may take once it drives on a network of the user's own, which may come from anywhere"""
SIGN_OF_LIFE = 0.2
"""seconds between two reports of progress"""

_LENGTHS = struct.Struct(">QQ")


def write_message(pipe: IO[bytes], facts: dict[str, Any], arrays: Arrays | None = None) -> None:
    """Write one message: `facts` as JSON, and arrays by name."""
    text = json.dumps(facts).encode()
    data = save({name: np.asarray(array, order="C") for name, array in arrays.items()}) if arrays else b""
    pipe.write(_LENGTHS.pack(len(text), len(data)) + text + data)
    pipe.flush()


def read_message(pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
    """Return the next message; raise `EOFError` where the other side is gone."""
    text_length, data_length = _LENGTHS.unpack(_read_exactly(pipe, _LENGTHS.size))
    facts = json.loads(_read_exactly(pipe, text_length))
    data = _read_exactly(pipe, data_length)
    return facts, load(data) if data else {}


def _read_exactly(pipe: IO[bytes], length: int) -> bytes:
    parts = []
    while length:
        part = pipe.read(length)
        if not part:
            raise EOFError("the other side closed the pipe")
        parts.append(part)
        length -= len(part)
    return b"".join(parts)


def main() -> None:
    """Answer requests from standard input until it is closed."""
    end_with_parent(signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    gc.freeze()  # what the imports made stays; searching it for garbage would cost every episode
    simulation = None
    try:
        while True:
            facts, arrays = read_message(sys.stdin.buffer)
            try:
                simulation = simulation or Simulation()
                episode = _run(facts, arrays, simulation, answers)
            except Exception as error:  # every requested episode has a row, also one that failed
                known = _known(error)
                episode = failed_episode(tuple(facts["seed"]), str(known), type(known).__name__)
            answer, answer_arrays = pack(episode)
            write_message(answers, {"episode": answer}, answer_arrays)
    except (BrokenPipeError, EOFError):
        pass  # the parent is gone, or wants no more
    finally:
        if simulation is not None:
            simulation.close()


@cache
def _confine() -> None:
    """Let a file that would fill the memory end this process alone, which writes only into its own folder."""
    limit(NETWORK_MEMORY)
    confine(Path(tempfile.gettempdir()))


def _known(error: Exception) -> Exception:
    """Return an error in the words of unjam."""
    if isinstance(error, OSError) and error.errno in DISK_ERRNOS:
        return disk_error(error, error.filename or "a temporary file")
    return error if isinstance(error, UnjamError) else UnjamError(f"{type(error).__name__}: {error}")


def _run(facts: dict[str, Any], arrays: Arrays, simulation: Simulation, answers: BinaryIO) -> Any:
    last = time.monotonic()

    def progress(steps: int) -> None:
        nonlocal last
        if time.monotonic() - last > SIGN_OF_LIFE:
            last = time.monotonic()
            try:
                write_message(answers, {"progress": steps})
            except BrokenPipeError:
                sys.exit()  # the parent is gone

    scenario = scenario_from_recipe(facts["scenario"])
    if isinstance(scenario, OwnNetwork):
        _confine()
    driver = driver_from_recipe(facts["driver"], arrays)
    how = {name: facts[name] for name in ("seed", "reward", "explore", "full")}
    return run_episode(scenario, driver, **how, simulation=simulation, progress=progress)


if __name__ == "__main__":
    main()
