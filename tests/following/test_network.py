import numpy as np
import pytest
import torch

from tests.following.made_up import idm_driver
from unjam.following.network import FollowingNetwork, NetworkSettings, fit_one_step, on_rows
from unjam.following.open_loop import idm_follow
from unjam.following.pairs import Rows, rows_of
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios.population import residual_inputs

SETTINGS = NetworkSettings(hidden=(16, 16), rate=1e-2, epochs=40, batch=128)


@pytest.fixture(scope="module")
def rows() -> Rows:
    driver = IDMParameters(time_headway=1.5)
    return rows_of([idm_driver(driver, seed=seed) for seed in range(3)])


def test_the_papers_network_has_two_layers_of_128() -> None:
    settings = NetworkSettings()
    assert (settings.hidden, settings.rate, settings.batch, settings.epochs) == ((128, 128), 1e-4, 1024, 200)


def test_its_numpy_twin_answers_the_same(rows: Rows) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1)
    seen = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    with torch.no_grad():
        wanted = network(torch.as_tensor(seen, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(on_rows(network.as_driver())(seen), wanted, atol=1e-4)
    stacked = seen[:20].reshape(4, 5, 3)
    np.testing.assert_allclose(on_rows(network.as_driver())(stacked).ravel(), wanted[:20], atol=1e-4)


def test_a_new_residual_may_be_zero(rows: Rows) -> None:
    network = FollowingNetwork(SETTINGS, rows, seed=1, zero=True)
    assert not network(torch.ones(4, 3)).any()


@pytest.mark.parametrize("base", [None, idm_follow(PAPER_IDM)])
def test_it_learns(rows: Rows, base: None) -> None:
    network, losses = fit_one_step(rows, rows, base, SETTINGS, seed=0)
    assert min(losses.validation) < 0.2 * losses.validation[0]
    seen = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    known = base(rows.speed, rows.leader_speed, rows.gap) if base else 0.0
    error = np.square(on_rows(network.as_driver())(seen) + known - rows.acceleration).mean()
    assert error == pytest.approx(min(losses.validation), rel=1e-2)


def test_the_same_seed_gives_the_same_network(rows: Rows) -> None:
    short = NetworkSettings(hidden=(8,), epochs=2)
    one, other = (fit_one_step(rows, rows, None, short, seed=3)[1] for _ in range(2))
    assert one == other


def test_without_progress_it_ends(rows: Rows) -> None:
    settings = NetworkSettings(hidden=(4,), rate=1e-12, epochs=50, patience=2)
    still = Rows(rows.speed, rows.leader_speed, rows.gap, np.zeros(len(rows)))
    _, losses = fit_one_step(still, rows, None, settings, seed=0)
    assert len(losses.training) < 50
