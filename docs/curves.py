"""Learning curves with the virtual environment and without it, from files under results/model/."""

import json
from io import BytesIO

import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.figure import Figure
from tables import RESULTS, rows_of

from unjam.reports.statistics import paired_difference

CURVES = RESULTS / "model" / "curves"
LABELS = {"with": "with the virtual environment", "without": "without"}
COLOURS = {"with": "#2b6cb0", "without": "#e07a1f"}
SEEDS = range(5)


def progress(kind: str, seed: int) -> list[dict]:
    """Return the rows of progress of a run."""
    text = (CURVES / f"{kind}-{seed}" / "progress.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


def validations(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return actual steps, and the returns on the validation seeds, shape (runs, points)."""
    curves = []
    steps = np.zeros(0)
    for seed in SEEDS:
        rows = progress(kind, seed)
        points = [(0, rows[0]["return_expert"])]
        points += [
            (row["actual_steps"], row["return_validation"])
            for row in rows
            if row["return_validation"] is not None
        ]
        steps, returns = np.array(points, float).T
        curves.append(returns)
    return steps, np.array(curves)


def draw() -> Image:
    """Draw validation against actual steps: mean and range of the runs."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    for kind, label in LABELS.items():
        steps, curves = validations(kind)
        axes.fill_between(steps / 1000, curves.min(0), curves.max(0), color=COLOURS[kind], alpha=0.15, lw=0)
        axes.plot(steps / 1000, curves.mean(0), color=COLOURS[kind], label=label)
    axes.axhline(curves[0, 0], color="#1f2933", lw=0.8, ls="--", label="expert")
    axes.set_xlabel("actual simulator steps [thousands]")
    axes.set_ylabel("return of an episode, validation")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return Image(content.getvalue(), width=900)


def reached(kind: str, level: float) -> list[float]:
    """Return the actual steps after which each run's validation first reached `level`; NaN: never."""
    steps, curves = validations(kind)
    found = []
    for curve in curves:
        there = np.flatnonzero(curve >= level)
        found.append(float(steps[there[0]]) if len(there) else float("nan"))
    return found


def judged() -> pd.DataFrame:
    """Return a table of all runs: gain beyond the expert, steps to what runs without it reach on average."""
    level = float(validations("without")[1].max(1).mean())
    table = []
    for kind, label in LABELS.items():
        for seed, steps in zip(SEEDS, reached(kind, level), strict=True):
            rows = rows_of(f"model/curves/{kind}-{seed}/evaluation.json")
            gain = paired_difference(rows["trained"], rows["pi"], "return")
            parts: dict[str, float] = {}
            for row in progress(kind, seed):
                for part, seconds in row["seconds"].items():
                    parts[part] = parts.get(part, 0.0) + seconds
            table.append(
                {
                    "": label,
                    "training seed": seed,
                    "beyond the expert": f"{gain.mean:+.0f} [{gain.low:+.0f}, {gain.high:+.0f}]",
                    f"actual steps to {level:.0f}": "never" if np.isnan(steps) else f"{steps:,.0f}",
                    "wall time [s]": f"{sum(parts.values()):.0f}",
                    "of it fit and imagine": f"{parts.get('fit', 0) + parts.get('imagine', 0):.0f}",
                }
            )
    return pd.DataFrame(table)
