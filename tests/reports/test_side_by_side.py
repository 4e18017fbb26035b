import csv
from typing import Any

import numpy as np

from unjam.measures.metrics import METRICS
from unjam.reports.summary import METRIC_DIRECTIONS, ReportColumn, baseline_differences, episodes_as_csv


def column(name: str, values: list[float], people: ReportColumn | None = None, **more: Any) -> ReportColumn:
    rows = [
        {"seed": seed, "status": "completed", **dict.fromkeys(METRICS, float("nan")), "fuel_ml_per_km": value}
        for seed, value in enumerate(values)
    ]
    return ReportColumn(name, [{**row, **more} for row in rows], None, people.rows if people else None)


PEOPLE = column("human", [100.0, 200.0, 300.0], mean_speed=5.0)


def test_less_fuel_is_better_and_less_speed_is_worse() -> None:
    found = baseline_differences([PEOPLE, column("pi", [90.0, 191.0, 289.0], PEOPLE, mean_speed=4.0)])
    cells = {row["label"]: row["cells"][0] for row in found["rows"]}
    assert found["names"] == ["pi"]
    assert cells["fuel"] == {"text": "-10.0 [-12.5, -7.5]", "mark": "better"}
    assert cells["mean speed"]["mark"] == "worse"
    assert list(cells) == [METRICS[name].label for name in METRIC_DIRECTIONS if METRICS[name].label in cells]


def test_what_may_be_nothing_has_no_mark_and_what_is_unknown_no_row() -> None:
    found = baseline_differences([PEOPLE, column("pi", [90.0, 210.0, 301.0], PEOPLE)])
    assert [(row["label"], row["cells"][0]["mark"]) for row in found["rows"]] == [("fuel", "")]


def test_a_difference_of_few_of_the_pairs_says_of_how_many_and_has_no_mark() -> None:
    people = column("human", [100.0, 200.0, 300.0, 400.0])
    found = baseline_differences([people, column("pi", [90.0, 191.0, 289.0, float("nan")], people)])
    [fuel] = found["rows"]
    assert fuel["cells"] == [{"text": "-10.0 [-12.5, -7.5] 3 of 4", "mark": ""}]


def test_each_stands_beside_the_people_of_its_own_folder() -> None:
    others = column("b: human", [1100.0, 1200.0, 1300.0])
    pairs = (("a", PEOPLE, 0.0), ("b", others, 1000.0))
    both = [column(f"{of}: pi", [far + 90.0, far + 191.0, far + 289.0], people) for of, people, far in pairs]
    found = baseline_differences([PEOPLE, both[0], others, both[1]])
    [fuel] = found["rows"]
    assert found["names"] == ["a: pi", "b: pi"]
    assert [cell["text"] for cell in fuel["cells"]] == ["-10.0 [-12.5, -7.5]"] * 2


def test_without_people_or_without_anybody_else_there_is_no_table() -> None:
    assert baseline_differences([PEOPLE]) == {}
    assert baseline_differences([column("pi", [1.0]), column("idm", [2.0])]) == {}


def test_all_episodes_are_in_the_csv_with_nothing_where_nothing_is_known() -> None:
    columns = [PEOPLE, column('a "b", c', [1.25])]
    found = list(csv.DictReader(episodes_as_csv(columns).splitlines()))
    assert [(row["driver"], row["seed"]) for row in found] == [
        *(("human", str(seed)) for seed in range(3)),
        ('a "b", c', "0"),
    ]
    assert [float(row["fuel_ml_per_km"]) for row in found] == [100.0, 200.0, 300.0, 1.25]
    assert {row["return"] for row in found} == {""}
    assert np.isclose(float(found[0]["mean_speed"]), 5.0)
