"""The feasibility verdict, and the comparison of human braking with the baseline."""

from typing import Any

import pytest

from unjam.measures.feasibility import FEASIBLE, feasibility, feasibility_by_driver, overall_feasibility

FEASIBLE_ROW: dict[str, Any] = {
    "status": "completed",
    "required_time_gap": 1.0,
    "collisions": 0.0,
    "min_time_gap": 0.95,
    "cav_min_ttc": 1.5,
    "cav_max_braking": 5.0,
    "override_share": 0.0,
    "human_braking_beyond_4_5": 0.0,
}
HUMAN = {**FEASIBLE_ROW, "cav_max_braking": float("nan"), "human_braking_beyond_4_5": 20.0}


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, FEASIBLE),
        ({"min_time_gap": 0.9}, FEASIBLE),
        ({"cav_min_ttc": float("nan"), "min_time_gap": float("nan")}, FEASIBLE),
        ({"min_time_gap": 0.2}, "time gap 0.20 s (limit 0.9 s)"),
        ({"min_time_gap": 1.2, "required_time_gap": 1.5}, "time gap 1.20 s (limit 1.35 s)"),
        ({"min_time_gap": 0.8, "required_time_gap": 0.0}, "time gap 0.80 s (limit 0.9 s)"),
        ({"cav_min_ttc": 0.9}, "0.90 s to a collision"),
        ({"cav_max_braking": 6.5}, "brakes with 6.5 m/s2"),
        ({"override_share": 0.013}, "the simulator overrides 1.3 % of its commands"),
        ({"status": "collision", "collisions": 2.0, "min_time_gap": 0.1}, "2 vehicles in contact"),
        ({"status": "failed"}, ""),
        ({"cav_max_braking": float("nan")}, ""),
    ],
)
def test_verdict_is_the_first_violated_limit(changes: dict[str, Any], verdict: str) -> None:
    assert feasibility({**FEASIBLE_ROW, **changes}) == verdict


def test_hard_human_braking_counts_only_above_the_baseline() -> None:
    row = {**FEASIBLE_ROW, "human_braking_beyond_4_5": 15.0}
    text = "human drivers brake beyond 4.5 m/s2 15 times in a million vehicle-steps"
    assert feasibility(row) == f"{text} (without CAVs: unknown, -d human measures it)"
    assert overall_feasibility([row, row], [HUMAN]) == FEASIBLE
    assert overall_feasibility([row, {**FEASIBLE_ROW, "human_braking_beyond_4_5": 40.0}], [HUMAN]).startswith(
        "human drivers brake"
    )


def test_overall_verdict_counts_the_violating_episodes_and_has_the_worst_value() -> None:
    rows = [FEASIBLE_ROW, {**FEASIBLE_ROW, "min_time_gap": 0.3}, FEASIBLE_ROW]
    assert overall_feasibility(rows) == "time gap 0.30 s (limit 0.9 s) (1 of 3)"
    rows += [{**FEASIBLE_ROW, "min_time_gap": 0.2}, {**FEASIBLE_ROW, "cav_max_braking": 7.0}]
    assert overall_feasibility(rows) == "time gap 0.20 s (limit 0.9 s) (3 of 5)"


def test_compared_results_use_their_own_baselines() -> None:
    rows = {"many: human": [HUMAN], "few: human": [{**HUMAN, "human_braking_beyond_4_5": 10.0}]}
    driven = [{**FEASIBLE_ROW, "human_braking_beyond_4_5": 15.0}]
    found = feasibility_by_driver({**rows, "many: pi": driven, "few: pi": driven})
    assert found["many: pi"] == FEASIBLE
    assert found["few: pi"].endswith("(without CAVs: 10)")


def test_human_baseline_has_no_verdict() -> None:
    assert feasibility_by_driver({"human": [HUMAN], "pi": [FEASIBLE_ROW]}) == {"human": "", "pi": FEASIBLE}
