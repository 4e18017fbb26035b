"""A worker process: runs the episodes that it is asked for, one after the other. Free of torch.

Started by `unjam.worlds.worker_pool` as `python -m unjam.worlds.worker`.
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
from unjam.errors import as_unjam_error
from unjam.processes import exit_with_parent
from unjam.scenarios import scenario_from_recipe
from unjam.scenarios.user_network import UserNetwork
from unjam.sumo_files import take_answer
from unjam.tree import Arrays, pack
from unjam.worlds.episode import run_episode
from unjam.worlds.messages import read_message, write_message
from unjam.worlds.record import failed_episode
from unjam.worlds.sumo.sandboxed import enter_sandbox
from unjam.worlds.sumo.simulation import Simulation

PROGRESS_INTERVAL = 0.2
"""seconds between two reports of progress"""


def run_worker() -> None:
    """Answer requests from standard input until it is closed."""
    exit_with_parent(signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    gc.freeze()  # what the imports made stays; searching it for garbage would cost every episode
    # Either error: the parent wants no more, or is gone.
    with ExitStack() as at_the_end, suppress(BrokenPipeError, EOFError):
        simulation = cache(lambda: at_the_end.enter_context(Simulation(owns_stdout=True)))
        while True:
            _answer_request(*read_message(sys.stdin.buffer), simulation, answers)


def _answer_request(
    request: dict[str, Any], arrays: Arrays, simulation: Callable[[], Simulation], output: BinaryIO
) -> None:
    """Run an episode and send what happened; of hours of traffic nothing stays here."""
    try:
        answer, found = pack(_run_request(request, arrays, simulation(), output))
    except Exception as error:  # every requested episode has a row, also one that failed
        known = as_unjam_error(error)
        answer, found = pack(failed_episode(tuple(request["seed"]), str(known), type(known).__name__))
    write_message(output, {"episode": answer}, found)


def _run_request(request: dict[str, Any], arrays: Arrays, simulation: Simulation, output: BinaryIO) -> Any:
    last = time.monotonic()

    def send_progress(control_steps: int) -> None:
        nonlocal last
        if time.monotonic() - last > PROGRESS_INTERVAL:
            last = time.monotonic()
            try:
                write_message(output, {"progress": control_steps})
            except BrokenPipeError:
                sys.exit()  # the parent is gone

    if "files" in request:  # as the parent has read them; changed ones are read again
        take_answer(request["scenario"]["file"], request["files"])
    scenario = scenario_from_recipe(request["scenario"])
    if isinstance(scenario, UserNetwork):
        enter_sandbox()
    driver = driver_from_recipe(request["driver"], arrays)
    how = {name: request[name] for name in ("seed", "reward", "explore", "record_details", "stop_at_contact")}
    return run_episode(scenario, driver, **how, simulation=simulation, on_progress=send_progress)


if __name__ == "__main__":
    run_worker()
