"""Texts, key figures and tables of the report, from the results of one or several folders."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from unjam.errors import printable
from unjam.measures.effect import Effect, effects_by_driver
from unjam.measures.feasibility import FEASIBLE, feasibility_by_driver
from unjam.measures.metric_table import HUMAN_LABEL, choose_baseline, estimate_cell
from unjam.measures.metrics import METRICS
from unjam.measures.notes import early_end_notes
from unjam.measures.statistics import format_difference, gain_verdict, metric_estimate, pair_rows, paired_difference
from unjam.measures.verdict import is_better
from unjam.reports.results import PlotEpisode, Results

CLOSE_TIME_GAP = 1.0
"""time gap below which the report has a note [s]; the paper's h_max"""
FORMULA_STARTS = {*"=+-@\t\r\n"}
"""first letters of a cell that a spreadsheet takes for a formula"""
MAX_LIMIT_RATIO = 1.01
"""ratio of mean speed to the limit above which the report has a note"""
COMPARED_METRICS = (
    *("mean_speed", "mean_speed_steady", "outflow_veh_per_h", "travel_time", "delay", "insertion_backlog_veh"),
    *("fuel_ml_per_km", "share_standing", "speed_std_fleet", "speed_std_fleet_steady", "time_to_dissolve", "min_ttc"),
    *("human_max_braking", "human_braking_beyond_3_5", "human_braking_beyond_4_5", "human_braking_beyond_9"),
    "collisions",
)
"""metrics with the same meaning in the human baseline and with CAVs, in the order of the table"""


@dataclass(frozen=True)
class ReportColumn:
    """One driver of one folder, as named in tables and figures."""

    name: str
    rows: list[dict[str, Any]]
    episode: PlotEpisode | None
    human_rows: list[dict[str, Any]] | None = None
    """rows of the human baseline in the same folder; None for the baseline itself"""


def report_columns(results: Sequence[Results]) -> list[ReportColumn]:
    """Return all drivers of a single folder; of several folders, shared baselines only once."""
    columns: dict[str, ReportColumn] = {}
    for result, folder in zip(results, folder_names(results), strict=True):
        for label, rows in result.rows.items():
            is_own = len(results) > 1 and result.trained_label in (None, label)
            is_other = label in columns and _episode_keys(columns[label].rows) != _episode_keys(rows)
            name = f"{folder}: {label}" if is_own or is_other else label
            human = None if label == HUMAN_LABEL else result.rows.get(HUMAN_LABEL)
            columns.setdefault(name, ReportColumn(name, rows, result.plot_episodes.get(label), human))
    return list(columns.values())


def common_baseline(results: Sequence[Results]) -> str:
    """Return the baseline of the table of `report_columns`; empty if the folders do not share one."""
    first, *others = (choose_baseline(result.rows) for result in results)
    is_same = len({tuple(_episode_keys(result.rows.get(first, []))) for result in results}) == 1
    is_own = len(results) > 1 and any(result.trained_label in (None, first) for result in results)
    return first if all(other == first for other in others) and is_same and not is_own else ""


def _episode_keys(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return a key for each episode of a driver; the keys differ between different roads."""
    return [(str(row["seed"]), str(row["return"])) for row in rows]


def folder_names(results: Sequence[Results]) -> list[str]:
    """Return a name for each folder: the shortest end of its path that is unique."""
    paths = [result.folder.resolve().parts for result in results]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [str(result.folder) for result in results]


def report_title(results: Sequence[Results]) -> str:
    """Return the title of the page."""
    names = ", ".join(dict.fromkeys(result.metadata["scenario"] for result in results))
    if len(results) > 1:
        return f"{names}: comparison of {len(results)} results"
    if results[0].trained_label is None:
        return f"{names}: {', '.join(results[0].rows)}"
    expert = results[0].metadata["expert"]
    return f"{names}: a trained " + ("network" if expert == "none" else f"residual on {expert}")


def main_finding(result: Results) -> str:
    """Return the main finding of a folder in a few sentences, positive or negative."""
    if (trained := result.trained_label) is None:
        return _drive_finding(result)
    rows = result.rows[trained]
    if effect := effects_by_driver(result.rows).get(trained):
        text = _effect_text(effect, feasibility_by_driver(result.rows)[trained])
        road, count = result.metadata["scenario"], _pair_count(effect)
        finding = f"Compared with the human baseline on {road}, {count} paired test seeds: {text}."
    else:
        mean = metric_estimate(rows, "return").mean
        finding = f"On {len(rows)} test seeds the mean return of the trained controller is {mean:.0f}."
    experts = {label: other for label, other in result.rows.items() if label not in (trained, HUMAN_LABEL)}
    returns = {label: metric_estimate(other, "return").mean for label, other in experts.items()}
    expert = result.metadata["expert"]
    best = max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default=expert)
    if expert in experts:
        gain = paired_difference(rows, experts[expert], "return")
        finding += f" Return difference to its expert, {expert}: {format_difference(gain)}. {gain_verdict(gain)}"
    if best != expert:
        gain = paired_difference(rows, experts[best], "return")
        finding += f" Return difference to {best}, the expert with the highest return: {format_difference(gain)}."
    return finding


def _pair_count(effect: Effect) -> int:
    """Return the number of seeds on which both drivers ran."""
    return max(effect.flow.count, effect.speed.count)


def _effect_text(effect: Effect, verdict: str) -> str:
    """Return the effect and the feasibility of the CAVs as text; `verdict` also takes human drivers into account."""
    feasible = "; feasible" + ("" if verdict == FEASIBLE else f", but {verdict}")
    texts = {"": "", FEASIBLE: feasible}
    return effect.summary + texts.get(effect.feasibility, f"; infeasible: {effect.feasibility}")


def _drive_finding(result: Results) -> str:
    scenario, effects = result.metadata["scenario"], effects_by_driver(result.rows)
    if effects:
        count, verdicts = max(map(_pair_count, effects.values())), feasibility_by_driver(result.rows)
        text = "; ".join(f"{label}: {_effect_text(effect, verdicts[label])}" for label, effect in effects.items())
        seeds = f"{count} episodes on paired seeds" if count > 1 else "a single seed, which proves nothing"
        return f"Compared with the human baseline on {scenario}, {seeds}: {text}."
    ratios = {label: metric_estimate(rows, "speed_limit_ratio_steady") for label, rows in result.rows.items()}
    percent = {label: f"{100 * ratio.mean:.0f}\u00a0%" for label, ratio in ratios.items()}
    if len(ratios) > 1:
        text = ", ".join(f"{label} {percent[label] if ratios[label].count else 'failed'}" for label in ratios)
        return f"Mean speed of all vehicles in steady state on {scenario}, relative to the limit: {text}."
    [(label, rows)] = result.rows.items()
    speed = metric_estimate(rows, "mean_speed")
    if speed.count == 0:
        return f"{label} on {scenario}: all {len(rows)} episodes failed."
    return (
        f"{label} on {scenario}, {len(rows)} episodes: the mean speed of all vehicles is {speed.mean:.2f} m/s, "
        f"and in steady state {percent[label]} of the limit."
    )


def report_notes(result: Results) -> list[str]:
    """Return caveats of the main finding."""
    labels = [result.trained_label] if result.trained_label else list(result.rows)
    notes = dict.fromkeys([*result.metadata.get("notes", []), *early_end_notes(result.rows)])
    return [*(f"{note}." for note in notes), *(note for label in labels for note in _driver_notes(result, label))]


def _driver_notes(result: Results, label: str) -> list[str]:
    rows = [row for row in result.rows[label] if row["status"] != "failed"]
    notes = []
    closest = min((row["min_time_gap"] for row in rows if np.isfinite(row["min_time_gap"])), default=np.inf)
    if closest < CLOSE_TIME_GAP:
        is_released = result.metadata["reward"] == "released"
        reason = " The reward (released) has no term for distance." if is_released else ""
        notes.append(f"{label} follows closely: its min time gap is {closest:.2f} s.{reason}")
    ratio = metric_estimate(rows, "speed_limit_ratio_steady").mean
    if ratio > MAX_LIMIT_RATIO:
        notes.append(
            f"With {label} the mean speed is {100 * ratio:.0f}\u00a0% of the limit, which is the equilibrium speed of "
            "human drivers: the CAV keeps a smaller gap than they would."
        )
    share = metric_estimate(rows, "shield_override_share").mean
    if share > 0.01:
        hardest = max(row["shield_max_braking"] for row in rows)
        notes.append(
            f"{label} relies on SUMO's safety check: it overrides {100 * share:.1f}\u00a0% of commands, and adds up to "
            f"{hardest:.1f} m/s² of braking."
        )
    return notes


def key_figures(result: Results) -> list[dict[str, str]]:
    """Return the key figures of the trained controller or of the only driver of a folder; none for several drivers."""
    if result.trained_label is None and len(result.rows) > 1:
        return []
    label = result.trained_label or next(iter(result.rows))
    rows = result.rows[label]
    human = [] if label == HUMAN_LABEL else result.rows.get(HUMAN_LABEL, [])
    is_closed = all(episode.is_closed for episode in result.plot_episodes.values())
    figures = (
        ("Mean speed / limit, steady", "speed_limit_ratio_steady", 0, "%", 100.0),
        ("Speed std across vehicles, steady", "speed_std_fleet_steady", 2, "m/s", 1.0)
        if is_closed
        else ("Outflow", "outflow_veh_per_h", 0, "veh/h", 1.0),
        ("Fuel", "fuel_ml_per_km", 0, "ml/km", 1.0),
    )
    cards = []
    for title, name, digits, unit, scale in figures:
        estimates = (metric_estimate(each, name) for each in (rows, human))
        value, baseline = (f"{scale * each.mean:.{digits}f} {unit}" if each.count else "–" for each in estimates)
        cards.append({"label": title, "value": value, "detail": f"human baseline: {baseline}" if human else label})
    expert = result.rows.get(result.metadata.get("expert", ""))
    if result.trained_label and expert is not None:
        gain = paired_difference(rows, expert, "return")
        cell = estimate_cell(gain, 0, sign="+")
        detail = f"95 % CI {cell.interval}" if gain.low < gain.high else f"{gain.count} seeds"
        cards.append({"label": "Return difference to expert", "value": cell.mean, "detail": detail})
    return cards


def baseline_differences(columns: Sequence[ReportColumn]) -> dict[str, Any]:
    """Return the table of paired differences to the human baseline of the same folder; empty without baselines.

    A cell is marked as better or worse if its confidence interval excludes zero and all pairs count. There is no
    correction for multiple comparisons: of twenty cells, one is marked by chance.
    """
    compared = [(column, column.human_rows) for column in columns if column.human_rows is not None]
    if not compared:
        return {}
    rows = []
    for name in COMPARED_METRICS:
        metric, cells = METRICS[name], []
        for column, human in compared:
            gain, pairs = paired_difference(column.rows, human, name), len(pair_rows(column.rows, human))
            verdict = is_better(name, gain) if gain.count == pairs else None
            mark = {True: "better", False: "worse", None: ""}[verdict]
            text = str(estimate_cell(gain, metric.digits, pairs, "+"))
            cells.append({"text": text, "mark": mark, "count": gain.count})
        if any(cell["count"] for cell in cells):
            rows.append({"label": metric.label, "unit": metric.unit, "cells": cells})
    return {"names": [column.name for column, _ in compared], "rows": rows}


def episodes_as_csv(columns: Sequence[ReportColumn]) -> str:
    """Return all episodes as CSV: a row per driver and seed, a column per metric; NaN is empty."""
    rows = [{**row, "driver": column.name} for column in columns for row in column.rows]
    table = pd.DataFrame(rows, columns=["driver", "seed", "status", *METRICS])
    return csv_text(table)


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as `printable` CSV; texts that a spreadsheet would calculate begin with an apostrophe."""

    def protect(value: Any) -> Any:
        return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA_STARTS else value

    return printable(table.rename(columns=protect).map(protect).to_csv(index=False, lineterminator="\n"))
