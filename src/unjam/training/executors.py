"""Running many command lines of unjam at once: in processes of this machine, or on a Ray cluster."""

import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

from unjam.errors import MissingPartError, UnjamError
from unjam.files import make_folder

Executor = Literal["local", "ray"]
EXECUTORS: tuple[Executor, ...] = ("local", "ray")
Told = Callable[[str], None]
ATTEMPTS = 3
"""how often a command line is started that a signal kills, or whose machine is lost"""


class Command(NamedTuple):
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
        return [sys.executable, "-m", "unjam", *(self.again if begun else self.words)]


Runner = Callable[[Command], int]
"""runs a command line to its end and returns its exit code"""


class Processes:
    """Runs command lines on this machine, and can end all that still run."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def run(self, command: Command) -> int:
        """Run a command line to its end, anew where a signal kills it; return its exit code."""
        make_folder(command.log.parent)
        for _ in range(ATTEMPTS - 1):
            if (code := self._once(command)) >= 0 or self._stopped:
                return code
        return self._once(command)

    def _once(self, command: Command) -> int:
        line = command.line()
        with open(command.log, "ab") as log:
            log.write(f"$ {shlex.join(line)}\n".encode())
            log.flush()
            with subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=log, stderr=log) as process:
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
def running(executor: Executor, workers: int) -> Iterator[Runner]:
    """Give what runs command lines, from several threads at once; an exception in the block ends them.

    Args:
        executor: `ray`: on a Ray cluster whose machines share the folders.
        workers: how many cores are asked for where there is no cluster.

    Raises:
        MissingPartError: Ray is not installed.
    """
    if executor == "ray":
        with _ray(workers) as run:
            yield run
        return
    processes = Processes()
    try:
        yield processes.run
    except BaseException:
        processes.stop()
        raise


def run_all(commands: dict[str, Command], workers: int, executor: Executor, told: Told) -> None:
    """Run command lines, `workers` at once.

    Args:
        commands: by name.
        workers: how many at once; on a cluster that has more cores, how many are asked for.
        executor: where.
        told: told a line when one has ended.

    Raises:
        UnjamError: one or several failed; all others have run.
        MissingPartError: Ray is not installed.
    """
    if not commands:
        return
    failed, started = [], time.monotonic()
    with ThreadPoolExecutor(workers) as threads, running(executor, workers) as run:
        names = {threads.submit(run, command): name for name, command in commands.items()}
        try:
            for done, future in enumerate(as_completed(names), start=1):
                name, code = names[future], future.result()
                minutes = (time.monotonic() - started) / 60.0
                told(f"{done} of {len(names)}, {minutes:.0f} min: {name}{' failed' if code else ''}")
                if code != 0:
                    failed.append(name)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    if failed:
        words = f"{len(failed)} of {len(commands)} failed: {', '.join(failed)}"
        raise UnjamError(f"{words}; what the first of them said is in {commands[failed[0]].log}")


@contextmanager
def _ray(workers: int) -> Iterator[Runner]:
    """Give what runs a command line somewhere on the Ray cluster that is there, or on one of this machine."""
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingPartError("executor: ray is not installed: pip install 'unjam[ray]'") from None
    try:
        ray.init(address="auto", log_to_driver=False)
    except ConnectionError:
        ray.init(address="local", num_cpus=workers, include_dashboard=False, log_to_driver=False)
    remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS)(_run_here)
    try:
        yield lambda command: ray.get(remote.remote(command))
    finally:
        ray.shutdown()


def _run_here(command: Command) -> int:
    return Processes().run(command)
