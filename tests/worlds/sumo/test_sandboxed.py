"""Programs that drive on users' networks: SUMO is sandboxed, the driver is not."""

import itertools
import locale
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import IO, Any

import gymnasium
import numpy as np
import psutil
import pytest

from tests.test_processes import soon
from tests.test_sandbox import kept
from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_record import fingerprint
from unjam import drive
from unjam.drivers import IDM, LocalState
from unjam.errors import EpisodeError
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.messages import read_message
from unjam.worlds.sumo.backend import SumoBackend, make_traffic, sumo_inputs
from unjam.worlds.sumo.sandboxed import SandboxedSimulation, open_simulation
from unjam.worlds.sumo.simulation import Simulation

CARS = "".join(
    f'<vehicle id="{number}" type="car" route="along" depart="0" departPos="{400 - 60 * number}" departSpeed="10"/>'
    for number in range(5)
)
WRITING = ("--tripinfo-output={}", "--fcd-output={}", "--save-configuration={}")


@pytest.fixture
def road(tmp_path: Path) -> Scenario:
    return make_scenario(str(straight(tmp_path, CARS)), {"penetration_rate": 0.5, "horizon": 40})


def test_an_episode_is_the_same_wherever_sumo_runs(road: Scenario, sumo: SumoBackend) -> None:
    here = run_episode(road, IDM(), 3, backend=sumo, record_details=True)
    apart = run_episode(road, IDM(), 3, record_details=True)
    assert fingerprint(here) == fingerprint(apart)
    np.testing.assert_array_equal(here.poses, apart.poses)


def test_a_sandboxed_simulation_returns_the_same_results(road: Scenario, simulation: Simulation) -> None:
    methods = [name for name, of in vars(Simulation).items() if not name.startswith("_") and callable(of)]
    methods += ["speeds", "lane_offsets", "distances", "fuel", "time"]
    others = {"load", "step", "close", "command_speeds", "replace_speeds", "command_humans", "limit_braking"}
    others |= {"take_control", "change_type", "end_with_trips", "is_in_contact", "teleport_count", "finish", "passages"}
    others |= {"stop_at", "end_stop", "replay"}  # of built-in roads
    answers = []
    with SandboxedSimulation() as apart:
        for each in (simulation, apart):
            make_traffic(road, (0,), each).start(is_controlled=False)  # pyright: ignore[reportArgumentType]
            names = ["0", "1"]
            arguments = dict[str, tuple[object, ...]]({"neighbors": ("1", 100.0), "left": (), "expects_vehicles": ()})
            arguments |= dict.fromkeys(("lanes", "time", "has_refused", "jam_teleport_count"), ())
            arguments |= dict.fromkeys(("type_of", "route_of"), ("1",)) | {"type_limits": ("DEFAULT_VEHTYPE",)}
            answers.append(
                {name: getattr(each, name)(*arguments.get(name, (names,))) for name in methods if name not in others}
            )
    for name, answer in answers[0].items():
        assert type(answers[1][name]) is type(answer), name
        np.testing.assert_equal(answers[1][name], answer, name)


def test_a_drivers_function_runs_in_its_own_process(road: Scenario, tmp_path: Path) -> None:
    seen = []

    def mine(state: LocalState) -> np.ndarray:
        seen.append(os.getpid())
        (tmp_path / "mine").touch()
        return np.zeros(len(state.speed))

    result = drive(road.file, mine, 1, scenario_options={"penetration_rate": 0.5, "horizon": 5})  # pyright: ignore
    assert [row["status"] for rows in result.rows.values() for row in rows] == ["completed"]
    assert set(seen) == {os.getpid()}


FORKING = """
import os, sys
from unjam import run_episode
from unjam.scenarios import Ring, make_scenario
codes = []
def forking(state):
    if not codes:
        child = os.fork()
        if child == 0:
            sys.exit(3)
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    return 0 * state.speed
if __name__ == "__main__":
    options = {"penetration_rate": 0.5, "horizon": 5}
    print(run_episode(make_scenario(sys.argv[1], options), forking, 0).status, codes)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_that_ends_in_a_driver_leaves_the_episode_to_its_parent(road: Scenario, tmp_path: Path) -> None:
    program, file = tmp_path / "forking.py", tmp_path / "straight.sumocfg"
    program.write_text(FORKING)
    done = subprocess.run([sys.executable, program, file], capture_output=True, text=True, timeout=60)
    assert done.stdout == "completed [3]\n", done.stderr
    in_worker = drive(str(file), f"{program}:forking", 1, scenario_options={"penetration_rate": 0.5, "horizon": 5})
    assert [row["status"] for rows in in_worker.rows.values() for row in rows] == ["completed"]


FORKED = """
import os, sys
from unjam.drivers import IDM
from unjam.errors import LostWorkerError
from unjam.scenarios import Ring, make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.sandboxed import SandboxedSimulation
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
if __name__ == "__main__":
    road = make_scenario(sys.argv[1], {"penetration_rate": 0.5, "horizon": 5})
    with SandboxedSimulation() as sandboxed, Simulation("traci") as connected, WorkerPool(1) as workers:
        calls = [
            lambda: run_episode(road, IDM(), 0, backend=SumoBackend(sandboxed)).speeds.sum(),
            lambda: run_episode(road, IDM(), 0, backend=SumoBackend(connected)).speeds.sum(),
            lambda: workers.run([EpisodeTask(road, IDM(), (0,))])[0].speeds.sum(),
        ]
        before = [call() for call in calls]
        for call in calls:
            child = os.fork()
            if child == 0:
                try:
                    call()
                except LostWorkerError as error:
                    os._exit(7 if "os.fork" in str(error) else 8)
                os._exit(9)
            print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), end=" ")
        print([call() for call in calls] == before, flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_may_not_use_processes_of_its_parent(road: Scenario, tmp_path: Path) -> None:
    program = tmp_path / "forked.py"
    program.write_text(FORKED)
    done = subprocess.run(
        [sys.executable, program, tmp_path / "straight.sumocfg"], capture_output=True, text=True, timeout=120
    )
    assert done.stdout == "7 7 7 True\n", done.stderr


@pytest.mark.long
@kept
@pytest.mark.parametrize("option", WRITING)
def test_the_kernel_refuses_that_sumo_writes(option: str, road: Scenario, tmp_path: Path) -> None:
    canary, files = tmp_path / "canary", sumo_inputs(road, road.draw_from_seed((0,))[0])
    canary.write_text("as it was")
    options = (*files.options, option.format(canary))
    with SandboxedSimulation() as simulation, pytest.raises(EpisodeError, match="SUMO cannot start") as caught:
        simulation.load(files._replace(options=options), road.simulation_step, 0)
    assert "\n" not in str(caught.value)
    assert canary.read_text() == "as it was"


@kept
@pytest.mark.parametrize("option", WRITING)
def test_sumo_over_traci_writes_nothing_either(option: str, road: Scenario, tmp_path: Path) -> None:
    canary, files = tmp_path / "canary", sumo_inputs(road, road.draw_from_seed((0,))[0])
    canary.write_text("as it was")
    options = (*files.options, option.format(canary))
    with Simulation("traci") as simulation, pytest.raises(EpisodeError, match="SUMO cannot start"):
        simulation.load(files._replace(options=options), road.simulation_step, 0)
    assert canary.read_text() == "as it was"
    canary.write_text("this process may still write")


def test_a_lost_process_is_an_error_in_one_line_and_leaves_nothing(road: Scenario) -> None:
    with SandboxedSimulation() as simulation:
        process, folder = psutil.Process(simulation._process.pid), Path(simulation._folder.name)
        files = sumo_inputs(road, road.draw_from_seed((0,))[0])
        simulation.load(files, road.simulation_step, 0)
        process.kill()
        with pytest.raises(EpisodeError, match=r"SUMO was lost: .* -9"):
            simulation.step()
    assert soon(process.pid)
    assert not folder.exists()


def test_an_interrupt_within_a_call_does_not_mix_up_answers(
    road: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = tmp_path / "straight.sumocfg"
    environment = gymnasium.make("unjam/UserNetwork-v0", scenario=str(network), penetration_rate=0.5, horizon=40)

    def drive_steps() -> list[np.ndarray]:
        return [environment.reset(seed=1)[0], *(environment.step(np.zeros(1, np.float32))[0] for _ in range(5))]

    with closing(environment):
        expected = drive_steps()
        calls = itertools.count()

        def interrupt(pipe: IO[bytes]) -> Any:
            if next(calls) == 3:
                raise KeyboardInterrupt
            return read_message(pipe)

        with monkeypatch.context() as patch:
            patch.setattr("unjam.worlds.messages.read_message", interrupt)
            with pytest.raises(KeyboardInterrupt):
                drive_steps()
        np.testing.assert_equal(drive_steps(), expected)


def test_where_numbers_have_a_comma_sumo_runs_in_a_process_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = Ring(horizon=40)
    expected = fingerprint(run_episode(ring, IDM(), (0,)))
    monkeypatch.setattr(locale, "localeconv", lambda: {"decimal_point": ","})
    with pytest.warns(UserWarning, match="the locale of this process writes numbers with ','"), SumoBackend() as sumo:
        assert fingerprint(run_episode(ring, IDM(), (0,), backend=sumo)) == expected


def test_a_silent_process_is_lost_after_a_time(road: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unjam.worlds.sumo.sandboxed.MAX_ANSWER_SECONDS", 0.5)
    with SandboxedSimulation() as simulation:
        os.kill(simulation._process.pid, signal.SIGSTOP)
        with pytest.raises(EpisodeError, match=r"SUMO was lost: it did not answer for 0.5 s"):
            simulation.step()
        assert soon(simulation._process.pid)
        assert simulation.is_lost


def test_the_process_outlives_the_thread_that_started_it(road: Scenario) -> None:
    with ThreadPoolExecutor(1) as pool:
        apart = pool.submit(SandboxedSimulation).result()
    with apart:
        make_traffic(road, (0,), apart).start(is_controlled=False)  # pyright: ignore[reportArgumentType]
        assert apart.type_of("1") == "car"


def test_only_users_networks_are_sandboxed(road: Scenario) -> None:
    with open_simulation(False) as here, open_simulation(True) as apart:
        assert [type(here), type(apart)] == [Simulation, SandboxedSimulation]
