"""Learning with the virtual environment and without it, from what `unjam reproduce` made."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from studies import rows_of
from tables import results_part

from unjam_paper.comparison import compared_variants
from unjam_paper.study import PlannedRun, interval_text

LABELS = {"ours": "with the virtual environment", "ours-without-model": "without"}
COLOURS = ("#2b6cb0", "#e07a1f", "#3a8f5c", "#7b8794")


def road_model(prefix: str, road: str = "ring") -> dict[str, str]:
    """Return the labels of the variants that a study of road models compares, large iterations first."""
    modelled, *others = compared_variants(prefix)
    sizes = {name: PlannedRun(road, name, 0).config.learner.steps_per_iteration for name in others}
    labels = {name: f"without, in iterations of {size:,}" for name, size in sizes.items()}
    ordered = sorted(labels, key=lambda name: -sizes[name])
    return {modelled: "with a model of the whole road", **{name: labels[name] for name in ordered}}


def validations(variant: str, study: str = "table-2", road: str = "ring") -> tuple[np.ndarray, np.ndarray]:
    """Return actual steps, shape (points,), and the returns on the validation seeds, shape (runs, points).

    Before a training was validated for the first time there is nothing.
    """
    curves = results_part(f"{study}/curves")[road][variant]
    steps, values = np.array(curves["steps"]), np.array(curves["return_validation"])
    known = (values != values[:, :1]).any(0)  # until then the first is all that is known
    first = int(np.argmax(known)) if known.any() else len(steps)
    return steps[max(0, first - 1) :], values[:, max(0, first - 1) :]


def draw(
    labels: dict[str, str] = LABELS, study: str = "table-2", lowest: float | None = None, road: str = "ring"
) -> Figure:
    """Draw validation against actual steps: mean and range of the runs; from `lowest` on, steps by powers."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    most = -np.inf
    for (variant, label), colour in zip(labels.items(), COLOURS, strict=False):
        steps, curves = validations(variant, study, road)
        most = max(most, curves.max())
        low, high, once = curves.min(0), curves.max(0), len(steps) == 1
        axes.fill_between(steps / 1000, low, high, color=colour, alpha=0.15, lw=0)
        axes.plot(steps / 1000, curves.mean(0), "o" if once else "-", color=colour, label=label)
        axes.vlines(steps / 1000, low, high, color=colour, alpha=0.15, lw=8 if once else 0)
    if lowest is not None:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylim(lowest, most + max(5.0, 0.05 * (most - lowest)))
    axes.set_xlabel("environment steps [thousands]")
    axes.set_ylabel("return of an episode, validation")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def judged() -> pd.DataFrame:
    """Return what the trainings gain, each, and after how many steps they first reach a level.

    The level is what runs without the virtual environment reach at best, on average.
    """
    rows = {row["variant"]: row for row in rows_of("table-2", "ring") if row["is_learned"]}
    level = float(validations("ours-without-model")[1].max(1).mean())
    table = []
    for variant, label in LABELS.items():
        steps, curves = validations(variant)
        there = [int(steps[np.argmax(curve >= level)]) for curve in curves if curve.max() >= level]
        row = rows[variant]
        table.append(
            {
                "": label,
                "trainings": len(curves),
                "difference to the best tuned expert": interval_text(row["gain_over_best_expert"], 0, "+"),
                "each": ", ".join(f"{gain:+.0f}" for gain in row["gains"]),
                f"reach {level:.0f}": f"{len(there)} of {len(curves)}",
                "after environment steps": ", ".join(f"{count:,}" for count in sorted(there)),
            }
        )
    return pd.DataFrame(table)
