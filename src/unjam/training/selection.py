"""Which controller is best at each penetration rate, and is it better than ACC vehicles and human drivers?

Tuning seeds choose a controller for each penetration rate by successive halving. Fresh test seeds compare the
human baseline, ACC vehicles without a controller, and the controllers that were chosen.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, log2
from typing import Any, NamedTuple

from unjam.measures.effect import (
    MIN_VERDICT_SEEDS,
    AccResult,
    ControllerResult,
    Effect,
    describe_harm,
    effect_of,
    format_percent,
    is_too_small,
    required_seeds,
)
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.statistics import CONFIDENCE, Estimate, paired_difference
from unjam.training.evaluate import raise_failure
from unjam.training.seeds import make_test_seeds, selection_seeds

MAX_SELECTION_SEEDS = 10
"""seeds of a round of successive halving, at most"""
MIN_HARM_SEEDS = 6
"""seeds before an option is set aside because it is shown to do harm"""
MIN_TEST_SEEDS = 3
"""test seeds without which there is no interval"""
SELECTION_BUDGET_FRACTION = 0.4
"""of the budget, that choosing may spend"""

EpisodeSeed = tuple[int, ...]
OptionRows = list[dict[str, Any]]
OptionMessageCallback = Callable[[str], None]


class Option(NamedTuple):
    """A penetration rate and a driver of the CAVs."""

    penetration_rate: float
    driver: str

    @property
    def label(self) -> str:
        """Its name in tables; the human baseline is `human`, as everywhere."""
        return f"{self.driver}, {format_percent(self.penetration_rate)}" if self.penetration_rate else self.driver


HUMAN_BASELINE = Option(0.0, "human")
ACC_DRIVER = "cruise"
"""driver of ACC vehicles without a controller"""
UNCHANGED_ACC_DRIVER = "acc with unchanged vehicles"
"""the same, where the user has set properties of CAVs: with those of the vehicles which they replace"""
OptionRunner = Callable[[Sequence[Option], Sequence[EpisodeSeed]], dict[Option, OptionRows]]
"""drives all options on all seeds, and measures"""


class EpisodeBudget:
    """Counts episodes, and knows how many more fit into the time."""

    def __init__(
        self, episodes: int, minutes: float | None = None, workers: int = 1, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to count, and the clock to run; as many episodes at once as there are `workers`."""
        self.episodes, self.minutes, self.used_episodes = episodes, minutes, 0
        self._workers, self._completed_rounds, self._clock, self._start_time = workers, 0, clock, clock()

    def spend(self, count: int) -> None:
        """Note that so many episodes were driven together."""
        self.used_episodes += count
        self._completed_rounds += ceil(count / self._workers)

    @property
    def elapsed_seconds(self) -> float:
        """Time since the start [s]."""
        return self._clock() - self._start_time

    def estimate_seconds(self, episodes: float) -> float:
        """Return how long so many episodes take, as those before did [s]."""
        return self.elapsed_seconds / max(1, self._completed_rounds) * ceil(episodes / self._workers)

    def affordable_seeds(self, option_count: int, fraction: float = 1.0) -> int:
        """Return on how many seeds so many options can be driven within this part of the budget."""
        left = int(fraction * self.episodes + 1e-9) - self.used_episodes
        if self.minutes is not None and self._completed_rounds:
            rounds = (fraction * 60.0 * self.minutes - self.elapsed_seconds) / max(self.estimate_seconds(1), 1e-9)
            left = min(left, int(rounds) * self._workers)
        return max(0, left // option_count)


@dataclass(frozen=True)
class Selection:
    """What the tuning seeds have shown."""

    rows: dict[Option, OptionRows]
    rejection_reasons: dict[Option, str]
    """why, of the options that are not tested"""
    finalists: list[Option]
    """at most one for each penetration rate"""

    def effect(self, option: Option) -> Effect:
        """Return what an option changes compared with the human baseline on the seeds of both."""
        return effect_of(self.rows[option], self.rows[HUMAN_BASELINE])


def min_episodes(rate_count: int, driver_count: int, with_unchanged_acc: bool = False) -> int:
    """Return the smallest budget with which every option is driven, and those chosen are tested."""
    choosing = 1 + rate_count * driver_count if driver_count > 1 else 0
    return choosing + MIN_TEST_SEEDS * (1 + rate_count * (1 + bool(driver_count) + with_unchanged_acc))


def select_controllers(
    options: Sequence[Option], run_options: OptionRunner, budget: EpisodeBudget, on_message: OptionMessageCallback
) -> Selection:
    """Choose a controller for each penetration rate by successive halving.

    In each round the better half of each penetration rate goes on. `on_line` gets a line for each round.

    Raises:
        UnjamError: the human baseline cannot be driven, or no option can.
    """
    rows: dict[Option, OptionRows] = {option: [] for option in (HUMAN_BASELINE, *options)}
    set_aside: dict[Option, str] = {}
    found, left = Selection(rows, set_aside, []), list(options)
    most = max(
        (sum(each.penetration_rate == option.penetration_rate for each in options) for option in options), default=0
    )
    rounds = ceil(log2(most)) if most > 1 else 0
    for number in range(rounds):
        fit = budget.affordable_seeds(1 + len(left), SELECTION_BUDGET_FRACTION * (number + 1) / rounds)
        count = max(min(MAX_SELECTION_SEEDS, fit), int(number == 0))
        if count:
            _extend_rows(rows, run_options([HUMAN_BASELINE, *left], selection_seeds(count, len(rows[HUMAN_BASELINE]))))
        set_aside |= _failure_reasons(rows, left)
        seeds = len(rows[HUMAN_BASELINE])
        if seeds >= MIN_HARM_SEEDS:
            set_aside |= {each: harm for each in left if (harm := describe_harm(found.effect(each)))}
        left = [option for option in left if option not in set_aside]
        for share in dict.fromkeys(option.penetration_rate for option in left):
            ranked = sorted(
                (each for each in left if each.penetration_rate == share),
                key=lambda each: _ranking_key(found.effect(each)),
            )
            for option in ranked[ceil(len(ranked) / 2) :]:
                set_aside[option] = f"behind {ranked[0].driver} (tuning seeds: {seeds})"
        left = [option for option in left if option not in set_aside]
        on_message(f"tuning seeds: {seeds}; {len(left)} of {len(options)} options left{_remaining_time_text(budget)}")
        if not left:
            break
    if options and len(_failure_reasons(rows, options)) == len(options):
        raise_failure([row for option in options for row in rows[option]])
    return Selection(rows, set_aside, left)


@dataclass(frozen=True)
class AssessmentFindings:
    """What the test seeds have shown."""

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
    on_message: OptionMessageCallback,
) -> AssessmentFindings:
    """Compare human baseline, ACC vehicles and the chosen controllers on test seeds.

    An option is driven until its intervals are narrower than `precision`, a share of the travel time of the
    human baseline, or until it can hardly be recommended any more within the budget. No option ends because
    it does well, so that no interval is too narrow by a lucky moment. Intervals hold together for all
    penetration rates with 95 % (Bonferroni). `split`: ACC vehicles that keep all properties of the vehicles
    which they replace are driven, too.
    """
    baselines = [Option(share, ACC_DRIVER) for share in penetration_rates]
    unchanged = [Option(share, UNCHANGED_ACC_DRIVER) for share in penetration_rates if with_unchanged_acc]
    rows: dict[Option, OptionRows] = {option: [] for option in (HUMAN_BASELINE, *baselines, *unchanged, *finalists)}
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(1, len(penetration_rates))
    active, judged, acc = [*rows][1:], list[ControllerResult](), list[AccResult]()
    while active:
        seeds = len(rows[HUMAN_BASELINE])
        wanted = MIN_VERDICT_SEEDS - seeds if seeds < MIN_VERDICT_SEEDS else seeds // 2
        count = max(min(wanted, budget.affordable_seeds(1 + len(active))), 0 if seeds else MIN_TEST_SEEDS)
        if not count:
            break
        _extend_rows(rows, run_options([HUMAN_BASELINE, *active], make_test_seeds(count, seeds)))
        judged = [_controller_result(option, rows, confidence, precision) for option in finalists]
        acc = [_acc_result(option, rows, confidence, precision) for option in baselines]
        affordable = len(rows[HUMAN_BASELINE]) + budget.affordable_seeds(1 + len(active))
        open_ones = {
            Option(each.penetration_rate, each.driver)
            for each in judged
            if _may_change_verdict(each, affordable, precision)
        }
        open_shares = {option.penetration_rate for option in open_ones} | {
            each.penetration_rate
            for each in acc
            if 0 < each.missing_seeds <= affordable - each.effect.travel_time.count
        }
        active = [
            option
            for option in active
            if option in open_ones or (option not in finalists and option.penetration_rate in open_shares)
        ]
        widths = [each.effect.relative_half_width for each in (*judged, *acc)]
        said = f"test seeds: {len(rows[HUMAN_BASELINE])}; {_width_text(widths, precision)}, {len(active)} options left"
        on_message(f"{said}{_remaining_time_text(budget) if active else ''}")
    driven = [row for option in baselines for row in rows[option]]
    if all(row["status"] == "failed" for row in driven):
        raise_failure(driven)
    return AssessmentFindings(rows, judged, acc)


def _controller_result(
    option: Option, rows: dict[Option, OptionRows], confidence: float, precision: float
) -> ControllerResult:
    """Return what a controller does compared with human drivers and with ACC vehicles."""
    effect = effect_of(rows[option], rows[HUMAN_BASELINE], confidence)
    beyond = paired_difference(
        rows[option], rows[Option(option.penetration_rate, ACC_DRIVER)][: len(rows[option])], "travel_time", confidence
    )
    narrow = precision * effect.baseline_travel_time
    needed = max(required_seeds(each, narrow) for each in (beyond, effect.travel_time))
    missing = 0.0 if _is_rejected(effect, beyond) else max(0.0, needed - beyond.count)
    return ControllerResult(*option, effect, beyond, missing)


def _is_rejected(effect: Effect, difference_to_acc: Estimate) -> bool:
    """Return whether more test seeds can hardly lead to a recommendation."""
    harms = bool(describe_harm(effect)) or difference_to_acc.low > 0
    nothing = effect.is_too_small or is_too_small(difference_to_acc, effect.baseline_travel_time)
    return bool(effect.failed_episodes) or harms or nothing or effect.feasibility != FEASIBLE


def _acc_result(option: Option, rows: dict[Option, OptionRows], confidence: float, precision: float) -> AccResult:
    """Return what ACC vehicles do compared with human drivers."""
    effect = effect_of(rows[option], rows[HUMAN_BASELINE], confidence)
    unchanged = rows.get(Option(option.penetration_rate, UNCHANGED_ACC_DRIVER))
    of_properties = paired_difference(rows[option], unchanged, "travel_time", confidence) if unchanged else None
    needed = required_seeds(effect.travel_time, precision * effect.baseline_travel_time)
    missing = 0.0 if effect.is_too_small else max(0.0, needed - effect.travel_time.count)
    return AccResult(option.penetration_rate, effect, of_properties, missing)


def _may_change_verdict(result: ControllerResult, max_seeds: int, precision: float) -> bool:
    """Return whether more test seeds may still lead to a recommendation, or make it more precise."""
    effect, beyond = result.effect, result.difference_to_acc
    if beyond.count < MIN_VERDICT_SEEDS:
        return not effect.failed_episodes
    hopeless = beyond.mean >= 0 or _is_rejected(effect, beyond)
    unreachable = result.missing_seeds > max_seeds - beyond.count
    half = (beyond.high - beyond.low) / 2.0
    narrow = max(half / effect.baseline_travel_time, effect.relative_half_width) <= precision
    return not (hopeless or unreachable or narrow)


def _extend_rows(rows: dict[Option, OptionRows], new_rows: dict[Option, OptionRows]) -> None:
    raise_failure(new_rows[HUMAN_BASELINE])
    for option, found in new_rows.items():
        rows[option] += found


def _failure_reasons(rows: dict[Option, OptionRows], options: Iterable[Option]) -> dict[Option, str]:
    """Return the options of which an episode failed, and why."""
    reasons = {
        option: next((row["reason"] for row in rows[option] if row["status"] == "failed"), None) for option in options
    }
    return {option: f"failed: {reason}" for option, reason in reasons.items() if reason is not None}


def _ranking_key(effect: Effect) -> tuple[bool, bool, float]:
    """Return what options are sorted by: without contact, then feasible, then quick."""
    return effect.collisions > 0, effect.feasibility != FEASIBLE, effect.relative_travel_time


def _width_text(widths: Sequence[float], precision: float) -> str:
    """Return how wide the widest interval is, in words."""
    wanted = f"(wanted: ±{100 * precision:g} %)"
    if not all(map(isfinite, widths)):
        return f"too few for an interval of travel time {wanted}"
    return f"travel time known to ±{100 * max(widths):.1f} % of the human baseline's {wanted}"


def _remaining_time_text(budget: EpisodeBudget) -> str:
    """Return how long the rest of the budget takes at most, in words."""
    seconds = budget.estimate_seconds(budget.episodes - budget.used_episodes)
    if budget.minutes is not None:
        seconds = min(seconds, max(0.0, 60.0 * budget.minutes - budget.elapsed_seconds))
    return f"; at most {format_duration(seconds)} more"


def format_duration(seconds: float) -> str:
    """Return a duration for a line of progress."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
