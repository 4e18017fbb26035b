"""Figures of episodes and trainings. Each function draws on a new figure."""

import base64
import io
import re
from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate
from unjam.reports.results import PlotEpisode, seconds_by_part, selected_row
from unjam.text import printable, to_one_line

SPEED_COLORMAP = "viridis"  # dark is slow, bright is fast: readable with color blindness and in print
TEXT_COLOR, MUTED_COLOR, GRID_COLOR = "#1f2933", "#697586", "#e4e7eb"
CAV_PLOT_COLOR = "#d7263d"
LINE_COLORS = ["#7b8794", "#e07a1f", "#2b6cb0", "#2f855a", "#b83280", "#805ad5", "#1a202c", "#00a3c4"]
"""colors of lines and bars, in the order of the legend"""
FIGURE_WIDTH = 10.5  # [inch]; texts are legible if a page shows the figure 760 pixels wide
MAX_LABEL_LENGTH = 34  # maximum length of the label of a driver in a figure [characters]
DPI = 130  # resolution of rasterized parts [pixels per inch]
MAX_PLOT_TIMES = 600  # maximum number of snapshots of an episode in a figure

PLOT_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.parse_math": False,  # names of drivers may have dollar signs
    "text.usetex": False,  # in other programs a matplotlibrc could enable LaTeX, which runs code
    "axes.edgecolor": MUTED_COLOR,
    "axes.labelcolor": TEXT_COLOR,
    "axes.titlecolor": TEXT_COLOR,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID_COLOR,
    "xtick.color": MUTED_COLOR,
    "ytick.color": MUTED_COLOR,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def short_label(label: str) -> str:
    """Cut the label of a driver, which can have many parameters, to the width of a title."""
    return to_one_line(label, MAX_LABEL_LENGTH)


class NotebookFigure(Figure):
    """A figure that notebooks display even if `matplotlib.pyplot` is not imported."""

    def _repr_png_(self) -> bytes:
        return png_bytes(self)


def new_figure(height: float, width: float = FIGURE_WIDTH) -> Figure:
    """Return an empty figure; height and width in inches, by default as wide as the page."""
    return NotebookFigure(figsize=(width, height), layout="constrained", dpi=DPI)


def data_uri(figure: Figure) -> str:
    """Return a figure as the `data:` address of an SVG, for a page that works offline."""
    return f"data:image/svg+xml;base64,{base64.b64encode(svg_bytes(figure)).decode()}"


def svg_bytes(figure: Figure) -> bytes:
    """Return a figure as an SVG."""
    content = io.BytesIO()
    with rc_context({"svg.hashsalt": "unjam"}):  # the same figure has the same bytes
        figure.savefig(content, format="svg", dpi=DPI, metadata={"Date": None})
    return re.sub(
        rb'(?<=data:image/png;base64,)[^"]+',
        lambda match: base64.b64encode(_reduce_colors(base64.b64decode(match[0]))),
        printable(content.getvalue().decode()).encode(),  # comments of the SVG contain labels
    )


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as a PNG of 256 colors."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    return _reduce_colors(content.getvalue())


def _reduce_colors(png: bytes) -> bytes:
    """Return a picture on white in 256 colors, a sixth of the size.

    Quantization by maximum coverage keeps rare colors: those of CAVs and of the highest speeds.
    """
    image, content = Image.open(io.BytesIO(png)).convert("RGBA"), io.BytesIO()
    background = Image.new("RGBA", image.size, "white")
    opaque = Image.alpha_composite(background, image).convert("RGB")
    opaque.quantize(256, Image.Quantize.MAXCOVERAGE).save(content, "PNG")
    return content.getvalue()


@rc_context(PLOT_STYLE)
def time_series_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw quantities over time, with a line for each driver.

    On closed and recorded roads: speed and gap of the first CAV, and of the same vehicle with a human driver; if no
    driver has CAVs, the mean speed; and the standard deviation of speed across all vehicles. On other open roads: mean
    speed, standard deviation, and any insertion backlog.
    """
    has_same_vehicles = all(episode.has_same_vehicles for episode in episodes)
    has_cav_panels = has_same_vehicles and any(episode.controlled_columns for episode in episodes)
    shows_backlog = not has_same_vehicles and any(np.any(episode.backlog) for episode in episodes)
    all_series = [_time_series(episode, has_cav_panels, shows_backlog) for episode in episodes]
    figure = new_figure(0.2 + 2.0 * len(all_series[0]))
    panels = figure.subplots(len(all_series[0]), 1, sharex=True)
    for episode, series, color in zip(episodes, all_series, LINE_COLORS, strict=False):
        stride = max(1, len(episode.times) // MAX_PLOT_TIMES)
        for axes, (label, values) in zip(panels, series.items(), strict=True):
            axes.plot(episode.times[::stride], values[::stride], color=color, lw=1.2)
            axes.set_ylabel(label)
        panels[0].plot([], [], color=color, lw=1.2, label=short_label(episode.driver))
    limit = episodes[0].limit_speed
    if np.isfinite(limit):
        panels[0].axhline(limit, color=TEXT_COLOR, lw=0.8, ls=":", label="limit speed")
    for axes in panels:
        axes.set_ylim(bottom=0)
    panels[-1].set_xlabel("time [s]")
    panels[0].margins(x=0)
    figure.legend(loc="outside upper left", ncols=6)
    return figure


def _time_series(episode: PlotEpisode, has_cav_panels: bool, shows_backlog: bool) -> dict[str, np.ndarray]:
    """Return the quantities of `time_series_figure` by label, each of shape (T + 1,)."""
    has_no_vehicles = np.isnan(episode.speeds).all(axis=1, keepdims=True)
    speeds = np.where(has_no_vehicles, 0.0, episode.speeds)
    speed_std = {"speed std across\nvehicles [m/s]": np.nanstd(speeds, axis=1)}
    if has_cav_panels:
        cav = episode.cav_columns[0]
        return {"CAV's speed [m/s]": episode.speeds[:, cav], "CAV's gap [m]": episode.gaps[:, cav], **speed_std}
    backlog = episode.backlog if len(episode.backlog) else np.zeros(len(speeds))
    backlogs = {"insertion backlog\n[vehicles]": backlog} if shows_backlog else {}
    return {"mean speed [m/s]": np.nanmean(speeds, axis=1), **speed_std, **backlogs}


@rc_context(PLOT_STYLE)
def last_vehicle_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw the speeds of the recorded vehicle, and of the last vehicle with each driver, over time."""
    figure = new_figure(3.2)
    axes, recordings = figure.subplots(), dict[bytes, PlotEpisode]()
    for episode, color in zip(episodes, LINE_COLORS, strict=False):
        if episode.has_recorded_leader:
            recordings.setdefault(episode.replayed_motion.tobytes(), episode)
            stride = max(1, len(episode.times) // MAX_PLOT_TIMES)
            ratios = (METRICS[name].function(episode) for name in ("amplification", "amplification_medium"))
            total, medium = ("–" if np.isnan(ratio) else f"{ratio:.2f}" for ratio in ratios)
            label = f"{short_label(episode.driver)}: amplification {total} (periods of 20 to 60 s: {medium})"
            axes.plot(episode.times[::stride], episode.speeds[::stride, 0], color=color, lw=1.4, label=label)
    for index, episode in enumerate(recordings.values()):
        style = {"color": TEXT_COLOR, "lw": 1.0, "ls": (0, (3, 1.5)), "label": "" if index else "recorded vehicle"}
        axes.plot(episode.times, episode.replayed_motion[:, 0, 1], **style, zorder=1.5)
    axes.set(xlabel="time [s]", ylabel="speed [m/s]")
    axes.margins(x=0)
    figure.legend(loc="outside upper left", ncols=2)
    return figure


@rc_context(PLOT_STYLE)
def learning_curve_figure(
    runs: dict[str, list[dict[str, Any]]],
    expert_returns: dict[str, float],
    test_returns: dict[str, Estimate],
    reference: str = "",
) -> Figure:
    """Draw returns in training over environment steps, and returns on test seeds after training.

    The upper panel has the returns on training and validation seeds: `runs` has rows of progress by label, a circle
    marks the selected network, and horizontal lines are the `expert_returns` by label. The lower panel has the
    `test_returns` by driver; with a `reference` they are differences to this driver. Returns on different seeds are
    not comparable.
    """
    figure = new_figure(3.8 + (0.6 + 0.22 * len(test_returns) if test_returns else 0.0))
    heights = [3.4, 0.4 + 0.22 * len(test_returns)] if test_returns else [1.0]
    axes, *test_panels = figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for (run_label, rows), color in zip(runs.items(), cycle(LINE_COLORS[2:]), strict=False):
        steps = np.array([row["environment_steps"] for row in rows]) / 1000
        prefix = f"{run_label}: " if len(runs) > 1 else ""
        returns, label = [row["return_mean"] for row in rows], f"{prefix}training seeds, with exploration"
        axes.plot(steps, returns, color=color, lw=1, alpha=0.45, label=label)
        validations = [(0.0, rows[0]["return_expert"])]  # the untrained policy equals its expert
        validations += [(step, row["return_validation"]) for step, row in zip(steps, rows, strict=True)]
        points = np.array([point for point in validations if point[1] is not None], float).reshape(-1, 2)
        label = f"{prefix}validation seeds, deterministic"
        axes.plot(*points.T, color=color, lw=1.8, marker="o", ms=3.5, label=label)
        if (row := selected_row(rows)) and len(runs) == 1:
            point = row["environment_steps"] / 1000, row["return_validation"]
            axes.scatter(*point, 110, "none", edgecolors=color, label="selected network")
    for (label, value), style in zip(expert_returns.items(), cycle(("--", ":", "-.", (0, (1, 3))))):
        axes.axhline(value, color=TEXT_COLOR, lw=1.1, ls=style, label=f"{label}, validation seeds")
    axes.set(xlabel="environment steps [thousands]", ylabel="return of an episode")
    axes.margins(x=0.01, y=0.06)
    for panel in test_panels:
        for index, estimate in enumerate(test_returns.values()):
            errors = np.nan_to_num([[estimate.mean - estimate.low], [estimate.high - estimate.mean]])
            panel.errorbar([estimate.mean], [index], xerr=errors, fmt="o", ms=4, color=TEXT_COLOR, capsize=3)
        panel.set_yticks(range(len(test_returns)), list(map(short_label, test_returns)))
        if reference:
            panel.axvline(0.0, color=TEXT_COLOR, lw=0.9)
        quantity = f"return minus that of {reference}" if reference else "return"
        panel.set(xlabel=f"{quantity} on test seeds, after training: mean and 95 % CI")
        panel.set(ylim=(len(test_returns) - 0.5, -0.5))
    figure.legend(loc="outside upper left", ncols=3)
    return figure


@rc_context(PLOT_STYLE)
def training_time_figure(progress: Sequence[dict[str, Any]]) -> Figure:
    """Draw the wall time of each part of training."""
    totals = {f"{part} {seconds:.0f} s": seconds for part, seconds in seconds_by_part(progress).items()}
    figure = stacked_bar_figure({"": totals}, "wall time [s]", height=1.5)
    axes = figure.axes[0]
    axes.set(yticks=[], xmargin=0.0)
    axes.spines["left"].set_visible(False)
    return figure


@rc_context(PLOT_STYLE)
def stacked_bar_figure(bars: dict[str, dict[str, float]], axis_label: str, height: float) -> Figure:
    """Draw a bar for each name with its parts end to end; a part has the same color in all bars."""
    figure = new_figure(height)
    axes, left = figure.subplots(), np.zeros(len(bars))
    parts = dict.fromkeys(part for bar in bars.values() for part in bar)
    for part, color in zip(parts, LINE_COLORS, strict=False):
        widths = np.array([bar.get(part, 0.0) for bar in bars.values()])
        axes.barh(list(bars), widths, left=left, color=color, label=part)
        left = left + widths
    axes.set_xlabel(axis_label)
    figure.legend(loc="outside upper left", ncols=6)
    return figure


def speed_colors() -> list[str]:
    """Return the colors of speeds as hexadecimal codes, slowest first, for drawings without matplotlib."""
    return [to_hex(color) for color in colormaps[SPEED_COLORMAP](np.linspace(0, 1, 32))]
