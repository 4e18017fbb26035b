"""Pictures. Each function draws on a new figure; `wide` for a screen, otherwise for a phone."""

import base64
import io
from collections.abc import Sequence
from itertools import cycle
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from unjam.reports.results import Shown

SPEED_COLOURS = "viridis"
"""slow is dark, fast is bright: also without colour vision, and in print"""
INK, MUTED, GRID = "#1f2933", "#697586", "#e4e7eb"
LINES = ["#7b8794", "#e07a1f", "#2b6cb0", "#2f855a", "#b83280", "#805ad5", "#1a202c", "#00a3c4"]
"""of drivers, in the order in which they are shown"""
POINTS_IN_TIME = 600
"""moments that a picture shows of an episode"""

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")


def data_uri(figure: Figure, kind: Literal["png", "svg"]) -> str:
    """Return a figure as a `data:` address, for a page that needs no network."""
    content = io.BytesIO()
    if kind == "svg":
        with rc_context({"svg.hashsalt": "unjam"}):  # the same figure gets the same bytes
            figure.savefig(content, format="svg", metadata={"Date": None})
        return _data_uri("image/svg+xml", content.getvalue())
    return _data_uri("image/png", png_bytes(figure))


def png_bytes(figure: Figure, dpi: int = 130) -> bytes:
    """Return a figure as a small PNG of 256 colours."""
    content, small = io.BytesIO(), io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    # A sixth of the size. Maximum coverage keeps colours that are rare: the CAV's, and the fastest.
    quantized = Image.open(content).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    quantized.save(small, "PNG")
    return small.getvalue()


def _data_uri(mime: str, content: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(content).decode()}"


def speed_scale(shown: Sequence[Shown]) -> Normalize:
    """Return one scale of speed for all pictures of these episodes."""
    fastest = max(float(np.nanmax(episode.speeds, initial=0.0)) for episode in shown)
    return Normalize(0.0, max(1.0, np.ceil(fastest)))


def space_time(shown: Sequence[Shown], wide: bool = True) -> Figure:
    """Draw where every vehicle is at every time, coloured by speed; a panel per driver, all on one scale.

    A stop-and-go wave is a dark band that runs against the direction of travel. Where the road crosses itself
    is shaded. Of a merging road the ramp has a panel of its own below the main road's; of your own network
    the route that is driven most is shown.
    """
    count = len(shown)
    with rc_context(STYLE):
        columns = min(count, 2 if count == 4 else 3) if wide else 1
        rows = -(-count // columns)
        branches = _branches(shown)
        figure = _figure(10.5 if wide else 4.4, (3.1 + 0.9 * (len(branches) - 1)) * rows + 0.3)
        heights = [3.0, *[1.0] * (len(branches) - 1)] * rows
        panels = figure.subplots(
            rows * len(branches), columns, sharex=True, squeeze=False, height_ratios=heights
        )
        scale = speed_scale(shown)
        longest = max(episode.times[-1] for episode in shown)
        for number, (episode, (row, column)) in enumerate(
            zip(shown, np.ndindex(rows, columns), strict=False)
        ):
            for part, branch in enumerate(branches):
                axes = panels[row * len(branches) + part, column]
                _trajectories(axes, episode, scale, branch, main=part == 0)
                axes.set_xlim(0, longest)
                axes.set_ylim(*_extent(shown, branch))
                if part == 0:
                    axes.set_title(episode.driver, loc="left", fontsize=10, color=INK)
                if column == 0:
                    axes.set_ylabel(f"{branch} [m]" if branch else "position along the road [m]")
                if part == len(branches) - 1 and number + columns >= count:
                    axes.set_xlabel("time [s]")
                    axes.tick_params(labelbottom=True)
        for axes in panels.flat:
            axes.set_visible(bool(axes.collections))
        mappable = ScalarMappable(scale, SPEED_COLOURS)
        bar = figure.colorbar(
            mappable, ax=panels, location="right" if wide else "bottom", shrink=0.8, pad=0.02, aspect=30
        )
        bar.set_label("speed [m/s]")
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        return figure


def _branches(shown: Sequence[Shown]) -> list[str]:
    """Return the parts of the road that have panels of their own; one without a name where there are none."""
    return list(dict.fromkeys(branch for episode in shown for branch in episode.branches)) or [""]


def _on_branch(episode: Shown, branch: str, main: bool) -> np.ndarray:
    """Return the positions of the vehicles while they are on a branch, shape (T + 1, N); NaN elsewhere.

    Who comes from another branch is on the main one from where both meet.
    """
    if not branch:
        return episode.positions
    own = np.array(episode.branches) == branch
    past = episode.positions >= 0
    return np.where(own | past if main else own & ~past, episode.positions, np.nan)


def _extent(shown: Sequence[Shown], branch: str) -> tuple[float, float]:
    """Return the first and the last coordinate of a branch [m]."""
    if all(episode.closed for episode in shown):
        return 0.0, max(episode.loop_length for episode in shown)
    main = branch == _branches(shown)[0]
    found = [_on_branch(episode, branch, main) for episode in shown]
    found = [positions for positions in found if not np.isnan(positions).all()]
    if not found:
        return 0.0, 1.0
    return min(float(np.nanmin(each)) for each in found), max(float(np.nanmax(each)) for each in found)


def _trajectories(axes: Axes, episode: Shown, scale: Normalize, branch: str, main: bool) -> None:
    every = max(1, len(episode.times) // POINTS_IN_TIME)
    times = episode.times[::every]
    axes.grid(False)
    for start, end in episode.crossings:
        axes.axhspan(start, end, color=GRID, lw=0)
    positions = _on_branch(episode, branch, main)[::every]
    if episode.closed:
        positions = positions % episode.loop_length
    seam = episode.loop_length / 2 if episode.closed else np.inf
    for is_cav in (False, True):
        driven = np.isin(np.arange(episode.speeds.shape[1]), episode.cavs) == is_cav
        position = positions[:, driven].T
        points = np.stack([np.broadcast_to(times, position.shape), position], axis=-1)
        keep = np.abs(np.diff(position)) < seam  # not across the seam of the road, nor where nobody is
        segments = list(np.stack([points[:, :-1], points[:, 1:]], axis=2)[keep])
        lines = LineCollection(
            segments,
            cmap=SPEED_COLOURS,
            norm=scale,
            linewidths=(2.6 if is_cav else 1.1) if episode.closed else (1.6 if is_cav else 0.7),
            rasterized=True,
        )
        lines.set_array(episode.speeds[::every, driven].T[:, :-1][keep])
        axes.add_collection(lines)
        if is_cav:
            width = 1.3 if episode.closed else 0.6
            axes.add_collection(LineCollection(segments, colors="#d7263d", linewidths=width, rasterized=True))


def over_time(shown: Sequence[Shown], wide: bool = True) -> Figure:
    """Draw three quantities over time, a line per driver.

    Of closed roads the CAV's speed and gap, and the std of speed across all vehicles; of roads with ends the
    mean speed, the std, and how many vehicles wait to enter.
    """
    with rc_context(STYLE):
        figure = _figure(10.5 if wide else 4.4, 6.2 if wide else 7.0)
        panels = figure.subplots(3, 1, sharex=True)
        closed = all(episode.closed for episode in shown)
        for episode, colour in zip(shown, LINES, strict=False):
            every = max(1, len(episode.times) // POINTS_IN_TIME)
            times = episode.times[::every]
            for axes, values in zip(panels, _three_of(episode, closed), strict=True):
                axes.plot(times, values[::every], color=colour, lw=1.2)
            panels[0].plot([], [], color=colour, lw=1.2, label=episode.driver)
        limit = shown[0].limit_speed
        if np.isfinite(limit):
            panels[0].axhline(limit, color=INK, lw=0.8, ls=":", label="limit")
        labels = (
            ("CAV's speed [m/s]", "CAV's gap [m]", "speed std across\nvehicles [m/s]")
            if closed
            else ("mean speed [m/s]", "speed std across\nvehicles [m/s]", "vehicles waiting\nto enter")
        )
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0)
        panels[-1].set_xlabel("time [s]")
        panels[0].margins(x=0)
        figure.legend(loc="outside upper left", ncols=6 if wide else 2, fontsize=9)
        return figure


def _three_of(episode: Shown, closed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    there = np.where(np.isnan(episode.speeds).all(axis=1, keepdims=True), 0.0, episode.speeds)
    std = np.nanstd(there, axis=1)
    if closed:
        column = episode.cavs[0]
        return episode.speeds[:, column], episode.gaps[:, column], std
    waiting = episode.waiting if len(episode.waiting) else np.zeros(len(std))
    return np.nanmean(there, axis=1), std, waiting


def learning_curve(
    runs: dict[str, list[dict[str, Any]]], references: dict[str, float], wide: bool = True
) -> Figure:
    """Draw return against actual simulator steps.

    Args:
        runs: rows of progress, by the label of the run.
        references: returns of drivers that do not learn, drawn as lines.
        wide: for a screen.
    """
    with rc_context(STYLE):
        figure = _figure(10.5 if wide else 4.4, 3.8)
        axes = figure.subplots()
        for (label, rows), colour in zip(runs.items(), cycle(LINES[2:]), strict=False):
            steps = np.array([row["actual_steps"] for row in rows]) / 1000
            prefix = f"{label}: " if len(runs) > 1 else ""
            training = [row["return_mean"] for row in rows]
            axes.plot(
                steps, training, color=colour, lw=1, alpha=0.45, label=f"{prefix}training, with exploration"
            )
            validated = [(0.0, rows[0]["return_expert"])]  # the policy starts as exactly its expert
            validated += [(step, row["return_validation"]) for step, row in zip(steps, rows, strict=True)]
            points = np.array([point for point in validated if point[1] is not None], float).reshape(-1, 2)
            axes.plot(
                *points.T,
                color=colour,
                lw=1.8,
                marker="o",
                ms=3.5,
                label=f"{prefix}validation, deterministic",
            )
        for (label, value), style in zip(
            references.items(), cycle(("--", ":", "-.", (0, (1, 3)))), strict=False
        ):
            axes.axhline(value, color=INK, lw=1.1, ls=style, label=label)
        axes.set_xlabel("actual simulator steps [thousands]")
        axes.set_ylabel("return of an episode")
        axes.margins(x=0.01, y=0.06)
        figure.legend(loc="outside upper left", ncols=3 if wide else 1, fontsize=9)
        return figure


def time_split(progress: list[dict[str, Any]], wide: bool = True) -> Figure:
    """Draw how the wall time of training divides among its parts."""
    totals: dict[str, float] = {}
    for row in progress:
        for part, seconds in row["seconds"].items():
            totals[part] = totals.get(part, 0.0) + seconds
    with rc_context(STYLE):
        figure = _figure(10.5 if wide else 4.4, 1.5)
        axes = figure.subplots()
        start = 0.0
        for (part, seconds), colour in zip(totals.items(), LINES, strict=False):
            axes.barh([0], [seconds], left=start, color=colour, label=f"{part} {seconds:.0f} s")
            start += seconds
        axes.set_yticks([])
        axes.set_xlabel("wall time [s]")
        axes.margins(x=0)
        axes.spines["left"].set_visible(False)
        figure.legend(loc="outside upper left", ncols=5 if wide else 2, fontsize=9)
        return figure


def colour_table(steps: int = 32) -> list[str]:
    """Return the colours of speed as hex codes, slowest first: for pictures that the page draws itself."""
    table = colormaps[SPEED_COLOURS](np.linspace(0, 1, steps))[:, :3]
    return [f"#{round(r * 255):02x}{round(g * 255):02x}{round(b * 255):02x}" for r, g, b in table]
