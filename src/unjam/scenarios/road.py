"""The road and traffic of one episode, which a scenario draws: geometry, vehicles, demand."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Literal, NamedTuple

import numpy as np

from unjam.drivers.roadside import RoadsideSettings
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMParameters
from unjam.sumo_files import SumoFiles

Polyline = tuple[tuple[float, float], ...]
"""points (x, y) [m]"""


def to_polyline(points: Floats) -> Polyline:
    """Return points of shape (n, 2) as a polyline."""
    return tuple((x, y) for x, y in points.tolist())


class Node(NamedTuple):
    """A point (x, y) [m] where edges begin, end or meet."""

    name: str
    x: float
    y: float
    has_priority: bool = False
    """whether the priorities of the edges decide the right of way"""
    radius: float | None = None
    """radius of the junction at the node [m]; None: the simulator's default"""


class Edge(NamedTuple):
    """A piece of road between two nodes; the length is in m."""

    name: str
    from_node: str
    to_node: str
    length: float
    priority: int | None = None
    """edges of higher priority have the right of way; None: the simulator's default"""
    shape: Polyline = ()
    """line of the edge; empty: straight"""
    lanes: int = 1
    speed_limit: float | None = None
    """speed limit of the edge [m/s]; None: that of the network"""


class Connection(NamedTuple):
    """Two edges, or two lanes, that follow each other; lane 0 is the right one, None: all lanes."""

    from_edge: str
    to_edge: str
    from_lane: int | None = None
    to_lane: int | None = None


@dataclass(frozen=True)
class RoadNetwork:
    """The nodes and edges of a road."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    speed_limit: float
    """speed limit of all edges that define none [m/s]"""
    has_internal_links: bool = True
    """whether the lanes across junctions have a length of their own"""
    connections: tuple[Connection, ...] = ()
    """connections of edges; empty: all that are possible"""


class Route(NamedTuple):
    """Edges that a vehicle drives one after the other, for a number of laps."""

    name: str
    edges: tuple[str, ...]
    laps: int = 1


class Entry(NamedTuple):
    """A vehicle that wants to enter the road."""

    name: str
    route: str
    position: float
    """position of the front bumper on the first edge [m]"""
    speed: float | Literal["last"] = 0.0
    """speed at entry [m/s]; `last`: the speed of the vehicle that entered before"""
    time: float = 0.0
    """time at which the vehicle wants to enter [s]"""
    lane: int = 0
    vehicle_type: str = ""
    """one of the road's `vehicle_types`; empty: that of the scenario's human drivers"""


DRAWN_UNITS = {"file": "", "part": "", "begin": "s"}
"""units of drawn values by name; other values are in meters"""


def format_drawn_values(values: Mapping[str, float]) -> list[str]:
    """Return the drawn values of an episode as texts for captions."""
    return [f"{name} {value:g} {DRAWN_UNITS.get(name, 'm')}".strip() for name, value in values.items()]


@dataclass(frozen=True, kw_only=True)
class Road:
    """The road and traffic of one episode."""

    limit_speed: float
    """speed that traffic cannot exceed in the long run, defined by the scenario [m/s]; NaN: unknown"""
    drawn_values: dict[str, float] = field(default_factory=dict)
    """values drawn from the episode's seed, by name"""
    merge_positions: tuple[float, ...] = ()
    """positions along the road where ramps join [m]"""
    human_parameters: dict[str, IDMParameters] = field(default_factory=dict)
    """parameters of the human drivers by vehicle id; empty: all drivers have those of the scenario"""


@dataclass(frozen=True, kw_only=True)
class BuiltRoad(Road):
    """A road that is built for the episode, with the vehicles that enter it."""

    network: RoadNetwork
    routes: tuple[Route, ...]
    entries: tuple[Entry, ...]
    """vehicles that want to enter, ordered by time"""
    has_entry_checks: bool = True
    """whether SUMO inserts a vehicle only if its gap is safe"""


@dataclass(frozen=True, kw_only=True)
class OrderedRoad(BuiltRoad):
    """A road with one lane on which the vehicles and their order never change."""

    vehicle_ids: tuple[str, ...]
    """all vehicles, in their order along the road"""
    cav_ids: tuple[str, ...]
    """the CAVs, in the same order"""
    start_positions: Floats
    """position of each front bumper along the route at the start [m]"""
    loop_length: float
    """length of a closed road [m]; infinite on a road with ends"""
    center_line: Floats
    """center line of a closed road: rows (position along the route, x, y) [m]; no rows: straight"""
    replayed_speeds: Floats | None
    """recorded speeds that the front vehicle, the last of `vehicle_ids`, repeats at the start and after each simulation
    step [m/s], shape (S + 1,); None: no vehicle repeats a recording"""
    crossings: tuple[tuple[float, float], ...] = ()
    """sections where the road crosses itself [m]; there SUMO controls the motion of commanded human drivers"""

    @property
    def driven_count(self) -> int:
        """Number of vehicles that do not replay a recording."""
        return len(self.vehicle_ids) - (self.replayed_speeds is not None)

    @property
    def start_speed(self) -> float:
        """Speed of all vehicles at the start [m/s]."""
        return 0.0 if self.replayed_speeds is None else float(self.replayed_speeds[0])

    def provided_penetration_rate(self, required_fields: Collection[str]) -> float | None:
        """Return the penetration rate if it is among the fields that a driver requires, else None."""
        return len(self.cav_ids) / self.driven_count if "penetration_rate" in required_fields else None


@dataclass(frozen=True, kw_only=True)
class ClosedRoad(OrderedRoad):
    """A loop with one lane."""

    replayed_speeds: None = None


@dataclass(frozen=True, kw_only=True)
class RecordedRoad(OrderedRoad):
    """A platoon on a straight road behind a vehicle that replays a recording."""

    replayed_speeds: Floats
    loop_length: float = inf
    center_line: Floats = field(default_factory=lambda: np.zeros((0, 3)))


class VehicleType(NamedTuple):
    """A type of vehicle and driver on a motorway: parameters of one of SUMO's car-following models, in SI units."""

    model: str
    time_headway: float
    acceleration: float
    deceleration: float
    """comfortable deceleration"""
    minimum_gap: float
    """gap to a standing leader [m]"""
    speed_factor: float
    """desired speed divided by the speed limit"""
    length: float
    max_speed: float | None = None
    """maximum speed of the vehicle [m/s]; None: no limit below the desired speed"""
    vehicle_class: str | None = None
    """one of SUMO's vehicle classes; None: passenger cars"""
    emission_class: str | None = None
    """SUMO's emission class; None: that of the scenario"""
    parameters: tuple[tuple[str, float], ...] = ()
    """parameters of lane changing by SUMO's names; others have SUMO's defaults"""


@dataclass(frozen=True, kw_only=True)
class OpenRoad(Road):
    """A road with ends, which vehicles enter and leave."""

    cav_ids: frozenset[str] = frozenset()
    """the CAVs, if the scenario chooses them before they enter"""


class Origin(NamedTuple):
    """The point where a vehicle enters a merge."""

    branch: int
    """0: the main road; 1: the ramp"""
    position: float
    """position of the front bumper [m], negative upstream of the merge point"""


@dataclass(frozen=True, kw_only=True)
class MergeRoad(BuiltRoad, OpenRoad):
    """A main road that a ramp joins, with one lane each."""

    origins: dict[str, Origin]
    """origins of all vehicles that can enter, by vehicle id"""
    junction_lengths: tuple[float, float]
    """lengths of the lanes across the junction up to the merge point, of main road and ramp [m]; on these lanes SUMO
    controls the motion of commanded human drivers"""


@dataclass(frozen=True, kw_only=True)
class UserNetworkRoad(OpenRoad):
    """A SUMO network of the user with its traffic."""

    files: SumoFiles
    """content of the files of the network"""
    penetration_rate: float
    """share of the eligible vehicles that become CAVs"""
    cav_types: tuple[str, ...]
    """vehicle types of which all vehicles become CAVs"""
    eligible_types: frozenset[str]
    """vehicle types to which the penetration rate applies"""
    cav_seed: int
    """seed of the choice of CAVs"""
    max_cav_count: int | None = None
    """maximum number of CAVs: the first that enter"""
    drivers: tuple[IDMParameters, ...] = ()
    """calibrated human drivers, of which each car has one; empty: the vehicle types define all drivers"""
    calibrated_types: frozenset[str] = frozenset()
    """vehicle types with calibrated human drivers"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """the roadside information that CAVs receive"""
