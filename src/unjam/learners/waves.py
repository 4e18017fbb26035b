"""An actual road beside imagined ones, for whoever wants to see whether the same waves come."""

from typing import NamedTuple

from unjam.worlds.record import Episode, Floats


class RoadTrajectories(NamedTuple):
    """Everybody on a road, at some moments; M moments, N columns, of which each vehicle has one."""

    speeds: Floats
    """[m/s], shape (M, N), NaN where nobody is"""
    positions: Floats
    """front bumpers [m], likewise"""
    lanes: Floats
    """in which lane each is, likewise, or (0, 0)"""
    cav_columns: list[int]
    """columns of CAVs"""


class Waves(NamedTuple):
    """The same road as it was and as it is imagined: do the same waves come?"""

    time_step: float
    """from one moment to the next [s]"""
    loop_length: float
    """of a closed road [m], or NaN"""
    lane_names: tuple[str, ...]
    """of a road with lanes"""
    roads: dict[str, RoadTrajectories]
    """`recorded_states`, `road_model_study` with what was learned, and by the `base` alone"""


def road_trajectories(episode: Episode, interval: int) -> RoadTrajectories:
    """Return everybody at every so many-th moment of an episode."""
    speeds, positions, lanes = (
        values[::interval] for values in (episode.speeds, episode.positions, episode.lane_indices)
    )
    return RoadTrajectories(speeds, positions, lanes, episode.cav_columns)
