"""Effect of CAVs on a road: paired differences to the human baseline on the same seeds."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any

import numpy as np

from unjam.measures.feasibility import FEASIBLE, HARD_BRAKING_METRIC, EpisodeRows, RowsByDriver, overall_feasibility
from unjam.measures.statistics import (
    CONFIDENCE,
    Estimate,
    count_teleports,
    estimate,
    format_difference,
    format_share,
    has_ended_early,
    linearized_ratio,
    metric_estimate,
    metric_value,
    pair_rows,
    paired_difference,
)

MAX_FLOW_LOSS = 0.01  # loss of flow that the CI must exclude, relative to the flow of the baseline
SMALLEST_EFFECT = 0.005
"""difference of travel time, relative to the baseline, below which there is neither gain nor harm"""

TIME_METRIC, FLOW_METRIC, FUEL_METRIC = "travel_time", "outflow_veh_per_h", "fuel_ml_per_km"
POWER_FUEL_METRIC, LAG_METRIC = "fuel_by_power", "time_behind_leader"  # the second only exists behind recorded vehicles
TOO_SMALL = f"less than {100 * SMALLEST_EFFECT:g} %, which is too small to matter"
"""description of a difference of travel time below `SMALLEST_EFFECT`"""


@dataclass(frozen=True)
class Effect:
    """Effect of CAVs on a road; each `Estimate` is a paired difference to the human baseline with its CI."""

    travel_time: Estimate  # mean travel time of the vehicles of the demand, departure delay included [s]
    flow: Estimate  # flow [veh/h]
    fuel: Estimate
    """fuel of all vehicles [ml/km]: by power behind a recorded vehicle, by emission class on other roads"""
    hard_braking: Estimate  # vehicle-steps in which human drivers brake beyond 4.5 m/s2 [per million]
    collisions: float  # difference of the number of vehicles in contact, in all episodes together
    failed_episodes: int  # number of episodes that did not run
    feasibility: str  # verdict on the CAVs themselves: `FEASIBLE`, or the first reason against it
    baseline_travel_time: float  # mean travel time of the human baseline on these seeds [s]
    baseline_flow: float  # mean flow of the human baseline on these seeds [veh/h]
    delay_reduction: Estimate
    """reduction of the delay relative to the human baseline; NaN if the delay of the baseline is unknown or zero"""
    speed: Estimate  # mean speed of all vehicles [m/s]
    early_ends: int = 0  # number of episodes that ended early, baseline included; they are not compared
    teleports: int = 0  # difference of the number of vehicles that SUMO teleported or removed, in all episodes together
    baseline_teleport_share: float = 0.0  # share of vehicles that SUMO teleported or removed in the baseline

    @property
    def summary(self) -> str:
        """Differences of travel time, or of speed on closed roads, and of flow and fuel, as one line of text."""
        time = f"travel time {format_seconds(self.travel_time)}"
        if self.delay_reduction.count and (self.travel_time.high < 0 or self.travel_time.low > 0):
            reduction = f"{format_share(self.delay_reduction)} less delay"
            time += f" ({reduction if self.travel_time.high < 0 else 'more delay'})"
        speed_or_time = time if self.travel_time.count else f"mean speed {format_difference(self.speed, 2)} m/s"
        loss = ": a loss, whatever the speed" if self.travel_time.count and self.flow.high < 0 else ""
        flow = f"flow {format_difference(self.flow)} veh/h{loss}"
        return f"{speed_or_time}, {flow}, fuel {format_difference(self.fuel, 1)} ml/km"

    @property
    def relative_half_width(self) -> float:
        """Half the width of the CI of travel time, relative to the baseline's travel time; NaN without a CI."""
        return self.travel_time.half_width / self.baseline_travel_time

    @property
    def relative_travel_time(self) -> float:
        """Difference of travel time, relative to the baseline's travel time."""
        return self.travel_time.mean / self.baseline_travel_time

    @property
    def is_too_small(self) -> bool:
        """Whether the difference of travel time is shown to be too small to matter."""
        return is_too_small(self.travel_time, self.baseline_travel_time)

    @property
    def is_infeasible(self) -> bool:
        """Whether CAVs were infeasible in an episode; further episodes cannot change this verdict."""
        return self.feasibility not in ("", FEASIBLE)

    @property
    def is_longer(self) -> bool:
        """Whether travel time is shown to be longer by a difference that is not shown to be too small to matter."""
        return self.travel_time.low > 0 and not self.is_too_small

    @property
    def harm_checks(self) -> tuple[tuple[bool, str], ...]:
        """For travel time and for flow: whether the metric is shown to be worse, and the finding as text."""
        time = f"travel time is longer than that of the human baseline: {format_seconds(self.travel_time)}"
        flow = f"flow is lower than that of the human baseline: {format_difference(self.flow)} veh/h"
        return (self.is_longer, time), (self.flow.high < 0, flow)


def format_seconds(difference: Estimate) -> str:
    """Return a difference of times [s] with its CI as text."""
    return f"{format_difference(difference, 1)} s"


def is_too_small(difference: Estimate, baseline_time: float) -> bool:
    """Return whether the whole CI of a difference is within ±0.5 % of the baseline's travel time [s]."""
    limit = SMALLEST_EFFECT * baseline_time
    return -limit < difference.low and difference.high < limit


def is_measured(rows: Iterable[dict[str, Any]], metric: str) -> bool:
    """Return whether a metric is defined for any of the episodes."""
    return any(isfinite(row.get(metric, nan)) for row in rows)


def compute_effect(rows: EpisodeRows, baseline: EpisodeRows, confidence: float = CONFIDENCE) -> Effect:
    """Return the effect of a driver from rows of `measure`, its own and those of the human baseline.

    Only seeds that are in both sets of rows are used.
    """
    seeds = {str(row["seed"]) for row in rows}
    baseline = [row for row in baseline if str(row["seed"]) in seeds]
    run_rows, run_baseline = ([row for row in table if row["status"] != "failed"] for table in (rows, baseline))
    fuel_metric = POWER_FUEL_METRIC if is_measured(run_rows, LAG_METRIC) else FUEL_METRIC
    metrics = TIME_METRIC, FLOW_METRIC, fuel_metric, HARD_BRAKING_METRIC
    differences = (paired_difference(rows, baseline, name, confidence) for name in metrics)
    teleports, baseline_teleports = map(count_teleports, (rows, baseline))
    return Effect(
        *differences,
        collisions=float(sum(row["collisions"] for row in run_rows) - sum(row["collisions"] for row in run_baseline)),
        failed_episodes=len(rows) - len(run_rows),
        feasibility=overall_feasibility([{**row, HARD_BRAKING_METRIC: 0.0} for row in rows]),
        baseline_travel_time=metric_estimate(baseline, TIME_METRIC).mean,
        baseline_flow=metric_estimate(baseline, FLOW_METRIC).mean,
        delay_reduction=_delay_reduction(rows, baseline, confidence),
        speed=paired_difference(rows, baseline, "mean_speed", confidence),
        early_ends=sum(map(has_ended_early, [*rows, *baseline])),
        teleports=teleports - baseline_teleports,
        baseline_teleport_share=baseline_teleports / max(1, sum(row.get("vehicles", 0) for row in baseline)),
    )


def _delay_reduction(rows: EpisodeRows, baseline: EpisodeRows, confidence: float) -> Estimate:
    pairs = [
        (metric_value(human_row, TIME_METRIC) - metric_value(row, TIME_METRIC), metric_value(human_row, "delay"))
        for row, human_row in pair_rows(rows, baseline)
    ]
    reductions, delays = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2).T
    if not len(delays) or delays.mean() <= 0:
        return Estimate(nan, nan, nan, 0)
    return estimate(linearized_ratio(reductions, delays).tolist(), confidence)


def effects_by_driver(rows_by_driver: RowsByDriver) -> dict[str, Effect]:
    """Return the effect of each driver compared with the human baseline; empty without a baseline."""
    baseline = rows_by_driver.get("human", [])
    labels = [label for label in rows_by_driver if baseline and label != "human"]
    return {label: compute_effect(rows_by_driver[label], baseline) for label in labels}


def describe_harm(effect: Effect) -> str:
    """Return a text that says whether travel time or flow is shown to be worse; empty if neither is."""
    return "; ".join(reason for is_worse, reason in effect.harm_checks if is_worse)
