"""Verdicts on drivers name what is shown, and nothing else."""

from math import nan
from typing import Any

import pytest

from tests.measures.test_effect import USUAL
from unjam.measures.metrics import METRICS
from unjam.measures.verdict import (
    CLOSED_ROAD,
    OPEN_ROAD,
    RECORDED_ROAD,
    Verdict,
    road_metrics,
    short_table_metrics,
    verdicts,
)

ROW: dict[str, Any] = {"speed_std_fleet_steady": 1.0, "fuel_by_power": 60.0, "cav_mean_gap": 20.0, **USUAL}
ROADS = {"closed": {"travel_time": nan}, "open": {}, "recorded": {"travel_time": nan, "time_behind_leader": 10.0}}


def episodes(road: str = "closed", count: int = 4, **changes: float) -> list[dict[str, Any]]:
    """Return rows whose changes vary a little from seed to seed."""
    varied = ({name: value + 0.01 * seed for name, value in changes.items()} for seed in range(count))
    return [{**ROW, **ROADS[road], **each, "seed": [7, seed]} for seed, each in enumerate(varied)]


def lines_of(**rows_by_driver: list[dict[str, Any]]) -> list[str]:
    return [line for verdict in verdicts(rows_by_driver) for line in verdict.lines]


def test_each_kind_of_road_has_its_metrics() -> None:
    found = [road_metrics({"human": episodes(road)}) for road in ROADS]
    assert found == [CLOSED_ROAD, OPEN_ROAD, RECORDED_ROAD]
    for road in ROADS:
        names = short_table_metrics({"human": episodes(road)})
        assert set(names) <= set(METRICS)
        assert len(names) == len(set(names)) <= 10


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"mean_speed": 21.0}, "pi: feasible; mean speed better than that of human drivers, 4 paired seeds"),
        ({"mean_speed": 19.0}, "pi: feasible; mean speed worse than that of human drivers, 4 paired seeds"),
        ({}, "pi: feasible; mean speed undecided compared with human drivers, 4 paired seeds; more may decide"),
        (
            {"mean_speed": 21.0, "outflow_veh_per_h": 1900.0},
            "pi: feasible; mean speed better than that of human drivers, but less flow, 4 paired seeds",
        ),
        (
            {"mean_speed": 21.0, "min_time_gap": 0.6},
            "pi: infeasible: time gap 0.60 s (limit 0.9 s) (4 of 4); mean speed better than that of human drivers, "
            "4 paired seeds",
        ),
    ],
)
def test_a_verdict_names_feasibility_the_first_metric_and_lost_flow(changes: dict[str, float], verdict: str) -> None:
    assert lines_of(human=episodes(), pi=episodes("closed", 4, **changes))[0] == verdict


def test_differences_have_signs_intervals_and_units() -> None:
    assert lines_of(human=episodes("recorded"), pi=episodes("recorded", fuel_by_power=58.0)) == [
        "pi: feasible; fuel by power better than that of human drivers, 4 paired seeds",
        "  fuel by power   -2.0 [-2.0, -2.0] ml/km (-3.3 %)",
        "  flow            0 veh/h",
        "  CAV's mean gap  0.0 m",
    ]


def test_a_verdict_on_fuel_names_the_other_model_if_it_disagrees() -> None:
    more = ROW["fuel_ml_per_km"] + 1.0
    verdict = lines_of(human=episodes("recorded"), pi=episodes("recorded", fuel_by_power=58.0, fuel_ml_per_km=more))[0]
    price = "but more fuel by emission model"
    assert verdict == f"pi: feasible; fuel by power better than that of human drivers, {price}, 4 paired seeds"
    worse = {"fuel_by_power": 58.0, "fuel_ml_per_km": more, "outflow_veh_per_h": 1900.0}
    verdict = lines_of(human=episodes("recorded"), pi=episodes("recorded", **worse))[0]
    assert ", but less flow and more fuel by emission model, " in verdict


def test_more_teleports_are_the_price_of_a_better_metric() -> None:
    found = {"human": episodes(teleports=1), "pi": episodes(mean_speed=30.0, teleports=3)}
    (verdict,) = verdicts(found)
    assert verdict.comparison.endswith(", but 8 more vehicles teleported or removed, 4 paired seeds")
    assert verdict.is_better is None
    (verdict,) = verdicts(found | {"human": episodes(teleports=3)})
    assert (verdict.is_better, "teleported" in verdict.comparison) == (True, False)


def test_few_seeds_decide_nothing() -> None:
    verdict = lines_of(human=episodes(count=1), pi=episodes(count=1, mean_speed=30.0))[0]
    assert verdict == "pi: feasible; mean speed undecided compared with human drivers, 1 paired seed, which is too few"


def test_a_verdict_counts_different_recordings() -> None:
    def behind(files: list[int], fuel: float) -> list[dict[str, Any]]:
        rows = episodes("recorded", len(files), fuel_by_power=fuel)
        return [{**row, "file": file, "part": 0, "begin": 0.0} for row, file in zip(rows, files, strict=True)]

    def verdict_of(*files: int) -> Verdict:
        (verdict,) = verdicts({"human": behind([*files], 60.0), "pi": behind([*files], 58.0)})
        return verdict

    alike, two, three = verdict_of(3, 3, 3, 3, 3), verdict_of(3, 3, 5, 5), verdict_of(3, 3, 5, 5, 6)
    assert [each.is_better for each in (alike, two, three)] == [None, None, True]
    assert alike.comparison == "fuel by power undecided compared with human drivers, 1 recording, which is too few"
    assert alike.differences[0].text == "-2.0 ml/km (-3.3 %)"
    assert two.comparison.endswith(", 2 recordings, which are too few")
    assert three.comparison == "fuel by power better than that of human drivers, 3 recordings"
    *others, part = behind([3, 3, 3], 58.0)
    rows = {"human": behind([3, 3, 3], 60.0), "pi": [*others, {**part, "part": 1}]}
    assert verdicts(rows)[0].comparison.endswith(", 2 recordings, which are too few")


def test_without_human_drivers_or_common_episodes_there_is_no_comparison() -> None:
    failed = [{**row, **dict.fromkeys(METRICS, nan), "status": "failed"} for row in episodes()]
    assert lines_of(pi=episodes(), idm=episodes()) == []
    assert lines_of(human=episodes()) == []
    assert lines_of(human=episodes(), pi=failed) == ["pi: no episode can be compared with human drivers"]
