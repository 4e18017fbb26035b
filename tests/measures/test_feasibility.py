"""Is the verdict the first reason against a driver, and nobody blamed for what people do anyway?"""

from typing import Any

import pytest

from unjam.measures.feasibility import FEASIBLE, feasibility, feasibility_by_driver, overall_feasibility

GOOD: dict[str, Any] = {
    "status": "completed",
    "required_time_gap": 1.0,
    "collisions": 0.0,
    "min_time_gap": 0.95,
    "cav_min_ttc": 1.5,
    "cav_max_braking": 5.0,
    "override_share": 0.0,
    "human_braking_beyond_4_5": 0.0,
}
HUMAN = {**GOOD, "cav_max_braking": float("nan"), "human_braking_beyond_4_5": 20.0}


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, FEASIBLE),
        ({"min_time_gap": 0.9}, FEASIBLE),
        ({"cav_min_ttc": float("nan"), "min_time_gap": float("nan")}, FEASIBLE),
        ({"min_time_gap": 0.2}, "follows at 0.20 s (floor 1 s)"),
        ({"min_time_gap": 1.2, "required_time_gap": 1.5}, "follows at 1.20 s (floor 1.5 s)"),
        ({"min_time_gap": 0.8, "required_time_gap": 0.0}, "follows at 0.80 s (floor 1 s)"),
        ({"cav_min_ttc": 0.9}, "0.90 s to a collision"),
        ({"cav_max_braking": 6.5}, "brakes with 6.5 m/s2"),
        ({"override_share": 0.013}, "SUMO overrides 1.3 % of its commands"),
        ({"status": "collision", "collisions": 2.0, "min_time_gap": 0.1}, "2 vehicles in contact"),
        ({"status": "failed"}, ""),
        ({"cav_max_braking": float("nan")}, ""),
    ],
)
def test_a_verdict_names_the_first_reason(changes: dict[str, Any], verdict: str) -> None:
    assert feasibility({**GOOD, **changes}) == verdict


def test_people_who_brake_hard_are_a_reason_only_where_they_do_so_more_than_alone() -> None:
    row = {**GOOD, "human_braking_beyond_4_5": 15.0}
    words = "people brake beyond 4.5 m/s2 15 times in a million moments"
    assert feasibility(row) == f"{words} (without CAVs: not driven)"
    assert overall_feasibility([row, row], [HUMAN]) == FEASIBLE
    assert overall_feasibility([row, {**GOOD, "human_braking_beyond_4_5": 40.0}], [HUMAN]).startswith("people brake")


def test_one_bad_episode_of_many_is_told_with_how_many_there_are() -> None:
    assert overall_feasibility([GOOD, {**GOOD, "min_time_gap": 0.3}, GOOD]) == "follows at 0.30 s (floor 1 s) (1 of 3)"


def test_of_results_that_are_compared_each_has_its_own_people() -> None:
    rows = {"many: human": [HUMAN], "few: human": [{**HUMAN, "human_braking_beyond_4_5": 10.0}]}
    driven = [{**GOOD, "human_braking_beyond_4_5": 15.0}]
    found = feasibility_by_driver({**rows, "many: pi": driven, "few: pi": driven})
    assert found["many: pi"] == FEASIBLE
    assert found["few: pi"].endswith("(without CAVs: 10)")


def test_each_driver_of_a_road_has_a_verdict_and_people_have_none() -> None:
    assert feasibility_by_driver({"human": [HUMAN], "pi": [GOOD]}) == {"human": "", "pi": FEASIBLE}
