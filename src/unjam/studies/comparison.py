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

from unjam.files import to_json, write_whole
from unjam.measures.drivable import drivable_in_all, verdicts
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    Estimate,
    crossed_estimate,
    estimate_of,
    interval_of,
    over_trainings,
    paired_by_training,
    paired_difference,
    probability_of_improvement,
)
from unjam.measures.table import cell_of, unbroken
from unjam.reports.figures import INK, LINES, STYLE, new_figure, png_bytes, space_time
from unjam.reports.results import Shown, read_results, validations_of
from unjam.studies.references import best_expert
from unjam.studies.results_file import read_part
from unjam.studies.study import (
    PAPERS_ROADS,
    ROADS,
    VARIANTS,
    PlannedRun,
    Study,
    StudyFolder,
    Table,
    TrainedRun,
    planned,
)
from unjam.training.config import load_config

PAPER: dict[tuple[str, str], tuple[float, float, float]] = {
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
CONVENTION = {
    "reward": ("return", "return_mean"),
    "speed": ("cav_mean_speed", "cav_mean_speed"),
    "std": ("speed_std_cav", "speed_std_cav"),
}
"""the paper's columns: each as a metric of episodes, and as a number of the training batches"""
LETTERS_OF_A_ROW, BESIDE_A_LABEL = 155, 8
"""what a row of a legend holds, and what a label's line and margins take of it"""
HONEST = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "speed_limit_ratio_steady"),
    *("speed_std_fleet", "time_to_dissolve", "throughput_veh_per_h", "backlog_veh"),
    *("min_headway", "collisions"),
)
"""metrics of the deterministic policy on held-out seeds"""
INTERQUARTILE = 0.25
"""share left out at either end: Agarwal et al. 2021, `Deep RL at the edge of the statistical precipice`"""
POINTS = 100
"""of a curve"""
DRAWN = {"return_mean": "return, in training", "cav_mean_speed": "CAV's mean speed, in training [m/s]"}
RETURNS, SPEEDS = ("return_mean", "return_validation"), ("cav_mean_speed", "speed_std_cav")
SHOWN = ("proposed", "ours")
"""in Figure 5"""


def comparison_of(title: str, variants: Sequence[str], road: str = "ring") -> Study:
    """Return the study that compares some variants on a road."""

    def write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        write_table(table_rows(studies, road, variants, seeds), folder)
        curves, metric = curves_of(studies, road, variants, seeds), metric_of(road, variants[0])
        found = studies.references(road)
        references = {"all human": found["human"], "best expert": found[best_expert(found, metric)]}
        write_whole(folder / "curves.json", to_json({road: curves}))
        write_whole(
            folder / "curves.png", png_bytes(draw_curves(road, curves, references, metric), small=False)
        )
        studies.keep_controllers(planned([road], variants, seeds), folder / "controllers")

    tables = {"checkpoints": partial(_checkpoints, road)}
    return Study(title, lambda seeds: planned([road], variants, seeds), write, (road,), tables=tables)


def metric_of(road: str, variant: str) -> str:
    """Return which return trainings are judged by: one that all drivers have, of the reward as meant."""
    return "return_eq16" if PlannedRun(road, variant, 0).config.reward.startswith("eq16") else "return"


def table_rows(studies: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> Table:
    """Return a row per driver that does not learn, and per variant, on a road."""
    references = studies.references(road)
    best, said = best_expert(references, metric_of(road, variants[0])), verdicts(references)
    rows: Table = []
    for label, found in references.items():
        row = {"road": road, "name": label, "learns": False, "trainings": 0, "episodes": len(found)}
        row |= {"best_expert": label == best, "drivable": said[label], **estimates(found, HONEST)}
        beyond = paired_difference(found, references[best], metric_of(road, variants[0]))
        row["beyond_best_expert"] = entries(beyond)
        convention = {key: _mean_and_std(_finite(found, name)) for key, (name, _) in CONVENTION.items()}
        rows.append({**row, "paper_convention": convention, "steady_by_draw": _by_draw(road, found)})
    trained = {variant: studies.trained(road, variant, seeds) for variant in variants}
    return [*rows, *(_of_variant(road, variant, runs, references) for variant, runs in trained.items())]


def _of_variant(
    road: str, variant: str, runs: list[TrainedRun], references: dict[str, Table]
) -> dict[str, Any]:
    reported, metric = PAPER.get((road, VARIANTS[variant].papers or variant)), metric_of(road, variant)
    best = best_expert(references, metric)
    row: dict[str, Any] = {
        "road": road,
        "name": VARIANTS[variant].label,
        "variant": variant,
        "learns": True,
        "trainings": len(runs),
        "episodes": len(runs[0].rows),
        "steps": runs[0].run.config.steps,
        "paper": dict(zip(CONVENTION, reported, strict=True)) if reported else None,
    }
    for name in HONEST:
        own = name != "return" or metric == "return"  # returns of another reward are no returns here
        values = [_mean(_finite(run.rows, name)) if own else float("nan") for run in runs]
        row[name] = entries(over_trainings(values, INTERQUARTILE, METRICS[name].bounds))
    differences = paired_by_training([run.rows for run in runs], references[best], metric)
    validated = [found for run in runs if (found := validations_of(run.progress))]
    return {
        **row,
        "paper_convention": {
            key: _mean_and_std([run.in_training(name) for run in runs])
            for key, (_, name) in CONVENTION.items()
        },
        "steady_by_draw": _by_draw(road, [one for run in runs for one in run.rows]),
        "beyond": {"expert": best, "metric": metric},
        "beyond_best_expert": entries(crossed_estimate(differences)),
        "probability_of_improvement": entries(probability_of_improvement(differences)),
        "kept_untrained": sum(best <= 0 for best, _ in validated),
        "drivable": [drivable_in_all(run.rows, references["human"]) for run in runs],
        "seconds": _mean([run.seconds for run in runs]),
        "gains": differences.mean(1).tolist(),
    }


def _by_draw(road: str, rows: Table) -> dict[str, dict[str, float]]:
    """Return the steady mean speed by each number that episodes draw: the length, or the radius."""
    return {
        name: {
            f"{value:g}": _mean(_finite([row for row in rows if row[name] == value], "mean_speed_steady"))
            for value in sorted({row[name] for row in rows})
        }
        for name in load_config(changes=ROADS[road]).make_scenario().drawn_ranges
    }


def estimates(rows: Table, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each of these metrics over episodes, with its interval."""
    return {name: entries(estimate_of(rows, name)) for name in names}


def entries(found: Estimate) -> dict[str, Any]:
    """Return an estimate as tables keep it."""
    return asdict(found)


def number(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number as pages show it; a dash where there is none."""
    return "–" if value is None else f"{value:{sign}.{digits}f}"


def interval(entries: dict[str, Any], digits: int, sign: str = "") -> str:
    """Return an estimate as pages show it: with its interval, else its range, where that is known."""
    nothing: dict[str, Any] = {"count": 0, "smallest": nan, "largest": nan}  # of tables of before
    known: dict[str, Any] = nothing | {key: nan if value is None else value for key, value in entries.items()}
    found = Estimate(**{field.name: known[field.name] for field in fields(Estimate)})
    return unbroken(f"{number(found.mean, digits, sign)} {interval_of(found, f'{sign}.{digits}f')}".strip())


def _mean_and_std(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _mean(values), "std": float(np.std(values)) if len(values) else float("nan")}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _finite(rows: Table, name: str) -> list[float]:
    return [row[name] for row in rows if np.isfinite(row[name])]


def write_table(rows: Table, folder: Path) -> None:
    """Write a table as JSON, all of it, and as CSV, the numbers that people look at."""
    write_whole(folder / "table.json", to_json(rows, indent=1))
    write_whole(folder / "table.csv", pd.DataFrame([_flat(row) for row in rows]).to_csv(index=False))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    paper = row.get("paper") or {}
    flat: dict[str, Any] = {"road": row["road"], "name": row["name"], "trainings": row["trainings"]}
    for key in CONVENTION:
        flat[f"{key}, paper"] = paper.get(key)
        flat[f"{key}, paper convention"] = round(row["paper_convention"][key]["mean"], 2)
    for name in (*HONEST, "beyond_best_expert", "probability_of_improvement"):
        if name in row:  # drivers that do not learn are not compared with experts
            flat[name] = round(row[name]["mean"], 3)
    return flat


def curves_of(studies: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> dict[str, Any]:
    """Return the curves of a road: by variant the steps, and what is drawn over them, a list per seed.

    Returns of another reward than that of the first variant are left out, and what was never looked at.
    """
    found: dict[str, Any] = {}
    reward = PlannedRun(road, variants[0], 0).config.reward
    for variant in variants:
        runs = studies.trained(road, variant, seeds)
        first = max(run.progress[0]["actual_steps"] for run in runs)
        last = min(run.progress[-1]["actual_steps"] for run in runs)
        grid = np.linspace(first, last, POINTS)
        found[variant] = {"steps": grid.round().tolist()}
        same = PlannedRun(road, variant, 0).config.reward == reward
        for name in (*RETURNS, *SPEEDS) if same else SPEEDS:
            if any(row[name] is not None for row in runs[0].progress):
                found[variant][name] = [_on(grid, run.progress, name) for run in runs]
    return found


def _checkpoints(road: str, folder: Path) -> pd.DataFrame:
    """Return what validation chose beside the last checkpoint, and how many kept the untrained network.

    From the curves, on the validation seeds. Tables of before know who kept it by a gain of zero alone.
    """
    curves, table = read_part(folder, "curves")[road], []
    for row in read_part(folder, "table"):
        if "return_validation" in curves.get(row.get("variant"), {}):
            values = np.array(curves[row["variant"]]["return_validation"])
            best, last = values.max(1), values[:, -1]
            kept = row.get("kept_untrained", sum(gain == 0 for gain in row["gains"]))
            cells = {"": row["name"], "trainings": len(values), "best trained": number(best.mean(), 0)}
            cells["last checkpoint"] = number(last.mean(), 0)
            cells["last − best"] = str(cell_of(over_trainings(last - best, bounds=(-inf, 0.0)), 0, sign="+"))
            table.append({**cells, "kept the untrained network": f"{kept} of {len(values)}"})
    return pd.DataFrame(table)


def _on(grid: np.ndarray, progress: Table, name: str) -> list[float]:
    known = [(row["actual_steps"], row[name]) for row in progress if row[name] is not None]
    steps, values = np.array(known, float).T
    return np.interp(grid, steps, values).round(4).tolist()


@rc_context(STYLE)
def draw_curves(
    road: str, curves: dict[str, Any], references: dict[str, Table], metric: str = "return"
) -> Figure:
    """Draw return and speed in training against actual steps, side by side.

    `curves` are of `curves_of`; `references`, drivers that do not learn, are lines at the mean of `metric`.
    """
    figure = new_figure(3.1)
    for (name, label), axes in zip(DRAWN.items(), figure.subplots(1, len(DRAWN)), strict=True):
        for (variant, curve), colour in zip(curves.items(), LINES[1:], strict=False):
            if name in curve:
                steps, values = np.array(curve["steps"]) / 1000.0, np.array(curve[name])
                axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
                axes.plot(steps, values.mean(0), color=colour, lw=1.5, label=VARIANTS[variant].label)
        of_rows = metric if name == "return_mean" else name
        for (reference, rows), style in zip(references.items(), ("--", ":"), strict=False):
            value = estimate_of(rows, of_rows).mean
            axes.axhline(value, color=INK, lw=1.0, ls=style, label=reference)
        axes.set_title(f"{road}: {label}")
        axes.margins(x=0.01)
        axes.set_xlabel("actual simulator steps [thousands]")
    lines, labels = figure.axes[-1].get_legend_handles_labels()
    rows = ceil(sum(len(label) + BESIDE_A_LABEL for label in labels) / LETTERS_OF_A_ROW)
    figure.legend(lines, labels, loc="outside upper left", ncols=ceil(len(labels) / rows))
    return figure


def _figure_5(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Draw a space-time picture per road: people alone, the best expert, the paper's method and ours."""
    for road in PAPERS_ROADS:
        write_whole(folder / f"{road}.png", png_bytes(space_time(shown_on(studies, road)), small=False))


def shown_on(studies: StudyFolder, road: str) -> list[Shown]:
    """Return the episodes to show, all of the same traffic: of trainings the first seed of each."""
    drives = read_results(studies.drives_of(road)).shown
    episodes = [drives["human"], drives[best_expert(studies.references(road))]]
    for variant in SHOWN:
        results = read_results(studies.folder_of(PlannedRun(road, variant, 0)))
        trained = results.shown[results.trained or ""]
        episodes.append(replace(trained, driver=VARIANTS[variant].label))
    return episodes


FIGURE_5 = Study(
    "space-time pictures",
    lambda seeds: planned(PAPERS_ROADS, SHOWN, 1),
    _figure_5,
    PAPERS_ROADS,
    minutes=0.5,
)
