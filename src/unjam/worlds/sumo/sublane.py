"""Neighbors in SUMO's sublane model, where vehicles of one lane drive side by side.

There SUMO reports the next vehicle of the same lane as the leader, even if it is alongside, and no vehicle that
protrudes from another lane. A leader in the sense of car following overlaps laterally.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

INTERNAL_EDGE_PREFIX = ":"
"""first letter of the edges within junctions"""


class LateralNeighbors(NamedTuple):
    """Leader and follower of a vehicle that overlap it laterally, with their net gaps [m]; empty name: none."""

    leader: str
    leader_gap: float
    follower: str
    follower_gap: float


def find_lateral_neighbors(sumo: Any, name: str, max_distance: float) -> LateralNeighbors:
    """Return the neighbors of a vehicle up to `max_distance` [m], on all lanes of the edges of its route.

    Lateral positions on the next edges are relative to the lane in which the vehicle arrives, and only its own edge is
    searched for followers, before the one that SUMO reports.
    """
    vehicle = sumo.vehicle
    front, length = vehicle.getLanePosition(name), vehicle.getLength(name)
    center, half_width = vehicle.getLateralLanePosition(name), vehicle.getWidth(name) / 2.0
    offset, leader, follower = -front, ("", max_distance), ("", max_distance)
    for number, lane in enumerate(_lanes_ahead(sumo, name)):
        if leader[0] or offset >= max_distance:
            break
        for other, lateral in _vehicles_of_edge(sumo, lane):
            distance = offset + vehicle.getLanePosition(other)
            if other == name or abs(lateral - center) >= half_width + vehicle.getWidth(other) / 2.0:
                continue
            if distance > 0.0:
                leader = min(leader, (other, distance - vehicle.getLength(other)), key=_gap)
            elif number == 0:
                follower = min(follower, (other, -length - distance), key=_gap)
        offset += sumo.lane.getLength(lane)
    if not follower[0]:
        other, gap = vehicle.getFollower(name, max_distance)
        if other and vehicle.getRoadID(other) != vehicle.getRoadID(name):
            follower = other, min(gap + vehicle.getMinGap(other), max_distance)
    return LateralNeighbors(*leader, *follower)


def _gap(neighbor: tuple[str, float]) -> float:
    return neighbor[1]


def _lanes_ahead(sumo: Any, name: str) -> Iterator[str]:
    """Yield the lane of a vehicle and the next ones of its route, with those within junctions."""
    lane = sumo.vehicle.getLaneID(name)
    if not lane:  # teleported
        return
    yield lane
    if lane.startswith(INTERNAL_EDGE_PREFIX):
        yield from _lanes_to_exit(sumo, lane)
    for link in sumo.vehicle.getNextLinks(name):
        target, internal_lane = link[0], link[4]
        if not internal_lane:
            yield target
            continue
        yield internal_lane
        yield from _lanes_to_exit(sumo, internal_lane)


def _lanes_to_exit(sumo: Any, lane: str) -> Iterator[str]:
    """Yield the lanes after one within a junction, up to the first outside."""
    while lane.startswith(INTERNAL_EDGE_PREFIX):
        link = sumo.lane.getLinks(lane)[0]
        lane = link[4] or link[0]
        yield lane


def _vehicles_of_edge(sumo: Any, lane: str) -> Iterator[tuple[str, float]]:
    """Yield the vehicles on all lanes of an edge, with the lateral positions of their centers to that of a lane [m]."""
    edge = sumo.lane.getEdgeID(lane)
    names = [f"{edge}_{number}" for number in range(sumo.edge.getLaneNumber(edge))]
    edge_width, centers = 0.0, dict[str, float]()
    for each in names:
        width = sumo.lane.getWidth(each)
        centers[each] = edge_width + width / 2.0
        edge_width += width
    for each in names:
        for other in sumo.lane.getLastStepVehicleIDs(each):
            yield other, centers[each] - centers[lane] + sumo.vehicle.getLateralLanePosition(other)
