"""A motorway with on-ramps: its geometry, which all simulators read, and one episode's traffic on it.

Positions are along the main road from its entrance [m]. Lane 0 is that of the ramps with their
acceleration lanes; the lanes of the main road follow from right to left.
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
    """An on-ramp: its lane continues next to the main road and ends there."""

    merge_start: float
    """position where its lane starts to run next to the main road [m]"""
    merge_end: float
    """position where that lane ends [m]"""
    length: float
    """length upstream of the merging section [m]"""
    speed_limit: float
    """speed limit upstream of the merging section [m/s]"""

    @property
    def start(self) -> float:
        """Position where it begins [m]."""
        return self.merge_start - self.length


class MotorwaySections(NamedTuple):
    """The sections where n vehicles are, and their next ramps; arrays of shape (n,).

    The next ramp has the first merging section that ends downstream of the vehicle; downstream of all, it is the last.
    """

    ramp: Array
    """index of the next ramp"""
    merge_start: Array
    merge_end: Array
    """positions where the merging section of the next ramp starts and ends [m]"""
    ramp_speed_limit: Array
    """speed limit of the next ramp [m/s]"""
    start: Array
    """position where the section starts: the entrance, or the last start or end of a merging section [m]"""
    is_before: Array
    """whether the vehicle is upstream of the merging section"""
    is_merging: Array
    """whether it is in the merging section"""


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
        """Zero of recorded positions: the first merging section, or the entrance of a road without ramps."""
        return self.ramps[0].merge_start if self.ramps else 0.0

    @property
    def lane_names(self) -> tuple[str, ...]:
        """Names of the lanes from right to left; a road without ramps has no lane 0."""
        inner = [f"lane {number}" for number in range(2, self.lane_count)]
        inner = ["middle lane"] if len(inner) == 1 else inner
        main = ["motorway"] if self.lane_count == 1 else ["right lane", *inner, "left lane"]
        return (*(["ramp"] if self.ramps else []), *main)

    @property
    def route_names(self) -> tuple[str, ...]:
        """Names of the routes from the entrance and from each ramp to the end."""
        return (MAIN_ROUTE, *(_numbered("ramp", number) for number in range(len(self.ramps))))

    def sections(self, lane: Array, position: Array) -> MotorwaySections:
        """Return the sections of n vehicles with these lanes and positions [m], arrays of shape (n,)."""
        ramps = self.ramps or (RampGeometry(self.length, self.length, 0.0, self.speed_limit),)
        merge_starts, merge_ends, lengths, limits = np.array(ramps, position.dtype).T
        # A vehicle that stands at the end of an acceleration lane is not yet on the next ramp.
        begins = merge_starts[1:] - lengths[1:] + self.vehicle_length
        ramp = (position[:, None] >= np.where(lane[:, None] == 0, begins, merge_ends[:-1])).sum(1)
        merge_start, merge_end = merge_starts[ramp], merge_ends[ramp]
        is_before, is_past = position < merge_start, position >= merge_end
        section_before = np.where(ramp > 0, merge_ends[ramp - 1], 0.0)
        start = np.where(is_before, section_before, np.where(is_past, merge_end, merge_start))
        return MotorwaySections(ramp, merge_start, merge_end, limits[ramp], start, is_before, ~is_before & ~is_past)

    def distance_to_merge(self, lane: Array, position: Array) -> Array | None:
        """Return the distance to the next merging section [m], in it negative; None without ramps."""
        return self.sections(lane, position).merge_start - position if self.ramps else None

    def speed_limits(self, lane: Array, sections: MotorwaySections) -> Array:
        """Return the speed limit where each of n vehicles is [m/s]."""
        is_on_ramp = (lane == 0) & sections.is_before
        return np.where(is_on_ramp, sections.ramp_speed_limit, self.speed_limit)

    @property
    def network(self) -> RoadNetwork:
        """The network; its x axis has its zero at `origin`."""
        lanes, origin = self.lane_count, self.origin
        borders = [_numbered(name, number) for number in range(len(self.ramps)) for name in ("joins", "closes")]
        parts = enumerate(zip(self._main_edges(), pairwise(["entrance", *borders, "exit"]), strict=True))
        main = [Edge(name, *ends, end - start, lanes=lanes + at % 2) for at, ((name, start, end), ends) in parts]
        nodes, edges, connections = [Node("entrance", 0.0 - origin, 0.0)], main[:1], list[Connection]()
        for number, (name, ramp) in enumerate(zip(self.route_names[1:], self.ramps, strict=True)):
            before, merging, after = main[2 * number : 2 * number + 3]
            entrance, joins, closes = _numbered("ramp_entrance", number), merging.from_node, merging.to_node
            nodes += [
                Node(entrance, ramp.start - origin + 1.0, -RAMP_OFFSET),
                Node(joins, ramp.merge_start - origin, 0.0),
                Node(closes, ramp.merge_end - origin, 0.0),
            ]
            edges += [Edge(name, entrance, joins, ramp.length, speed_limit=ramp.speed_limit), merging, after]
            connections += [
                *(Connection(before.name, merging.name, lane, lane + 1) for lane in range(lanes)),
                Connection(name, merging.name, 0, 0),
                *(Connection(merging.name, after.name, lane + 1, lane) for lane in range(lanes)),
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
        """All lanes of all edges: name, number among the lanes of the road, and position of the start [m]."""
        main, result = self._main_edges(), list[tuple[str, int, float]]()
        for (merging, start, _), name, ramp in zip(main[1::2], self.route_names[1:], self.ramps, strict=True):
            result += [(f"{name}_0", 0, ramp.start), (f"{merging}_0", 0, start)]
        for lane in range(self.lane_count):
            result += [(f"{name}_{lane + index % 2}", lane + 1, start) for index, (name, start, _) in enumerate(main)]
        return result

    def _main_edges(self) -> list[tuple[str, float, float]]:
        """Return name, start and end of the edges of the main road; every second one is a merging section."""
        names = [MAIN_ROUTE]
        for number in range(len(self.ramps)):
            names += [_numbered("merging", number), _numbered("after", number)]
        points = [0.0, *(point for ramp in self.ramps for point in ramp[:2]), self.length]
        return list(zip(names, points[:-1], points[1:], strict=True))


def _numbered(name: str, number: int) -> str:
    """Return the name of a part of a ramp, with the number of the ramp unless it is the first."""
    return f"{name}{number + 1}" if number else name


@dataclass(frozen=True, kw_only=True)
class MotorwayRoad(BuiltRoad, OpenRoad):
    """A motorway with the vehicles that enter it; human drivers differ, and overtake."""

    geometry: MotorwayGeometry
    vehicle_types: dict[str, VehicleType]
    """the types of human drivers, by name"""
    peak: tuple[float, float]
    """begin and end of the peak of demand [s]"""
    free_flow_time: float
    """mean travel time of human drivers in free flow [s]"""
    roadside: RoadsideSettings
    """the roadside information that CAVs receive"""
