"""Neighbors in SUMO's sublane model, in which vehicles of one lane may drive side by side.

SUMO reports the next vehicle of the same lane as the leader, even if it is alongside, but no vehicle that protrudes
from another lane. Here, the leader is the next vehicle that overlaps laterally, as in car following.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

INTERNAL_EDGE_PREFIX = ":"
"""first letter of the ids of edges within junctions"""


class LateralNeighbors(NamedTuple):
    """Ids and net gaps [m] of the leader and follower that overlap a vehicle laterally; an empty id: there is none."""

    leader: str
    leader_gap: float
    follower: str
    follower_gap: float


def find_lateral_neighbors(sumo: Any, vehicle_id: str, max_distance: float) -> LateralNeighbors:
    """Return the neighbors of a vehicle up to `max_distance` [m], on all lanes of the edges of its route.

    Lateral positions on the next edges are relative to the lane on which the vehicle will arrive. The follower is a
    vehicle on the same edge, or else the follower that SUMO reports.
    """
    vehicle = sumo.vehicle
    front, length = vehicle.getLanePosition(vehicle_id), vehicle.getLength(vehicle_id)
    center, half_width = vehicle.getLateralLanePosition(vehicle_id), vehicle.getWidth(vehicle_id) / 2.0
    offset, leader, follower = -front, ("", max_distance), ("", max_distance)
    for index, lane in enumerate(_lanes_ahead(sumo, vehicle_id)):
        if leader[0] or offset >= max_distance:
            break
        for neighbor, lateral in _vehicles_of_edge(sumo, lane):
            distance = offset + vehicle.getLanePosition(neighbor)
            if neighbor == vehicle_id or abs(lateral - center) >= half_width + vehicle.getWidth(neighbor) / 2.0:
                continue
            if distance > 0.0:
                leader = min(leader, (neighbor, distance - vehicle.getLength(neighbor)), key=_gap)
            elif index == 0:
                follower = min(follower, (neighbor, -length - distance), key=_gap)
        offset += sumo.lane.getLength(lane)
    if not follower[0]:
        neighbor, gap = vehicle.getFollower(vehicle_id, max_distance)
        if neighbor and vehicle.getRoadID(neighbor) != vehicle.getRoadID(vehicle_id):
            follower = neighbor, min(gap + vehicle.getMinGap(neighbor), max_distance)
    return LateralNeighbors(*leader, *follower)


def _gap(neighbor: tuple[str, float]) -> float:
    return neighbor[1]


def _lanes_ahead(sumo: Any, vehicle_id: str) -> Iterator[str]:
    """Yield the lane of a vehicle and the next lanes of its route, including lanes within junctions."""
    lane = sumo.vehicle.getLaneID(vehicle_id)
    if not lane:  # the vehicle is teleported
        return
    yield lane
    if lane.startswith(INTERNAL_EDGE_PREFIX):
        yield from _lanes_to_exit(sumo, lane)
    for link in sumo.vehicle.getNextLinks(vehicle_id):
        target, internal_lane = link[0], link[4]
        if not internal_lane:
            yield target
            continue
        yield internal_lane
        yield from _lanes_to_exit(sumo, internal_lane)


def _lanes_to_exit(sumo: Any, lane: str) -> Iterator[str]:
    """Yield the lanes that follow a lane within a junction, up to the first lane outside."""
    while lane.startswith(INTERNAL_EDGE_PREFIX):
        link = sumo.lane.getLinks(lane)[0]
        lane = link[4] or link[0]
        yield lane


def _vehicles_of_edge(sumo: Any, lane: str) -> Iterator[tuple[str, float]]:
    """Yield the vehicles on all lanes of the edge of `lane`, and their lateral positions relative to its center [m]."""
    edge = sumo.lane.getEdgeID(lane)
    lanes = [f"{edge}_{index}" for index in range(sumo.edge.getLaneNumber(edge))]
    edge_width, centers = 0.0, dict[str, float]()
    for edge_lane in lanes:
        width = sumo.lane.getWidth(edge_lane)
        centers[edge_lane] = edge_width + width / 2.0
        edge_width += width
    for edge_lane in lanes:
        for vehicle_id in sumo.lane.getLastStepVehicleIDs(edge_lane):
            offset = sumo.vehicle.getLateralLanePosition(vehicle_id)
            yield vehicle_id, centers[edge_lane] - centers[lane] + offset
