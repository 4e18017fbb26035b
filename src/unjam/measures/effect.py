"""What CAVs change on a road, compared with the human baseline and with ACC vehicles on the same seeds.

One rule holds for all roads. A controller is recommended only if travel time is shown to be shorter than with
human drivers alone and than with ACC vehicles at the same penetration rate, flow is shown not to be lower, the
CAVs are feasible, and human drivers do not brake hard more often. A travel-time difference that is shown to be
below 0.5 % is no gain and no harm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite, nan
from operator import attrgetter
from typing import Any

import numpy as np

from unjam.measures.feasibility import FEASIBLE, HARD_BRAKING_METRIC, overall_feasibility
from unjam.measures.statistics import (
    CONFIDENCE,
    Estimate,
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

MAX_FLOW_LOSS = 0.01
"""loss that the CI must exclude, as a share of the baseline's flow"""
SMALLEST_EFFECT = 0.005
"""travel-time difference that is too small to matter, as a share of the baseline's travel time"""
MAX_TELEPORT_SHARE = 0.01
"""share of the baseline's vehicles that SUMO may teleport or remove; more of them distort all travel times"""
NEGLIGIBLE_DELAY_SHARE = 0.05
"""delay up to which nothing can be gained on a road, as a share of the free-flow travel time"""
MIN_VERDICT_SEEDS = 10
"""fewest seeds for a recommendation; the CI of fewer is not reliable"""

TIME_METRIC, FLOW_METRIC, FUEL_METRIC = "travel_time", "outflow_veh_per_h", "fuel_ml_per_km"
NO_RECOMMENDATION = "No controller is recommended on this road"
TOO_SMALL = f"less than {100 * SMALLEST_EFFECT:g} %, which is too small to matter"


@dataclass(frozen=True)
class Effect:
    """CAVs compared with the human baseline: paired differences."""

    travel_time: Estimate
    """[s] per vehicle of the demand, departure delay included"""
    flow: Estimate
    """[veh/h]"""
    fuel: Estimate
    """[ml/km]"""
    hard_braking: Estimate
    """human drivers' vehicle-steps with braking beyond 4.5 m/s2 [per million]"""
    collisions: float
    """difference of vehicles in contact, all episodes together"""
    failed_episodes: int
    """episodes that did not run"""
    feasibility: str
    """verdict on the CAVs themselves: `FEASIBLE`, or the first reason against it"""
    baseline_travel_time: float
    """mean travel time of the human baseline on these seeds [s]"""
    baseline_flow: float
    """[veh/h]"""
    delay_reduction: Estimate
    """as a share of the delay of the human baseline; NaN if that is unknown or zero"""
    speed: Estimate
    """mean speed of all vehicles [m/s]"""
    early_ends: int = 0
    """episodes that ran but ended early, with or without CAVs; only complete ones are compared"""
    teleports: int = 0
    """vehicles that SUMO teleported or removed beyond those of the human baseline, all episodes together"""
    baseline_teleport_share: float = 0.0
    """teleports and removals of the human baseline, as a share of its vehicles"""

    @property
    def summary(self) -> str:
        """Travel time (on closed roads speed), flow and fuel of all vehicles, on one line."""
        time = f"travel time {_seconds(self.travel_time)}"
        if self.delay_reduction.count and (self.travel_time.high < 0 or self.travel_time.low > 0):
            less = f"{format_share(self.delay_reduction)} less delay"
            time += f" ({less if self.travel_time.high < 0 else 'more delay'})"
        first = time if self.travel_time.count else f"mean speed {format_difference(self.speed, 2)} m/s"
        loss = ": a loss, whatever the speed" if self.flow.high < 0 else ""
        return f"{first}, flow {format_difference(self.flow)} veh/h{loss}, fuel {format_difference(self.fuel, 1)} ml/km"

    @property
    def relative_half_width(self) -> float:
        """Half the width of the CI of travel time, as a share of the baseline's travel time; NaN without a CI."""
        return self.travel_time.half_width / self.baseline_travel_time

    @property
    def relative_travel_time(self) -> float:
        """Difference of travel time, as a share of the baseline's."""
        return self.travel_time.mean / self.baseline_travel_time

    @property
    def is_too_small(self) -> bool:
        """Whether the difference of travel time is shown to be too small to matter."""
        return is_too_small(self.travel_time, self.baseline_travel_time)

    @property
    def is_longer(self) -> bool:
        """Whether travel time is shown to be longer by more than that."""
        return self.travel_time.low > 0 and not self.is_too_small


def _seconds(difference: Estimate) -> str:
    return f"{format_difference(difference, 1)} s"


def is_too_small(difference: Estimate, baseline_time: float) -> bool:
    """Return whether the whole CI of a difference is within ±0.5 % of the baseline's travel time [s]."""
    limit = SMALLEST_EFFECT * baseline_time
    return -limit < difference.low and difference.high < limit


def effect_of(
    rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]], confidence: float = CONFIDENCE
) -> Effect:
    """Return the effect of a driver compared with the human baseline, from their rows of `measure`.

    The baseline may have more seeds; only common ones count.
    """
    seeds = {str(row["seed"]) for row in rows}
    baseline = [row for row in baseline if str(row["seed"]) in seeds]
    ran, baseline_ran = ([row for row in each if row["status"] != "failed"] for each in (rows, baseline))
    metrics = TIME_METRIC, FLOW_METRIC, FUEL_METRIC, HARD_BRAKING_METRIC
    differences = (paired_difference(rows, baseline, name, confidence) for name in metrics)
    teleports, baseline_teleports = (sum(row.get("teleports", 0) for row in each) for each in (rows, baseline))
    return Effect(
        *differences,
        collisions=float(sum(row["collisions"] for row in ran) - sum(row["collisions"] for row in baseline_ran)),
        failed_episodes=len(rows) - len(ran),
        feasibility=overall_feasibility([{**row, HARD_BRAKING_METRIC: 0.0} for row in rows]),
        baseline_travel_time=metric_estimate(baseline, TIME_METRIC).mean,
        baseline_flow=metric_estimate(baseline, FLOW_METRIC).mean,
        delay_reduction=_delay_reduction(rows, baseline, confidence),
        speed=paired_difference(rows, baseline, "mean_speed", confidence),
        early_ends=sum(map(has_ended_early, [*rows, *baseline])),
        teleports=teleports - baseline_teleports,
        baseline_teleport_share=baseline_teleports / max(1, sum(row.get("vehicles", 0) for row in baseline)),
    )


def _delay_reduction(rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]], confidence: float) -> Estimate:
    pairs = [
        (metric_value(human, TIME_METRIC) - metric_value(row, TIME_METRIC), metric_value(human, "delay"))
        for row, human in pair_rows(rows, baseline)
    ]
    saved, delays = np.array([each for each in pairs if np.isfinite(each).all()]).reshape(-1, 2).T
    if not len(delays) or delays.mean() <= 0:
        return Estimate(nan, nan, nan, 0)
    return estimate(linearized_ratio(saved, delays).tolist(), confidence)


def effects_by_driver(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, Effect]:
    """Return the effect of each driver compared with the human baseline; empty without a baseline."""
    baseline = rows_by_driver.get("human", [])
    others = ((label, rows) for label, rows in rows_by_driver.items() if label != "human")
    return {label: effect_of(rows, baseline) for label, rows in others} if baseline else {}


def describe_harm(effect: Effect) -> str:
    """Return what CAVs are shown to make worse, travel time or flow; or an empty text."""
    return "; ".join(reason for is_worse, reason in _harm_checks(effect) if is_worse)


def _harm_checks(effect: Effect) -> tuple[tuple[bool, str], ...]:
    """Return for travel time and flow whether they are shown to be worse, with the text for it."""
    longer = f"travel time is longer than that of the human baseline: {_seconds(effect.travel_time)}"
    lower = f"flow is lower than that of the human baseline: {format_difference(effect.flow)} veh/h"
    return (effect.is_longer, longer), (effect.flow.high < 0, lower)


def rejection_reasons(effect: Effect) -> list[str]:
    """Return all reasons against a recommendation."""
    time, max_loss = _seconds(effect.travel_time), MAX_FLOW_LOSS * effect.baseline_flow
    # The conditions are written so that NaN, the result of too few seeds, is a reason against.
    checks = (
        (effect.travel_time.count >= MIN_VERDICT_SEEDS, f"{effect.travel_time.count} test seeds are too few"),
        (not effect.failed_episodes, f"{effect.failed_episodes} episodes failed"),
        (not effect.early_ends, f"{effect.early_ends} episodes ended early"),
        (
            effect.baseline_teleport_share <= MAX_TELEPORT_SHARE,
            f"nothing can be concluded: in the human baseline SUMO teleports or removes "
            f"{100 * effect.baseline_teleport_share:.1f} % of the vehicles (limit {100 * MAX_TELEPORT_SHARE:g} %)",
        ),
        (effect.teleports <= 0, f"{effect.teleports} more vehicles teleported or removed than without CAVs"),
        *((not is_worse, reason) for is_worse, reason in _harm_checks(effect)),
        (not effect.is_too_small, f"travel time differs from that of the human baseline by {TOO_SMALL}: {time}"),
        (
            effect.travel_time.low > 0 or effect.travel_time.high < 0 or effect.is_too_small,
            f"travel time is not shown to be shorter than that of the human baseline: {time}",
        ),
        (
            effect.flow.high < 0 or effect.flow.low >= -max_loss,
            f"flow may be lower by more than {100 * MAX_FLOW_LOSS:g} %: {format_difference(effect.flow)} veh/h",
        ),
        (effect.feasibility == FEASIBLE, f"infeasible: {effect.feasibility or 'no CAV drove'}"),
        (effect.collisions <= 0, f"{effect.collisions:.0f} more vehicles in contact than without CAVs"),
        (
            effect.hard_braking.mean <= 0,
            "human drivers brake beyond 4.5 m/s² more often than in the human baseline: "
            f"{format_difference(effect.hard_braking)} times in a million vehicle-steps (the sign of the mean counts)",
        ),
    )
    return [reason for is_fine, reason in checks if not is_fine]


def required_seeds(difference: Estimate, half_width: float) -> float:
    """Return the number of seeds with which a CI would exclude zero or be narrower than ±`half_width`.

    It is assumed that the mean stays and that the CI narrows with the square root of the seeds; infinite
    without a CI.
    """
    half, target = difference.half_width, max(abs(difference.mean), half_width)
    if not isfinite(half):
        return inf
    return max(float(MIN_VERDICT_SEEDS), ceil(difference.count * (half / target) ** 2) if half else 0.0)


@dataclass(frozen=True)
class AccResult:
    """Effect of ACC vehicles without a controller at a penetration rate, on test seeds."""

    penetration_rate: float
    effect: Effect
    property_effect: Estimate | None = None
    """travel time compared with ACC vehicles that keep all properties of the vehicles that they replace [s];
    None: they keep them"""
    missing_seeds: float = 0.0
    """additional test seeds that a verdict needs"""

    @property
    def has_enough_seeds(self) -> bool:
        """Whether the CI has enough seeds for a finding."""
        return self.effect.travel_time.count >= MIN_VERDICT_SEEDS

    @property
    def summary(self) -> str:
        """The finding as text."""
        time = self.effect.travel_time
        change = "is longer" if time.low > 0 else "is shorter" if time.high < 0 else "is not shown to differ"
        if not self.has_enough_seeds:
            change = f"is not shown to differ ({time.count} test seeds are too few)"
        elif self.effect.is_too_small:
            change = f"differs by {TOO_SMALL},"
        text = (
            f"ACC vehicles alone at a penetration rate of {format_percent(self.penetration_rate)}: travel time "
            f"{change} compared with the human baseline. "
            f"Differences: {self.effect.summary}{_missing_seeds_text(self.missing_seeds, time, 2)}."
        )
        if self.effect.feasibility != FEASIBLE:
            text += f" They are infeasible themselves: {self.effect.feasibility or 'no CAV drove'}."
        if self.property_effect is None:
            return text
        return f"{text} The properties set for CAVs change {_seconds(self.property_effect)} of travel time."


@dataclass(frozen=True)
class ControllerResult:
    """Effect of the controller that was selected for a penetration rate, on test seeds."""

    penetration_rate: float
    driver: str
    effect: Effect
    difference_to_acc: Estimate
    """travel time compared with ACC vehicles at the same penetration rate [s]"""
    missing_seeds: float = 0.0
    """additional test seeds that a verdict needs"""

    @property
    def reasons(self) -> list[str]:
        """Reasons against a recommendation."""
        change, reasons = self.difference_to_acc, rejection_reasons(self.effect)
        acc = "with ACC vehicles alone at this penetration rate"
        if change.low == change.high == 0.0:
            reasons.append("it never intervened: all travel times are those of ACC vehicles alone")
        elif is_too_small(change, self.effect.baseline_travel_time):
            reasons.append(f"travel time differs from that {acc} by {TOO_SMALL}: {_seconds(change)}")
        elif not change.high < 0:
            relation = "longer than" if change.low > 0 else "not shown to be shorter than"
            reasons.append(f"travel time is {relation} {acc}: {_seconds(change)}")
        return reasons

    @property
    def summary(self) -> str:
        """The finding as text."""
        name = f"{self.driver} at a penetration rate of {format_percent(self.penetration_rate)}"
        if self.reasons:
            missing = _missing_seeds_text(self.missing_seeds, self.difference_to_acc, 3)
            return f"{name}: not recommended: {'; '.join(self.reasons)}{missing}."
        effect = self.effect
        return (
            f"{name}: recommended. Travel time {_seconds(effect.travel_time)} "
            f"({100 * effect.relative_travel_time:+.1f} %), flow {format_difference(effect.flow)} veh/h, fuel "
            f"{format_difference(effect.fuel, 1)} ml/km compared with the human baseline; travel time "
            f"{_seconds(self.difference_to_acc)} compared with ACC vehicles alone; "
            f"{effect.travel_time.count} test seeds."
        )


def _missing_seeds_text(missing_seeds: float, difference: Estimate, episodes_per_seed: int) -> str:
    """Return the width of a CI and the additional seeds that a verdict needs, as text."""
    if not missing_seeds:
        return ""
    if not isfinite(missing_seeds):
        return f"; no verdict yet: {difference.count} test seeds are too few for a confidence interval"
    episodes = f"{episodes_per_seed * missing_seeds:.0f} episodes"
    needed = f"a verdict needs about {missing_seeds:.0f} more test seeds ({episodes})"
    return f"; no verdict yet: the confidence interval is ±{difference.half_width:.1f} s, and {needed}"


def recommended_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return the recommended controller: the shortest travel time among those without a reason against them."""
    return _quickest([each for each in results if not each.reasons])


def _quickest(results: Sequence[ControllerResult]) -> ControllerResult | None:
    return min(results, key=lambda each: each.effect.relative_travel_time, default=None)


def plotted_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return the result to plot with the human baseline: the recommended one, else the shortest travel time."""
    return recommended_result(results) or _quickest(results)


def assessment_headline(
    results: Sequence[ControllerResult], acc_results: Sequence[AccResult], baseline: Sequence[dict[str, Any]] = ()
) -> str:
    """Return the answer: what is recommended, and the effect of ACC vehicles alone.

    `baseline` has the rows of the human baseline: on a nearly free road there is nothing to gain.
    """
    best = recommended_result(results)
    if best is not None:
        first = (
            f"Recommended on this road: {best.driver} at a penetration rate of "
            f"{format_percent(best.penetration_rate)}. Travel time {_seconds(best.effect.travel_time)} per vehicle "
            f"({100 * best.effect.relative_travel_time:+.1f} %) compared with the human baseline, "
            f"{_seconds(best.difference_to_acc)} compared with ACC vehicles alone."
        )
    elif not results:
        first = f"{NO_RECOMMENDATION}: none was tested, or all were rejected before the test."
    elif any(each.missing_seeds for each in results):
        first = f"{NO_RECOMMENDATION} so far: for some of them there is no verdict yet."
    else:
        first = f"{NO_RECOMMENDATION}: none passes the rule."
    second = _acc_finding([each for each in acc_results if each.has_enough_seeds])
    if best is None:
        travel_time, delay = (metric_estimate(baseline, name).mean for name in (TIME_METRIC, "delay"))
        if (delay_share := delay / (travel_time - delay)) <= NEGLIGIBLE_DELAY_SHARE:
            within = max(1, ceil(100 * delay_share))
            return f"Nothing to gain here: the human baseline is within {within} % of free flow. {first}"
    return f"{first} ACC vehicles alone {second}."


def _acc_finding(results: Sequence[AccResult]) -> str:
    """Return the end of a sentence on ACC vehicles alone: their largest gain, else their largest loss."""
    key = attrgetter("effect.relative_travel_time")
    gains = [each for each in results if each.effect.travel_time.high < 0 and not each.effect.is_too_small]
    losses = [each for each in results if each.effect.is_longer]
    if gains or losses:
        verb, most = ("shorten", min(gains, key=key)) if gains else ("lengthen", max(losses, key=key))
        time, change = _seconds(most.effect.travel_time), 100 * most.effect.relative_travel_time
        return f"{verb} travel time: {time} ({change:+.1f} %) at {format_percent(most.penetration_rate)}"
    if results and all(each.effect.is_too_small for each in results):
        return f"change travel time by {TOO_SMALL}"
    return "are not shown to shorten travel time" if results else f"have fewer than {MIN_VERDICT_SEEDS} test seeds"


def format_percent(share: float) -> str:
    """Return a share as text."""
    return f"{100 * share:g} %"
