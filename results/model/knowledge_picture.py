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
    """Return the errors by the number of actual steps: a row of panels per road."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.6), layout="constrained", dpi=130)
        panels = figure.subplots(len(ROADS), len(PANELS), sharex=True, squeeze=False)
        for (line, column), axes in np.ndenumerate(panels):
            road, (name, label) = ROADS[line], list(PANELS.items())[column]
            here = [row for row in rows if row["road"] == road]
            for alone, style in zip(ALONE, ("--", ":"), strict=True):
                (value,) = (row[name] for row in here if row["model"] == alone)
                axes.axhline(value, color=INK, lw=1.1, ls=style, label=alone)
            for (model, colour), shift in zip(
                zip(BASES, LINES[2:0:-1], strict=True), (0.96, 1.04), strict=True
            ):
                found = np.array(
                    [[row[name] for row in here if (row["model"], row["steps"]) == (model, n)] for n in STEPS]
                )
                places = np.array(STEPS) * shift
                axes.plot(places, found.mean(1), color=colour, lw=1.6, label=model)
                axes.plot(places, found, color=colour, lw=0, marker="o", ms=3, alpha=0.5)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks(STEPS, [f"{steps:,}" for steps in STEPS])
            axes.minorticks_off()
            axes.set_title(f"{road}: {label}", loc="left", fontsize=9, color=INK)
            if line == len(ROADS) - 1:
                axes.set_xlabel("actual steps")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
        return figure


if __name__ == "__main__":
    place = Path(sys.argv[1])
    picture(json.loads((place / "knowledge.json").read_text())["rows"]).savefig(place / "knowledge.png")
