"""Learning curves of several trainings of each variant: mean and range over the seeds."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.measures.statistics import estimate
from unjam.reports.figures import INK, LINES, STYLE
from unjam.studies.plan import VARIANTS, PlannedRun
from unjam.studies.pool import Pool
from unjam.studies.table import metric_of

POINTS = 100
"""of a curve"""
DRAWN = {"return_mean": "return, in training", "cav_mean_speed": "CAV's mean speed, in training [m/s]"}
RETURNS, SPEEDS = ("return_mean", "return_validation"), ("cav_mean_speed", "speed_std_cav")


def curves_of(pool: Pool, road: str, variants: Sequence[str], seeds: int) -> dict[str, Any]:
    """Return the curves of a road: by variant the steps, and what is drawn over them, a list per seed.

    Returns of another reward than that of the first variant are left out.
    """
    found: dict[str, Any] = {}
    metric = metric_of(road, variants[0])
    for variant in variants:
        comparable = metric_of(road, variant) == metric
        runs = pool.trained([PlannedRun(road, variant, seed) for seed in range(seeds)])
        first = max(run.progress[0]["actual_steps"] for run in runs)
        last = min(run.progress[-1]["actual_steps"] for run in runs)
        grid = np.linspace(first, last, POINTS)
        found[variant] = {"steps": grid.round().tolist()}
        for name in (*RETURNS, *SPEEDS) if comparable else SPEEDS:
            found[variant][name] = [_on(grid, run.progress, name) for run in runs]
    return found


def _on(grid: np.ndarray, progress: list[dict[str, Any]], name: str) -> list[float]:
    known = [(row["actual_steps"], row[name]) for row in progress if row[name] is not None]
    steps, values = np.array(known, float).T
    return np.interp(grid, steps, values).round(4).tolist()


def draw_curves(
    by_road: dict[str, dict[str, Any]],
    references: dict[str, dict[str, list[dict[str, Any]]]],
    metric: str = "return",
) -> Figure:
    """Draw return and speed in training against actual steps, a row of panels per road.

    Args:
        by_road: what `curves_of` returned, by road.
        references: rows of drivers that do not learn, by road and label, drawn as lines.
        metric: which of their returns.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 2.6 * len(by_road) + 0.5), layout="constrained", dpi=130)
        panels = figure.subplots(len(by_road), len(DRAWN), squeeze=False)
        for (road, curves), line in zip(by_road.items(), panels, strict=True):
            for (name, label), axes in zip(DRAWN.items(), line, strict=True):
                _draw(axes, curves, name)
                of_rows = metric if name == "return_mean" else name
                for (reference, rows), style in zip(references[road].items(), ("--", ":"), strict=False):
                    value = estimate([row[of_rows] for row in rows]).mean
                    axes.axhline(value, color=INK, lw=1.0, ls=style, label=reference)
                axes.set_title(f"{road}: {label}", loc="left", fontsize=9, color=INK)
                axes.margins(x=0.01)
        for axes in panels[-1]:
            axes.set_xlabel("actual simulator steps [thousands]")
        figure.legend(*panels[0, -1].get_legend_handles_labels(), loc="outside upper left", ncols=6)
        return figure


def _draw(axes: Axes, curves: dict[str, Any], name: str) -> None:
    for (variant, curve), colour in zip(curves.items(), LINES[1:], strict=False):
        if name not in curve:
            continue
        steps, values = np.array(curve["steps"]) / 1000.0, np.array(curve[name])
        axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
        axes.plot(steps, values.mean(0), color=colour, lw=1.5, label=VARIANTS[variant].label)
