"""The paper's comparisons of learners: Tables 1 and 2, Figures 4, 5, 7, 9 and 10.

Curves are of several trainings of each variant: mean and range over the seeds.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.measures.statistics import estimate
from unjam.reports.figures import INK, LINES, STYLE, space_time
from unjam.reports.results import Shown, read_results
from unjam.studies.study import PAPERS_ROADS, ROADS, VARIANTS, PlannedRun, Study, StudyFolder, Table, planned
from unjam.studies.table import (
    HONEST,
    best_expert,
    estimates,
    metric_of,
    table_rows,
    unbroken,
    write_table,
)
from unjam.training.config import load_config
from unjam.training.evaluate import evaluate, held_out_seeds
from unjam.worlds.workers import Workers

POINTS = 100
"""of a curve"""
DRAWN = {"return_mean": "return, in training", "cav_mean_speed": "CAV's mean speed, in training [m/s]"}
RETURNS, SPEEDS = ("return_mean", "return_validation"), ("cav_mean_speed", "speed_std_cav")
SHOWN = ("proposed", "ours")
"""in Figure 5"""
VOLUMES = ("ring-5", "ring-11", "ring")
"""of Figure 10; controllers of the last are carried over to OTHER_ROADS"""
AMONG_VOLUMES = ("trpo", "ppo", "sac", "without-model", "proposed", "ours")
CARRIED = ("proposed", "ours")
TRAINED_ON = "ring"
OTHER_ROADS: dict[str, dict[str, Any]] = {
    "5 vehicles": ROADS["ring-5"],
    "11 vehicles": ROADS["ring-11"],
    "22 vehicles": ROADS["ring"],
    "44 vehicles on 520 m": {"scenario": "ring", "road.vehicles": 44, "road.length": [520, 520]},
}
EPISODES = 20


def comparison_of(title: str, variants: Sequence[str], road: str = "ring") -> Study:
    """Return the study that compares some variants on a road."""

    def write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        write_table(table_rows(studies, road, variants, seeds), folder)
        curves, metric = curves_of(studies, road, variants, seeds), metric_of(road, variants[0])
        found = studies.references(road)
        references = {"all human": found["human"], "best expert": found[best_expert(found, metric)]}
        write_whole(folder / "curves.json", to_json({road: curves}))
        draw_curves(road, curves, references, metric).savefig(folder / "curves.png")

    return Study(title, lambda seeds: planned([road], variants, seeds), write, (road,))


def curves_of(studies: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> dict[str, Any]:
    """Return the curves of a road: by variant the steps, and what is drawn over them, a list per seed.

    Returns of another reward than that of the first variant are left out.
    """
    found: dict[str, Any] = {}
    metric = metric_of(road, variants[0])
    for variant in variants:
        comparable = metric_of(road, variant) == metric
        runs = studies.trained(road, variant, seeds)
        first = max(run.progress[0]["actual_steps"] for run in runs)
        last = min(run.progress[-1]["actual_steps"] for run in runs)
        grid = np.linspace(first, last, POINTS)
        found[variant] = {"steps": grid.round().tolist()}
        for name in (*RETURNS, *SPEEDS) if comparable else SPEEDS:
            found[variant][name] = [_on(grid, run.progress, name) for run in runs]
    return found


def _on(grid: np.ndarray, progress: Table, name: str) -> list[float]:
    known = [(row["actual_steps"], row[name]) for row in progress if row[name] is not None]
    steps, values = np.array(known, float).T
    return np.interp(grid, steps, values).round(4).tolist()


def draw_curves(
    road: str, curves: dict[str, Any], references: dict[str, Table], metric: str = "return"
) -> Figure:
    """Draw return and speed in training against actual steps, side by side.

    Args:
        road: its name.
        curves: what `curves_of` returned.
        references: rows of drivers that do not learn, by label, drawn as lines.
        metric: which of their returns.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 3.1), layout="constrained", dpi=130)
        for (name, label), axes in zip(DRAWN.items(), figure.subplots(1, len(DRAWN)), strict=True):
            for (variant, curve), colour in zip(curves.items(), LINES[1:], strict=False):
                if name in curve:
                    steps, values = np.array(curve["steps"]) / 1000.0, np.array(curve[name])
                    axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
                    axes.plot(steps, values.mean(0), color=colour, lw=1.5, label=VARIANTS[variant].label)
            of_rows = metric if name == "return_mean" else name
            for (reference, rows), style in zip(references.items(), ("--", ":"), strict=False):
                value = estimate([row[of_rows] for row in rows]).mean
                axes.axhline(value, color=INK, lw=1.0, ls=style, label=reference)
            axes.set_title(f"{road}: {label}", loc="left", fontsize=9, color=INK)
            axes.margins(x=0.01)
            axes.set_xlabel("actual simulator steps [thousands]")
        handles = figure.axes[-1].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper left", ncols=6)
        return figure


def _figure_5(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Draw a space-time picture per road: people alone, the best expert, the paper's method and ours."""
    for road in PAPERS_ROADS:
        space_time(shown_on(studies, road)).savefig(folder / f"{road}.png", dpi=130)


def shown_on(studies: StudyFolder, road: str) -> list[Shown]:
    """Return the episodes to show, all of the same traffic: of trainings the first seed of each."""
    drives = read_results(studies.drives_of(road)).shown
    episodes = [drives["human"], drives[best_expert(studies.references(road))]]
    for variant in SHOWN:
        results = read_results(studies.folder_of(PlannedRun(road, variant, 0)))
        trained = results.shown[results.trained or ""]
        episodes.append(replace(trained, driver=VARIANTS[variant].label))
    return episodes


def carried_over(studies: StudyFolder, seeds: int, processes: int = 2) -> Table:
    """Return what controllers that were trained among 22 vehicles do among others, without training."""
    names = {"human": "human", "pi": "pi"}
    for run in (PlannedRun(TRAINED_ON, variant, seed) for variant in CARRIED for seed in range(seeds)):
        names[f"{run.variant} {run.seed}"] = str(studies.folder_of(run))
    rows = []
    with Workers(processes) as workers:
        for road, changes in OTHER_ROADS.items():
            scenario = load_config(changes=changes).make_scenario()
            drivers = {label: make_driver(name, scenario.decision_step) for label, name in names.items()}
            found = evaluate(scenario, drivers, held_out_seeds(EPISODES), workers).rows
            rows += [
                {"road": road, "driver": label, **estimates(driven, HONEST)}
                for label, driven in found.items()
            ]
    return rows


def _figure_10(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Train for 5, 11 and 22 vehicles, as in the paper; and carry controllers over without training."""
    write_table([row for road in VOLUMES for row in table_rows(studies, road, AMONG_VOLUMES, seeds)], folder)
    write_whole(folder / "carried-over.json", to_json(carried_over(studies, seeds, workers), indent=1))


def _carried_over_table(folder: Path) -> pd.DataFrame:
    """Return the mean speed by driver and traffic: over trainings, with the smallest and the largest."""
    speeds: dict[str, dict[str, list[float]]] = {}
    for row in json.loads((folder / "carried-over.json").read_text()):
        by_driver = speeds.setdefault(row["road"], {})
        by_driver.setdefault(row["driver"].rstrip(" 0123456789"), []).append(row["mean_speed"]["mean"])
    table = []
    for road, by_driver in speeds.items():
        cells = {"": road}
        for driver, means in by_driver.items():
            cells[driver] = f"{sum(means) / len(means):.2f}"
            if len(means) > 1:
                cells[driver] = unbroken(f"{cells[driver]} [{min(means):.2f}, {max(means):.2f}]")
        table.append(cells)
    return pd.DataFrame(table)


FIGURE_5 = Study(
    "space-time pictures",
    lambda seeds: planned(PAPERS_ROADS, SHOWN, 1),
    _figure_5,
    PAPERS_ROADS,
    minutes=0.5,
)
FIGURE_10 = Study(
    "5, 11 and 22 vehicles, trained for each, and carried over",
    lambda seeds: planned(VOLUMES, AMONG_VOLUMES, seeds),
    _figure_10,
    VOLUMES,
    minutes=3.0,
    tables={"carried over": _carried_over_table},
)
