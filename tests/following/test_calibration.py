import numpy as np
import pytest

from tests.following.made_up import idm_driver
from unjam.following.calibration import CalibrationSettings, calibrate, gap_objective
from unjam.following.pairs import stretches_of
from unjam.physics.idm import IDMParameters

QUICK = CalibrationSettings(generations=40)
DRIVER = IDMParameters(time_headway=0.9, max_acceleration=1.4, comfortable_deceleration=2.0, minimum_gap=2.5)


def test_the_true_parameters_have_no_error() -> None:
    objective = gap_objective(stretches_of([idm_driver(DRIVER)]), (-4.0, 2.0), "trajectory")
    true = [30.0, 0.9, 1.4, 2.0, 2.5, 0.0]
    found = objective(np.array([true, [30.0, 1.4, 1.4, 2.0, 2.5, 0.0]]).T)
    assert found[0] < 1e-9
    assert found[1] > 1.0


def test_the_headway_of_a_driver_is_found() -> None:
    pairs = [idm_driver(DRIVER, seed=seed) for seed in range(3)]
    found = calibrate(pairs, QUICK)
    assert found.gap_error < 0.2
    assert found.parameters.time_headway == pytest.approx(0.9, abs=0.15)
    assert found.collided == 0
    assert found.seconds == pytest.approx(120.0)


def test_the_result_depends_on_the_seed_alone() -> None:
    pairs = [idm_driver(DRIVER, seconds=10.0)]
    settings = CalibrationSettings(generations=3)
    assert calibrate(pairs, settings) == calibrate(pairs, settings)


def test_a_parameter_at_the_end_of_what_is_searched_is_named() -> None:
    settings = CalibrationSettings(generations=20, time_headway=(1.5, 3.0))
    assert "time_headway" in calibrate([idm_driver(DRIVER)], settings).bounds
