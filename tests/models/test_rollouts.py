from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.conftest import random_network
from tests.models.toy_dynamics import RING, ToyDynamics, environment_data
from unjam.drivers import IDM, Constant, Driver, LocalState, PISaturation, ResidualDriver
from unjam.drivers.observation import FeatureName, observation_size
from unjam.drivers.safety import ActuatorState
from unjam.drivers.user_driver import FileDriver
from unjam.errors import UnjamError
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.rollouts import (
    AT_REST,
    CLIPPED_QUANTITIES,
    ModelDynamics,
    ModelTransition,
    RolloutBatch,
    draw_starts,
    prepare_starts,
    return_bound,
    roll_out,
    rollout_length,
)
from unjam.models.row_model import RowModel
from unjam.models.settings import ModelSettings

PARTS: tuple[FeatureName, ...] = ("local", "expert_acceleration", "expert_memory")


def residual_driver(expert: Driver, action_repeat: int = 1, limit: float = 1.0) -> ResidualDriver:
    network = replace(random_network(observation_size(PARTS, expert)), authority=min(1.0, 2.0 * limit))
    return ResidualDriver(expert, network, limit, PARTS, action_repeat)


@given(
    st.one_of(st.floats(0, 1e-2), st.floats(0, 50), st.sampled_from([0.01, 0.004, 2.0, 2.0000001])),
    st.integers(0, 600),
    st.floats(0.01, 10),
)
def test_rollout_length_is_equation_15(eps_m: float, k_max: int, kappa: float) -> None:
    found = rollout_length(eps_m, ModelSettings(k_max=k_max, kappa=kappa))
    expected = 0  # the largest number of steps with a total error of at most kappa
    while expected < k_max and (eps_m == 0.0 or kappa / eps_m >= expected + 1):
        expected += 1
    assert found == expected


@pytest.mark.parametrize(("eps_m", "expected"), [(0.01, 200), (0.04, 50), (0.0, 500), (2.5, 0), (inf, 0), (nan, 0)])
def test_rollout_length_at_known_errors(eps_m: float, expected: int) -> None:
    assert rollout_length(eps_m, ModelSettings(kappa=2.0, k_max=500)) == expected


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 500), st.floats(0.5, 0.999), st.floats(0, 10))
def test_return_bound_is_the_sum_of_its_three_terms(
    eps_pi: float, eps_m: float, k: int, gamma: float, largest: float
) -> None:
    power = 1.0
    for _ in range(k):
        power *= gamma
    horizon = sum(gamma**step for step in range(40_000)) if gamma < 0.99 else 1 / (1 - gamma)
    expected = (
        2 * largest * (gamma * power * eps_pi * horizon * horizon + power * eps_pi * horizon + k * eps_m * horizon)
    )
    assert return_bound(eps_pi, eps_m, k, gamma, largest) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def experts(my_drivers: Path) -> list[Driver]:
    return [
        PISaturation(window=1.5),
        FileDriver(my_drivers, "Keeper"),
        ResidualDriver(PISaturation(window=2.0), random_network(seed=5), 1.0, action_repeat=7),
    ]


def value(observations: np.ndarray) -> np.ndarray:
    """Return values of a linear function."""
    return 3.0 + observations @ np.linspace(-1, 1, observations.shape[-1])


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("action_repeat", [1, 4])
def test_rollouts_with_true_dynamics_equal_recordings(number: int, action_repeat: int, my_drivers: Path) -> None:
    """From any recorded state: the same observations, residuals, rewards, and value targets."""
    dynamics, gamma, control_steps = ToyDynamics(), 0.97, 41
    driver = residual_driver(experts(my_drivers)[number], action_repeat)
    data = environment_data(dynamics, driver, 3, 120, explore=False)
    start_indices = data.start_indices(min_control_steps=control_steps)
    found = roll_out(driver, dynamics, prepare_starts(data, start_indices, driver.expert, "cpu"), control_steps, None)
    action_count = control_steps // action_repeat
    assert found.rewards.shape == (len(start_indices), action_count)
    assert not found.terminated.any()
    replays = [replay(driver, data, index) for index in range(3)]
    for row, (index, at) in enumerate(start_indices):
        recording, replayed = data.recordings[index], replays[index]
        observations = replayed[0][at : at + action_count * action_repeat + 1 : action_repeat]
        np.testing.assert_allclose(found.observations[row].numpy(), observations, atol=2e-4)
        residuals = replayed[1][at : at + action_count * action_repeat : action_repeat]
        np.testing.assert_allclose(found.actions[row].numpy(), residuals, atol=2e-4)
        rewards = recording.reward[at : at + action_count * action_repeat].reshape(action_count, action_repeat).sum(1)
        np.testing.assert_allclose(found.rewards[row].numpy(), rewards, atol=1e-3)
        powers = gamma ** np.arange(action_count + 1)
        target = powers @ np.append(found.rewards[row], value(found.observations[row, -1:].numpy()))
        assert target == pytest.approx(powers @ np.append(rewards, value(observations[-1:])), abs=5e-3)


def replay(driver: ResidualDriver, data: EnvironmentData, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The observation of the network in every control step of a recording, and its residual."""
    recording = data.recordings[index]
    memory, observations, residuals = driver.initial_memory(1), [], []
    for step in range(len(recording.states.speed)):
        state = recording.states.select(slice(step, step + 1))
        observations.append(driver.observation(state, memory)[0])
        decision = driver.decide(state, memory)
        residuals.append(decision.residual[0])
        memory = decision.memory
    return np.array(observations), np.array(residuals)


def crash_course(limit: float = 1.0) -> tuple[ResidualDriver, EnvironmentData]:
    """A driver that does not brake, behind vehicles that do."""
    gentle = environment_data(ToyDynamics(), residual_driver(IDM(), 2), 4, 60)
    return residual_driver(Constant(1.0), 2, limit), gentle


def test_a_crash_ends_a_row_and_its_rewards() -> None:
    driver, data = crash_course()
    start_indices = data.start_indices()
    found = roll_out(driver, ToyDynamics(), prepare_starts(data, start_indices, driver.expert, "cpu"), 300, None)
    assert found.terminated.all()
    assert found.lengths.max() < 150
    for row in range(len(start_indices)):
        action_count = int(found.lengths[row])
        assert action_count > 0
        assert (found.rewards[row, action_count:] == 0.0).all()
        assert found.rewards[row, :action_count].abs().sum() > 0.0
    one = start_indices[:1]
    alone = roll_out(driver, ToyDynamics(), prepare_starts(data, one, driver.expert, "cpu"), 300, None)
    assert alone.control_steps in (2 * int(alone.lengths[0]), 2 * int(alone.lengths[0]) - 1)
    assert_close(alone.rewards[0], found.rewards[0])


class ClippingDynamics(ToyDynamics):
    """Report the first quantity as always clipped, the second never, the third in the first step."""

    steps = 0

    def step(
        self, state: LocalState, acceleration: Any, drawn_values: Any, actuators: ActuatorState = AT_REST
    ) -> ModelTransition:
        self.steps += 1
        always = torch.ones_like(acceleration)
        clipped = torch.stack([always, always * 0, always * (self.steps == 1)]) > 0
        return super().step(state, acceleration, drawn_values, actuators)._replace(clipped=clipped)


def test_clipped_share_counts_steps_before_the_crash() -> None:
    driver, data = crash_course()
    starts = prepare_starts(data, data.start_indices()[:50], driver.expert, "cpu")
    found = roll_out(driver, ClippingDynamics(), starts, 300, None)
    assert found.control_steps < 50 * 300
    assert found.clipped_share == pytest.approx(
        dict(zip(CLIPPED_QUANTITIES, [1.0, 0.0, 50 / found.control_steps], strict=True)), rel=1e-5
    )


@pytest.fixture(scope="module")
def noisy() -> tuple[ResidualDriver, EnvironmentData, RowModel]:
    driver = residual_driver(PISaturation(window=1.5), 5)
    data = environment_data(ToyDynamics(), driver, 3, 60)
    model = RowModel(ModelSettings(members=2, hidden=(8,)), 1, (1,))
    model.noise.normal_(0, 0.01, generator=torch_generator((4,), "cpu"))
    model.reward_range.copy_(torch.tensor([-1.0, 1.0]))
    return driver, data, model


def run(noisy: tuple[ResidualDriver, EnvironmentData, RowModel], seed: int) -> RolloutBatch:
    driver, data, model = noisy
    generator = torch_generator((seed,), "cpu")
    start_indices = draw_starts(data, 200, 1, (seed,))
    starts = prepare_starts(data, start_indices, driver.expert, "cpu")
    return roll_out(driver, ModelDynamics(model, RING, "", generator), starts, 23, generator)


def test_the_same_seed_gives_the_same_bits(noisy: tuple[ResidualDriver, EnvironmentData, RowModel]) -> None:
    one = run(noisy, 1)
    torch.rand(3)
    again, other = run(noisy, 1), run(noisy, 2)
    for name in ("observations", "actions", "rewards", "lengths", "terminated", "drawn_values"):
        assert torch.equal(getattr(one, name), getattr(again, name)), name
    assert not torch.equal(one.rewards, other.rewards)


def test_rollouts_have_whole_actions(noisy: tuple[ResidualDriver, EnvironmentData, RowModel]) -> None:
    found = run(noisy, 1)
    assert found.observations.shape == (200, 5, 8)
    assert found.actions.shape == found.rewards.shape == (200, 4)
    assert found.control_steps == 200 * 4 * 5
    assert found.drawn_values.shape == (200, 1)
    assert (found.drawn_values == 0.3).all()
    assert found.observations.dtype == torch.float32


def test_exploration_noise_has_the_standard_deviation_of_the_network(
    noisy: tuple[ResidualDriver, EnvironmentData, RowModel],
) -> None:
    driver = noisy[0]
    found = run(noisy, 1)
    mean = driver.network(found.observations[:, :-1].reshape(-1, 8)).view(200, 4)
    noise = (found.actions - mean) / driver.network.exploration_std
    assert noise.mean().item() == pytest.approx(0.0, abs=0.1)
    assert noise.std().item() == pytest.approx(1.0, abs=0.1)


def test_rollout_without_steps_has_only_the_start(noisy: tuple[ResidualDriver, EnvironmentData, RowModel]) -> None:
    driver, data, _ = noisy
    starts = prepare_starts(data, data.start_indices()[:7], driver.expert, "cpu")
    found = roll_out(driver, ToyDynamics(), starts, 4, None)
    assert found.observations.shape == (7, 1, 8)
    assert found.rewards.shape == found.actions.shape == (7, 0)
    assert (found.control_steps, found.lengths.tolist(), found.terminated.any().item()) == (0, [0] * 7, False)


def test_starts_are_actions_with_enough_steps_left() -> None:
    data = environment_data(ToyDynamics(), residual_driver(IDM(), 4), 3, 50)
    found = draw_starts(data, 500, 20, (1,))
    assert found.shape == (500, 2)
    assert set(found[:, 1].tolist()) == set(range(0, 31, 4))
    assert set(found[:, 0].tolist()) == {0, 1, 2}
    np.testing.assert_array_equal(found, draw_starts(data, 500, 20, (1,)))
    assert draw_starts(data, 500, 51, (1,)).shape == (0, 2)


def test_non_finite_values_raise_error() -> None:
    driver, data = residual_driver(IDM()), environment_data(ToyDynamics(), residual_driver(IDM()), 1, 10)
    starts = prepare_starts(data, data.start_indices(), driver.expert, "cpu")
    with pytest.raises(UnjamError, match="model rollout: rewards are not finite"):
        roll_out(driver, ToyDynamics(bonus=inf), starts, 3, None)


def test_action_limit_clips_expert_and_sum() -> None:
    driver, data = crash_course(limit=0.1)
    commands: list[torch.Tensor] = []

    class RecordingDynamics(ToyDynamics):
        def step(
            self, state: LocalState, acceleration: Any, drawn_values: Any, actuators: ActuatorState = AT_REST
        ) -> ModelTransition:
            commands.append(acceleration)
            return super().step(state, acceleration, drawn_values, actuators)

    strong = replace(driver, expert=IDM(), network=replace(random_network(6, seed=1, scale=1.0), authority=0.2))
    roll_out(strong, RecordingDynamics(), prepare_starts(data, data.start_indices(), IDM(), "cpu"), 20, None)
    assert torch.stack(commands).abs().max() == pytest.approx(0.1)
    assert torch.stack(commands).unique().numel() > 10


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_rollouts_on_gpu_equal_cpu(noisy: tuple[ResidualDriver, EnvironmentData, RowModel]) -> None:
    driver, data, model = noisy
    found = []
    for device in ("cpu", "cuda"):
        generator = torch_generator((1,), device)
        dynamics = ModelDynamics(model.to(device), RING, "", generator, add_noise=False)
        found.append(
            roll_out(driver, dynamics, prepare_starts(data, data.start_indices(), driver.expert, device), 20, None)
        )
    model.to("cpu")
    assert_close(found[1].rewards.cpu(), found[0].rewards, atol=1e-3, rtol=1e-3)
