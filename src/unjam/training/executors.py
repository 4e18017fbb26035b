"""Trainings in processes of their own: many command lines at once, here or on a Ray cluster; or one alone.

The one alone is for a program that imported NumPy before unjam: see `unjam.kernels`. Its child, `python -m
unjam.training.executors`, reads one line of JSON and answers lines: a list of a word and what belongs to it.
After each row of progress it reads whether to go on.
"""

import json
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
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from unjam.children import child_environment, child_import_path, isolated_start, python_command
from unjam.errors import MissingPartError, UnjamError, error_named
from unjam.files import APPEND, make_folder, open_in_place, write_whole
from unjam.folders import HELD_FOLDERS
from unjam.parameters import build
from unjam.processes import bound, end_with_parent
from unjam.trust import FLAG, expecting_code, is_all_trusted

if TYPE_CHECKING:  # the command line asks which executors there are: it is to be quick
    from unjam.training.config import RunConfig
    from unjam.training.evaluate import Progress, Rows

Executor = Literal["local", "ray"]
EXECUTORS: tuple[Executor, ...] = ("local", "ray")
OnLine = Callable[[str], None]
"""gets a line of progress"""
OnIteration = Callable[[dict[str, Any]], object]
"""called with each row of progress as it is written; False ends the training"""
ATTEMPTS = 3
"""how often a command line is started that a signal kills, or whose machine is lost"""


class CommandLine(NamedTuple):
    """A command line of unjam."""

    words: Sequence[str]
    """what follows `unjam`"""
    log: Path
    """where what it prints is added"""
    begun: Path | None = None
    """the file whose presence says that it was begun before"""
    again: Sequence[str] = ()
    """words that go on with what was begun"""

    def line(self) -> list[str]:
        """Return the whole command line, as it must be on this machine at this moment."""
        begun = self.begun is not None and self.begun.is_file()
        return python_command("-m", "unjam", *(self.again if begun else self.words))


def training_command(config: "RunConfig", folder: Path, plan: Path, log: Path) -> CommandLine:
    """Return the command line that begins a training or goes on with it; `plan` gets its configuration."""
    from unjam.training.config import to_toml

    make_folder(plan.parent)
    write_whole(plan, to_toml(config))
    once = ["--workers", str(config.workers), *([FLAG] if is_all_trusted() else [])]
    return CommandLine(
        ["train", "--config", str(plan), *once, "--out", str(folder)],
        log,
        folder / "config.toml",
        ["train", "--resume", str(folder), *once, "--steps", str(config.steps)],
    )


class Processes:
    """Runs command lines on this machine, and can end all that still run."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def run(self, command: CommandLine) -> int:
        """Run a command line to its end, anew where a signal kills it; return its exit code."""
        make_folder(command.log.parent)
        for _ in range(ATTEMPTS - 1):
            if (code := self._once(command)) >= 0 or self._stopped:
                return code
        return self._once(command)

    def _once(self, command: CommandLine) -> int:
        line = command.line()
        with open(open_in_place(command.log, APPEND), "ab") as log:
            log.write(f"$ {shlex.join(line)}\n".encode())
            log.flush()
            with subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=child_environment()
            ) as process:
                with self._lock:
                    self._running.add(process)
                code = process.wait()
                with self._lock:
                    self._running.discard(process)
        return code

    def stop(self) -> None:
        """Ask all that still run to end: a training then writes its checkpoint."""
        self._stopped = True
        with self._lock:
            for process in self._running:
                process.terminate()


@contextmanager
def running(executor: Executor, workers: int) -> Iterator[Callable[[CommandLine], Future[int]]]:
    """Give what starts a command line and promises its exit code; an exception in the block ends them all.

    At most `workers` run at once; on a Ray cluster, whose machines share the folders, so many are asked for.

    Raises:
        MissingPartError: Ray is not installed.
    """
    processes = Processes()
    place = _ray(workers) if executor == "ray" else nullcontext(processes.run)
    with ThreadPoolExecutor(workers) as threads, place as run:
        try:
            yield lambda command: threads.submit(run, command)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            processes.stop()
            raise


def run_all(commands: dict[str, CommandLine], workers: int, executor: Executor, on_line: OnLine) -> None:
    """Run command lines, given by name, `workers` at once; `on_line` gets a line when one has ended.

    Raises:
        UnjamError: one or several failed; all others have run.
        MissingPartError: Ray is not installed.
    """
    if not commands:
        return
    failed, started = [], time.monotonic()
    with running(executor, workers) as start:
        names = {start(command): name for name, command in commands.items()}
        for done, future in enumerate(as_completed(names), start=1):
            name, code = names[future], future.result()
            minutes = (time.monotonic() - started) / 60.0
            on_line(f"{done} of {len(names)}, {minutes:.0f} min: {name}{' failed' if code else ''}")
            if code != 0:
                failed.append(name)
    if failed:
        words = f"{len(failed)} of {len(commands)} failed: {', '.join(failed)}"
        raise UnjamError(f"{words}; what the first of them said is in {commands[failed[0]].log}")


@contextmanager
def _ray(workers: int) -> Iterator[Callable[[CommandLine], int]]:
    """Give what runs a command line somewhere on the Ray cluster that is there, or on one of this machine."""
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingPartError("executor: ray is not installed: pip install 'unjam[ray]'") from None
    with isolated_start(child_import_path()):
        try:
            ray.init(address="auto", log_to_driver=False)
        except ConnectionError:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, log_to_driver=False)
    remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_run_here)
    try:
        yield lambda command: ray.get(remote.remote(command, bound({})[HELD_FOLDERS]))
    finally:
        ray.shutdown()


def _run_here(command: CommandLine, held_folders: str) -> int:
    """Run a command line in a process of the cluster, where folders are held that another machine holds."""
    os.environ[HELD_FOLDERS] = held_folders
    return Processes().run(command)


@expecting_code()
def train_apart(
    config: "RunConfig",
    folder: Path,
    resume: bool,
    on_iteration: OnIteration | None,
    progress: "Progress | None",
) -> "dict[str, Rows]":
    """Train as `unjam.train` does, and return the rows of the judgement, by road and driver.

    Raises:
        UnjamError: of the same kind as in this process.
    """
    child = subprocess.Popen(
        python_command("-m", "unjam.training.executors"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        encoding="utf-8",
        env=child_environment(),
    )
    try:
        assert child.stdin is not None
        assert child.stdout is not None
        request = [asdict(config), os.fspath(folder), resume, child_import_path()]
        print(json.dumps(request), file=child.stdin, flush=True)
        for line in child.stdout:
            match json.loads(line):
                case ["row", row]:
                    goes_on = on_iteration is None or on_iteration(row) is not False
                    with suppress(BrokenPipeError):  # it was killed: its code is told below
                        print(json.dumps(goes_on), file=child.stdin, flush=True)
                case ["judged", driver, episode, steps] if progress is not None:
                    progress((driver, episode), steps)
                case ["error", kind, words]:
                    raise error_named(kind, words)
                case ["done", rows]:
                    return rows
        raise UnjamError(f"training: its process ended with code {child.wait()}")
    finally:
        child.terminate()  # where it has ended by itself, this does nothing
        child.wait()


def main() -> None:
    """Train as the line on standard input says."""
    end_with_parent(signal.SIGTERM)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    values, folder, resume, path = json.loads(sys.stdin.readline())
    # A user's driver may import what the program added to its path; last, it hides nothing that is installed.
    sys.path.extend(each for each in path if each not in sys.path)

    def say(*words: Any) -> None:
        print(json.dumps(words), file=answers, flush=True)

    def iterated(row: dict[str, Any]) -> bool:
        say("row", row)
        return json.loads(sys.stdin.readline())

    try:
        from unjam.training.config import RunConfig
        from unjam.training.train import train_here

        rows = train_here(
            build(RunConfig, values, ""),
            Path(folder),
            resume,
            iterated,
            lambda episode, steps: say("judged", *episode, steps),
        )
        say("done", rows)
    except UnjamError as error:
        say("error", type(error).__name__, str(error))


if __name__ == "__main__":
    main()
