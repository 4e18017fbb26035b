"""Could a car have driven so? What an episode's audit says, and the verdict: the first reason against it."""

from collections.abc import Callable, Sequence
from math import isfinite, isnan, nan
from typing import Any, Literal

import numpy as np

from unjam.worlds.audit import BRAKING_THRESHOLDS
from unjam.worlds.record import Episode

MIN_TIME_GAP_FRACTION = 0.9
"""share of the demanded time headway that must be left at any moment"""
DEFAULT_REQUIRED_TIME_GAP = 1.0
"""time headway that is demanded where a road names none [s]"""
MIN_TIME_GAP_WITH_LANES = 0.8
"""time headway behind who was followed for long that must be left at any moment, where others cut in [s]"""
MAX_SHORT_TIME_GAP_SHARE = 1e-3
"""of that time, how much may be below the floor"""
MAX_CUT_IN_BRAKING = 9.0
"""braking just after somebody has cut in [m/s2]: what dry asphalt allows"""
MIN_FEASIBLE_TTC = 1.0
"""[s]"""
MAX_FEASIBLE_BRAKING = 6.0
"""[m/s2]"""
FEASIBILITY_TOLERANCE = 1e-6

FEASIBLE = "feasible"


def min_time_gap(episode: Episode) -> float:
    """Smallest time headway of the CAV, gap over speed, while it drives faster than 1 m/s [s]; NaN if never.

    In any simulation step, as all that follows; on the merge after every decision.
    """
    return _nan_if_infinite(episode.audit.following.min_time_gap)


def _nan_if_infinite(value: float) -> float:
    return value if isfinite(value) else nan


def share_short_time_gap(episode: Episode) -> float:
    """Share of the CAV's time faster than 1 m/s with a time headway below one second."""
    return episode.audit.following.share_short_time_gap


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
    return _nan_if_infinite(episode.audit.following.min_time_to_collision)


def max_drac(episode: Episode) -> float:
    """Largest deceleration rate to avoid a crash of the CAV, closing speed squared over twice the gap [m/s2].

    Almqvist, Hyden and Risser 1991.
    """
    return episode.audit.following.max_required_braking


def max_jerk(episode: Episode) -> float:
    """Largest change of the CAV's acceleration over time [m/s3]."""
    return episode.audit.following.max_jerk


def cav_max_braking(episode: Episode) -> float:
    """Hardest braking of a CAV [m/s2]; NaN where nobody is automated."""
    return episode.audit.cav_braking.max_braking if episode.audit.cav_braking.samples else nan


def cut_in_max_braking(episode: Episode) -> float:
    """Hardest braking of a CAV in the 3 s after somebody else came before it [m/s2], on roads with lanes.

    It is not part of the other brakings of CAVs; NaN where nobody may cut in.
    """
    return episode.audit.cut_in_braking.max_braking if episode.audit.cut_in_braking.samples else nan


def human_max_braking(episode: Episode) -> float:
    """Hardest braking of people [m/s2]."""
    return episode.audit.human_braking.max_braking


def braking_beyond_metric(group: Literal["humans", "cavs"], limit: float) -> Callable[[Episode], float]:
    """Return the metric of how often people or CAVs brake beyond one of BEYOND [m/s2]."""

    def beyond(episode: Episode) -> float:
        brakings = episode.audit.human_braking if group == "humans" else episode.audit.cav_braking
        moments = brakings.samples
        return 1e6 * brakings.exceedances[BRAKING_THRESHOLDS.index(limit)] / moments if moments else nan

    beyond.__doc__ = (
        f"{group.capitalize()}: vehicle-steps with braking beyond {limit:g} m/s2 [per million]. ".replace("Cavs", "CAVs")
        + "ISO 15622 allows 3.5 above 20 m/s; dry asphalt allows hardly 9."
    )
    return beyond


def filter_override_share(episode: Episode) -> float:
    """Share of the CAV's decisions in which the safety filter braked harder than its driver."""
    shares = [(trajectory.filter_braking > 0).mean() for trajectory in episode.trajectories]
    return float(np.mean(shares)) if shares else nan


def override_share(episode: Episode) -> float:
    """Share of commands that SUMO's safety check changed, but for the right of way."""
    return episode.audit.following.override_share


def yield_share(episode: Episode) -> float:
    """Share of commands that SUMO changed near a crossing, where vehicles yield."""
    return episode.audit.following.yield_share


def feasibility(row: dict[str, Any], baseline_braking: float | None = None) -> str:
    """Return the verdict on an episode: `feasibility`, or the first reason why not.

    Empty where nobody automated drove, or the episode failed. `people_alone` is how often in a million
    moments people brake beyond 4.5 m/s2 where there are no CAVs; None: nobody looked.
    """
    if row["status"] == "failed" or isnan(row["cav_max_braking"]):
        return ""
    alone = "not driven" if baseline_braking is None else f"{baseline_braking:.0f}"
    floor, lanes = row.get("required_time_gap") or DEFAULT_REQUIRED_TIME_GAP, row.get("has_lanes", False)
    smallest = MIN_TIME_GAP_WITH_LANES if lanes else MIN_TIME_GAP_FRACTION * floor
    checks = [
        (row["status"] == "collision", f"{row['collisions']:.0f} vehicles in contact"),
        ((contacts := row.get("contacts", 0)) > 0, f"{contacts} CAVs in contact"),
        (
            row["min_time_gap"] < smallest - FEASIBILITY_TOLERANCE,
            f"follows at {row['min_time_gap']:.2f} s (floor {floor:g} s)",
        ),
        *(_lane_checks(row, floor) if lanes else ()),
        (row["cav_min_ttc"] < MIN_FEASIBLE_TTC - FEASIBILITY_TOLERANCE, f"{row['cav_min_ttc']:.2f} s to a collision"),
        (
            row["cav_max_braking"] > MAX_FEASIBLE_BRAKING + FEASIBILITY_TOLERANCE,
            f"brakes with {row['cav_max_braking']:.1f} m/s2",
        ),
        (row["override_share"] > 0, f"SUMO overrides {100 * row['override_share']:.2g} % of its commands"),
        (
            row["human_braking_beyond_4_5"] > (baseline_braking or 0.0),
            f"people brake beyond 4.5 m/s2 {row['human_braking_beyond_4_5']:.0f} times in a million moments "
            f"(without CAVs: {alone})",
        ),
    ]
    return next((reason for fails, reason in checks if fails), FEASIBLE)


def _lane_checks(row: dict[str, Any], required_time_gap: float) -> tuple[tuple[bool, str], ...]:
    """Return what is asked besides where others may cut in."""
    short, braking = row["share_short_time_gap"], row["cut_in_max_braking"]
    return (
        (short > MAX_SHORT_TIME_GAP_SHARE, f"follows below {required_time_gap:g} s in {100 * short:.2g} % of the time"),
        (
            braking > MAX_CUT_IN_BRAKING + FEASIBILITY_TOLERANCE,
            f"brakes with {braking:.1f} m/s2 where somebody cuts in",
        ),
    )


def feasibility_by_driver(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, str]:
    """Return the verdict on each driver of a road; people alone, where they are among them, are `human`."""
    return {
        label: overall_feasibility(rows, baseline_rows(label, rows_by_driver)) for label, rows in rows_by_driver.items()
    }


def baseline_rows(label: str, rows_by_driver: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of people alone on a driver's road: of results that are compared, those of its own."""
    result, _, _ = label.rpartition(": ")
    return rows_by_driver.get(f"{result}: human", rows_by_driver.get("human", []))


def overall_feasibility(rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]] = ()) -> str:
    """Return one verdict on all episodes of a driver: the first reason against any of them, and how many.

    `people` are the episodes of the same road in which nobody is automated: what people do there is no
    driver's fault.
    """
    alone = [row["human_braking_beyond_4_5"] for row in baseline if row["status"] == "completed"]
    share = sum(alone) / len(alone) if alone else None
    verdicts = [feasibility({**row, "human_braking_beyond_4_5": 0.0}) for row in rows]
    wrong = [verdict for verdict in verdicts if verdict not in ("", FEASIBLE)]
    if wrong:
        return f"{wrong[0]} ({len(wrong)} of {len(verdicts)})"
    pairs = zip(rows, verdicts, strict=True)
    judged = [row for row, verdict in pairs if verdict and row["status"] == "completed"]
    if not judged:
        return ""
    mean = sum(row["human_braking_beyond_4_5"] for row in judged) / len(judged)
    return feasibility({**judged[0], "human_braking_beyond_4_5": mean}, share)
