import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import random_network
from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_record import fingerprint
from unjam.drivers import IDM, Constant, Driver, Human, LocalState, Memory, PISaturation, ResidualDriver
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.user_driver import FileDriver, FileReference
from unjam.errors import InputError
from unjam.scenarios import Ring, make_scenario
from unjam.worlds import worker_pool
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool, processor_wait

SHORT = Ring(horizon=60)
CRASHING = Ring(horizon=500, actuation="raw", safety=SafetyFilter(active=False))
LONG = Ring(horizon=15_000)  # more than half a second: long enough to be disturbed
RESIDUAL = ResidualDriver(PISaturation(), random_network(), 1.0, action_repeat=3)

DRIVERS = """
import os, sys, time
import numpy as np

def steady(state):
    return np.zeros(len(state.speed))

def kills_its_process(state):
    os.kill(os.getpid(), 9)

def leaves(state):
    sys.exit(5)

def leaves_at_once(state):
    os._exit(5)

def talks(state):
    print("all is well " * 1000)
    sys.stderr.write("or is it? " * 1000)
    return np.zeros(len(state.speed))

def writes_everywhere(state):
    for file in range(3, 32):
        try:
            os.write(file, b"x" * 64)
        except OSError:
            pass
    return np.zeros(len(state.speed))

def thinks_long(state):
    time.sleep(0.025)
    return np.zeros(len(state.speed))

def is_limited(state):
    import resource
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return np.full(len(state.speed), -0.5 if limit == resource.RLIM_INFINITY else 0.5)

def finds_torch(state):
    return np.full(len(state.speed), 0.5 if "torch" in sys.modules else -0.5)

class ReadsAnEmptyFile:
    def initial_memory(self, n):
        return {"weights": np.load(os.devnull)}
    def act(self, state, memory):
        return np.zeros(len(state.speed)), memory

class StaysBeforeItsFirstStep:
    def initial_memory(self, n):
        while True:
            time.sleep(1)
    def act(self, state, memory):
        return np.zeros(len(state.speed)), memory
"""


@pytest.fixture
def drivers(tmp_path: Path) -> Path:
    path = tmp_path / "drivers.py"
    path.write_text(DRIVERS)
    return path


@pytest.fixture(scope="module")
def workers() -> Iterator[WorkerPool]:
    with WorkerPool(1) as pool:
        yield pool


@pytest.fixture(scope="module")
def undisturbed_results() -> list[Any]:
    return [fingerprint(run_episode(LONG, PISaturation(), (seed,))) for seed in range(2)]


def processes(workers: WorkerPool) -> list[int]:
    """Process numbers of the workers that are running."""
    running = [worker._process for worker in workers._workers]
    return [process.pid for process in running if process is not None]


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def has_ended(process: int) -> bool:
    """Whether a process without its parent has ended, even if no process has waited for it yet."""
    if not is_running(process):
        return True
    state = Path(f"/proc/{process}/stat")
    try:
        return state.read_text().rpartition(") ")[2][0] == "Z"
    except (FileNotFoundError, ProcessLookupError):  # between the two questions, or a system without /proc
        return not is_running(process)


def tasks_of_all_kinds(my_drivers: Path) -> list[EpisodeTask]:
    return [
        EpisodeTask(replace(SHORT, horizon=900), PISaturation(), (0,)),
        EpisodeTask(SHORT, Human(), (1, 2), record_details=True),
        EpisodeTask(replace(SHORT, warmup=40, cavs=2), RESIDUAL, (2,), "eq16", explore=True),
        EpisodeTask(CRASHING, Constant(1.0), (3,)),
        EpisodeTask(replace(SHORT, steps_per_control_step=5), FileDriver(my_drivers, "gentle"), (4,)),
        EpisodeTask(SHORT, FileDriver(my_drivers, "Keeper", {"gain": 0.2}), (5,), f"{my_drivers}:calm"),
    ]


@pytest.mark.long
@pytest.mark.parametrize("count", [1, 2, pytest.param(4, marks=pytest.mark.slow)])
def test_any_number_of_workers_gives_the_same_bytes_as_this_process(count: int, my_drivers: Path) -> None:
    tasks = tasks_of_all_kinds(my_drivers)
    expected = [
        run_episode(task.scenario, task.driver, task.seed, task.reward, task.explore, task.record_details)
        for task in tasks
    ]
    with WorkerPool(count) as workers:
        first, again = workers.run(tasks), workers.run(tasks)
    for found in (first, again):
        assert [fingerprint(episode) for episode in found] == [fingerprint(episode) for episode in expected]
    assert [episode.status for episode in first] == ["completed"] * 3 + ["collision"] + ["completed"] * 2


@pytest.mark.long
def test_episodes_are_in_the_order_of_their_tasks() -> None:
    horizons = [6000, 10, 3000, 20, 30, 1000, 40]
    tasks = [EpisodeTask(Ring(horizon=horizon), IDM(), (seed,)) for seed, horizon in enumerate(horizons)]
    with WorkerPool(2) as workers:
        found = workers.run(tasks)
    assert [(episode.control_steps, episode.seed) for episode in found] == [
        (horizon, (seed,)) for seed, horizon in enumerate(horizons)
    ]


def test_an_empty_list_of_tasks_starts_no_process() -> None:
    with WorkerPool(2) as workers:
        assert workers.run([]) == []
        assert processes(workers) == []


def test_consecutive_tasks_start_one_process() -> None:
    with WorkerPool(2) as workers:
        for seed in range(2):
            workers.run([EpisodeTask(SHORT, IDM(), (seed,))])
        assert len(processes(workers)) == 1


def test_a_worker_continues_with_the_next_task(workers: WorkerPool) -> None:
    workers.run([EpisodeTask(SHORT, IDM(), (0,))])
    first = processes(workers)
    workers.run([EpisodeTask(SHORT, IDM(), (seed,)) for seed in range(5)])
    assert processes(workers) == first
    assert len(first) == 1


@pytest.mark.long
def test_progress_is_reported_for_each_task() -> None:
    reported: list[tuple[int, int]] = []
    with WorkerPool(2) as workers:
        workers.run(
            [EpisodeTask(LONG, IDM(), (0,)), EpisodeTask(SHORT, IDM(), (1,))],
            lambda task, steps: reported.append((task, steps)),
        )
    assert {(0, 15_000), (1, 60)} <= set(reported)
    assert any(task == 0 and 0 < steps < 15_000 for task, steps in reported)


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [signal.SIGKILL, *(pytest.param(other, marks=pytest.mark.slow) for other in (signal.SIGSEGV, signal.SIGSTOP))],
)
def test_an_episode_whose_worker_is_lost_is_repeated_to_the_same_bytes(
    how: signal.Signals, undisturbed_results: list[Any]
) -> None:
    disturbed: list[int] = []
    with WorkerPool(1, timeout=3.0) as workers:

        def disturb(task: int, steps: int) -> None:
            if not disturbed and 0 < steps < LONG.horizon:
                disturbed.extend(processes(workers))
                os.kill(disturbed[0], how)

        began = time.monotonic()
        (found,) = workers.run([EpisodeTask(LONG, PISaturation(), (0,))], disturb)
        assert time.monotonic() - began < 120.0
        assert len(disturbed) == 1
        assert not is_running(disturbed[0])
        assert processes(workers) != disturbed
    assert fingerprint(found) == undisturbed_results[0]


@pytest.mark.slow
def test_losing_worker_after_worker_changes_nothing(undisturbed_results: list[Any]) -> None:
    killed: list[int] = []
    one_at_a_time = threading.Lock()
    with WorkerPool(2) as workers:

        def kill_two(task: int, steps: int) -> None:
            with one_at_a_time:
                if len(killed) < 2 and 0 < steps < LONG.horizon:
                    killed.append(next(process for process in processes(workers) if process not in killed))
                    os.kill(killed[-1], signal.SIGKILL)

        found = workers.run([EpisodeTask(LONG, PISaturation(), (seed,)) for seed in range(2)], kill_two)
    assert len(killed) == 2
    assert [fingerprint(episode) for episode in found] == undisturbed_results


def test_an_idle_worker_that_is_lost_is_replaced(workers: WorkerPool) -> None:
    task = EpisodeTask(SHORT, IDM(), (0,))
    (expected,) = workers.run([task])
    (process,) = processes(workers)
    os.kill(process, signal.SIGKILL)
    (found,) = workers.run([task])
    assert fingerprint(found) == fingerprint(expected)
    assert not is_running(process)


@pytest.mark.slow
def test_a_worker_stopped_while_idle_is_noticed_also_by_a_task_larger_than_the_pipe() -> None:
    large = ResidualDriver(IDM(), random_network(size=200), 1.0)
    with WorkerPool(1, timeout=3.0) as workers, ThreadPoolExecutor(1) as thread:
        workers.run([EpisodeTask(SHORT, IDM(), (0,))])
        (process,) = processes(workers)
        os.kill(process, signal.SIGSTOP)
        run = thread.submit(workers.run, [EpisodeTask(SHORT, large, (0,))])
        try:
            (found,) = run.result(timeout=120.0)
        finally:
            if is_running(process):
                os.kill(process, signal.SIGKILL)  # or this test would hang with it
    assert fingerprint(found) == fingerprint(run_episode(SHORT, large, (0,)))


@pytest.mark.slow
def test_a_driver_that_always_kills_its_process_fails_alone_after_three_attempts(drivers: Path) -> None:
    good = [EpisodeTask(SHORT, IDM(), (seed,)) for seed in range(4)]
    bad = EpisodeTask(SHORT, FileDriver(drivers, "kills_its_process"), (7, 8))
    with WorkerPool(2) as workers:
        first, second, failed, *rest = workers.run([*good[:2], bad, *good[2:]])
    assert (failed.status, failed.seed, failed.error) == ("failed", (7, 8), "EpisodeError")
    assert failed.reason == "3 workers were lost in this episode: killed by signal 9"
    expected = [fingerprint(run_episode(SHORT, IDM(), (seed,))) for seed in range(4)]
    assert [fingerprint(episode) for episode in (first, second, *rest)] == expected


@pytest.mark.slow
def test_the_number_of_attempts_can_be_set(drivers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    popen: Any = subprocess.Popen

    def count(*arguments: Any, **options: Any) -> Any:
        started.append(popen(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", count)
    bad = EpisodeTask(SHORT, FileDriver(drivers, "kills_its_process"), (0,))
    with WorkerPool(1, max_attempts=2) as workers:
        (failed,) = workers.run([bad])
        assert failed.reason.startswith("2 workers were lost in this episode")
        assert len(started) == 2
        (found,) = workers.run([EpisodeTask(SHORT, IDM(), (0,))])
        assert found.status == "completed"
        assert len(started) == 3


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [("leaves", "InputError", "SystemExit: 5"), ("leaves_at_once", "EpisodeError", "ended with code 5")],
)
def test_a_driver_that_exits_is_reported_with_its_exit_code(name: str, error: str, words: str, drivers: Path) -> None:
    with WorkerPool(1, max_attempts=1) as workers:
        (failed,) = workers.run([EpisodeTask(SHORT, FileDriver(drivers, name), (0,))])
    assert (failed.status, failed.error) == ("failed", error)
    assert words in failed.reason


@pytest.mark.long
def test_a_driver_that_hangs_is_ended(drivers: Path) -> None:
    hangs = FileDriver(drivers, "StaysBeforeItsFirstStep")
    with WorkerPool(1, timeout=2.0, max_attempts=1) as workers:
        (failed,) = workers.run([EpisodeTask(SHORT, hangs, (0,))])
        assert processes(workers) == []
    assert (failed.status, failed.error) == ("failed", "EpisodeError")
    assert "no message for 2 s" in failed.reason


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="only Linux says how long a process waited")
def test_processes_that_share_a_processor_wait_for_it() -> None:
    pinned = f"import os; os.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})\nwhile True: pass"
    busy = [subprocess.Popen([sys.executable, "-c", pinned]) for _ in range(3)]
    try:
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline and min(processor_wait(each.pid) for each in busy) < 0.3:
            time.sleep(0.1)
        assert min(processor_wait(each.pid) for each in busy) >= 0.3
    finally:
        for each in busy:
            each.kill()
            each.wait()


@pytest.mark.parametrize(("wait", "status"), [(5.0, "completed"), (0.0, "failed")])
def test_time_in_which_a_worker_has_no_processor_does_not_count_against_it(
    wait: float, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with WorkerPool(1, max_attempts=1) as workers, ThreadPoolExecutor(1) as thread:
        workers.run([EpisodeTask(SHORT, IDM(), (0,))])  # so that no time goes into starting it
        workers._workers[0]._timeout = 0.5
        (process,) = processes(workers)
        waits = count(0.0, wait)
        monkeypatch.setattr(worker_pool, "processor_wait", lambda process_id: next(waits))
        os.kill(process, signal.SIGSTOP)
        run = thread.submit(workers.run, [EpisodeTask(SHORT, IDM(), (0,))])
        time.sleep(2.0)
        if is_running(process):
            os.kill(process, signal.SIGCONT)
        assert run.result(timeout=60.0)[0].status == status


@pytest.mark.slow
def test_a_slow_driver_does_not_count_as_hung(drivers: Path) -> None:
    slow = EpisodeTask(replace(SHORT, horizon=110), FileDriver(drivers, "thinks_long"), (0,))
    with WorkerPool(1, timeout=2.0, max_attempts=1) as workers:
        workers.run([EpisodeTask(SHORT, IDM(), (0,))])  # so that no time goes into starting it
        (found,) = workers.run([slow])
    assert (found.status, found.reason) == ("completed", "")


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("raises", "InputError", "lost the map"),
        ("broken", "InputError", "driver: step 0: acceleration of cav_0 is nan"),
        ("short", "InputError", "mine.py:short: acceleration has shape (2,)"),
    ],
)
def test_a_drivers_error_message_is_reported_and_the_worker_continues(
    name: str, error: str, words: str, my_drivers: Path, workers: WorkerPool
) -> None:
    good = EpisodeTask(SHORT, IDM(), (0,))
    (expected,) = workers.run([good])
    process = processes(workers)
    failed, found = workers.run([EpisodeTask(SHORT, FileDriver(my_drivers, name), (5,)), good])
    assert (failed.status, failed.seed, failed.error) == ("failed", (5,), error)
    assert words in failed.reason
    assert "\n" not in failed.reason
    assert fingerprint(found) == fingerprint(expected)
    assert processes(workers) == process


def test_an_end_of_file_in_user_code_does_not_end_the_worker(drivers: Path, workers: WorkerPool) -> None:
    workers.run([EpisodeTask(SHORT, IDM(), (0,))])
    process = processes(workers)
    (failed,) = workers.run([EpisodeTask(SHORT, FileDriver(drivers, "ReadsAnEmptyFile"), (0,))])
    assert failed.status == "failed"
    assert "EOFError: No data left in file" in failed.reason
    assert processes(workers) == process


def test_sumos_error_message_is_reported_and_the_worker_continues(workers: WorkerPool) -> None:
    good = EpisodeTask(SHORT, IDM(), (0,))
    bad = EpisodeTask(replace(SHORT, emission_class="coal"), IDM(), (5,))
    _, failed, found = workers.run([good, bad, good])
    assert (failed.status, failed.error) == ("failed", "SumoInputError")
    assert "'coal' doesn't exist" in failed.reason
    assert fingerprint(found) == fingerprint(run_episode(SHORT, IDM(), (0,)))


@pytest.mark.long
def test_every_task_has_an_episode_whatever_happens(my_drivers: Path, drivers: Path) -> None:
    tasks = [
        EpisodeTask(SHORT, driver, (seed,), reward)
        for seed, (driver, reward) in enumerate(
            [
                (FileDriver(my_drivers, "raises"), ""),
                (IDM(), ""),
                (FileDriver(drivers, "kills_its_process"), ""),
                (IDM(), f"{my_drivers}:wrong_reward"),
                (FileDriver(my_drivers, "gentle"), ""),
                (IDM(), "fame"),
            ]
        )
    ]
    with WorkerPool(2) as workers:
        found = workers.run(tasks)
    assert [episode.seed for episode in found] == [task.seed for task in tasks]
    assert [episode.has_run for episode in found] == [False, True, False, False, True, False]
    assert all(episode.reason for episode in found if not episode.has_run)


def test_what_a_driver_prints_does_not_disturb_the_answers(drivers: Path, workers: WorkerPool) -> None:
    talking, silent = workers.run([EpisodeTask(SHORT, FileDriver(drivers, name), (0,)) for name in ("talks", "steady")])
    assert talking.status == "completed"
    assert fingerprint(talking) == fingerprint(silent)


@pytest.mark.long
def test_a_worker_with_an_unreadable_answer_counts_as_lost(drivers: Path) -> None:
    bad = EpisodeTask(SHORT, FileDriver(drivers, "writes_everywhere"), (0,))
    with WorkerPool(1, timeout=3.0, max_attempts=1) as workers, ThreadPoolExecutor(1) as thread:
        run = thread.submit(workers.run, [bad])
        try:
            (failed,) = run.result(timeout=120.0)
        finally:
            for process in processes(workers):
                os.kill(process, signal.SIGKILL)  # or this test would hang with it
    assert (failed.status, failed.error) == ("failed", "EpisodeError")


def test_a_driver_that_is_not_serializable_is_refused_with_a_hint() -> None:
    class Mine(Driver):
        def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
            return state.speed * 0.0, memory

    with WorkerPool(1) as workers, pytest.raises(InputError, match=r"'Mine' is not allowed.*path\.py:name"):
        workers.run([EpisodeTask(SHORT, Mine(), (0,))])


@pytest.mark.long
def test_closing_twice_leaves_no_process() -> None:
    workers = WorkerPool(2)
    workers.run([EpisodeTask(Ring(horizon=2000), IDM(), (seed,)) for seed in range(4)])
    running = processes(workers)
    assert len(running) == 2
    assert all(is_running(process) for process in running)
    workers.close()
    assert not any(is_running(process) for process in running)
    workers.close()


def test_workers_that_were_never_used_can_be_closed() -> None:
    workers = WorkerPool(3)
    workers.close()
    workers.close()


def test_an_error_inside_the_block_leaves_no_process() -> None:
    running: list[int] = []

    def fail() -> None:
        with WorkerPool(1) as workers:
            workers.run([EpisodeTask(SHORT, IDM(), (0,))])
            running.extend(processes(workers))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert len(running) == 1
    assert not is_running(running[0])


def when_running(workers: WorkerPool, then: Callable[[], None]) -> tuple[threading.Thread, list[Any]]:
    """Run long episodes in a thread, and do something once they run."""
    found: list[Any] = []
    runs = threading.Event()

    def run() -> None:
        tasks = [EpisodeTask(LONG, IDM(), (seed,)) for seed in range(6)]
        try:
            found.extend(workers.run(tasks, lambda task, steps: runs.set()))
        except BaseException as error:
            found.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert runs.wait(20.0)
    then()
    return thread, found


def test_closing_while_episodes_run_ends_them_and_leaves_no_process() -> None:
    workers = WorkerPool(2)
    running: list[int] = []

    def close() -> None:
        running.extend(processes(workers))
        workers.close()

    thread, found = when_running(workers, close)
    thread.join(10.0)
    assert not thread.is_alive()
    assert found
    assert processes(workers) == []
    assert running
    assert not any(is_running(process) for process in running)


def test_closing_while_a_worker_starts_leaves_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    starts = threading.Event()
    popen: Any = subprocess.Popen

    def start_slowly(*arguments: Any, **options: Any) -> Any:
        started.append(popen(*arguments, **options))
        starts.set()
        time.sleep(0.3)
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start_slowly)
    workers = WorkerPool(1)
    thread = threading.Thread(target=workers.run, args=([EpisodeTask(SHORT, IDM(), (0,))],), daemon=True)
    thread.start()
    assert starts.wait(20.0)
    workers.close()
    thread.join(10.0)
    try:
        assert not thread.is_alive()
        assert len(started) == 1
        assert not is_running(started[0].pid)
    finally:
        started[0].kill()
        started[0].wait()


def test_an_error_in_the_progress_report_ends_the_run_and_leaves_no_process() -> None:
    running: list[int] = []
    workers = WorkerPool(2)

    def fail(task: int, steps: int) -> None:
        running.extend(processes(workers))
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        workers.run([EpisodeTask(LONG, IDM(), (seed,)) for seed in range(3)], fail)
    assert running
    assert not any(is_running(process) for process in running)


def test_workers_end_with_their_parent_process() -> None:
    code = (
        "import os, signal\n"
        "from unjam.drivers import IDM\n"
        "from unjam.scenarios import Ring\n"
        "from unjam.worlds.worker_pool import EpisodeTask, WorkerPool\n"
        "workers = WorkerPool(1)\n"
        "workers.run([EpisodeTask(Ring(horizon=10), IDM(), (0,))])\n"
        "print(workers._workers[0]._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    parent = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert parent.returncode == -signal.SIGKILL
    process, patience = int(parent.stdout), time.monotonic() + 10.0
    while not has_ended(process) and time.monotonic() < patience:
        time.sleep(0.05)
    assert has_ended(process)


def test_a_worker_imports_no_torch() -> None:
    heavy = {"torch", "matplotlib", "pandas"}
    code = f"import sys, unjam.worlds.worker; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_residual_driver_runs_without_torch(drivers: Path, workers: WorkerPool) -> None:
    expert = FileDriver(drivers, "finds_torch")
    driver = ResidualDriver(expert, random_network(), 1.0)
    (episode,) = workers.run([EpisodeTask(SHORT, driver, (0,), explore=True)])
    assert set(episode.trajectories[0].expert_acceleration) == {-0.5}


def test_a_worker_has_limited_memory_on_a_users_network(drivers: Path, tmp_path: Path) -> None:
    path = straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>')
    road = make_scenario(str(path), {"cav_types": ["car"], "horizon": 5})
    with WorkerPool(1) as workers:
        free, limited = workers.run(
            [EpisodeTask(scenario, FileDriver(drivers, "is_limited"), (0,)) for scenario in (SHORT, road)]
        )
    assert set(free.trajectories[0].applied_acceleration) == {-0.5}
    assert set(limited.trajectories[0].applied_acceleration) == {0.5}


RANDOM_DRIVER = """
import random
import numpy as np

class Noisy:
    def __init__(self):
        self.offset = np.random.normal()

    def initial_memory(self, n):
        return {}

    def act(self, state, memory):
        import torch  # workers do not import it themselves

        noise = np.random.normal(0.0, 0.3) + random.gauss(0.0, 0.3) + float(torch.randn(()))
        return 0.0 * state.speed + self.offset + noise, memory
"""


def test_a_driver_with_global_random_numbers_gives_the_same_episode_in_every_process(tmp_path: Path) -> None:
    (tmp_path / "noisy.py").write_text(RANDOM_DRIVER)
    reference = FileReference.parse(f"{tmp_path / 'noisy.py'}:Noisy")
    task = EpisodeTask(Ring(horizon=20), FileDriver(reference.path, reference.name), (5,))
    speeds = list[Any]()
    for _ in range(2):
        with WorkerPool(2) as workers:
            speeds += [episode.speeds for episode in workers.run([replace(task, seed=(4,)), task, task])[1:]]
    states = [(random.seed(1), random.getstate())[1], (np.random.seed(2), np.random.get_state())[1]]
    kind = reference.load_object()
    speeds += [run_episode(task.scenario, kind, seed).speeds for seed in (5, 4, 5)][::2]
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda seed: run_episode(task.scenario, kind, seed), (1, 2)))
    np.testing.assert_equal([random.getstate(), np.random.get_state()], states)
    for other in speeds[1:]:
        np.testing.assert_array_equal(other, speeds[0])
