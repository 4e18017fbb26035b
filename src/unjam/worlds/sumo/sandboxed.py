"""SUMO in a process of its own that may neither write nor listen: for networks that may come from anywhere.

Programs that drive on such a network ask it over a pipe for what `Simulation` can do: SUMO is confined, while
the driver and whoever looks on stay where they are. Started as `python -m unjam.worlds.sumo.sandboxed`.
"""

import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, Self, get_type_hints

from unjam.child_processes import child_environment, python_command
from unjam.errors import LostWorkerError, as_unjam_error, error_from_name
from unjam.processes import PrivateFolder, exit_with_parent, remove_stale_private_folders
from unjam.sandbox import confine_process, limit_resources
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import UserNetwork
from unjam.tree import pack, unpack
from unjam.worlds.messages import read_message, write_message
from unjam.worlds.sumo.backends import InUseError
from unjam.worlds.sumo.detectors import InductionLoop, passages
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.simulation import Simulation

MAX_NETWORK_MEMORY = 16 * 2**30
"""bytes that a process may take once it drives on a network of the user's own"""


def open_simulation(*scenarios: Scenario) -> Simulation:
    """Open a simulation for episodes on these roads: a confined one where one is a network of the user's own.

    Of others it runs in this process. Where libsumo holds one there already, unjam's or the user's, it runs
    in a process of its own, with a warning: another thread may ask at the same time.
    """
    if not any(isinstance(scenario, UserNetwork) for scenario in scenarios):
        try:
            return Simulation()
        except InUseError:
            warnings.warn(
                "another simulation is open in this process, and libsumo holds one per process: this one "
                "runs in a process of its own, with the same results but several times slower; close the "
                "other, or use gymnasium.make_vec(..., vectorization_mode='async')",
                stacklevel=2,
            )
    return SandboxedSimulation()  # pyright: ignore[reportReturnType]  (it answers to the same names)


@cache
def enter_sandbox() -> None:
    """Let a file that would fill the memory end this process alone, which writes only into its own folder."""
    limit_resources(MAX_NETWORK_MEMORY)
    confine_process(Path(tempfile.gettempdir()))


@cache
def _process_starter(process: int) -> ThreadPoolExecutor:
    """Return the thread that starts others' processes here: to the system it is who they must not outlive."""
    return ThreadPoolExecutor(1)


_process_starter_lock = Lock()
"""a second thread that starts processes would end with its executor, and they with it"""


class SandboxedSimulation:
    """A `Simulation` in a confined process; what it is asked for, that process does and answers."""

    def __init__(self) -> None:
        """Start the process."""
        remove_stale_private_folders()
        self._folder = PrivateFolder()
        with _process_starter_lock:
            starter = _process_starter(os.getpid())
        start = starter.submit(
            subprocess.Popen[bytes],
            python_command("-m", "unjam.worlds.sumo.sandboxed"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=child_environment(TMPDIR=self._folder.name),
            start_new_session=True,  # an interrupt in the terminal is this process's to handle
        )
        self._process = start.result()
        self.episode_lock = Lock()
        """held by the episode that runs"""

    @property
    def is_lost(self) -> bool:
        """Whether the process has ended: only a new one can go on."""
        return self._process.poll() is not None

    def check(self) -> None:
        """Do nothing: no other code reaches the simulation."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._call, name)

    def load(self, inputs: SumoInputs, step: float, seed: int) -> None:
        """Start an episode, as `Simulation.load` does."""
        named = {option: list(map(str, paths)) for option, paths in inputs.existing_files.items()}
        to_copy = {str(path): list(map(str, made_from)) for path, made_from in inputs.copied_files.items()}
        self._call("load", {**inputs._asdict(), "existing_files": named, "copied_files": to_copy}, step, seed)

    def _call(self, name: str, *arguments: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        plain = [each if isinstance(each, (str, dict)) else _as_json(each) for each in arguments]
        try:
            write_message(self._process.stdin, {"call": name, "arguments": plain})
            facts, arrays = read_message(self._process.stdout)
        except (BrokenPipeError, EOFError):
            raise LostWorkerError(f"SUMO was lost: its process ended with code {self._process.wait()}") from None
        if "error" in facts:
            raise error_from_name(*facts["error"])
        return unpack(_return_type(name), facts["answer"], arrays)

    def close(self) -> None:
        """End the process; may be called twice."""
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _as_json(value: Any) -> Any:
    """Return an argument as JSON: names and numbers come in many kinds of sequences."""
    return list(value) if hasattr(value, "__iter__") else value


@cache
def _return_type(name: str) -> Any:
    """Return the type of what `Simulation` answers when it is asked for `name`."""
    method = getattr(Simulation, name, None)
    return get_type_hints(method).get("return", Any) if method else Any


def serve_simulation() -> None:
    """Do what is asked on standard input until it is closed."""
    exit_with_parent(signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO may print: not into the answers
    enter_sandbox()
    with Simulation(owns_stdout=True) as simulation:
        while True:
            try:
                facts, _ = read_message(sys.stdin.buffer)
            except EOFError:
                return
            try:
                answer, arrays = pack(_execute(simulation, facts["call"], facts["arguments"]))
                write_message(answers, {"answer": answer}, arrays)
            except Exception as error:
                known = as_unjam_error(error)
                write_message(answers, {"error": [type(known).__name__, str(known)]})


def _execute(simulation: Simulation, name: str, arguments: list[Any]) -> Any:
    if name == passages.__name__:  # a message for each step would cost as much as the steps
        loops, steps = arguments
        return passages(simulation, [InductionLoop(*each) for each in loops], steps)
    if name == "load":
        files = arguments[0]
        named = {option: tuple(map(Path, paths)) for option, paths in files["existing_files"].items()}
        to_copy = {Path(path): tuple(map(Path, made)) for path, made in files["copied_files"].items()}
        parts = {"options": tuple(files["options"]), "existing_files": named, "copied_files": to_copy}
        arguments[0] = SumoInputs(**{**files, **parts})
    return getattr(simulation, name)(*arguments)


if __name__ == "__main__":
    serve_simulation()
