"""A worker process that runs episodes on request, `python -m unjam.worlds.worker`, without torch."""

import gc
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache, partial
from typing import IO, Any

from unjam.drivers.registry import driver_from_recipe
from unjam.errors import as_unjam_error
from unjam.scenarios import scenario_from_recipe
from unjam.sumo_files import store_answer
from unjam.tree import Arrays, pack
from unjam.trust import expect_code
from unjam.worlds.backend import Backend, open_backend
from unjam.worlds.episode import run_episode, seeded_generators
from unjam.worlds.messages import answer_requests, open_answer_pipe, write_message
from unjam.worlds.record import failed_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.sandboxed import enter_sandbox
from unjam.worlds.sumo.simulation import Simulation

PROGRESS_INTERVAL = 0.2
"""minimum time between two progress messages [s]"""


def _answer(open_once: Callable[[str], Backend], output: IO[bytes], request: dict[str, Any], arrays: Arrays) -> None:
    """Run the requested episode and send its record."""
    last_time = time.monotonic()

    def send_progress(control_steps: int) -> None:
        nonlocal last_time
        if time.monotonic() - last_time > PROGRESS_INTERVAL:
            last_time = time.monotonic()
            try:
                write_message(output, {"progress": control_steps})
            except BrokenPipeError:
                sys.exit()  # the parent has ended

    try:
        if "files" in request:  # read by the parent; changed files are read again
            store_answer(request["scenario"]["file"], request["files"])
        expect_code(request["code"])
        with seeded_generators(request["seed"]):  # a user's file or class may draw random numbers
            scenario = scenario_from_recipe(request["scenario"])
            if scenario.reads_user_files:
                enter_sandbox()
            driver = driver_from_recipe(request["driver"], arrays)
        options = {name: request[name] for name in ("seed", "reward", "explore", "record_details", "stop_at_contact")}
        options |= {"backend": open_once(request["backend"]), "on_progress": send_progress}
        content, record_arrays = pack(run_episode(scenario, driver, **options))
    except Exception as error:  # a failed episode has a record, too
        unjam_error = as_unjam_error(error)
        failed = failed_episode(tuple(request["seed"]), str(unjam_error), type(unjam_error).__name__)
        content, record_arrays = pack(failed)
    write_message(output, {"episode": content}, record_arrays)


def _open_backend(stack: ExitStack, backend: str) -> Backend:
    """Return a backend that stays open for all episodes; SUMO runs in this process, which can be sandboxed."""
    if backend == "sumo":
        return SumoBackend(stack.enter_context(Simulation(owns_stdout=True)))
    return stack.enter_context(open_backend(backend))


if __name__ == "__main__":
    answer_pipe = open_answer_pipe()
    gc.freeze()  # no garbage collection of imported objects, which would take time in each episode
    with ExitStack() as stack:
        answer_requests(partial(_answer, cache(partial(_open_backend, stack)), answer_pipe))
