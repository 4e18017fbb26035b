"""The nearest vehicles ahead and behind on each lane of a motorway, for all worlds; arrays have shape (n,)."""

from typing import NamedTuple

import numpy as np

from unjam.drivers.local_state import observe_neighbor
from unjam.physics.arrays import Array, clamp_max, clamp_min
from unjam.scenarios.motorway_road import MotorwayGeometry

NO_VEHICLE = -1
"""row or lane of a vehicle or lane that does not exist"""


class LaneNeighbors(NamedTuple):
    """Rows of the nearest vehicles ahead and behind on each lane, shape (lanes, n); `NO_VEHICLE`: none."""

    leaders: Array
    followers: Array


def find_neighbors(road: Array, lane: Array, lane_count: int) -> LaneNeighbors:
    """Return the neighbors of vehicles that are sorted by road, and from front to back."""
    count = len(road)
    neighbors = np.empty((2, lane_count, count), np.intp)
    for number, (leaders, followers) in enumerate(neighbors.swapaxes(0, 1)):
        rows = np.flatnonzero(lane == number)
        distances = np.diff(np.concatenate([[-1], rows, [count]]))
        leaders[:] = np.concatenate([[NO_VEHICLE], rows]).repeat(distances)[:-1]
        followers[:] = np.concatenate([rows, [NO_VEHICLE]]).repeat(distances)[1:]
    vehicles_of_roads = np.bincount(road)
    ends = vehicles_of_roads.cumsum()  # rows behind the last vehicle of each road
    end, start = ends.repeat(vehicles_of_roads), (ends - vehicles_of_roads).repeat(vehicles_of_roads)
    leaders, followers = neighbors
    is_leader, is_follower = leaders >= start, followers < end
    return LaneNeighbors(np.where(is_leader, leaders, NO_VEHICLE), np.where(is_follower, followers, NO_VEHICLE))


def find_road_neighbors(road: Array, lane: Array, position: Array, geometry: MotorwayGeometry) -> LaneNeighbors:
    """Return the neighbors of sorted vehicles on all lanes; on lane 0, vehicles of different ramps are none."""
    neighbors = find_neighbors(road, lane, geometry.lane_count + 1)
    if len(geometry.ramps) > 1:
        ramp = geometry.sections(lane, position).ramp
        for rows in neighbors:
            rows[0, (lane == 0) & (ramp[rows[0]] != ramp)] = NO_VEHICLE
    return neighbors


def find_unsorted_neighbors(lane: Array, position: Array, geometry: MotorwayGeometry) -> LaneNeighbors:
    """Return the neighbors of the vehicles of one road, in any order, as `find_road_neighbors`."""
    order = np.argsort(-position, kind="stable")
    neighbors = np.array(find_road_neighbors(0 * order, lane[order], position[order], geometry))
    neighbors[..., order] = np.where(neighbors >= 0, order[neighbors], NO_VEHICLE)
    return LaneNeighbors(*neighbors)


def neighbors_on_lane(neighbors: Array, lane: Array) -> Array:
    """Return each vehicle's neighbor on a lane given for each; `NO_VEHICLE` for lanes that do not exist."""
    lane_count, count = neighbors.shape
    lane_neighbor = neighbors.take(clamp_max(clamp_min(lane, 0), lane_count - 1) * count + np.arange(count))
    return np.where((lane >= 0) & (lane < lane_count), lane_neighbor, NO_VEHICLE)


def observe_lane(
    neighbors: LaneNeighbors, rows: Array, lane: Array, position: Array, speed: Array, length: Array
) -> list[tuple[Array, Array]]:
    """Return speeds and gaps of the neighbors of some rows ahead and behind, on a `lane` given for each row."""
    pairs = list[tuple[Array, Array]]()
    for side, sign in zip(neighbors, (1.0, -1.0), strict=True):
        row = neighbors_on_lane(side[:, rows], lane)
        gap = sign * (position[row] - position[rows]) - length[row if sign > 0.0 else rows]
        pairs.append(observe_neighbor(row >= 0, gap, speed[row], speed[rows]))
    return pairs
