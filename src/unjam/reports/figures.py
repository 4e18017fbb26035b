"""Pictures of drivers and trainings. Each function draws on a new figure."""

import base64
import io
import re
from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure
from PIL import Image

from unjam.reports.results import PlotEpisode, seconds_by_part

SPEED_COLORMAP = "viridis"
"""slow is dark, fast is bright: also without colour vision, and in print"""
TEXT_COLOR, MUTED_COLOR, GRID_COLOR = "#1f2933", "#697586", "#e4e7eb"
CAV_PLOT_COLOR = "#d7263d"
LINE_COLORS = ["#7b8794", "#e07a1f", "#2b6cb0", "#2f855a", "#b83280", "#805ad5", "#1a202c", "#00a3c4"]
"""of drivers, in the order in which they are shown"""
FIGURE_WIDTH = 10.5
"""of a figure of the page [inch]: its letters are legible from 760 pixels on, the least that it gets there"""
MAX_LABEL_LENGTH = 34
"""letters of a driver's label in a picture"""
DPI = 130
"""pixels per inch of what is drawn in pixels"""
MAX_PLOT_TIMES = 600
"""moments that a picture shows of an episode"""
SPEED_FIELD_POSITIONS = 250
"""places along the road at which a picture shows a speed"""
FILL_DISTANCE, FILL_SECONDS = 10.0, 1.4
"""how far from a vehicle a picture shows its speed: metres, and seconds of driving"""
HUMAN_LINE_STYLE: dict[str, Any] = {"colors": "white", "linewidths": 0.35, "alpha": 0.35}
CAV_LINE_STYLE: dict[str, Any] = {"colors": CAV_PLOT_COLOR, "linewidths": 1.6}

PLOT_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.usetex": False,  # the working folder may hold a matplotlibrc, and LaTeX runs what that says
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
    """Return a driver's label as far as a title has room: parameters that were tuned are many."""
    return label if len(label) <= MAX_LABEL_LENGTH else f"{label[: MAX_LABEL_LENGTH - 1]}…"


def new_figure(height: float, width: float = FIGURE_WIDTH) -> Figure:
    """Return an empty figure of so many inches; as wide as the page where nothing is said."""
    return Figure(figsize=(width, height), layout="constrained", dpi=DPI)


def data_uri(figure: Figure) -> str:
    """Return a figure as the `data:` address of an SVG, for a page that needs no network."""
    content = io.BytesIO()
    with rc_context({"svg.hashsalt": "unjam"}):  # the same figure gets the same bytes
        figure.savefig(content, format="svg", dpi=DPI, metadata={"Date": None})
    drawing = re.sub(
        rb'(?<=data:image/png;base64,)[^"]+',
        lambda found: base64.b64encode(_reduce_colors(base64.b64decode(found[0]))),
        content.getvalue(),
    )
    return f"data:image/svg+xml;base64,{base64.b64encode(drawing).decode()}"


def png_bytes(figure: Figure, dpi: int = DPI, reduce_colors: bool = True) -> bytes:
    """Return a figure as a PNG, a `small` one of 256 colours."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return _reduce_colors(content.getvalue()) if reduce_colors else content.getvalue()


def _reduce_colors(png: bytes) -> bytes:
    """Return a picture on white in 256 colours: a sixth of the size.

    Maximum coverage keeps colours that are rare: the CAV's, and the fastest.
    """
    image, small = Image.open(io.BytesIO(png)).convert("RGBA"), io.BytesIO()
    paper = Image.new("RGBA", image.size, "white")
    opaque = Image.alpha_composite(paper, image).convert("RGB")
    opaque.quantize(256, Image.Quantize.MAXCOVERAGE).save(small, "PNG")
    return small.getvalue()


def speed_scale(episodes: Sequence[PlotEpisode]) -> Normalize:
    """Return one scale of speed for all pictures of these episodes."""
    fastest = max(float(np.nanmax(episode.speeds, initial=0.0)) for episode in episodes)
    return Normalize(0.0, max(1.0, np.ceil(fastest)))


@rc_context(PLOT_STYLE)
def trajectory_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw where every vehicle is at every time, and the speed there; a panel per driver, all on one scale.

    A stop-and-go wave is a dark band that runs against the direction of travel. Where the road crosses itself
    is shaded. Of a merging road the ramp has a panel of its own below the main road's; of your own network
    the route that is driven most is shown.
    """
    branches = list(dict.fromkeys(branch for episode in episodes for branch in episode.branches)) or [""]
    count, parts = len(episodes), len(branches)
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    figure = new_figure((3.1 + 0.9 * (parts - 1)) * rows + 0.3)
    heights = [3.0, *[1.0] * (parts - 1)] * rows
    panels = figure.subplots(rows * parts, columns, sharex=True, squeeze=False, height_ratios=heights)
    scale = speed_scale(episodes)
    longest = max(episode.times[-1] for episode in episodes)
    for part, branch in enumerate(branches):
        positions = [_branch_positions(episode, branch, is_main=part == 0) for episode in episodes]
        extent = _position_range(episodes, positions)
        for number, episode in enumerate(episodes):
            row, column = divmod(number, columns)
            axes = panels[row * parts + part, column]
            _draw_trajectories(axes, episode, positions[number], extent, scale)
            axes.set_xlim(0, longest)
            axes.set_ylim(*extent)
            if part == 0:
                axes.set_title(short_label(episode.driver), fontsize=10)
            if column == 0:
                axes.set_ylabel(f"{branch} [m]" if branch else "position along the road [m]")
            if part == parts - 1 and number + columns >= count:
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
    for axes in panels.flat:
        axes.set_visible(bool(axes.collections))
    add_speed_colorbar(figure, panels, scale)
    return figure


def add_speed_colorbar(figure: Figure, panels: np.ndarray, scale: Normalize) -> None:
    """Draw beside all panels which colour is which speed."""
    bar = figure.colorbar(ScalarMappable(scale, SPEED_COLORMAP), ax=panels, shrink=0.8, pad=0.02, aspect=30)
    bar.set_label("speed [m/s]")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _branch_positions(episode: PlotEpisode, branch: str, is_main: bool) -> np.ndarray:
    """Return the positions of the vehicles while they are on a branch, shape (T + 1, N); NaN elsewhere.

    Who comes from another branch is on the main one from where both meet.
    """
    if not branch:
        return episode.positions
    own = np.array(episode.branches) == branch
    past = episode.positions >= 0
    return np.where(own | past if is_main else own & ~past, episode.positions, np.nan)


def _position_range(episodes: Sequence[PlotEpisode], positions: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the first and the last coordinate that a panel shows [m]."""
    if all(episode.is_closed for episode in episodes):
        return 0.0, max(episode.loop_length for episode in episodes)
    there = np.concatenate([each[~np.isnan(each)] for each in positions])
    return (float(there.min()), float(there.max())) if there.size else (0.0, 1.0)


def _draw_trajectories(
    axes: Axes, episode: PlotEpisode, positions: np.ndarray, extent: tuple[float, float], scale: Normalize
) -> None:
    every = max(1, len(episode.times) // MAX_PLOT_TIMES)
    times, positions, speeds = (each[::every] for each in (episode.times, positions, episode.speeds))
    axes.grid(False)
    for start, end in episode.crossings:
        axes.axhspan(start, end, color=TEXT_COLOR, alpha=0.15, lw=0, zorder=1.5, rasterized=True)
    loop_length, places = 0.0, np.linspace(*extent, SPEED_FIELD_POSITIONS)
    if episode.is_closed:
        loop_length = episode.loop_length
        positions, places = positions % loop_length, np.linspace(0.0, loop_length, SPEED_FIELD_POSITIONS)
    seam, width = loop_length / 2 or np.inf, 1.0 if episode.is_closed else 0.5  # many come and go
    field = speed_field(positions, speeds, places, loop_length)
    axes.pcolormesh(times, places, field, cmap=SPEED_COLORMAP, norm=scale, rasterized=True)
    is_cav = np.isin(np.arange(speeds.shape[1]), episode.cav_columns)
    for driven, style in ((~is_cav, HUMAN_LINE_STYLE), (is_cav, CAV_LINE_STYLE)):
        position = positions[:, driven].T
        points = np.stack([np.broadcast_to(times, position.shape), position], axis=-1)
        keep = np.abs(np.diff(position)) < seam  # not across the seam of the road, nor where nobody is
        segments = list(np.stack([points[:, :-1], points[:, 1:]], axis=2)[keep])
        style = {**style, "linewidths": width * style["linewidths"]}
        axes.add_collection(LineCollection(segments, rasterized=True, **style))


def speed_field(positions: np.ndarray, speeds: np.ndarray, grid: np.ndarray, loop_length: float) -> np.ndarray:
    """Return the speed along the road at each moment [m/s], shape (places, moments).

    Between two vehicles it goes from the one's to the other's; it is NaN where nobody is near. Lines alone
    would leave stripes of paper, which a screen of other pixels makes into patterns that are not there.

    Args:
        positions: of the vehicles [m], shape (moments, N), NaN where one is not on the road.
        speeds: of the vehicles [m/s], likewise.
        places: where it is asked for [m], ascending.
        loop_length: of a closed road [m]; 0: it has ends.
    """
    field = np.full((len(grid), len(positions)), np.nan)
    for moment, (where, fast) in enumerate(zip(positions, speeds, strict=True)):
        there = np.flatnonzero(~np.isnan(where))
        if not len(there):
            continue
        there = there[np.argsort(where[there])]
        where, fast = where[there], fast[there]
        if loop_length:  # it goes on at both ends
            where = np.concatenate([where - loop_length, where, where + loop_length])
            fast = np.tile(fast, 3)
        behind = (np.searchsorted(where, grid) - 1).clip(min=0)
        ahead = (behind + 1).clip(max=len(where) - 1)
        nearest = np.where(np.abs(grid - where[behind]) < np.abs(grid - where[ahead]), behind, ahead)
        near = np.abs(grid - where[nearest]) <= FILL_DISTANCE + FILL_SECONDS * fast[nearest]
        field[near, moment] = np.interp(grid, where, fast)[near]
    return field


@rc_context(PLOT_STYLE)
def time_series_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw three quantities over time, a line per driver.

    Of closed roads the CAV's speed and gap, and the std of speed across all vehicles; of roads with ends the
    mean speed, the std, and how many vehicles wait to enter.
    """
    figure = new_figure(6.2)
    panels = figure.subplots(3, 1, sharex=True)
    closed = all(episode.is_closed for episode in episodes)
    for episode, colour in zip(episodes, LINE_COLORS, strict=False):
        every = max(1, len(episode.times) // MAX_PLOT_TIMES)
        for axes, (label, values) in zip(panels, _time_series(episode, closed).items(), strict=True):
            axes.plot(episode.times[::every], values[::every], color=colour, lw=1.2)
            axes.set_ylabel(label)
        panels[0].plot([], [], color=colour, lw=1.2, label=short_label(episode.driver))
    limit = episodes[0].limit_speed
    if np.isfinite(limit):
        panels[0].axhline(limit, color=TEXT_COLOR, lw=0.8, ls=":", label="limit")
    for axes in panels:
        axes.set_ylim(bottom=0)
    panels[-1].set_xlabel("time [s]")
    panels[0].margins(x=0)
    figure.legend(loc="outside upper left", ncols=6)
    return figure


def _time_series(episode: PlotEpisode, is_closed: bool) -> dict[str, np.ndarray]:
    """Return what `time_series_figure` draws of an episode, by label; each of shape (T + 1,)."""
    there = np.where(np.isnan(episode.speeds).all(axis=1, keepdims=True), 0.0, episode.speeds)
    waves = {"speed std across\nvehicles [m/s]": np.nanstd(there, axis=1)}
    if is_closed:
        cav = episode.cav_columns[0]
        return {"CAV's speed [m/s]": episode.speeds[:, cav], "CAV's gap [m]": episode.gaps[:, cav], **waves}
    waiting = episode.backlog if len(episode.backlog) else np.zeros(len(there))
    return {"mean speed [m/s]": np.nanmean(there, axis=1), **waves, "vehicles waiting\nto enter": waiting}


@rc_context(PLOT_STYLE)
def learning_curve_figure(runs: dict[str, list[dict[str, Any]]], references: dict[str, float]) -> Figure:
    """Draw return against actual steps: of each run by its label, and of drivers that do not learn."""
    figure = new_figure(3.8)
    axes = figure.subplots()
    for (label, rows), colour in zip(runs.items(), cycle(LINE_COLORS[2:]), strict=False):
        steps = np.array([row["environment_steps"] for row in rows]) / 1000
        prefix = f"{label}: " if len(runs) > 1 else ""
        training, label = [row["return_mean"] for row in rows], f"{prefix}training, with exploration"
        axes.plot(steps, training, color=colour, lw=1, alpha=0.45, label=label)
        validated = [(0.0, rows[0]["return_expert"])]  # the policy starts as exactly its expert
        validated += [(step, row["return_validation"]) for step, row in zip(steps, rows, strict=True)]
        points = np.array([point for point in validated if point[1] is not None], float).reshape(-1, 2)
        label = f"{prefix}validation, deterministic"
        axes.plot(*points.T, color=colour, lw=1.8, marker="o", ms=3.5, label=label)
    styles = cycle(("--", ":", "-.", (0, (1, 3))))
    for (label, value), style in zip(references.items(), styles, strict=False):
        axes.axhline(value, color=TEXT_COLOR, lw=1.1, ls=style, label=label)
    axes.set_xlabel("actual simulator steps [thousands]")
    axes.set_ylabel("return of an episode")
    axes.margins(x=0.01, y=0.06)
    figure.legend(loc="outside upper left", ncols=3)
    return figure


@rc_context(PLOT_STYLE)
def training_time_figure(progress: Sequence[dict[str, Any]]) -> Figure:
    """Draw how the wall time of training divides among its parts."""
    totals = {f"{part} {seconds:.0f} s": seconds for part, seconds in seconds_by_part(progress).items()}
    figure = stacked_bars({"": totals}, "wall time [s]", height=1.5)
    axes = figure.axes[0]
    axes.set_yticks([])
    axes.margins(x=0)
    axes.spines["left"].set_visible(False)
    return figure


@rc_context(PLOT_STYLE)
def stacked_bars(bars: dict[str, dict[str, float]], label: str, height: float) -> Figure:
    """Draw a bar per name, its parts end to end; the same part has the same colour in all."""
    figure = new_figure(height)
    axes, left = figure.subplots(), np.zeros(len(bars))
    parts = dict.fromkeys(part for bar in bars.values() for part in bar)
    for part, colour in zip(parts, LINE_COLORS, strict=False):
        widths = np.array([bar.get(part, 0.0) for bar in bars.values()])
        axes.barh(list(bars), widths, left=left, color=colour, label=part)
        left = left + widths
    axes.set_xlabel(label)
    figure.legend(loc="outside upper left", ncols=6)
    return figure


def color_table() -> list[str]:
    """Return the colours of speed as hex codes, slowest first: for pictures that matplotlib does not draw."""
    return [to_hex(colour) for colour in colormaps[SPEED_COLORMAP](np.linspace(0, 1, 32))]
