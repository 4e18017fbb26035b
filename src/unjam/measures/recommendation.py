"""Recommendation of a controller for a road, and the findings of an assessment as text.

A controller is recommended only if travel time is shown to be shorter than in the human baseline and than with ACC
vehicles at the same penetration rate, flow is shown not to be lower, the CAVs are feasible, and human drivers do not
brake hard more often. A difference of travel time that is shown to be below 0.5 % is neither a gain nor harm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite
from operator import attrgetter
from typing import NamedTuple

from unjam.measures.effect import MAX_FLOW_LOSS, TIME_METRIC, TOO_SMALL, Effect, format_seconds, is_too_small
from unjam.measures.feasibility import FEASIBLE, EpisodeRows
from unjam.measures.statistics import Estimate, format_difference, format_percent, metric_estimate
from unjam.text import format_count

MAX_TELEPORT_SHARE = 0.01
"""share of the baseline's vehicles above which teleports and removals by SUMO make travel times meaningless"""
MAX_CAV_SLOWDOWN = 0.1  # maximum relative loss of the CAVs' own speed compared with ACC vehicles
NEGLIGIBLE_DELAY_SHARE = 0.05
"""delay of the human baseline, relative to the free-flow travel time, up to which there is nothing to gain"""
MIN_VERDICT_SEEDS = 10  # minimum number of seeds of a reliable CI
RECOMMENDED, NOT_RECOMMENDED, UNDECIDED = "recommended", "not recommended", "not yet known"  # verdicts
ACC_BASELINE = "ACC vehicles alone"


def rejection_reasons(effect: Effect) -> list[str]:
    """Return all reasons against recommending a controller with this effect."""
    time, flow_text = effect.travel_time, format_difference(effect.flow)
    time_text = format_seconds(time)
    is_known = time.low > 0 or time.high < 0 or effect.is_too_small
    keeps_flow = effect.flow.high < 0 or effect.flow.low >= -MAX_FLOW_LOSS * effect.baseline_flow
    teleported = f"SUMO teleports or removes {100 * effect.baseline_teleport_share:.1f} % of the vehicles"
    teleports, contacts = (format_count(n, "more vehicle") for n in (effect.teleports, round(effect.collisions)))
    braking = f"{format_difference(effect.hard_braking)} times in a million vehicle-steps (a positive mean counts)"
    verb = "brake" if effect.hard_braking.low > 0 else "may brake"
    # With too few seeds CIs are NaN, all comparisons are false, and the checks fail.
    checks = (
        (
            time.count >= MIN_VERDICT_SEEDS or effect.is_infeasible,
            f"{format_count(time.count, 'test seed')}, where {MIN_VERDICT_SEEDS} are needed",
        ),
        (not effect.failed_episodes, f"{format_count(effect.failed_episodes, 'episode')} failed"),
        (not effect.early_ends, f"{format_count(effect.early_ends, 'episode')} ended early"),
        (
            effect.baseline_teleport_share <= MAX_TELEPORT_SHARE,
            f"nothing can be concluded: in the human baseline {teleported} (limit {100 * MAX_TELEPORT_SHARE:g} %)",
        ),
        (effect.teleports <= 0, f"{teleports} teleported or removed than without CAVs"),
        *((not is_worse, reason) for is_worse, reason in effect.harm_checks),
        (not effect.is_too_small, f"travel time differs from that of the human baseline by {TOO_SMALL}: {time_text}"),
        (is_known, f"travel time is not shown to be shorter than that of the human baseline: {time_text}"),
        (keeps_flow, f"flow may be lower by more than {100 * MAX_FLOW_LOSS:g} %: {flow_text} veh/h"),
        (effect.feasibility == FEASIBLE, f"infeasible: {effect.feasibility or 'no CAV drove'}"),
        (effect.collisions <= 0, f"{contacts} in contact than without CAVs"),
        (
            effect.hard_braking.mean <= 0,
            f"human drivers {verb} beyond 4.5 m/s² more often than in the human baseline: {braking}",
        ),
    )
    return [reason for is_fine, reason in checks if not is_fine]


def required_seeds(difference: Estimate, half_width: float) -> float:
    """Return the number of seeds with which a CI is expected to exclude zero or to be narrower than ±`half_width`.

    The mean is assumed to stay the same, and the width of the CI to fall with the square root of the number of seeds.
    Without a CI the result is infinite.
    """
    current, target = difference.half_width, max(abs(difference.mean), half_width)
    if not isfinite(current):
        return inf
    return max(float(MIN_VERDICT_SEEDS), ceil(difference.count * (current / target) ** 2) if current else 0.0)


@dataclass(frozen=True)
class AccResult:
    """Effect of ACC vehicles without a controller at a penetration rate, on test seeds."""

    penetration_rate: float
    effect: Effect
    property_effect: Estimate | None = None
    """difference of travel time to ACC vehicles with all properties of the vehicles that they replace [s]; None: the
    ACC vehicles already have these properties"""
    missing_seeds: float = 0.0  # number of further test seeds until the CI is narrow enough

    @property
    def has_enough_seeds(self) -> bool:
        """Whether the CI has enough seeds for a finding."""
        return self.effect.travel_time.count >= MIN_VERDICT_SEEDS

    @property
    def needs_comment(self) -> bool:
        """Whether ACC vehicles are infeasible or have other properties than the vehicles that they replace."""
        return self.effect.feasibility != FEASIBLE or self.property_effect is not None

    @property
    def summary(self) -> str:
        """The finding as text."""
        time = self.effect.travel_time
        change = "is longer" if time.low > 0 else "is shorter" if time.high < 0 else "is not shown to differ"
        if not self.has_enough_seeds:
            seeds = format_count(time.count, "test seed")
            change = f"is not shown to differ ({seeds}, where {MIN_VERDICT_SEEDS} are needed)"
        elif self.effect.is_too_small:
            change = f"differs by {TOO_SMALL},"
        label = f"{ACC_BASELINE} at a penetration rate of {format_percent(self.penetration_rate)}"
        text = f"{label}: travel time {change} compared with the human baseline. Differences: {self.effect.summary}."
        if self.effect.feasibility != FEASIBLE:
            text += f" ACC vehicles are infeasible themselves: {self.effect.feasibility or 'no CAV drove'}."
        if self.property_effect is None:
            return text
        return f"{text} The properties set for CAVs change {format_seconds(self.property_effect)} of travel time."


@dataclass(frozen=True)
class ControllerResult:
    """Effect of the controller selected for a penetration rate, on test seeds."""

    penetration_rate: float
    driver: str
    effect: Effect
    difference_to_acc: Estimate  # difference of travel time to ACC vehicles at the same penetration rate [s]
    flow_difference_to_acc: Estimate  # difference of flow to the same ACC vehicles [veh/h]
    missing_seeds: float = 0.0  # number of further test seeds until a verdict is possible
    cav_speed_change: Estimate | None = None
    """difference of the mean speed of CAVs to the same ACC vehicles, relative to it; None: unknown"""

    @property
    def reasons(self) -> list[str]:
        """Reasons against a recommendation, from the effect and from the comparison with ACC vehicles."""
        difference, reasons = self.difference_to_acc, rejection_reasons(self.effect)
        acc = f"with {ACC_BASELINE} at this penetration rate"
        if difference.low == difference.high == 0.0:
            reasons.append(f"the controller never intervened: all travel times are those of {ACC_BASELINE}")
        elif is_too_small(difference, self.effect.baseline_travel_time):
            reasons.append(f"travel time differs from that {acc} by {TOO_SMALL}: {format_seconds(difference)}")
        elif not difference.high < 0:
            relation = "longer than" if difference.low > 0 else "not shown to be shorter than"
            reasons.append(f"travel time is {relation} {acc}: {format_seconds(difference)}")
        if self.cav_speed_change is not None and self.cav_speed_change.high < -MAX_CAV_SLOWDOWN:
            slower = f"{-100 * self.cav_speed_change.mean:.0f} % slower than {ACC_BASELINE}"
            reasons.append(f"the CAVs themselves are {slower} (limit {100 * MAX_CAV_SLOWDOWN:g} %)")
        return reasons

    @property
    def verdict(self) -> str:
        """The verdict on the controller: `RECOMMENDED`, `NOT_RECOMMENDED` or `UNDECIDED`."""
        return RECOMMENDED if not self.reasons else UNDECIDED if self.missing_seeds else NOT_RECOMMENDED

    @property
    def label(self) -> str:
        """The controller and its penetration rate."""
        return f"{self.driver} at a penetration rate of {format_percent(self.penetration_rate)}"

    @property
    def open_question(self) -> str:
        """The comparison that prevents a verdict, as a clause: with ACC vehicles or human drivers."""
        comparisons = (self.difference_to_acc, ACC_BASELINE), (self.effect.travel_time, "the human baseline")

        def badness(comparison: tuple[Estimate, str]) -> tuple[bool, bool, bool, float]:
            difference, _ = comparison
            contains_zero = difference.low <= 0 <= difference.high
            return difference.low > 0, difference.mean >= 0, contains_zero, difference.half_width

        difference, baseline = max(comparisons, key=badness)
        seeds = f"with {format_count(difference.count, 'test seed')}"
        if difference.count < MIN_VERDICT_SEEDS:
            seeds += f", where a verdict needs {MIN_VERDICT_SEEDS}"
        longer = ", so far longer" if difference.low > 0 else ""
        return f"{seeds}, the difference of travel time to {baseline} is {format_seconds(difference)}{longer}"

    @property
    def summary(self) -> str:
        """The finding as text."""
        if self.verdict == UNDECIDED:
            return f"{self.label}: {UNDECIDED}: {self.open_question}."
        if self.reasons:
            return f"{self.label}: {NOT_RECOMMENDED}: {'; '.join(self.reasons)}."
        effect = self.effect
        return (
            f"{self.label}: recommended. Travel time {format_seconds(effect.travel_time)} "
            f"({100 * effect.relative_travel_time:+.1f} %), flow {format_difference(effect.flow)} veh/h, fuel "
            f"{format_difference(effect.fuel, 1)} ml/km compared with the human baseline; travel time "
            f"{format_seconds(self.difference_to_acc)} compared with {ACC_BASELINE}; "
            f"{effect.travel_time.count} test seeds."
        )


def recommended_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return the recommended result with the shortest travel time; None if none is recommended."""
    return _quickest([result for result in results if not result.reasons])


def _quickest(results: Sequence[ControllerResult]) -> ControllerResult | None:
    return min(results, key=lambda result: result.effect.relative_travel_time, default=None)


def plotted_result(results: Sequence[ControllerResult]) -> ControllerResult | None:
    """Return the result to plot: the recommended one, else the one with the shortest travel time."""
    return recommended_result(results) or _quickest(results)


class RoadVerdict(NamedTuple):
    """The answer of an assessment."""

    verdict: str
    sentence: str  # the answer in one sentence


def road_verdict(results: Sequence[ControllerResult], baseline: EpisodeRows = ()) -> RoadVerdict:
    """Return the answer of an assessment: the recommended controller, or the reason why none is recommended.

    `baseline` has the rows of the human baseline, which show whether traffic is nearly free-flowing.
    """
    best = recommended_result(results)
    if best is not None:
        time, to_acc = best.effect.travel_time.mean, best.difference_to_acc.mean
        share = 100 * abs(best.effect.relative_travel_time)
        gain = f"{-time:.1f} s ({share:.1f} %) shorter than in human-only traffic"
        reason = f"travel time is {gain} and {-to_acc:.1f} s shorter than with {ACC_BASELINE}"
        return RoadVerdict(RECOMMENDED, f"Recommended: {best.label}, because {reason}.")
    travel_time, delay = (metric_estimate(baseline, name).mean for name in (TIME_METRIC, "delay"))
    if (delay_share := delay / (travel_time - delay)) <= NEGLIGIBLE_DELAY_SHARE:
        percent = max(1, ceil(100 * delay_share))
        reason = f"there is nothing to gain, because human-only traffic is within {percent} % of free flow"
    elif undecided := [result for result in results if result.verdict == UNDECIDED]:
        best, fastest = _quickest(undecided) or undecided[0], ", the fastest so far" if len(undecided) > 1 else ""
        sentence = f"Not yet known whether to recommend {best.label}{fastest}: {best.open_question}."
        return RoadVerdict(UNDECIDED, sentence)
    elif best := _quickest(results):
        reason = f"no controller passes the rule; the fastest is {best.label}, but {best.reasons[0]}"
    else:
        reason = "no controller was tested, or all were rejected on the tuning seeds"
    return RoadVerdict(NOT_RECOMMENDED, f"Not recommended: {reason}.")


def acc_finding(results: Sequence[AccResult]) -> str:
    """Return the finding on ACC vehicles alone as a sentence."""
    return f"{ACC_BASELINE} {_acc_effect([result for result in results if result.has_enough_seeds])}."


def _acc_effect(results: Sequence[AccResult]) -> str:
    """Return the predicate of a sentence on ACC vehicles alone: the largest gain, or else the largest loss."""
    relative_time = attrgetter("effect.relative_travel_time")
    gains = [result for result in results if result.effect.travel_time.high < 0 and not result.effect.is_too_small]
    losses = [result for result in results if result.effect.is_longer]
    if gains or losses:
        verb = "shorten" if gains else "lengthen"
        result = min(gains, key=relative_time) if gains else max(losses, key=relative_time)
        time, percent = format_seconds(result.effect.travel_time), 100 * result.effect.relative_travel_time
        return f"{verb} travel time: {time} ({percent:+.1f} %) at {format_percent(result.penetration_rate)}"
    if results and all(result.effect.is_too_small for result in results):
        return f"change travel time by {TOO_SMALL}"
    return "are not shown to shorten travel time" if results else f"have fewer than {MIN_VERDICT_SEEDS} test seeds"
