"""SUMO in a sandboxed process, which may neither write files nor open ports, for networks from any source.

The process runs `python -m unjam.worlds.sumo.sandboxed`, and receives calls of the functions of `Simulation` over a
pipe. The driver runs outside the sandbox, in the calling process.
"""

import locale
import os
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import IO, Any, get_type_hints

from unjam.errors import LostWorkerError, as_unjam_error, error_from_name
from unjam.processes import PrivateFolder, check_owner, remove_stale_private_folders
from unjam.sandbox import confine_process, limit_resources
from unjam.tree import Arrays, pack, unpack
from unjam.worlds import messages
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.transports import InUseError

MAX_NETWORK_MEMORY = 16 * 2**30
"""memory limit of a sandboxed process [bytes]"""
MAX_ANSWER_SECONDS = 150.0
"""time without an answer after which SUMO counts as lost [s]; SUMO needs most time to read a large network"""


def open_simulation(is_sandboxed: bool) -> Simulation:
    """Open a sandboxed simulation, or one in this process.

    If libsumo already runs a simulation here, or could not read numbers, warn and open a sandboxed one.
    """
    if not is_sandboxed and (point := locale.localeconv()["decimal_point"]) != ".":
        warnings.warn(
            f"the locale of this process writes numbers with {str(point)!r}, which SUMO does not read: it runs in a "
            "process of its own, several times slower; allowed: locale.setlocale(locale.LC_NUMERIC, 'C')",
            stacklevel=2,
        )
    elif not is_sandboxed:
        try:
            return Simulation()
        except InUseError:
            warnings.warn(
                "another simulation is open in this process, and libsumo holds one per process: this one "
                "runs in a process of its own, with the same results but several times slower; close the "
                "other, or use gymnasium.make_vec(..., vectorization_mode='async')",
                stacklevel=2,
            )
    return SandboxedSimulation()  # pyright: ignore[reportReturnType]  (it has the same methods)


@cache
def enter_sandbox() -> None:
    """Limit the memory of this process, and let it write only into its own folder."""
    limit_resources(MAX_NETWORK_MEMORY)
    confine_process(Path(tempfile.gettempdir()))


@cache
def _process_starter(process: int) -> ThreadPoolExecutor:
    """Return the thread that starts all child processes of a process: they end with the thread that started them."""
    return ThreadPoolExecutor(1)


_process_starter_lock = Lock()
"""prevents a second such thread: its processes would end with its executor"""


class SandboxedSimulation(AbstractContextManager["SandboxedSimulation"]):
    """Proxy of a `Simulation` in a sandboxed process, to which it sends all calls."""

    is_sandboxed = True

    def __init__(self) -> None:
        remove_stale_private_folders()
        self._folder = PrivateFolder()
        with _process_starter_lock:
            starter = _process_starter(os.getpid())
        start = starter.submit(messages.start_child, "unjam.worlds.sumo.sandboxed", TMPDIR=self._folder.name)
        self._process, self._owner = start.result(), os.getpid()
        self.episode_lock = Lock()

    @property
    def is_lost(self) -> bool:
        """Whether the process has ended, so that a new one must be started."""
        return self._process.poll() is not None

    def check(self) -> None:
        """Do nothing: no other code can change the simulation."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._call, name)

    def load(self, inputs: SumoInputs, step: float, seed: int) -> None:
        """Start an episode, as `Simulation.load` does."""
        existing = {option: list(map(str, paths)) for option, paths in inputs.existing_files.items()}
        copied = {str(path): list(map(str, sources)) for path, sources in inputs.copied_files.items()}
        self._call("load", {**inputs._asdict(), "existing_files": existing, "copied_files": copied}, step, seed)

    def _call(self, name: str, *arguments: Any) -> Any:
        check_owner(self._owner, "simulation: it")
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        # Arguments may be sequences or iterators of any kind; messages have lists.
        lists = [
            list(value) if hasattr(value, "__iter__") and not isinstance(value, str | dict) else value
            for value in arguments
        ]
        try:
            messages.write_message(self._process.stdin, {"call": name, "arguments": lists})
            if not messages.has_message(self._process.stdout, MAX_ANSWER_SECONDS):
                raise LostWorkerError(f"SUMO was lost: it did not answer for {MAX_ANSWER_SECONDS:g} s")
            content, arrays = messages.read_message(self._process.stdout)
        except (BrokenPipeError, EOFError):
            raise LostWorkerError(f"SUMO was lost: its process ended with code {self._process.wait()}") from None
        except BaseException:  # a timeout or an interrupt: the next call would read the answer to this one
            self._process.kill()
            self._process.wait()
            raise
        if "error" in content:
            raise error_from_name(*content["error"])
        return unpack(_return_type(name), content["answer"], arrays)

    def close(self) -> None:
        """End the process; may be called twice, and has no effect in a fork of this one."""
        if os.getpid() != self._owner:
            return
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError, ValueError):  # it has an unsent message, or Python has closed it at its end
                assert pipe is not None
                pipe.close()
        self._process.wait()
        self._folder.cleanup()

    def __exit__(self, *error: object) -> None:
        self.close()


@cache
def _return_type(name: str) -> Any:
    method = getattr(Simulation, name, None)
    return get_type_hints(method).get("return", Any) if method else Any


def _answer_request(simulation: Simulation, output: IO[bytes], request: dict[str, Any], arrays: Arrays) -> None:
    try:
        answer, arrays = pack(_call_function(simulation, request["call"], request["arguments"]))
        messages.write_message(output, {"answer": answer}, arrays)
    except Exception as error:
        unjam_error = as_unjam_error(error)
        messages.write_message(output, {"error": [type(unjam_error).__name__, str(unjam_error)]})


def _call_function(simulation: Simulation, name: str, arguments: list[Any]) -> Any:
    """Call a function of the simulation; `load` gets its inputs as a dictionary."""
    if name == "load":
        fields, *step_and_seed = arguments
        existing = {option: tuple(map(Path, paths)) for option, paths in fields["existing_files"].items()}
        copied = {Path(path): tuple(map(Path, sources)) for path, sources in fields["copied_files"].items()}
        fields |= {"options": tuple(fields["options"]), "existing_files": existing, "copied_files": copied}
        arguments = [SumoInputs(**fields), *step_and_seed]
    return getattr(simulation, name)(*arguments)


if __name__ == "__main__":
    answer_pipe = messages.open_answer_pipe()
    enter_sandbox()
    with Simulation(owns_stdout=True) as sandboxed_simulation:
        messages.answer_requests(partial(_answer_request, sandboxed_simulation, answer_pipe))
