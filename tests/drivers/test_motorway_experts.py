"""Experts for motorways reduce the speed upstream of slow traffic, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.drivers.local_state import COMMON_FIELDS, SECTIONS_AHEAD, LocalState, state_of_ones
from unjam.drivers.registry import driver_from_name
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.road_experts import UNBOUNDED_ACCELERATION, Cruise, GapMaker, JamAhead
from unjam.errors import InputError


def state(speed: float, ahead: float, to_merge: float = 500.0, allowed: float = 28.0) -> LocalState:
    """One CAV; the first five sections ahead are as fast as `ahead`, those behind them free."""
    speeds = np.full((1, SECTIONS_AHEAD), allowed)
    speeds[0, :5] = ahead
    values = (speed, speed, 50.0, speed, 50.0, 1500.0, np.nan)
    near = LocalState(*(np.array([value]) for value in values))
    road_fields = {"allowed_speed": np.array([allowed]), "distance_to_merge": np.array([to_merge])}
    return near._replace(**road_fields, lane_speeds=speeds, road_speeds=speeds - 1.0)


AT_ONCE = JamAhead(time_constant=1.0, speed_margin=0.0)


def answer(driver: JamAhead, *args: float) -> float:
    return float(driver.act(state(*args), {})[0][0])


def test_it_drives_towards_the_mean_speed_ahead_and_never_brakes_hard_for_it() -> None:
    driver = AT_ONCE
    assert answer(driver, 20.0, 19.5) == pytest.approx(-0.5)
    assert answer(driver, 20.0, 10.0) == -1.5
    assert answer(driver, 4.0, 1.0) == pytest.approx(1.0)  # towards the lowest, 5 m/s
    assert answer(replace(AT_ONCE, time_constant=2.0), 20.0, 19.0) == pytest.approx(-0.5)
    assert answer(replace(AT_ONCE, speed_margin=0.4), 20.0, 19.5) == pytest.approx(-0.1)


def test_the_more_cavs_there_are_the_less_each_holds_back() -> None:
    """Otherwise each CAV follows the mean of others that hold back, and all of them stop."""
    crowd = state(20.0, 19.0)._replace(penetration_rate=np.array([0.2]))
    driver = replace(AT_ONCE, margin_by_penetration=10.0)
    assert driver.act(crowd, {})[0].tolist() == pytest.approx([1.0])
    assert answer(driver, 20.0, 19.0) == pytest.approx(-1.0)  # without a penetration rate


def test_it_never_asks_for_more_than_is_allowed() -> None:
    assert answer(AT_ONCE, 27.9, 40.0) == pytest.approx(0.1)


def without_map(ahead: float, *congested: int, report: float = 1.0) -> LocalState:
    """As `state`, on a road without known merge points, with the sections that are congested."""
    congestion = np.zeros((1, SECTIONS_AHEAD))
    congestion[0, list(congested)] = report
    return state(20.0, ahead)._replace(distance_to_merge=None, congestion=congestion)


def test_where_no_map_says_where_ramps_join_it_slows_down_for_reported_congestion_alone() -> None:
    jam, dense = 20.9, 21.1  # below and above three quarters of 28 m/s
    assert AT_ONCE.act(without_map(jam, 4), {})[0].tolist() == pytest.approx([0.9])
    assert AT_ONCE.act(without_map(jam), {})[0].tolist() == [UNBOUNDED_ACCELERATION]
    assert AT_ONCE.act(without_map(jam, 5), {})[0].tolist() == [UNBOUNDED_ACCELERATION]
    assert AT_ONCE.act(without_map(dense, 4), {})[0].tolist() == [UNBOUNDED_ACCELERATION]
    assert AT_ONCE.act(without_map(jam, 4, report=0.4), {})[0].tolist() == [UNBOUNDED_ACCELERATION]
    assert AT_ONCE.act(without_map(jam, 4)._replace(congestion=None), {})[0].tolist() == [UNBOUNDED_ACCELERATION]


def test_where_a_map_says_where_ramps_join_no_report_of_congestion_changes_anything() -> None:
    mapped = state(20.0, 19.0)
    reported = mapped._replace(congestion=np.ones((1, SECTIONS_AHEAD)))
    assert AT_ONCE.act(reported, {})[0].tolist() == AT_ONCE.act(mapped, {})[0].tolist()


def test_arrays_and_tensors_of_a_road_without_a_map_have_the_same_answers() -> None:
    rows = [without_map(ahead, *congested) for ahead in (15.0, 25.0) for congested in ((), (0,), (4, 6))]
    both = rows[0].map(lambda *values: np.concatenate(values), *rows[1:])
    tensors = both.map(torch.as_tensor)
    assert JamAhead().act(tensors, {})[0].tolist() == JamAhead().act(both, {})[0].tolist()


def test_behind_the_merge_and_without_a_message_it_holds_nobody_back() -> None:
    assert answer(JamAhead(), 20.0, 5.0, -1.0) == UNBOUNDED_ACCELERATION
    alone = state_of_ones(COMMON_FIELDS, np.ones)
    assert JamAhead().act(alone, {})[0].tolist() == [UNBOUNDED_ACCELERATION]
    assert Cruise().act(alone, {})[0].tolist() == [UNBOUNDED_ACCELERATION]


def test_sections_and_lanes_are_the_users_to_choose() -> None:
    mixed = (3 * 10.0 + 2 * 28.0) / 5  # sections 2 to 6, of which 2, 3 and 4 are slow
    assert answer(replace(AT_ONCE, first_section=2, last_section=6), 17.0, 10.0) == pytest.approx(mixed - 17.0)
    assert answer(replace(AT_ONCE, all_lanes=True), 20.0, 20.0) == pytest.approx(-1.0)
    with pytest.raises(InputError, match="last_section: 2 is not allowed; allowed: >= first_section, 3"):
        driver_from_name("jam-ahead:first_section=3,last_section=2", 1.0)


@pytest.mark.parametrize(
    ("to_merge", "right", "time_gap"),
    [(200.0, 10.0, 2.0), (200.0, -3.0, 2.0), (200.0, 50.0, np.nan), (400.0, 10.0, np.nan), (-1.0, 10.0, np.nan)],
)
def test_room_is_made_just_before_the_merge_for_those_on_the_right(
    to_merge: float, right: float, time_gap: float
) -> None:
    adjacent_gaps = np.array([[1.0, 1.0, right, 100.0]])
    driver, seen = GapMaker(merge_time_gap=2.0), state(20.0, 19.0, to_merge)._replace(adjacent_gaps=adjacent_gaps)
    np.testing.assert_array_equal(driver.time_gaps(seen, {}), [time_gap])
    np.testing.assert_array_equal(driver.act(seen, {})[0], JamAhead().act(seen, {})[0])


def test_nobody_makes_room_who_is_not_told_of_it() -> None:
    alone = state_of_ones(COMMON_FIELDS, np.ones)
    assert GapMaker().time_gaps(alone, {}) is None
    assert JamAhead().decide(state(20.0, 19.0), {}).command.time_gap is None


def test_it_says_what_it_must_be_told() -> None:
    known = ("allowed_speed", "distance_to_merge", "lane_speeds", "road_speeds", "penetration_rate")
    assert JamAhead().requirements().input_fields == (*COMMON_FIELDS, *known)
    assert Cruise().requirements().input_fields == COMMON_FIELDS


def test_a_network_may_see_who_drives_beside() -> None:
    driver = ResidualDriver(Cruise(), random_network(8), 2.5, ("adjacent_lanes",))
    assert driver.requirements().input_fields == (*COMMON_FIELDS, "adjacent_gaps", "adjacent_speeds")
    gaps, speeds = np.array([[10.0, 100.0, -2.0, 40.0]]), np.array([[25.0, 20.0, 15.0, 20.0]])
    near = state(20.0, 20.0)._replace(adjacent_gaps=gaps, adjacent_speeds=speeds)
    seen = driver.observation(near, driver.initial_memory(1))
    np.testing.assert_allclose(seen, [[1.0, 0.0, -1.0, 0.0, 0.5, 5.0, -0.1, 2.0]])


def test_it_does_not_slow_down_for_traffic_that_counts_as_free() -> None:
    driver = replace(AT_ONCE, free_speed_ratio=0.7)
    assert answer(driver, 25.0, 0.7 * 27.0 - 0.1, 500.0, 27.0) == -1.5
    assert answer(driver, 25.0, 0.7 * 27.0 + 0.1, 500.0, 27.0) == UNBOUNDED_ACCELERATION
