"""Space-time maps of speed by lane: on a road with lanes, lines of vehicles that overtake are but a smear."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from unjam.reports.figures import (
    CAV_PLOT_COLOR,
    PLOT_STYLE,
    SPEED_COLORMAP,
    add_speed_colorbar,
    new_figure,
    short_label,
    speed_scale,
    trajectory_figure,
)
from unjam.reports.results import Float32s, PlotEpisode

MAX_TIME_BINS, MAX_POSITION_BINS = 240, 100
"""cells of a map, at most, along time and along the road"""
MIN_SAMPLES_PER_CELL = 4
"""vehicles at moments in a cell, in the mean, that leave hardly one empty"""
MAX_LANE_MAPS = 4
"""lanes that have a map: of more, those with the most traffic"""


def has_lane_maps(episodes: Sequence[PlotEpisode]) -> bool:
    """Return whether episodes are drawn lane by lane: whether all are on one road with lanes."""
    return bool(episodes) and len({tuple(each.lane_names) for each in episodes}) == 1 and bool(episodes[0].lane_names)


def space_time_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw where vehicles are and how fast: a map for each lane, or without lanes a line for each vehicle."""
    return lane_map_figure(episodes) if has_lane_maps(episodes) else trajectory_figure(episodes)


@rc_context(PLOT_STYLE)
def lane_map_figure(episodes: Sequence[PlotEpisode]) -> Figure:
    """Draw the mean speed in cells of time and road, a row per lane from left to right, a column per driver.

    Speeds are Edie's: distance over time of all that is driven in a cell. Where nobody drives it is white;
    red lines are CAVs.
    """
    rows = _busiest_lanes(episodes)
    columns = 2 if len(episodes) == 4 else min(len(episodes), 3)
    blocks = -(-len(episodes) // columns)
    extents = [_lane_range(episodes, lane) for lane in rows]
    spans = [end - start for start, end in extents]
    heights = [max(span / max(spans), 0.3) for span in spans]
    figure = new_figure((0.4 + 1.75 * sum(heights)) * blocks + 0.3)
    panels = figure.subplots(blocks * len(rows), columns, sharex=True, squeeze=False, height_ratios=heights * blocks)
    scale, longest = speed_scale(episodes), max(episode.times[-1] for episode in episodes)
    for axes in panels.flat:
        axes.set_visible(False)
    for number, episode in enumerate(episodes):
        block, column = divmod(number, columns)
        for row, (lane, extent) in enumerate(zip(rows, extents, strict=True)):
            axes = panels[block * len(rows) + row, column]
            axes.set_visible(True)
            _draw_lane_map(axes, episode, lane, (longest, *extent), scale)
            if row == 0:
                axes.set_title(short_label(episode.driver), fontsize=10)
            if column == 0:
                axes.set_ylabel(f"{episode.lane_names[lane]}\n[m]")
            if row == len(rows) - 1 and number + columns >= len(episodes):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
    figure.align_ylabels(panels[:, 0])
    add_speed_colorbar(figure, panels, scale)
    return figure


def _busiest_lanes(episodes: Sequence[PlotEpisode]) -> list[int]:
    """Return the lanes to draw, from left to right: those in which anybody is on the road that is shown."""
    lanes = range(len(episodes[0].lane_names))
    counts = [
        sum(int(np.sum((each.lane_indices == lane) & ~np.isnan(each.positions))) for each in episodes) for lane in lanes
    ]
    busy = sorted((lane for lane in lanes if counts[lane]), key=lambda lane: -counts[lane])
    return sorted(busy[:MAX_LANE_MAPS]) or [0]


def _lane_range(episodes: Sequence[PlotEpisode], lane: int) -> tuple[float, float]:
    """Return the first and the last place of a lane at which anybody was [m]."""
    there = np.concatenate([each.positions[each.lane_indices == lane] for each in episodes])
    there = there[~np.isnan(there)]
    return (float(there.min()), float(there.max()) + 1.0) if len(there) else (0.0, 1.0)


def mean_speed_grid(episode: PlotEpisode, lane: int, extent: tuple[float, float, float]) -> Float32s:
    """Return the mean speeds in a lane's cells of place and time [m/s], NaN where nobody drives.

    `extent` is the last moment [s] and the first and last place [m]. A cell is not smaller than what is
    driven between two moments, or fast vehicles would leave holes, unless so many drive that they fill them.
    """
    longest, start, end = extent
    moments, vehicles = np.nonzero((episode.lane_indices == lane) & ~np.isnan(episode.positions))
    times = max(1, min(MAX_TIME_BINS, int(longest / episode.control_step)))
    driven = float(np.nanmax(episode.speeds, initial=1.0)) * episode.control_step
    places = max(
        1, min(MAX_POSITION_BINS, int(max((end - start) / driven, len(moments) / times / MIN_SAMPLES_PER_CELL)))
    )
    column = (episode.times[moments] / (longest + episode.control_step) * times).astype(int)
    along = (episode.positions[moments, vehicles] - start) / (end - start)
    row = (along * places).astype(int).clip(0, places - 1)
    sums, counts = np.zeros((2, places, times))
    np.add.at(sums, (row, column), episode.speeds[moments, vehicles])
    np.add.at(counts, (row, column), 1)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0).astype(np.float32)


def _draw_lane_map(
    axes: Axes, episode: PlotEpisode, lane: int, extent: tuple[float, float, float], scale: Normalize
) -> None:
    longest, start, end = extent
    speeds = mean_speed_grid(episode, lane, extent)
    axes.grid(False)
    places, times = (size + 1 for size in speeds.shape)
    edges = np.linspace(0.0, longest + episode.control_step, times), np.linspace(start, end, places)
    axes.pcolormesh(*edges, speeds, cmap=SPEED_COLORMAP, norm=scale, rasterized=True)
    axes.set_xlim(0, longest)
    axes.set_ylim(start, end)
    cavs = episode.cav_columns
    places = np.where(episode.lane_indices[:, cavs] == lane, episode.positions[:, cavs], np.nan).T
    points = np.stack([np.broadcast_to(episode.times, places.shape), places], axis=-1)
    keep = ~np.isnan(np.diff(places))
    segments = list(np.stack([points[:, :-1], points[:, 1:]], axis=2)[keep])
    axes.add_collection(LineCollection(segments, colors=CAV_PLOT_COLOR, linewidths=0.35, rasterized=True))
