import numpy as np
import pytest

from unjam.drivers import BCM, LocalState


def act(speed: float, leader: float, gap: float, follower: float, gap_behind: float, driver: BCM) -> float:
    values = (speed, leader, gap, follower, gap_behind, 0.0, 230.0)
    acceleration, _ = driver.act(LocalState(*(np.array([value]) for value in values)), {})
    return float(acceleration[0])


def test_rests_in_the_middle_at_its_desired_speed() -> None:
    assert act(8, 8, 10, 8, 10, BCM()) == 0.0


def test_pulls_towards_the_larger_gap() -> None:
    assert act(8, 8, 12, 8, 10, BCM(gap_gain=0.5)) == pytest.approx(1.0)


def test_gives_way_to_neither_side_where_both_close_in_alike() -> None:
    assert act(8, 7, 10, 9, 10, BCM(speed_gain=3)) == 0.0


def test_pulls_towards_its_desired_speed() -> None:
    assert act(6, 6, 10, 6, 10, BCM(desired_speed_gain=0.25)) == pytest.approx(0.5)
