"""Notes on the episodes of an evaluation: missing demand, early ends, teleports, SUMO's warnings."""

import re
from collections import Counter
from math import isnan, nan

from unjam.errors import InputError
from unjam.measures.effect import FLOW_METRIC
from unjam.measures.feasibility import EpisodeRows, RowsByDriver
from unjam.measures.statistics import count_teleports, has_ended_early
from unjam.text import format_count

MAX_EARLY_END_SHARE = 0.05  # share of the baseline's episodes that may end early; with more, comparisons would mislead
MAX_WARNING_KINDS = 10  # kinds of SUMO's warnings that are shown, the most frequent first
MAX_BACKLOG_SHARE = 0.05  # share of the vehicles in the insertion backlog at the end, above which there is a note
MAX_UNFINISHED_SHARE, MAX_DELAY_SHARE = 0.05, 1 / 3
"""share of the vehicles that have not arrived at the end, above which there is a note, and share of delay in their
travel time, above which traffic is still congested"""
LOST_DEMAND_PATTERN = re.compile(
    "sorted by departure time|no (valid )?route|discard|removing vehicle|not reachable|inserted", re.IGNORECASE
)  # pattern of SUMO's warnings about missing demand, which are listed first


def episode_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return all notes on the episodes of several drivers, the most serious first."""
    lost, others = warning_notes(rows_by_driver)
    traffic = early_end_notes, _backlog_notes, _unfinished_trip_notes, _entrance_notes, _flow_notes
    notes = (note(rows_by_driver) for note in (*traffic, teleport_notes, _repeated_drive_notes))
    return [*lost, *(note for group in notes for note in group), *others]


def count_early_ends(rows: EpisodeRows) -> dict[str, int]:
    """Return the number of episodes that ended early, by reason."""
    return dict(Counter(row.get("reason") or row["status"] for row in rows if has_ended_early(row)))


def early_end_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each driver with episodes that ended early, with the reasons."""
    early = ((label, rows) for label, rows in rows_by_driver.items() if count_early_ends(rows))
    return [f"{label}: {_early_end_text(rows)}; means are over complete episodes only" for label, rows in early]


def _early_end_text(rows: EpisodeRows) -> str:
    counts = count_early_ends(rows)
    reasons = ", ".join(f"{reason} ({count})" if len(counts) > 1 else reason for reason, count in counts.items())
    return f"{sum(counts.values())} of {format_count(len(rows), 'episode')} ended early: {reasons}"


def check_baseline(rows: EpisodeRows, planned_episodes: int = 0) -> None:
    """Raise `InputError` if so many episodes of the human baseline ended early that comparisons would mislead.

    `planned_episodes` is their planned number, if it is larger than that of the `rows` so far.
    """
    if sum(count_early_ends(rows).values()) > MAX_EARLY_END_SHARE * max(len(rows), planned_episodes):
        reason = "because CAVs are compared with the baseline"
        raise InputError(f"human: {_early_end_text(rows)}; allowed: {100 * MAX_EARLY_END_SHARE:g} %, {reason}")


def teleport_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each driver with teleports, which do not exist in real traffic."""
    counts = {label: count_teleports(rows) for label, rows in rows_by_driver.items()}
    count_texts = {label: format_count(count, "vehicle") for label, count in counts.items() if count}
    reason = "which had waited longer than time-to-teleport or collided"
    return [f"{label}: SUMO teleported or removed {vehicles}, {reason}" for label, vehicles in count_texts.items()]


def _repeated_drive_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note if several episodes repeat the same part of a recording."""
    rows = max(rows_by_driver.values(), key=len, default=[])
    drives = {tuple(row[name] for name in ("file", "part", "begin")) for row in rows if "part" in row}
    if not drives or len(drives) == len(rows):
        return []
    alike = (
        "those of the same drive differ in the noise of human drivers alone: in paired differences they count as one, "
        "and intervals of single drivers are too narrow"
    )
    return [f"{format_count(len(rows), 'episode')} of {format_count(len(drives), 'recorded drive')}: {alike}"]


def _backlog_notes(rows_by_driver: RowsByDriver) -> list[str]:
    notes = []
    for label, rows in rows_by_driver.items():
        complete = [row for row in rows if row["status"] == "completed"]
        backlog = sum(row["insertion_backlog_veh"] for row in complete)
        demand = backlog + sum(row["vehicles"] for row in complete)
        if backlog > MAX_BACKLOG_SHARE * demand:
            count = f"{backlog:,.0f} of {format_count(demand, 'vehicle')}"
            notes.append(f"{label}: {count} had not entered by the end: they wait in the insertion backlog")
    return notes


def _unfinished_trip_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note if trips of many vehicles have not ended with some drivers, so that travel times are cut off."""
    shares, delayed = dict[str, float](), list[str]()
    for label, rows in rows_by_driver.items():
        complete = [row for row in rows if row["status"] == "completed" and "unfinished_trips" in row]
        # Vehicles that wait for persons are not in the backlog.
        demand = sum(max(row["vehicles"] + row["insertion_backlog_veh"], row["unfinished_trips"]) for row in complete)
        unfinished = sum(row["unfinished_trips"] for row in complete)
        if unfinished > MAX_UNFINISHED_SHARE * demand:
            shares[label] = unfinished / demand
            delay_shares = [row["delay_share_at_end"] for row in complete]
            delayed += [label] if sum(delay_shares) > MAX_DELAY_SHARE * len(delay_shares) else []
    if not shares:
        return []
    which = "" if delayed == [*shares] else f" with {'; '.join(delayed)}"
    congested = f" (traffic is still congested{which})" if delayed else ""
    most = 100 * max(shares.values())
    return [
        f"{'; '.join(shares)}: up to {most:.0f} % of the vehicles are under way or waiting at the end{congested}; "
        "their travel time counts until then, and a later --end shows more of it"
    ]


def _entrance_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each entrance at which vehicles wait without a jam, with its values in one episode."""
    rows = (row for rows in rows_by_driver.values() for row in rows)
    slow = {entrance["edge"]: entrance for row in rows for entrance in row.get("slow_entrances", ())}
    return [
        f"{edge}: {each['vehicles']} vehicles wait {each['depart_delay']:.0f} s on average for their insertion without "
        f'a jam, and depart at {each["depart_speed"]:.0f} m/s; departSpeed="max" departLane="best" lets them enter '
        "as fast as is safe, if the entrance has the capacity for the demand"
        for edge, each in slow.items()
    ]


def _flow_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note if flow is the demand with every driver, since all vehicles arrive before the end."""
    all_rows = [rows for rows in rows_by_driver.values() if rows]
    flows = dict[str, set[float]]()
    for row in (row for rows in all_rows for row in rows if row["status"] == "completed"):
        flows.setdefault(str(row["seed"]), set()).add(row.get(FLOW_METRIC, nan))
    is_demand = bool(flows) and all(len(flow) == 1 and not isnan(*flow) for flow in flows.values())
    have_arrived = all(row.get("unfinished_trips", 1) == 0 for rows in all_rows for row in rows)
    if len(all_rows) < 2 or not is_demand or not have_arrived:
        return []
    return ["flow: that of the demand with all drivers, since all vehicles arrive before the end: it says nothing here"]


def warning_notes(rows_by_driver: RowsByDriver) -> tuple[list[str], list[str]]:
    """Return a note with one example for each kind of SUMO's warnings: on missing demand, and others."""
    rows = [row for rows in rows_by_driver.values() for row in rows if row["status"] != "failed"]
    counts, episodes, examples = Counter[str](), Counter[str](), dict[str, str]()
    for warning in (warning for row in rows for warning in row["warnings"]):
        examples.setdefault(warning["kind"], warning["example"])
        counts[warning["kind"]] += warning["count"]
        episodes[warning["kind"]] += 1
    lost, others = list[str](), list[str]()
    for kind, count in counts.most_common():
        share = f"{episodes[kind]} of {format_count(len(rows), 'episode')}"
        frequency = f" ({format_count(count, 'warning')} of this kind in {share})"
        note = examples[kind] + (frequency if len(rows) > 1 or count > 1 else "")
        if LOST_DEMAND_PATTERN.search(kind):
            lost.append(f"demand is missing, SUMO warns: {note}")
        else:
            others.append(f"SUMO warns: {note}")
    if len(others) > MAX_WARNING_KINDS:
        more = len(others) - MAX_WARNING_KINDS
        others[MAX_WARNING_KINDS:] = [f"SUMO gives {format_count(more, 'less frequent kind')} of warnings"]
    return lost, others
