"""What vehicles look at before they change lanes on a motorway with a ramp.

From each lane, only one change is possible: left from the ramp's lane and the right lane, right from the left lane.
Source: SUMO's MSLaneChanger (`getRealLeader`, `getRealFollower`, `checkChange`).
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
"""gap without a neighbor [m]"""


class MotorwayGeometry(NamedTuple):
    """A motorway with a ramp: positions and lengths along the road [m], speeds [m/s]."""

    merge_start: float
    """where the ramp's lane starts to run next to the road"""
    merge_end: float
    """where that lane ends"""
    length: float
    speed_limit: float
    ramp_speed_limit: float
    lane_count: int
    """of the motorway"""
    vehicle_length: float


class Neighbor(NamedTuple):
    """A neighbor of each vehicle."""

    row: Array
    is_present: Array
    """whether there is one within the visible distance"""
    speed: Array
    gap: Array
    """beyond the minimum gap of the vehicle behind [m]"""


class LaneChangeContext(NamedTuple):
    """What each vehicle looks at before it changes to its target lane."""

    drivers: MotorwayDrivers
    target_lane: Array
    """`NO_VEHICLE`: none"""
    leader: Neighbor
    target_leader: Neighbor
    """on the target lane"""
    target_follower: Neighbor
    follower_drivers: MotorwayDrivers
    """of the target followers"""
    is_leader_blocking: Array
    """whether the target leader prevents a change"""
    is_follower_blocking: Array
    step: float


def lane_change_context(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> LaneChangeContext:
    """Return what each vehicle looks at, in a simulation with a `step` [s]."""
    xp, lane, position, speed = namespace(vehicles.speed), vehicles.lane, vehicles.position, vehicles.speed
    is_past_start, is_past_end = position >= geometry.merge_start, position >= geometry.merge_end
    is_merging = is_past_start & ~is_past_end
    target_lane = xp.where((lane == 0) & is_merging, 1, NO_VEHICLE)
    if geometry.lane_count > 1:
        target_lane = xp.where(lane == 1, 2, xp.where(lane == 2, 1, target_lane))
    neighbors = find_neighbors(vehicles, geometry.lane_count + 1)
    drivers, length = vehicles.drivers, geometry.vehicle_length
    section = 1.0 * is_past_start + 1.0 * is_past_end
    section_end = xp.where(is_merging, geometry.merge_end, geometry.length)
    section_end = xp.where(is_past_start, section_end, geometry.merge_start)
    sees_past_end = drivers.brake_gap(speed, step) + vehicles.minimum_gap >= section_end - position

    def neighbor_ahead(row: Array) -> Neighbor:
        is_visible = sees_past_end | (section[row] == section) | (position[row] - length < section_end)
        is_present = (row >= 0) & is_visible
        gap = xp.where(is_present, position[row] - length - position - vehicles.minimum_gap, NO_NEIGHBOR_GAP)
        return Neighbor(row, is_present, speed[row], gap)

    leader, ahead = (neighbor_ahead(neighbors_on_lane(neighbors.leaders, each)) for each in (lane, target_lane))
    row = neighbors_on_lane(neighbors.followers, target_lane)
    gap = xp.where(row >= 0, position - length - position[row] - vehicles.minimum_gap[row], NO_NEIGHBOR_GAP)
    behind, followers = Neighbor(row, row >= 0, speed[row], gap), drivers.select(row)
    by_leader = ahead.is_present & (ahead.gap < clamp_min(drivers.secure_gap(speed, ahead.speed), 0.0))
    by_follower = behind.is_present & (behind.gap < clamp_min(followers.secure_gap(behind.speed, speed), 0.0))
    return LaneChangeContext(drivers, target_lane, leader, ahead, behind, followers, by_leader, by_follower, step)
