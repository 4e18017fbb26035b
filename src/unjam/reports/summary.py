"""What the report says in words, figures and tables, from the results of one folder or of several."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.effect import Effect, effects_by_driver
from unjam.measures.feasibility import FEASIBLE, feasibility_by_driver
from unjam.measures.metric_table import HUMAN_LABEL, choose_baseline, estimate_cell
from unjam.measures.metrics import METRICS
from unjam.measures.notes import early_end_notes
from unjam.measures.statistics import format_difference, gain_verdict, metric_estimate, pair_rows, paired_difference
from unjam.reports.results import PlotEpisode, Results

CLOSE_TIME_GAP = 1.0
"""time headway below which the report says so [s]; the paper's h_max"""

MAX_LIMIT_RATIO = 1.01
"""share of the limit above which the report explains how that can be"""
LOWER_IS_BETTER, HIGHER_IS_BETTER = "less", "more"
METRIC_DIRECTIONS = {
    **dict.fromkeys(("mean_speed", "mean_speed_steady", "outflow_veh_per_h"), HIGHER_IS_BETTER),
    **dict.fromkeys(
        ("travel_time", "delay", "insertion_backlog_veh", "fuel_ml_per_km", "share_standing"), LOWER_IS_BETTER
    ),
    **dict.fromkeys(("speed_std_fleet", "speed_std_fleet_steady", "time_to_dissolve"), LOWER_IS_BETTER),
    "min_ttc": HIGHER_IS_BETTER,
    **dict.fromkeys(
        ("human_max_braking", "people_beyond_3_5", "people_beyond_4_5", "people_beyond_9"), LOWER_IS_BETTER
    ),
    "collisions": LOWER_IS_BETTER,
}
"""metrics that say the same of people alone and of traffic with CAVs, in the order of the table, and what is
better of each"""


@dataclass(frozen=True)
class ReportColumn:
    """One driver of one folder, as tables and pictures name it."""

    name: str
    rows: list[dict[str, Any]]
    episode: PlotEpisode | None
    human_rows: list[dict[str, Any]] | None = None
    """those of people alone in the same folder; of themselves none"""


def report_columns(results: Sequence[Results]) -> list[ReportColumn]:
    """Return the drivers to show: all of a single folder; of several, what each folder is about."""
    if len(results) == 1:
        return [_make_column(results[0], label, label) for label in results[0].rows]
    columns: dict[str, ReportColumn] = {}
    for result, folder in zip(results, folder_names(results), strict=True):
        for label, rows in result.rows.items():
            mine = label == result.trained_label or result.trained_label is None
            name = f"{folder}: {label}" if mine else label
            if name in columns and _episode_keys(columns[name].rows) != _episode_keys(rows):
                name = f"{folder}: {label}"
            columns.setdefault(name, _make_column(result, label, name))
    return list(columns.values())


def _make_column(result: Results, label: str, name: str) -> ReportColumn:
    people = None if label == HUMAN_LABEL else result.rows.get(HUMAN_LABEL)
    return ReportColumn(name, result.rows[label], result.plot_episodes.get(label), people)


def common_baseline(results: Sequence[Results]) -> str:
    """Return beside whom the table of `report_columns` sets the drivers; of several folders who is in all."""
    first, *others = (choose_baseline(result.rows) for result in results)
    same = {tuple(_episode_keys(result.rows.get(first, []))) for result in results}
    own = len(results) > 1 and any(result.trained_label in (None, first) for result in results)
    return first if all(other == first for other in others) and len(same) == 1 and not own else ""


def _episode_keys(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return what tells the episodes of one driver from those on another road."""
    return [(str(row["seed"]), str(row["return"])) for row in rows]


def folder_names(results: Sequence[Results]) -> list[str]:
    """Return a name for each folder: as much of the end of its path as tells it from the others."""
    paths = [result.folder.resolve().parts for result in results]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [str(result.folder) for result in results]


def report_title(results: Sequence[Results]) -> str:
    """Return the page's title."""
    names = ", ".join(dict.fromkeys(result.metadata["scenario"] for result in results))
    if len(results) > 1:
        return f"{names}: {len(results)} results compared"
    only = results[0]
    if only.trained_label is None:
        return f"{names}: {', '.join(only.rows)}"
    expert = only.metadata["expert"]
    return f"{names}: a trained " + ("network" if expert == "none" else f"residual on {expert}")


def main_finding(result: Results) -> str:
    """Return the main finding of a folder in a few sentences, whichever way it went."""
    if result.trained_label is None:
        return _drive_finding(result)
    rows, effect = result.rows[result.trained_label], effects_by_driver(result.rows).get(result.trained_label)
    if effect:
        scenario, words = (
            result.metadata["scenario"],
            _effect_text(effect, feasibility_by_driver(result.rows)[result.trained_label]),
        )
        said = f"Beside people alone on {scenario}, {_pair_count(effect)} held-out seeds paired: {words}."
    else:
        earned = metric_estimate(rows, "return").mean
        said = f"On {len(rows)} held-out seeds the trained controller earns {earned:.0f} an episode."
    experts = {label: of for label, of in result.rows.items() if label not in (result.trained_label, HUMAN_LABEL)}
    returns = {label: metric_estimate(of, "return").mean for label, of in experts.items()}
    expert = result.metadata["expert"]
    best = max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default=expert)
    if expert in experts:
        gain = paired_difference(rows, experts[expert], "return")
        said += f" Return beyond its expert, {expert}: {format_difference(gain)}. {gain_verdict(gain)}"
    if best != expert:
        gain = paired_difference(rows, experts[best], "return")
        said += f" Beyond {best}, the expert that earns most: {format_difference(gain)}."
    return said


def _pair_count(effect: Effect) -> int:
    """Return on how many seeds both ran."""
    return max(effect.flow.count, effect.speed.count)


def _effect_text(effect: Effect, verdict: str) -> str:
    """Return what everybody on the road gains, and whether a car could drive so, as `verdict` says, too."""
    able = "; a car could drive so" + ("" if verdict == FEASIBLE else f", but {verdict}")
    safe = {"": "", FEASIBLE: able}
    return effect.summary + safe.get(effect.feasibility, f"; no car could drive so: {effect.feasibility}")


def _drive_finding(result: Results) -> str:
    """Return how fast all vehicles drive with each driver."""
    scenario, effects = result.metadata["scenario"], effects_by_driver(result.rows)
    if effects:
        count, found = max(_pair_count(effect) for effect in effects.values()), feasibility_by_driver(result.rows)
        said = "; ".join(f"{label}: {_effect_text(effect, found[label])}" for label, effect in effects.items())
        seeds = f"{count} episodes with the same seeds paired" if count > 1 else "one seed, which proves nothing"
        return f"Beside people alone on {scenario}, {seeds}: {said}."
    ratios = {label: metric_estimate(rows, "speed_limit_ratio_steady") for label, rows in result.rows.items()}
    if len(ratios) > 1:
        words = ", ".join(
            f"{label} {100 * ratio.mean:.0f}\u00a0%" if ratio.count else f"{label} failed"
            for label, ratio in ratios.items()
        )
        return f"Mean speed of all vehicles in steady state on {scenario}, of the limit: {words}."
    [(label, rows)] = result.rows.items()
    speed = metric_estimate(rows, "mean_speed")
    if speed.count == 0:
        return f"{label} on {scenario}: all {len(rows)} episodes failed."
    return (
        f"{label} on {scenario}, {len(rows)} episodes: all vehicles drive {speed.mean:.2f} m/s on average, "
        f"and in steady state {100 * ratios[label].mean:.0f}\u00a0% of the limit."
    )


def report_notes(result: Results) -> list[str]:
    """Return what a reader should know before trusting the main finding."""
    labels = [result.trained_label] if result.trained_label else list(result.rows)
    early = early_end_notes(result.rows)
    said = [f"{note}." for note in dict.fromkeys([*result.metadata.get("notes", []), *early])]
    return [*said, *(note for label in labels for note in _driver_notes(result, label))]


def _driver_notes(result: Results, label: str) -> list[str]:
    rows = [row for row in result.rows[label] if row["status"] != "failed"]
    notes = []
    closest = min((row["min_time_gap"] for row in rows if np.isfinite(row["min_time_gap"])), default=np.inf)
    if closest < CLOSE_TIME_GAP:
        released = result.metadata["reward"] == "released"
        blamed = " The reward (released) does not ask for distance." if released else ""
        notes.append(f"{label} drives close: its smallest time headway is {closest:.2f} s.{blamed}")
    ratio = metric_estimate(rows, "speed_limit_ratio_steady").mean
    if ratio > MAX_LIMIT_RATIO:
        notes.append(
            f"With {label} all vehicles drive at {100 * ratio:.0f} % of the limit, which is how fast people "
            "alone could drive alike: the CAV keeps a smaller gap than they would."
        )
    leaning = metric_estimate(rows, "shield_override_share").mean
    if leaning > 0.01:
        hardest = max(row["shield_max_braking"] for row in rows)
        notes.append(
            f"{label} leans on the simulator's safety check: it overrides {100 * leaning:.1f} % of commands, "
            f"braking up to {hardest:.1f} m/s² harder than asked."
        )
    return notes


def key_figures(result: Results) -> list[dict[str, str]]:
    """Return the key figures of a folder, for its trained controller or its only driver; of several none."""
    if result.trained_label is None and len(result.rows) > 1:
        return []
    label = result.trained_label or next(iter(result.rows))
    rows = result.rows[label]
    human = [] if label == "human" else result.rows.get("human", [])
    closed = all(episode.is_closed for episode in result.plot_episodes.values())
    figures = (
        ("Mean speed / limit, steady", "speed_limit_ratio_steady", 0, "%", 100.0),
        ("Speed std across vehicles, steady", "speed_std_fleet_steady", 2, "m/s", 1.0)
        if closed
        else ("Vehicles that left the road", "outflow_veh_per_h", 0, "per hour", 1.0),
        ("Fuel", "fuel_ml_per_km", 0, "ml/km", 1.0),
    )
    cards = []
    for title, name, digits, unit, scale in figures:
        found, people = (metric_estimate(of, name) for of in (rows, human))
        value, beside = (f"{scale * each.mean:.{digits}f} {unit}" if each.count else "–" for each in (found, people))
        detail = f"all-human: {beside}" if human else label
        cards.append({"label": title, "value": value, "detail": detail})
    expert = result.rows.get(result.metadata.get("expert", ""))
    if result.trained_label and expert is not None:
        gain = paired_difference(rows, expert, "return")
        beyond = estimate_cell(gain, 0, sign="+")
        detail = f"95 % interval {beyond.interval}" if gain.low < gain.high else f"of {gain.count} seeds"
        cards.append({"label": "Return beyond the expert", "value": beyond.mean, "detail": detail})
    return cards


def baseline_differences(columns: Sequence[ReportColumn]) -> dict[str, Any]:
    """Return the table of differences to people alone in the same folder, seeds paired; empty without them.

    A cell is marked better or worse where its interval lies on one side of zero, of all pairs: each for
    itself, so that of twenty cells one is marked by chance.
    """
    others = [(column, column.human_rows) for column in columns if column.human_rows is not None]
    if not others:
        return {}
    rows = []
    for name, better in METRIC_DIRECTIONS.items():
        metric = METRICS[name]
        gains = [paired_difference(column.rows, people, name) for column, people in others]
        if not any(gain.count for gain in gains):
            continue
        cells = []
        for gain, (column, people) in zip(gains, others, strict=True):
            pairs = len(pair_rows(column.rows, people))
            shown = (gain.low > 0 or gain.high < 0) and gain.count == pairs
            mark = ("better" if (gain.mean > 0) == (better is HIGHER_IS_BETTER) else "worse") if shown else ""
            cells.append({"text": str(estimate_cell(gain, metric.digits, pairs, "+")), "mark": mark})
        rows.append({"label": metric.label, "unit": metric.unit, "cells": cells})
    return {"names": [column.name for column, _ in others], "rows": rows}


def episodes_as_csv(columns: Sequence[ReportColumn]) -> str:
    """Return all episodes as CSV: a row per driver and seed, a column per metric; NaN is empty."""
    rows = [{**row, "driver": column.name} for column in columns for row in column.rows]
    table = pd.DataFrame(rows, columns=["driver", "seed", "status", *METRICS])
    return table.to_csv(index=False, lineterminator="\n")
