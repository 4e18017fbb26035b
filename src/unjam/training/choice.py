"""Which controller is best at each penetration rate, and is it better than ACC vehicles and human drivers?

Tuning seeds choose a controller for each penetration rate by successive halving. Fresh test seeds compare the
human baseline, ACC vehicles without a controller, and the controllers that were chosen.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, log2
from typing import Any, NamedTuple

from unjam.measures.drivable import DRIVABLE
from unjam.measures.effect import (
    LEAST_JUDGED,
    AccResult,
    Effect,
    Judged,
    effect_of,
    harm_of,
    is_too_small,
    percent,
    seeds_for_verdict,
)
from unjam.measures.statistics import CONFIDENCE, Estimate, paired_difference
from unjam.training.evaluate import raise_failure
from unjam.training.seeds import choosing_seeds, held_out_seeds

MOST_CHOOSING = 10
"""seeds of a round of successive halving, at most"""
LEAST_HARMED = 6
"""seeds before an option is set aside because it is shown to do harm"""
LEAST_TESTED = 3
"""test seeds without which there is no interval"""
PART_CHOOSING = 0.4
"""of the budget, that choosing may spend"""

Seed = tuple[int, ...]
Rows = list[dict[str, Any]]
OnLine = Callable[[str], None]


class Option(NamedTuple):
    """A penetration rate and a driver of the CAVs."""

    share: float
    driver: str

    @property
    def label(self) -> str:
        """Its name in tables; the human baseline is `human`, as everywhere."""
        return f"{self.driver}, {percent(self.share)}" if self.share else self.driver


HUMAN = Option(0.0, "human")
ACC = "cruise"
"""driver of ACC vehicles without a controller"""
UNCHANGED_ACC = "cruise with unchanged vehicles"
"""the same, where the user has set properties of CAVs: with those of the vehicles which they replace"""
Drive = Callable[[Sequence[Option], Sequence[Seed]], dict[Option, Rows]]
"""drives all options on all seeds, and measures"""


class Budget:
    """Counts episodes, and knows how many more fit into the time."""

    def __init__(
        self,
        episodes: int,
        minutes: float | None = None,
        workers: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to count, and the clock to run; as many episodes at once as there are `workers`."""
        self.episodes, self.minutes, self.spent = episodes, minutes, 0
        self._workers, self._rounds, self._clock, self._started = workers, 0, clock, clock()

    def spend(self, count: int) -> None:
        """Note that so many episodes were driven together."""
        self.spent += count
        self._rounds += ceil(count / self._workers)

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return self._clock() - self._started

    def seconds_for(self, episodes: float) -> float:
        """Return how long so many episodes take, as those before did [s]."""
        return self.elapsed / max(1, self._rounds) * ceil(episodes / self._workers)

    def seeds(self, options: int, part: float = 1.0) -> int:
        """Return on how many seeds so many options can be driven within this part of the budget."""
        left = int(part * self.episodes + 1e-9) - self.spent
        if self.minutes is not None and self._rounds:
            rounds = (part * 60.0 * self.minutes - self.elapsed) / max(self.seconds_for(1), 1e-9)
            left = min(left, int(rounds) * self._workers)
        return max(0, left // options)


@dataclass(frozen=True)
class Choice:
    """What the tuning seeds have shown."""

    rows: dict[Option, Rows]
    set_aside: dict[Option, str]
    """why, of the options that are not tested"""
    finalists: list[Option]
    """at most one for each penetration rate"""

    def effect(self, option: Option) -> Effect:
        """Return what an option changes compared with the human baseline on the seeds of both."""
        return effect_of(self.rows[option], self.rows[HUMAN])


def least_episodes(shares: int, drivers: int, split: bool = False) -> int:
    """Return the smallest budget with which every option is driven, and those chosen are tested."""
    choosing = 1 + shares * drivers if drivers > 1 else 0
    return choosing + LEAST_TESTED * (1 + shares * (1 + bool(drivers) + split))


def choose(options: Sequence[Option], drive: Drive, budget: Budget, on_line: OnLine) -> Choice:
    """Choose a controller for each penetration rate by successive halving.

    In each round the better half of each penetration rate goes on. `on_line` gets a line for each round.

    Raises:
        UnjamError: the human baseline cannot be driven, or no option can.
    """
    rows: dict[Option, Rows] = {option: [] for option in (HUMAN, *options)}
    set_aside: dict[Option, str] = {}
    found, left = Choice(rows, set_aside, []), list(options)
    most = max((sum(each.share == option.share for each in options) for option in options), default=0)
    rounds = ceil(log2(most)) if most > 1 else 0
    for number in range(rounds):
        fit = budget.seeds(1 + len(left), PART_CHOOSING * (number + 1) / rounds)
        count = max(min(MOST_CHOOSING, fit), int(number == 0))
        if count:
            _extend(rows, drive([HUMAN, *left], choosing_seeds(count, len(rows[HUMAN]))))
        set_aside |= _failed(rows, left)
        seeds = len(rows[HUMAN])
        if seeds >= LEAST_HARMED:
            set_aside |= {each: harm for each in left if (harm := harm_of(found.effect(each)))}
        left = [option for option in left if option not in set_aside]
        for share in dict.fromkeys(option.share for option in left):
            ranked = sorted(
                (each for each in left if each.share == share), key=lambda each: _order(found.effect(each))
            )
            for option in ranked[ceil(len(ranked) / 2) :]:
                set_aside[option] = f"behind {ranked[0].driver} (tuning seeds: {seeds})"
        left = [option for option in left if option not in set_aside]
        on_line(f"tuning seeds: {seeds}; {len(left)} of {len(options)} options left{_time_left(budget)}")
        if not left:
            break
    if options and len(_failed(rows, options)) == len(options):
        raise_failure([row for option in options for row in rows[option]])
    return Choice(rows, set_aside, left)


@dataclass(frozen=True)
class Findings:
    """What the test seeds have shown."""

    rows: dict[Option, Rows]
    judged: list[Judged]
    acc: list[AccResult]


def judge(
    finalists: Sequence[Option],
    shares: Sequence[float],
    split: bool,
    drive: Drive,
    budget: Budget,
    precision: float,
    on_line: OnLine,
) -> Findings:
    """Compare human baseline, ACC vehicles and the chosen controllers on test seeds.

    An option is driven until its intervals are narrower than `precision`, a share of the travel time of the
    human baseline, or until it can hardly be recommended any more within the budget. No option ends because
    it does well, so that no interval is too narrow by a lucky moment. Intervals hold together for all
    penetration rates with 95 % (Bonferroni). `split`: ACC vehicles that keep all properties of the vehicles
    which they replace are driven, too.
    """
    baselines = [Option(share, ACC) for share in shares]
    unchanged = [Option(share, UNCHANGED_ACC) for share in shares if split]
    rows: dict[Option, Rows] = {option: [] for option in (HUMAN, *baselines, *unchanged, *finalists)}
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(1, len(shares))
    active, judged, acc = [*rows][1:], list[Judged](), list[AccResult]()
    while active:
        seeds = len(rows[HUMAN])
        wanted = LEAST_JUDGED - seeds if seeds < LEAST_JUDGED else seeds // 2
        count = max(min(wanted, budget.seeds(1 + len(active))), 0 if seeds else LEAST_TESTED)
        if not count:
            break
        _extend(rows, drive([HUMAN, *active], held_out_seeds(count, seeds)))
        judged = [_judged(option, rows, confidence, precision) for option in finalists]
        acc = [_acc_result(option, rows, confidence, precision) for option in baselines]
        affordable = len(rows[HUMAN]) + budget.seeds(1 + len(active))
        open_ones = {
            Option(each.share, each.driver) for each in judged if _is_open(each, affordable, precision)
        }
        open_shares = {option.share for option in open_ones} | {
            each.share for each in acc if 0 < each.missing <= affordable - each.effect.travel_time.count
        }
        active = [
            option
            for option in active
            if option in open_ones or (option not in finalists and option.share in open_shares)
        ]
        widths = [each.effect.width for each in (*judged, *acc)]
        said = f"test seeds: {len(rows[HUMAN])}; {_wide(widths, precision)}, {len(active)} options left"
        on_line(f"{said}{_time_left(budget) if active else ''}")
    driven = [row for option in baselines for row in rows[option]]
    if all(row["status"] == "failed" for row in driven):
        raise_failure(driven)
    return Findings(rows, judged, acc)


def _judged(option: Option, rows: dict[Option, Rows], confidence: float, precision: float) -> Judged:
    """Return what a controller does compared with human drivers and with ACC vehicles."""
    effect = effect_of(rows[option], rows[HUMAN], confidence)
    beyond = paired_difference(
        rows[option], rows[Option(option.share, ACC)][: len(rows[option])], "travel_time", confidence
    )
    narrow = precision * effect.people_time
    needed = max(seeds_for_verdict(each, narrow) for each in (beyond, effect.travel_time))
    missing = 0.0 if _is_refused(effect, beyond) else max(0.0, needed - beyond.count)
    return Judged(*option, effect, beyond, missing)


def _is_refused(effect: Effect, beyond_acc: Estimate) -> bool:
    """Return whether more test seeds can hardly lead to a recommendation."""
    harms = bool(harm_of(effect)) or beyond_acc.low > 0
    nothing = effect.is_too_small or is_too_small(beyond_acc, effect.people_time)
    return bool(effect.failed) or harms or nothing or effect.drivable != DRIVABLE


def _acc_result(option: Option, rows: dict[Option, Rows], confidence: float, precision: float) -> AccResult:
    """Return what ACC vehicles do compared with human drivers."""
    effect = effect_of(rows[option], rows[HUMAN], confidence)
    unchanged = rows.get(Option(option.share, UNCHANGED_ACC))
    of_properties = (
        paired_difference(rows[option], unchanged, "travel_time", confidence) if unchanged else None
    )
    needed = seeds_for_verdict(effect.travel_time, precision * effect.people_time)
    missing = 0.0 if effect.is_too_small else max(0.0, needed - effect.travel_time.count)
    return AccResult(option.share, effect, of_properties, missing)


def _is_open(found: Judged, affordable: int, precision: float) -> bool:
    """Return whether more test seeds may still lead to a recommendation, or make it more precise."""
    effect, beyond = found.effect, found.beyond_acc
    if beyond.count < LEAST_JUDGED:
        return not effect.failed
    hopeless = beyond.mean >= 0 or _is_refused(effect, beyond)
    unreachable = found.missing > affordable - beyond.count
    half = (beyond.high - beyond.low) / 2.0
    narrow = max(half / effect.people_time, effect.width) <= precision
    return not (hopeless or unreachable or narrow)


def _extend(rows: dict[Option, Rows], more: dict[Option, Rows]) -> None:
    raise_failure(more[HUMAN])
    for option, found in more.items():
        rows[option] += found


def _failed(rows: dict[Option, Rows], options: Iterable[Option]) -> dict[Option, str]:
    """Return the options of which an episode failed, and why."""
    reasons = {
        option: next((row["reason"] for row in rows[option] if row["status"] == "failed"), None)
        for option in options
    }
    return {option: f"failed: {reason}" for option, reason in reasons.items() if reason is not None}


def _order(effect: Effect) -> tuple[bool, bool, float]:
    """Return what options are sorted by: without contact, then feasible, then quick."""
    return effect.collisions > 0, effect.drivable != DRIVABLE, effect.relative_time


def _wide(widths: Sequence[float], precision: float) -> str:
    """Return how wide the widest interval is, in words."""
    wanted = f"(wanted: ±{100 * precision:g} %)"
    if not all(map(isfinite, widths)):
        return f"too few for an interval of travel time {wanted}"
    return f"travel time known to ±{100 * max(widths):.1f} % of the human baseline's {wanted}"


def _time_left(budget: Budget) -> str:
    """Return how long the rest of the budget takes at most, in words."""
    seconds = budget.seconds_for(budget.episodes - budget.spent)
    if budget.minutes is not None:
        seconds = min(seconds, max(0.0, 60.0 * budget.minutes - budget.elapsed))
    return f"; at most {in_words(seconds)} more"


def in_words(seconds: float) -> str:
    """Return a duration for a line of progress."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
