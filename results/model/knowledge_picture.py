"""The picture of knowledge.json: errors of IDM alone, IDM + residual, networks alone, by actual steps.

    python results/model/knowledge_picture.py FOLDER

reads FOLDER/knowledge.json and writes FOLDER/knowledge.png.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from unjam.reports.figures import INK, LINES, STYLE

LEARNED = {"IDM + residual": LINES[2], "networks alone": LINES[1]}
ALONE = {"IDM alone": "--", "nothing changes": ":"}
PANELS = {
    "unexplained": "unexplained share of\na 0.1 s change, mean of 5 numbers",
    "gap_later": "error of the gap ahead\nafter 5 s [m]",
    "follower_gap_later": "error of the gap behind\nafter 5 s [m]",
}


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Return the errors by the number of actual steps: a row of panels per road, a dot per seed."""
    roads = list(dict.fromkeys(row["road"] for row in rows))
    steps = sorted({row["steps"] for row in rows if row["steps"]})
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.8), layout="constrained", dpi=130)
        panels = figure.subplots(len(roads), len(PANELS), sharex=True, squeeze=False)
        for road, line in zip(roads, panels, strict=True):
            here = [row for row in rows if row["road"] == road]
            for (name, label), axes in zip(PANELS.items(), line, strict=True):
                _errors(axes, here, name, steps)
                axes.set_title(f"{road}: {label}", loc="left", fontsize=9, color=INK)
        for axes in panels[-1]:
            axes.set_xlabel("actual steps")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
        return figure


def _errors(axes: Axes, rows: list[dict[str, Any]], name: str, steps: list[int]) -> None:
    for model, style in ALONE.items():
        (value,) = (row[name] for row in rows if row["model"] == model)
        axes.axhline(value, color=INK, lw=1.1, ls=style, label=model)
    for (model, colour), shift in zip(LEARNED.items(), (0.95, 1.05), strict=True):
        found = np.array(
            [[row[name] for row in rows if (row["model"], row["steps"]) == (model, n)] for n in steps]
        )
        places = np.array(steps) * shift
        axes.plot(places, found.mean(1), color=colour, lw=1.6, label=model)
        axes.plot(places, found, color=colour, lw=0, marker="o", ms=3, alpha=0.5)
    axes.set_xscale("log")
    axes.set_xticks(steps, [f"{n:,}" for n in steps])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


if __name__ == "__main__":
    place = Path(sys.argv[1])
    picture(json.loads((place / "knowledge.json").read_text())["rows"]).savefig(place / "knowledge.png")
