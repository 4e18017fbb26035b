"""The picture of the study of Fig. 6."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from unjam.reports.figures import INK, LINES, STYLE

COLOURS = {"knowledge": LINES[2], "vanilla": LINES[1]}
LABELS = {"knowledge": "IDM + residual", "vanilla": "network alone"}


def picture(rows: Sequence[dict[str, Any]]) -> Figure:
    """Return training loss, error by the share of the data, and the same with more gradient steps."""
    main = [row for row in rows if row["split"] == "trajectories" and row["driver"] == "other"]
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 3.7), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        _losses(left, [row for row in main if row["size"] == 1.0])
        _errors(middle, [row for row in main if not row["longer"]])
        middle.set_title("200 passes, as in the paper", loc="left", fontsize=9, color=INK)
        longer = [row for row in main if row["longer"]]
        _errors(right, [*longer, *(row for row in main if row["size"] == 0.3)])
        right.set_title("at 1 % as many gradient steps as at 30 %", loc="left", fontsize=9, color=INK)
        right.sharey(middle)
        middle.set_ylabel("error of the acceleration, noise aside [m/s²]")
        middle.legend()
        return figure


def _losses(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    for network, colour in COLOURS.items():
        curves = [row["training_loss"] for row in rows if row["network"] == network]
        for curve in curves:
            axes.plot(np.arange(1, len(curve) + 1), curve, color=colour, lw=1.0, alpha=0.7)
    noise = next(row["noise"] for row in rows)
    axes.axhline(noise**2, color=INK, lw=0.9, ls=":")
    axes.annotate("noise", (1.2, noise**2), va="bottom", fontsize=8, color=INK)
    axes.set_xscale("log")
    _few_ticks(axes)
    axes.set_xlabel("passes over all training rows")
    axes.set_title("training loss [(m/s²)²]", loc="left", fontsize=9, color=INK)


def _errors(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    for network, colour in COLOURS.items():
        here = [row for row in rows if row["network"] == network]
        sizes = sorted({row["size"] for row in here})
        values = [[row["error_of_driver"] for row in here if row["size"] == size] for size in sizes]
        percent = 100 * np.array(sizes)
        means, spreads = [np.mean(value) for value in values], [np.std(value) for value in values]
        axes.errorbar(
            percent, means, spreads, color=colour, lw=1.5, marker="o", ms=4, capsize=3, label=LABELS[network]
        )
    axes.set_xscale("log")
    axes.set_xlabel("share of the training rows [%]")
    ticks = [100 * size for size in sorted({row["size"] for row in rows})]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    _few_ticks(axes)


def _few_ticks(axes: Axes) -> None:
    """Make the vertical axis logarithmic, with numbers that can be read within a decade."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 4.0, 6.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
