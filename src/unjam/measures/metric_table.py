"""The table of metrics in terminals and on pages: values of drivers, and differences to a baseline."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from unjam.drivers.registry import DRIVERS
from unjam.measures.feasibility import RowsByDriver, feasibility_by_driver
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    count_units,
    display_digits,
    format_ci,
    metric_estimate,
    paired_difference,
    paired_differences,
    probability_of_improvement,
)

Value = TypeVar("Value")
HUMAN_LABEL = "human"  # label of the human baseline
CAV_METRICS = {name for name, metric in METRICS.items() if metric.label.startswith("CAV")} | {
    *("min_ttc", "min_time_gap", "max_jerk", "filter_override_share", "override_share", "yield_share"),
    *("shield_override_share", "shield_max_braking"),
}  # metrics of CAVs; in the human baseline, of the human drivers that CAVs would replace


@dataclass(frozen=True)
class TableCell:
    """The text of a number in a table."""

    mean: str
    interval: str = ""  # CI, or else the range of values; with the number of episodes if some are left out

    def __str__(self) -> str:
        return f"{self.mean} {self.interval}".strip()


@dataclass(frozen=True)
class TableRow:
    """A metric: a cell for each driver, then a cell for each difference to the baseline."""

    label: str
    unit: str
    description: str
    cells: list[TableCell]


def driver_rank(label: str) -> int:
    """Return the rank of a driver in tables: 0 for the human baseline, 1 for formulas of the package, 2 for others."""
    name = label.rpartition(": ")[2]  # labels in a comparison begin with the folder of results
    if name == HUMAN_LABEL:
        return 0
    return 1 if all(formula.partition(":")[0] in DRIVERS for formula in name.split("+")) else 2


def order_by_rank(by_driver: Mapping[str, Value]) -> dict[str, Value]:
    """Return the entries of drivers in the order of tables and figures, by `driver_rank`."""
    return {label: by_driver[label] for label in sorted(by_driver, key=driver_rank)}


def choose_baseline(rows_by_driver: RowsByDriver, requested: str = "") -> str:
    """Return the driver to compare with: the requested one, the human baseline, the best expert by return, or empty."""
    if requested and len(rows_by_driver) > 1:
        return requested
    if len(rows_by_driver) < 2 or HUMAN_LABEL in rows_by_driver:
        return HUMAN_LABEL if len(rows_by_driver) > 1 else ""
    experts = {label: rows for label, rows in rows_by_driver.items() if driver_rank(label) == 1}
    returns = {label: metric_estimate(rows, "return").mean for label, rows in experts.items()}
    return max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default="")


def metric_table(
    rows_by_driver: RowsByDriver, baseline: str, names: Iterable[str] = METRICS
) -> tuple[list[str], list[TableRow]]:
    """Return the headings, and the rows of verdicts, of probabilities of improvement, and of the named metrics.

    A row has a cell for each driver, then one for each paired difference to the baseline, if there is a baseline. Rows
    about CAVs are left out if no driver has CAVs.
    """
    has_cavs = any(map(driver_rank, rows_by_driver))
    compared = {label: rows for label, rows in rows_by_driver.items() if baseline and label != baseline}
    headings = [*rows_by_driver, *(f"{label} − {baseline}" for label in compared)]
    reference = rows_by_driver[baseline] if compared else []
    table = list[TableRow]()
    if has_cavs:
        verdicts = [TableCell(verdict or "–") for verdict in feasibility_by_driver(rows_by_driver).values()]
        description = "The first violated limit; see docs/safety.md."
        table.append(TableRow("feasible", "", description, [*verdicts, *(TableCell("") for _ in compared)]))
    if compared:
        description = f"Share of seeds with a larger return than {baseline}; a tie counts half. Wilson's interval."
        differences = (paired_differences([rows], reference, "return") for rows in compared.values())
        improvements = (estimate_cell(probability_of_improvement(difference), 2) for difference in differences)
        cells = [*(TableCell("") for _ in rows_by_driver), *improvements]
        table.append(TableRow("probability of improvement", "in return", description, cells))
    for name in names:
        metric = METRICS[name]
        if name in CAV_METRICS and not has_cavs:
            continue
        estimates = [(metric_estimate(rows, name), len(rows)) for rows in rows_by_driver.values()]
        if not any(estimate.count for estimate, _ in estimates):
            continue  # the metric is not defined on this road
        cells = [estimate_cell(estimate, metric.digits, episodes) for estimate, episodes in estimates]
        for rows in compared.values():
            difference, units = paired_difference(rows, reference, name), count_units(rows, reference)
            cells.append(estimate_cell(difference, metric.digits, units, "+"))
        table.append(TableRow(metric.label, metric.unit, " ".join((metric.function.__doc__ or "").split()), cells))
    return headings, table


def estimate_cell(estimate: Estimate, digits: int, expected_count: int | None = None, sign: str = "") -> TableCell:
    """Return a cell with the mean, the CI of different values, and the count if it is below `expected_count`."""
    if estimate.count == 0:
        return TableCell("–")
    format_spec = f"{sign if estimate.mean else ''}.{display_digits(estimate, digits)}f"
    interval = "" if estimate.smallest == estimate.largest else format_ci(estimate, format_spec)
    if expected_count is not None and estimate.count < expected_count:
        interval = f"{interval} {estimate.count} of {expected_count}".strip()
    return TableCell(f"{estimate.mean:{format_spec}}", interval)


def use_no_break_spaces(text: str) -> str:
    """Return the text with no-break spaces, so that it stays on one line."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")
