"""The geometry of a motorway with on-ramps, which all simulators read, and the motorway of one episode.

Positions are along the main road from its entrance [m]. Lane 0 consists of the ramps and their acceleration lanes;
the lanes of the main road follow from right to left.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from unjam.drivers.roadside import RoadsideSettings
from unjam.physics.arrays import Array
from unjam.scenarios.road import BuiltRoad, Connection, Edge, Node, OpenRoad, RoadNetwork, Route, VehicleType

MAIN_ROUTE = "motorway"
"""route, and first edge, of vehicles that enter the main road"""
RAMP_OFFSET = 60.0
"""distance between the main road and the nodes where ramps begin [m]"""


class RampGeometry(NamedTuple):
    """An on-ramp, the lane of which continues next to the main road and ends there."""

    merge_start: float
    """position where the lane starts to run next to the main road [m]"""
    merge_end: float
    """position where the lane ends [m]"""
    length: float
    """length upstream of the merging section [m]"""
    speed_limit: float
    """speed limit upstream of the merging section [m/s]"""

    @property
    def start(self) -> float:
        """Position where the ramp begins [m]."""
        return self.merge_start - self.length


class MotorwaySections(NamedTuple):
    """The road sections and the next ramps of n vehicles; arrays of shape (n,).

    The next ramp is the first one with a merging section that ends downstream of the vehicle, else the last ramp.
    """

    ramp: Array
    """index of the next ramp"""
    merge_start: Array
    merge_end: Array
    """positions where the merging section of the next ramp starts and ends [m]"""
    ramp_speed_limit: Array
    """speed limit of the next ramp [m/s]"""
    start: Array
    """position where the section starts: the entrance, or the start or end of a merging section [m]"""
    is_before: Array
    """whether the vehicle is upstream of the merging section"""
    is_merging: Array
    """whether the vehicle is in the merging section"""


class MotorwayGeometry(NamedTuple):
    """A motorway with any number of ramps, from upstream to downstream; no two of them overlap."""

    length: float
    speed_limit: float
    lane_count: int
    """number of lanes of the main road"""
    vehicle_length: float
    ramps: tuple[RampGeometry, ...] = ()

    @property
    def origin(self) -> float:
        """Zero of recorded positions [m]: the start of the first merging section, or the entrance without ramps."""
        return self.ramps[0].merge_start if self.ramps else 0.0

    @property
    def lane_names(self) -> tuple[str, ...]:
        """Names of the lanes from right to left; a road without ramps has no lane 0."""
        inner = [f"lane {lane}" for lane in range(2, self.lane_count)]
        inner = ["middle lane"] if len(inner) == 1 else inner
        main = ["motorway"] if self.lane_count == 1 else ["right lane", *inner, "left lane"]
        return (*(["ramp"] if self.ramps else []), *main)

    @property
    def route_names(self) -> tuple[str, ...]:
        """Names of the routes from the entrance and from each ramp to the end."""
        return (MAIN_ROUTE, *(_element_name("ramp", index) for index in range(len(self.ramps))))

    def sections(self, lane: Array, position: Array) -> MotorwaySections:
        """Return the sections of n vehicles with these lanes and positions [m], arrays of shape (n,)."""
        ramps = self.ramps or (RampGeometry(self.length, self.length, 0.0, self.speed_limit),)
        merge_starts, merge_ends, lengths, limits = np.array(ramps, position.dtype).T
        # A vehicle that stands at the end of an acceleration lane is not yet on the next ramp.
        ramp_starts = merge_starts[1:] - lengths[1:] + self.vehicle_length
        ramp = (position[:, None] >= np.where(lane[:, None] == 0, ramp_starts, merge_ends[:-1])).sum(1)
        merge_start, merge_end = merge_starts[ramp], merge_ends[ramp]
        is_before, is_past = position < merge_start, position >= merge_end
        last_merge_end = np.where(ramp > 0, merge_ends[ramp - 1], 0.0)
        start = np.where(is_before, last_merge_end, np.where(is_past, merge_end, merge_start))
        return MotorwaySections(ramp, merge_start, merge_end, limits[ramp], start, is_before, ~is_before & ~is_past)

    def distance_to_merge(self, lane: Array, position: Array) -> Array | None:
        """Return the distance to the start of the next merging section [m], negative inside it; None without ramps."""
        return self.sections(lane, position).merge_start - position if self.ramps else None

    def speed_limits(self, lane: Array, sections: MotorwaySections) -> Array:
        """Return the speed limits at the positions of n vehicles [m/s]."""
        is_on_ramp = (lane == 0) & sections.is_before
        return np.where(is_on_ramp, sections.ramp_speed_limit, self.speed_limit)

    @property
    def network(self) -> RoadNetwork:
        """The network; x is 0 at `origin`."""
        lanes, origin = self.lane_count, self.origin
        merge_nodes = [_element_name(name, index) for index in range(len(self.ramps)) for name in ("joins", "closes")]
        node_pairs = pairwise(["entrance", *merge_nodes, "exit"])
        main = [
            Edge(name, *node_pair, end - start, lanes=lanes + index % 2)
            for index, ((name, start, end), node_pair) in enumerate(zip(self._main_edges(), node_pairs, strict=True))
        ]
        nodes, edges, connections = [Node("entrance", 0.0 - origin, 0.0)], main[:1], list[Connection]()
        for index, (name, ramp) in enumerate(zip(self.route_names[1:], self.ramps, strict=True)):
            upstream, merging, downstream = main[2 * index : 2 * index + 3]
            entrance, joins, closes = _element_name("ramp_entrance", index), merging.from_node, merging.to_node
            nodes += [
                Node(entrance, ramp.start - origin + 1.0, -RAMP_OFFSET),
                Node(joins, ramp.merge_start - origin, 0.0),
                Node(closes, ramp.merge_end - origin, 0.0),
            ]
            edges += [Edge(name, entrance, joins, ramp.length, speed_limit=ramp.speed_limit), merging, downstream]
            connections += [
                *(Connection(upstream.name, merging.name, lane, lane + 1) for lane in range(lanes)),
                Connection(name, merging.name, 0, 0),
                *(Connection(merging.name, downstream.name, lane + 1, lane) for lane in range(lanes)),
            ]
        nodes.append(Node("exit", self.length - origin, 0.0))
        links = tuple(connections)
        return RoadNetwork(tuple(nodes), tuple(edges), self.speed_limit, has_internal_links=False, connections=links)

    @property
    def routes(self) -> tuple[Route, ...]:
        """The routes in the order of `route_names`."""
        names = [name for name, *_ in self._main_edges()]
        ramps = enumerate(self.route_names[1:])
        return (Route(MAIN_ROUTE, tuple(names)), *(Route(name, (name, *names[2 * i + 1 :])) for i, name in ramps))

    @property
    def edge_lanes(self) -> list[tuple[str, int, float]]:
        """All lanes of all edges: name, lane of the road, and position of the start [m]."""
        main, edge_lanes = self._main_edges(), list[tuple[str, int, float]]()
        for (merging, start, _), name, ramp in zip(main[1::2], self.route_names[1:], self.ramps, strict=True):
            edge_lanes += [(f"{name}_0", 0, ramp.start), (f"{merging}_0", 0, start)]
        for lane in range(self.lane_count):
            edge_lanes += [(f"{name}_{lane + i % 2}", lane + 1, start) for i, (name, start, _) in enumerate(main)]
        return edge_lanes

    def _main_edges(self) -> list[tuple[str, float, float]]:
        """Return name, start and end of the edges of the main road; every second one is a merging section."""
        names = [MAIN_ROUTE]
        for index in range(len(self.ramps)):
            names += [_element_name("merging", index), _element_name("after", index)]
        points = [0.0, *(point for ramp in self.ramps for point in ramp[:2]), self.length]
        return list(zip(names, points[:-1], points[1:], strict=True))


def _element_name(name: str, ramp_index: int) -> str:
    """Return the name of an edge, node or route of a ramp, with the number of the ramp unless it is the first."""
    return f"{name}{ramp_index + 1}" if ramp_index else name


@dataclass(frozen=True, kw_only=True)
class MotorwayRoad(BuiltRoad, OpenRoad):
    """A motorway with the vehicles that enter it; human drivers have different parameters, and overtake."""

    geometry: MotorwayGeometry
    vehicle_types: dict[str, VehicleType]
    """the types of human drivers, by name"""
    peak: tuple[float, float]
    """begin and end of the peak of demand [s]"""
    free_flow_time: float
    """mean travel time of human drivers in free flow [s]"""
    roadside: RoadsideSettings
    """the roadside information that CAVs receive"""
