"""Verdicts on drivers: whether they are feasible and better than a baseline, and the key metrics of a road."""

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

from unjam.measures.effect import FLOW_METRIC, FUEL_METRIC, LAG_METRIC, POWER_FUEL_METRIC, TIME_METRIC, is_measured
from unjam.measures.feasibility import FEASIBLE, EpisodeRows, RowsByDriver, feasibility_by_driver
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell, metric_table
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    count_teleports,
    format_units,
    pair_rows,
    paired_difference,
    relative_difference,
)
from unjam.text import format_count

if TYPE_CHECKING:  # imported late, so that commands start quickly
    import pandas as pd

HIGHER_IS_BETTER = {"mean_speed", "mean_speed_steady", "outflow_veh_per_h", "min_ttc"}
"""compared metrics of which higher values are better; of other compared metrics, lower values are better"""
MAX_RELATIVE_CHANGE = 10.0  # relative change above which it is not shown, because the baseline is nearly zero
FEW_SEEDS = 10  # number of seeds or recordings below which more of them may change a verdict
NEITHER_IS_BETTER = {"cav_mean_gap"}
"""metrics without a better direction: a larger gap can dissolve a wave, but lets vehicles cut in"""


@dataclass(frozen=True)
class RoadMetrics:
    """The key metrics of a kind of road."""

    compared: tuple[str, ...]  # metrics that are compared with the baseline; the first metric decides
    others: tuple[str, ...]  # further metrics of a short table
    headline: tuple[str, ...]  # metrics of a driver without a baseline; the first two are the most important


CLOSED_ROAD = RoadMetrics(
    ("mean_speed", FLOW_METRIC, "speed_std_fleet_steady"),
    ("time_to_dissolve",),
    ("mean_speed", "speed_limit_ratio_steady", "speed_std_fleet_steady", POWER_FUEL_METRIC),
)
_OPEN_ROAD_METRICS = TIME_METRIC, FLOW_METRIC, POWER_FUEL_METRIC
OPEN_ROAD = RoadMetrics(_OPEN_ROAD_METRICS, ("mean_speed",), _OPEN_ROAD_METRICS)
RECORDED_ROAD = RoadMetrics(
    (POWER_FUEL_METRIC, FLOW_METRIC, "cav_mean_gap"),
    (LAG_METRIC, "amplification_medium"),
    (POWER_FUEL_METRIC, FLOW_METRIC, LAG_METRIC),
)
PRICES = {FLOW_METRIC: "less flow", FUEL_METRIC: "more fuel by emission model"}
"""texts on worse metrics in the verdict on a better driver; fuel by emission model only if fuel by power decides"""
COMMON_METRICS = ("min_time_gap", "cav_max_braking", "human_max_braking", "collisions")


def road_metrics(rows_by_driver: RowsByDriver) -> RoadMetrics:
    """Return the key metrics of a road; the metrics in its rows show the kind of road."""
    rows = [row for driver_rows in rows_by_driver.values() for row in driver_rows]
    if is_measured(rows, LAG_METRIC):
        return RECORDED_ROAD
    return OPEN_ROAD if is_measured(rows, TIME_METRIC) else CLOSED_ROAD


def short_table_metrics(rows_by_driver: RowsByDriver) -> tuple[str, ...]:
    """Return the metrics of a short table."""
    metrics = road_metrics(rows_by_driver)
    return *metrics.compared, *metrics.others, *COMMON_METRICS


def metric_frame(rows_by_driver: RowsByDriver) -> "pd.DataFrame":
    """Return a table of the metrics of `short_table_metrics` as texts: a row per metric, a column per driver."""
    import pandas as pd

    headings, rows = metric_table(rows_by_driver, "", short_table_metrics(rows_by_driver))
    cells = [[f"{row.label} [{row.unit}]" if row.unit else row.label, *map(str, row.cells)] for row in rows]
    return pd.DataFrame(cells, columns=["", *headings])


@dataclass(frozen=True)
class DifferenceText:
    """The text of a paired difference to the baseline."""

    label: str
    text: str  # mean and CI with the unit, and the mean relative to the baseline
    is_better: bool | None


@dataclass(frozen=True)
class Verdict:
    """The verdict on a driver compared with a baseline on the same seeds; seeds of one recording count as one."""

    driver: str
    feasibility: str  # `FEASIBLE`, the first reason against it, or empty
    comparison: str  # whether the deciding metric is better or worse, and which metrics are worse
    is_better: bool | None  # whether the deciding metric is shown to be better; None: undecided
    differences: tuple[DifferenceText, ...] = ()

    @property
    def feasibility_text(self) -> str:
        """Feasibility as a short text; empty if it is unknown."""
        return self.feasibility if self.feasibility in ("", FEASIBLE) else f"infeasible: {self.feasibility}"

    @property
    def lines(self) -> list[str]:
        """The lines of the verdict as text: a summary, and an indented line for each difference."""
        width = max((len(difference.label) for difference in self.differences), default=0)
        details = (f"  {difference.label:{width}}  {difference.text}" for difference in self.differences)
        return [f"{self.driver}: {'; '.join(filter(None, [self.feasibility_text, self.comparison]))}", *details]


def verdicts(rows_by_driver: RowsByDriver, baseline: str = "") -> list[Verdict]:
    """Return the verdicts on all drivers except the baseline, by default the human one; none without a baseline."""
    reference = baseline or HUMAN_LABEL
    by_driver = feasibility_by_driver(rows_by_driver) if rows_by_driver.get(reference) else {}
    return [_verdict(label, rows_by_driver, reference, by_driver[label]) for label in by_driver if label != reference]


def _verdict(label: str, rows_by_driver: RowsByDriver, reference: str, feasibility: str) -> Verdict:
    rows, reference_rows = rows_by_driver[label], rows_by_driver[reference]
    names = road_metrics(rows_by_driver).compared
    reference_name = "human drivers" if reference == HUMAN_LABEL else reference
    names_with_prices = (*names, FUEL_METRIC) if names[0] == POWER_FUEL_METRIC else names
    differences = {name: paired_difference(rows, reference_rows, name) for name in names_with_prices}
    if not any(difference.count for difference in differences.values()):
        return Verdict(label, "", f"no episode can be compared with {reference_name}", None)
    changes = {name: is_better(name, difference) for name, difference in differences.items()}
    texts = list[DifferenceText]()
    for name in names:
        if differences[name].count:
            title = METRICS[name].label.removesuffix(", departure delay included")
            text = _difference_text(name, differences[name], relative_difference(rows, reference_rows, name).mean)
            texts.append(DifferenceText(title, text, changes[name]))
    prices = [text for name, text in PRICES.items() if changes.get(name) is False]
    paired_rows, paired_reference = zip(*pair_rows(rows, reference_rows), strict=True)
    if (teleports := count_teleports(paired_rows) - count_teleports(paired_reference)) > 0:
        prices.append(f"{format_count(teleports, 'more vehicle')} teleported or removed")
    comparison = _comparison(differences, changes, rows, reference_name, " and ".join(prices))
    # Teleports and removals make traffic look better.
    verdict = None if changes[names[0]] and teleports > 0 else changes[names[0]]
    return Verdict(label, feasibility, comparison, verdict, (*texts,))


def _comparison(
    differences: dict[str, Estimate],
    changes: dict[str, bool | None],
    rows: EpisodeRows,
    reference_name: str,
    price: str,
) -> str:
    """Return whether the first metric is shown to be better or worse, and the price of an improvement, as text."""
    metric = next(iter(differences))
    label, units = METRICS[metric].label.partition(",")[0], max(difference.count for difference in differences.values())
    sample = format_units(rows, units, "paired seed")
    if changes[metric] is None:
        too_few = f", which {'is' if units == 1 else 'are'} too few"
        reason = "; more may decide" if isfinite(differences[metric].low) else too_few
        return f"{label} undecided compared with {reference_name}, {sample}{reason if units < FEW_SEEDS else ''}"
    if not changes[metric]:
        return f"{label} worse than that of {reference_name}, {sample}"
    return f"{label} better than that of {reference_name}{price and f', but {price}'}, {sample}"


def _difference_text(name: str, difference: Estimate, relative: float) -> str:
    metric = METRICS[name]
    share = f" ({100 * relative:+.1f} %)" if abs(relative) < MAX_RELATIVE_CHANGE and difference.mean else ""
    return f"{estimate_cell(difference, metric.digits, sign='+')} {metric.unit}".strip() + share


def is_better(metric: str, difference: Estimate) -> bool | None:
    """Return whether a paired difference is shown to be an improvement; None if undecided, or if neither is better."""
    if metric not in NEITHER_IS_BETTER and (difference.low > 0 or difference.high < 0):
        return (difference.mean > 0) == (metric in HIGHER_IS_BETTER)
    return None
