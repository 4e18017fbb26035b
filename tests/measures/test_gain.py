"""Are people alone 0, the best that is known 1, and does nothing count that no car could drive?"""

from math import nan
from typing import Any

import pytest

from unjam.measures.gain import (
    MAX_GAIN,
    MIN_GAIN,
    MIN_REFERENCE_GAIN,
    gain_by_seed,
    normalized_gain,
    performance,
    performance_bound,
)
from unjam.measures.statistics import estimate

CLOSED: dict[str, Any] = {
    "status": "completed",
    "required_time_gap": 1.0,
    "collisions": 0.0,
    "min_time_gap": 1.1,
    "cav_min_ttc": 1.5,
    "cav_max_braking": 3.0,
    "override_share": 0.0,
    "mean_speed": 3.5,
    "speed_limit_ratio": 0.7,
    "travel_time": nan,
    "delay": nan,
    "outflow_veh_per_h": 1000.0,
    "human_braking_beyond_4_5": 0.0,
}


def ring(speeds: list[float], **changes: Any) -> list[dict[str, Any]]:
    """A row for each speed of the second half, with seeds from zero."""
    return [{**CLOSED, "seed": [7, n], "mean_speed_second_half": v, **changes} for n, v in enumerate(speeds)]


PEOPLE = ring([3.0, 3.1, 2.9, 3.0])
BEST = [4.0, 4.1, 3.9, 4.0]
"""what the best is worth on each of people's seeds"""


def test_closed_roads_are_judged_by_speed_and_those_with_ends_by_travel_time() -> None:
    assert performance(PEOPLE[0]) == 3.0
    assert performance_bound(PEOPLE[0]) == pytest.approx(5.0)
    motorway = {**PEOPLE[0], "travel_time": 150.0, "delay": 40.0}
    assert performance(motorway) == -150.0
    assert performance_bound(motorway) == -110.0


def test_people_gain_nothing_and_the_best_gains_one() -> None:
    assert normalized_gain(PEOPLE, PEOPLE, BEST).mean == 0.0
    best = normalized_gain(ring(BEST), PEOPLE, BEST)
    assert (best.mean, best.low, best.high) == pytest.approx((1.0, 1.0, 1.0))
    of_each = normalized_gain(ring([3.5, 3.6, 3.4, 3.7]), PEOPLE, [4.0, 4.1, 3.9, 4.4])
    assert (of_each.mean, of_each.low, of_each.high) == pytest.approx((0.5, 0.5, 0.5))
    half = normalized_gain(ring([3.4, 3.6, 3.5, 3.5]), PEOPLE, BEST)
    assert half.mean == pytest.approx(0.5)
    assert half.low < 0.5 < half.high


def test_a_gain_is_bounded_on_both_sides() -> None:
    assert normalized_gain(ring([9.0] * 4), PEOPLE, BEST).mean == MAX_GAIN
    assert normalized_gain(ring([0.1] * 4), PEOPLE, BEST).mean == MIN_GAIN


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_time_gap": 0.3},
        {"status": "collision", "collisions": 2.0},
        {"override_share": 0.01},
        {"outflow_veh_per_h": 900.0},
    ],
)
def test_what_no_car_could_drive_or_what_lowers_flow_gains_nothing(wrong: dict[str, Any]) -> None:
    fast = ring([4.0] * 4, **wrong)
    assert normalized_gain(fast, PEOPLE, BEST).mean == 0.0
    slow = ring([2.5] * 4, **wrong)
    assert normalized_gain(slow, PEOPLE, BEST).mean == pytest.approx(-0.5)


def test_who_cannot_drive_on_a_road_neither_gains_nor_loses_there() -> None:
    failed = ring([nan] * 4, status="failed", cav_max_braking=nan, outflow_veh_per_h=nan)
    found = normalized_gain(failed, PEOPLE, BEST)
    assert (found.mean, found.low, found.high) == (0.0, 0.0, 0.0)


def test_a_single_disaster_counts_no_more_than_the_worst_that_counts() -> None:
    rows = ring([4.0, 4.1, 3.9, -50.0])
    found = gain_by_seed(rows, PEOPLE, BEST)
    assert found.mean() == pytest.approx(normalized_gain(rows, PEOPLE, BEST).mean)
    assert found - found.min() == pytest.approx([1.0 - MIN_GAIN] * 3 + [0.0])


def test_where_nothing_is_to_be_gained_a_loss_is_all_that_counts() -> None:
    best = [performance(row) * (1.0 + MIN_REFERENCE_GAIN / 2) for row in PEOPLE]
    assert normalized_gain(ring([3.05] * 4), PEOPLE, best).mean == 0.0
    assert normalized_gain(ring([2.955] * 4), PEOPLE, best).mean == pytest.approx(-0.5)


def test_seed_by_seed_a_gain_has_the_same_mean_and_interval() -> None:
    rows = ring([3.4, 3.7, 3.1, 3.9])
    found, alone = estimate(gain_by_seed(rows, PEOPLE, BEST).tolist()), normalized_gain(rows, PEOPLE, BEST)
    assert (found.mean, found.low, found.high) == pytest.approx((alone.mean, alone.low, alone.high))


def test_a_gain_that_a_rule_has_fixed_has_no_errors() -> None:
    crashed = ring([3.4, 3.7, 3.1, 3.9], collisions=2.0, status="collision")
    assert gain_by_seed(crashed, PEOPLE, BEST).tolist() == [0.0] * 4


def test_where_a_rule_has_fixed_it_seeds_differ_in_what_is_lost() -> None:
    rows, nothing = ring([3.09, 3.01, 2.81, 2.82]), [performance(row) for row in PEOPLE]
    found = gain_by_seed(rows, PEOPLE, nothing)
    assert found.mean() == pytest.approx(normalized_gain(rows, PEOPLE, nothing).mean)
    assert found.max() == pytest.approx(found[0])  # who gains and who keeps what there is are alike
