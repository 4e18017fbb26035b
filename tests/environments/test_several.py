import warnings
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import unjam
from unjam.drivers import Constant
from unjam.scenarios import make_scenario
from unjam.traffic.episode import run_episode

SHORT: Any = {"horizon": 40, "cavs": 3}


@pytest.mark.parametrize("scenario", ["ring", "figure-eight"])
def test_passes_the_checks_of_pettingzoo_without_warnings(
    scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = unjam.parallel_env(scenario, **SHORT)
        parallel_api_test(environment, num_cycles=100)
        environment.close()


def test_steps_the_very_episode_that_run_episode_runs() -> None:
    expected = run_episode(make_scenario("ring", SHORT), Constant(acceleration=0.2), (4,))
    environment = unjam.parallel_env("ring", **SHORT)
    environment.reset(seed=4)
    rewards = []
    while environment.agents:
        _, earned, *_ = environment.step({agent: np.array([0.2]) for agent in environment.agents})
        assert set(earned) == {"cav_0", "cav_7", "cav_15"}
        rewards.append(earned["cav_0"])
    environment.close()
    np.testing.assert_allclose(rewards, expected.trajectories[0].reward, atol=1e-12)


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


def test_passes_the_seed_test_of_pettingzoo() -> None:
    parallel_seed_test(lambda: unjam.parallel_env("ring", **SHORT), num_cycles=10)
