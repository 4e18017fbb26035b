"""The table of all metrics, for terminals and pages alike: drivers, and what each is beyond a baseline."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.drivers.registry import DRIVERS
from unjam.measures.drivable import verdicts
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    digits_of,
    estimate_of,
    interval_of,
    paired,
    paired_by_training,
    paired_difference,
    probability_of_improvement,
)

Rows = dict[str, list[dict[str, Any]]]
"""by driver: a row of metrics per episode, failed ones too"""
PEOPLE = "human"
"""label of people alone"""


@dataclass(frozen=True)
class Cell:
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
    about: str
    cells: list[Cell]


def baseline_of(rows_by_driver: Rows) -> str:
    """Return beside whom the others stand: people alone, else the expert that earns most; empty: nobody."""
    if len(rows_by_driver) < 2 or PEOPLE in rows_by_driver:
        return PEOPLE if len(rows_by_driver) > 1 else ""
    returns = {
        label: estimate_of(rows, "return").mean
        for label, rows in rows_by_driver.items()
        if all(part.partition(":")[0] in DRIVERS for part in label.split("+"))
    }
    return max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default="")


def headings_of(rows_by_driver: Rows, baseline: str) -> list[str]:
    """Return the names of the columns: drivers, then the differences to the baseline."""
    return [*rows_by_driver, *(f"{label} − {baseline}" for label in _compared(rows_by_driver, baseline))]


def table_of(rows_by_driver: Rows, baseline: str) -> list[TableRow]:
    """Return the verdict, how often each earns more than the baseline, and all metrics.

    A cell per driver, then the differences to the baseline, same seeds paired; none without one.
    """
    compared = _compared(rows_by_driver, baseline)
    pairs = {label: len(paired(rows, rows_by_driver[baseline])) for label, rows in compared.items()}
    said = [Cell(verdict or "–") for verdict in verdicts(rows_by_driver).values()]
    about = "The first reason against it; docs: What a car can drive."
    table = [TableRow("could a car drive so?", "", about, [*said, *(Cell("") for _ in compared)])]
    if compared:
        about = (
            f"Share of seeds on which it earns more than {baseline}, a tie counting half; Wilson's interval."
        )
        found = [
            probability_of_improvement(paired_by_training([rows], rows_by_driver[baseline], "return"))
            for rows in compared.values()
        ]
        cells = [*(Cell("") for _ in rows_by_driver), *(cell_of(each, 2) for each in found)]
        table.append(TableRow("probability of improvement", "in return", about, cells))
    for name, metric in METRICS.items():
        if not any(estimate_of(rows, name).count for rows in rows_by_driver.values()):
            continue  # it is not defined on this road
        cells = [
            cell_of(estimate_of(rows, name), metric.digits, len(rows)) for rows in rows_by_driver.values()
        ]
        cells += [
            cell_of(paired_difference(rows, rows_by_driver[baseline], name), metric.digits, pairs[label], "+")
            for label, rows in compared.items()
        ]
        about = " ".join((metric.function.__doc__ or "").split())
        table.append(TableRow(metric.label, metric.unit, about, cells))
    return table


def _compared(rows_by_driver: Rows, baseline: str) -> Rows:
    return {label: rows for label, rows in rows_by_driver.items() if baseline and label != baseline}


def cell_of(found: Estimate, digits: int, wanted: int | None = None, sign: str = "") -> Cell:
    """Return a cell: mean and interval, unless that is a point; of how many, where `wanted` are more."""
    if found.count == 0:
        return Cell("–")
    shown = f"{sign if found.mean else ''}.{digits_of(found, digits)}f"
    interval = "" if found.smallest == found.largest else interval_of(found, shown)
    if wanted is not None and found.count < wanted:
        interval = f"{interval} {found.count} of {wanted}".strip()
    return Cell(f"{found.mean:{shown}}", interval)


def unbroken(text: str) -> str:
    """Return a text that stays on one line of a table."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")
