import numpy as np
import pytest
import torch

from tests.following.made_up import follower, idm_driver
from unjam.following.networks import (
    CalibratedPairs,
    FollowingNetwork,
    MultiStepSettings,
    NetworkSettings,
    batched_network,
    fit_multi_step,
    fit_one_step,
)
from unjam.following.open_loop import AccelerationBounds, add_residual, idm_function, simulate_open_loop
from unjam.following.pairs import FollowingSamples, following_samples, make_segments
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios.population import residual_inputs

SETTINGS = NetworkSettings(hidden=(16, 16), learning_rate=1e-2, epochs=40, batch_size=128)


@pytest.fixture(scope="module")
def rows() -> FollowingSamples:
    driver = IDMParameters(time_headway=1.5)
    return following_samples([idm_driver(driver, seed=seed) for seed in range(3)])


def test_the_papers_network_has_two_layers_of_128() -> None:
    settings = NetworkSettings()
    assert (settings.hidden, settings.learning_rate, settings.batch_size, settings.epochs) == (
        (128, 128),
        1e-4,
        1024,
        200,
    )


def test_its_numpy_twin_answers_the_same(rows: FollowingSamples) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1)
    seen = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    with torch.no_grad():
        wanted = network(torch.as_tensor(seen, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(batched_network(network.to_numpy_network())(seen), wanted, atol=1e-4)
    stacked = seen[:20].reshape(4, 5, 3)
    np.testing.assert_allclose(batched_network(network.to_numpy_network())(stacked).ravel(), wanted[:20], atol=1e-4)


def test_a_new_residual_may_be_zero(rows: FollowingSamples) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1, zero_init=True)
    assert not network(torch.ones(4, 3)).any()


@pytest.mark.parametrize("base", [None, idm_function(PAPER_IDM)])
def test_it_learns(rows: FollowingSamples, base: None) -> None:
    network, losses = fit_one_step(rows, rows, base, SETTINGS, seed=0)
    assert min(losses.validation) < 0.2 * losses.validation[0]
    seen = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    known = base(rows.speed, rows.leader_speed, rows.gap) if base else 0.0
    error = np.square(batched_network(network.to_numpy_network())(seen) + known - rows.acceleration).mean()
    assert error == pytest.approx(min(losses.validation), rel=1e-2)


def test_the_same_seed_gives_the_same_network(rows: FollowingSamples) -> None:
    short = NetworkSettings(hidden=(8,), epochs=2)
    one, other = (fit_one_step(rows, rows, None, short, seed=3)[1] for _ in range(2))
    assert one == other


def test_without_progress_it_ends(rows: FollowingSamples) -> None:
    settings = NetworkSettings(hidden=(4,), learning_rate=1e-12, epochs=50, patience=2)
    still = FollowingSamples(rows.speed, rows.leader_speed, rows.gap, np.zeros(len(rows)))
    _, losses = fit_one_step(still, rows, None, settings, seed=0)
    assert len(losses.training) < 50


LIMITS: AccelerationBounds = (-4.0, 2.0)
DRIVING = MultiStepSettings(
    hidden=(8,), segment_seconds=6.0, batch_size=16, gradient_steps=30, learning_rate=2e-2, validation_interval=10
)


def eager(speed: np.ndarray, leader_speed: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """The paper's IDM, but half a m/s2 keener."""
    return idm_function(PAPER_IDM)(speed, leader_speed, gap) + 0.5


def known(seeds: range) -> CalibratedPairs:
    pairs = [follower(eager, f"{seed}", 20.0, seed=seed) for seed in seeds]
    return CalibratedPairs(pairs, [PAPER_IDM] * len(pairs))


@pytest.mark.long
def test_a_residual_learns_what_the_base_lacks_when_it_drives() -> None:
    fitted = fit_multi_step(known(range(4)), known(range(4, 6)), LIMITS, DRIVING, seed=0)
    assert min(fitted.validation_errors) < 0.5 * fitted.validation_errors[0]
    others = known(range(6, 8))
    stretches = make_segments(others.pairs)
    base = others.model(stretches.pair_index, LIMITS)
    alone = simulate_open_loop(base, stretches)
    learned = simulate_open_loop(
        add_residual(base, batched_network(fitted.network.to_numpy_network()), LIMITS), stretches
    )
    assert (learned.gap_mse < alone.gap_mse).all()


def test_where_nothing_is_left_nothing_is_learned() -> None:
    pairs = [follower(idm_function(PAPER_IDM), f"{seed}", 12.0, seed=seed) for seed in range(3)]
    perfect = CalibratedPairs(pairs, [PAPER_IDM] * 3)
    settings = MultiStepSettings(
        hidden=(4,), segment_seconds=3.0, batch_size=4, gradient_steps=2, validation_interval=1
    )
    fitted = fit_multi_step(perfect, perfect, LIMITS, settings, seed=0)
    assert fitted.validation_errors[0] == pytest.approx(0.0, abs=1e-9)
    assert not fitted.network.to_numpy_network()(np.ones((2, 3))).any()


def test_the_same_seed_gives_the_same_fit() -> None:
    settings = MultiStepSettings(
        hidden=(4,), segment_seconds=3.0, batch_size=4, gradient_steps=2, validation_interval=1
    )
    one, other = (
        fit_multi_step(known(range(2)), known(range(2, 3)), LIMITS, settings, seed=1).validation_errors
        for _ in range(2)
    )
    assert one == other
