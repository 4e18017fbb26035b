"""Running many command lines at once: in processes of this machine, or on a Ray cluster."""

import shlex
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Literal, NamedTuple

from unjam.errors import MissingPartError, UnjamError
from unjam.files import make_folder

Executor = Literal["local", "ray"]
Told = Callable[[str], None]


class Command(NamedTuple):
    """A command line."""

    words: list[str]
    log: Path
    """where what it prints is added"""


class Processes:
    """Runs command lines on this machine, and can end all that still run."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()

    def run(self, command: Command) -> int:
        """Run a command line to its end; return its exit code."""
        make_folder(command.log.parent)
        with open(command.log, "ab") as log:
            log.write(f"$ {shlex.join(command.words)}\n".encode())
            log.flush()
            with subprocess.Popen(command.words, stdin=subprocess.DEVNULL, stdout=log, stderr=log) as process:
                with self._lock:
                    self._running.add(process)
                code = process.wait()
                with self._lock:
                    self._running.discard(process)
        return code

    def stop(self) -> None:
        """Ask all that still run to end: a training then writes its checkpoint."""
        with self._lock:
            for process in self._running:
                process.terminate()


def run_all(commands: dict[str, Command], workers: int, executor: Executor, told: Told) -> None:
    """Run command lines, `workers` at once.

    Args:
        commands: by name.
        workers: how many at once; on a cluster that has more cores, how many are asked for.
        executor: `ray`: on a Ray cluster whose machines share the folders.
        told: told a line when one has ended.

    Raises:
        UnjamError: one or several failed; all others have run.
        MissingPartError: Ray is not installed.
    """
    if not commands:
        return
    processes = Processes()
    run = _on_ray(workers) if executor == "ray" else processes.run
    failed, started = [], time.monotonic()
    with ThreadPoolExecutor(workers) as threads:
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
            processes.stop()
            raise
    if failed:
        words = f"{len(failed)} of {len(commands)} failed: {', '.join(failed)}"
        raise UnjamError(f"{words}; what the first of them said is in {commands[failed[0]].log}")


def _on_ray(workers: int) -> Callable[[Command], int]:
    """Return what runs a command somewhere on a Ray cluster, or on `workers` cores where there is none."""
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingPartError("executor: ray is not installed: pip install 'unjam[ray]'") from None
    ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, ignore_reinit_error=True)
    remote = ray.remote(num_cpus=1, max_retries=3)(lambda command: Processes().run(command))
    return lambda command: ray.get(remote.remote(command))
