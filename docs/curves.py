"""Curves of trainings with and without a learned model, from the results of `unjam reproduce`."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from studies import study_rows
from tables import results_part

from unjam_paper.comparison import compared_variants
from unjam_paper.study import PlannedRun, interval_text, trainings_text
from unjam_paper.variants import WRONG_BASES

LABELS = {"ours": "with the virtual environment", "ours-without-model": "without"}
COLORS = ("#2b6cb0", "#e07a1f", "#3a8f5c", "#7b8794")


def road_model_labels(prefix: str, road: str = "ring") -> dict[str, str]:
    """Return labels by variant of a study of road models: first with the model, then by size of the iterations."""
    model_variant, *other_variants = compared_variants(prefix)
    sizes = {name: PlannedRun(road, name, 0).config.learner.steps_per_iteration for name in other_variants}
    labels = {name: f"without, in iterations of {size:,}" for name, size in sizes.items()}
    ordered = sorted(labels, key=lambda name: -sizes[name])
    return {model_variant: "with a model of the whole road", **{name: labels[name] for name in ordered}}


def validation_curves(variant: str, study: str = "table-2", road: str = "ring") -> tuple[np.ndarray, np.ndarray]:
    """Return environment steps, shape (points,), and the returns on the validation seeds, shape (trainings, points).

    The curves start at the first validation.
    """
    curves = results_part(f"{study}/curves")[road][variant]
    steps, values = np.array(curves["steps"]), np.array(curves["return_validation"])
    is_validated = (values != values[:, :1]).any(0)  # up to the first validation all values are equal
    first = int(np.argmax(is_validated)) if is_validated.any() else len(steps)
    return steps[max(0, first - 1) :], values[:, max(0, first - 1) :]


def draw_validation(
    labels: dict[str, str] = LABELS, study: str = "table-2", lowest: float | None = None, road: str = "ring"
) -> Figure:
    """Draw the mean and the range of validation returns over environment steps.

    With `lowest`, the lower limit of the axis of returns, the axis of steps is logarithmic.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    highest = -np.inf
    for (variant, label), color in zip(labels.items(), COLORS, strict=False):
        steps, curves = validation_curves(variant, study, road)
        highest = max(highest, curves.max())
        low, high, is_point = curves.min(0), curves.max(0), len(steps) == 1
        axes.fill_between(steps / 1000, low, high, color=color, alpha=0.15, lw=0)
        axes.plot(steps / 1000, curves.mean(0), "o" if is_point else "-", color=color, label=label)
        axes.vlines(steps / 1000, low, high, color=color, alpha=0.15, lw=8 if is_point else 0)
    if lowest is not None:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylim(lowest, highest + max(5.0, 0.05 * (highest - lowest)))
    axes.set_xlabel("environment steps [thousands]")
    axes.set_ylabel("return of an episode, validation")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def wrong_base_text() -> str:
    """Return a sentence on the returns with wrong bases of the model, compared with twice the steps without a model."""
    gains = {
        row["variant"]: np.array(row["gains"])
        for study in ("road-model", "road-model-wrong-base")
        for row in study_rows(study, "ring")
        if row["is_learned"]
    }
    double = gains["best-double"]
    texts = []
    for name, (base, _) in WRONG_BASES.items():
        model_gains = gains[f"best-road-model-{name}"]
        difference = trainings_text(model_gains - double[: len(model_gains)], 0, "+")
        texts.append(f"{difference} with a model on {base}")
    return (
        f"Difference to twice the steps without a model, the cheapest alternative, paired by seed: {', '.join(texts)}."
    )


def step_count_table() -> pd.DataFrame:
    """Return the gain of each training, and the environment steps after which it first reaches a level of the return.

    The level is the mean of the best validations of the trainings without the virtual environment.
    """
    rows = {row["variant"]: row for row in study_rows("table-2", "ring") if row["is_learned"]}
    level = float(validation_curves("ours-without-model")[1].max(1).mean())
    table = []
    for variant, label in LABELS.items():
        steps, curves = validation_curves(variant)
        step_counts = [int(steps[np.argmax(curve >= level)]) for curve in curves if curve.max() >= level]
        row = rows[variant]
        table.append(
            {
                "": label,
                "trainings": len(curves),
                "difference to the best tuned expert": interval_text(row["gain_over_best_expert"], 0, "+"),
                "each": ", ".join(f"{gain:+.0f}" for gain in row["gains"]),
                f"reach {level:.0f}": f"{len(step_counts)} of {len(curves)}",
                "after environment steps": ", ".join(f"{count:,}" for count in sorted(step_counts)),
            }
        )
    return pd.DataFrame(table)
