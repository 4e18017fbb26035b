import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.physics.fuel import MID_SIZE_CAR, fuel_rate


def test_an_idle_engine_burns_a_liter_in_an_hour() -> None:
    assert fuel_rate(0.0, 0.0) * 3600.0 == pytest.approx(900.0)


def test_steady_driving_at_100_kilometers_per_hour_takes_some_six_liters() -> None:
    speed = 100.0 / 3.6
    assert 5.0 < fuel_rate(speed, 0.0) / speed * 100.0 < 6.5  # ml/m are liters per kilometer


def test_an_engine_that_brakes_burns_nothing() -> None:
    assert fuel_rate(20.0, -1.0) == 0.0


@given(st.floats(0.0, 40.0), st.floats(-6.0, 2.0), st.floats(0.0, 1.0))
def test_fuel_increases_with_acceleration(speed: float, acceleration: float, more: float) -> None:
    assert fuel_rate(speed, acceleration + more) >= fuel_rate(speed, acceleration) >= 0.0


def test_waves_cost_fuel_at_the_same_mean_speed() -> None:
    times = np.arange(0.0, 100.0, 0.1)
    speed, acceleration = 15.0 + 5.0 * np.sin(times * 0.2 * np.pi), np.pi * np.cos(times * 0.2 * np.pi)
    assert fuel_rate(speed, acceleration).mean() > 1.2 * fuel_rate(15.0, 0.0)
    assert MID_SIZE_CAR.mass == 1500.0
