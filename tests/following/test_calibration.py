from typing import Literal

import numpy as np
import pytest

from tests.recordings.synthetic_trajectories import idm_driver
from unjam.following.calibration import CalibrationSettings, calibrate_groups, calibrate_idm, gap_objective
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.recordings.trajectories import FollowingTrajectory, make_segments

QUICK = CalibrationSettings(generations=40)
DRIVER = IDMParameters(time_headway=0.9, max_acceleration=1.4, comfortable_deceleration=2.0, minimum_gap=2.5)


def test_true_parameters_have_no_error() -> None:
    objective = gap_objective(make_segments([idm_driver(DRIVER)]), (-4.0, 2.0), "trajectory")
    true = [30.0, 0.9, 1.4, 2.0, 2.5, 0.0]
    result = objective(np.array([true, [30.0, 1.4, 1.4, 2.0, 2.5, 0.0]]).T)
    assert result[0] < 1e-9
    assert result[1] > 1.0


def test_calibration_finds_the_time_headway() -> None:
    trajectories = [idm_driver(DRIVER, seed=seed) for seed in range(3)]
    result = calibrate_idm(trajectories, QUICK)
    assert result.gap_error < 0.2
    assert result.parameters.time_headway == pytest.approx(0.9, abs=0.15)
    assert result.collisions == 0
    assert result.seconds == pytest.approx(120.0)


def test_same_seed_gives_the_same_result() -> None:
    trajectories = [idm_driver(DRIVER, seconds=10.0)]
    settings = CalibrationSettings(generations=3)
    assert calibrate_idm(trajectories, settings) == calibrate_idm(trajectories, settings)


def test_parameter_at_a_bound_is_named() -> None:
    settings = CalibrationSettings(generations=20, time_headway=(1.5, 3.0))
    assert "time_headway" in calibrate_idm([idm_driver(DRIVER)], settings).parameters_at_bounds


HEADWAYS = (0.8, 1.6, 1.15)


def groups() -> list[list[FollowingTrajectory]]:
    """Return drivers that differ in their time headway alone; the second has two trajectories."""
    drivers = [[idm_driver(IDMParameters(time_headway=headway), f"{headway}")] for headway in HEADWAYS]
    drivers[1].append(idm_driver(IDMParameters(time_headway=HEADWAYS[1]), "1.6", seed=4, seconds=20.0))
    return drivers


@pytest.mark.parametrize("weighting", ["trajectory", "sample"])
def test_each_driver_gets_its_own_headway_and_the_typical_other_parameters(
    weighting: Literal["trajectory", "sample"],
) -> None:
    progress: list[int] = []
    settings = CalibrationSettings(weighting=weighting)
    result = calibrate_groups(groups(), PAPER_IDM, ("time_headway",), settings, progress.append)
    assert [one.parameters.time_headway for one in result] == pytest.approx(HEADWAYS, abs=5e-3)
    assert all(one.parameters.minimum_gap == PAPER_IDM.minimum_gap for one in result)
    assert all(one.gap_error < 0.05 for one in result)
    assert [one.seconds for one in result] == pytest.approx([40.0, 60.0, 40.0])
    assert progress == [3]


@pytest.mark.slow
def test_groups_do_not_influence_each_other() -> None:
    joint = calibrate_groups(groups(), PAPER_IDM, ("time_headway",))
    separate = [calibrate_groups([group], PAPER_IDM, ("time_headway",))[0] for group in groups()]
    for one, other in zip(joint, separate, strict=True):
        assert one.parameters.time_headway == pytest.approx(other.parameters.time_headway, abs=2e-3)


def test_several_individual_parameters_are_calibrated_driver_by_driver() -> None:
    progress: list[int] = []
    settings = CalibrationSettings(generations=5)
    result = calibrate_groups(groups()[:2], PAPER_IDM, ("time_headway", "minimum_gap"), settings, progress.append)
    assert all(one.parameters.max_acceleration == PAPER_IDM.max_acceleration for one in result)
    assert result[0].parameters.time_headway < result[1].parameters.time_headway
    assert progress == [1, 2]


def test_headway_beyond_the_bounds_is_named() -> None:
    settings = CalibrationSettings(time_headway=(1.0, 3.0))
    (result,) = calibrate_groups(groups()[:1], PAPER_IDM, ("time_headway",), settings)
    assert (result.parameters.time_headway, result.parameters_at_bounds) == (1.0, ("time_headway",))


@pytest.mark.parametrize("weighting", ["trajectory", "sample"])
def test_short_last_segment_of_a_trajectory_has_little_weight(weighting: Literal["trajectory", "sample"]) -> None:
    whole = idm_driver(DRIVER, seconds=20.0)
    candidates = np.array([[30.0, 1.4, 1.4, 2.0, 2.5, 0.0]]).T
    segments = [make_segments([whole], seconds) for seconds in (20.0, 19.8)]
    errors = [gap_objective(segment, (-4.0, 2.0), weighting)(candidates)[0] for segment in segments]
    assert errors[1] == pytest.approx(errors[0], rel=0.02)
