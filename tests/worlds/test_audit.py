"""The audit equals values that are computed independently from positions and speeds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers.safety import FollowingState
from unjam.worlds import audit
from unjam.worlds.audit import Audit, BrakingLog, braking_statistics, following_statistics, is_recovering


def test_braking_is_counted_beyond_each_threshold_with_a_tolerance() -> None:
    found = braking_statistics([[1.0, -3.5, -3.6], [-4.5 - 1e-9, -4.6, -12.0]])
    assert (found.max_braking, found.exceedances, found.samples) == (12.0, (4, 2, 1), 6)
    assert braking_statistics([0.5, 1.0]).max_braking == 0.0
    assert braking_statistics([]).samples == 0


def column(*values: float) -> np.ndarray:
    return np.array(values, float)[:, None]


def test_time_gaps_count_above_1_m_s_and_time_to_collision_while_closing() -> None:
    found = following_statistics(column(0.5, 4.0, 8.0), column(0.5, 4.0, 4.0), column(0.1, 2.0, 12.0), 0.1)
    assert found.min_time_gap == pytest.approx(0.5)
    assert found.min_time_to_collision == pytest.approx(3.0)
    assert found.max_required_braking == pytest.approx(16.0 / 24.0)
    assert found.share_short_time_gap == pytest.approx(0.5)


def test_a_recovering_cav_counts_for_the_time_to_collision_and_not_for_time_gaps() -> None:
    speeds, ahead, gaps = column(10.0, 10.0), column(9.0, 10.0), column(5.0, 12.0)
    found = following_statistics(speeds, ahead, gaps, 0.1, in_recovery=column(1.0, 0.0))
    assert (found.min_time_gap, found.share_short_time_gap, found.min_time_to_collision) == (1.2, 0.0, 5.0)


OPENING, CLOSING = FollowingState(10.0, 10.5, 6.0), FollowingState(10.0, 9.5, 5.4)


@pytest.mark.parametrize(
    ("so_far", "lasts", "now", "expected"),
    [
        pytest.param(False, 0.0, CLOSING, True, id="another vehicle has just cut in"),
        pytest.param(True, 5.0, CLOSING, True, id="the first seconds"),
        pytest.param(True, 9.0, OPENING, True, id="the leader is faster"),
        pytest.param(True, 9.0, FollowingState(9.8, 9.8, 5.7), True, id="the time gap increases"),
        pytest.param(True, 9.0, CLOSING, False, id="the time gap decreases"),
        pytest.param(True, 9.0, FollowingState(10.0, 10.0, 5.7), False, id="the CAV has settled at a short time gap"),
        pytest.param(True, 9.0, FollowingState(10.0, 11.0, 10.0), False, id="one second is no longer short"),
        pytest.param(True, 9.0, FollowingState(0.9, 2.0, 0.5), False, id="at walking speed"),
        pytest.param(False, 9.0, OPENING, False, id="the recovery has ended before"),
        pytest.param(False, 2.0, OPENING, False, id="the gap was not short when the leader changed"),
    ],
)
def test_recovery_is_a_short_time_gap_that_opens_since_a_cut_in(
    so_far: bool, lasts: float, now: FollowingState, expected: bool
) -> None:
    before = FollowingState(10.0, 10.0, 5.7)
    assert is_recovering(so_far, lasts, before, now) is expected
    rows = [FollowingState(*(np.array([value]) for value in each)) for each in (before, now)]
    assert is_recovering(np.array([so_far]), np.array([lasts]), *rows).tolist() == [expected]


def test_jerk_is_the_change_of_acceleration_over_time() -> None:
    speeds = column(5.0, 5.1, 5.1, 5.0)
    assert following_statistics(speeds, speeds, speeds * 3.0, 0.1).max_jerk == pytest.approx(10.0)


def test_contact_is_a_time_to_collision_of_zero() -> None:
    assert following_statistics(column(5.0, 5.0), column(5.0, 6.0), column(1.0, -0.1), 0.1).min_time_to_collision == 0.0


def test_absent_vehicles_do_not_count() -> None:
    there = following_statistics(column(5.0, np.nan), column(4.0, np.nan), column(10.0, np.nan), 0.1)
    assert (there.min_time_gap, there.min_time_to_collision, there.max_jerk) == (2.0, 10.0, 0.0)
    empty = np.zeros((4, 0))
    assert following_statistics(empty, empty, empty, 0.1) == Audit().following


def test_an_override_near_a_crossing_counts_as_yielding() -> None:
    overridden, near = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    still = np.ones((4, 1))
    found = following_statistics(still, still, still, 0.1, overridden, near)
    assert (found.override_share, found.yield_share) == (0.25, 0.25)


@given(st.lists(st.lists(st.tuples(st.floats(-9, 3), st.integers(0, 2)), max_size=6), max_size=30))
def test_braking_counted_step_by_step_equals_that_of_all_steps_together(steps: list[list[tuple[float, int]]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(audit, "BRAKING_BLOCK_STEPS", 4)
        log = BrakingLog(0.5)
        for step in steps:
            log.add(np.array([change for change, _ in step]), np.array([kind for _, kind in step], np.uint8))
    for driver_kind in range(3):
        changes = [change for step in steps for change, kind in step if kind == driver_kind]
        assert log.statistics(driver_kind) == braking_statistics(np.array(changes) / 0.5)
