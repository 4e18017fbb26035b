"""Normalized gain: the human baseline is 0, the reference is 1, infeasible drivers gain nothing."""

from math import nan
from typing import Any

import pytest

from tests.measures.test_feasibility import FEASIBLE_ROW
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
    **FEASIBLE_ROW,
    "mean_speed": 3.5,
    "speed_limit_ratio": 0.7,
    "travel_time": nan,
    "delay": nan,
    "outflow_veh_per_h": 1000.0,
}


def ring(speeds: list[float], **changes: Any) -> list[dict[str, Any]]:
    """A row for each speed of the second half, with seeds from zero."""
    return [{**CLOSED, "seed": [7, n], "mean_speed_second_half": v, **changes} for n, v in enumerate(speeds)]


BASELINE = ring([3.0, 3.1, 2.9, 3.0])
BEST = [4.0, 4.1, 3.9, 4.0]
"""performance of the reference on each seed of the baseline"""


def test_performance_is_speed_on_closed_roads_and_travel_time_on_open_ones() -> None:
    assert performance(BASELINE[0]) == 3.0
    assert performance_bound(BASELINE[0]) == pytest.approx(5.0)
    motorway = {**BASELINE[0], "travel_time": 150.0, "delay": 40.0}
    assert performance(motorway) == -150.0
    assert performance_bound(motorway) == -110.0


def test_baseline_has_gain_zero_and_reference_has_gain_one() -> None:
    assert normalized_gain(BASELINE, BASELINE, BEST).mean == 0.0
    best = normalized_gain(ring(BEST), BASELINE, BEST)
    assert (best.mean, best.low, best.high) == pytest.approx((1.0, 1.0, 1.0))
    of_each = normalized_gain(ring([3.5, 3.6, 3.4, 3.7]), BASELINE, [4.0, 4.1, 3.9, 4.4])
    assert (of_each.mean, of_each.low, of_each.high) == pytest.approx((0.5, 0.5, 0.5))
    half = normalized_gain(ring([3.4, 3.6, 3.5, 3.5]), BASELINE, BEST)
    assert half.mean == pytest.approx(0.5)
    assert half.low < 0.5 < half.high


def test_gain_is_clipped_on_both_sides() -> None:
    assert normalized_gain(ring([9.0] * 4), BASELINE, BEST).mean == MAX_GAIN
    assert normalized_gain(ring([0.1] * 4), BASELINE, BEST).mean == MIN_GAIN


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_time_gap": 0.3},
        {"status": "collision", "collisions": 2.0},
        {"override_share": 0.01},
        {"outflow_veh_per_h": 900.0},
    ],
)
def test_infeasible_drivers_and_lower_flow_gain_nothing(wrong: dict[str, Any]) -> None:
    fast = ring([4.0] * 4, **wrong)
    assert normalized_gain(fast, BASELINE, BEST).mean == 0.0
    slow = ring([2.5] * 4, **wrong)
    assert normalized_gain(slow, BASELINE, BEST).mean == pytest.approx(-0.5)


def test_failed_episodes_have_gain_zero() -> None:
    failed = ring([nan] * 4, status="failed", cav_max_braking=nan, outflow_veh_per_h=nan)
    found = normalized_gain(failed, BASELINE, BEST)
    assert (found.mean, found.low, found.high) == (0.0, 0.0, 0.0)


def test_single_bad_episode_is_clipped() -> None:
    rows = ring([4.0, 4.1, 3.9, -50.0])
    found = gain_by_seed(rows, BASELINE, BEST)
    assert found.mean() == pytest.approx(normalized_gain(rows, BASELINE, BEST).mean)
    assert found - found.min() == pytest.approx([1.0 - MIN_GAIN] * 3 + [0.0])


def test_only_losses_count_if_the_reference_gain_is_negligible() -> None:
    best = [performance(row) * (1.0 + MIN_REFERENCE_GAIN / 2) for row in BASELINE]
    assert normalized_gain(ring([3.05] * 4), BASELINE, best).mean == 0.0
    assert normalized_gain(ring([2.955] * 4), BASELINE, best).mean == pytest.approx(-0.5)


def test_gain_by_seed_has_the_same_mean_and_interval() -> None:
    rows = ring([3.4, 3.7, 3.1, 3.9])
    found, alone = estimate(gain_by_seed(rows, BASELINE, BEST).tolist()), normalized_gain(rows, BASELINE, BEST)
    assert (found.mean, found.low, found.high) == pytest.approx((alone.mean, alone.low, alone.high))


def test_capped_gain_does_not_vary_by_seed() -> None:
    crashed = ring([3.4, 3.7, 3.1, 3.9], collisions=2.0, status="collision")
    assert gain_by_seed(crashed, BASELINE, BEST).tolist() == [0.0] * 4


def test_capped_gain_varies_by_seed_only_in_losses() -> None:
    rows, nothing = ring([3.09, 3.01, 2.81, 2.82]), [performance(row) for row in BASELINE]
    found = gain_by_seed(rows, BASELINE, nothing)
    assert found.mean() == pytest.approx(normalized_gain(rows, BASELINE, nothing).mean)
    assert found.max() == pytest.approx(found[0])  # a gain and no change count alike
