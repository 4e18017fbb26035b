"""Learning with the virtual environment and without it, from what `unjam reproduce table-2` made."""

import json
from io import BytesIO

import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.figure import Figure
from tables import RESULTS

from studies import rows_of
from unjam.studies.comparison import interval

LABELS = {"ours": "with the virtual environment", "ours-without-model": "without"}
COLOURS = {"ours": "#2b6cb0", "ours-without-model": "#e07a1f"}


def validations(variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Return actual steps, shape (points,), and the returns on the validation seeds, shape (runs, points)."""
    curves = json.loads((RESULTS / "table-2" / "curves.json").read_text())["ring"][variant]
    return np.array(curves["steps"]), np.array(curves["return_validation"])


def draw() -> Image:
    """Draw validation against actual steps: mean and range of the runs."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    for variant, label in LABELS.items():
        steps, curves = validations(variant)
        axes.fill_between(
            steps / 1000, curves.min(0), curves.max(0), color=COLOURS[variant], alpha=0.15, lw=0
        )
        axes.plot(steps / 1000, curves.mean(0), color=COLOURS[variant], label=label)
    axes.set_xlabel("actual simulator steps [thousands]")
    axes.set_ylabel("return of an episode, validation")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return Image(content.getvalue(), width=900)


def judged() -> pd.DataFrame:
    """Return what the trainings gain, each, and after how many steps they first reach a level.

    The level is what runs without the virtual environment reach at best, on average.
    """
    rows = {row["variant"]: row for row in rows_of("table-2", "ring") if row["learns"]}
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
                "beyond the best expert": interval(row["beyond_best_expert"], 0, "+"),
                "each": ", ".join(f"{gain:+.0f}" for gain in row["gains"]),
                f"reach {level:.0f}": f"{len(there)} of {len(curves)}",
                "after actual steps": ", ".join(f"{count:,}" for count in sorted(there)),
            }
        )
    return pd.DataFrame(table)
