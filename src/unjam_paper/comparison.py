"""The paper's comparisons of learners: Tables 1 and 2, Figures 4, 5, 7 and 9.

A table has the paper's convention beside the paper's numbers, and the honest one. Curves are of several
trainings of each variant: mean and range over the seeds.
"""

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from math import ceil, inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.files import atomic_write, to_json
from unjam.measures.feasibility import feasibility_by_driver, overall_feasibility
from unjam.measures.metric_table import estimate_cell, with_no_break_spaces
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    estimate_crossed,
    estimate_over_trainings,
    format_ci,
    metric_estimate,
    paired_difference,
    paired_differences,
    probability_of_improvement,
)
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, TEXT_COLOR, new_figure, png_bytes, trajectory_figure
from unjam.reports.results import PlotEpisode, read_results, validation_gains
from unjam.training.config import load_config
from unjam_paper.references import best_expert
from unjam_paper.results_file import read_part
from unjam_paper.study import (
    PAPER_ROADS,
    STUDY_ROADS,
    VARIANTS,
    PlannedRun,
    Study,
    StudyFolder,
    Table,
    TrainedRun,
    planned_runs,
)

PAPER_RESULTS: dict[tuple[str, str], tuple[float, float, float]] = {
    ("ring", "trpo"): (1699.15, 3.42, 0.55),
    ("ring", "ppo"): (1057.14, 3.43, 0.75),
    ("ring", "sac"): (1048.97, 3.24, 0.38),
    ("ring", "proposed"): (1753.66, 4.04, 0.48),
    ("ring", "mb-trpo"): (1717.45, 3.55, 0.73),
    ("ring", "no-initial-policy"): (1633.28, 3.53, 0.57),
    ("figure-eight", "trpo"): (542.42, 1.84, 1.43),
    ("figure-eight", "ppo"): (228.86, 1.60, 1.20),
    ("figure-eight", "sac"): (435.72, 2.30, 1.94),
    ("figure-eight", "proposed"): (862.81, 6.41, 2.04),
    ("merge", "trpo"): (420.07, 15.26, 2.46),
    ("merge", "ppo"): (415.02, 14.67, 2.77),
    ("merge", "sac"): (449.72, 16.47, 2.38),
    ("merge", "proposed"): (492.93, 17.44, 2.22),
}
"""Tables 1 and 2, by road and variant: reward, and of the CAV's own speed, start-up and exploration included,
the mean (`average speed`) and the standard deviation over time (`speed std`) [m/s]"""
PAPER_COLUMNS = {
    "reward": ("return", "return_mean"),
    "speed": ("cav_mean_speed", "cav_mean_speed"),
    "std": ("speed_std_cav", "speed_std_cav"),
}
"""the paper's columns: each as a metric of episodes, and as a number of the training batches"""
MAX_LEGEND_ROW_LENGTH, LEGEND_ENTRY_OVERHEAD = 155, 8
"""what a row of a legend holds, and what a label's line and margins take of it"""
COMPARISON_METRICS = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "speed_limit_ratio_steady"),
    *("speed_std_fleet", "time_to_dissolve", "outflow_veh_per_h", "insertion_backlog_veh"),
    *("min_time_gap", "collisions"),
)
"""metrics of the deterministic policy on held-out seeds"""
TRIMMED_SHARE = 0.25
"""share left out at either end: Agarwal et al. 2021, `Deep RL at the edge of the statistical precipice`"""
CURVE_POINTS = 100
"""of a curve"""
CURVE_LABELS = {"return_mean": "return, in training", "cav_mean_speed": "CAV's mean speed, in training [m/s]"}
RETURN_COLUMNS, SPEED_COLUMNS = ("return_mean", "return_validation"), ("cav_mean_speed", "speed_std_cav")
FIGURE_5_VARIANTS = ("proposed", "ours")
"""in Figure 5"""


def comparison_study(title: str, variants: Sequence[str], road: str = "ring") -> Study:
    """Return the study that compares some variants on a road."""

    def write(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        write_comparison_table(comparison_rows(study_folder, road, variants, seeds), folder)
        curves, metric = training_curves(study_folder, road, variants, seeds), return_metric(road, variants[0])
        found = study_folder.reference_rows(road)
        references = {"all human": found["human"], "best expert": found[best_expert(found, metric)]}
        atomic_write(folder / "curves.json", to_json({road: curves}))
        atomic_write(
            folder / "curves.png", png_bytes(curve_figure(road, curves, references, metric), reduce_colors=False)
        )
        study_folder.copy_controllers(planned_runs([road], variants, seeds), folder / "controllers")

    tables = {"checkpoints": partial(_checkpoint_table, road)}
    return Study(title, lambda seeds: planned_runs([road], variants, seeds), write, (road,), tables=tables)


def return_metric(road: str, variant: str) -> str:
    """Return which return trainings are judged by: one that all drivers have, of the reward as meant."""
    return "return_eq16" if PlannedRun(road, variant, 0).config.reward.startswith("eq16") else "return"


def comparison_rows(study_folder: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> Table:
    """Return a row per driver that does not learn, and per variant, on a road."""
    references = study_folder.reference_rows(road)
    best, said = best_expert(references, return_metric(road, variants[0])), feasibility_by_driver(references)
    rows: Table = []
    for label, found in references.items():
        row = {"road": road, "name": label, "learns": False, "trainings": 0, "episodes": len(found)}
        row |= {"best_expert": label == best, "drivable": said[label], **estimate_metrics(found, COMPARISON_METRICS)}
        beyond = paired_difference(found, references[best], return_metric(road, variants[0]))
        row["beyond_best_expert"] = estimate_entries(beyond)
        convention = {key: _mean_and_std(_finite_values(found, name)) for key, (name, _) in PAPER_COLUMNS.items()}
        rows.append({**row, "paper_convention": convention, "steady_by_draw": _mean_by_drawn_value(road, found)})
    trained = {variant: study_folder.trained_runs(road, variant, seeds) for variant in variants}
    return [*rows, *(_variant_row(road, variant, runs, references) for variant, runs in trained.items())]


def _variant_row(road: str, variant: str, runs: list[TrainedRun], reference_rows: dict[str, Table]) -> dict[str, Any]:
    reported, metric = (
        PAPER_RESULTS.get((road, VARIANTS[variant].paper_variant or variant)),
        return_metric(road, variant),
    )
    best = best_expert(reference_rows, metric)
    row: dict[str, Any] = {
        "road": road,
        "name": VARIANTS[variant].label,
        "variant": variant,
        "learns": True,
        "trainings": len(runs),
        "episodes": len(runs[0].rows),
        "steps": runs[0].run.config.steps,
        "paper": dict(zip(PAPER_COLUMNS, reported, strict=True)) if reported else None,
    }
    for name in COMPARISON_METRICS:
        own = name != "return" or metric == "return"  # returns of another reward are no returns here
        values = [_mean(_finite_values(run.rows, name)) if own else float("nan") for run in runs]
        row[name] = estimate_entries(estimate_over_trainings(values, TRIMMED_SHARE, METRICS[name].bounds))
    differences = paired_differences([run.rows for run in runs], reference_rows[best], metric)
    validated = [found for run in runs if (found := validation_gains(run.progress))]
    return {
        **row,
        "paper_convention": {
            key: _mean_and_std([run.final_training_mean(name) for run in runs])
            for key, (_, name) in PAPER_COLUMNS.items()
        },
        "steady_by_draw": _mean_by_drawn_value(road, [one for run in runs for one in run.rows]),
        "beyond": {"expert": best, "metric": metric},
        "beyond_best_expert": estimate_entries(estimate_crossed(differences)),
        "probability_of_improvement": estimate_entries(probability_of_improvement(differences)),
        "kept_untrained": sum(best <= 0 for best, _ in validated),
        "drivable": [overall_feasibility(run.rows, reference_rows["human"]) for run in runs],
        "seconds": _mean([run.seconds for run in runs]),
        "gains": differences.mean(1).tolist(),
    }


def _mean_by_drawn_value(road: str, rows: Table) -> dict[str, dict[str, float]]:
    """Return the steady mean speed by each number that episodes draw: the length, or the radius."""
    return {
        name: {
            f"{value:g}": _mean(_finite_values([row for row in rows if row[name] == value], "mean_speed_steady"))
            for value in sorted({row[name] for row in rows})
        }
        for name in load_config(changes=STUDY_ROADS[road]).make_scenario().drawn_ranges
    }


def estimate_metrics(rows: Table, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each of these metrics over episodes, with its interval."""
    return {name: estimate_entries(metric_estimate(rows, name)) for name in names}


def estimate_entries(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate as tables keep it."""
    return asdict(estimate)


def number_text(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number as pages show it; a dash where there is none."""
    return "–" if value is None else f"{value:{sign}.{digits}f}"


def interval_text(entries: dict[str, Any], digits: int, sign: str = "") -> str:
    """Return an estimate as pages show it: with its interval, else its range, where that is known."""
    nothing: dict[str, Any] = {"count": 0, "smallest": nan, "largest": nan}  # of tables of before
    known: dict[str, Any] = nothing | {key: nan if value is None else value for key, value in entries.items()}
    found = Estimate(**{field.name: known[field.name] for field in fields(Estimate)})
    return with_no_break_spaces(
        f"{number_text(found.mean, digits, sign)} {format_ci(found, f'{sign}.{digits}f')}".strip()
    )


def _mean_and_std(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _mean(values), "std": float(np.std(values)) if len(values) else float("nan")}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _finite_values(rows: Table, name: str) -> list[float]:
    return [row[name] for row in rows if np.isfinite(row[name])]


def write_comparison_table(rows: Table, folder: Path) -> None:
    """Write a table as JSON, all of it, and as CSV, the numbers that people look at."""
    atomic_write(folder / "table.json", to_json(rows, indent=1))
    atomic_write(folder / "table.csv", pd.DataFrame([_csv_row(row) for row in rows]).to_csv(index=False))


def _csv_row(row: dict[str, Any]) -> dict[str, Any]:
    paper = row.get("paper") or {}
    flat: dict[str, Any] = {"road": row["road"], "name": row["name"], "trainings": row["trainings"]}
    for key in PAPER_COLUMNS:
        flat[f"{key}, paper"] = paper.get(key)
        flat[f"{key}, paper convention"] = round(row["paper_convention"][key]["mean"], 2)
    for name in (*COMPARISON_METRICS, "beyond_best_expert", "probability_of_improvement"):
        if name in row:  # drivers that do not learn are not compared with experts
            flat[name] = round(row[name]["mean"], 3)
    return flat


def training_curves(study_folder: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> dict[str, Any]:
    """Return the curves of a road: by variant the steps, and what is drawn over them, a list per seed.

    Returns of another reward than that of the first variant are left out, and what was never looked at.
    """
    found: dict[str, Any] = {}
    reward = PlannedRun(road, variants[0], 0).config.reward
    for variant in variants:
        runs = study_folder.trained_runs(road, variant, seeds)
        first = max(run.progress[0]["environment_steps"] for run in runs)
        last = min(run.progress[-1]["environment_steps"] for run in runs)
        grid = np.linspace(first, last, CURVE_POINTS)
        found[variant] = {"steps": grid.round().tolist()}
        same = PlannedRun(road, variant, 0).config.reward == reward
        for name in (*RETURN_COLUMNS, *SPEED_COLUMNS) if same else SPEED_COLUMNS:
            if any(row[name] is not None for row in runs[0].progress):
                found[variant][name] = [_resample(grid, run.progress, name) for run in runs]
    return found


def _checkpoint_table(road: str, folder: Path) -> pd.DataFrame:
    """Return what validation chose beside the last checkpoint, and how many kept the untrained network.

    From the curves, on the validation seeds. Tables of before know who kept it by a gain of zero alone.
    """
    curves, table = read_part(folder, "curves")[road], []
    for row in read_part(folder, "table"):
        if "return_validation" in curves.get(row.get("variant"), {}):
            values = np.array(curves[row["variant"]]["return_validation"])
            best, last = values.max(1), values[:, -1]
            kept = row.get("kept_untrained", sum(gain == 0 for gain in row["gains"]))
            cells = {"": row["name"], "trainings": len(values), "best trained": number_text(best.mean(), 0)}
            cells["last checkpoint"] = number_text(last.mean(), 0)
            cells["last − best"] = str(
                estimate_cell(estimate_over_trainings(last - best, bounds=(-inf, 0.0)), 0, sign="+")
            )
            table.append({**cells, "kept the untrained network": f"{kept} of {len(values)}"})
    return pd.DataFrame(table)


def _resample(grid: np.ndarray, progress: Table, name: str) -> list[float]:
    known = [(row["environment_steps"], row[name]) for row in progress if row[name] is not None]
    steps, values = np.array(known, float).T
    return np.interp(grid, steps, values).round(4).tolist()


@rc_context(PLOT_STYLE)
def curve_figure(road: str, curves: dict[str, Any], reference_rows: dict[str, Table], metric: str = "return") -> Figure:
    """Draw return and speed in training against actual steps, side by side.

    `curves` are of `training_curves`; `reference_rows`, drivers that do not learn, are lines at the mean of `metric`.
    """
    figure = new_figure(3.1)
    for (name, label), axes in zip(CURVE_LABELS.items(), figure.subplots(1, len(CURVE_LABELS)), strict=True):
        for (variant, curve), colour in zip(curves.items(), LINE_COLORS[1:], strict=False):
            if name in curve:
                steps, values = np.array(curve["steps"]) / 1000.0, np.array(curve[name])
                axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
                axes.plot(steps, values.mean(0), color=colour, lw=1.5, label=VARIANTS[variant].label)
        of_rows = metric if name == "return_mean" else name
        for (reference, rows), style in zip(reference_rows.items(), ("--", ":"), strict=False):
            value = metric_estimate(rows, of_rows).mean
            axes.axhline(value, color=TEXT_COLOR, lw=1.0, ls=style, label=reference)
        axes.set_title(f"{road}: {label}")
        axes.margins(x=0.01)
        axes.set_xlabel("actual simulator steps [thousands]")
    lines, labels = figure.axes[-1].get_legend_handles_labels()
    rows = ceil(sum(len(label) + LEGEND_ENTRY_OVERHEAD for label in labels) / MAX_LEGEND_ROW_LENGTH)
    figure.legend(lines, labels, loc="outside upper left", ncols=ceil(len(labels) / rows))
    return figure


def _write_figure_5(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Draw a space-time picture per road: people alone, the best expert, the paper's method and ours."""
    for road in PAPER_ROADS:
        atomic_write(
            folder / f"{road}.png",
            png_bytes(trajectory_figure(figure_5_episodes(study_folder, road)), reduce_colors=False),
        )


def figure_5_episodes(study_folder: StudyFolder, road: str) -> list[PlotEpisode]:
    """Return the episodes to show, all of the same traffic: of trainings the first seed of each."""
    drives = read_results(study_folder.reference_folder(road)).plot_episodes
    episodes = [drives["human"], drives[best_expert(study_folder.reference_rows(road))]]
    for variant in FIGURE_5_VARIANTS:
        results = read_results(study_folder.run_folder(PlannedRun(road, variant, 0)))
        trained = results.plot_episodes[results.trained_label or ""]
        episodes.append(replace(trained, driver=VARIANTS[variant].label))
    return episodes


FIGURE_5 = Study(
    "space-time pictures",
    lambda seeds: planned_runs(PAPER_ROADS, FIGURE_5_VARIANTS, 1),
    _write_figure_5,
    PAPER_ROADS,
    minutes=0.5,
)
