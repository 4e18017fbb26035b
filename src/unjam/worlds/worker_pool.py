"""Parallel episodes in worker processes; lost workers do not change the results."""

import os
import queue
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_recipe, is_serializable
from unjam.drivers.user_driver import code_hashes
from unjam.errors import EpisodeError, SumoInputError
from unjam.parameters import split_parameters
from unjam.processes import PrivateFolder, check_owner, remove_stale_private_folders
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.sumo_files import MAX_READER_TIME, stored_answer
from unjam.tree import Arrays, unpack
from unjam.worlds.backend import BackendLike
from unjam.worlds.messages import read_message, start_child, write_message
from unjam.worlds.record import Episode, failed_episode
from unjam.worlds.reward import RewardLike

MAX_EPISODE_ATTEMPTS = 3
"""number of attempts to run an episode before its record reports a failure"""
WORKER_TIMEOUT = 30.0
"""time without a message, excluding waits for a processor, after which a worker counts as hung [s]"""
MIN_PROCESSOR_WAIT = 0.1
"""wait for a processor below which a silent worker counts as hung [s]"""

ResultT = TypeVar("ResultT")
Message = tuple[dict[str, Any], Arrays]


@dataclass(frozen=True)
class EpisodeTask:
    """The arguments of one call of `run_episode`."""

    scenario: Scenario
    driver: Driver
    seed: tuple[int, ...]
    reward: RewardLike = ""
    """a function is only allowed for episodes in this process"""
    explore: float = 0.0
    record_details: bool = False
    stop_at_contact: bool = True
    backend: BackendLike = "sumo"
    """an object is only allowed for episodes in this process"""

    @property
    def is_serializable(self) -> bool:
        """Whether another process can run the task."""
        is_named = isinstance(self.reward, str) and isinstance(self.backend, str)
        return is_named and is_serializable(self.driver)

    def message(self) -> Message:
        """Return the message that sends the task to a worker."""
        recipe, arrays = driver_recipe(self.driver)
        names = "reward", "explore", "record_details", "stop_at_contact", "backend"
        content = {name: getattr(self, name) for name in names}
        content |= {"seed": list(self.seed), "scenario": scenario_recipe(self.scenario), "driver": recipe}
        return content, arrays

    def code_hashes(self) -> dict[str, str]:
        """Return hashes of the files of reward and backend by path; drivers and scenarios contain their own hashes."""
        reward, _ = split_parameters(str(self.reward or self.scenario.reward))
        return code_hashes([reward, str(self.backend)])


class WorkerPool(AbstractContextManager["WorkerPool"]):
    """A fixed number of worker processes, which start when first needed, and are replaced when they die or hang."""

    def __init__(
        self, count: int = 1, timeout: float = WORKER_TIMEOUT, max_attempts: int = MAX_EPISODE_ATTEMPTS
    ) -> None:
        self.count, self._max_attempts, self._is_first, self._owner = count, max_attempts, True, os.getpid()
        remove_stale_private_folders()
        self._temporary_folder = PrivateFolder()  # shared, so that killed workers leave no files
        self._idle_workers: queue.LifoQueue[_Worker] = queue.LifoQueue()
        self._workers = [_Worker(timeout, self._temporary_folder.name) for _ in range(count)]
        self._code_hashes = dict[str, str]()
        self._thread_pool = ThreadPoolExecutor(count, thread_name_prefix="unjam-worker")
        for worker in self._workers:
            self._idle_workers.put(worker)

    def run(self, tasks: Sequence[EpisodeTask], on_progress: Callable[[int, int], None] | None = None) -> list[Episode]:
        """Run all tasks and return their episodes in order; a failed episode contains the reason.

        `on_progress` is called with a task's index and its control steps so far, from several threads.
        """
        return self.run_and_map(tasks, lambda index, episode: episode, on_progress)

    def run_and_map(
        self,
        tasks: Sequence[EpisodeTask],
        transform: Callable[[int, Episode], ResultT],
        on_progress: Callable[[int, int], None] | None = None,
    ) -> list[ResultT]:
        """Run all tasks and return `transform(index, episode)` of each; episodes need not stay in memory.

        `transform` is called from several threads. Raise `SumoInputError` if SUMO refuses the files of the first task
        of the pool, because it would refuse those of the others, too.
        """
        check_owner(self._owner, "worker pool: it")
        task_by_code = {(task.reward, task.scenario.reward, task.backend): task for task in tasks}
        for task in task_by_code.values():
            self._code_hashes = task.code_hashes() | self._code_hashes  # the first hash of a file stays valid
        is_first, self._is_first = self._is_first, False

        def run_one(index: int, task: EpisodeTask) -> ResultT:
            episode = self._run_one(index, task, on_progress)
            if is_first and index == 0 and episode.error == SumoInputError.__name__:
                raise SumoInputError(episode.reason)
            return transform(index, episode)

        try:
            return list(self._thread_pool.map(run_one, range(len(tasks)), tasks))
        except BaseException:  # may be an interrupt
            self.close()
            raise

    def _run_one(self, index: int, task: EpisodeTask, on_progress: Callable[[int, int], None] | None) -> Episode:
        worker = self._idle_workers.get()
        reasons = list[str]()
        try:
            for _ in range(self._max_attempts):
                try:
                    report_steps = partial(on_progress, index) if on_progress else lambda steps: None
                    episode = worker.run(task, self._code_hashes, report_steps)
                    if on_progress is not None:
                        on_progress(index, episode.control_steps)
                    return episode
                except _WorkerLostError as lost:
                    reasons.append(str(lost))
            reason = f"{self._max_attempts} workers were lost in this episode: {'; '.join(dict.fromkeys(reasons))}"
            return failed_episode(task.seed, reason, EpisodeError.__name__)
        finally:
            self._idle_workers.put(worker)

    def close(self) -> None:
        """Stop all workers; further calls have no effect."""
        for worker in self._workers:
            worker.stop()
        self._thread_pool.shutdown(wait=True, cancel_futures=True)
        self._temporary_folder.cleanup()

    def __exit__(self, *error: object) -> None:
        self.close()


class _WorkerLostError(Exception):
    """The worker process died or did not answer."""


class _Worker:
    """A worker process and the pipes to it."""

    def __init__(self, timeout: float, temporary_folder: str) -> None:
        self._timeout, self._temporary_folder = timeout, temporary_folder
        self._process: subprocess.Popen[bytes] | None = None
        self._is_stopped = self._is_sandboxed = False
        self._sent_files = set[str]()
        self._start_lock = threading.Lock()

    def _start(self) -> subprocess.Popen[bytes]:
        # BLAS threads would compete with the other workers for the cores.
        environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TMPDIR": self._temporary_folder}
        self._error_file = tempfile.TemporaryFile()  # noqa: SIM115  (closed after the process)
        process = start_child("unjam.worlds.worker", self._error_file, **environment)
        self._sent_files.clear()
        self._messages: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        threading.Thread(target=_forward_messages, args=(process, self._messages), daemon=True).start()
        return process

    def run(self, task: EpisodeTask, code: dict[str, str], on_progress: Callable[[int], object]) -> Episode:
        """Return the episode of a task, given hashes of its code; raise `_WorkerLostError` if the process is lost."""
        was_sandboxed, self._is_sandboxed = self._is_sandboxed, task.scenario.reads_user_files
        if was_sandboxed and not self._is_sandboxed:  # a process cannot leave its sandbox
            self._kill()
        with self._start_lock:
            if self._is_stopped:
                raise _WorkerLostError("stopped")
            process = self._process = self._process or self._start()
        # A sandboxed process reads a user's network before its first message.
        timeout = self._timeout + (MAX_READER_TIME if self._is_sandboxed else 0.0)
        try:
            content, arrays = task.message()
            self._send(process, {**content, "code": code}, arrays)
            while (message := self._next_message(process, timeout)) is not None:
                timeout = self._timeout
                content, arrays = message
                if "episode" in content:
                    return unpack(Episode, content["episode"], arrays)
                on_progress(content["progress"])
        except queue.Empty:
            self._kill()
            raise _WorkerLostError(f"no message for {timeout:g} s") from None
        except BrokenPipeError:
            pass
        raise _WorkerLostError(self._exit_reason(process))

    def _next_message(self, process: subprocess.Popen[bytes], timeout: float) -> Message | None:
        """Return the next message, None after the last one; raise `queue.Empty` after `timeout` [s]."""
        while True:
            previous_wait = processor_wait(process.pid)
            try:
                return self._messages.get(timeout=timeout)
            except queue.Empty:  # the process may have waited for a processor
                timeout = processor_wait(process.pid) - previous_wait
                if timeout < MIN_PROCESSOR_WAIT:
                    raise

    def _send(self, process: subprocess.Popen[bytes], content: dict[str, Any], arrays: Arrays) -> None:
        """Send a task; the first task with a file of the user also contains its content."""
        assert process.stdin is not None
        file = content["scenario"].get("file")
        if file and file not in self._sent_files and (answer := stored_answer(file)):
            self._sent_files.add(file)
            content = {**content, "files": answer}
        timer = threading.Timer(self._timeout, process.kill)  # a write into a full pipe without a reader never returns
        timer.start()
        try:
            write_message(process.stdin, content, dict(arrays))
        finally:
            timer.cancel()

    def _exit_reason(self, process: subprocess.Popen[bytes]) -> str:
        try:
            code = process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:  # the process runs, but its messages cannot be read
            process.kill()
            code = process.wait()
        self._process = None
        self._error_file.seek(0)
        last_line = self._error_file.read().decode(errors="replace").strip().splitlines()[-1:]
        return ": ".join([f"killed by signal {-code}" if code < 0 else f"ended with code {code}", *last_line])

    def _kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def stop(self) -> None:
        """End the process for good."""
        with self._start_lock:
            self._is_stopped = True
            self._kill()


def processor_wait(process_id: int) -> float:
    """Return the total time that a process has waited for a processor [s]; 0 if it is unknown."""
    with suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{process_id}/schedstat").read_text().split()[1]) / 1e9
    return 0.0


def _forward_messages(process: subprocess.Popen[bytes], messages: "queue.SimpleQueue[Message | None]") -> None:
    """Put the messages of the process into a queue, and None after the last message."""
    assert process.stdout is not None
    try:
        while True:
            messages.put(read_message(process.stdout))
    except Exception:  # the end of the pipe, also within a message
        messages.put(None)
