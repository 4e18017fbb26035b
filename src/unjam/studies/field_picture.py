"""The picture of the study on field data."""

from collections.abc import Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.reports.figures import INK, LINES, STYLE

PUBLISHED = 3.64
"""error of the gap of a calibrated IDM on the published test pairs of NGSIM [m]"""
NAMES = {
    "paper's IDM": "paper's IDM",
    "IDM": "IDM, calibrated",
    "IDM, headway kept": "IDM, calibrated, headway kept",
    "vanilla": "network alone",
    "knowledge, paper's IDM": "paper's IDM + residual",
    "knowledge, paper's IDM clipped": "paper's IDM, clipped + residual",
    "knowledge, IDM": "calibrated IDM + residual",
    "IDM + multi-step": "calibrated IDM + multi-step residual",
    "IDM, headway kept + multi-step": "headway kept + multi-step residual",
}
"""of the models that are shown, from below to above"""
SHOWN = {"gap": (2.0, 12.0), "one_step": (0.4, 1.9)}
"""errors beyond this leave the picture, and are written at its edge [m, m/s2]"""


def picture(rows: Sequence[dict[str, Any]]) -> Figure:
    """Return, for NGSIM, the errors of the simulated gap, and beside them those of one step."""
    here = [row for row in rows if row["data"] == "ngsim" and row["model"] in NAMES]
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        for test, colour, shift in (("test", LINES[2], 0.14), ("others", LINES[0], -0.14)):
            label = {"test": "the 20 published test pairs", "others": "218 other drivers"}[test]
            _dots(left, [row for row in here if row["test"] == test], "gap", colour, shift, label)
            _dots(right, [row for row in here if row["test"] == test], "one_step", colour, shift, label)
        left.axvline(PUBLISHED, color=INK, lw=0.9, ls=":")
        left.annotate("published", (PUBLISHED + 0.1, len(NAMES) - 0.45), fontsize=8, color=INK)
        left.set_yticks(range(len(NAMES)), list(NAMES.values())[::-1])
        left.set_xlim(*SHOWN["gap"])
        left.set_ylim(-0.6, len(NAMES) - 0.2)
        left.set_xlabel("error of the gap, driving on [m]")
        right.set_xlim(*SHOWN["one_step"])
        left.plot([], [], "o", ms=4.5, color=INK, mfc="white", label="some collide")
        right.set_xlabel("error of the acceleration, one step [m/s²]")
        left.legend(loc="lower right")
        return figure


def _dots(
    axes: Axes, rows: Sequence[dict[str, Any]], name: str, colour: str, shift: float, label: str
) -> None:
    """Draw each seed as a dot with its interval; who collides has an open one."""
    labelled = False
    for place, model in enumerate(list(NAMES)[::-1]):
        found = [row for row in rows if row["model"] == model]
        for seed, row in enumerate(found):
            height = place + shift + 0.08 * (seed - (len(found) - 1) / 2)
            low, top = row[f"{name}_interval"]
            axes.plot([low, top], [height, height], color=colour, lw=1.2, alpha=0.6)
            axes.plot(
                row[name],
                height,
                marker="o",
                ms=4.5,
                color=colour,
                mfc="white" if row["collided"] else colour,
                label=None if labelled else label,
            )
            labelled = True
        most = SHOWN[name][1]
        beyond = [row[name] for row in found if row[name] > most]
        if beyond:
            words = f"{sum(beyond) / len(beyond):.1f} →"
            axes.annotate(words, (most, place + shift), ha="right", va="bottom", fontsize=8, color=colour)
