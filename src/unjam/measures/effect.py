"""What CAVs change on a road, beside people alone on the same seeds, and whether they are recommended.

The rule is one for all roads: travel time must be shown to fall; flow must be shown not to; a car must be
able to drive so; and people must not brake hard more often than where they are alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.statistics import (
    CONFIDENCE,
    Estimate,
    around_ratio,
    ended_early,
    estimate,
    estimate_of,
    in_percent,
    paired,
    paired_difference,
    signed,
    value_of,
)

FLOW_LOST = 0.01
"""share of people's flow that the interval must exclude as a loss"""
LEAST_JUDGED = 10
"""seeds without which nothing is recommended: an interval of fewer is too narrow to be trusted"""

TIME, FLOW, FUEL = "travel_time", "throughput_veh_per_h", "fuel_ml_per_km"
HARD = "people_beyond_4_5"
NONE = "No CAVs are recommended on this road"


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
    failed: int
    """episodes that did not run"""
    drivable: str
    """verdict on the CAVs themselves: `drivable`, or the first reason why not"""
    people_time: float
    """mean travel time of people alone on these seeds [s]"""
    people_flow: float
    """[veh/h]"""
    delay_cut: Estimate
    """share of people's delay beyond a free road that is saved; NaN where it is not known, or none"""
    speed: Estimate
    """mean speed of all vehicles [m/s]"""
    ended_early: int = 0
    """episodes that ran, but ended early, with or without CAVs: only complete ones are compared"""

    @property
    def words(self) -> str:
        """What everybody on the road gains, in a line: time, flow and fuel, or speed where nobody leaves."""
        time = f"travel time {signed(self.travel_time, 1)} s"
        if self.delay_cut.count and (self.travel_time.high < 0 or self.travel_time.low > 0):
            less = f"{in_percent(self.delay_cut)} less delay"
            time += f" ({less if self.travel_time.high < 0 else 'more delay'})"
        first = time if self.travel_time.count else f"mean speed {signed(self.speed, 2)} m/s"
        lost = ": a loss, whatever the speed" if self.flow.high < 0 else ""
        return f"{first}, flow {signed(self.flow)} veh/h{lost}, fuel {signed(self.fuel, 1)} ml/km"

    @property
    def width(self) -> float:
        """Half the interval of travel time, as a share of people's travel time; NaN of one seed."""
        return (self.travel_time.high - self.travel_time.low) / 2.0 / self.people_time

    @property
    def relative_time(self) -> float:
        """Difference of travel time, as a share of people's."""
        return self.travel_time.mean / self.people_time


def effect_of(
    rows: Sequence[dict[str, Any]], people: Sequence[dict[str, Any]], confidence: float = CONFIDENCE
) -> Effect:
    """Return what the rows of `measure` of a driver show beside those of people alone.

    People may have been driven on more seeds; only those that both have count.
    """
    seeds = {str(row["seed"]) for row in rows}
    people = [row for row in people if str(row["seed"]) in seeds]
    ran = [row for row in rows if row["status"] != "failed"]
    differences = (paired_difference(rows, people, name, confidence) for name in (TIME, FLOW, FUEL, HARD))
    return Effect(
        *differences,
        collisions=float(
            sum(row["collisions"] for row in ran)
            - sum(row["collisions"] for row in people if row["status"] != "failed")
        ),
        failed=len(rows) - len(ran),
        drivable=drivable_in_all([{**row, HARD: 0.0} for row in rows]),
        people_time=estimate_of(people, TIME).mean,
        people_flow=estimate_of(people, FLOW).mean,
        delay_cut=_delay_cut(rows, people, confidence),
        speed=paired_difference(rows, people, "mean_speed", confidence),
        ended_early=sum(map(ended_early, [*rows, *people])),
    )


def _delay_cut(
    rows: Sequence[dict[str, Any]], people: Sequence[dict[str, Any]], confidence: float
) -> Estimate:
    both = [
        (value_of(alone, TIME) - value_of(row, TIME), value_of(alone, "delay"))
        for row, alone in paired(rows, people)
    ]
    saved, delays = np.array([each for each in both if np.isfinite(each).all()]).reshape(-1, 2).T
    if not len(delays) or delays.mean() <= 0:
        return Estimate(nan, nan, nan, 0)
    return estimate(around_ratio(saved, delays).tolist(), confidence)


def beside_people(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, Effect]:
    """Return the effect of each driver beside people alone, where they are among the drivers."""
    people = rows_by_driver.get("human", [])
    others = ((label, rows) for label, rows in rows_by_driver.items() if label != "human")
    return {label: effect_of(rows, people) for label, rows in others} if people else {}


def harm_of(effect: Effect) -> str:
    """Return what CAVs are shown to make worse, travel time or flow; empty where nothing is shown."""
    return "; ".join(words for worse, words in _harms(effect) if worse)


def _harms(effect: Effect) -> tuple[tuple[bool, str], ...]:
    """Return whether travel time and flow are shown to be worse, each with the words for it."""
    longer = f"travel time is longer than people's alone: {signed(effect.travel_time, 1)} s"
    lower = f"flow is lower than people's alone: {signed(effect.flow)} veh/h"
    return (effect.travel_time.low > 0, longer), (effect.flow.high < 0, lower)


def reasons_against(effect: Effect) -> list[str]:
    """Return all reasons against recommending what was measured; none where there is nothing against it."""
    most = FLOW_LOST * effect.people_flow
    # Written so that a NaN, of too few seeds, is a reason against.
    checks = (
        (effect.travel_time.count >= LEAST_JUDGED, f"{effect.travel_time.count} fresh seeds are too few"),
        (not effect.failed, f"{effect.failed} episodes failed"),
        (not effect.ended_early, f"{effect.ended_early} episodes ended early"),
        *((not worse, words) for worse, words in _harms(effect)),
        (
            effect.travel_time.low > 0 or effect.travel_time.high < 0,
            f"travel time is not shown to be shorter: {signed(effect.travel_time, 1)} s",
        ),
        (
            effect.flow.high < 0 or effect.flow.low >= -most,
            f"flow may be lower by more than {100 * FLOW_LOST:g} %: {signed(effect.flow)} veh/h",
        ),
        (effect.drivable == DRIVABLE, f"no car could drive so: {effect.drivable or 'no CAV drove'}"),
        (effect.collisions <= 0, f"{effect.collisions:.0f} more vehicles in contact than without CAVs"),
        (
            effect.hard_braking.mean <= 0,
            "people brake beyond 4.5 m/s² more often than alone: "
            f"{signed(effect.hard_braking)} times in a million moments, of which the mean's sign is asked",
        ),
    )
    return [reason for fine, reason in checks if not fine]


@dataclass(frozen=True)
class Judged:
    """The driver that was chosen for a share of CAVs, on seeds that chose nothing."""

    share: float
    driver: str
    effect: Effect

    @property
    def reasons(self) -> list[str]:
        """Why it is not recommended; none where it is."""
        return reasons_against(self.effect)

    @property
    def words(self) -> str:
        """What is said of this share, in a sentence or two."""
        who = f"{percent(self.share)} CAVs that drive as {self.driver}"
        if self.reasons:
            return f"{who}: not recommended, for {'; '.join(self.reasons)}."
        found = self.effect
        return (
            f"{who}: recommended. Travel time {signed(found.travel_time, 1)} s "
            f"({100 * found.relative_time:+.1f} %), flow {signed(found.flow)} veh/h, fuel "
            f"{signed(found.fuel, 1)} ml/km, on {found.travel_time.count} fresh seeds."
        )


def recommended(judged: Sequence[Judged]) -> Judged | None:
    """Return the share and driver that are recommended: who shortens travel time most among those allowed."""
    return min(
        (each for each in judged if not each.reasons),
        key=lambda each: each.effect.relative_time,
        default=None,
    )


def shown_beside(judged: Sequence[Judged]) -> Judged | None:
    """Return whose traffic pictures show beside people's: the recommended, else the quickest."""
    quickest = min(judged, key=lambda each: each.effect.relative_time, default=None)
    return recommended(judged) or quickest


def headline(judged: Sequence[Judged]) -> str:
    """Return the answer in one sentence."""
    best = recommended(judged)
    if best is None:
        if not judged:
            return (
                f"{NONE}: all that was tried did worse than people alone on the seeds that choose, or failed."
            )
        worse = sum(bool(harm_of(each.effect)) for each in judged)
        harm = f" ({worse} of {len(judged)} slow traffic or lose flow)" if worse else ""
        return f"{NONE}: none of the shares judged on fresh seeds passes the rule{harm}."
    return (
        f"{percent(best.share)} CAVs are recommended on this road, driving as {best.driver}: travel time "
        f"{signed(best.effect.travel_time, 1)} s a vehicle ({100 * best.effect.relative_time:+.1f} %)."
    )


def percent(share: float) -> str:
    """Return a share as words say it."""
    return f"{100 * share:g} %"
