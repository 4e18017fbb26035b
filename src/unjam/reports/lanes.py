"""Space-time maps of speed by lane: on a road with lanes, lines of vehicles that overtake are but a smear."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from unjam.reports.figures import (
    CAV_COLOUR,
    SPEED_COLOURS,
    STYLE,
    add_speed_bar,
    new_figure,
    short,
    space_time,
    speed_scale,
)
from unjam.reports.results import Floats, Shown

TIMES, PLACES = 240, 100
"""cells of a map, at most, along time and along the road"""
FILLING = 4
"""vehicles at moments in a cell, in the mean, that leave hardly one empty"""
MOST_LANES = 4
"""lanes that have a map: of more, those with the most traffic"""


def drawn_by_lane(shown: Sequence[Shown]) -> bool:
    """Return whether episodes are drawn lane by lane: whether all are on one road with lanes."""
    return bool(shown) and len({tuple(each.lane_names) for each in shown}) == 1 and bool(shown[0].lane_names)


def space_time_of(shown: Sequence[Shown]) -> Figure:
    """Draw where vehicles are and how fast: a map for each lane, or without lanes a line for each vehicle."""
    return lane_maps(shown) if drawn_by_lane(shown) else space_time(shown)


@rc_context(STYLE)
def lane_maps(shown: Sequence[Shown]) -> Figure:
    """Draw the mean speed in cells of time and road, a row per lane from left to right, a column per driver.

    Speeds are Edie's: distance over time of all that is driven in a cell. Where nobody drives it is white;
    red lines are CAVs.
    """
    rows = _busiest(shown)
    columns = 2 if len(shown) == 4 else min(len(shown), 3)
    blocks = -(-len(shown) // columns)
    extents = [_extent(shown, lane) for lane in rows]
    spans = [end - start for start, end in extents]
    heights = [max(span / max(spans), 0.3) for span in spans]
    figure = new_figure((0.4 + 1.75 * sum(heights)) * blocks + 0.3)
    panels = figure.subplots(
        blocks * len(rows), columns, sharex=True, squeeze=False, height_ratios=heights * blocks
    )
    scale, longest = speed_scale(shown), max(episode.times[-1] for episode in shown)
    for axes in panels.flat:
        axes.set_visible(False)
    for number, episode in enumerate(shown):
        block, column = divmod(number, columns)
        for row, (lane, extent) in enumerate(zip(rows, extents, strict=True)):
            axes = panels[block * len(rows) + row, column]
            axes.set_visible(True)
            _map(axes, episode, lane, (longest, *extent), scale)
            if row == 0:
                axes.set_title(short(episode.driver), fontsize=10)
            if column == 0:
                axes.set_ylabel(f"{episode.lane_names[lane]}\n[m]")
            if row == len(rows) - 1 and number + columns >= len(shown):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
    figure.align_ylabels(panels[:, 0])
    add_speed_bar(figure, panels, scale)
    return figure


def _busiest(shown: Sequence[Shown]) -> list[int]:
    """Return the lanes to draw, from left to right: those in which anybody is on the road that is shown."""
    lanes = range(len(shown[0].lane_names))
    counts = [
        sum(int(np.sum((each.lanes == lane) & ~np.isnan(each.positions))) for each in shown) for lane in lanes
    ]
    busy = sorted((lane for lane in lanes if counts[lane]), key=lambda lane: -counts[lane])
    return sorted(busy[:MOST_LANES]) or [0]


def _extent(shown: Sequence[Shown], lane: int) -> tuple[float, float]:
    """Return the first and the last place of a lane at which anybody was [m]."""
    there = np.concatenate([each.positions[each.lanes == lane] for each in shown])
    there = there[~np.isnan(there)]
    return (float(there.min()), float(there.max()) + 1.0) if len(there) else (0.0, 1.0)


def mean_speeds(episode: Shown, lane: int, extent: tuple[float, float, float]) -> Floats:
    """Return the mean speeds in a lane's cells of place and time [m/s], NaN where nobody drives.

    `extent` is the last moment [s] and the first and last place [m]. A cell is not smaller than what is
    driven between two moments, or fast vehicles would leave holes, unless so many drive that they fill them.
    """
    longest, start, end = extent
    moments, vehicles = np.nonzero((episode.lanes == lane) & ~np.isnan(episode.positions))
    times = max(1, min(TIMES, int(longest / episode.step)))
    driven = float(np.nanmax(episode.speeds, initial=1.0)) * episode.step
    places = max(1, min(PLACES, int(max((end - start) / driven, len(moments) / times / FILLING))))
    column = (episode.times[moments] / (longest + episode.step) * times).astype(int)
    along = (episode.positions[moments, vehicles] - start) / (end - start)
    row = (along * places).astype(int).clip(0, places - 1)
    sums, counts = np.zeros((2, places, times))
    np.add.at(sums, (row, column), episode.speeds[moments, vehicles])
    np.add.at(counts, (row, column), 1)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0).astype(np.float32)


def _map(axes: Axes, episode: Shown, lane: int, extent: tuple[float, float, float], scale: Normalize) -> None:
    longest, start, end = extent
    speeds = mean_speeds(episode, lane, extent)
    axes.grid(False)
    places, times = (size + 1 for size in speeds.shape)
    edges = np.linspace(0.0, longest + episode.step, times), np.linspace(start, end, places)
    axes.pcolormesh(*edges, speeds, cmap=SPEED_COLOURS, norm=scale, rasterized=True)
    axes.set_xlim(0, longest)
    axes.set_ylim(start, end)
    cavs = episode.cavs
    places = np.where(episode.lanes[:, cavs] == lane, episode.positions[:, cavs], np.nan).T
    points = np.stack([np.broadcast_to(episode.times, places.shape), places], axis=-1)
    keep = ~np.isnan(np.diff(places))
    segments = list(np.stack([points[:, :-1], points[:, 1:]], axis=2)[keep])
    axes.add_collection(LineCollection(segments, colors=CAV_COLOUR, linewidths=0.35, rasterized=True))
