import numpy as np
import pytest

from tests.conftest import state_of
from unjam.drivers import FollowerStopper, LocalState
from unjam.errors import InputError


def test_flows_reference_values() -> None:
    driver = FollowerStopper(desired_speed=7.5, time_constant=0)
    state = state_of([5, 7.5, 7.5, 8, 7], [7.5, 7.5, 8, 7, 5], [5, 10, 15, 20, 25])
    found, _ = driver.act(state, driver.initial_memory(5))
    np.testing.assert_allclose(found, [0, 0, 0, -5, 5], atol=1e-12)


@pytest.mark.parametrize(
    ("gap", "expected_speed"),
    [(4.0, 0.0), (4.5, 0.0), (4.875, 2.0), (5.25, 4.0), (5.625, 6.0), (6.0, 8.0), (50.0, 8.0)],
)
def test_commanded_speed_in_each_region_at_equal_speeds(gap: float, expected_speed: float) -> None:
    driver = FollowerStopper(desired_speed=8.0, time_constant=0)
    found, _ = driver.act(state_of([4.0], [4.0], [gap]), driver.initial_memory(1))
    assert found[0] * 0.1 + 4.0 == pytest.approx(expected_speed, abs=1e-12)


def test_borders_grow_with_the_square_of_the_closing_speed() -> None:
    driver = FollowerStopper(desired_speed=8.0, time_constant=0)
    closing = 3.0
    border = 4.5 + closing**2 / (2 * 1.5)
    for gap, is_stopped in ((border - 0.01, True), (border + 0.3, False)):
        found, _ = driver.act(state_of([5.0], [2.0], [gap]), driver.initial_memory(1))
        assert bool(found[0] * 0.1 + 5.0 < 1e-9) is is_stopped


def test_default_desired_speed_is_the_mean_speed_of_the_leader() -> None:
    driver, memory, speed = FollowerStopper(), None, 0.0
    memory = driver.initial_memory(1)
    for _ in range(200):
        acceleration, memory = driver.act(state_of([speed], [4.0], [30.0]), memory)
        speed = max(0.0, speed + min(1.0, float(acceleration[0])) * 0.1)
    assert speed == pytest.approx(4.0, abs=1e-6)


def test_history_of_the_warm_up_determines_the_desired_speed() -> None:
    driver = FollowerStopper(time_constant=0)
    history = np.full((1, 380), 3.0)
    memory = driver.recall(driver.initial_memory(1), LocalState(*([history] * 7)))
    found, _ = driver.act(state_of([0.0], [3.0], [50.0]), memory)
    assert found[0] == pytest.approx(30.0)


def test_borders_of_the_version_for_motorways_are_time_gaps() -> None:
    driver = FollowerStopper(desired_speed=30.0, boundary_time_gaps=(0.4, 0.6, 0.8))
    for gap, expected_speed in ((8.0, 0.0), (10.0, 10.0), (12.0, 20.0), (14.0, 25.0), (16.0, 30.0)):
        found, _ = driver.act(state_of([20.0], [20.0], [gap]), driver.initial_memory(1))
        assert found[0] * 0.1 + 20.0 == pytest.approx(expected_speed, abs=1e-9)
    with pytest.raises(InputError, match="boundary_time_gaps"):
        FollowerStopper(boundary_time_gaps=(0.8, 0.6, 0.4))
