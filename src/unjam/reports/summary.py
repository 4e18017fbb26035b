"""Texts, key figures and tables of a report on one or several folders of results."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.effect import LAG_METRIC, POWER_FUEL_METRIC
from unjam.measures.feasibility import EpisodeRows
from unjam.measures.metric_table import HUMAN_LABEL, choose_baseline, driver_rank, estimate_cell
from unjam.measures.metrics import METRICS
from unjam.measures.notes import early_end_notes
from unjam.measures.statistics import (
    count_units,
    format_difference,
    format_units,
    gain_verdict,
    is_expert_unchanged,
    metric_estimate,
    pair_rows,
    paired_difference,
)
from unjam.measures.verdict import Verdict, is_better, road_metrics, verdicts
from unjam.reports.results import PlotEpisode, Results, is_outdated, original_command, selected_row
from unjam.text import format_count, printable

CLOSE_TIME_GAP = 1.0  # time gap below which the report has a note [s]; h_max of the paper
IRRELEVANT_OPTIONS, IRRELEVANT_FLAGS = ("--out", "--workers"), ("--json", "--all")
"""options of a command with and without a value that have no effect on its results"""
FORMULA_STARTS = {*"=+-@\t\r\n"}  # first characters of cells that a spreadsheet reads as formulas
MAX_LIMIT_RATIO = 1.01  # ratio of mean speed to the limit above which the report has a note
COMPARED_METRICS = (
    *("mean_speed", "mean_speed_steady", "outflow_veh_per_h", "travel_time", "delay", "insertion_backlog_veh"),
    *(POWER_FUEL_METRIC, "share_standing", "speed_std_fleet", "speed_std_fleet_steady"),
    *("time_to_dissolve", "min_ttc"),
    *("human_max_braking", "human_braking_beyond_3_5", "human_braking_beyond_4_5", "human_braking_beyond_9"),
    *("cav_mean_gap", LAG_METRIC, "amplification_long", "amplification_medium", "amplification_short", "collisions"),
)  # metrics with the same meaning in the human baseline and with CAVs, in the order of the table


@dataclass(frozen=True)
class ReportColumn:
    """One driver of one folder, with its name in tables and figures."""

    name: str
    rows: list[dict[str, Any]]
    episode: PlotEpisode | None
    baseline_rows: list[dict[str, Any]] | None = None  # rows of the baseline; None for the baseline itself
    verdict: Verdict | None = None  # compared with the baseline


def report_columns(results: Sequence[Results]) -> list[ReportColumn]:
    """Return all drivers in the order of `driver_rank`; a driver with equal episodes in several folders only once."""
    columns: dict[str, ReportColumn] = {}
    for result, folder in zip(results, folder_names(results), strict=True):
        baseline = result.baseline or HUMAN_LABEL
        verdict_by_driver = {verdict.driver: verdict for verdict in verdicts(result.rows, baseline)}
        for label, rows in result.rows.items():
            is_of_folder = len(results) > 1 and result.trained_label in (None, label)
            has_homonym = label in columns and _episode_keys(columns[label].rows) != _episode_keys(rows)
            name = f"{folder}: {label}" if is_of_folder or has_homonym else label
            baseline_rows = None if label == baseline else result.rows.get(baseline)
            verdict = replace(verdict_by_driver[label], driver=name) if label in verdict_by_driver else None
            episode = result.plot_episodes.get(label)
            columns.setdefault(name, ReportColumn(name, rows, episode, baseline_rows, verdict))
    return sorted(columns.values(), key=lambda column: driver_rank(column.name))


def common_baseline(results: Sequence[Results]) -> str:
    """Return the baseline of the table of `report_columns`; empty if the folders do not share one."""
    baselines = [choose_baseline(result.rows, result.baseline) for result in results]
    baseline = baselines[0]
    has_same_episodes = len({tuple(_episode_keys(result.rows.get(baseline, []))) for result in results}) == 1
    is_of_folder = len(results) > 1 and any(result.trained_label in (None, baseline) for result in results)
    return baseline if len(set(baselines)) == 1 and has_same_episodes and not is_of_folder else ""


def first_network_column(results: Sequence[Results]) -> str:
    """Return the name of the column of human drivers on the first of several user networks; else an empty text.

    Human drivers on the other networks, for example with a speed limit, are compared with it on common seeds.
    """
    has_humans = all(HUMAN_LABEL in result.rows and result.trained_label is None for result in results)
    are_networks = all(result.metadata["scenario"].endswith(".sumocfg") for result in results)
    seeds = common_seeds(results)
    keys = [_episode_keys(result.rows[HUMAN_LABEL]) for result in results] if has_humans else []
    episodes = {str([key for key in network_keys if key[0] in seeds]) for network_keys in keys}
    is_comparison = len(results) > 1 and are_networks and bool(seeds) and len(episodes) > 1
    return f"{folder_names(results)[0]}: {HUMAN_LABEL}" if is_comparison else ""


def common_seeds(results: Sequence[Results]) -> set[str]:
    """Return the seeds on which all folders have human drivers."""
    return set.intersection(*({str(row["seed"]) for row in result.rows.get(HUMAN_LABEL, [])} for result in results))


def compare_networks(column: ReportColumn, first_rows: Sequence[dict[str, Any]]) -> ReportColumn:
    """Return the column of human drivers on another network, compared with the first network on common seeds."""
    label = "human drivers of the first network"
    rows, baseline_rows = (list(paired) for paired in zip(*pair_rows(column.rows, first_rows), strict=True))
    (verdict,) = verdicts({label: baseline_rows, column.name: rows}, label)
    return replace(column, rows=rows, baseline_rows=baseline_rows, verdict=verdict)


def _episode_keys(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return a key for each episode of a driver; keys of different roads are different."""
    return [(str(row["seed"]), str(row["return"])) for row in rows]


def folder_names(results: Sequence[Results]) -> list[str]:
    """Return a name for each folder: the shortest unique end of its path."""
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
        return f"{names}: comparison of {format_count(len(results), 'result')}"
    if results[0].trained_label is None:
        return f"{names}: {', '.join(results[0].rows)}"
    expert = results[0].metadata["expert"]
    return f"{names}: a trained " + ("network" if expert == "none" else f"residual on {expert}")


def mismatch_warning(results: Sequence[Results]) -> str:
    """Return a warning if several folders have different roads, seeds or durations; else an empty text.

    If user networks are compared with the first of them, an explanation replaces the warning. There is none for the
    tasks of a training, which have different roads on purpose.
    """
    parents = {result.folder.resolve().parent for result in results}
    if len(parents) == 1 and (parents.pop() / "config.toml").is_file():
        return ""
    episodes = [next(iter(result.plot_episodes.values()), None) for result in results]
    comparable = [episode for episode in episodes if episode is not None and not episode.has_recorded_leader]
    properties = {
        "roads": [result.metadata["scenario"] for result in results],
        "geometries": [road.outline.round().tobytes() + road.lane_lines.round().tobytes() for road in comparable],
        "seeds": [str([row["seed"] for row in next(iter(result.rows.values()), [])]) for result in results],
        "durations": [str(episode.times[-1]) for episode in comparable if episode.status == "completed"],
    }
    different = [name for name, values in properties.items() if len(set(values)) > 1]
    if (first := first_network_column(results)) and "durations" not in different:
        return (
            f"Human drivers of these networks are compared with {first}, on the seeds that both have. Delay is the "
            "time lost to the speed that is allowed at each moment: a speed limit hides its own cost, so compare "
            "travel times."
        )
    if not different:
        return ""
    listed = ", ".join(different)
    return f"These folders have different {listed}: differences between them are not effects of the drivers alone."


def command_differences(results: Sequence[Results]) -> list[tuple[str, str]]:
    """Return the name of each folder with the options of its command that other folders do not have.

    Empty if a command is unknown, or if commands differ only in the folder of results and the number of workers.
    """
    commands = [_command_options(result) for result in results]
    if not all(commands):
        return []
    shared = set.intersection(*map(set, commands))
    texts = ["; ".join(word for word in command if word not in shared) for command in commands]
    return [*zip(folder_names(results), texts, strict=True)] if any(texts) else []


def _command_options(result: Results) -> list[str]:
    """Return the arguments of the command that wrote a folder, each option with its value."""
    options = list[str]()
    for word in (word for word in shlex.split(original_command(result))[1:] if word not in IRRELEVANT_FLAGS):
        is_value = options and options[-1].startswith("-") and " " not in options[-1] and not word.startswith("-")
        options = [*options[:-1], f"{options[-1]} {word}"] if is_value else [*options, word]
    return [option for option in options if not option.startswith(IRRELEVANT_OPTIONS)]


def name_baselines(results: Sequence[Results]) -> str:
    """Return the names of the baselines of these results, joined by `or`."""
    names = dict.fromkeys(result.baseline or "the human baseline" for result in results)
    return " or ".join("the human baseline" if name == HUMAN_LABEL else name for name in names)


def main_finding(result: Results) -> str:
    """Return sentences on the results of a folder in addition to the verdicts on its drivers; may be empty."""
    if (trained := result.trained_label) is None:
        return "" if HUMAN_LABEL in result.rows and len(result.rows) > 1 else _drive_finding(result)
    rows = result.rows[trained]
    experts = {label: result.rows[label] for label in result.rows if label not in (trained, HUMAN_LABEL)}
    returns = {label: metric_estimate(experts[label], "return").mean for label in experts}
    expert, sentences = result.metadata["expert"], list[str]()
    best = max(returns, key=lambda label: np.nan_to_num(returns[label], nan=-np.inf), default=expert)
    if expert in experts:
        gain = paired_difference(rows, experts[expert], "return")
        seeds = format_units(rows, gain.count, "test seed")
        finding = f"Return difference to its expert, {expert} (return {returns[expert]:,.0f}), on {seeds}"
        sentences.append(f"{finding}: {format_difference(gain)}. {gain_verdict(gain)}")
        if row := selected_row(result.progress):
            steps = f"{row['environment_steps']:,} environment steps"
            sentences.append(f"The network is that after {steps}, the best in validation.")
        if not is_expert_unchanged(gain):
            sentences.append(_traffic_finding(rows, experts[expert], expert, road_metrics(result.rows).compared[0]))
    if best != expert:
        gain = paired_difference(rows, experts[best], "return")
        sentences.append(f"Return difference to {best}, the expert with the highest return: {format_difference(gain)}.")
    mean = metric_estimate(rows, "return").mean
    seeds = format_count(len(rows), "test seed")
    return " ".join(sentences) or f"On {seeds} the mean return of the trained controller is {mean:.0f}."


def _traffic_finding(rows: EpisodeRows, expert_rows: EpisodeRows, expert: str, name: str) -> str:
    """Return a sentence on the difference to the expert in the main metric of the road."""
    metric, change = METRICS[name], paired_difference(rows, expert_rows, name)
    finding = {None: "no difference is shown", True: "better", False: "worse"}[is_better(name, change)]
    number = f"{format_difference(change, metric.digits)} {metric.unit}".strip()
    return f"Difference of {metric.label.partition(',')[0]} to {expert}: {number} ({finding})."


def _drive_finding(result: Results) -> str:
    names, texts = road_metrics(result.rows).headline[:2], list[str]()
    for label, rows in result.rows.items():
        has_failed = all(row["status"] == "failed" for row in rows)
        means = "all episodes failed" if has_failed else ", ".join(_mean_text(rows, name) for name in names)
        texts.append(f"{label}: {means}")
    episodes = format_count(max(map(len, result.rows.values())), "episode")
    return f"Means of {episodes} on {result.metadata['scenario']}: {'; '.join(texts)}."


def _mean_text(rows: Sequence[dict[str, Any]], name: str) -> str:
    """Return a mean with the label of the metric; text after a comma in the label follows in parentheses."""
    label, _, detail = METRICS[name].label.partition(", ")
    return f"{label} {_mean_with_unit(rows, name)}{detail and f' ({detail})'}"


def _mean_with_unit(rows: EpisodeRows, name: str) -> str:
    metric, estimate = METRICS[name], metric_estimate(rows, name)
    return f"{estimate.mean:.{metric.digits}f} {metric.unit}".strip() if estimate.count else "–"


def report_notes(result: Results) -> list[str]:
    """Return caveats on the results of a folder."""
    labels = [result.trained_label] if result.trained_label else list(filter(driver_rank, result.rows))
    notes = dict.fromkeys([*result.metadata.get("notes", []), *early_end_notes(result.rows)])
    if is_outdated(result.folder, result.metadata):
        outdated = "the evaluation is of an earlier controller than that in the folder; unjam evaluate repeats it"
        notes = {outdated: None, **notes}
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
        overrides = f"it overrides {100 * share:.1f}\u00a0% of commands"
        braking = f"adds up to {max(row['shield_max_braking'] for row in rows):.1f} m/s² of braking"
        notes.append(f"{label} relies on SUMO's safety check: {overrides}, and {braking}.")
    return notes


def key_figures(result: Results) -> list[dict[str, str]]:
    """Return the key figures of the only driver in a folder; none for several drivers, which have verdicts."""
    if len(result.rows) > 1:
        return []
    [(label, rows)] = result.rows.items()
    names = road_metrics(result.rows).headline
    return [{"label": METRICS[name].label, "value": _mean_with_unit(rows, name), "detail": label} for name in names]


def baseline_differences(columns: Sequence[ReportColumn]) -> dict[str, Any]:
    """Return the table of paired differences to the baseline of the same folder; empty without baselines.

    A cell is marked as better or worse if its confidence interval excludes zero and the metric is defined for all
    pairs. Without correction for multiple comparisons, about one of twenty cells is marked by chance.
    """
    compared = [(column, column.baseline_rows) for column in columns if column.baseline_rows is not None]
    if not compared:
        return {}
    rows = []
    for name in COMPARED_METRICS:
        metric, cells = METRICS[name], []
        for column, baseline_rows in compared:
            difference = paired_difference(column.rows, baseline_rows, name)
            units = count_units(column.rows, baseline_rows)
            verdict = is_better(name, difference) if difference.count == units else None
            mark = {True: "better", False: "worse", None: ""}[verdict]
            text = str(estimate_cell(difference, metric.digits, units, "+"))
            cells.append({"text": text, "mark": mark, "count": difference.count})
        if any(cell["count"] for cell in cells):
            rows.append({"label": metric.label, "unit": metric.unit, "cells": cells})
    return {"names": [column.name for column, _ in compared], "rows": rows}


def episodes_as_csv(columns: Sequence[ReportColumn]) -> str:
    """Return all episodes as CSV: a row per driver and seed, a column per metric; NaN is empty."""
    rows = [{**row, "driver": column.name} for column in columns for row in column.rows]
    table = pd.DataFrame(rows, columns=["driver", "seed", "status", *METRICS])
    return csv_text(table)


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as `printable` CSV, with an apostrophe before texts that a spreadsheet reads as formulas."""

    def protect(value: Any) -> Any:
        return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA_STARTS else value

    return printable(table.rename(columns=protect).map(protect).to_csv(index=False, lineterminator="\n"))
