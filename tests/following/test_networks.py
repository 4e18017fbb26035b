import numpy as np
import pytest
import torch

from tests.recordings.synthetic_trajectories import follower, idm_driver
from unjam.following.leader_replay import AccelerationBounds, add_residual, idm_function, simulate_followers
from unjam.following.networks import (
    CalibratedTrajectories,
    FollowingNetwork,
    MultiStepSettings,
    OneStepSettings,
    batched_network,
    fit_multi_step,
    fit_one_step,
)
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.recordings.trajectories import FollowingSamples, following_samples, make_segments
from unjam.scenarios.population import residual_inputs

SETTINGS = OneStepSettings(hidden=(16, 16), learning_rate=1e-2, epochs=40, batch_size=128)


@pytest.fixture(scope="module")
def rows() -> FollowingSamples:
    driver = IDMParameters(time_headway=1.5)
    return following_samples([idm_driver(driver, seed=seed) for seed in range(3)])


def test_default_settings_are_those_of_the_paper() -> None:
    settings = OneStepSettings()
    assert (settings.hidden, settings.learning_rate, settings.batch_size, settings.epochs) == (
        (128, 128),
        1e-4,
        1024,
        200,
    )


def test_numpy_network_equals_the_torch_network(rows: FollowingSamples) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1)
    inputs = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    with torch.no_grad():
        expected = network(torch.as_tensor(inputs, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(batched_network(network.to_numpy_network())(inputs), expected, atol=1e-4)
    stacked = inputs[:20].reshape(4, 5, 3)
    np.testing.assert_allclose(batched_network(network.to_numpy_network())(stacked).ravel(), expected[:20], atol=1e-4)


def test_network_with_zero_init_is_zero(rows: FollowingSamples) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1, zero_init=True)
    assert not network(torch.ones(4, 3)).any()


@pytest.mark.parametrize("base", [None, idm_function(PAPER_IDM)])
def test_fit_reduces_the_validation_error(rows: FollowingSamples, base: None) -> None:
    network, losses = fit_one_step(rows, rows, base, SETTINGS, seed=0)
    assert min(losses.validation) < 0.2 * losses.validation[0]
    inputs = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    base_acceleration = base(rows.speed, rows.leader_speed, rows.gap) if base else 0.0
    error = np.square(
        batched_network(network.to_numpy_network())(inputs) + base_acceleration - rows.acceleration
    ).mean()
    assert error == pytest.approx(min(losses.validation), rel=1e-2)


def test_same_seed_gives_the_same_losses(rows: FollowingSamples) -> None:
    short = OneStepSettings(hidden=(8,), epochs=2)
    one, other = (fit_one_step(rows, rows, None, short, seed=3)[1] for _ in range(2))
    assert one == other


def test_fit_ends_without_improvement(rows: FollowingSamples) -> None:
    settings = OneStepSettings(hidden=(4,), learning_rate=1e-12, epochs=50, patience=2)
    at_rest = FollowingSamples(rows.speed, rows.leader_speed, rows.gap, np.zeros(len(rows)))
    _, losses = fit_one_step(at_rest, rows, None, settings, seed=0)
    assert len(losses.training) < 50


LIMITS: AccelerationBounds = (-4.0, 2.0)
MULTI_STEP = MultiStepSettings(
    hidden=(8,), segment_seconds=6.0, batch_size=16, gradient_steps=30, learning_rate=2e-2, validation_interval=10
)


def aggressive_idm(speed: np.ndarray, leader_speed: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return the acceleration of the paper's IDM plus 0.5 m/s2."""
    return idm_function(PAPER_IDM)(speed, leader_speed, gap) + 0.5


def calibrated_trajectories(seeds: range) -> CalibratedTrajectories:
    trajectories = [follower(aggressive_idm, f"{seed}", 20.0, seed=seed) for seed in seeds]
    return CalibratedTrajectories(trajectories, [PAPER_IDM] * len(trajectories))


@pytest.mark.slow
def test_multi_step_residual_reduces_the_gap_error() -> None:
    network, errors = fit_multi_step(
        calibrated_trajectories(range(4)), calibrated_trajectories(range(4, 6)), LIMITS, MULTI_STEP, seed=0
    )
    assert min(errors) < 0.5 * errors[0]
    unseen = calibrated_trajectories(range(6, 8))
    segments = make_segments(unseen.trajectories)
    base = unseen.make_driver_model(segments.trajectory_index, LIMITS)
    without_residual = simulate_followers(base, segments)
    with_residual = simulate_followers(
        add_residual(base, batched_network(network.to_numpy_network()), LIMITS), segments
    )
    assert (with_residual.gap_mse < without_residual.gap_mse).all()


def test_exact_base_keeps_a_zero_residual() -> None:
    trajectories = [follower(idm_function(PAPER_IDM), f"{seed}", 12.0, seed=seed) for seed in range(3)]
    exact = CalibratedTrajectories(trajectories, [PAPER_IDM] * 3)
    settings = MultiStepSettings(
        hidden=(4,), segment_seconds=3.0, batch_size=4, gradient_steps=2, validation_interval=1
    )
    network, errors = fit_multi_step(exact, exact, LIMITS, settings, seed=0)
    assert errors[0] == pytest.approx(0.0, abs=1e-9)
    assert not network.to_numpy_network()(np.ones((2, 3))).any()


def test_same_seed_gives_the_same_validation_errors() -> None:
    settings = MultiStepSettings(
        hidden=(4,), segment_seconds=3.0, batch_size=4, gradient_steps=2, validation_interval=1
    )
    one, other = (
        fit_multi_step(
            calibrated_trajectories(range(2)), calibrated_trajectories(range(2, 3)), LIMITS, settings, seed=1
        )[1]
        for _ in range(2)
    )
    assert one == other
