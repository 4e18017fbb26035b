"""Figures of positions and speeds over time: trajectories of vehicles, and maps of the lanes."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from unjam.reports import figures
from unjam.reports.results import Float32s, PlotEpisode

SPEED_FIELD_POSITIONS = 250  # number of positions along the road with a speed
FILL_DISTANCE, FILL_SECONDS = 10.0, 1.4
"""a figure shows the speed of a vehicle up to this distance from it [m], plus this time of driving [s]"""
MAX_TIME_BINS, MAX_POSITION_BINS = 240, 100  # maximum number of bins of a lane map, in time and along the road
MIN_SAMPLES_PER_CELL = 4  # mean number of samples per cell at which hardly any cell is empty
PANEL_WIDTH = 4.75  # width of the figure of a driver [inch]; up to three are next to each other, on a phone one
SCALE_QUANTILE = 0.98  # quantile of all speeds from which vehicles have the brightest color
MAX_LANE_MAPS = 4  # lanes with the most traffic are drawn
HUMAN_LINE_STYLE: dict[str, Any] = {"colors": "white", "linewidths": 0.35, "alpha": 0.35}
CAV_LINE_STYLE: dict[str, Any] = {"colors": figures.CAV_PLOT_COLOR, "linewidths": 1.6}


def speed_scale(episodes: Sequence[PlotEpisode]) -> Normalize:
    """Return a scale of speed for all figures of these episodes, on which a few fast vehicles have no influence.

    The scale starts at zero; on recorded roads, where waves are often small, it starts at the smallest speed.
    """
    speeds = np.concatenate([_append_recorded(episode, episode.speeds, 1).ravel() for episode in episodes])
    speeds = speeds[~np.isnan(speeds)]
    lowest = np.floor(speeds.min()) if all(episode.has_recorded_leader for episode in episodes) else 0.0
    return Normalize(lowest, max(lowest + 1.0, np.ceil(np.quantile(speeds, SCALE_QUANTILE))) if speeds.size else 1.0)


class PanelRow(NamedTuple):
    """A row of panels over time: label, relative height, and a function that draws an episode with a scale of speed."""

    label: str
    height: float
    draw: Callable[[Axes, PlotEpisode, Normalize], None]


def episode_grid(
    episodes: Sequence[PlotEpisode], rows: Sequence[PanelRow], height: float, selection: Sequence[PlotEpisode] = ()
) -> Figure:
    """Draw rows of panels for each episode, up to three episodes next to each other.

    `height` is the total height of the rows of one episode [inch]. `selection` are the episodes to draw, by default
    all; the scales of time and speed are for all `episodes`.
    """
    selection, width = selection or episodes, PANEL_WIDTH if selection else figures.FIGURE_WIDTH
    count = len(selection)
    columns = 2 if count == 4 else min(count, 3)
    blocks = -(-count // columns)
    figure, heights = figures.new_figure(height * blocks + 0.3, width), [row.height for row in rows] * blocks
    panels = figure.subplots(len(heights), columns, sharex=True, squeeze=False, height_ratios=heights)
    scale, longest = speed_scale(episodes), max(episode.times[-1] for episode in episodes)
    for index, episode in enumerate(selection):
        block, column = divmod(index, columns)
        for row_index, row in enumerate(rows):
            axes = panels[block * len(rows) + row_index, column]
            row.draw(axes, episode, scale)
            axes.set_xlim(0, longest)
            if row_index == 0:
                axes.set_title(figures.short_label(episode.driver), fontsize=10)
            if column == 0:
                axes.set_ylabel(row.label)
            if row_index == len(rows) - 1 and index + columns >= count:
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
    for axes in panels.flat:
        axes.set_visible(bool(axes.collections))
    figure.align_ylabels(panels[:, 0])
    colors = ScalarMappable(scale, figures.SPEED_COLORMAP)
    bar = figure.colorbar(colors, ax=panels, shrink=0.8, pad=0.02, aspect=30, extend="max")
    bar.set_label("speed [m/s]")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    return figure


def add_vehicle_lines(axes: Axes, times: np.ndarray, positions: np.ndarray, max_step: float, **style: Any) -> None:
    """Add a line for each vehicle, interrupted at NaN and at steps of `max_step` or more [m].

    `times` has shape (T,), `positions` shape (T, N).
    """
    points = np.stack([np.broadcast_to(times, positions.T.shape), positions.T], axis=-1)
    is_connected = np.abs(np.diff(positions.T)) < max_step
    segments = list(np.stack([points[:, :-1], points[:, 1:]], axis=2)[is_connected])
    axes.add_collection(LineCollection(segments, rasterized=True, **style))


@rc_context(figures.PLOT_STYLE)
def trajectory_figure(episodes: Sequence[PlotEpisode], selection: Sequence[PlotEpisode] = ()) -> Figure:
    """Draw the positions of all vehicles over time, colored by speed; a panel per driver.

    A stop-and-go wave is a dark band that runs against the direction of travel. Sections where the road crosses
    itself are shaded. On a merge road the ramp has a panel below that of the main road; on a user network, the
    most frequent route is drawn. Behind a recorded vehicle, positions are relative to it. `selection` is as in
    `episode_grid`.
    """
    branches = list(dict.fromkeys(branch for episode in episodes for branch in episode.branches)) or [""]
    rows = [_branch_row(episodes, branch, index == 0) for index, branch in enumerate(branches)]
    return episode_grid(episodes, rows, 3.1 + 0.9 * (len(rows) - 1), selection)


def _branch_row(episodes: Sequence[PlotEpisode], branch: str, is_main: bool) -> PanelRow:
    all_positions = np.concatenate([_branch_positions(episode, branch, is_main).ravel() for episode in episodes])
    all_positions = all_positions[~np.isnan(all_positions)]
    extent = (float(all_positions.min()), float(all_positions.max())) if all_positions.size else (0.0, 1.0)
    if all(episode.is_closed for episode in episodes):
        extent = 0.0, max(episode.loop_length for episode in episodes)

    def draw(axes: Axes, episode: PlotEpisode, scale: Normalize) -> None:
        stride = max(1, len(episode.times) // figures.MAX_PLOT_TIMES)
        positions = _branch_positions(episode, branch, is_main)[::stride]
        times, speeds = episode.times[::stride], _append_recorded(episode, episode.speeds, 1)[::stride]
        axes.grid(False)
        axes.set_ylim(*extent)
        for start, end in episode.crossings:
            axes.axhspan(start, end, color=figures.TEXT_COLOR, alpha=0.15, lw=0, zorder=1.5, rasterized=True)
        loop_length, max_step, width = 0.0, np.inf, 0.5  # open roads have many vehicles
        grid = np.linspace(*extent, SPEED_FIELD_POSITIONS)
        if episode.is_closed:
            loop_length, max_step, width = episode.loop_length, episode.loop_length / 2, 1.0  # no line across the seam
            positions, grid = positions % loop_length, np.linspace(0.0, loop_length, SPEED_FIELD_POSITIONS)
        if is_main:
            _mark_merges(axes, episode, extent)
        field = speed_field(positions, speeds, grid, loop_length, episode.has_recorded_leader)
        axes.pcolormesh(times, grid, field, cmap=figures.SPEED_COLORMAP, norm=scale, rasterized=True)
        is_cav = np.isin(np.arange(speeds.shape[1]), episode.controlled_columns)
        for group, style in ((~is_cav, HUMAN_LINE_STYLE), (is_cav, CAV_LINE_STYLE)):
            style = {**style, "linewidths": width * style["linewidths"]}
            add_vehicle_lines(axes, times, positions[:, group], max_step, **style)

    is_moving = any(episode.has_recorded_leader for episode in episodes)
    label = "position behind the recorded vehicle [m]" if is_moving else "position along the road [m]"
    return PanelRow(f"{branch} [m]" if branch else label, 3.0 if is_main else 1.0, draw)


def _append_recorded(episode: PlotEpisode, values: np.ndarray, quantity: int) -> np.ndarray:
    """Append the recorded vehicle to values of all vehicles, shape (T + 1, N); `quantity`: 0 positions, 1 speeds."""
    if not episode.has_recorded_leader:
        return values
    return np.column_stack([values, episode.replayed_motion[..., quantity]])


def _branch_positions(episode: PlotEpisode, branch: str, is_main: bool) -> np.ndarray:
    """Return the positions of the vehicles while they are on a branch, shape (T + 1, N); NaN elsewhere.

    Vehicles of other branches are on the main branch downstream of the merge. A recorded vehicle is the last column and
    the origin of all positions.
    """
    if not branch:
        positions = _append_recorded(episode, episode.positions, 0)
        return positions - positions[:, -1:] if episode.has_recorded_leader else positions
    is_of_branch = np.array(episode.branches) == branch
    has_merged = episode.positions >= 0
    is_on_branch = is_of_branch | has_merged if is_main else is_of_branch & ~has_merged
    return np.where(is_on_branch, episode.positions, np.nan)


def speed_field(
    positions: np.ndarray, speeds: np.ndarray, grid: np.ndarray, loop_length: float, is_platoon: bool = False
) -> np.ndarray:
    """Return the speed along the road at each time [m/s], shape (grid points, times).

    The speed is interpolated between vehicles, and NaN far from all vehicles; for a platoon, it is NaN only outside of
    it. Without this field, white stripes between lines of vehicles cause moiré patterns on screens. `positions` [m] and
    `speeds` [m/s] of the vehicles have the shape (times, N), NaN off the road. `grid` has the ascending positions of
    the result [m]. `loop_length` [m] is 0 for an open road.
    """
    field = np.full((len(grid), len(positions)), np.nan)
    for step, (position, speed) in enumerate(zip(positions, speeds, strict=True)):
        present = np.flatnonzero(~np.isnan(position))
        if not len(present):
            continue
        present = present[np.argsort(position[present])]
        position, speed = position[present], speed[present]
        if loop_length:  # repeat the vehicles before and after the loop
            position = np.concatenate([position - loop_length, position, position + loop_length])
            speed = np.tile(speed, 3)
        rear = (np.searchsorted(position, grid) - 1).clip(min=0)
        front = (rear + 1).clip(max=len(position) - 1)
        nearest = np.where(np.abs(grid - position[rear]) < np.abs(grid - position[front]), rear, front)
        is_near = np.abs(grid - position[nearest]) <= FILL_DISTANCE + FILL_SECONDS * speed[nearest]
        if is_platoon:
            is_near = (grid >= position[0]) & (grid <= position[-1])
        field[is_near, step] = np.interp(grid, position, speed)[is_near]
    return field


def _mark_merges(axes: Axes, episode: PlotEpisode, extent: tuple[float, float]) -> None:
    """Draw a dashed line where a ramp joins the road, if between the first and last position of a panel [m]."""
    for position in episode.merge_positions:
        if extent[0] < position < extent[1]:
            axes.axhline(position, color=figures.TEXT_COLOR, lw=0.8, ls=(0, (4, 3)), zorder=1.6, rasterized=True)
            label = {"ha": "left", "va": "bottom", "fontsize": 7, "color": figures.TEXT_COLOR, "zorder": 3}
            axes.text(0.01, position, "ramp joins", transform=axes.get_yaxis_transform(), **label)


def has_lane_maps(episodes: Sequence[PlotEpisode]) -> bool:
    """Return whether episodes are drawn lane by lane, because all are on the same road with lanes."""
    return (
        bool(episodes)
        and len({tuple(episode.lane_names) for episode in episodes}) == 1
        and bool(episodes[0].lane_names)
    )


def space_time_figure(episodes: Sequence[PlotEpisode], selection: Sequence[PlotEpisode] = ()) -> Figure:
    """Draw speeds over time and position: a map per lane, or a line per vehicle; `selection` as in `episode_grid`."""
    return (lane_map_figure if has_lane_maps(episodes) else trajectory_figure)(episodes, selection)


@rc_context(figures.PLOT_STYLE)
def lane_map_figure(episodes: Sequence[PlotEpisode], selection: Sequence[PlotEpisode] = ()) -> Figure:
    """Draw the mean speed in cells of time and road, a row per lane from left to right, a column per driver.

    The mean speed is that of Edie: total distance divided by total time in a cell. Cells without vehicles are white;
    red lines are CAVs, and dashed lines show where ramps join. `selection` is as in `episode_grid`.
    """
    lanes = _busiest_lanes(episodes)
    extents = [_lane_range(episodes, lane) for lane in lanes]
    max_span = max(end - start for start, end in extents)
    end_time = max(episode.times[-1] for episode in episodes)
    ranges = zip(lanes, extents, strict=True)
    rows = [_lane_row(episodes[0], lane, (end_time, *extent), max_span) for lane, extent in ranges]
    return episode_grid(episodes, rows, 0.4 + 1.75 * sum(row.height for row in rows), selection)


def _busiest_lanes(episodes: Sequence[PlotEpisode]) -> list[int]:
    """Return the lanes to draw from left to right: those with the most vehicles on the drawn road."""
    counts = {
        lane: sum(int(np.sum((episode.lane_indices == lane) & ~np.isnan(episode.positions))) for episode in episodes)
        for lane in range(len(episodes[0].lane_names))
    }
    busy = sorted((lane for lane in counts if counts[lane]), key=lambda lane: -counts[lane])
    return sorted(busy[:MAX_LANE_MAPS]) or [0]


def _lane_range(episodes: Sequence[PlotEpisode], lane: int) -> tuple[float, float]:
    """Return the first and last position of vehicles on a lane [m]."""
    positions = np.concatenate([episode.positions[episode.lane_indices == lane] for episode in episodes])
    positions = positions[~np.isnan(positions)]
    return (float(positions.min()), float(positions.max()) + 1.0) if len(positions) else (0.0, 1.0)


def mean_speed_grid(episode: PlotEpisode, lane: int, extent: tuple[float, float, float]) -> Float32s:
    """Return the mean speeds in cells of position and time on a lane [m/s], NaN without vehicles.

    `extent` is the last time [s] and the first and last position [m]. Cells are at least as long as the distance
    between two samples of a vehicle, so that fast vehicles skip no cells, or shorter if there are enough vehicles.
    """
    end_time, start, end = extent
    steps, vehicles = np.nonzero((episode.lane_indices == lane) & ~np.isnan(episode.positions))
    time_bins = max(1, min(MAX_TIME_BINS, int(end_time / episode.control_step)))
    step_length = float(np.nanmax(episode.speeds, initial=1.0)) * episode.control_step
    supported_bins = max((end - start) / step_length, len(steps) / time_bins / MIN_SAMPLES_PER_CELL)
    position_bins = max(1, min(MAX_POSITION_BINS, int(supported_bins)))
    column = (episode.times[steps] / (end_time + episode.control_step) * time_bins).astype(int)
    relative_position = (episode.positions[steps, vehicles] - start) / (end - start)
    row = (relative_position * position_bins).astype(int).clip(0, position_bins - 1)
    sums, counts = np.zeros((2, position_bins, time_bins))
    np.add.at(sums, (row, column), episode.speeds[steps, vehicles])
    np.add.at(counts, (row, column), 1)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0).astype(np.float32)


def _lane_row(first_episode: PlotEpisode, lane: int, extent: tuple[float, float, float], max_span: float) -> PanelRow:
    end_time, start, end = extent

    def draw(axes: Axes, episode: PlotEpisode, scale: Normalize) -> None:
        speeds = mean_speed_grid(episode, lane, extent)
        axes.grid(False)
        rows, columns = speeds.shape
        edges = np.linspace(0.0, end_time + episode.control_step, columns + 1), np.linspace(start, end, rows + 1)
        axes.pcolormesh(*edges, speeds, cmap=figures.SPEED_COLORMAP, norm=scale, rasterized=True)
        axes.set_ylim(start, end)
        _mark_merges(axes, episode, (start, end))
        cavs = episode.controlled_columns
        positions = np.where(episode.lane_indices[:, cavs] == lane, episode.positions[:, cavs], np.nan)
        add_vehicle_lines(axes, episode.times, positions, np.inf, colors=figures.CAV_PLOT_COLOR, linewidths=0.35)

    return PanelRow(f"{first_episode.lane_names[lane]}\n[m]", max((end - start) / max_span, 0.3), draw)
