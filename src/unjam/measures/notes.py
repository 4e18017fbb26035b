"""What a reader of metrics should know first: missing demand, early ends, teleports, SUMO's warnings."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

from unjam.errors import InputError
from unjam.measures.metric_table import RowsByDriver
from unjam.measures.statistics import has_ended_early

MAX_EARLY_END_SHARE = 0.05
"""share of the baseline's episodes that may end early: beyond it there is nothing to compare with"""
MAX_WARNING_KINDS = 10
"""kinds of SUMO's warnings that are shown, the most frequent first"""
MAX_BACKLOG_SHARE = 0.05
"""share of the vehicles that had not entered by the end beyond which a note says so"""
LOST_DEMAND_PATTERN = re.compile(
    "sorted by departure time|no (valid )?route|discard|removing vehicle|not reachable|inserted", re.IGNORECASE
)
"""what SUMO warns of where part of the demand is missing: these warnings come first"""


def episode_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return all notes on the episodes of several drivers, the gravest first."""
    lost, others = warning_notes(rows_by_driver)
    return [
        *lost,
        *early_end_notes(rows_by_driver),
        *_backlog_notes(rows_by_driver),
        *teleport_notes(rows_by_driver),
        *others,
    ]


def count_early_ends(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Return how many episodes ended early, by reason."""
    return dict(Counter(row.get("reason") or row["status"] for row in rows if has_ended_early(row)))


def early_end_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return by driver how many episodes ended early, and why."""
    return [
        f"{label}: {_early_end_text(rows)}; means are over complete episodes only"
        for label, rows in rows_by_driver.items()
        if count_early_ends(rows)
    ]


def _early_end_text(rows: Sequence[dict[str, Any]]) -> str:
    found = count_early_ends(rows)
    why = ", ".join(f"{reason} ({count})" if len(found) > 1 else reason for reason, count in found.items())
    return f"{sum(found.values())} of {len(rows)} episodes ended early: {why}"


def check_baseline(rows: Sequence[dict[str, Any]], planned_episodes: int = 0) -> None:
    """Raise `InputError` where so many episodes of the baseline ended early that comparisons would mislead.

    Args:
        rows: those of human-only traffic so far.
        planned: how many there will be at least.
    """
    if sum(count_early_ends(rows).values()) > MAX_EARLY_END_SHARE * max(len(rows), planned_episodes):
        raise InputError(
            f"human: {_early_end_text(rows)}; allowed: {100 * MAX_EARLY_END_SHARE:g} %, for CAVs are compared with the baseline"
        )


def teleport_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return by driver how often SUMO took a vehicle off the road: no road does that."""
    counts = {label: sum(row["teleports"] for row in rows) for label, rows in rows_by_driver.items()}
    why = "that had stood for its time-to-teleport or collided"
    return [f"{label}: SUMO teleported or removed {count} vehicles {why}" for label, count in counts.items() if count]


def _backlog_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return by driver how many vehicles had not entered at the end, where they are more than a few."""
    notes = []
    for label, rows in rows_by_driver.items():
        complete = [row for row in rows if row["status"] == "completed"]
        left = sum(row["insertion_backlog_veh"] for row in complete)
        wanted = left + sum(row["vehicles"] for row in complete)
        if left > MAX_BACKLOG_SHARE * wanted:
            many = f"{left:.0f} of {wanted:.0f} vehicles"
            notes.append(f"{label}: {many} had not entered by the end: they wait in the insertion backlog")
    return notes


def warning_notes(rows_by_driver: RowsByDriver) -> tuple[list[str], list[str]]:
    """Return a note for each kind of SUMO's warnings, with one example: of missing demand, and others."""
    rows = [row for rows in rows_by_driver.values() for row in rows if row["status"] != "failed"]
    counts, episodes, examples = Counter[str](), Counter[str](), dict[str, str]()
    for each in (each for row in rows for each in row["warnings"]):
        examples.setdefault(each["kind"], each["example"])
        counts[each["kind"]] += each["count"]
        episodes[each["kind"]] += 1
    lost, others = list[str](), list[str]()
    for kind, count in counts.most_common():
        often = f" ({count} warnings of this kind in {episodes[kind]} of {len(rows)} episodes)"
        note = examples[kind] + (often if len(rows) > 1 or count > 1 else "")
        if LOST_DEMAND_PATTERN.search(kind):
            lost.append(f"demand is missing, SUMO warns: {note}")
        else:
            others.append(f"SUMO warns: {note}")
    if len(others) > MAX_WARNING_KINDS:
        others[MAX_WARNING_KINDS:] = [
            f"SUMO warns of {len(others) - MAX_WARNING_KINDS} other kinds of things, less often"
        ]
    return lost, others
