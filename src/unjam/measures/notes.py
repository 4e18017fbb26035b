"""Notes on the episodes of an evaluation: missing demand, early ends, teleports, SUMO's warnings."""

import re
from collections import Counter
from math import isnan, nan

from unjam.errors import InputError
from unjam.measures.effect import FLOW_METRIC
from unjam.measures.feasibility import EpisodeRows, RowsByDriver
from unjam.measures.statistics import count_teleports, has_ended_early
from unjam.text import format_count

MAX_EARLY_END_SHARE = 0.05  # share of the baseline's episodes that may end early in comparisons
MAX_WARNING_KINDS = 10  # maximum number of kinds of SUMO's warnings in notes, the most frequent first
MAX_BACKLOG_SHARE = 0.05  # share of vehicles in the insertion backlog at the end above which there is a note
MAX_UNFINISHED_SHARE, MAX_DELAY_SHARE = 0.05, 1 / 3
"""share of vehicles that have not arrived at the end above which there is a note, and share of delay in their travel
time above which traffic counts as congested"""
LOST_DEMAND_PATTERN = re.compile(
    "sorted by departure time|no (valid )?route|discard|removing vehicle|not reachable|inserted", re.IGNORECASE
)  # pattern of SUMO's warnings about missing demand, which are listed first


def episode_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return all notes on the episodes of several drivers, the most serious first."""
    demand_warnings, other_warnings = warning_notes(rows_by_driver)
    traffic = early_end_notes, _backlog_notes, _unfinished_trip_notes, _entrance_notes, _flow_notes
    groups = (find_notes(rows_by_driver) for find_notes in (*traffic, teleport_notes, _repeated_drive_notes))
    return [*demand_warnings, *(note for group in groups for note in group), *other_warnings]


def count_early_ends(rows: EpisodeRows) -> dict[str, int]:
    """Return the number of episodes that ended early, by reason."""
    return dict(Counter(row.get("reason") or row["status"] for row in rows if has_ended_early(row)))


def early_end_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note with reasons for each driver with episodes that ended early."""
    affected = ((label, rows) for label, rows in rows_by_driver.items() if count_early_ends(rows))
    return [f"{label}: {_early_end_text(rows)}; means are over complete episodes only" for label, rows in affected]


def _early_end_text(rows: EpisodeRows) -> str:
    counts = count_early_ends(rows)
    reasons = ", ".join(f"{reason} ({count})" if len(counts) > 1 else reason for reason, count in counts.items())
    return f"{sum(counts.values())} of {format_count(len(rows), 'episode')} ended early: {reasons}"


def check_baseline(rows: EpisodeRows, planned_episodes: int = 0) -> None:
    """Raise `InputError` if too many episodes of the human baseline ended early for a comparison.

    `planned_episodes` is the planned number of episodes if `rows` do not yet have all of them.
    """
    if sum(count_early_ends(rows).values()) > MAX_EARLY_END_SHARE * max(len(rows), planned_episodes):
        reason = "because CAVs are compared with the baseline"
        raise InputError(f"human: {_early_end_text(rows)}; allowed: {100 * MAX_EARLY_END_SHARE:g} %, {reason}")


def teleport_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each driver with teleports, which are artifacts of the simulation."""
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
    consequence = (
        "episodes of the same drive differ only in the noise of human drivers: they count as one in paired "
        "differences, and confidence intervals of single drivers are too narrow"
    )
    return [f"{format_count(len(rows), 'episode')} of {format_count(len(drives), 'recorded drive')}: {consequence}"]


def _backlog_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each driver with many vehicles in the insertion backlog at the end."""
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
    """Return a note on the drivers with which many trips have not ended, so that travel times are cut off."""
    shares, congested_drivers = dict[str, float](), list[str]()
    for label, rows in rows_by_driver.items():
        complete = [row for row in rows if row["status"] == "completed" and "unfinished_trips" in row]
        # Vehicles that wait for persons are not in the backlog.
        demand = sum(max(row["vehicles"] + row["insertion_backlog_veh"], row["unfinished_trips"]) for row in complete)
        unfinished = sum(row["unfinished_trips"] for row in complete)
        if unfinished > MAX_UNFINISHED_SHARE * demand:
            shares[label] = unfinished / demand
            delay_shares = [row["delay_share_at_end"] for row in complete]
            congested_drivers += [label] if sum(delay_shares) > MAX_DELAY_SHARE * len(delay_shares) else []
    if not shares:
        return []
    drivers = "" if congested_drivers == [*shares] else f" with {'; '.join(congested_drivers)}"
    congested = f" (traffic is still congested{drivers})" if congested_drivers else ""
    percent = 100 * max(shares.values())
    return [
        f"{'; '.join(shares)}: up to {percent:.0f} % of the vehicles are under way or waiting at the end{congested}; "
        "their travel time counts until then, and a later --end shows more of it"
    ]


def _entrance_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note for each entrance at which vehicles wait without a jam, with the values of one episode."""
    rows = (row for rows in rows_by_driver.values() for row in rows)
    slow_entrances = {entrance["edge"]: entrance for row in rows for entrance in row.get("slow_entrances", ())}
    return [
        f"{edge}: {entrance['vehicles']} vehicles wait {entrance['depart_delay']:.0f} s on average for their insertion "
        f'without a jam, and depart at {entrance["depart_speed"]:.0f} m/s; departSpeed="max" departLane="best" lets '
        "them enter as fast as is safe, if the entrance has the capacity for the demand"
        for edge, entrance in slow_entrances.items()
    ]


def _flow_notes(rows_by_driver: RowsByDriver) -> list[str]:
    """Return a note if flow equals the demand with all drivers, because all vehicles arrive before the end."""
    all_rows = [rows for rows in rows_by_driver.values() if rows]
    flows = dict[str, set[float]]()
    for row in (row for rows in all_rows for row in rows if row["status"] == "completed"):
        flows.setdefault(str(row["seed"]), set()).add(row.get(FLOW_METRIC, nan))
    is_demand = bool(flows) and all(len(flow) == 1 and not isnan(*flow) for flow in flows.values())
    have_arrived = all(row.get("unfinished_trips", 1) == 0 for rows in all_rows for row in rows)
    if len(all_rows) < 2 or not is_demand or not have_arrived:
        return []
    return [
        "flow: equal to the demand with all drivers, because all vehicles arrive before the end: it is no result here"
    ]


def warning_notes(rows_by_driver: RowsByDriver) -> tuple[list[str], list[str]]:
    """Return notes on missing demand, and notes on other warnings of SUMO: an example of each kind of warning."""
    rows = [row for rows in rows_by_driver.values() for row in rows if row["status"] != "failed"]
    counts, episodes, examples = Counter[str](), Counter[str](), dict[str, str]()
    for warning in (warning for row in rows for warning in row["warnings"]):
        examples.setdefault(warning["kind"], warning["example"])
        counts[warning["kind"]] += warning["count"]
        episodes[warning["kind"]] += 1
    demand_notes, other_notes = list[str](), list[str]()
    for kind, count in counts.most_common():
        share = f"{episodes[kind]} of {format_count(len(rows), 'episode')}"
        frequency = f" ({format_count(count, 'warning')} of this kind in {share})"
        note = examples[kind] + (frequency if len(rows) > 1 or count > 1 else "")
        if LOST_DEMAND_PATTERN.search(kind):
            demand_notes.append(f"demand is missing, SUMO warns: {note}")
        else:
            other_notes.append(f"SUMO warns: {note}")
    if len(other_notes) > MAX_WARNING_KINDS:
        omitted = len(other_notes) - MAX_WARNING_KINDS
        other_notes[MAX_WARNING_KINDS:] = [f"SUMO gives {format_count(omitted, 'less frequent kind')} of warnings"]
    return demand_notes, other_notes
