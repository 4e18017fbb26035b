"""The nearest vehicles ahead of and behind n vehicles on each lane of a motorway; arrays have shape (n,)."""

from typing import NamedTuple

import numpy as np

from unjam.drivers.local_state import observe_neighbor
from unjam.physics.arrays import Array, clamp_max, clamp_min
from unjam.scenarios.motorway_road import MotorwayGeometry

NO_VEHICLE = -1
"""row of a vehicle, or index of a lane, that does not exist"""


class LaneNeighbors(NamedTuple):
    """Rows of the nearest vehicles ahead and behind on each lane, shape (lanes, n); `NO_VEHICLE` if there is none."""

    leaders: Array
    followers: Array


def find_neighbors(road: Array, lane: Array, lane_count: int) -> LaneNeighbors:
    """Return the neighbors of vehicles, which are sorted by road and from front to back."""
    count = len(road)
    neighbors = np.empty((2, lane_count, count), np.intp)
    for lane_index, (leaders, followers) in enumerate(neighbors.swapaxes(0, 1)):
        rows = np.flatnonzero(lane == lane_index)
        distances = np.diff(np.concatenate([[-1], rows, [count]]))
        leaders[:] = np.concatenate([[NO_VEHICLE], rows]).repeat(distances)[:-1]
        followers[:] = np.concatenate([rows, [NO_VEHICLE]]).repeat(distances)[1:]
    vehicle_counts = np.bincount(road)
    ends = vehicle_counts.cumsum()  # rows behind the last vehicle of each road
    end, start = ends.repeat(vehicle_counts), (ends - vehicle_counts).repeat(vehicle_counts)
    leaders, followers = neighbors
    is_leader, is_follower = leaders >= start, followers < end
    return LaneNeighbors(np.where(is_leader, leaders, NO_VEHICLE), np.where(is_follower, followers, NO_VEHICLE))


def find_road_neighbors(road: Array, lane: Array, position: Array, geometry: MotorwayGeometry) -> LaneNeighbors:
    """Return the neighbors of sorted vehicles; vehicles on lane 0 of different ramps are not neighbors."""
    neighbors = find_neighbors(road, lane, geometry.lane_count + 1)
    if len(geometry.ramps) > 1:
        ramp = geometry.sections(lane, position).ramp
        for rows in neighbors:
            rows[0, (lane == 0) & (ramp[rows[0]] != ramp)] = NO_VEHICLE
    return neighbors


def find_unsorted_neighbors(lane: Array, position: Array, geometry: MotorwayGeometry) -> LaneNeighbors:
    """Return the neighbors of the vehicles of one road as `find_road_neighbors`; the vehicles have any order."""
    order = np.argsort(-position, kind="stable")
    neighbors = np.array(find_road_neighbors(0 * order, lane[order], position[order], geometry))
    neighbors[..., order] = np.where(neighbors >= 0, order[neighbors], NO_VEHICLE)
    return LaneNeighbors(*neighbors)


def neighbors_on_lane(neighbors: Array, lane: Array) -> Array:
    """Return the neighbor of each vehicle on its `lane`; `NO_VEHICLE` for lanes that do not exist."""
    lane_count, count = neighbors.shape
    lane_neighbor = neighbors.take(clamp_max(clamp_min(lane, 0), lane_count - 1) * count + np.arange(count))
    return np.where((lane >= 0) & (lane < lane_count), lane_neighbor, NO_VEHICLE)


def observe_lane(
    neighbors: LaneNeighbors, rows: Array, lane: Array, position: Array, speed: Array, length: Array
) -> list[tuple[Array, Array]]:
    """Return speeds and gaps of the leaders, and those of the followers, of the vehicles `rows` on a `lane` of each."""
    pairs = list[tuple[Array, Array]]()
    for neighbor_rows, sign in zip(neighbors, (1.0, -1.0), strict=True):
        row = neighbors_on_lane(neighbor_rows[:, rows], lane)
        gap = sign * (position[row] - position[rows]) - length[row if sign > 0.0 else rows]
        pairs.append(observe_neighbor(row >= 0, gap, speed[row], speed[rows]))
    return pairs
