import numpy as np
import pytest

from tests.following.made_up import follower
from unjam.following.multi_step import Known, MultiStepSettings, fit_multi_step
from unjam.following.network import on_rows
from unjam.following.open_loop import Limits, idm_follow, open_loop, with_residual
from unjam.following.pairs import stretches_of
from unjam.physics.idm import PAPER_IDM

LIMITS: Limits = (-4.0, 2.0)
SETTINGS = MultiStepSettings(hidden=(8,), seconds=6.0, batch=16, steps=30, rate=2e-2, validate_every=10)


def eager(speed: np.ndarray, leader_speed: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """The paper's IDM, but half a m/s2 keener."""
    return idm_follow(PAPER_IDM)(speed, leader_speed, gap) + 0.5


def known(seeds: range) -> Known:
    pairs = [follower(eager, f"{seed}", 20.0, seed=seed) for seed in seeds]
    return Known(pairs, [PAPER_IDM] * len(pairs))


def test_a_residual_learns_what_the_base_lacks_when_it_drives() -> None:
    fitted = fit_multi_step(known(range(4)), known(range(4, 6)), LIMITS, SETTINGS, seed=0)
    assert min(fitted.validation) < 0.5 * fitted.validation[0]
    others = known(range(6, 8))
    stretches = stretches_of(others.pairs)
    base = others.model(stretches.owner, LIMITS)
    alone = open_loop(base, stretches)
    learned = open_loop(with_residual(base, on_rows(fitted.network.as_driver()), LIMITS), stretches)
    assert (learned.gap_square < alone.gap_square).all()


def test_where_nothing_is_left_nothing_is_learned() -> None:
    pairs = [follower(idm_follow(PAPER_IDM), f"{seed}", 12.0, seed=seed) for seed in range(3)]
    perfect = Known(pairs, [PAPER_IDM] * 3)
    settings = MultiStepSettings(hidden=(4,), seconds=3.0, batch=4, steps=2, validate_every=1)
    fitted = fit_multi_step(perfect, perfect, LIMITS, settings, seed=0)
    assert fitted.validation[0] == pytest.approx(0.0, abs=1e-9)
    assert not fitted.network.as_driver()(np.ones((2, 3))).any()


def test_the_same_seed_gives_the_same_fit() -> None:
    settings = MultiStepSettings(hidden=(4,), seconds=3.0, batch=4, steps=2, validate_every=1)
    one, other = (
        fit_multi_step(known(range(2)), known(range(2, 3)), LIMITS, settings, seed=1).validation
        for _ in range(2)
    )
    assert one == other
