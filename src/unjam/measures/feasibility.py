"""Feasibility: whether a car could have driven as a CAV did. The verdict is the first limit that was violated."""

from collections.abc import Sequence
from math import isnan
from typing import Any

MIN_TIME_GAP_FRACTION = 0.9
"""smallest time gap at any moment, as a fraction of the required one"""
DEFAULT_REQUIRED_TIME_GAP = 1.0
"""required time gap on roads that do not set one [s]"""
MIN_TIME_GAP_WITH_LANES = 0.8
"""smallest time gap at any moment on roads with lanes, recovery after cut-ins excluded [s]"""
MAX_SHORT_TIME_GAP_SHARE = 1e-3
"""share of that time in which the time gap may be shorter than the required one"""
MAX_CUT_IN_BRAKING = 9.0
"""braking just after a cut-in [m/s2]: what dry asphalt allows"""
MIN_FEASIBLE_TTC = 1.0
"""[s]"""
MAX_FEASIBLE_BRAKING = 6.0
"""[m/s2]"""
FEASIBILITY_TOLERANCE = 1e-6

FEASIBLE = "feasible"
HARD_BRAKING_METRIC = "human_braking_beyond_4_5"
"""metric of human drivers that is compared with the human baseline"""


def feasibility(row: dict[str, Any], baseline_braking: float | None = None) -> str:
    """Return the verdict on an episode: `FEASIBLE`, or the first reason against it.

    It is empty for an episode that failed or had no CAV. `baseline_braking` is how often human drivers brake
    beyond 4.5 m/s2 without CAVs [per million vehicle-steps]; None: unknown.
    """
    if row["status"] == "failed" or isnan(row["cav_max_braking"]):
        return ""
    required, has_lanes = row.get("required_time_gap") or DEFAULT_REQUIRED_TIME_GAP, row.get("has_lanes", False)
    time_gap, human_braking = row["min_time_gap"], row[HARD_BRAKING_METRIC]
    min_time_gap = MIN_TIME_GAP_WITH_LANES if has_lanes else MIN_TIME_GAP_FRACTION * required
    short, cut_in = (row[name] if has_lanes else 0.0 for name in ("share_short_time_gap", "cut_in_max_braking"))
    baseline = "not driven" if baseline_braking is None else f"{baseline_braking:.0f}"
    checks = [
        (row["status"] == "collision", f"{row['collisions']:.0f} vehicles in contact"),
        ((contacts := row.get("contacts", 0)) > 0, f"{contacts} CAVs in contact"),
        (time_gap < min_time_gap - FEASIBILITY_TOLERANCE, f"time gap {time_gap:.2f} s (limit {required:g} s)"),
        (short > MAX_SHORT_TIME_GAP_SHARE, f"time gap below {required:g} s in {100 * short:.2g} % of the time"),
        (cut_in > MAX_CUT_IN_BRAKING + FEASIBILITY_TOLERANCE, f"brakes with {cut_in:.1f} m/s2 after a cut-in"),
        (row["cav_min_ttc"] < MIN_FEASIBLE_TTC - FEASIBILITY_TOLERANCE, f"{row['cav_min_ttc']:.2f} s to a collision"),
        (
            row["cav_max_braking"] > MAX_FEASIBLE_BRAKING + FEASIBILITY_TOLERANCE,
            f"brakes with {row['cav_max_braking']:.1f} m/s2",
        ),
        (row["override_share"] > 0, f"SUMO overrides {100 * row['override_share']:.2g} % of its commands"),
        (
            human_braking > (baseline_braking or 0.0),
            f"human drivers brake beyond 4.5 m/s2 {human_braking:.0f} times in a million vehicle-steps "
            f"(without CAVs: {baseline})",
        ),
    ]
    return next((reason for fails, reason in checks if fails), FEASIBLE)


def feasibility_by_driver(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, str]:
    """Return the verdict on each driver of a road; that of the human baseline is empty."""
    return {
        label: overall_feasibility(rows, baseline_rows(label, rows_by_driver)) for label, rows in rows_by_driver.items()
    }


def baseline_rows(label: str, rows_by_driver: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of the human baseline of a driver; of compared results, those of the same result."""
    result, _, _ = label.rpartition(": ")
    return rows_by_driver.get(f"{result}: human", rows_by_driver.get("human", []))


def overall_feasibility(rows: Sequence[dict[str, Any]], baseline: Sequence[dict[str, Any]] = ()) -> str:
    """Return one verdict on all episodes of a driver: the first reason against any of them, and how many violate.

    `baseline` has the rows of human-only traffic on the same road: a driver is not blamed for braking that
    human drivers do without CAVs.
    """
    alone = [row[HARD_BRAKING_METRIC] for row in baseline if row["status"] == "completed"]
    verdicts = [feasibility({**row, HARD_BRAKING_METRIC: 0.0}) for row in rows]
    if violations := [verdict for verdict in verdicts if verdict not in ("", FEASIBLE)]:
        return f"{violations[0]} ({len(violations)} of {len(verdicts)})"
    pairs = zip(rows, verdicts, strict=True)
    completed = [row for row, verdict in pairs if verdict and row["status"] == "completed"]
    if not completed:
        return ""
    mean = sum(row[HARD_BRAKING_METRIC] for row in completed) / len(completed)
    return feasibility({**completed[0], HARD_BRAKING_METRIC: mean}, sum(alone) / len(alone) if alone else None)
