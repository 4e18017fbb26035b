"""The table of all metrics, for terminals and pages alike: drivers, and what each is beyond a baseline."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.drivers.registry import DRIVERS
from unjam.measures.feasibility import feasibility_by_driver
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    display_digits,
    format_ci,
    metric_estimate,
    pair_rows,
    paired_difference,
    paired_differences,
    probability_of_improvement,
)

RowsByDriver = dict[str, list[dict[str, Any]]]
"""by driver: a row of metrics per episode, failed ones too"""
HUMAN_LABEL = "human"
"""label of people alone"""


@dataclass(frozen=True)
class TableCell:
    """A number as tables show it."""

    mean: str
    interval: str = ""
    """or the range, where there is none; and of how many episodes, where not of all"""

    def __str__(self) -> str:
        """Return both, on one line."""
        return f"{self.mean} {self.interval}".strip()


@dataclass(frozen=True)
class TableRow:
    """A metric of all drivers, and then its differences."""

    label: str
    unit: str
    description: str
    cells: list[TableCell]


def choose_baseline(rows_by_driver: RowsByDriver) -> str:
    """Return beside whom the others stand: people alone, else the expert that earns most; empty: nobody."""
    if len(rows_by_driver) < 2 or HUMAN_LABEL in rows_by_driver:
        return HUMAN_LABEL if len(rows_by_driver) > 1 else ""
    returns = {
        label: metric_estimate(rows, "return").mean
        for label, rows in rows_by_driver.items()
        if all(part.partition(":")[0] in DRIVERS for part in label.split("+"))
    }
    return max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default="")


def table_headings(rows_by_driver: RowsByDriver, baseline: str) -> list[str]:
    """Return the names of the columns: drivers, then the differences to the baseline."""
    return [*rows_by_driver, *(f"{label} − {baseline}" for label in _compared_rows(rows_by_driver, baseline))]


def metric_table(rows_by_driver: RowsByDriver, baseline: str) -> list[TableRow]:
    """Return the verdict, how often each earns more than the baseline, and all metrics.

    A cell per driver, then the differences to the baseline, same seeds paired; none without one.
    """
    compared = _compared_rows(rows_by_driver, baseline)
    pairs = {label: len(pair_rows(rows, rows_by_driver[baseline])) for label, rows in compared.items()}
    said = [TableCell(verdict or "–") for verdict in feasibility_by_driver(rows_by_driver).values()]
    about = "The first reason against it; docs: What a car can drive."
    table = [TableRow("feasible", "", about, [*said, *(TableCell("") for _ in compared)])]
    if compared:
        about = f"Share of seeds on which it earns more than {baseline}, a tie counting half; Wilson's interval."
        found = [
            probability_of_improvement(paired_differences([rows], rows_by_driver[baseline], "return"))
            for rows in compared.values()
        ]
        cells = [*(TableCell("") for _ in rows_by_driver), *(estimate_cell(each, 2) for each in found)]
        table.append(TableRow("probability of improvement", "in return", about, cells))
    for name, metric in METRICS.items():
        if not any(metric_estimate(rows, name).count for rows in rows_by_driver.values()):
            continue  # it is not defined on this road
        cells = [
            estimate_cell(metric_estimate(rows, name), metric.digits, len(rows)) for rows in rows_by_driver.values()
        ]
        cells += [
            estimate_cell(paired_difference(rows, rows_by_driver[baseline], name), metric.digits, pairs[label], "+")
            for label, rows in compared.items()
        ]
        about = " ".join((metric.function.__doc__ or "").split())
        table.append(TableRow(metric.label, metric.unit, about, cells))
    return table


def _compared_rows(rows_by_driver: RowsByDriver, baseline: str) -> RowsByDriver:
    return {label: rows for label, rows in rows_by_driver.items() if baseline and label != baseline}


def estimate_cell(estimate: Estimate, digits: int, expected_count: int | None = None, sign: str = "") -> TableCell:
    """Return a cell: mean and interval, unless that is a point; of how many, where `wanted` are more."""
    if estimate.count == 0:
        return TableCell("–")
    shown = f"{sign if estimate.mean else ''}.{display_digits(estimate, digits)}f"
    interval = "" if estimate.smallest == estimate.largest else format_ci(estimate, shown)
    if expected_count is not None and estimate.count < expected_count:
        interval = f"{interval} {estimate.count} of {expected_count}".strip()
    return TableCell(f"{estimate.mean:{shown}}", interval)


def with_no_break_spaces(text: str) -> str:
    """Return a text that stays on one line of a table."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")
