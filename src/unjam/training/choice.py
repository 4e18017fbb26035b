"""Who drives best at each share of CAVs: chosen on some seeds, judged on others, beside people alone.

Some seeds choose a driver for each share: what is shown to harm, or to be slower than another at the same
share, is set aside early. Those that are chosen are judged on fresh seeds, and a rule says what it means.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

from unjam.measures.drivable import DRIVABLE
from unjam.measures.effect import LEAST_JUDGED, Effect, Judged, effect_of, harm_of, percent
from unjam.measures.statistics import CONFIDENCE, paired_difference, signed
from unjam.training.evaluate import raise_failure
from unjam.training.seeds import choosing_seeds, held_out_seeds

BATCH = 2
"""seeds that are added at a time"""
LEAST_CHOOSING = 6
"""seeds before anything is set aside, or counts as known well enough"""
PART_CHOOSING = 0.5
"""of the budget, that choosing may spend"""

Seed = tuple[int, ...]
Rows = list[dict[str, Any]]
OnLine = Callable[[str], None]


class Option(NamedTuple):
    """A share of CAVs and who drives them."""

    share: float
    driver: str

    @property
    def label(self) -> str:
        """Its name in tables; people alone are `human`, as everywhere."""
        return f"{self.driver}, {percent(self.share)}" if self.share else self.driver


PEOPLE = Option(0.0, "human")
Drive = Callable[[Sequence[Option], Sequence[Seed]], dict[Option, Rows]]
"""drives all options on all seeds, and measures"""


class Budget:
    """Counts episodes, and knows by how long those before took whether more fit into the time."""

    def __init__(
        self, episodes: int, minutes: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to count, and the clock to run."""
        self.episodes, self.spent = episodes, 0
        self._seconds, self._clock, self._started = minutes and 60.0 * minutes, clock, clock()

    def spend(self, count: int) -> None:
        """Note that so many episodes were driven."""
        self.spent += count

    def allows(self, count: int, part: float = 1.0) -> bool:
        """Return whether so many episodes more fit into this part of the budget."""
        wanted = self.spent + count
        if wanted > part * self.episodes:
            return False
        if self._seconds is None or not self.spent:
            return True
        each = (self._clock() - self._started) / self.spent
        return each * wanted <= part * self._seconds


@dataclass(frozen=True)
class Choice:
    """What the seeds that choose have shown."""

    rows: dict[Option, Rows]
    set_aside: dict[Option, str]
    """why, of what was not driven to the end"""
    finalists: list[Option]
    """at most one for each share"""

    def effect(self, option: Option) -> Effect:
        """Return what an option does beside people alone, on the seeds that it was driven on."""
        return effect_of(self.rows[option], self.rows[PEOPLE])


def least_episodes(shares: int, drivers: int) -> int:
    """Return the smallest budget with which something can be chosen and judged."""
    choosing = LEAST_CHOOSING * (1 + shares * drivers)
    return max(round(choosing / PART_CHOOSING), choosing + LEAST_JUDGED * (1 + shares))


def choose(
    options: Sequence[Option], drive: Drive, budget: Budget, precision: float, on_line: OnLine
) -> Choice:
    """Drive people and all options until a driver is known for each share, or half the budget is spent.

    `precision` is the half-width of the interval of travel time that is narrow enough, as a share of
    people's; `on_line` gets a line for each batch.

    Raises:
        UnjamError: people alone cannot be driven, or no option can.
    """
    rows: dict[Option, Rows] = {option: [] for option in (PEOPLE, *options)}
    set_aside: dict[Option, str] = {}
    slower_than: dict[Option, Option] = {}
    while True:
        left = [option for option in options if option not in set_aside]
        _extend(rows, drive([PEOPLE, *left], choosing_seeds(BATCH, len(rows[PEOPLE]))))
        found = Choice(rows, set_aside, [])
        set_aside |= _failed(rows, left)
        if len(rows[PEOPLE]) >= LEAST_CHOOSING:
            left = [option for option in left if option not in set_aside]
            set_aside |= {option: harm for option in left if (harm := harm_of(found.effect(option)))}
            for option in [each for each in slower_than if _is_better(each, slower_than[each], found)]:
                del slower_than[option], set_aside[option]
            slower = _slower(found, [option for option in left if option not in set_aside])
            slower_than |= {option: rival for option, (rival, _) in slower.items()}
            set_aside |= {option: words for option, (_, words) in slower.items()}
        left = [option for option in options if option not in set_aside]  # with who has come back
        widths = [found.effect(option).width for option in left]
        said = f"choosing, {len(rows[PEOPLE])} seeds: {len(left)} of {len(options)} left"
        on_line(f"{said}, {_wide(widths, precision)}")
        decided = len({option.share for option in left}) == len(left)
        known = len(rows[PEOPLE]) >= LEAST_CHOOSING and (decided or all(each <= precision for each in widths))
        if not left or known or not budget.allows(BATCH * (1 + len(left)), PART_CHOOSING):
            break
    if len(_failed(rows, options)) == len(options):
        raise_failure([row for option in options for row in rows[option]])
    shares = dict.fromkeys(option.share for option in left)
    finalists = [
        min((each for each in left if each.share == share), key=lambda each: _order(found.effect(each)))
        for share in shares
    ]
    return Choice(rows, set_aside, finalists)


def judge(
    finalists: Sequence[Option], drive: Drive, budget: Budget, precision: float, on_line: OnLine
) -> tuple[dict[Option, Rows], list[Judged]]:
    """Drive people and the finalists on fresh seeds until intervals are narrow, or the budget is spent.

    It ends by how narrow the intervals are, never by where they lie. They are wider the more are judged: all
    of them together hold with 95 % (Bonferroni).
    """
    rows: dict[Option, Rows] = {option: [] for option in (PEOPLE, *finalists)}
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(1, len(finalists))
    while True:
        _extend(rows, drive([PEOPLE, *finalists], held_out_seeds(BATCH, len(rows[PEOPLE]))))
        effects = [effect_of(rows[option], rows[PEOPLE], confidence) for option in finalists]
        widths = [effect.width for effect in effects]
        on_line(f"judging, {len(rows[PEOPLE])} fresh seeds: {_wide(widths, precision)}")
        known = len(rows[PEOPLE]) >= LEAST_JUDGED and all(each <= precision for each in widths)
        if known or not budget.allows(BATCH * len(rows)):
            return rows, [Judged(*each, effect) for each, effect in zip(finalists, effects, strict=True)]


def _extend(rows: dict[Option, Rows], more: dict[Option, Rows]) -> None:
    raise_failure(more[PEOPLE])
    for option, found in more.items():
        rows[option] += found


def _failed(rows: dict[Option, Rows], options: Iterable[Option]) -> dict[Option, str]:
    """Return the options of which an episode failed, and why."""
    reasons = {
        option: next((row["reason"] for row in rows[option] if row["status"] == "failed"), None)
        for option in options
    }
    return {option: f"failed: {reason}" for option, reason in reasons.items() if reason is not None}


def _slower(found: Choice, left: Sequence[Option]) -> dict[Option, tuple[Option, str]]:
    """Return which options are shown to be slower than the best of their share, that one, and the words."""
    slower = dict[Option, tuple[Option, str]]()
    for option in left:
        best = min(
            (each for each in left if each.share == option.share),
            key=lambda each: _order(found.effect(each)),
        )
        more = paired_difference(found.rows[option], found.rows[best], "travel_time")
        if more.low > 0:
            slower[option] = best, f"slower than {best.driver}: travel time {signed(more, 1)} s"
    return slower


def _is_better(option: Option, rival: Option, found: Choice) -> bool:
    """Return whether who was quicker has turned out worse: it harms, failed, or no car could drive so."""
    its, own = found.effect(rival), found.effect(option)
    return bool(harm_of(its) or its.failed or _order(its)[:2] > _order(own)[:2])


def _order(effect: Effect) -> tuple[bool, bool, float]:
    """Return what options are sorted by: without contact, then drivable, then quick."""
    return effect.collisions > 0, effect.drivable != DRIVABLE, effect.relative_time


def _wide(widths: Sequence[float], precision: float) -> str:
    """Return how wide the widest interval is, in words."""
    if not widths:
        return "all are set aside"
    wanted = f"(wanted: ±{100 * precision:g} %)"
    if not all(map(isfinite, widths)):
        return f"too few for an interval of travel time {wanted}"
    return f"travel time known to ±{100 * max(widths):.1f} % of people's {wanted}"
