"""Space-time maps of speed for each lane: on roads with lanes, lines of vehicles that overtake are unreadable."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from unjam.reports.figures import (
    CAV_PLOT_COLOR,
    PLOT_STYLE,
    SPEED_COLORMAP,
    PanelRow,
    add_vehicle_lines,
    episode_grid,
    trajectory_figure,
)
from unjam.reports.results import Float32s, PlotEpisode

MAX_TIME_BINS, MAX_POSITION_BINS = 240, 100
"""of a map"""
MIN_SAMPLES_PER_CELL = 4
"""mean number of samples in a cell that leaves hardly any cell empty"""
MAX_LANE_MAPS = 4
"""if there are more lanes, those with the most traffic have maps"""


def has_lane_maps(episodes: Sequence[PlotEpisode]) -> bool:
    """Return whether episodes are drawn lane by lane: whether all are on the same road with lanes."""
    return bool(episodes) and len({tuple(each.lane_names) for each in episodes}) == 1 and bool(episodes[0].lane_names)


def space_time_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw positions and speeds over time: a map for each lane, or without lanes a line for each vehicle."""
    return lane_map_figure(episodes) if has_lane_maps(episodes) else trajectory_figure(episodes)


@rc_context(PLOT_STYLE)
def lane_map_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw the mean speed in cells of time and road, a row per lane from left to right, a column per driver.

    Speeds are Edie's: total distance over total time in a cell. Cells without vehicles are white; red lines are
    CAVs.
    """
    lanes = _busiest_lanes(episodes)
    extents = [_lane_range(episodes, lane) for lane in lanes]
    max_span = max(end - start for start, end in extents)
    longest = max(episode.times[-1] for episode in episodes)
    rows = [
        _lane_row(episodes[0], lane, (longest, *extent), max_span) for lane, extent in zip(lanes, extents, strict=True)
    ]
    return episode_grid(episodes, rows, 0.4 + 1.75 * sum(row.height for row in rows))


def _busiest_lanes(episodes: Sequence[PlotEpisode]) -> list[int]:
    """Return the lanes to draw, from left to right: of those with vehicles on the road shown, the busiest."""
    counts = {
        lane: sum(int(np.sum((each.lane_indices == lane) & ~np.isnan(each.positions))) for each in episodes)
        for lane in range(len(episodes[0].lane_names))
    }
    busy = sorted((lane for lane in counts if counts[lane]), key=lambda lane: -counts[lane])
    return sorted(busy[:MAX_LANE_MAPS]) or [0]


def _lane_range(episodes: Sequence[PlotEpisode], lane: int) -> tuple[float, float]:
    """Return the first and the last position of vehicles in a lane [m]."""
    present = np.concatenate([each.positions[each.lane_indices == lane] for each in episodes])
    present = present[~np.isnan(present)]
    return (float(present.min()), float(present.max()) + 1.0) if len(present) else (0.0, 1.0)


def mean_speed_grid(episode: PlotEpisode, lane: int, extent: tuple[float, float, float]) -> Float32s:
    """Return the mean speeds in a lane's cells of position and time [m/s], NaN where there is no vehicle.

    `extent` is the last time [s] and the first and last position [m]. A cell is not shorter than the distance
    between two samples of a vehicle, or fast vehicles would skip cells, unless there are enough vehicles.
    """
    longest, start, end = extent
    steps, vehicles = np.nonzero((episode.lane_indices == lane) & ~np.isnan(episode.positions))
    time_bins = max(1, min(MAX_TIME_BINS, int(longest / episode.control_step)))
    step_length = float(np.nanmax(episode.speeds, initial=1.0)) * episode.control_step
    enough = max((end - start) / step_length, len(steps) / time_bins / MIN_SAMPLES_PER_CELL)
    position_bins = max(1, min(MAX_POSITION_BINS, int(enough)))
    column = (episode.times[steps] / (longest + episode.control_step) * time_bins).astype(int)
    share = (episode.positions[steps, vehicles] - start) / (end - start)
    row = (share * position_bins).astype(int).clip(0, position_bins - 1)
    sums, counts = np.zeros((2, position_bins, time_bins))
    np.add.at(sums, (row, column), episode.speeds[steps, vehicles])
    np.add.at(counts, (row, column), 1)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0).astype(np.float32)


def _lane_row(first: PlotEpisode, lane: int, extent: tuple[float, float, float], max_span: float) -> PanelRow:
    longest, start, end = extent

    def draw(axes: Axes, episode: PlotEpisode, scale: Normalize) -> None:
        speeds = mean_speed_grid(episode, lane, extent)
        axes.grid(False)
        rows, columns = speeds.shape
        edges = np.linspace(0.0, longest + episode.control_step, columns + 1), np.linspace(start, end, rows + 1)
        axes.pcolormesh(*edges, speeds, cmap=SPEED_COLORMAP, norm=scale, rasterized=True)
        axes.set_ylim(start, end)
        cavs = episode.cav_columns
        positions = np.where(episode.lane_indices[:, cavs] == lane, episode.positions[:, cavs], np.nan)
        add_vehicle_lines(axes, episode.times, positions, np.inf, colors=CAV_PLOT_COLOR, linewidths=0.35)

    return PanelRow(f"{first.lane_names[lane]}\n[m]", max((end - start) / max_span, 0.3), draw)
