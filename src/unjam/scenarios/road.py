"""One episode's road and traffic, as a scenario draws it: geometry, vehicles, demand."""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.roadside import RoadsideSettings
from unjam.physics.idm import IDMParameters
from unjam.sumo_files import SumoFiles

Polyline = tuple[tuple[float, float], ...]
"""points (x, y) [m]"""


def as_polyline(points: NDArray[np.float64]) -> Polyline:
    """Return points of shape (n, 2) as a line."""
    return tuple((x, y) for x, y in points.tolist())


class Node(NamedTuple):
    """Where edges begin, end and meet."""

    name: str
    x: float
    """[m]"""
    y: float
    """[m]"""
    has_priority: bool = False
    """whether priorities of the edges decide who goes first"""
    radius: float | None = None
    """of its junction [m]; None: the simulator's"""


class Edge(NamedTuple):
    """A stretch of road between two nodes."""

    name: str
    from_node: str
    to_node: str
    length: float
    """[m]"""
    priority: int | None = None
    """larger goes first where edges meet"""
    shape: Polyline = ()
    """empty: straight"""
    lanes: int = 1
    speed_limit: float | None = None
    """what it allows [m/s]; None: what the network does"""


class Connection(NamedTuple):
    """An edge that another one follows, or a lane that follows a lane; lanes count from 0 at the right."""

    from_edge: str
    to_edge: str
    from_lane: int | None = None
    """None: all lanes, as the simulator connects them"""
    to_lane: int | None = None


@dataclass(frozen=True)
class RoadNetwork:
    """Nodes and edges."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    speed_limit: float
    """what every edge allows that says nothing else [m/s]"""
    has_internal_links: bool = True
    """whether ways across junctions have a length of their own"""
    connections: tuple[Connection, ...] = ()
    """empty: all that are possible"""


class Route(NamedTuple):
    """Edges one after the other."""

    name: str
    edges: tuple[str, ...]
    laps: int = 1
    """how often they are driven"""


class Entry(NamedTuple):
    """A vehicle that enters."""

    name: str
    route: str
    position: float
    """of its front bumper on the first edge [m]"""
    speed: float | Literal["last"] = 0.0
    """[m/s]; `last`: as fast as who entered before"""
    time: float = 0.0
    """[s]"""
    lane: int = 0
    vehicle_type: str = ""
    """of the road's `vehicle_types`; empty: as the scenario's people"""


@dataclass(frozen=True, kw_only=True)
class Road:
    """One episode's road and traffic."""

    limit_speed: float
    """speed that the traffic cannot exceed in the long run [m/s]: the scenario's own limit; NaN: unknown"""
    drawn_values: dict[str, float] = field(default_factory=dict)
    """what the episode's seed has drawn, by name"""
    human_parameters: dict[str, IDMParameters] = field(default_factory=dict)
    """how each vehicle's human driver drives, by vehicle; empty: all as the scenario says"""


@dataclass(frozen=True, kw_only=True)
class BuiltRoad(Road):
    """A road that is built for the episode, and who enters it."""

    network: RoadNetwork
    routes: tuple[Route, ...]
    entries: tuple[Entry, ...]
    """in order of time"""


@dataclass(frozen=True, kw_only=True)
class ClosedRoad(BuiltRoad):
    """A loop with one lane: nobody enters, nobody leaves, nobody overtakes."""

    vehicle_ids: tuple[str, ...]
    """all vehicles, in the order in which they stand along the road"""
    cav_ids: tuple[str, ...]
    """those of them that a driver drives, in the same order"""
    start_positions: NDArray[np.float64]
    """front bumper of each vehicle along the route at the start [m]"""
    loop_length: float
    """length of the closed road [m]"""
    crossings: tuple[tuple[float, float], ...]
    """where along the road it crosses another way: there SUMO drives commanded people itself [m]"""
    center_line: NDArray[np.float64]
    """the road's centre line: rows (coordinate along the route, x, y) [m]"""

    def provided_penetration_rate(self, required_fields: Collection[str]) -> float | None:
        """Return the share of CAVs, as a service tells it, where it is among what a driver asks for."""
        return len(self.cav_ids) / len(self.vehicle_ids) if "penetration_rate" in required_fields else None


class VehicleType(NamedTuple):
    """How somebody drives on a motorway, as SUMO's car-following models take it."""

    model: str
    """SUMO's name of the car-following model"""
    time_headway: float
    """[s]"""
    acceleration: float
    """[m/s2]"""
    deceleration: float
    """comfortable [m/s2]"""
    minimum_gap: float
    """to who stands ahead [m]"""
    speed_factor: float
    """wanted speed over what the road allows"""


class EdgeLane(NamedTuple):
    """A lane of an edge, and which way it is part of: a way is lanes one after the other."""

    name: str
    """the simulator's"""
    lane_index: int
    start: float
    """where along the main road it begins [m]"""
    speed_limit: float
    """what it allows [m/s]"""
    is_merging: bool = False
    """whether it leads nowhere and is there to change lanes: nobody is commanded on its edge"""


@dataclass(frozen=True, kw_only=True)
class OpenRoad(Road):
    """A road with ends: vehicles come and go."""

    cav_ids: frozenset[str] = frozenset()
    """those that a driver drives, where that is known before they enter"""


class Origin(NamedTuple):
    """Where a vehicle of a merging road comes from."""

    branch: int
    """0: the main road; 1: the ramp"""
    position: float
    """of its front bumper as it enters, negative before the place where both ways meet [m]"""


@dataclass(frozen=True, kw_only=True)
class MergeRoad(BuiltRoad, OpenRoad):
    """A main road that a ramp joins, with one lane each."""

    origins: dict[str, Origin]
    """of all vehicles that may enter"""
    junction_lengths: tuple[float, float]
    """lengths of the ways across the junction, of main road and ramp [m]; they end where the ways meet, and
    there SUMO drives commanded people itself"""


@dataclass(frozen=True, kw_only=True)
class MotorwayRoad(BuiltRoad, OpenRoad):
    """A main road with lanes that ramps join; people differ and overtake."""

    vehicle_types: dict[str, VehicleType]
    """the people that there are, by name"""
    edge_lanes: tuple[EdgeLane, ...]
    """of all edges"""
    lane_names: tuple[str, ...]
    """names of the ways that lanes join to, from right to left"""
    merge_position: float
    """where along the main road the ramp's lane begins to run beside it [m]"""
    length: float
    """of the main road [m]"""
    vehicle_length: float
    """of every vehicle [m]"""
    peak: tuple[float, float]
    """from when to when the most vehicles want to enter [s]"""
    free_flow_time: float
    """mean travel time of people where they are few [s]"""
    roadside: RoadsideSettings
    """what CAVs are told of the road ahead"""


@dataclass(frozen=True, kw_only=True)
class UserNetworkRoad(OpenRoad):
    """A network of the user's own, with all its traffic."""

    files: SumoFiles
    """what its files say"""
    penetration_rate: float
    """share of the vehicles that become CAVs"""
    cav_types: tuple[str, ...]
    """vehicle types all of whose vehicles become CAVs"""
    eligible_types: frozenset[str]
    """vehicle types whose vehicles the share may pick"""
    cav_seed: int
    """which vehicles the share picks"""
    cavs: int | None = None
    """at most so many of them, the first that enter"""
    drivers: tuple[IDMParameters, ...] = ()
    """calibrated people, one of whom drives each car; nobody where all drive as their types say"""
    calibrated_types: frozenset[str] = frozenset()
    """vehicle types that they drive"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """what CAVs are told of the road ahead"""
