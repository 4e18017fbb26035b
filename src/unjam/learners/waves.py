"""Trajectories of the same road in the environment and in the model, to compare their waves."""

from typing import NamedTuple

from unjam.worlds.record import Episode, Floats


class RoadTrajectories(NamedTuple):
    """Trajectories of all vehicles on a road at M times, in N columns."""

    speeds: Floats
    """[m/s], shape (M, N), NaN without a vehicle"""
    positions: Floats
    """front bumpers [m], likewise"""
    lanes: Floats
    """lane indices, likewise, or of shape (0, 0)"""
    cav_columns: list[int]
    """columns of CAVs"""


class Waves(NamedTuple):
    """The same road in the environment and in the model."""

    time_step: float
    """[s]"""
    loop_length: float
    """of a closed road [m], or NaN"""
    lane_names: tuple[str, ...]
    """of a road with lanes"""
    roads: dict[str, RoadTrajectories]
    """`recorded`; `model`, with what was learned; and the `base` alone"""


def road_trajectories(episode: Episode, interval: int) -> RoadTrajectories:
    """Return every `interval`-th state of an episode."""
    tables = episode.speeds, episode.positions, episode.lane_indices
    return RoadTrajectories(*(values[::interval] for values in tables), episode.cav_columns)
