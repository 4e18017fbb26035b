"""SUMO's lane changes of human drivers on a motorway, for all vehicles at once.

SUMO decides for one vehicle after the other. Here, vehicles on the ramp's lane, which must change, are first, followed
by all vehicles that gain by a change; results agree in distribution. Each lane has one target lane: the next lane to
the left, or the right lane for the left lane. Vehicles that must change request room from others.
Sources: SUMO's MSLaneChanger (`getRealLeader`, `getRealFollower`, `checkChange`) and MSLCM_LC2013 (`_wantsChange`,
`anticipateFollowSpeed`, `informLeader`, `informFollower`, `slowDownForBlocked`).
"""

from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, clamp_min
from unjam.scenarios.motorway_road import MotorwayGeometry, MotorwaySections
from unjam.worlds.batch.motorway.vehicles import ADVICE_FIELDS, NO_ADVICE, MotorwayDrivers, MotorwayVehicles, as_rows
from unjam.worlds.lane_neighbors import NO_VEHICLE, find_neighbors, find_road_neighbors, neighbors_on_lane

NO_NEIGHBOR_GAP = 1e6
MERGE_LOOK_AHEAD_TIME, LEFT_LOOK_AHEAD_FACTOR = 10.0, 2.0
"""look-ahead time of a mandatory change [s], and its factor for changes to the left"""
URGENCY_FACTOR = 2.0
"""factor by which the remaining time is shorter than at the look-ahead speed"""
HELP_SPEED_DIFFERENCE, MIN_FALL_BEHIND_BRAKING = 10.0 / 3.6, 7.0 / 3.6
"""speed difference of vehicles that overtake to help [m/s], and minimum braking to fall behind a leader [m/s2]"""
UNCONGESTED_SPEED = 60.0 / 3.6
"""speed above which vehicles do not pass on the right [m/s]"""
SUMO_POSITION_TOLERANCE = 0.1
"""SUMO's POSITION_EPS [m]"""
LOOK_AHEAD_RETENTION = 0.9
"""share of the look-ahead speed that remains after a second"""
LEFT_GAIN_THRESHOLD, RIGHT_GAIN_THRESHOLD = 0.2, 2.0
"""accumulated gains above which vehicles change lanes"""
MIN_REFERENCE_SPEED = 10.0
"""minimum speed to which gains are relative [m/s]"""
RIGHT_SPEED_TOLERANCE = 5.0 / 3.6
"""speed difference up to which the right lane counts as equally fast [m/s]"""
KEEP_RIGHT_ACCEPTANCE_TIME, KEEP_RIGHT_TIME = 7.0, 5.0
"""times that scale the obligation to keep right, as in SUMO's LC2013 [s]"""
MIN_REMAINING_TIME = 20.0
"""minimum remaining driving time on the target lane of an optional change [s]"""
OVERTAKING_LOOK_AHEAD = 8.0
"""time before a vehicle must brake at which it starts to overtake [s]"""


class Neighbor(NamedTuple):
    """The leader or the follower of each vehicle on one lane."""

    row: Array
    is_present: Array
    """whether a neighbor is within the visible distance"""
    speed: Array
    gap: Array
    """gap beyond the minimum gap of the vehicle behind [m]"""


class LaneChangeContext(NamedTuple):
    """The information of each vehicle for a change to its target lane."""

    drivers: MotorwayDrivers
    target_lane: Array
    """index of the target lane; `NO_VEHICLE` without one"""
    leader: Neighbor
    target_leader: Neighbor
    target_follower: Neighbor
    follower_drivers: MotorwayDrivers
    is_leader_blocking: Array
    is_follower_blocking: Array
    sections: MotorwaySections
    step: float


def lane_change_context(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> LaneChangeContext:
    """Return the information of each vehicle for a lane change in a simulation step of `step` [s]."""
    lane, position, speed = vehicles.lane, vehicles.position, vehicles.speed
    sections = geometry.sections(lane, position)
    is_merging = sections.is_merging
    target_lane = np.where((lane == 0) & is_merging, 1, NO_VEHICLE)
    if geometry.lane_count > 1:
        target_lane = np.where(lane == 1, 2, np.where(lane == 2, 1, target_lane))
    neighbors = find_road_neighbors(vehicles.road, lane, position, geometry)
    drivers, length = vehicles.drivers, geometry.vehicle_length
    section_end = np.where(is_merging, sections.merge_end, geometry.length)
    section_end = np.where(sections.is_before, sections.merge_start, section_end)
    sees_past_end = drivers.brake_gap(speed, step) + vehicles.minimum_gap >= section_end - position

    def neighbor_ahead(row: Array) -> Neighbor:
        is_visible = sees_past_end | (sections.start[row] == sections.start) | (position[row] - length < section_end)
        is_present = (row >= 0) & is_visible
        gap = np.where(is_present, position[row] - length - position - vehicles.minimum_gap, NO_NEIGHBOR_GAP)
        return Neighbor(row, is_present, speed[row], gap)

    leader, ahead = (
        neighbor_ahead(neighbors_on_lane(neighbors.leaders, checked_lane)) for checked_lane in (lane, target_lane)
    )
    row = neighbors_on_lane(neighbors.followers, target_lane)
    gap = np.where(row >= 0, position - length - position[row] - vehicles.minimum_gap[row], NO_NEIGHBOR_GAP)
    behind, followers = Neighbor(row, row >= 0, speed[row], gap), drivers.select(row)
    is_leader_blocking = ahead.is_present & (ahead.gap < clamp_min(drivers.secure_gap(speed, ahead.speed), 0.0))
    min_gap_behind = clamp_min(followers.secure_gap(behind.speed, speed), 0.0)
    is_blocking = is_leader_blocking, behind.is_present & (behind.gap < min_gap_behind)
    return LaneChangeContext(drivers, target_lane, leader, ahead, behind, followers, *is_blocking, sections, step)


def change_lanes(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> MotorwayVehicles:
    """Return the vehicles after their lane changes, with advice for the next step."""
    speed, last_speed = vehicles.speed, vehicles.look_ahead_speed
    retention = 1.0 - (1.0 - LOOK_AHEAD_RETENTION) * step
    look_ahead_speed = np.where(speed > last_speed, speed, retention * last_speed + (1.0 - retention) * speed)
    advice = dict.fromkeys(ADVICE_FIELDS, speed * 0.0 + NO_ADVICE)
    vehicles = vehicles._replace(**advice, speed_bias=speed * 0.0, look_ahead_speed=look_ahead_speed)
    context = lane_change_context(vehicles, geometry, step)
    vehicles, is_urgent, is_asked = mandatory_lane_changes(vehicles, context, geometry)
    has_target = context.target_lane != NO_VEHICLE
    is_clear = ~(context.is_leader_blocking | context.is_follower_blocking) & has_target
    vehicles, wants_change = _speed_gain_changes(vehicles, context, geometry, ~is_urgent & has_target)
    helps = is_asked & (vehicles.lane > 0) & (context.target_lane > vehicles.lane)
    changes = (is_urgent | wants_change | helps) & is_clear
    helping_bias = np.where(context.is_leader_blocking, -1.0, 0.0 * speed + 1.0)
    bias = np.where(helps & ~is_clear, helping_bias, vehicles.speed_bias)
    vehicles = vehicles._replace(speed_bias=bias)
    changes = changes & ~_has_change_conflict(vehicles, changes, geometry)
    initial_values = dict.fromkeys(("speed_gain", "keep_right", "look_ahead_speed", "speed_bias"), 0.0)
    initial_values |= dict.fromkeys(ADVICE_FIELDS, NO_ADVICE)
    return vehicles.replace_rows(changes, lane=context.target_lane[changes], **initial_values)


def mandatory_lane_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry
) -> tuple[MotorwayVehicles, Array, Array]:
    """Return the vehicles with advice, whether each must change now, and whether others request room from it."""
    position, step = vehicles.position, context.step
    is_on_lane = (vehicles.lane == 0) & (context.target_lane != NO_VEHICLE)
    # The length of the right lane that vehicles ahead of each vehicle occupy.
    occupies = (vehicles.lane == 1) & (position >= geometry.origin)
    lengths = np.where(occupies, vehicles.minimum_gap + geometry.vehicle_length, 0.0 * position)
    total = lengths.cumsum(0)
    counts = np.bincount(vehicles.road)
    first = (counts.cumsum() - counts)[vehicles.road]
    occupied = total - np.where(first > 0, total[first - 1], 0.0 * position)
    needed = vehicles.look_ahead_speed * (MERGE_LOOK_AHEAD_TIME * LEFT_LOOK_AHEAD_FACTOR)
    needed = needed + 2.0 * (vehicles.minimum_gap + geometry.vehicle_length)
    is_urgent = is_on_lane & (context.sections.merge_end - position - occupied < needed)
    is_asked = vehicles.speed < 0.0
    rows = np.arange(len(position))[is_urgent]
    if len(rows) == 0:
        return vehicles, is_urgent, is_asked
    own_advice, cooperative = vehicles.lane_change_advice.copy(), vehicles.cooperative_advice.copy()
    bias = vehicles.speed_bias.copy()
    merging = _MergingVehicles(vehicles, context, geometry, rows)
    leader, follower = merging.leader, merging.follower
    planned, leader_advice, overtakes = merging.plan_with_leader()
    is_blocked = merging.is_leader_blocking & leader.is_present
    bias[leader.row[is_blocked]] = 1.0
    overtakes_leader = is_blocked & overtakes
    np.minimum.at(cooperative, leader.row[overtakes_leader], 0.0 * merging.speed[overtakes_leader])
    is_request, speeds, follower_advice, asks_for_change = merging.request_from_follower(planned, ~overtakes_leader)
    own_advice[rows] = np.minimum(leader_advice, follower_advice)
    np.minimum.at(cooperative, follower.row[is_request], (speeds - follower.speed)[is_request] / step)
    is_asked[follower.row[asks_for_change]] = True
    stuck_rows = rows[np.logical_or(merging.is_leader_blocking, merging.is_follower_blocking)]
    bias[stuck_rows] = 1.0
    vehicles = vehicles._replace(lane_change_advice=own_advice, cooperative_advice=cooperative, speed_bias=bias)
    return _yield_to_stuck(vehicles, context, geometry, stuck_rows), is_urgent, is_asked


class _MergingVehicles:
    """Vehicles that must leave the ramp's lane, and their requests."""

    def __init__(
        self, vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, rows: Array
    ) -> None:
        self.speed, self._step = vehicles.speed[rows], context.step
        self._remaining_distance = context.sections.merge_end[rows] - vehicles.position[rows]
        self._vehicle_length, self._minimum_gap = geometry.vehicle_length, vehicles.minimum_gap[rows]
        self.leader = Neighbor(*(values[rows] for values in context.target_leader))
        self.follower = Neighbor(*(values[rows] for values in context.target_follower))
        self.is_leader_blocking = context.is_leader_blocking[rows]
        self.is_follower_blocking = context.is_follower_blocking[rows]
        self._drivers, self._follower_drivers = context.drivers.select(rows), context.follower_drivers.select(rows)
        self._leader_drivers = context.drivers.select(self.leader.row)
        self._leader_acceleration = vehicles.acceleration[self.leader.row]
        self._braking = vehicles.braking[rows]
        look_ahead_speed = clamp_min(vehicles.look_ahead_speed[rows], 1e-3)
        self._remaining_time = clamp_min(self._remaining_distance / look_ahead_speed / URGENCY_FACTOR, context.step)

    def plan_with_leader(self) -> tuple[Array, Array, Array]:
        """Return planned speeds, own advice [m/s2], and whether each vehicle overtakes its leader."""
        speed, step, leader = self.speed, self._step, self.leader
        planned = np.minimum(speed, self._drivers.stop_speed(speed, self._remaining_distance, step))
        leader_speed = leader.speed - step * clamp_min(-self._leader_acceleration, 1.0)
        gap = leader.gap + step * (leader_speed - planned)
        follow = self._drivers.follow_speed(speed, gap + self._minimum_gap, leader_speed, step)
        follow = np.maximum(clamp_min(speed - self._braking * step, 0.0), follow)
        distance = leader.gap + 2.0 * self._vehicle_length + self._leader_drivers.parameters.minimum_gap
        distance = clamp_min(distance + self._leader_drivers.secure_gap(leader.speed, speed), 0.0)
        surplus = planned - leader.speed
        duration = np.where(surplus > 0.0, distance / clamp_min(surplus, 1e-6), self._remaining_time + 1.0)
        has_room = self._remaining_distance - self._drivers.brake_gap(speed, step) >= distance
        overtakes = (surplus >= 0.0) & (speed < UNCONGESTED_SPEED) & has_room & (duration <= self._remaining_time)
        braking = clamp_min((speed - follow) / self._remaining_time, MIN_FALL_BEHIND_BRAKING)
        behind = np.minimum(planned, clamp_min(speed - step * np.minimum(self._braking, braking), 0.0))
        is_blocked = self.is_leader_blocking & leader.is_present
        falls_behind = is_blocked & ~overtakes & (follow < speed)
        advice = (np.where(falls_behind, behind, follow) - speed) / step
        advice = np.where(leader.is_present & ~(is_blocked & overtakes), advice, NO_ADVICE)
        is_free = leader.is_present & ~self.is_leader_blocking
        planned = np.where(is_free, np.minimum(follow, planned), planned)
        return np.where(falls_behind, behind, planned), advice, overtakes

    def request_from_follower(self, planned_speed: Array, may_request: Array) -> tuple[Array, Array, Array, Array]:
        """Return whether each follower gets a requested speed, the speed, own advice, and a request to change lanes."""
        speed, step, follower = self.speed, self._step, self.follower
        may_ask, drivers, time = may_request & follower.is_present, self._follower_drivers, self._remaining_time
        braking, minimum_gap = drivers.parameters.comfortable_deceleration, drivers.parameters.minimum_gap
        slower, after_second = clamp_min(follower.speed - step * braking, 0.0), clamp_min(follower.speed - braking, 0.0)
        surplus, room = planned_speed - after_second, follower.gap + planned_speed - after_second
        needed = drivers.secure_gap(after_second, clamp_min(planned_speed, 0.0))

        def follower_speed(slack: Array) -> Array:
            gap = follower.gap + minimum_gap + step * slack
            return drivers.follow_speed(follower.speed, gap, planned_speed, step)

        behind = follower_speed(planned_speed - np.maximum(slower, follower_speed(planned_speed)))
        difference = planned_speed - follower.speed
        missing = drivers.secure_gap(follower.speed, planned_speed) - follower.gap
        opens_alone = (difference >= HELP_SPEED_DIFFERENCE) & (missing < difference * time)
        can_brake = (room > 0.0) & (room >= needed)
        is_in_time = (surplus > 0.0) & (surplus * time > needed - room + SUMO_POSITION_TOLERANCE)
        is_faster = follower.speed > speed
        passing = speed + HELP_SPEED_DIFFERENCE
        passing = np.where(is_faster, np.maximum(slower, passing), np.maximum(follower.speed, passing))
        requested = np.where(can_brake, np.maximum(slower, behind), np.where(is_in_time, slower, passing))
        requested = np.where(opens_alone, planned_speed - HELP_SPEED_DIFFERENCE, requested)
        is_passed = ~opens_alone & ~can_brake & ~is_in_time
        is_passed = is_passed & ~(is_faster & ((follower.speed - speed) / braking < time))
        distance = follower.gap + 2.0 * self._vehicle_length + self._minimum_gap
        distance = clamp_min(distance + self._drivers.secure_gap(planned_speed, passing), 0.0)
        own_speed = np.maximum(passing - distance / time, speed - step * self._braking)
        is_blocked = may_ask & self.is_follower_blocking
        own_advice = np.where(is_blocked & is_passed, (own_speed - speed) / step, NO_ADVICE)
        keeps_gap = may_ask & ~self.is_follower_blocking & self.is_leader_blocking
        keeping = follower_speed(planned_speed - follower_speed(planned_speed))
        return is_blocked | keeps_gap, np.where(is_blocked, requested, keeping), own_advice, is_blocked


def _yield_to_stuck(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, stuck_rows: Array
) -> MotorwayVehicles:
    """Return the vehicles; those that crawl next to the ramp's lane get advice to let one stuck vehicle merge."""
    if len(stuck_rows) == 0:
        return vehicles
    position, speed = vehicles.position, vehicles.speed
    sections = context.sections
    crawls = (vehicles.lane == 1) & sections.is_merging & (speed < vehicles.braking)
    if not bool(crawls.any()):
        return vehicles
    is_stuck = np.zeros(len(position), np.intp)
    is_stuck[stuck_rows] = 1
    index = is_stuck.cumsum() - is_stuck - 1  # index of the next stuck vehicle ahead
    stuck = stuck_rows[clamp_min(index, 0)]
    gap = position[stuck] - geometry.vehicle_length - position - vehicles.minimum_gap
    yields = crawls & (index >= 0) & (vehicles.road[stuck] == vehicles.road) & (gap > SUMO_POSITION_TOLERANCE)
    yields = yields & (sections.ramp[stuck] == sections.ramp)
    if not bool(yields.any()):
        return vehicles
    gap = (gap + vehicles.minimum_gap)[yields] - SUMO_POSITION_TOLERANCE
    own_speed = context.drivers.select(yields).follow_speed(speed[yields], gap, speed[stuck][yields], context.step)
    return vehicles.replace_rows(yields, adjacent_advice=(own_speed - speed[yields]) / context.step)


def _speed_gain_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, may_change: Array
) -> tuple[MotorwayVehicles, Array]:
    """Return the vehicles with their gains, and whether each wants to change to gain speed or to keep right."""
    speed, step = vehicles.speed, context.step
    ahead, leader, drivers, speed_limit = context.target_leader, context.leader, context.drivers, geometry.speed_limit
    is_left = context.target_lane > vehicles.lane

    def allowed_speed(limit: Array, rows: Array) -> Array:
        return np.minimum(limit * vehicles.speed_factor[rows], vehicles.speed_cap[rows])

    all_rows, sections = slice(None), context.sections
    target_speed = allowed_speed(speed_limit, all_rows)
    own_speed = allowed_speed(geometry.speed_limits(vehicles.lane, sections), all_rows)
    remaining = geometry.length - sections.start
    own_remaining = np.where(vehicles.lane == 0, sections.merge_end - sections.merge_start, remaining)
    gain, keep, is_fast = vehicles.speed_gain, vehicles.keep_right, speed >= UNCONGESTED_SPEED
    # Vehicles do not pass on the right: behind a slower vehicle on the left lane, they slow down or change to the left.
    difference = np.maximum(own_speed - allowed_speed(speed_limit, ahead.row), speed - ahead.speed)
    is_held_back = as_rows(may_change & is_left & ahead.is_present & is_fast & (difference > 0.0))
    max_speed, must_brake_soon, advice = own_speed, speed < 0.0, vehicles.adjacent_advice
    if len(is_held_back):
        safe, brakes_soon = _speed_behind_left_leader(vehicles, context, is_held_back, difference[is_held_back])
        advice, max_speed = advice.copy(), own_speed.copy()
        advice[is_held_back] = np.minimum(advice[is_held_back], (safe - speed[is_held_back]) / step)
        must_brake_soon[is_held_back] = brakes_soon
        max_speed[is_held_back] = np.minimum(own_speed[is_held_back], safe)
        relative = step * difference / clamp_min(own_speed, MIN_REFERENCE_SPEED)
        gain = gain + np.where(must_brake_soon, relative, 0.0 * gain)
    # Anticipated speeds on both lanes.
    accelerates = ahead.is_present & (vehicles.acceleration[ahead.row] > 0.0)
    accelerates = accelerates | (leader.is_present & (vehicles.acceleration[leader.row] > 0.0))
    faster, faster_drivers = as_rows(accelerates), drivers.select(accelerates)

    def anticipated_speed(neighbor: Neighbor, end_distance: Array) -> Array:
        gap = np.where(neighbor.is_present, neighbor.gap, end_distance)
        leader_speed = np.where(neighbor.is_present, neighbor.speed, 0.0 * speed)
        anticipated = drivers.safe_speed(gap, leader_speed, vehicles.braking[neighbor.row], step)
        later = (speed + vehicles.max_acceleration * (1.0 - step))[faster]
        gap = (gap + vehicles.minimum_gap)[faster]
        anticipated[faster] = faster_drivers.follow_speed(later, gap, leader_speed[faster], step)
        return anticipated

    target_lane_speed = np.minimum(target_speed, anticipated_speed(ahead, remaining))
    # Without acceleration, passing on the right is not restricted.
    own_lane_speed = np.minimum(np.where(accelerates, max_speed, own_speed), anticipated_speed(leader, own_remaining))
    relative = (target_lane_speed - own_lane_speed) / clamp_min(target_lane_speed, MIN_REFERENCE_SPEED)
    continues = remaining / clamp_min(speed, 0.1) > MIN_REMAINING_TIME
    # Changes to the right.
    right = may_change & (context.target_lane < vehicles.lane)
    is_slower = own_lane_speed - RIGHT_SPEED_TOLERANCE > target_lane_speed
    decay = np.where(right & is_slower & (gain < 0.0), 0.5**step, 0.0 * gain + 1.0)
    is_suitable = right & ~is_slower
    is_counted = is_suitable & ((gain < 0.0) | (relative > 0.0))
    gain = gain * decay - np.where(is_counted, step * relative, 0.0 * gain)
    accepted = KEEP_RIGHT_ACCEPTANCE_TIME * (own_speed / speed_limit) * clamp_min(speed, 1.0)
    distance = clamp_min(remaining - drivers.brake_gap(own_speed, step), 0.0)
    seconds = np.minimum(accepted, distance / own_speed)
    closes_in = ahead.is_present & (ahead.speed < own_speed)
    secure = clamp_min(np.minimum(distance, ahead.gap - drivers.secure_gap(own_speed, ahead.speed)), 0.0)
    closing_seconds = np.minimum(seconds, secure / clamp_min(own_speed - ahead.speed, 1e-6))
    seconds, distance = np.where(closes_in, closing_seconds, seconds), np.where(closes_in, secure, distance)
    is_behind = is_suitable & is_fast & leader.is_present & (allowed_speed(speed_limit, leader.row) < own_speed)
    surplus = own_speed - leader.speed
    surplus = np.where(surplus * surplus < 1e-12, 1e-6, surplus)
    seconds = np.where(is_behind, np.minimum(seconds, np.minimum(distance, leader.gap) / surplus), seconds)
    obligation = step * RIGHT_GAIN_THRESHOLD * seconds / accepted / KEEP_RIGHT_TIME
    keep = keep - np.where(is_suitable, obligation, 0.0 * keep)
    keeps_right = is_suitable & (keep < -RIGHT_GAIN_THRESHOLD)
    wants_change = keeps_right | (right & (gain < -RIGHT_GAIN_THRESHOLD) & continues)
    # Changes to the left.
    left = may_change & is_left
    decay = np.where(own_lane_speed > target_lane_speed, 0.5**step, 0.0 * gain + 0.8**step)
    gain = np.where(left & (own_lane_speed >= target_lane_speed) & (gain > 0.0), gain * decay, gain)
    gain = gain + np.where(left & (own_lane_speed < target_lane_speed), step * relative, 0.0 * gain)
    gains = (gain > LEFT_GAIN_THRESHOLD) & ((relative > 1e-3) | must_brake_soon) & continues
    merges = (vehicles.lane == 0) & (relative >= 0.0) & (gain > 0.0)
    vehicles = vehicles._replace(speed_gain=gain, keep_right=keep, adjacent_advice=advice)
    return vehicles, wants_change | (left & (gains | merges))


def _speed_behind_left_leader(
    vehicles: MotorwayVehicles, context: LaneChangeContext, rows: Array, speed_difference: Array
) -> tuple[Array, Array]:
    """Return the speeds of vehicles behind a slower vehicle on the left lane, and whether each must brake soon."""
    speed, drivers, step = vehicles.speed[rows], context.drivers.select(rows), context.step
    leader_speed, gap = context.target_leader.speed[rows], (context.target_leader.gap + vehicles.minimum_gap)[rows]
    comfortable = clamp_min(speed - vehicles.braking[rows] * step, 0.0)
    safe = drivers.follow_speed(speed, gap, leader_speed, step)
    gentle = np.maximum(comfortable, leader_speed - HELP_SPEED_DIFFERENCE)
    safe = np.where(safe >= comfortable, safe, gentle)
    safe = np.where(vehicles.speed_gain[rows] < LEFT_GAIN_THRESHOLD, np.maximum(safe, leader_speed), safe)
    later = drivers.follow_speed(speed, gap - speed_difference * OVERTAKING_LOOK_AHEAD, leader_speed, step)
    return safe, later < safe


def _has_change_conflict(vehicles: MotorwayVehicles, changes_lane: Array, geometry: MotorwayGeometry) -> Array:
    """Return which vehicles would change into a gap of the right lane where a vehicle merges from the ramp."""
    merges, conflict = changes_lane & (vehicles.lane == 0), np.zeros(len(changes_lane), bool)
    if not bool(merges.any()):
        return conflict
    rows = np.flatnonzero(np.isin(vehicles.road, vehicles.road[merges]))
    vehicles, merges = vehicles.select(rows), merges[rows]
    ahead, behind = (neighbor[1] for neighbor in find_neighbors(vehicles.road, np.where(merges, 1, vehicles.lane), 2))
    position, min_distance = vehicles.position, 2.0 * (geometry.vehicle_length + vehicles.minimum_gap)
    is_tight_ahead = (ahead >= 0) & merges[ahead] & (position[ahead] - position < min_distance)
    is_tight_behind = (behind >= 0) & merges[behind] & (position - position[behind] < min_distance)
    conflict[rows] = changes_lane[rows] & (vehicles.lane == 2) & (is_tight_ahead | is_tight_behind)
    return conflict
