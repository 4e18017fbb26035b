"""What the report says in words, figures and tables, from the results of one folder or of several."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.drivable import DRIVABLE, verdicts
from unjam.measures.effect import Effect, beside_people
from unjam.measures.metrics import METRICS
from unjam.measures.notes import early_end_notes
from unjam.measures.statistics import estimate_of, paired, paired_difference, signed, verdict_on
from unjam.measures.table import PEOPLE, baseline_of, cell_of
from unjam.reports.results import Results, Shown

CLOSE_HEADWAY = 1.0
"""time headway below which the report says so [s]; the paper's h_max"""

BEYOND_LIMIT = 1.01
"""share of the limit above which the report explains how that can be"""
LESS, MORE = "less", "more"
BETTER = {
    **dict.fromkeys(("mean_speed", "mean_speed_steady", "throughput_veh_per_h"), MORE),
    **dict.fromkeys(("travel_time", "delay", "backlog_veh", "fuel_ml_per_km", "share_standing"), LESS),
    **dict.fromkeys(("speed_std_fleet", "speed_std_fleet_steady", "time_to_dissolve"), LESS),
    "min_ttc": MORE,
    **dict.fromkeys(
        ("people_max_braking", "people_beyond_3_5", "people_beyond_4_5", "people_beyond_9"), LESS
    ),
    "collisions": LESS,
}
"""metrics that say the same of people alone and of traffic with CAVs, in the order of the table, and what is
better of each"""


@dataclass(frozen=True)
class Column:
    """One driver of one folder, as tables and pictures name it."""

    name: str
    rows: list[dict[str, Any]]
    shown: Shown | None
    people: list[dict[str, Any]] | None = None
    """those of people alone in the same folder; of themselves none"""


def columns_of(results: Sequence[Results]) -> list[Column]:
    """Return the drivers to show: all of a single folder; of several, what each folder is about."""
    if len(results) == 1:
        return [_column(results[0], label, label) for label in results[0].rows]
    columns: dict[str, Column] = {}
    for result, folder in zip(results, names_of(results), strict=True):
        for label, rows in result.rows.items():
            mine = label == result.trained or result.trained is None
            name = f"{folder}: {label}" if mine else label
            if name in columns and _episodes(columns[name].rows) != _episodes(rows):
                name = f"{folder}: {label}"
            columns.setdefault(name, _column(result, label, name))
    return list(columns.values())


def _column(result: Results, label: str, name: str) -> Column:
    people = None if label == PEOPLE else result.rows.get(PEOPLE)
    return Column(name, result.rows[label], result.shown.get(label), people)


def baseline_of_columns(results: Sequence[Results]) -> str:
    """Return beside whom the table of `columns_of` sets the drivers; of several folders who is in all."""
    first, *others = (baseline_of(result.rows) for result in results)
    same = {tuple(_episodes(result.rows.get(first, []))) for result in results}
    own = len(results) > 1 and any(result.trained in (None, first) for result in results)
    return first if all(other == first for other in others) and len(same) == 1 and not own else ""


def _episodes(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return what tells the episodes of one driver from those on another road."""
    return [(str(row["seed"]), str(row["return"])) for row in rows]


def names_of(results: Sequence[Results]) -> list[str]:
    """Return a name for each folder: as much of the end of its path as tells it from the others."""
    paths = [result.folder.resolve().parts for result in results]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [str(result.folder) for result in results]


def title_of(results: Sequence[Results]) -> str:
    """Return the page's title."""
    names = ", ".join(dict.fromkeys(result.about["scenario"] for result in results))
    if len(results) > 1:
        return f"{names}: {len(results)} results compared"
    only = results[0]
    if only.trained is None:
        return f"{names}: {', '.join(only.rows)}"
    expert = only.about["expert"]
    return f"{names}: a trained " + ("network" if expert == "none" else f"residual on {expert}")


def lead_of(result: Results) -> str:
    """Return the main finding of a folder in a few sentences, whichever way it went."""
    if result.trained is None:
        return _lead_of_drives(result)
    rows, effect = result.rows[result.trained], beside_people(result.rows).get(result.trained)
    if effect:
        scenario, words = result.about["scenario"], _words_of(effect, verdicts(result.rows)[result.trained])
        said = f"Beside people alone on {scenario}, {_paired(effect)} held-out seeds paired: {words}."
    else:
        earned = estimate_of(rows, "return").mean
        said = f"On {len(rows)} held-out seeds the trained controller earns {earned:.0f} an episode."
    experts = {label: of for label, of in result.rows.items() if label not in (result.trained, PEOPLE)}
    returns = {label: estimate_of(of, "return").mean for label, of in experts.items()}
    expert = result.about["expert"]
    best = max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default=expert)
    if expert in experts:
        gain = paired_difference(rows, experts[expert], "return")
        said += f" Return beyond its expert, {expert}: {signed(gain)}. {verdict_on(gain)}"
    if best != expert:
        gain = paired_difference(rows, experts[best], "return")
        said += f" Beyond {best}, the expert that earns most: {signed(gain)}."
    return said


def _paired(effect: Effect) -> int:
    """Return on how many seeds both ran."""
    return max(effect.flow.count, effect.speed.count)


def _words_of(effect: Effect, verdict: str) -> str:
    """Return what everybody on the road gains, and whether a car could drive so, as `verdict` says, too."""
    able = "; a car could drive so" + ("" if verdict == DRIVABLE else f", but {verdict}")
    safe = {"": "", DRIVABLE: able}
    return effect.words + safe.get(effect.drivable, f"; no car could drive so: {effect.drivable}")


def _lead_of_drives(result: Results) -> str:
    """Return how fast all vehicles drive with each driver."""
    scenario, effects = result.about["scenario"], beside_people(result.rows)
    if effects:
        count, found = max(_paired(effect) for effect in effects.values()), verdicts(result.rows)
        said = "; ".join(f"{label}: {_words_of(effect, found[label])}" for label, effect in effects.items())
        seeds = (
            f"{count} episodes with the same seeds paired" if count > 1 else "one seed, which proves nothing"
        )
        return f"Beside people alone on {scenario}, {seeds}: {said}."
    ratios = {label: estimate_of(rows, "speed_limit_ratio_steady") for label, rows in result.rows.items()}
    if len(ratios) > 1:
        words = ", ".join(
            f"{label} {100 * ratio.mean:.0f}\u00a0%" if ratio.count else f"{label} failed"
            for label, ratio in ratios.items()
        )
        return f"Mean speed of all vehicles in steady state on {scenario}, of the limit: {words}."
    [(label, rows)] = result.rows.items()
    speed = estimate_of(rows, "mean_speed")
    if speed.count == 0:
        return f"{label} on {scenario}: all {len(rows)} episodes failed."
    return (
        f"{label} on {scenario}, {len(rows)} episodes: all vehicles drive {speed.mean:.2f} m/s on average, "
        f"and in steady state {100 * ratios[label].mean:.0f}\u00a0% of the limit."
    )


def notes_of(result: Results) -> list[str]:
    """Return what a reader should know before trusting the main finding."""
    labels = [result.trained] if result.trained else list(result.rows)
    early = early_end_notes(result.rows)
    said = [f"{note}." for note in dict.fromkeys([*result.about.get("notes", []), *early])]
    return [*said, *(note for label in labels for note in _notes_of(result, label))]


def _notes_of(result: Results, label: str) -> list[str]:
    rows = [row for row in result.rows[label] if row["status"] != "failed"]
    notes = []
    closest = min((row["min_headway"] for row in rows if np.isfinite(row["min_headway"])), default=np.inf)
    if closest < CLOSE_HEADWAY:
        released = result.about["reward"] == "released"
        blamed = " The reward (released) does not ask for distance." if released else ""
        notes.append(f"{label} drives close: its smallest time headway is {closest:.2f} s.{blamed}")
    ratio = estimate_of(rows, "speed_limit_ratio_steady").mean
    if ratio > BEYOND_LIMIT:
        notes.append(
            f"With {label} all vehicles drive at {100 * ratio:.0f} % of the limit, which is how fast people "
            "alone could drive alike: the CAV keeps a smaller gap than they would."
        )
    leaning = estimate_of(rows, "shield_override_share").mean
    if leaning > 0.01:
        hardest = max(row["shield_max_braking"] for row in rows)
        notes.append(
            f"{label} leans on the simulator's safety check: it overrides {100 * leaning:.1f} % of commands, "
            f"braking up to {hardest:.1f} m/s² harder than asked."
        )
    return notes


def cards_of(result: Results) -> list[dict[str, str]]:
    """Return the key figures of a folder, for its trained controller or its only driver; of several none."""
    if result.trained is None and len(result.rows) > 1:
        return []
    label = result.trained or next(iter(result.rows))
    rows = result.rows[label]
    human = [] if label == "human" else result.rows.get("human", [])
    closed = all(episode.closed for episode in result.shown.values())
    figures = (
        ("Mean speed / limit, steady", "speed_limit_ratio_steady", 0, "%", 100.0),
        ("Speed std across vehicles, steady", "speed_std_fleet_steady", 2, "m/s", 1.0)
        if closed
        else ("Vehicles that left the road", "throughput_veh_per_h", 0, "per hour", 1.0),
        ("Fuel", "fuel_ml_per_km", 0, "ml/km", 1.0),
    )
    cards = []
    for title, name, digits, unit, scale in figures:
        found, people = (estimate_of(of, name) for of in (rows, human))
        value, beside = (
            f"{scale * each.mean:.{digits}f} {unit}" if each.count else "–" for each in (found, people)
        )
        detail = f"all-human: {beside}" if human else label
        cards.append({"label": title, "value": value, "detail": detail})
    expert = result.rows.get(result.about.get("expert", ""))
    if result.trained and expert is not None:
        gain = paired_difference(rows, expert, "return")
        beyond = cell_of(gain, 0, sign="+")
        detail = f"95 % interval {beyond.interval}" if gain.low < gain.high else f"of {gain.count} seeds"
        cards.append({"label": "Return beyond the expert", "value": beyond.mean, "detail": detail})
    return cards


def against_people(columns: Sequence[Column]) -> dict[str, Any]:
    """Return the table of differences to people alone in the same folder, seeds paired; empty without them.

    A cell is marked better or worse where its interval lies on one side of zero, of all pairs: each for
    itself, so that of twenty cells one is marked by chance.
    """
    others = [(column, column.people) for column in columns if column.people is not None]
    if not others:
        return {}
    rows = []
    for name, better in BETTER.items():
        metric = METRICS[name]
        gains = [paired_difference(column.rows, people, name) for column, people in others]
        if not any(gain.count for gain in gains):
            continue
        cells = []
        for gain, (column, people) in zip(gains, others, strict=True):
            pairs = len(paired(column.rows, people))
            shown = (gain.low > 0 or gain.high < 0) and gain.count == pairs
            mark = ("better" if (gain.mean > 0) == (better is MORE) else "worse") if shown else ""
            cells.append({"text": str(cell_of(gain, metric.digits, pairs, "+")), "mark": mark})
        rows.append({"label": metric.label, "unit": metric.unit, "cells": cells})
    return {"names": [column.name for column, _ in others], "rows": rows}


def episodes_as_csv(columns: Sequence[Column]) -> str:
    """Return all episodes as CSV: a row per driver and seed, a column per metric; NaN is empty."""
    rows = [{**row, "driver": column.name} for column in columns for row in column.rows]
    table = pd.DataFrame(rows, columns=["driver", "seed", "status", *METRICS])
    return table.to_csv(index=False, lineterminator="\n")
