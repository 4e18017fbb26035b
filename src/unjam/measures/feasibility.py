"""Feasibility check: whether a real vehicle could drive like a CAV. The verdict names the first violated limit."""

from collections.abc import Sequence
from math import isnan
from typing import Any

from unjam.text import format_count

MIN_TIME_GAP_FRACTION = 0.9  # minimum time gap in every step, as a fraction of the required time gap
DEFAULT_REQUIRED_TIME_GAP = 1.0  # required time gap on roads that do not define one [s]
MIN_TIME_GAP_WITH_LANES = 0.8  # minimum time gap on roads with lanes [s], not during recovery from cut-ins
MAX_SHORT_TIME_GAP_SHARE = 1e-3
"""maximum share of time with a time gap below the required one on roads with lanes, not during this recovery"""
MAX_CUT_IN_BRAKING = 9.0  # maximum braking after a cut-in [m/s2]: about the limit on dry asphalt
MIN_FEASIBLE_TTC = 1.0  # minimum time to collision [s]
MAX_FEASIBLE_BRAKING = 6.0  # maximum braking [m/s2]
TOLERANCE = 1e-6  # tolerance for rounding errors

EpisodeRows = Sequence[dict[str, Any]]  # a row of metrics for each episode, including failed episodes
RowsByDriver = dict[str, list[dict[str, Any]]]
FEASIBLE = "feasible"
HARD_BRAKING_METRIC = "human_braking_beyond_4_5"  # it must not exceed that of the human baseline


def feasibility(row: dict[str, Any], baseline_braking: float | None = None) -> str:
    """Return the verdict on an episode: `FEASIBLE`, or the first reason against it.

    The verdict is empty for an episode that failed or had no CAV. `baseline_braking` is the `HARD_BRAKING_METRIC` of
    the human baseline [per million vehicle-steps]; None: unknown.
    """
    if row["status"] == "failed" or isnan(row["cav_max_braking"]):
        return ""
    return next((reason for _, _, reason in _violations(row, baseline_braking)), FEASIBLE)


def _violations(row: dict[str, Any], baseline_braking: float | None) -> list[tuple[int, float, str]]:
    """Return the rank, the value and a text for each violated limit; a larger value is a worse violation."""
    required, has_lanes = row.get("required_time_gap") or DEFAULT_REQUIRED_TIME_GAP, row.get("has_lanes", False)
    time_gap, human_braking = row["min_time_gap"], row[HARD_BRAKING_METRIC]
    min_time_gap = MIN_TIME_GAP_WITH_LANES if has_lanes else MIN_TIME_GAP_FRACTION * required
    short, cut_in = (row[name] if has_lanes else 0.0 for name in ("share_short_time_gap", "cut_in_max_braking"))
    baseline = "unknown, -d human measures it" if baseline_braking is None else _rate_text(baseline_braking)
    rate = f"{_rate_text(human_braking)} times in a million vehicle-steps (without CAVs: {baseline})"
    has_crashed, contacts, braking = row["status"] == "collision", float(row.get("contacts", 0)), row["cav_max_braking"]
    checks = (  # value, largest allowed value, reason
        (has_crashed * (1.0 + row["collisions"]), 0.0, f"{format_count(row['collisions'], 'vehicle')} in contact"),
        (contacts, 0.0, f"{format_count(contacts, 'CAV')} in contact"),
        (-time_gap, TOLERANCE - min_time_gap, f"time gap {time_gap:.2f} s (limit {min_time_gap:g} s)"),
        (short, MAX_SHORT_TIME_GAP_SHARE, f"time gap below {required:g} s in {100 * short:.2g} % of the time"),
        (cut_in, TOLERANCE + MAX_CUT_IN_BRAKING, f"brakes with {cut_in:.1f} m/s2 after a cut-in"),
        (-row["cav_min_ttc"], TOLERANCE - MIN_FEASIBLE_TTC, f"{row['cav_min_ttc']:.2f} s to a collision"),
        (braking, TOLERANCE + MAX_FEASIBLE_BRAKING, f"brakes with {braking:.1f} m/s2"),
        (row["override_share"], 0.0, f"the simulator overrides {100 * row['override_share']:.2g} % of its commands"),
        (human_braking, baseline_braking or 0.0, f"human drivers brake beyond 4.5 m/s2 {rate}"),
    )
    return [(rank, value, reason) for rank, (value, limit, reason) in enumerate(checks) if value > limit]


def _rate_text(rate: float) -> str:
    """Return a rate as text, with at least three digits and without an exponent."""
    return f"{rate:,.0f}" if rate >= 100.0 else f"{rate:.3g}"


def feasibility_by_driver(rows_by_driver: RowsByDriver) -> dict[str, str]:
    """Return the verdict on each driver of a road; the verdict on the human baseline is empty."""
    baselines = {label: baseline_rows(label, rows_by_driver) for label in rows_by_driver}
    return {label: overall_feasibility(rows, baselines[label]) for label, rows in rows_by_driver.items()}


def baseline_rows(label: str, rows_by_driver: RowsByDriver) -> list[dict[str, Any]]:
    """Return the rows of the human baseline for a driver; in a comparison, they are of the same result."""
    result, _, _ = label.rpartition(": ")
    return rows_by_driver.get(f"{result}: human", rows_by_driver.get("human", []))


def overall_feasibility(rows: EpisodeRows, baseline: EpisodeRows = ()) -> str:
    """Return one verdict on all episodes of a driver, with the number of episodes that violate a limit.

    The reason is the first limit that any episode violates, with the value of the worst episode. `baseline` has the
    rows of the human baseline on the same road, with which the braking of human drivers is compared.
    """
    baseline_braking = [row[HARD_BRAKING_METRIC] for row in baseline if row["status"] == "completed"]
    cav_rows = [{**row, HARD_BRAKING_METRIC: 0.0} for row in rows]  # braking of human drivers is compared below
    verdicts = list(map(feasibility, cav_rows))
    infeasible = [row for row, verdict in zip(cav_rows, verdicts, strict=True) if verdict not in ("", FEASIBLE)]
    if infeasible:
        violations = [min(_violations(row, None), key=lambda violation: violation[0]) for row in infeasible]
        _, _, reason = min(violations, key=lambda violation: (violation[0], -violation[1]))
        return f"{reason} ({len(infeasible)} of {len(rows)})"
    pairs = zip(rows, verdicts, strict=True)
    completed = [row for row, verdict in pairs if verdict and row["status"] == "completed"]
    if not completed:
        return ""
    mean = sum(row[HARD_BRAKING_METRIC] for row in completed) / len(completed)
    baseline_mean = sum(baseline_braking) / len(baseline_braking) if baseline_braking else None
    return feasibility({**completed[0], HARD_BRAKING_METRIC: mean}, baseline_mean)
