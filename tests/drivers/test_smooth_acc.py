import numpy as np
import pytest

from tests.conftest import state_of
from unjam.controller import string_stability
from unjam.controller.string_stability import GAIN_TOLERANCE, measure_string_stability
from unjam.drivers import LocalState, SmoothACC
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.wrappers import FilteredDriver
from unjam.physics.idm import PAPER_IDM


def test_drives_at_the_leaders_mean_speed_with_its_time_gap() -> None:
    driver, gap, speed = SmoothACC(time_gap=3.0, standstill_gap=2.0), 30.0, 3.0
    memory = driver.initial_memory(1)
    for step in range(6000):
        leader = 5.0 + np.sin(step / 5.0)
        acceleration, memory = driver.act(state_of([speed], [leader], [gap]), memory)
        speed = max(0.0, speed + float(acceleration[0]) * 0.1)
        gap += (leader - speed) * 0.1
    assert speed == pytest.approx(5.0, abs=0.1)
    assert gap == pytest.approx(2.0 + 3.0 * 5.0, abs=1.0)


def test_a_large_gap_raises_the_speed_by_no_more_than_the_catch_up_speed() -> None:
    driver = SmoothACC(catch_up_speed=2.0, time_constant=0.0)
    found, _ = driver.act(state_of([4.0], [4.0], [100.0]), driver.initial_memory(1))
    assert found[0] * 0.1 + 4.0 == pytest.approx(6.0)


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_a_share_of_the_mean_of_the_warm_up_is_the_first_mean(factor: float) -> None:
    driver = SmoothACC(history_factor=factor)
    history = np.full((1, 380), 3.0)
    memory = driver.recall(driver.initial_memory(1), LocalState(*([history] * 7)))
    assert memory["mean_leader_speed"] == pytest.approx(3.0 * factor)


def test_the_defaults_are_string_stable_with_a_slow_actuator_and_human_drivers_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(string_stability, "OSCILLATION_FREQUENCIES", np.geomspace(0.005, 0.5, 12))
    monkeypatch.setattr(string_stability, "SETTLING_SECONDS", 100.0)
    driver = FilteredDriver(SmoothACC(), 1.0, SafetyFilter(), 0.1, Actuator(delay=0.2, lag=0.3))
    for each in measure_string_stability(driver, [2.0, 12.0], PAPER_IDM):
        assert max(each.gains) <= 1.0 + GAIN_TOLERANCE
        assert each.max_stable_followers >= 10


LIMITED = SmoothACC(acceleration_limit=0.2, braking_limit=0.3, largest_gap=100.0, time_gap=2.0)


@pytest.mark.parametrize(
    ("speed", "leader_speed", "gap", "expected"),
    [
        (20.0, 25.0, 60.0, 0.2),  # faster leader: the limit
        (20.0, 18.0, 42.0, -0.3),  # slower leader: the limit
        (20.0, 10.0, 62.0, -(10.0**2) / (2 * (62.0 - 2.0 - 20.0))),  # the leader would be reached too early
        (20.0, 26.0, 110.0, 1.5),  # beyond the largest gap
    ],
)
def test_limits_hold_unless_a_gap_requires_more(speed: float, leader_speed: float, gap: float, expected: float) -> None:
    found, _ = LIMITED.act(state_of([speed], [leader_speed], [gap]), {"mean_leader_speed": np.array([leader_speed])})
    assert found[0] == pytest.approx(expected)
    plain = LocalState(speed, leader_speed, gap, speed, gap, 0.0, 0.0)
    alone, _ = LIMITED.act(plain, {"mean_leader_speed": leader_speed})
    assert alone == pytest.approx(expected)


def test_the_largest_gap_is_kept_behind_a_leader_that_drives_away() -> None:
    memory, speed, gap, largest = LIMITED.initial_memory(1), 10.0, 30.0, 0.0
    for step in range(3000):
        leader = min(25.0, 10.0 + 0.1 * step * 0.5)
        acceleration, memory = LIMITED.act(state_of([speed], [leader], [gap]), memory)
        speed = max(0.0, speed + float(np.clip(acceleration[0], -3.0, 1.5)) * 0.1)
        gap += (leader - speed) * 0.1
        largest = max(largest, gap)
    assert largest < 103.5
