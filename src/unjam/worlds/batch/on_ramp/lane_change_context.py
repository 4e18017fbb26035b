"""Whom vehicles look at before they change lanes on a motorway that a ramp joins.

On each lane there is but one way to go: from the ramp's lane and the right one to the left, from the left one
to the right. Source: SUMO's MSLaneChanger (`getRealLeader`, `getRealFollower`, `checkChange`).
"""

from typing import NamedTuple

from unjam.physics.arrays import Array, clamp_min, namespace
from unjam.worlds.batch.on_ramp.vehicles import (
    NO_VEHICLE,
    MotorwayDrivers,
    MotorwayVehicles,
    find_neighbors,
    neighbors_on_lane,
)

NO_NEIGHBOR_GAP = 1e6
"""gap to nobody [m]"""


class MotorwayGeometry(NamedTuple):
    """A motorway with a ramp: lengths along the road [m]."""

    merge_start: float
    """where the ramp's lane begins to run beside it"""
    merge_end: float
    """where that lane ends"""
    length: float
    speed_limit: float
    """what it allows [m/s]"""
    ramp_speed_limit: float
    """what the ramp allows [m/s]"""
    lane_count: int
    """of the motorway"""
    vehicle_length: float


class Neighbor(NamedTuple):
    """A vehicle beside or ahead of each."""

    row: Array
    is_present: Array
    """whether there is one that is near enough to count"""
    speed: Array
    gap: Array
    """beyond the smallest one of who is behind [m]"""


class LaneChangeContext(NamedTuple):
    """What each vehicle looks at before it changes to the one lane it can change to."""

    drivers: MotorwayDrivers
    target_lane: Array
    """its way; `NOBODY` where it can go nowhere"""
    leader: Neighbor
    target_leader: Neighbor
    """on the target lane"""
    target_follower: Neighbor
    follower_drivers: MotorwayDrivers
    """how those drive"""
    is_leader_blocking: Array
    """whether the one ahead on the target lane is in its way"""
    is_follower_blocking: Array
    step: float


def lane_change_context(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> LaneChangeContext:
    """Return what each vehicle looks at, in a simulation of a `step` [s]."""
    xp, way, place, speed = namespace(vehicles.speed), vehicles.lane, vehicles.position, vehicles.speed
    merging = (place >= geometry.merge_start) & (place < geometry.merge_end)
    target = xp.where((way == 0) & merging, 1, NO_VEHICLE)
    if geometry.lane_count > 1:
        target = xp.where(way == 1, 2, xp.where(way == 2, 1, target))
    near = find_neighbors(vehicles, geometry.lane_count + 1)
    drivers, length = vehicles.drivers, geometry.vehicle_length
    section = 1.0 * (place >= geometry.merge_start) + 1.0 * (place >= geometry.merge_end)
    ends = xp.where(
        place < geometry.merge_start, geometry.merge_start, xp.where(merging, geometry.merge_end, geometry.length)
    )
    sees = drivers.brake_gap(speed, step) + vehicles.minimum_gap >= ends - place

    def neighbor_ahead(row: Array) -> Neighbor:
        there = (row >= 0) & (sees | (section[row] == section) | (place[row] - length < ends))
        gap = xp.where(there, place[row] - length - place - vehicles.minimum_gap, NO_NEIGHBOR_GAP)
        return Neighbor(row, there, speed[row], gap)

    leader, ahead = (
        neighbor_ahead(neighbors_on_lane(near.leaders, way)),
        neighbor_ahead(neighbors_on_lane(near.leaders, target)),
    )
    row = neighbors_on_lane(near.followers, target)
    gap = xp.where(row >= 0, place - length - place[row] - vehicles.minimum_gap[row], NO_NEIGHBOR_GAP)
    behind, followers = Neighbor(row, row >= 0, speed[row], gap), drivers.select(row)
    by_leader = ahead.is_present & (ahead.gap < clamp_min(drivers.secure_gap(speed, ahead.speed), 0.0))
    by_follower = behind.is_present & (behind.gap < clamp_min(followers.secure_gap(behind.speed, speed), 0.0))
    return LaneChangeContext(drivers, target, leader, ahead, behind, followers, by_leader, by_follower, step)
