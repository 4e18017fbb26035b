"""Verdicts on drivers: feasible or not, better or worse than human drivers, and the numbers that matter on a road."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from unjam.measures.effect import FLOW_METRIC, LAG_METRIC, POWER_FUEL_METRIC, TIME_METRIC, is_measured
from unjam.measures.feasibility import FEASIBLE, feasibility_by_driver
from unjam.measures.metric_table import HUMAN_LABEL, RowsByDriver, estimate_cell
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, paired_difference

HIGHER_IS_BETTER = {"mean_speed", "mean_speed_steady", "outflow_veh_per_h", "min_ttc"}
"""metrics that are compared with human drivers, of which lower values are worse; of the others they are better"""


@dataclass(frozen=True)
class RoadMetrics:
    """What matters on a kind of road."""

    compared: tuple[str, ...]
    """metrics that are compared with human drivers; the first one decides"""
    others: tuple[str, ...]
    """metrics that a short table shows besides"""


CLOSED_ROAD = RoadMetrics(("mean_speed", FLOW_METRIC, "speed_std_fleet_steady"), ("time_to_dissolve",))
OPEN_ROAD = RoadMetrics((TIME_METRIC, FLOW_METRIC, POWER_FUEL_METRIC), ("mean_speed",))
RECORDED_ROAD = RoadMetrics(
    (POWER_FUEL_METRIC, FLOW_METRIC, "cav_mean_gap"), ("amplification_long", "amplification_medium")
)
COMMON_METRICS = ("min_time_gap", "cav_max_braking", "human_max_braking", "collisions")


def road_metrics(rows_by_driver: RowsByDriver) -> RoadMetrics:
    """Return what matters on the road of these rows, which their metrics show."""
    rows = [row for own in rows_by_driver.values() for row in own]
    if is_measured(rows, LAG_METRIC):
        return RECORDED_ROAD
    return OPEN_ROAD if is_measured(rows, TIME_METRIC) else CLOSED_ROAD


def short_table_metrics(rows_by_driver: RowsByDriver) -> tuple[str, ...]:
    """Return the metrics of a short table."""
    metrics = road_metrics(rows_by_driver)
    return *metrics.compared, *metrics.others, *COMMON_METRICS


def verdict_lines(rows_by_driver: RowsByDriver) -> list[str]:
    """Return two lines for each driver: the verdict, and the paired differences to human drivers; none without them."""
    human = rows_by_driver.get(HUMAN_LABEL)
    if human is None or len(rows_by_driver) == 1:
        return []
    names, lines = road_metrics(rows_by_driver).compared, list[str]()
    for label, feasible in feasibility_by_driver(rows_by_driver).items():
        if label == HUMAN_LABEL:
            continue
        differences = {name: paired_difference(rows_by_driver[label], human, name) for name in names}
        pairs = max(each.count for each in differences.values())
        if not pairs:
            lines.append(f"{label}: no episode can be compared with human drivers")
            continue
        drivable = feasible if feasible in ("", FEASIBLE) else f"infeasible: {feasible}"
        verdict = "; ".join(filter(None, [drivable, _comparison(differences, pairs)]))
        lines += [f"{label}: {verdict}", f"  {', '.join(_difference_texts(differences))}"]
    return lines


def _comparison(differences: dict[str, Estimate], pairs: int) -> str:
    """Return whether the first metric is shown to be better or worse, and whether flow is shown to be lower."""
    first = next(iter(differences))
    label, seeds = METRICS[first].label.partition(",")[0], f"{pairs} paired seed{'' if pairs == 1 else 's'}"
    changes = {name: is_better(name, difference) for name, difference in differences.items()}
    if changes[first] is None:
        reason = "" if isfinite(differences[first].low) else ", which are too few"
        return f"{label} undecided compared with human drivers, {seeds}{reason}"
    word = "better" if changes[first] else "worse"
    price = ", but less flow" if changes[first] and changes[FLOW_METRIC] is False else ""
    return f"{label} {word} than that of human drivers{price}, {seeds}"


def is_better(metric: str, difference: Estimate) -> bool | None:
    """Return whether a paired difference is shown to be an improvement; None if its CI contains zero."""
    if difference.low > 0 or difference.high < 0:
        return (difference.mean > 0) == (metric in HIGHER_IS_BETTER)
    return None


def _difference_texts(differences: dict[str, Estimate]) -> Sequence[str]:
    return [
        f"{metric.label.partition(',')[0]} {estimate_cell(difference, metric.digits, sign='+')} {metric.unit}".strip()
        for metric, difference in ((METRICS[name], each) for name, each in differences.items())
        if difference.count
    ]
