"""Effects of CAVs and the reasons against a recommendation."""

from dataclasses import replace
from math import nan
from typing import Any

import pytest

from tests.measures.test_feasibility import FEASIBLE_ROW
from unjam.measures.effect import Effect, compute_effect, describe_harm, effects_by_driver
from unjam.measures.recommendation import MIN_VERDICT_SEEDS, rejection_reasons
from unjam.measures.statistics import Estimate, estimate

USUAL: dict[str, Any] = {
    **FEASIBLE_ROW,
    "mean_speed": 20.0,
    "cav_mean_speed": 20.0,
    "travel_time": 100.0,
    "delay": 40.0,
    "outflow_veh_per_h": 2000.0,
    "fuel_ml_per_km": 80.0,
    "human_braking_beyond_4_5": 30.0,
}


def rows_of(times: list[float], **changes: Any) -> list[dict[str, Any]]:
    """A row per travel time, with seeds from zero."""
    return [{**USUAL, "seed": [7, seed], "travel_time": time, **changes} for seed, time in enumerate(times)]


def between(low: float, high: float, count: int = 20) -> Estimate:
    return Estimate((low + high) / 2, low, high, count)


NONE = Estimate(0.0, 0.0, 0.0, 20)
GOOD = Effect(
    travel_time=between(-6.0, -2.0),
    flow=between(-10.0, 30.0),
    fuel=NONE,
    hard_braking=between(-9.0, 3.0),
    collisions=0.0,
    failed_episodes=0,
    feasibility="feasible",
    baseline_travel_time=100.0,
    baseline_flow=2000.0,
    delay_reduction=Estimate(nan, nan, nan, 0),
    speed=NONE,
)


def test_summary_has_travel_time_flow_and_fuel() -> None:
    known = replace(GOOD, delay_reduction=between(0.06, 0.14))
    assert known.summary == (
        "travel time -4.0 [-6.0, -2.0] s (10 % [6, 14] less delay), flow +10 [-10, +30] veh/h, "
        "fuel +0.0 [+0.0, +0.0] ml/km"
    )
    assert "delay" not in GOOD.summary
    slower = replace(known, travel_time=between(2.0, 6.0))
    assert slower.summary.startswith("travel time +4.0 [+2.0, +6.0] s (more delay)")
    assert "delay" not in replace(known, travel_time=between(-6.0, 1.0)).summary  # it may be none
    assert "flow -20 [-30, -10] veh/h: a loss" in replace(GOOD, flow=between(-30.0, -10.0)).summary
    nowhere = Estimate(nan, nan, nan, 0)
    closed = replace(GOOD, travel_time=nowhere, speed=between(0.1, 0.3))
    assert closed.summary.startswith("mean speed +0.20 [+0.10, +0.30] m/s, flow")


def test_effects_need_a_human_baseline() -> None:
    found = effects_by_driver({"pi": rows_of([98.0, 99.0]), "human": rows_of([100.0, 100.0])})
    assert list(found) == ["pi"]
    assert found["pi"].travel_time.mean == -1.5
    assert not effects_by_driver({"pi": rows_of([98.0])})


def test_delay_reduction_has_its_own_confidence_interval() -> None:
    baseline = [{**row, "delay": row["travel_time"] - 60.0} for row in rows_of([90.0, 100.0, 120.0])]
    half = compute_effect(rows_of([75.0, 80.0, 90.0]), baseline).delay_reduction
    assert (half.mean, half.low, half.high) == pytest.approx((0.5, 0.5, 0.5))  # on each seed
    assert compute_effect(rows_of([75.0, 80.0, nan]), baseline).delay_reduction.count == 2
    negative_delay = [{**row, "delay": -40.0} for row in baseline]
    assert compute_effect(rows_of([75.0] * 3), negative_delay).delay_reduction.count == 0


def test_differences_are_paired_on_common_seeds() -> None:
    baseline = rows_of([100.0, 120.0, 140.0, 999.0])
    found = compute_effect(rows_of([98.0, 117.0, 136.0], outflow_veh_per_h=1990.0), baseline)
    assert (found.travel_time.mean, found.travel_time.count) == (-3.0, 3)
    assert found.travel_time == estimate([-2.0, -3.0, -4.0])
    assert found.flow == Estimate(-10.0, -10.0, -10.0, 3)
    assert (found.baseline_travel_time, found.baseline_flow) == (120.0, 2000.0)
    assert found.relative_travel_time == -3.0 / 120.0
    assert found.relative_half_width == (found.travel_time.high - found.travel_time.low) / 2 / 120.0


def test_effect_has_collisions_failures_and_feasibility() -> None:
    rows = rows_of([99.0, 98.0, nan], human_braking_beyond_4_5=500.0)
    rows[0] |= {"status": "collision", "collisions": 2.0}
    rows[2] |= {"status": "failed", "collisions": nan}
    found = compute_effect(rows, rows_of([100.0] * 3))
    assert (found.collisions, found.failed_episodes, found.early_ends) == (2.0, 1, 1)
    assert (found.travel_time.count, found.travel_time.mean) == (1, -2.0), "of the complete episode"
    assert found.feasibility == "2 vehicles in contact (1 of 3)"
    assert found.hard_braking.mean == 470.0
    assert compute_effect(rows_of([99.0], human_braking_beyond_4_5=500.0), rows_of([100.0])).feasibility == "feasible"


def test_higher_confidence_widens_the_interval() -> None:
    baseline, rows = rows_of([100.0] * 12), rows_of([99.0 + 0.3 * number for number in range(12)])
    assert (
        compute_effect(rows, baseline, 0.99).relative_half_width
        > compute_effect(rows, baseline).relative_half_width
        > 0
    )


def test_beneficial_effect_has_no_rejection_reasons() -> None:
    assert rejection_reasons(GOOD) == []
    assert describe_harm(GOOD) == ""
    assert rejection_reasons(replace(GOOD, flow=NONE, hard_braking=NONE)) == []


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"travel_time": between(-6, -2, MIN_VERDICT_SEEDS - 1)}, "9 test seeds, where 10 are needed"),
        ({"failed_episodes": 3}, "3 episodes failed"),
        ({"travel_time": between(1, 3)}, "travel time is longer than that of the human baseline: +2.0 [+1.0, +3.0] s"),
        (
            {"travel_time": between(-6, 0)},
            "travel time is not shown to be shorter than that of the human baseline: -3.0 [-6.0, +0.0] s",
        ),
        ({"flow": between(-8, -2)}, "flow is lower than that of the human baseline: -5 [-8, -2] veh/h"),
        ({"flow": between(-21, 40)}, "flow may be lower by more than 1 %: +10 [-21, +40] veh/h"),
        ({"feasibility": "brakes with 7 m/s2 (1 of 9)"}, "infeasible: brakes with 7 m/s2 (1 of 9)"),
        ({"feasibility": ""}, "infeasible: no CAV drove"),
        (
            {"hard_braking": between(-1, 9)},
            "human drivers may brake beyond 4.5 m/s² more often than in the human baseline: +4 [-1, +9] times "
            "in a million vehicle-steps (a positive mean counts)",
        ),
    ],
)
def test_each_violation_gives_one_reason(changes: dict[str, Any], reason: str) -> None:
    assert rejection_reasons(replace(GOOD, **changes)) == [reason]


@pytest.mark.parametrize("time", [between(0.1, 0.4), between(-0.4, -0.1), between(-0.3, 0.4)])
def test_difference_below_half_a_percent_is_neither_gain_nor_harm(time: Estimate) -> None:
    found = replace(GOOD, travel_time=time)  # of 100 s
    assert describe_harm(found) == ""
    (reason,) = rejection_reasons(found)
    assert reason.startswith("travel time differs from that of the human baseline by less than 0.5 %, which is ")
    lower = replace(found, flow=between(-150.0, -50.0))
    assert describe_harm(lower) == "flow is lower than that of the human baseline: -100 [-150, -50] veh/h"


@pytest.mark.parametrize("time", [between(0.1, 0.6), between(-0.6, -0.1), Estimate(0.1, nan, nan, 1)])
def test_difference_that_may_exceed_half_a_percent_is_not_too_small(time: Estimate) -> None:
    found = replace(GOOD, travel_time=time)
    assert not found.is_too_small
    assert bool(describe_harm(found)) == (time.low > 0)


def test_loss_of_flow_is_rejected_despite_shorter_travel_time() -> None:
    found = replace(GOOD, travel_time=between(-60, -50), flow=between(-99, -50), feasibility="2 in contact")
    assert [reason.split(":")[0] for reason in rejection_reasons(found)] == [
        "flow is lower than that of the human baseline",
        "infeasible",
    ]


def test_one_seed_is_not_enough_for_a_recommendation() -> None:
    found = compute_effect(rows_of([50.0]), rows_of([100.0]))
    reasons = rejection_reasons(found)
    assert any("1 test seed, where 10 are needed" in reason for reason in reasons)
    assert any("not shown to be shorter" in reason for reason in reasons)
    assert any("flow may be lower" in reason for reason in reasons)


def test_both_harms_are_reported() -> None:
    both = replace(GOOD, travel_time=between(2.0, 8.0), flow=between(-150.0, -50.0))
    longer, lower = rejection_reasons(both)
    assert longer == "travel time is longer than that of the human baseline: +5.0 [+2.0, +8.0] s"
    assert lower == "flow is lower than that of the human baseline: -100 [-150, -50] veh/h"
    assert describe_harm(both) == f"{longer}; {lower}"
