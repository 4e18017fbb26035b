"""The table of metrics: baseline, differences, cells."""

import re
from typing import Any

import numpy as np
import pytest

from unjam.measures.metric_table import (
    CAV_METRICS,
    TableCell,
    TableRow,
    choose_baseline,
    estimate_cell,
    metric_table,
    order_by_rank,
)
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import estimate, probability_of_improvement

USUAL: dict[str, Any] = {"status": "completed", "reason": "", **dict.fromkeys(METRICS, 1.0)}


def rows_of(*returns: float) -> list[dict[str, Any]]:
    """A row per return, with seeds from zero."""
    return [{**USUAL, "seed": seed, "return": value} for seed, value in enumerate(returns)]


@pytest.mark.parametrize(
    ("drivers", "baseline"),
    [
        ({"pi": 9.0, "human": 1.0}, "human"),
        ({"pi": 1.0, "idm:time_headway=1": 2.0, "unjam:ring-best": 9.0}, "idm:time_headway=1"),
        ({"pi+idm": 3.0, "pi": 2.0, "mine.py:steady": 9.0}, "pi+idm"),
        ({"unjam:ring-best": 1.0, "runs/ring-001": 2.0}, ""),
        ({"idm": float("nan"), "pi": 1.0}, "pi"),
        ({"human": 1.0}, ""),
        ({"pi": 1.0}, ""),
    ],
)
def test_baseline_is_human_or_the_expert_with_the_largest_return(drivers: dict[str, float], baseline: str) -> None:
    assert choose_baseline({label: rows_of(value, value) for label, value in drivers.items()}) == baseline


def row_named(table: list[TableRow], label: str) -> TableRow:
    return next(row for row in table if row.label == label)


def test_table_has_every_metric_with_its_definition() -> None:
    _, (verdict, *table) = metric_table({"human": rows_of(1.0), "pi": rows_of(10.0, 20.0)}, "")
    assert verdict.label == "feasible"
    assert [row.label for row in table] == [metric.label for metric in METRICS.values()]
    for row, metric in zip(table, METRICS.values(), strict=True):
        assert row.description == " ".join((metric.function.__doc__ or "").split())
        assert (row.unit, len(row.cells)) == (metric.unit, 2)
    assert row_named(table, "return").cells == [TableCell("1"), TableCell("15", "(10 to 20)")]


def test_a_table_of_human_drivers_alone_has_no_rows_about_cavs() -> None:
    for labels in (["human"], ["a: human", "b: human"]):
        _, table = metric_table({label: rows_of(1.0) for label in labels}, "")
        assert [row.label for row in table] == [METRICS[name].label for name in METRICS if name not in CAV_METRICS]
    assert not [
        row.label for row in table if re.search("CAV|feasible|filter|command|time gap|added by SUMO", row.label)
    ]
    assert "human drivers' maximum braking" in [row.label for row in table]


def test_drivers_are_ordered_human_baseline_then_formulas_then_others_as_given() -> None:
    given = "runs/b", "unjam:best", "mine.py:gentle", "pi+acc", "trained", "a.unjam", "human", "acc"
    expected = ["human", "pi+acc", "acc", "runs/b", "unjam:best", "mine.py:gentle", "trained", "a.unjam"]
    assert list(order_by_rank(dict.fromkeys(given, 0))) == expected


def test_differences_are_paired_and_have_their_own_columns() -> None:
    rows = {"idm": rows_of(8.0, 9.0, 10.0), "human": rows_of(1.0, 2.0, 4.0), "pi": rows_of(1.0, 1.0, 7.0)}
    headings, table = metric_table(rows, "human")
    assert headings == ["idm", "human", "pi", "idm \u2212 human", "pi \u2212 human"]
    assert all(len(row.cells) == 5 for row in table)
    gain = row_named(table, "return").cells[3]
    assert gain == estimate_cell(estimate([7.0, 7.0, 6.0]), 0, sign="+")
    assert (gain.mean, gain.interval) == ("+7", "[+5, +8]")
    better = row_named(table, "probability of improvement").cells
    assert better[:3] == [TableCell("")] * 3
    found = probability_of_improvement(np.array([[0.0, -1.0, 3.0]]))
    assert better[4] == TableCell("0.50", f"[{found.low:.2f}, {found.high:.2f}]")


def test_cell_of_incomplete_pairs_has_the_count() -> None:
    undissolved = {"time_to_dissolve": np.nan}
    human_rows = [row | {"time_to_dissolve": 100.0} for row in rows_of(1.0, 1.0, 1.0, 1.0)]
    pi = [row | ({"time_to_dissolve": 60.0 + k} if k < 3 else undissolved) for k, row in enumerate(human_rows)]
    _, table = metric_table({"human": human_rows, "pi": pi}, "human")
    gain = row_named(table, METRICS["time_to_dissolve"].label).cells[2]
    assert (gain.mean, gain.interval) == ("-39", "[-41, -37] 3 of 4")


def test_cell_has_the_count_of_values() -> None:
    assert estimate_cell(estimate([1.0, 1.0]), 2, 2) == TableCell("1.00")
    assert estimate_cell(estimate([1.0, 3.0, np.nan]), 1, 3) == TableCell("2.0", "(1.0 to 3.0) 2 of 3")
    assert estimate_cell(estimate([1.0, np.nan]), 0, 2) == TableCell("1", "1 of 2")
    assert estimate_cell(estimate([np.nan]), 0, 1) == TableCell("–")
    assert str(estimate_cell(estimate([1.0, 2.0, 3.0]), 1)) == "2.0 [-0.5, 4.5]"
