from typing import Literal

import numpy as np
import pytest

from tests.following.made_up import idm_driver
from unjam.following.calibration import CalibrationSettings, calibrate_groups, calibrate_idm, gap_objective
from unjam.following.pairs import Pair, make_segments
from unjam.physics.idm import PAPER_IDM, IDMParameters

QUICK = CalibrationSettings(generations=40)
DRIVER = IDMParameters(time_headway=0.9, max_acceleration=1.4, comfortable_deceleration=2.0, minimum_gap=2.5)


def test_the_true_parameters_have_no_error() -> None:
    objective = gap_objective(make_segments([idm_driver(DRIVER)]), (-4.0, 2.0), "trajectory")
    true = [30.0, 0.9, 1.4, 2.0, 2.5, 0.0]
    found = objective(np.array([true, [30.0, 1.4, 1.4, 2.0, 2.5, 0.0]]).T)
    assert found[0] < 1e-9
    assert found[1] > 1.0


def test_the_headway_of_a_driver_is_found() -> None:
    pairs = [idm_driver(DRIVER, seed=seed) for seed in range(3)]
    found = calibrate_idm(pairs, QUICK)
    assert found.gap_error < 0.2
    assert found.parameters.time_headway == pytest.approx(0.9, abs=0.15)
    assert found.collisions == 0
    assert found.seconds == pytest.approx(120.0)


def test_the_result_depends_on_the_seed_alone() -> None:
    pairs = [idm_driver(DRIVER, seconds=10.0)]
    settings = CalibrationSettings(generations=3)
    assert calibrate_idm(pairs, settings) == calibrate_idm(pairs, settings)


def test_a_parameter_at_the_end_of_what_is_searched_is_named() -> None:
    settings = CalibrationSettings(generations=20, time_headway=(1.5, 3.0))
    assert "time_headway" in calibrate_idm([idm_driver(DRIVER)], settings).parameters_at_bounds


HEADWAYS = (0.8, 1.6, 1.15)


def groups() -> list[list[Pair]]:
    """Drivers who differ in their headway alone; the second with two trajectories."""
    made = [[idm_driver(IDMParameters(time_headway=headway), f"{headway}")] for headway in HEADWAYS]
    made[1].append(idm_driver(IDMParameters(time_headway=HEADWAYS[1]), "1.6", seed=4, seconds=20.0))
    return made


@pytest.mark.parametrize("weighting", ["trajectory", "sample"])
def test_each_driver_gets_its_own_headway_and_what_is_typical(weighting: Literal["trajectory", "sample"]) -> None:
    told: list[int] = []
    settings = CalibrationSettings(weighting=weighting)
    found = calibrate_groups(groups(), PAPER_IDM, ("time_headway",), settings, told.append)
    assert [one.parameters.time_headway for one in found] == pytest.approx(HEADWAYS, abs=5e-3)
    assert all(one.parameters.minimum_gap == PAPER_IDM.minimum_gap for one in found)
    assert all(one.gap_error < 0.05 for one in found)
    assert [one.seconds for one in found] == pytest.approx([40.0, 60.0, 40.0])
    assert told == [3]


@pytest.mark.long
def test_who_drives_beside_whom_does_not_matter() -> None:
    together = calibrate_groups(groups(), PAPER_IDM, ("time_headway",))
    alone = [calibrate_groups([group], PAPER_IDM, ("time_headway",))[0] for group in groups()]
    for one, other in zip(together, alone, strict=True):
        assert one.parameters.time_headway == pytest.approx(other.parameters.time_headway, abs=2e-3)


def test_several_own_parameters_are_searched_for_one_driver_after_the_other() -> None:
    told: list[int] = []
    settings = CalibrationSettings(generations=5)
    found = calibrate_groups(groups()[:2], PAPER_IDM, ("time_headway", "minimum_gap"), settings, told.append)
    assert all(one.parameters.max_acceleration == PAPER_IDM.max_acceleration for one in found)
    assert found[0].parameters.time_headway < found[1].parameters.time_headway
    assert told == [1, 2]


def test_a_headway_beyond_what_is_searched_is_named() -> None:
    settings = CalibrationSettings(time_headway=(1.0, 3.0))
    (found,) = calibrate_groups(groups()[:1], PAPER_IDM, ("time_headway",), settings)
    assert (found.parameters.time_headway, found.parameters_at_bounds) == (1.0, ("time_headway",))


@pytest.mark.parametrize("weighting", ["trajectory", "sample"])
def test_a_short_rest_of_a_long_trajectory_weighs_little(weighting: Literal["trajectory", "sample"]) -> None:
    whole = idm_driver(DRIVER, seconds=20.0)
    wrong = np.array([[30.0, 1.4, 1.4, 2.0, 2.5, 0.0]]).T
    cut = [make_segments([whole], seconds) for seconds in (20.0, 19.8)]
    errors = [gap_objective(each, (-4.0, 2.0), weighting)(wrong)[0] for each in cut]
    assert errors[1] == pytest.approx(errors[0], rel=0.02)
