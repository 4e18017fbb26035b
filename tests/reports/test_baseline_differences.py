import csv
from typing import Any

import numpy as np

from unjam.measures.metrics import METRICS
from unjam.reports.summary import COMPARED_METRICS, ReportColumn, baseline_differences, episodes_as_csv


def column(name: str, values: list[float], human: ReportColumn | None = None, **more: Any) -> ReportColumn:
    rows = [
        {"seed": seed, "status": "completed", **dict.fromkeys(METRICS, float("nan")), "fuel_by_power": value}
        for seed, value in enumerate(values)
    ]
    return ReportColumn(name, [{**row, **more} for row in rows], None, human.rows if human else None)


HUMAN = column("human", [100.0, 200.0, 300.0], mean_speed=5.0)


def test_lower_fuel_is_better_and_lower_speed_is_worse() -> None:
    found = baseline_differences([HUMAN, column("pi", [90.0, 191.0, 289.0], HUMAN, mean_speed=4.0)])
    cells = {row["label"]: row["cells"][0] for row in found["rows"]}
    assert found["names"] == ["pi"]
    assert cells["fuel by power"] == {"text": "-10.0 [-12.5, -7.5]", "mark": "better", "count": 3}
    assert cells["mean speed"]["mark"] == "worse"
    assert list(cells) == [METRICS[name].label for name in COMPARED_METRICS if METRICS[name].label in cells]


def test_insignificant_differences_have_no_mark_and_unknown_metrics_no_row() -> None:
    found = baseline_differences([HUMAN, column("pi", [90.0, 210.0, 301.0], HUMAN)])
    assert [(row["label"], row["cells"][0]["mark"]) for row in found["rows"]] == [("fuel by power", "")]


def test_a_difference_of_some_pairs_has_their_number_and_no_mark() -> None:
    human = column("human", [100.0, 200.0, 300.0, 400.0])
    found = baseline_differences([human, column("pi", [90.0, 191.0, 289.0, float("nan")], human)])
    [fuel] = found["rows"]
    assert fuel["cells"] == [{"text": "-10.0 [-12.5, -7.5] 3 of 4", "mark": "", "count": 3}]


def test_each_driver_is_compared_with_the_human_baseline_of_its_folder() -> None:
    others = column("b: human", [1100.0, 1200.0, 1300.0])
    pairs = (("a", HUMAN, 0.0), ("b", others, 1000.0))
    both = [column(f"{name}: pi", [x + 90.0, x + 191.0, x + 289.0], human) for name, human, x in pairs]
    found = baseline_differences([HUMAN, both[0], others, both[1]])
    [fuel] = found["rows"]
    assert found["names"] == ["a: pi", "b: pi"]
    assert [cell["text"] for cell in fuel["cells"]] == ["-10.0 [-12.5, -7.5]"] * 2


def test_no_table_without_a_human_baseline_or_without_another_driver() -> None:
    assert baseline_differences([HUMAN]) == {}
    assert baseline_differences([column("pi", [1.0]), column("idm", [2.0])]) == {}


def test_csv_has_all_episodes_and_empty_cells_for_nan() -> None:
    columns = [HUMAN, column('a "b", c', [1.25])]
    found = list(csv.DictReader(episodes_as_csv(columns).splitlines()))
    assert [(row["driver"], row["seed"]) for row in found] == [
        *(("human", str(seed)) for seed in range(3)),
        ('a "b", c', "0"),
    ]
    assert [float(row["fuel_by_power"]) for row in found] == [100.0, 200.0, 300.0, 1.25]
    assert {row["return"] for row in found} == {""}
    assert np.isclose(float(found[0]["mean_speed"]), 5.0)
