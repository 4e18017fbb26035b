"""One episode's road and traffic, as a scenario draws it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.idm import IDMParameters


@dataclass(frozen=True)
class PlainNetwork:
    """Nodes and edges, of which netconvert makes SUMO's network file."""

    nodes: str
    """XML of the nodes"""
    edges: str
    """XML of the edges"""
    netconvert_options: tuple[str, ...]
    connections: str = ""
    """XML of the connections; empty: all that are possible"""


@dataclass(frozen=True)
class SumoConfiguration:
    """The user's own network and traffic."""

    path: Path
    """a .sumocfg file"""
    additional_files: tuple[Path, ...]
    """those that it names; a command line that adds one must repeat them"""


@dataclass(frozen=True, kw_only=True)
class Road:
    """One episode's road and traffic, ready to be written as SUMO's input files."""

    network: PlainNetwork | SumoConfiguration
    traffic: str
    """XML of vehicle types, and of routes and vehicles where they are not the user's"""
    limit_speed: float
    """speed that the traffic cannot exceed in the long run [m/s]: the scenario's own limit; NaN: unknown"""
    drawn: dict[str, float] = field(default_factory=dict)
    """what the episode's seed has drawn, by name"""
    people: dict[str, IDMParameters] = field(default_factory=dict)
    """how each vehicle's human driver drives, by vehicle; empty: all as the scenario says"""


@dataclass(frozen=True, kw_only=True)
class ClosedRoad(Road):
    """A loop with one lane: nobody enters, nobody leaves, nobody overtakes."""

    network: PlainNetwork
    vehicle_ids: tuple[str, ...]
    """all vehicles, in the order in which they stand along the road"""
    cav_ids: tuple[str, ...]
    """those of them that a driver drives"""
    start_positions: NDArray[np.float64]
    """front bumper of each vehicle along the route at the start [m]"""
    loop_length: float
    """length of the closed road [m]"""
    crossings: tuple[tuple[float, float], ...]
    """where along the road it crosses another way: there SUMO drives commanded people itself [m]"""
    outline: NDArray[np.float64]
    """the road's centre line: rows (coordinate along the route, x, y) [m]"""


class Origin(NamedTuple):
    """Where a vehicle of a merging road comes from."""

    branch: int
    """0: the main road; 1: the ramp"""
    position: float
    """of its front bumper as it enters, negative before the place where both ways meet [m]"""


@dataclass(frozen=True, kw_only=True)
class MergingRoad(Road):
    """A main road that a ramp joins, with one lane each; vehicles come and go."""

    network: PlainNetwork
    origins: dict[str, Origin]
    """of all vehicles that may enter"""
    cav_ids: frozenset[str]
    """those of them that a driver drives"""
    junctions: tuple[float, float]
    """lengths of the ways across the junction, of main road and ramp [m]; they end where the ways meet, and
    there SUMO drives commanded people itself"""


@dataclass(frozen=True, kw_only=True)
class OwnRoad(Road):
    """A network of the user's own, with all its traffic."""

    network: SumoConfiguration
    cav_share: float
    """share of the vehicles that become CAVs"""
    cav_types: tuple[str, ...]
    """vehicle types all of whose vehicles become CAVs"""
    cars: frozenset[str]
    """vehicle types that the share may pick"""
    cav_seed: int
    """which vehicles the share picks"""
