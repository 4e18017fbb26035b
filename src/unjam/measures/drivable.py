"""Could a car have driven so? What an episode's audit says, and the verdict: the first reason against it."""

from collections.abc import Callable, Sequence
from math import isfinite, isnan, nan
from typing import Any, Literal

import numpy as np

from unjam.worlds.audit import BEYOND
from unjam.worlds.record import Episode

FLOOR_MET = 0.9
"""share of the demanded time headway that must be left at any moment"""
USUAL_FLOOR = 1.0
"""time headway that is demanded where a road names none [s]"""
SMALLEST_WITH_LANES = 0.8
"""time headway behind who was followed for long that must be left at any moment, where others cut in [s]"""
SHARE_BELOW_FLOOR = 1e-3
"""of that time, how much may be below the floor"""
HARDEST_AFTER_CUT_IN = 9.0
"""braking just after somebody has cut in [m/s2]: what dry asphalt allows"""
SMALLEST_TTC = 1.0
"""[s]"""
HARDEST_BRAKING = 6.0
"""[m/s2]"""
TOLERANCE = 1e-6

DRIVABLE = "drivable"


def min_headway(episode: Episode) -> float:
    """Smallest time headway of the CAV, gap over speed, while it drives faster than 1 m/s [s]; NaN if never.

    In any simulation step, as all that follows; on the merge after every decision.
    """
    return _finite(episode.audit.following.headway)


def _finite(value: float) -> float:
    return value if isfinite(value) else nan


def share_short_headway(episode: Episode) -> float:
    """Share of the CAV's time faster than 1 m/s with a time headway below one second."""
    return episode.audit.following.share_short


def min_ttc(episode: Episode) -> float:
    """Smallest time to collision [s], gap over closing speed, of the CAV and of the vehicle behind it.

    Infinite where nobody ever closed in. Hayward 1972.
    """
    smallest = np.inf
    for trajectory in episode.trajectories:
        own, leader, gap, follower, gap_behind, *_ = trajectory.states
        for distance, closing in ((gap, own - leader), (gap_behind, follower - own)):
            near = closing > 0
            smallest = min(smallest, float((distance[near] / closing[near]).min(initial=np.inf)))
    return smallest


def cav_min_ttc(episode: Episode) -> float:
    """Smallest time to collision of the CAV with the vehicle ahead [s]; NaN where it never closed in."""
    return _finite(episode.audit.following.time_to_collision)


def max_drac(episode: Episode) -> float:
    """Largest deceleration rate to avoid a crash of the CAV, closing speed squared over twice the gap [m/s2].

    Almqvist, Hyden and Risser 1991.
    """
    return episode.audit.following.needed_braking


def max_jerk(episode: Episode) -> float:
    """Largest change of the CAV's acceleration over time [m/s3]."""
    return episode.audit.following.jerk


def cav_max_braking(episode: Episode) -> float:
    """Hardest braking of a CAV [m/s2]; NaN where nobody is automated."""
    return episode.audit.cavs.hardest if episode.audit.cavs.moments else nan


def cut_in_max_braking(episode: Episode) -> float:
    """Hardest braking of a CAV in the 3 s after somebody else came before it [m/s2], on roads with lanes.

    It is not part of the other brakings of CAVs; NaN where nobody may cut in.
    """
    return episode.audit.cut_in.hardest if episode.audit.cut_in.moments else nan


def people_max_braking(episode: Episode) -> float:
    """Hardest braking of people [m/s2]."""
    return episode.audit.people.hardest


def brakings_beyond(who: Literal["people", "cavs"], limit: float) -> Callable[[Episode], float]:
    """Return the metric of how often people or CAVs brake beyond one of BEYOND [m/s2]."""

    def beyond(episode: Episode) -> float:
        brakings = episode.audit.people if who == "people" else episode.audit.cavs
        moments = brakings.moments
        return 1e6 * brakings.beyond[BEYOND.index(limit)] / moments if moments else nan

    whose = {"people": "People's", "cavs": "CAVs'"}[who]
    beyond.__doc__ = (
        f"{whose} moments (vehicles times simulation steps) of braking beyond {limit:g} m/s2 [per million]. "
        "ISO 15622 allows 3.5 above 20 m/s; dry asphalt hardly 9."
    )
    return beyond


def filter_share(episode: Episode) -> float:
    """Share of the CAV's decisions in which the safety filter braked harder than its driver."""
    shares = [(trajectory.filtered > 0).mean() for trajectory in episode.trajectories]
    return float(np.mean(shares)) if shares else nan


def overridden(episode: Episode) -> float:
    """Share of commands that SUMO's safety check changed, but for the right of way."""
    return episode.audit.following.overridden


def yielded(episode: Episode) -> float:
    """Share of commands that SUMO changed near a crossing, where vehicles yield."""
    return episode.audit.following.yielded


def drivable(row: dict[str, Any], people_alone: float | None = None) -> str:
    """Return the verdict on an episode: `drivable`, or the first reason why not.

    Empty where nobody automated drove, or the episode failed. `people_alone` is how often in a million
    moments people brake beyond 4.5 m/s2 where there are no CAVs; None: nobody looked.
    """
    if row["status"] == "failed" or isnan(row["cav_max_braking"]):
        return ""
    alone = "not driven" if people_alone is None else f"{people_alone:.0f}"
    floor, lanes = row.get("floor") or USUAL_FLOOR, row.get("lanes", False)
    smallest = SMALLEST_WITH_LANES if lanes else FLOOR_MET * floor
    checks = [
        (row["status"] == "collision", f"{row['collisions']:.0f} vehicles in contact"),
        ((contacts := row.get("contacts", 0)) > 0, f"{contacts} CAVs in contact"),
        (
            row["min_headway"] < smallest - TOLERANCE,
            f"follows at {row['min_headway']:.2f} s (floor {floor:g} s)",
        ),
        *(_with_lanes(row, floor) if lanes else ()),
        (row["cav_min_ttc"] < SMALLEST_TTC - TOLERANCE, f"{row['cav_min_ttc']:.2f} s to a collision"),
        (
            row["cav_max_braking"] > HARDEST_BRAKING + TOLERANCE,
            f"brakes with {row['cav_max_braking']:.1f} m/s2",
        ),
        (row["overridden"] > 0, f"SUMO overrides {100 * row['overridden']:.2g} % of its commands"),
        (
            row["people_beyond_4_5"] > (people_alone or 0.0),
            f"people brake beyond 4.5 m/s2 {row['people_beyond_4_5']:.0f} times in a million moments "
            f"(without CAVs: {alone})",
        ),
    ]
    return next((reason for fails, reason in checks if fails), DRIVABLE)


def _with_lanes(row: dict[str, Any], floor: float) -> tuple[tuple[bool, str], ...]:
    """Return what is asked besides where others may cut in."""
    short, braking = row["share_short_headway"], row["cut_in_max_braking"]
    return (
        (short > SHARE_BELOW_FLOOR, f"follows below {floor:g} s in {100 * short:.2g} % of the time"),
        (
            braking > HARDEST_AFTER_CUT_IN + TOLERANCE,
            f"brakes with {braking:.1f} m/s2 where somebody cuts in",
        ),
    )


def verdicts(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, str]:
    """Return the verdict on each driver of a road; people alone, where they are among them, are `human`."""
    return {
        label: drivable_in_all(rows, people_alone_of(label, rows_by_driver))
        for label, rows in rows_by_driver.items()
    }


def people_alone_of(label: str, rows_by_driver: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of people alone on a driver's road: of results that are compared, those of its own."""
    result, _, _ = label.rpartition(": ")
    return rows_by_driver.get(f"{result}: human", rows_by_driver.get("human", []))


def drivable_in_all(rows: Sequence[dict[str, Any]], people: Sequence[dict[str, Any]] = ()) -> str:
    """Return one verdict on all episodes of a driver: the first reason against any of them, and how many.

    `people` are the episodes of the same road in which nobody is automated: what people do there is no
    driver's fault.
    """
    alone = [row["people_beyond_4_5"] for row in people if row["status"] == "completed"]
    share = sum(alone) / len(alone) if alone else None
    verdicts = [drivable({**row, "people_beyond_4_5": 0.0}) for row in rows]
    wrong = [verdict for verdict in verdicts if verdict not in ("", DRIVABLE)]
    if wrong:
        return f"{wrong[0]} ({len(wrong)} of {len(verdicts)})"
    pairs = zip(rows, verdicts, strict=True)
    judged = [row for row, verdict in pairs if verdict and row["status"] == "completed"]
    if not judged:
        return ""
    mean = sum(row["people_beyond_4_5"] for row in judged) / len(judged)
    return drivable({**judged[0], "people_beyond_4_5": mean}, share)
