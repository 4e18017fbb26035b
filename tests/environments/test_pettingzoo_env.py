import warnings
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import unjam
from tests.worlds.sumo.user_networks import straight
from unjam.drivers import Constant
from unjam.environments.gymnasium_env import CopyableLock, RoadStepResult
from unjam.errors import InputError
from unjam.measures.metrics import METRICS
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

SHORT: Any = {"horizon": 40, "cavs": 3}


@pytest.mark.parametrize("scenario", ["ring", "figure-eight"])
def test_passes_the_checks_of_pettingzoo_without_warnings(scenario: str, capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = unjam.parallel_env(scenario, **SHORT)
        parallel_api_test(environment, num_cycles=100)
        environment.close()


def test_steps_the_very_episode_that_run_episode_runs() -> None:
    expected = run_episode(make_scenario("ring", SHORT), Constant(acceleration=0.2), (4,))
    environment = unjam.parallel_env("ring", **SHORT)
    environment.reset(seed=4)
    rewards, infos = [], dict[str, Any]()
    while environment.agents:
        _, reward, *_, infos = environment.step({agent: np.array([0.2]) for agent in environment.agents})
        assert set(reward) == {"cav_0", "cav_7", "cav_15"}
        rewards.append(reward["cav_0"])
    environment.close()
    np.testing.assert_allclose(rewards, expected.trajectories[0].reward, atol=1e-12)
    metrics = infos["cav_7"]["episode_metrics"]
    assert metrics.pop("steps") == 40
    assert metrics == pytest.approx({name: METRICS[name].function(expected) for name in metrics}, abs=1e-9)
    assert len(metrics) > 4


def test_the_same_seed_gives_the_same_observations() -> None:
    environment = unjam.parallel_env("ring", **SHORT)
    seen = []
    for _ in range(2):
        observations, _ = environment.reset(seed=9)
        for _ in range(20):
            actions = dict.fromkeys(environment.agents, np.array([0.5]))
            observations, *_ = environment.step(actions)
        seen.append(np.array(list(observations.values())))
    environment.close()
    np.testing.assert_array_equal(*seen)


@pytest.mark.long
def test_passes_the_seed_test_of_pettingzoo() -> None:
    parallel_seed_test(lambda: unjam.parallel_env("ring", **SHORT), num_cycles=10)


@pytest.mark.slow
def test_on_an_own_network_cavs_are_called_in_order_of_entry(tmp_path: Path) -> None:
    flow = '<flow id="cav_1" type="car" route="along" begin="0" end="60" period="2"/>'
    file = str(straight(tmp_path, flow, length=300.0))
    road = {"penetration_rate": 0.6, "cavs": 3, "horizon": 400}
    expected = run_episode(make_scenario(file, road), Constant(acceleration=0.2), (4,))
    environment = unjam.parallel_env(file, **road)
    assert environment.possible_agents == ["cav_0", "cav_1", "cav_2"]
    first, _ = environment.reset(seed=4)
    assert list(first) == ["cav_0"]
    seen: dict[str, list[Any]] = {}
    while environment.agents:
        actions = dict.fromkeys(environment.agents, np.array([0.2]))
        observations, *_ = environment.step(actions)
        for agent in actions:
            seen.setdefault(agent, []).append(observations[agent])
    environment.close()
    assert list(seen) == ["cav_0", "cav_1", "cav_2"]
    driven = [float(10.0 * speeds[5][0]) for speeds in seen.values()]
    assert driven == pytest.approx([trajectory.states.speed[6] for trajectory in expected.trajectories], abs=1e-5)
    assert len(expected.cav_ids) == 3


MERGE: Any = {"horizon": 60, "penetration_rate": 0.3}


@pytest.mark.long
def test_the_merge_passes_the_checks_of_pettingzoo_without_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Each episode draws which of the possible agents are CAVs.
        warnings.filterwarnings("ignore", "No agents present but not all possible_agents are terminated")
        with closing(unjam.parallel_env("merge", **MERGE)) as environment:
            parallel_api_test(environment, num_cycles=100)
        warnings.filterwarnings("ignore", "another simulation is open")  # it compares two at a time
        parallel_seed_test(lambda: unjam.parallel_env("merge", **MERGE), num_cycles=10)


def test_agents_of_the_merge_enter_and_leave_as_in_the_very_episode_that_run_episode_runs() -> None:
    scenario = make_scenario("merge", {**MERGE, "horizon": 100, "standing_vehicles": 0})
    expected = run_episode(scenario, Constant(acceleration=0.2), (4,))
    stays = {each.vehicle: each for each in expected.trajectories}
    environment = unjam.parallel_env("merge", **{**MERGE, "horizon": 100, "standing_vehicles": 0})
    last, _ = environment.reset(seed=4)
    left, rewards_by_agent = [], {name: [] for name in stays}
    truncated: dict[str, bool] = {}
    while environment.agents:
        acting = environment.agents
        seen, rewards, terminated, truncated, _ = environment.step(dict.fromkeys(acting, np.array([0.2])))
        moment = environment._road.world.control_steps
        assert not any(terminated.values())
        assert set(seen) == set(rewards) == set(terminated) == set(truncated) >= set(acting)
        for name in acting:
            if name not in environment.agents and moment < 100:
                left.append(name)
                assert truncated[name]
                np.testing.assert_array_equal(seen[name], last[name])  # what it saw before it left
                assert stays[name].start_step + len(stays[name].applied_acceleration) == moment - 1
            else:
                rewards_by_agent[name].append(rewards[name])
        for name in set(environment.agents) - set(acting):
            assert stays[name].start_step == moment
            assert (rewards[name], truncated[name]) == (0.0, False)
        last = seen
    assert all(truncated.values())
    environment.close()
    assert len(left) > 3
    for name, trajectory in stays.items():
        np.testing.assert_allclose(rewards_by_agent[name], trajectory.reward, atol=1e-12)


def test_time_goes_on_by_itself_until_the_first_agent_enters_and_ends_with_the_last() -> None:
    environment = unjam.parallel_env("merge", cavs=2, standing_vehicles=0, horizon=300)
    environment.reset(seed=1)
    assert len(environment.agents) == 1
    assert environment._road.world.control_steps > 0
    gaps = 0
    while environment.agents:
        before = environment._road.world.control_steps
        environment.step(dict.fromkeys(environment.agents, np.array([0.5])))
        gaps += environment._road.world.control_steps > before + 1
    assert gaps <= 1
    assert environment._road.world.control_steps < 300
    assert environment.step({}) == ({}, {}, {}, {}, {})
    environment.close()


def test_a_collision_terminates_everybody_who_is_there() -> None:
    environment = unjam.parallel_env("merge", penetration_rate=1.0, actuation="raw", standing_vehicles=0)
    environment.reset(seed=0)
    terminated: dict[str, bool] = {}
    truncated: dict[str, bool] = {}
    while environment.agents:
        actions = dict.fromkeys(environment.agents, np.array([1.0]))
        _, _, terminated, truncated, _ = environment.step(actions)
    environment.close()
    assert len(terminated) > 3
    assert all(terminated.values())
    assert not any(truncated.values())


def test_an_agent_whose_action_lacks_or_who_is_unknown_is_named() -> None:
    environment = unjam.parallel_env("ring", **SHORT)
    environment.reset(seed=1)
    with pytest.raises(InputError, match="step: actions: 5 is not allowed; allowed: a dict with an action for each"):
        environment.step(5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="agent: 'cav_1' is not allowed; allowed: cav_0, cav_7, cav_15"):
        environment.action_space("cav_1")
    with pytest.raises(InputError, match=r"step: no action for cav_7, cav_15; allowed: one for each"):
        environment.step({"cav_0": np.array([0.0])})
    environment.close()


def test_a_vehicle_that_comes_back_is_no_agent_again() -> None:
    environment = unjam.parallel_env("ring", **SHORT)
    cav_ids_by_step = [["a", "b"], ["a"], ["a", "b"]]
    received_actions: list[list[float]] = []

    class Road:
        """A road whose second CAV leaves in the first control step and returns in the second."""

        lock, world = CopyableLock(), SimpleNamespace(cav_ids=cav_ids_by_step[0])

        def step(self, actions: list[float]) -> RoadStepResult:
            before, now = cav_ids_by_step[len(received_actions)], cav_ids_by_step[len(received_actions) + 1]
            received_actions.append(actions)
            left = {name: np.zeros(5, np.float32) for name in before if name not in now}
            self.world.cav_ids = now
            return RoadStepResult(now, np.zeros((len(now), 5), np.float32), left, 1.0, {}, False, False)

        def step_info(self, result: RoadStepResult, has_ended: bool) -> dict[str, Any]:
            return {}

    environment._road = Road()  # pyright: ignore[reportAttributeAccessIssue]
    environment.agents = environment._assign_agents(cav_ids_by_step[0])
    first, second = environment.agents
    cav_ids_by_step.append(["a", "b"])
    *_, truncated, _ = environment.step({first: [0.1], second: [0.2]})
    assert truncated == {first: False, second: True}
    environment.step({first: [0.3]})
    assert environment.agents == [first]
    environment.step({first: [0.4]})
    assert received_actions == [[0.1, 0.2], [0.3], [0.4, 0.0]]
