"""Selection of a controller for each penetration rate, and its comparison with the human baseline and ACC vehicles.

Controllers are selected by successive halving on selection seeds, and compared on test seeds.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, log2
from typing import Any, NamedTuple

from unjam.errors import raise_failure
from unjam.measures.effect import FLOW_METRIC, TIME_METRIC, Effect, compute_effect, describe_harm, is_too_small
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.recommendation import MIN_VERDICT_SEEDS, AccResult, ControllerResult, required_seeds
from unjam.measures.statistics import CONFIDENCE, Estimate, format_percent, paired_difference, relative_difference
from unjam.seeds import held_out_seeds, selection_seeds
from unjam.text import format_count, format_duration
from unjam.training.executors import MessageCallback

MAX_SELECTION_SEEDS = 10
"""maximum number of seeds of a round of successive halving"""
MIN_HARM_SEEDS = 6
"""minimum number of seeds to reject an option for harm"""
MIN_TEST_SEEDS = 3
"""minimum number of test seeds for a confidence interval"""
SELECTION_BUDGET_FRACTION = 0.4
"""maximum part of the budget for the selection"""

EpisodeSeed = tuple[int, ...]
OptionRows = list[dict[str, Any]]


class Option(NamedTuple):
    """A penetration rate and a driver of the CAVs."""

    penetration_rate: float
    driver: str

    @property
    def label(self) -> str:
        """Name in tables; the human baseline is `human`."""
        return f"{self.driver}, {format_percent(self.penetration_rate)}" if self.penetration_rate else self.driver


HUMAN_BASELINE = Option(0.0, "human")
ACC_DRIVER = "cruise"
"""driver of ACC vehicles without a controller"""
UNCHANGED_ACC_DRIVER = "acc with unchanged vehicles"
"""driver of ACC vehicles with the properties of the replaced vehicles instead of those that the user sets for CAVs"""
OptionRunner = Callable[[Sequence[Option], Sequence[EpisodeSeed]], dict[Option, OptionRows]]
"""runs options on seeds and returns their rows; if the time is up, only the rows of the first seeds"""


class EpisodeBudget:
    """Counts episodes, and estimates how many more episodes fit into the limits of number and time."""

    def __init__(
        self, episodes: int, minutes: float | None = None, workers: int = 1, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.episodes, self.minutes, self.used_episodes = episodes, minutes, 0
        self._workers, self._completed_rounds, self._clock, self._start_time = workers, 0, clock, clock()

    def spend(self, count: int, simulated_count: int | None = None) -> None:
        """Count episodes, of which `simulated_count` (None: all) have run in parallel, and the others were stored."""
        self.used_episodes += count
        self._completed_rounds += ceil((count if simulated_count is None else simulated_count) / self._workers)

    @property
    def elapsed_seconds(self) -> float:
        """Time since the start [s]."""
        return self._clock() - self._start_time

    def estimate_seconds(self, episodes: float) -> float:
        """Return the estimated duration of more episodes [s]."""
        return self.elapsed_seconds / max(1, self._completed_rounds) * ceil(episodes / self._workers)

    @property
    def remaining_seconds(self) -> float:
        """Estimated time until the budget is spent [s]."""
        seconds = self.estimate_seconds(self.episodes - self.used_episodes)
        return seconds if self.minutes is None else min(seconds, max(0.0, 60.0 * self.minutes - self.elapsed_seconds))

    def has_time_for(self, episodes: int) -> bool:
        """Return whether more episodes probably end within the time."""
        is_limited = self.minutes is not None and self._completed_rounds
        return not is_limited or self.elapsed_seconds + self.estimate_seconds(episodes) <= 60.0 * (self.minutes or 0.0)

    def affordable_seeds(self, option_count: int, fraction: float = 1.0) -> int:
        """Return the number of seeds on which a number of options can run within a fraction of the budget."""
        episodes = int(fraction * self.episodes + 1e-9) - self.used_episodes
        if self.minutes is not None and self._completed_rounds:
            rounds = (fraction * 60.0 * self.minutes - self.elapsed_seconds) / max(self.estimate_seconds(1), 1e-9)
            episodes = min(episodes, int(rounds) * self._workers)
        return max(0, episodes // option_count)


def seeds_at_once(option_count: int, workers: int) -> int:
    """Return the number of seeds on which a number of options keep all workers busy, at least one."""
    return max(1, workers // option_count)


@dataclass(frozen=True)
class Selection:
    """Result of the selection on selection seeds."""

    rows: dict[Option, OptionRows]
    rejection_reasons: dict[Option, str]
    finalists: list[Option]
    """selected options, at most one for each penetration rate"""

    def effect(self, option: Option) -> Effect:
        """Return the effect of an option relative to the human baseline on the same seeds."""
        return compute_effect(self.rows[option], self.rows[HUMAN_BASELINE])


def min_episodes(rate_count: int, driver_count: int, with_unchanged_acc: bool = False) -> int:
    """Return the smallest budget with which every option runs and the selected options are tested."""
    selection_episodes = 1 + rate_count * driver_count if driver_count > 1 else 0
    return selection_episodes + MIN_TEST_SEEDS * (1 + rate_count * (1 + bool(driver_count) + with_unchanged_acc))


def verdict_episodes(
    rate_count: int,
    driver_count: int,
    with_unchanged_acc: bool = False,
    seeds: int = MIN_VERDICT_SEEDS,
    undecided_rate_count: int = 0,
) -> int:
    """Return a budget that is enough for a number of test seeds after a selection with its maximum budget.

    All penetration rates run on the first `MIN_VERDICT_SEEDS`, and `undecided_rate_count` rates on all seeds.
    """
    options_per_rate = 1 + bool(driver_count) + with_unchanged_acc
    first_episodes = MIN_VERDICT_SEEDS * (1 + rate_count * options_per_rate)
    test_episodes = first_episodes + (seeds - MIN_VERDICT_SEEDS) * (1 + undecided_rate_count * options_per_rate)
    return ceil(test_episodes / (1.0 - SELECTION_BUDGET_FRACTION)) if driver_count > 1 else test_episodes


def select_controllers(
    options: Sequence[Option], run_options: OptionRunner, budget: EpisodeBudget, on_message: MessageCallback
) -> Selection:
    """Select a controller for each penetration rate by successive halving.

    Raise `UnjamError` if the human baseline or all options fail.
    """
    rows: dict[Option, OptionRows] = {option: [] for option in (HUMAN_BASELINE, *options)}
    rejection_reasons: dict[Option, str] = {}
    selection, remaining = Selection(rows, rejection_reasons, []), list(options)
    rates = [option.penetration_rate for option in options]
    max_drivers = max(map(rates.count, rates), default=0)
    round_count = ceil(log2(max_drivers)) if max_drivers > 1 else 0
    for round_number in range(1, round_count + 1):
        fraction = SELECTION_BUDGET_FRACTION * round_number / round_count
        affordable = budget.affordable_seeds(1 + len(remaining), fraction)
        count = max(min(MAX_SELECTION_SEEDS, affordable), int(round_number == 1))
        if count:
            seeds = selection_seeds(count, len(rows[HUMAN_BASELINE]))
            _extend_rows(rows, run_options([HUMAN_BASELINE, *remaining], seeds))
        rejection_reasons |= _failure_reasons(rows, remaining)
        seed_count = len(rows[HUMAN_BASELINE])
        if seed_count >= MIN_HARM_SEEDS:
            rejection_reasons |= {
                option: harm for option in remaining if (harm := describe_harm(selection.effect(option)))
            }
        remaining = [option for option in remaining if option not in rejection_reasons]
        for rate in dict.fromkeys(option.penetration_rate for option in remaining):
            ranked = sorted(
                (option for option in remaining if option.penetration_rate == rate),
                key=lambda option: _ranking_key(selection.effect(option)),
            )
            reason = f"behind {ranked[0].driver} ({format_count(seed_count, 'tuning seed')})"
            rejection_reasons |= dict.fromkeys(ranked[ceil(len(ranked) / 2) :], reason)
        remaining = [option for option in remaining if option not in rejection_reasons]
        status = f"{format_count(seed_count, 'tuning seed')}: {len(remaining)} of {len(options)} options remain"
        on_message(f"{status}; {_remaining_time_text(budget)}")
        if not remaining:
            break
    if options and len(_failure_reasons(rows, options)) == len(options):
        raise_failure([row for option in options for row in rows[option]])
    return Selection(rows, rejection_reasons, remaining)


@dataclass(frozen=True)
class AssessmentFindings:
    """Result of the comparison on test seeds."""

    rows: dict[Option, OptionRows]
    controller_results: list[ControllerResult]
    acc_results: list[AccResult]


def compare_on_test_seeds(
    finalists: Sequence[Option],
    penetration_rates: Sequence[float],
    with_unchanged_acc: bool,
    run_options: OptionRunner,
    budget: EpisodeBudget,
    precision: float,
    on_message: MessageCallback,
    on_findings: Callable[[AssessmentFindings], None] = lambda findings: None,
) -> AssessmentFindings:
    """Compare human baseline, ACC vehicles and the selected controllers on test seeds.

    An option runs until its CIs are narrower than `precision`, a share of the baseline's travel time, or until more
    seeds within the budget can hardly lead to a recommendation. A good result does not end an option, because its CIs
    would be too narrow. CIs hold together for all penetration rates with 95 % (Bonferroni). `with_unchanged_acc` adds
    ACC vehicles with all properties of the replaced vehicles. `on_findings` is called after each round except the last.
    """
    acc_options = [Option(rate, ACC_DRIVER) for rate in penetration_rates]
    unchanged_acc = [Option(rate, UNCHANGED_ACC_DRIVER) for rate in penetration_rates if with_unchanged_acc]
    compared_options = [*acc_options, *unchanged_acc, *finalists]
    rows: dict[Option, OptionRows] = {option: [] for option in (HUMAN_BASELINE, *compared_options)}
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(1, len(penetration_rates))
    active, results, acc_results = compared_options, list[ControllerResult](), list[AccResult]()
    while active:
        seed_count = len(rows[HUMAN_BASELINE])
        if seed_count >= MIN_VERDICT_SEEDS:
            wanted = seed_count // 2
        else:  # a short first round ends options that can never be recommended, such as infeasible options
            wanted = MIN_VERDICT_SEEDS - seed_count if seed_count else MIN_TEST_SEEDS
        count = max(min(wanted, budget.affordable_seeds(1 + len(active))), 0 if seed_count else MIN_TEST_SEEDS)
        if not count:
            break
        _extend_rows(rows, run_options([HUMAN_BASELINE, *active], held_out_seeds(count, seed_count)))
        if len(rows[HUMAN_BASELINE]) == seed_count:  # the time is up
            break
        results = [_controller_result(option, rows, confidence, precision) for option in finalists]
        acc_results = [_acc_result(option, rows, confidence, precision) for option in acc_options]
        max_seeds = len(rows[HUMAN_BASELINE]) + budget.affordable_seeds(1 + len(active))
        undecided = {
            Option(result.penetration_rate, result.driver)
            for result in results
            if _may_change_verdict(result, max_seeds, precision)
        }
        undecided_rates = {option.penetration_rate for option in undecided} | {
            acc_result.penetration_rate
            for acc_result in acc_results
            if 0 < acc_result.missing_seeds <= max_seeds - acc_result.effect.travel_time.count
        }
        active = [
            option
            for option in active
            if option in undecided or (option not in finalists and option.penetration_rate in undecided_rates)
        ]
        half_widths = [result.effect.relative_half_width for result in (*results, *acc_results)]
        status = f"{format_count(len(rows[HUMAN_BASELINE]), 'test seed')}: {_precision_text(half_widths, precision)}"
        verb = "remains" if len(active) == 1 else "remain"
        remaining = f"; {format_count(len(active), 'option')} {verb}, {_remaining_time_text(budget)}" if active else ""
        on_message(status + remaining)
        if active:
            on_findings(AssessmentFindings(rows, results, acc_results))
    for options in filter(None, (acc_options, finalists)):
        option_rows = [row for option in options for row in rows[option]]
        if all(row["status"] == "failed" for row in option_rows):
            raise_failure(option_rows)
    return AssessmentFindings(rows, results, acc_results)


def _controller_result(
    option: Option, rows: dict[Option, OptionRows], confidence: float, precision: float
) -> ControllerResult:
    effect = compute_effect(rows[option], rows[HUMAN_BASELINE], confidence)
    acc_rows = rows[Option(option.penetration_rate, ACC_DRIVER)][: len(rows[option])]
    differences = (paired_difference(rows[option], acc_rows, name, confidence) for name in (TIME_METRIC, FLOW_METRIC))
    difference, flow_difference = differences
    half_width = precision * effect.baseline_travel_time
    required = max(required_seeds(estimate, half_width) for estimate in (difference, effect.travel_time))
    required = MIN_VERDICT_SEEDS if _is_rejected(effect, difference) else required
    missing = 0.0 if _has_failed(effect) else max(0.0, required - difference.count)
    cav_speed_change = relative_difference(rows[option], acc_rows, "cav_mean_speed")
    return ControllerResult(*option, effect, difference, flow_difference, missing, cav_speed_change)


def _is_rejected(effect: Effect, difference_to_acc: Estimate) -> bool:
    """Return whether more test seeds can hardly lead to a recommendation."""
    harms = bool(describe_harm(effect)) or difference_to_acc.low > 0
    too_small = effect.is_too_small or is_too_small(difference_to_acc, effect.baseline_travel_time)
    return harms or too_small or effect.feasibility != FEASIBLE


def _has_failed(effect: Effect) -> bool:
    """Return whether an episode rules out a recommendation, so that more seeds are useless."""
    return bool(effect.failed_episodes) or effect.is_infeasible


def _acc_result(option: Option, rows: dict[Option, OptionRows], confidence: float, precision: float) -> AccResult:
    effect = compute_effect(rows[option], rows[HUMAN_BASELINE], confidence)
    unchanged = rows.get(Option(option.penetration_rate, UNCHANGED_ACC_DRIVER))
    property_effect = paired_difference(rows[option], unchanged, "travel_time", confidence) if unchanged else None
    required = required_seeds(effect.travel_time, precision * effect.baseline_travel_time)
    required = MIN_VERDICT_SEEDS if effect.is_too_small else required
    missing = max(0.0, required - effect.travel_time.count)
    return AccResult(option.penetration_rate, effect, property_effect, missing)


def _may_change_verdict(result: ControllerResult, max_seeds: int, precision: float) -> bool:
    """Return whether up to `max_seeds` test seeds may still lead to a recommendation, or to narrower CIs."""
    effect, difference = result.effect, result.difference_to_acc
    if difference.count < MIN_VERDICT_SEEDS:
        return not _has_failed(effect)
    is_hopeless = difference.mean >= 0 or _has_failed(effect) or _is_rejected(effect, difference)
    is_unreachable = result.missing_seeds > max_seeds - difference.count
    half_widths = difference.half_width / effect.baseline_travel_time, effect.relative_half_width
    return not (is_hopeless or is_unreachable or max(half_widths) <= precision)


def _extend_rows(rows: dict[Option, OptionRows], new_rows: dict[Option, OptionRows]) -> None:
    raise_failure(new_rows[HUMAN_BASELINE])
    for option, option_rows in new_rows.items():
        rows[option] += option_rows


def _failure_reasons(rows: dict[Option, OptionRows], options: Iterable[Option]) -> dict[Option, str]:
    reasons = {
        option: next((row["reason"] for row in rows[option] if row["status"] == "failed"), None) for option in options
    }
    return {option: f"failed: {reason}" for option, reason in reasons.items() if reason is not None}


def _ranking_key(effect: Effect) -> tuple[bool, bool, float]:
    """Return the sort key of options: those without collisions first, then feasible options, then by travel time."""
    return effect.collisions > 0, effect.feasibility != FEASIBLE, effect.relative_travel_time


def _precision_text(half_widths: Sequence[float], precision: float) -> str:
    target = f"(target: ±{100 * precision:g} %)"
    if not all(map(isfinite, half_widths)):
        return f"too few for a confidence interval of travel time {target}"
    return f"CI of travel time at most ±{100 * max(half_widths):.1f} % of the human baseline's {target}"


def _remaining_time_text(budget: EpisodeBudget) -> str:
    return f"at most {format_duration(budget.remaining_seconds)} more"
