from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import TRPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import unjam
from unjam.adapters import PolicyOutput, policy_driver
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.pi_saturation import PISaturation
from unjam.errors import InputError

SHORT: Any = {"horizon": 40, "cavs": 1}
WITH_EXPERT = ("local", "expert_acceleration", "expert_memory")


class Space(gymnasium.Env):
    """An environment that only has spaces."""

    def __init__(self, inputs: Any = 5, action: Any = 1) -> None:
        box = spaces.Box(-50.0, 50.0, (inputs,), np.float32) if isinstance(inputs, int) else inputs
        self.observation_space = box
        self.action_space = spaces.Box(-1.0, 1.0, (action,), np.float32) if isinstance(action, int) else action

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 0.0, False, False, {}


def small(algorithm: Any, environment: Any) -> Any:
    return algorithm("MlpPolicy", environment, policy_kwargs={"net_arch": [16, 16]}, seed=3, device="cpu")


def returns_in_environment(model: Any, **arguments: Any) -> tuple[list[float], list[float]]:
    environment: Any = gymnasium.make("unjam/Ring-v0", **SHORT, **arguments)
    observation, _ = environment.reset(seed=7)
    rewards, speeds = [], []
    done = False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, _ = environment.step(action)
        done = terminated or truncated
        rewards.append(reward)
        speeds.append(10.0 * float(observation[0]))
    environment.close()
    return rewards, speeds


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3, TRPO])
def test_a_model_drives_as_in_its_environment(algorithm: Any) -> None:
    model = small(algorithm, Space())
    driver = policy_driver(model)
    unjam.check_driver(driver)
    assert driver.describe() == algorithm.__name__
    rewards, speeds = returns_in_environment(model)
    episode = unjam.run_episode(unjam.make_scenario("ring", SHORT), driver, 7)
    np.testing.assert_allclose(episode.reward, rewards, atol=1e-9)
    np.testing.assert_allclose(episode.trajectories[0].states.speed[1:], speeds, atol=1e-6)
    assert np.abs(episode.trajectories[0].applied_acceleration).max() > 0


def test_actions_are_added_to_an_expert() -> None:
    model = small(PPO, Space(8))
    driver = policy_driver(model, WITH_EXPERT, PISaturation())
    unjam.check_driver(driver)
    rewards, _ = returns_in_environment(model, expert="pi", features=WITH_EXPERT)
    episode = unjam.run_episode(unjam.make_scenario("ring", SHORT), driver, 7)
    np.testing.assert_allclose(episode.reward, rewards, atol=1e-9)
    assert driver.describe() == "pi + PPO"


def test_a_driver_of_several_cavs_is_measured_beside_drivers_with_names() -> None:
    driver = policy_driver(small(SAC, Space()))
    found = unjam.drive("ring", [driver, "pi"], episodes=1, scenario_options={"horizon": 40, "cavs": 3}, workers=1)
    assert list(found.rows) == ["pi", "SAC"]
    assert found.rows["SAC"][0]["status"] == "completed"


def test_features_are_functions_and_actions_have_a_scale() -> None:
    def gap(state: LocalState) -> Any:
        return state.leader_gap / 20.0

    model = small(TD3, Space(1))
    driver, half = (policy_driver(model, (gap,), output=PolicyOutput(scale=scale)) for scale in (1.0, 0.5))
    state = LocalState(*(np.full(2, 7.0) for _ in range(7)))
    expected = model.predict(np.full((2, 1), 0.35, np.float32), deterministic=True)[0][:, 0]
    np.testing.assert_allclose(driver.act(state, driver.initial_memory(2))[0], expected, atol=1e-6)
    np.testing.assert_allclose(half.act(state, half.initial_memory(2))[0], 0.5 * expected, atol=1e-6)


def test_observations_are_normalized_as_in_training() -> None:
    environment = VecNormalize(DummyVecEnv([Space]))
    environment.obs_rms.mean, environment.obs_rms.var = np.full(5, 0.7), np.full(5, 4.0)  # pyright: ignore
    model = small(PPO, environment)
    state = LocalState(*(np.full(1, 7.0) for _ in range(7)))
    driver: Driver = policy_driver(model)
    raw = np.array([[0.7, 0.0, 0.35, 0.0, 0.35]], np.float32)
    expected, _ = model.predict(environment.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(driver.act(state, driver.initial_memory(1))[0], expected[:, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("environment", "algorithm", "words"),
    [
        (Space(action=spaces.Discrete(3)), DQN, r"DQN: action space: .* is not allowed; allowed: Box of shape \(1,\)"),
        (Space(action=2), PPO, r"PPO: action space: .* is not allowed; allowed: Box of shape \(1,\)"),
        (Space(spaces.Discrete(4)), PPO, r"PPO: observation space: .*; allowed: Box of shape \(n,\)"),
        (Space(6), PPO, "inputs: 5 numbers are not allowed; allowed: 6, the inputs of PPO"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(environment: Any, algorithm: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        policy_driver(small(algorithm, environment))


def test_recurrent_and_exploring_policies_are_refused() -> None:
    with pytest.raises(InputError, match="RecurrentPPO: a recurrent policy is not allowed"):
        policy_driver(RecurrentPPO("MlpLstmPolicy", Space(), seed=0, device="cpu"))
    driver = policy_driver(small(PPO, Space()))
    with pytest.raises(InputError, match="explore: "):
        unjam.run_episode(unjam.make_scenario("ring", SHORT), driver, 0, explore=1.0)
