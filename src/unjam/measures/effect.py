"""What CAVs change on a road, compared with the human baseline and with ACC vehicles on the same seeds.

The rule is one for all roads. A controller is recommended only where travel time is shown to be shorter than
with human drivers alone and than with ACC vehicles at the same penetration rate, flow is shown not to be
lower, the CAVs are feasible, and human drivers do not brake hard more often. A difference of travel time that
is shown to be smaller than 0.5 % is no gain and no harm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, isfinite, nan
from typing import Any

import numpy as np

from unjam.measures.feasibility import FEASIBLE, overall_feasibility
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
"""share of people's flow that the interval must exclude as a loss"""
SMALLEST_EFFECT = 0.005
"""share of the baseline's travel time below which a difference is too small to matter"""
MAX_TELEPORT_SHARE = 0.01
"""share of the baseline's vehicles that SUMO may teleport or remove: more of them distort all travel times"""
NEGLIGIBLE_DELAY_SHARE = 0.05
"""delay as a share of the free travel time up to which a road has nothing to gain"""
MIN_VERDICT_SEEDS = 10
"""seeds without which nothing is recommended: an interval of fewer is too narrow to be trusted"""

TIME_METRIC, FLOW_METRIC, FUEL_METRIC = "travel_time", "outflow_veh_per_h", "fuel_ml_per_km"
HARD_BRAKING_METRIC = "human_braking_beyond_4_5"
NO_RECOMMENDATION = "No controller is recommended on this road"
TOO_SMALL = f"less than {100 * SMALLEST_EFFECT:g} %, which is too small to matter"


@dataclass(frozen=True)
class Effect:
    """CAVs against people alone: differences with the same seeds paired."""

    travel_time: Estimate
    """[s] per vehicle that wanted to drive, waiting included"""
    flow: Estimate
    """[veh/h]"""
    fuel: Estimate
    """[ml/km]"""
    hard_braking: Estimate
    """people's moments of braking beyond 4.5 m/s2 [per million]"""
    collisions: float
    """vehicles in contact, all episodes together"""
    failed_episodes: int
    """episodes that did not run"""
    feasibility: str
    """verdict on the CAVs themselves: `feasibility`, or the first reason why not"""
    baseline_travel_time: float
    """mean travel time of people alone on these seeds [s]"""
    baseline_flow: float
    """[veh/h]"""
    delay_reduction: Estimate
    """share of people's delay beyond a free road that is saved; NaN where it is not known, or none"""
    speed: Estimate
    """mean speed of all vehicles [m/s]"""
    early_ends: int = 0
    """episodes that ran, but ended early, with or without CAVs: only complete ones are compared"""
    teleports: int = 0
    """vehicles that SUMO teleported or removed beyond those of the human baseline, all episodes together"""
    baseline_teleport_share: float = 0.0
    """teleports and removals of the human baseline, as a share of its vehicles"""

    @property
    def summary(self) -> str:
        """What everybody on the road gains, in a line: time, flow and fuel, or speed where nobody leaves."""
        time = f"travel time {format_difference(self.travel_time, 1)} s"
        if self.delay_reduction.count and (self.travel_time.high < 0 or self.travel_time.low > 0):
            less = f"{format_share(self.delay_reduction)} less delay"
            time += f" ({less if self.travel_time.high < 0 else 'more delay'})"
        first = time if self.travel_time.count else f"mean speed {format_difference(self.speed, 2)} m/s"
        lost = ": a loss, whatever the speed" if self.flow.high < 0 else ""
        return f"{first}, flow {format_difference(self.flow)} veh/h{lost}, fuel {format_difference(self.fuel, 1)} ml/km"

    @property
    def relative_half_width(self) -> float:
        """Half the interval of travel time, as a share of people's travel time; NaN of one seed."""
        return (self.travel_time.high - self.travel_time.low) / 2.0 / self.baseline_travel_time

    @property
    def relative_travel_time(self) -> float:
        """Difference of travel time, as a share of people's."""
        return self.travel_time.mean / self.baseline_travel_time

    @property
    def is_too_small(self) -> bool:
        """Whether the difference of travel time is shown to be too small to matter."""
        return is_too_small(self.travel_time, self.baseline_travel_time)


def is_too_small(difference: Estimate, baseline_time: float) -> bool:
    """Return whether the whole interval of a difference is below 0.5 % of the baseline's travel time [s]."""
    least = SMALLEST_EFFECT * baseline_time
    return -least < difference.low and difference.high < least


def effect_of(
    rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]], confidence: float = CONFIDENCE
) -> Effect:
    """Return what the rows of `measure` of a driver show beside those of people alone.

    People may have been driven on more seeds; only those that both have count.
    """
    seeds = {str(row["seed"]) for row in rows}
    baseline = [row for row in baseline if str(row["seed"]) in seeds]
    ran = [row for row in rows if row["status"] != "failed"]
    differences = (
        paired_difference(rows, baseline, name, confidence)
        for name in (TIME_METRIC, FLOW_METRIC, FUEL_METRIC, HARD_BRAKING_METRIC)
    )
    teleports, of_baseline = (sum(row.get("teleports", 0) for row in each) for each in (rows, baseline))
    return Effect(
        *differences,
        collisions=float(
            sum(row["collisions"] for row in ran)
            - sum(row["collisions"] for row in baseline if row["status"] != "failed")
        ),
        failed_episodes=len(rows) - len(ran),
        feasibility=overall_feasibility([{**row, HARD_BRAKING_METRIC: 0.0} for row in rows]),
        baseline_travel_time=metric_estimate(baseline, TIME_METRIC).mean,
        baseline_flow=metric_estimate(baseline, FLOW_METRIC).mean,
        delay_reduction=_delay_reduction(rows, baseline, confidence),
        speed=paired_difference(rows, baseline, "mean_speed", confidence),
        early_ends=sum(map(has_ended_early, [*rows, *baseline])),
        teleports=teleports - of_baseline,
        baseline_teleport_share=of_baseline / max(1, sum(row.get("vehicles", 0) for row in baseline)),
    )


def _delay_reduction(rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]], confidence: float) -> Estimate:
    both = [
        (metric_value(alone, TIME_METRIC) - metric_value(row, TIME_METRIC), metric_value(alone, "delay"))
        for row, alone in pair_rows(rows, baseline)
    ]
    saved, delays = np.array([each for each in both if np.isfinite(each).all()]).reshape(-1, 2).T
    if not len(delays) or delays.mean() <= 0:
        return Estimate(nan, nan, nan, 0)
    return estimate(linearized_ratio(saved, delays).tolist(), confidence)


def effects_by_driver(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, Effect]:
    """Return the effect of each driver beside people alone, where they are among the drivers."""
    people = rows_by_driver.get("human", [])
    others = ((label, rows) for label, rows in rows_by_driver.items() if label != "human")
    return {label: effect_of(rows, people) for label, rows in others} if people else {}


def describe_harm(effect: Effect) -> str:
    """Return what CAVs are shown to make worse, travel time or flow; empty where nothing is shown."""
    return "; ".join(words for worse, words in _harm_checks(effect) if worse)


def _harm_checks(effect: Effect) -> tuple[tuple[bool, str], ...]:
    """Return whether travel time and flow are shown to be worse, each with the words for it."""
    longer = f"travel time is longer than that of the human baseline: {format_difference(effect.travel_time, 1)} s"
    lower = f"flow is lower than that of the human baseline: {format_difference(effect.flow)} veh/h"
    return (effect.travel_time.low > 0 and not effect.is_too_small, longer), (effect.flow.high < 0, lower)


def rejection_reasons(effect: Effect) -> list[str]:
    """Return all reasons against recommending what was measured; none where there is nothing against it."""
    most = MAX_FLOW_LOSS * effect.baseline_flow
    # Written so that a NaN, of too few seeds, is a reason against.
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
        *((not worse, words) for worse, words in _harm_checks(effect)),
        (
            not effect.is_too_small,
            f"travel time differs from that of the human baseline by {TOO_SMALL}: {format_difference(effect.travel_time, 1)} s",
        ),
        (
            effect.travel_time.low > 0 or effect.travel_time.high < 0 or effect.is_too_small,
            "travel time is not shown to be shorter than that of the human baseline: "
            f"{format_difference(effect.travel_time, 1)} s",
        ),
        (
            effect.flow.high < 0 or effect.flow.low >= -most,
            f"flow may be lower by more than {100 * MAX_FLOW_LOSS:g} %: {format_difference(effect.flow)} veh/h",
        ),
        (effect.feasibility == FEASIBLE, f"infeasible: {effect.feasibility or 'no CAV drove'}"),
        (effect.collisions <= 0, f"{effect.collisions:.0f} more vehicles in contact than without CAVs"),
        (
            effect.hard_braking.mean <= 0,
            "human drivers brake beyond 4.5 m/s² more often than in the human baseline: "
            f"{format_difference(effect.hard_braking)} times in a million moments (only the sign of the mean counts)",
        ),
    )
    return [reason for fine, reason in checks if not fine]


def required_seeds(difference: Estimate, half_width: float) -> float:
    """Return with how many seeds an interval would exclude zero, or be narrower than ±`narrow`.

    The mean is taken to stay, and the interval to narrow with the square root of the seeds; infinite where
    there is no interval yet.
    """
    half = (difference.high - difference.low) / 2.0
    enough = max(abs(difference.mean), half_width)
    if not isfinite(half):
        return float("inf")
    return max(float(MIN_VERDICT_SEEDS), ceil(difference.count * (half / enough) ** 2) if half else 0.0)


@dataclass(frozen=True)
class AccResult:
    """What ACC vehicles without any controller do at a penetration rate, on test seeds."""

    penetration_rate: float
    effect: Effect
    property_effect: Estimate | None = None
    """travel time compared with ACC vehicles that keep all properties of the vehicles which they replace [s];
    None: these do"""
    missing_seeds: float = 0.0
    """test seeds that a verdict would need in addition"""

    @property
    def summary(self) -> str:
        """The finding, in a sentence or two."""
        time = self.effect.travel_time
        shown = "is longer" if time.low > 0 else "is shorter" if time.high < 0 else "is not shown to differ"
        if self.effect.is_too_small:
            shown = f"differs by {TOO_SMALL},"
        words = (
            f"ACC vehicles alone at a penetration rate of {format_percent(self.penetration_rate)}: travel time {shown} "
            "compared with the human baseline. "
            f"Differences: {self.effect.summary}{_missing_seeds_text(self.missing_seeds, time, 2)}."
        )
        if self.property_effect is None:
            return words
        other = f"{format_difference(self.property_effect, 1)} s of travel time"
        return f"{words} Of it the properties that you have set for CAVs change {other}."


@dataclass(frozen=True)
class ControllerResult:
    """The controller that was chosen for a penetration rate, on test seeds."""

    penetration_rate: float
    driver: str
    effect: Effect
    difference_to_acc: Estimate
    """travel time compared with ACC vehicles at the same penetration rate [s]"""
    missing_seeds: float = 0.0
    """test seeds that a verdict would need in addition"""

    @property
    def reasons(self) -> list[str]:
        """Why it is not recommended; none where it is."""
        beyond, reasons = self.difference_to_acc, rejection_reasons(self.effect)
        if is_too_small(beyond, self.effect.baseline_travel_time):
            reasons.append(
                "travel time differs from that with ACC vehicles alone at this penetration rate by "
                f"{TOO_SMALL}: {format_difference(beyond, 1)} s"
            )
        elif not beyond.high < 0:
            shown = "longer than" if beyond.low > 0 else "not shown to be shorter than"
            difference = format_difference(beyond, 1)
            reasons.append(f"travel time is {shown} with ACC vehicles alone at this penetration rate: {difference} s")
        return reasons

    @property
    def summary(self) -> str:
        """What is said of this penetration rate, in a sentence or two."""
        name = f"{self.driver} at a penetration rate of {format_percent(self.penetration_rate)}"
        if self.reasons:
            unknown = _missing_seeds_text(self.missing_seeds, self.difference_to_acc, 3)
            return f"{name}: not recommended: {'; '.join(self.reasons)}{unknown}."
        found = self.effect
        return (
            f"{name}: recommended. Travel time {format_difference(found.travel_time, 1)} s "
            f"({100 * found.relative_travel_time:+.1f} %), flow {format_difference(found.flow)} veh/h, fuel "
            f"{format_difference(found.fuel, 1)} ml/km compared with the human baseline; travel time "
            f"{format_difference(self.difference_to_acc, 1)} s compared with ACC vehicles alone; "
            f"{found.travel_time.count} test seeds."
        )


def _missing_seeds_text(missing_seeds: float, difference: Estimate, episodes_per_seed: int) -> str:
    """Return how wide an interval is, and what a verdict needs at so many `episodes` a seed."""
    if not missing_seeds:
        return ""
    half = (difference.high - difference.low) / 2.0
    if not isfinite(missing_seeds):
        return f"; no verdict yet: {difference.count} test seeds are too few for an interval"
    needed = (
        f"a verdict needs about {missing_seeds:.0f} more test seeds ({episodes_per_seed * missing_seeds:.0f} episodes)"
    )
    return f"; no verdict yet: the interval is ±{half:.1f} s, and {needed}"


def recommended_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return what is recommended: the shortest travel time among those that pass."""
    return min(
        (each for each in results if not each.reasons), key=lambda each: each.effect.relative_travel_time, default=None
    )


def plotted_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return whose traffic pictures show with the human baseline's: the recommended, else the quickest."""
    quickest = min(results, key=lambda each: each.effect.relative_travel_time, default=None)
    return recommended_result(results) or quickest


def free_flow_note(baseline: Sequence[dict[str, Any]]) -> str:
    """Return a sentence where the rows of the human baseline have hardly any delay; else an empty text."""
    time, delay = (metric_estimate(baseline, name).mean for name in (TIME_METRIC, "delay"))
    above_free = delay / (time - delay)
    if not above_free <= NEGLIGIBLE_DELAY_SHARE:
        return ""
    within = max(1, ceil(100 * above_free))
    return f"Nothing to gain here: the human baseline is within {within} % of free flow. "


def assessment_headline(
    results: Sequence[ControllerResult], acc_results: Sequence[AccResult], baseline: Sequence[dict[str, Any]] = ()
) -> str:
    """Return the answer: what is recommended, and what ACC vehicles alone would do.

    `baseline` has the rows of the human baseline: on a nearly free road there is nothing to gain.
    """
    best = recommended_result(results)
    if best is not None:
        first = (
            f"Recommended on this road: {best.driver} at a penetration rate of {format_percent(best.penetration_rate)}. "
            f"Travel time {format_difference(best.effect.travel_time, 1)} s a vehicle "
            f"({100 * best.effect.relative_travel_time:+.1f} %) compared with the human baseline, "
            f"{format_difference(best.difference_to_acc, 1)} s compared with ACC vehicles alone."
        )
    elif not results:
        first = f"{NO_RECOMMENDATION}: none was tested, or all were set aside before the test."
    elif any(each.missing_seeds for each in results):
        first = f"{NO_RECOMMENDATION} so far: for some of them there is no verdict yet."
    else:
        first = f"{NO_RECOMMENDATION}: none passes the rule."
    gains = [each for each in acc_results if each.effect.travel_time.high < 0 and not each.effect.is_too_small]
    if gains:
        most = min(gains, key=lambda each: each.effect.relative_travel_time)
        time, cut = format_difference(most.effect.travel_time, 1), 100 * most.effect.relative_travel_time
        second = f"shorten travel time: {time} s ({cut:+.1f} %) at {format_percent(most.penetration_rate)}"
    elif any(each.effect.travel_time.low > 0 and not each.effect.is_too_small for each in acc_results):
        second = "lengthen travel time"
    elif acc_results and all(each.effect.is_too_small for each in acc_results):
        second = f"change travel time by {TOO_SMALL}"
    else:
        second = "are not shown to shorten travel time"
    if not best and (free := free_flow_note(baseline)):
        return free + first
    return f"{first} ACC vehicles alone {second}."


def format_percent(share: float) -> str:
    """Return a share as words say it."""
    return f"{100 * share:g} %"
