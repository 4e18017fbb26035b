"""A worker process: runs the episodes that it is asked for, one after the other. Free of torch.

Started by `unjam.worlds.workers` as `python -m unjam.worlds.worker`.
"""

import gc
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache
from typing import Any, BinaryIO

from unjam.drivers.registry import driver_from_recipe
from unjam.errors import in_own_words
from unjam.processes import end_with_parent
from unjam.scenarios import scenario_from_recipe
from unjam.scenarios.own_network import OwnNetwork
from unjam.sumo_files import take_answer
from unjam.tree import Arrays, pack
from unjam.worlds.episode import run_episode
from unjam.worlds.messages import read_message, write_message
from unjam.worlds.record import failed_episode
from unjam.worlds.sumo.apart import give_up_rights
from unjam.worlds.sumo.simulation import Simulation

SIGN_OF_LIFE = 0.2
"""seconds between two reports of progress"""


def main() -> None:
    """Answer requests from standard input until it is closed."""
    end_with_parent(signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    gc.freeze()  # what the imports made stays; searching it for garbage would cost every episode
    # Either error: the parent wants no more, or is gone.
    with ExitStack() as at_the_end, suppress(BrokenPipeError, EOFError):
        simulation = cache(lambda: at_the_end.enter_context(Simulation(alone=True)))
        while True:
            _answer(*read_message(sys.stdin.buffer), simulation, answers)


def _answer(
    facts: dict[str, Any], arrays: Arrays, simulation: Callable[[], Simulation], answers: BinaryIO
) -> None:
    """Run an episode and send what happened; of hours of traffic nothing stays here."""
    try:
        answer, found = pack(_run(facts, arrays, simulation(), answers))
    except Exception as error:  # every requested episode has a row, also one that failed
        known = in_own_words(error)
        answer, found = pack(failed_episode(tuple(facts["seed"]), str(known), type(known).__name__))
    write_message(answers, {"episode": answer}, found)


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

    if "files" in facts:  # as the parent has read them; changed ones are read again
        take_answer(facts["scenario"]["file"], facts["files"])
    scenario = scenario_from_recipe(facts["scenario"])
    if isinstance(scenario, OwnNetwork):
        give_up_rights()
    driver = driver_from_recipe(facts["driver"], arrays)
    how = {name: facts[name] for name in ("seed", "reward", "explore", "full", "stop_at_contact")}
    return run_episode(scenario, driver, **how, simulation=simulation, progress=progress)


if __name__ == "__main__":
    main()
