import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.physics.kinematics import distance_driven, gap_on_loop, next_position, next_speed


@given(st.floats(0, 40), st.floats(-20, 20), st.floats(0.01, 1))
def test_speed_changes_by_acceleration_and_is_never_negative(speed: float, acceleration: float, step: float) -> None:
    found = next_speed(speed, acceleration, step)
    assert found >= 0
    assert found == pytest.approx(max(0.0, speed + acceleration * step), abs=1e-12)


def test_position_moves_with_the_new_speed() -> None:
    assert next_position(10.0, 3.0, 0.1) == pytest.approx(10.3)


@given(st.floats(10, 30), st.floats(-2, 2), st.integers(1, 6))
def test_distance_equals_the_sum_of_single_steps(speed: float, acceleration: float, steps: int) -> None:
    position, new_speed = 0.0, speed
    for _ in range(steps):
        new_speed = next_speed(new_speed, acceleration, 0.2)
        position = next_position(position, new_speed, 0.2)
    assert distance_driven(speed, new_speed, 0.2, steps) == pytest.approx(position, abs=1e-9)


@given(st.floats(0, 1000), st.floats(5, 225))
def test_gap_on_a_loop_does_not_depend_on_the_start_of_the_loop(position: float, ahead: float) -> None:
    assert gap_on_loop(position, position + ahead, 230.0, 5.0) == pytest.approx(ahead - 5.0, abs=1e-9)
    wrapped = (position + ahead) % 230.0
    assert gap_on_loop(position % 230.0, wrapped, 230.0, 5.0) == pytest.approx(ahead - 5.0, abs=1e-9)


def test_nan_stays_nan() -> None:
    assert np.isnan(next_speed(np.array([np.nan]), 0.0, 0.1)).all()
    assert np.isnan(next_speed(float("nan"), 0.0, 0.1))
