"""Learning with the virtual environment and without it, from what `unjam reproduce` made."""

import json
from io import BytesIO

import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from tables import RESULTS

from studies import rows_of
from unjam.studies.comparison import interval
from unjam.studies.imagined import compared_with
from unjam.studies.study import VARIANTS

LABELS = {"ours": "with the virtual environment", "ours-without-model": "without"}
COLOURS = ("#2b6cb0", "#e07a1f", "#3a8f5c", "#7b8794")


def imagined(prefix: str) -> dict[str, str]:
    """Return the labels of the variants that a study of imagined roads compares."""
    modelled, few, middle, many = compared_with(prefix)
    if few == many:
        return {modelled: "whole roads imagined besides", few: "without"}
    return {
        modelled: "whole roads imagined besides",
        many: "without, in large iterations",
        middle: f"without, in iterations of {VARIANTS[middle].changes['trpo.batch_steps']:,}",
        few: "without, in small ones",
    }


def validations(variant: str, study: str = "table-2", road: str = "ring") -> tuple[np.ndarray, np.ndarray]:
    """Return actual steps, shape (points,), and the returns on the validation seeds, shape (runs, points).

    Before a training was validated for the first time there is nothing.
    """
    curves = json.loads((RESULTS / study / "curves.json").read_text())[road][variant]
    steps, values = np.array(curves["steps"]), np.array(curves["return_validation"])
    first = int(np.argmax((values != values[:, :1]).any(0)))  # until then the first is all that is known
    return steps[max(0, first - 1) :], values[:, max(0, first - 1) :]


def draw(
    labels: dict[str, str] = LABELS,
    study: str = "table-2",
    lowest: float | None = None,
    road: str = "ring",
) -> Image:
    """Draw validation against actual steps: mean and range of the runs; from `lowest` on, steps by powers."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    most = 0.0
    for (variant, label), colour in zip(labels.items(), COLOURS, strict=False):
        steps, curves = validations(variant, study, road)
        most = max(most, curves.max())
        axes.fill_between(steps / 1000, curves.min(0), curves.max(0), color=colour, alpha=0.15, lw=0)
        axes.plot(steps / 1000, curves.mean(0), color=colour, label=label)
    if lowest is not None:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylim(lowest, most + 5.0)
    axes.set_xlabel("actual simulator steps [thousands]")
    axes.set_ylabel("return of an episode, validation")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return Image(content.getvalue(), width=900)


def on_ramps_so_far() -> pd.DataFrame:
    """Return what first trainings of the on-ramp earn in validation after so many actual steps."""
    labels = {
        "on-ramp-in-turn": "imagined, learned from in turn",
        "on-ramp-union": "imagined, one update",
        "on-ramp-few": "without",
    }
    files = [
        (label, path) for folder, label in labels.items() for path in RESULTS.glob(f"tried/{folder}/*.jsonl")
    ]
    rows = pd.concat([pd.read_json(path, lines=True).assign(which=label) for label, path in files])
    table = []
    for (label, steps), found in rows.groupby(["which", "actual_steps"])["return_validation"]:
        if count := found.count():
            between = f" ({found.min():,.0f} to {found.max():,.0f})" if count > 1 else ""
            earned = f"{found.mean():,.0f}{between}"
            row = {
                "": label,
                "actual steps": f"{steps:,}",
                "trainings": count,
                "return in validation": earned,
            }
            table.append(row)
    return pd.DataFrame(table)


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
                "beyond the best tuned expert": interval(row["beyond_best_expert"], 0, "+"),
                "each": ", ".join(f"{gain:+.0f}" for gain in row["gains"]),
                f"reach {level:.0f}": f"{len(there)} of {len(curves)}",
                "after actual steps": ", ".join(f"{count:,}" for count in sorted(there)),
            }
        )
    return pd.DataFrame(table)
