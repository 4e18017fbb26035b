"""Trainings in subprocesses: many command lines at once, on this machine or on a Ray cluster, or a single training.

A single training, `python -m unjam.training.executors`, is for programs that imported NumPy before unjam (see
`unjam.kernels`). It reads a request and writes messages. After each row of progress it reads whether to continue.
"""

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, NamedTuple

from unjam.child_processes import (
    child_environment,
    child_import_path,
    isolated_start,
    leave_working_folder,
    python_command,
)
from unjam.errors import UnjamError, as_unjam_error, error_from_name, import_optional
from unjam.files import APPEND_FLAGS, atomic_write, make_folder, open_in_place
from unjam.folders import PROTECTED_FOLDERS_VARIABLE
from unjam.parameters import build_dataclass
from unjam.processes import bind_to_parent
from unjam.trust import TRUST_CODE_OPTION, forget_expected_code, is_all_code_trusted
from unjam.worlds.messages import open_answer_pipe, read_message, start_child, write_message

if TYPE_CHECKING:  # the command line imports this module and must start quickly
    from unjam.training.config import RunConfig
    from unjam.training.evaluate import EvaluationProgress, RowsByDriver

Executor = Literal["local", "ray"]
MessageCallback = Callable[[str], None]
IterationCallback = Callable[[dict[str, Any]], object]
"""called with each row of progress; it returns False to end the training"""
MAX_ATTEMPTS = 3
"""maximum number of starts of a command line, if signals kill it or its machine is lost"""


class CommandLine(NamedTuple):
    """A command line of unjam."""

    arguments: Sequence[str]
    log: Path
    resume_marker: Path | None = None
    """file that exists if the command was started before"""
    resume_arguments: Sequence[str] = ()
    """arguments if the command was started before"""

    def argv(self) -> list[str]:
        """Return the executable with the arguments for a first start or for resumption."""
        was_started = self.resume_marker is not None and self.resume_marker.is_file()
        return python_command("-m", "unjam", *(self.resume_arguments if was_started else self.arguments))


def training_command(config: "RunConfig", folder: Path, config_file: Path, log: Path) -> CommandLine:
    """Write a configuration to `config_file`, and return the command line that starts or resumes its training."""
    from unjam.training.config import CONFIG_FILE, to_toml

    folder, config_file, log = (path.absolute() for path in (folder, config_file, log))  # another machine runs it
    make_folder(config_file.parent)
    atomic_write(config_file, to_toml(config))
    options = ["--workers", str(config.workers), *([TRUST_CODE_OPTION] if is_all_code_trusted() else [])]
    return CommandLine(
        ["train", "--config", str(config_file), *options, "--out", str(folder)],
        log,
        folder / CONFIG_FILE,
        ["train", "--resume", str(folder), *options, "--steps", str(config.steps)],
    )


class LocalExecutor:
    """Runs command lines on this machine, in an existing folder or by default the working folder."""

    def __init__(self, folder: str | None = None) -> None:
        self._folder = folder
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._is_stopped = False

    def run(self, command: CommandLine) -> int:
        """Run a command line, and again if a signal kills it; return its exit code."""
        make_folder(command.log.parent)
        for _ in range(MAX_ATTEMPTS - 1):
            if (exit_code := self._run_once(command)) >= 0 or self._is_stopped:
                return exit_code
        return self._run_once(command)

    def _run_once(self, command: CommandLine) -> int:
        argv, environment = command.argv(), child_environment()
        with open(open_in_place(command.log, APPEND_FLAGS), "ab") as log:
            log.write(f"$ {shlex.join(argv)}\n".encode())
            log.flush()
            with self._lock:  # `stop` waits until the process is started, and terminates it too
                if self._is_stopped:
                    return -signal.SIGTERM
                process = subprocess.Popen(
                    argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, cwd=self._folder
                )
                self._running.add(process)
            with process:
                exit_code = process.wait()
            with self._lock:
                self._running.discard(process)
        return exit_code

    def stop(self) -> None:
        """Terminate all processes and start no further ones; a training writes its checkpoint before it ends."""
        with self._lock:
            self._is_stopped = True
            for process in self._running:
                process.terminate()


@contextmanager
def open_executor(executor: Executor, workers: int) -> Iterator[Callable[[CommandLine], Future[int]]]:
    """Yield a function that starts a command line and returns the future of its exit code; `workers` run at once.

    The machines of a Ray cluster must share the folders. An exception in the block ends all command lines.
    """
    local_executor = LocalExecutor()
    run_context = _open_ray(workers) if executor == "ray" else nullcontext(local_executor.run)
    with ThreadPoolExecutor(workers) as threads, run_context as run:
        try:
            yield lambda command: threads.submit(run, command)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            local_executor.stop()
            raise


def run_all(commands: dict[str, CommandLine], workers: int, executor: Executor, on_message: MessageCallback) -> None:
    """Run the `commands`, given by name, `workers` at once; `on_message` is called when a command line has ended.

    Raise `UnjamError` at the end if a command line failed, and `MissingPartError` if Ray is not installed.
    """
    if not commands:
        return
    failed, start_time = [], time.monotonic()
    with open_executor(executor, workers) as start:
        name_by_future = {start(command): name for name, command in commands.items()}
        for done_count, future in enumerate(as_completed(name_by_future), start=1):
            name, exit_code = name_by_future[future], future.result()
            minutes = (time.monotonic() - start_time) / 60.0
            on_message(f"{done_count} of {len(commands)}, {minutes:.0f} min: {name}{' failed' if exit_code else ''}")
            if exit_code != 0:
                failed.append(name)
    if failed:
        names_text = ", ".join(failed)
        raise UnjamError(f"{len(failed)} of {len(commands)} failed: {names_text}; first log: {commands[failed[0]].log}")


@contextmanager
def _open_ray(workers: int) -> Iterator[Callable[[CommandLine], int]]:
    """Yield a function that runs a command line on the existing Ray cluster, or else on a new one of this machine."""
    ray, folder = import_optional("ray"), os.getcwd()
    # Ray's processes import modules from the folder in which it was started.
    with _convert_ray_errors(), isolated_start(child_import_path()), leave_working_folder():
        try:
            ray.init(address="auto", log_to_driver=False)
        except ConnectionError:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, log_to_driver=False)
    remote = ray.remote(num_cpus=1, max_retries=MAX_ATTEMPTS - 1)(_run_on_node)

    def run(command: CommandLine) -> int:
        with _convert_ray_errors():
            return ray.get(remote.remote(command, folder, bind_to_parent({})[PROTECTED_FOLDERS_VARIABLE]))

    try:
        yield run
    finally:
        ray.shutdown()


@contextmanager
def _convert_ray_errors() -> Iterator[None]:
    """Raise errors of Ray as `UnjamError`, and errors in processes of the cluster with their original class."""
    try:
        yield
    except Exception as error:
        raise as_unjam_error(getattr(error, "cause", None) or error) from None


def _run_on_node(command: CommandLine, folder: str, protected_folders: str) -> int:
    """Run a command line in a process of the cluster, if possible in the given working folder."""
    os.environ[PROTECTED_FOLDERS_VARIABLE] = protected_folders
    return LocalExecutor(folder if os.path.isdir(folder) else None).run(command)


@forget_expected_code()
def train_in_subprocess(
    config: "RunConfig",
    folder: Path,
    resume: bool,
    on_iteration: IterationCallback | None,
    progress: "EvaluationProgress | None",
) -> "dict[str, RowsByDriver]":
    """Train as `train_in_process` does, with the same errors, in a subprocess."""
    child = start_child("unjam.training.executors")
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        write_message(
            child.stdin, {"arguments": [asdict(config), os.fspath(folder), resume], "path": child_import_path()}
        )
        while (message := _next_message(child.stdout)) is not None:
            match message:
                case {"row": row}:
                    continues = on_iteration is None or on_iteration(row) is not False
                    with suppress(BrokenPipeError):  # of a killed process; the exit code is reported below
                        write_message(child.stdin, {"continues": continues})
                case {"evaluated": [driver, episode], "steps": steps} if progress is not None:
                    progress((driver, episode), steps)
                case {"error": [kind, text]}:
                    raise error_from_name(kind, text)
                case {"rows": rows}:
                    return rows
        raise UnjamError(f"training: its process ended with code {child.wait()}")
    finally:
        child.terminate()  # has no effect on a process that has ended
        child.wait()


def _next_message(pipe: IO[bytes]) -> dict[str, Any] | None:
    with suppress(EOFError):
        return read_message(pipe)[0]
    return None


def train_from_stdin() -> None:
    """Run the training that the parent requests on standard input; the parent is in `train_in_subprocess`."""
    send = partial(write_message, open_answer_pipe())
    request, _ = read_message(sys.stdin.buffer)
    # User code may need the import path of the parent. At the end, it does not hide installed packages.
    sys.path.extend(path for path in request["path"] if path not in sys.path)
    values, folder, resume = request["arguments"]

    def report_iteration(row: dict[str, Any]) -> bool:
        send({"row": row})
        return read_message(sys.stdin.buffer)[0]["continues"]

    def report_evaluation(episode: tuple[str, int], steps: int) -> None:
        send({"evaluated": episode, "steps": steps})

    try:
        from unjam.training.config import RunConfig
        from unjam.training.train import train_in_process

        config = build_dataclass(RunConfig, values, "")
        send({"rows": train_in_process(config, Path(folder), resume, report_iteration, report_evaluation)})
    except UnjamError as error:
        send({"error": [type(error).__name__, str(error)]})


if __name__ == "__main__":
    train_from_stdin()
