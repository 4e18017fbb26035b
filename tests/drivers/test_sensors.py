"""Sensor errors stay within their bounds, readings are missing at the stated rate, and nothing else changes."""

from typing import Any

import numpy as np
import pytest

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.drivers.sensors import SensorReadings, Sensors
from unjam.errors import InputError
from unjam.parameters import build_dataclass
from unjam.scenarios import Ring

SEED = np.random.SeedSequence(0)
ROWS = 2000
NAMES = [f"cav_{number}" for number in range(ROWS)]


def traffic(moment: int = 0) -> LocalState:
    rows = np.full(ROWS, 10.0 + moment)
    return LocalState(rows, rows, 2.0 * rows, rows, 3.0 * rows, rows, rows)


def test_each_reading_is_off_by_at_most_the_bounds_on_both_sides() -> None:
    readings = SensorReadings(Sensors(gap_error=1.0, speed_error=0.5), 6.0, 0.1, SEED)
    true, seen = traffic(), readings.read_for_driver(NAMES, traffic())
    for name, largest in (("leader_gap", 1.0), ("follower_gap", 1.0), ("leader_speed", 0.5), ("follower_speed", 0.5)):
        off = getattr(seen, name) - getattr(true, name)
        assert largest >= off.max() > 0.9 * largest
        assert -largest <= off.min() < -0.9 * largest
    np.testing.assert_array_equal(seen.speed, true.speed)


def test_what_is_missing_is_to_a_driver_what_it_read_last() -> None:
    readings = SensorReadings(Sensors(dropout=0.3), 6.0, 0.1, SEED)
    first = readings.read_for_driver(NAMES, traffic(0)).leader_gap
    second = readings.read_for_driver(NAMES, traffic(1)).leader_gap
    np.testing.assert_array_equal(first, 20.0)  # before the first reading none can be missed
    assert set(second) == {20.0, 22.0}
    assert (second == 20.0).mean() == pytest.approx(0.3, abs=0.04)


def test_what_is_missing_is_to_a_filter_a_leader_who_brakes_as_hard_as_anybody_can() -> None:
    readings = SensorReadings(Sensors(dropout=0.5), 6.0, 0.1, SEED)
    rows = np.full(ROWS, 10.0)
    readings.read_for_filter("all", FollowingState(rows, rows, rows))
    _, leader, gap = readings.read_for_filter("all", FollowingState(rows, rows, rows))
    missed = leader < 10.0
    assert missed.mean() == pytest.approx(0.5, abs=0.04)
    np.testing.assert_allclose(leader[missed], 9.4)
    np.testing.assert_allclose(gap[missed], 10.0 + 0.1 * (9.4 - 10.0))
    np.testing.assert_array_equal(gap[~missed], 10.0)


def test_one_car_in_plain_numbers_stays_in_plain_numbers() -> None:
    readings = SensorReadings(Sensors(0.5, 0.5, 0.2), 6.0, 0.1, SEED)
    state = readings.read_for_driver(["cav"], LocalState(4.0, 4.0, 9.0, 4.0, 9.0, 1.0, 230.0))
    ahead = readings.read_for_filter("cav", FollowingState(4.0, 4.0, 9.0))
    assert {type(value) for value in (*state[:5], *ahead)} == {float}


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"sensors": {"gap_error": 0.5}}, "safety.gap_error: 0 is not allowed; allowed: >= sensors.gap_error"),
        ({"sensors": {"dropout": 1.0}}, "sensors.dropout: 1.0 is not allowed; allowed: less than 1"),
    ],
)
def test_sensors_for_which_the_filter_does_not_allow_are_refused(values: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as refused:
        build_dataclass(Ring, values, "")
    assert line in str(refused.value)


def test_a_filter_that_is_off_allows_for_nothing() -> None:
    ring = build_dataclass(Ring, {"sensors": {"gap_error": 0.5}, "safety": {"active": False}}, "")
    assert not ring.sensors.is_exact
