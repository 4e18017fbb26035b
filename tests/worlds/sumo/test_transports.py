"""libsumo and TraCI keep state of the whole process, in which users run simulations of their own."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import libsumo
import numpy as np
import pytest
import traci

import unjam
from tests.worlds.sumo.user_networks import straight
from unjam.drivers import LocalState
from unjam.environments.gymnasium_env import RoadEnv
from unjam.errors import EpisodeError, LostWorkerError, UnjamError
from unjam.scenarios import Ring, make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, sumo_inputs
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.transports import InUseError

RING = Ring(warmup=0, horizon=20)
FLOW = '<flow id="cav" type="car" route="along" begin="0" end="60" period="2"/>'
STEPS = 40
IN_OWN_PROCESS = "another simulation is open in this process, and libsumo holds one per process"


def coast(state: LocalState) -> np.ndarray:
    return 0.0 * np.asarray(state.speed)


@pytest.fixture
def command(tmp_path: Path) -> Iterator[list[str]]:
    """How a user starts SUMO on a road of their own."""
    yield [sumo_program("sumo"), "-c", str(straight(tmp_path, FLOW)), "--no-step-log", "--no-warnings"]
    if libsumo.isLoaded():
        libsumo.close()


def speeds_of(sumo: Any, command: list[str], meanwhile: Callable[[], object] = lambda: None) -> list[Any]:
    """The speeds in a user's simulation; `meanwhile` runs after half of its steps."""
    sumo.start(command)
    found = []
    for step in range(STEPS):
        if step == STEPS // 2:
            meanwhile()
        sumo.simulationStep()
        found.append([(name, sumo.vehicle.getSpeed(name)) for name in sumo.vehicle.getIDList()])
    sumo.close()
    return found


def episode_speeds() -> Any:
    return run_episode(RING, coast, 0).speeds


def environment_rewards() -> Any:
    with closing(gymnasium.make("unjam/Ring-v0", warmup=0, horizon=20)) as environment:
        environment.reset(seed=0)
        return [environment.step(np.zeros(1, np.float32))[1] for _ in range(20)]


def parallel_rewards() -> Any:
    with closing(unjam.parallel_env("ring", warmup=0, horizon=20)) as environment:
        environment.reset(seed=0)
        zero = {agent: np.zeros(1) for agent in environment.agents}
        return [environment.step(zero)[1]["cav_0"] for _ in range(20)]


def driven_speeds() -> Any:
    result = unjam.drive("ring", coast, 1, scenario_options={"warmup": 0, "horizon": 20})  # pyright: ignore
    return [row["mean_speed"] for rows in result.rows.values() for row in rows]


@pytest.mark.long
@pytest.mark.parametrize("run", [episode_speeds, environment_rewards, parallel_rewards, driven_speeds])
def test_a_users_libsumo_simulation_goes_on_undisturbed(run: Callable[[], Any], command: list[str]) -> None:
    undisturbed, expected, found = speeds_of(libsumo, command), run(), []
    with pytest.warns(UserWarning, match=IN_OWN_PROCESS):
        assert speeds_of(libsumo, command, lambda: found.append(run())) == undisturbed
    np.testing.assert_array_equal(found, [expected])
    np.testing.assert_array_equal(run(), expected)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:another simulation is open")
def test_a_users_traci_connection_stays_the_active_one(command: list[str]) -> None:
    def environments_and_a_failed_start() -> None:
        with closing(RoadEnv(warmup=0)) as first, closing(RoadEnv(warmup=0)) as second:
            first.reset(seed=1)
            second.reset(seed=1)
        road = sumo_inputs(RING, RING.draw_from_seed((0,))[0])
        with Simulation("traci") as simulation:
            with pytest.raises(EpisodeError):
                simulation.load(road._replace(traffic_xml="<routes"), 0.1, 0)
            simulation.load(road, 0.1, 0)
            assert traci.getLabel() == "default"

    undisturbed = speeds_of(traci, command)
    assert speeds_of(traci, command, environments_and_a_failed_start) == undisturbed


def start_another(command: list[str]) -> None:
    libsumo.start(command)
    libsumo.simulationStep()


CHANGES = {
    "start": start_another,
    "load": lambda command: libsumo.load(command[1:]),
    "step": lambda command: libsumo.simulationStep(),
    "close": lambda command: libsumo.close(),
}


@pytest.mark.parametrize("road", [RING, make_scenario("merge", {"cavs": 1, "standing_vehicles": 0, "horizon": 60})])
@pytest.mark.parametrize("change", CHANGES)
def test_changes_of_a_simulation_by_other_code_are_an_error_in_one_line(
    change: str, road: Any, command: list[str]
) -> None:
    calls = []

    def interfering(state: LocalState) -> np.ndarray:
        calls.append(state)
        if len(calls) == 5:
            CHANGES[change](command)
        return coast(state)

    with pytest.raises(LostWorkerError, match=r"SUMO was lost: other code in this process has .*run the episode"):
        run_episode(road, interfering, 0)
    assert len(calls) == 5
    assert libsumo.isLoaded() == (change in ("start", "load"))  # what is the user's goes on
    if libsumo.isLoaded():
        assert libsumo.vehicle.getIDList()[:1] in ((), ("cav.0",))
        libsumo.close()
    np.testing.assert_array_equal(episode_speeds(), episode_speeds())


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.filterwarnings("ignore:another simulation is open")
def test_an_environment_reports_a_lost_simulation_and_restarts_with_a_reset(change: str, command: list[str]) -> None:
    with closing(RoadEnv(warmup=0)) as environment:
        expected = environment.reset(seed=0)[0]
        CHANGES[change](command)
        for act in (lambda: environment.step(np.zeros(1)), environment.render):
            environment.render_mode = "rgb_array"
            with pytest.raises(LostWorkerError, match="SUMO was lost"):
                act()
        np.testing.assert_array_equal(environment.reset(seed=0)[0], expected)
        environment.step(np.zeros(1))
    assert libsumo.isLoaded() == (change in ("start", "load"))


def test_libsumo_is_not_taken_from_the_user(command: list[str]) -> None:
    libsumo.start(command)
    for _ in range(2):
        with pytest.raises(InUseError, match="already open in this process"):
            Simulation()
    libsumo.close()
    Simulation().close()


def test_an_episode_within_an_episode_of_the_same_simulation_is_refused(sumo: SumoBackend) -> None:
    def nested(state: LocalState) -> np.ndarray:
        run_episode(RING, coast, 1, backend=sumo)
        return coast(state)

    with pytest.raises(UnjamError, match="simulation: an episode is running in it; allowed: one at a time"):
        run_episode(RING, nested, 0, backend=sumo)
    assert run_episode(RING, coast, 0, backend=sumo).status == "completed"


AS_USERS_DO = """
import json, traci, unjam, warnings
warnings.simplefilter("ignore")
from tests.worlds.sumo.test_transports import environment_rewards, episode_speeds
from unjam.environments.gymnasium_env import RoadEnv
environment = RoadEnv(warmup=0)
environment.reset(seed=0)
apart = environment_rewards()
environment.close()
print(json.dumps([episode_speeds().tolist(), environment_rewards(), apart]))
"""


@pytest.mark.slow
def test_libsumo_as_traci_changes_no_number(tmp_path: Path) -> None:
    """Users of other packages set the variable: `import traci` is libsumo then, and says so."""

    def run(*arguments: str) -> str:
        variables = {**os.environ, "LIBSUMO_AS_TRACI": "1"}
        return subprocess.check_output([sys.executable, *arguments], env=variables, text=True)

    said, found = run("-c", AS_USERS_DO).splitlines()
    assert said.startswith("Using libsumo as traci")
    assert json.loads(found) == [episode_speeds().tolist(), *[environment_rewards()] * 2]
    options = ("--set", "warmup=0", "--set", "horizon=20", "--out", str(tmp_path / "out"))
    printed = run("-m", "unjam", "drive", "ring", "-d", "pi", "-n", "1", "--json", *options)
    json.loads(printed)
    row = run_rows("ring", "pi")
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["rows"][0]["mean_speed"] == row


def run_rows(road: str, driver: str) -> float:
    (row,) = unjam.drive(road, driver, 1, scenario_options={"warmup": 0, "horizon": 20}).rows[driver]
    return row["mean_speed"]
