import math

import numpy as np
import pytest

from unjam.drivers import PISaturation
from unjam.models.ensemble import OneStepRMSE, total_variation, transition_variation
from unjam.models.environment_data import EnvironmentData, Transitions
from unjam.models.row_model import (
    TARGET_NAMES,
    OneStepErrors,
    RowModel,
    base_step,
    fit_row_model,
    recorded_noise,
    unexplained_variance,
)
from unjam.models.settings import ModelSettings
from unjam.scenarios import FigureEight, Ring, Scenario
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask


def test_one_step_errors_are_root_mean_squares() -> None:
    errors, predicted = np.array([3.0, -4.0]), np.array([[3.0, -4.0], [3.0, -2.0]])
    columns = (np.repeat(each[..., None], 6, -1) for each in (errors, predicted, np.array([1.0, 3.0])))
    found = OneStepErrors(*columns).rmse_by_target()
    assert found == dict.fromkeys(TARGET_NAMES, OneStepRMSE(math.sqrt(12.5), 1.0, 1.0))


def test_unexplained_variance_is_the_mean_ratio_of_error_to_variance() -> None:
    steps = [OneStepRMSE(9.0, 0.1, 1.0), OneStepRMSE(9.0, 0.5, 1.0), OneStepRMSE(0.0, 0.0, 0.0)]
    assert unexplained_variance(steps) == pytest.approx((0.01 + 0.25 + 0.0) / 3)


def overlap(distance: float) -> float:
    """Half the integral of |difference| of two unit Gaussians in one dimension."""
    x = np.linspace(-12, 12 + distance, 200_001)
    difference = np.abs(np.exp(-(x**2) / 2) - np.exp(-((x - distance) ** 2) / 2)) / math.sqrt(2 * math.pi)
    return float(np.trapezoid(difference, x) / 2)


@pytest.mark.parametrize("distance", [0.1, 1.0, 3.0])
def test_total_variation_equals_that_of_two_gaussians(distance: float) -> None:
    members = np.array([0.0, math.sqrt(2.0)]) * distance * 0.5  # sample standard deviation: distance / 2
    predicted = members[:, None, None] + np.zeros((2, 4, 1))
    assert total_variation(predicted, np.array([0.5])) == pytest.approx(overlap(distance), abs=1e-6)


def test_error_of_a_tenth_of_the_noise_gives_rollouts_of_50_steps() -> None:
    predicted = np.array([0.0, math.sqrt(2.0)])[:, None, None] * 0.01 + np.zeros((2, 4, 1))
    assert 2.0 / total_variation(predicted, np.array([0.1])) == pytest.approx(50, abs=0.5)


def test_total_variation_adds_quantities_and_ignores_agreement() -> None:
    spread = np.array([0.0, math.sqrt(2.0)])[:, None, None]
    two = np.concatenate([spread * 0.3, spread * 0.4, spread * 0.0], 2) + np.zeros((2, 4, 1))
    one = spread * 0.5 + np.zeros((2, 4, 1))
    assert total_variation(two, np.array([1.0, 1.0, 0.0])) == pytest.approx(total_variation(one, np.array([1.0])))


def test_total_variation_of_a_single_member_is_nan() -> None:
    assert math.isnan(total_variation(np.zeros((1, 4, 2)), np.ones(2)))


@pytest.mark.parametrize("distance", [0.1, 1.0, 3.0])
def test_transition_variation_equals_that_of_two_gaussians(distance: float) -> None:
    wrong = np.full((3, 4, 2), distance * 0.5 / math.sqrt(2.0))
    assert transition_variation(wrong, 0.5) == pytest.approx(overlap(distance), abs=1e-6)


def transitions_of(scenario: Scenario, episodes: list[Episode]) -> Transitions:
    data = EnvironmentData(100_000)
    data.add(episodes, scenario)
    return data.transitions(0.2)


def test_recorded_noise_follows_from_the_driven_distance() -> None:
    ring = Ring(vehicles=6, length=(120, 120), horizon=400, noise=0.3)
    episodes = run_batch([EpisodeTask(ring, PISaturation(), (seed,)) for seed in range(6)])
    transitions = transitions_of(ring, episodes)
    noise = recorded_noise(transitions, ring)
    assert noise is not None
    is_moving = np.minimum(transitions.next_states.leader_speed, transitions.next_states.follower_speed) > 0.5
    sigma = ring.noise_per_step * ring.simulation_step
    np.testing.assert_allclose(noise[is_moving].std(0), sigma, rtol=0.06)
    # The follower's own leader is the CAV, so that the IDM gives the intended speed.
    intended = base_step("idm", ring, transitions.states, transitions.acceleration).follower_speed
    np.testing.assert_allclose(
        (intended + noise[:, 1])[is_moving], transitions.next_states.follower_speed[is_moving], atol=1e-9
    )


def test_variance_of_unknown_noise_is_subtracted_from_the_error() -> None:
    eight = FigureEight(horizon=300)
    transitions = transitions_of(eight, [run_episode(eight, PISaturation(), (seed,)) for seed in range(4)])
    assert recorded_noise(transitions, eight) is None
    settings = ModelSettings(members=1, epochs=1)
    model = RowModel(settings, transitions.drawn_values.shape[1], (0,))
    errors = fit_row_model(model, transitions, settings, eight, "", (1,)).errors
    assert 0.0 < errors["transitions"] <= 1.0
