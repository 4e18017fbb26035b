"""SUMO's lane changes of human drivers on a motorway with a ramp, all in one step.

SUMO decides for one vehicle after the other, from front to back. Here, vehicles on the ramp's lane, which must change,
come first, and then all that gain by a change, which agrees in distribution.
Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `anticipateFollowSpeed`).
"""

from unjam.physics.arrays import Array, clamp_min, namespace
from unjam.worlds.batch.on_ramp import mandatory_changes
from unjam.worlds.batch.on_ramp.lane_change_context import (
    LaneChangeContext,
    MotorwayGeometry,
    Neighbor,
    lane_change_context,
)
from unjam.worlds.batch.on_ramp.vehicles import (
    ADVICE_FIELDS,
    NO_ADVICE,
    NO_VEHICLE,
    MotorwayVehicles,
    copy_array,
    find_neighbors,
    neighbors_on_lane,
)

LOOK_AHEAD_RETENTION = 0.9
"""share of the look-ahead speed that remains after a second"""
LEFT_GAIN_THRESHOLD, RIGHT_GAIN_THRESHOLD = 0.2, 2.0
"""gains at which vehicles change"""
MIN_REFERENCE_SPEED = 10.0
"""minimum speed to which gains are relative [m/s]"""
RIGHT_SPEED_TOLERANCE = 5.0 / 3.6
"""speed difference up to which the right lane counts as equally fast [m/s]"""
KEEP_RIGHT_ACCEPTANCE_TIME, KEEP_RIGHT_TIME = 7.0, 5.0
"""[s]"""
MIN_REMAINING_TIME = 20.0
"""time for which the other lane must continue for an optional change [s]"""
OVERTAKING_LOOK_AHEAD = 8.0
"""time before necessary braking at which a vehicle starts to overtake [s]"""


def change_lanes(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> MotorwayVehicles:
    """Return the vehicles after their lane changes, with advice for the next step."""
    xp, speed, previous = namespace(vehicles.speed), vehicles.speed, vehicles.look_ahead_speed
    retention = 1.0 - (1.0 - LOOK_AHEAD_RETENTION) * step
    look_ahead_speed = xp.where(speed > previous, speed, retention * previous + (1.0 - retention) * speed)
    advice = dict.fromkeys(ADVICE_FIELDS, speed * 0.0 + NO_ADVICE)
    vehicles = vehicles._replace(**advice, speed_bias=speed * 0.0, look_ahead_speed=look_ahead_speed)
    context = lane_change_context(vehicles, geometry, step)
    vehicles, is_urgent, is_asked = mandatory_changes.mandatory_lane_changes(vehicles, context, geometry)
    has_target = context.target_lane != NO_VEHICLE
    is_clear = ~(context.is_leader_blocking | context.is_follower_blocking) & has_target
    vehicles, wants_change = _speed_gain_changes(vehicles, context, geometry, ~is_urgent & has_target)
    helps = is_asked & (vehicles.lane > 0) & (context.target_lane > vehicles.lane)
    changes = (is_urgent | wants_change | helps) & is_clear
    bias = xp.where(helps & ~is_clear, xp.where(context.is_leader_blocking, -1.0, 1.0), vehicles.speed_bias)
    vehicles = vehicles._replace(speed_bias=bias)
    changes = changes & ~_has_change_conflict(vehicles, changes, geometry)
    initial = dict.fromkeys(("speed_gain", "keep_right", "look_ahead_speed", "speed_bias"), 0.0)
    initial |= dict.fromkeys(ADVICE_FIELDS, NO_ADVICE)
    columns = {
        name: (0.0 * getattr(vehicles, name) + value, getattr(vehicles, name)) for name, value in initial.items()
    }
    columns["lane"] = context.target_lane, vehicles.lane
    return vehicles._replace(**{name: xp.where(changes, *values) for name, values in columns.items()})


def _speed_gain_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, may_change: Array
) -> tuple[MotorwayVehicles, Array]:
    """Return the vehicles with their gains, and whether each wants to change for its gain or to keep right."""
    xp, speed, position, step = namespace(vehicles.speed), vehicles.speed, vehicles.position, context.step
    ahead, leader, drivers, speed_limit = context.target_leader, context.leader, context.drivers, geometry.speed_limit
    is_left = context.target_lane > vehicles.lane

    def allowed_speed(limit: Array, rows: Array) -> Array:
        return xp.minimum(limit * vehicles.speed_factor[rows], vehicles.speed_cap[rows])

    every, is_before = slice(None), position < geometry.merge_start
    target_speed = allowed_speed(speed_limit, every)
    own_limit = xp.where((vehicles.lane == 0) & is_before, geometry.ramp_speed_limit, speed_limit)
    own_speed = allowed_speed(own_limit, every)
    remaining = xp.where(is_before, geometry.length, geometry.length - geometry.merge_start)
    remaining = xp.where(position < geometry.merge_end, remaining, geometry.length - geometry.merge_end)
    own_remaining = xp.where(vehicles.lane == 0, geometry.merge_end - geometry.merge_start, remaining)
    gain, keep, is_fast = vehicles.speed_gain, vehicles.keep_right, speed >= mandatory_changes.UNCONGESTED_SPEED
    # Vehicles do not pass on the right: behind a slower vehicle on the left lane, they slow down or change to the left.
    difference = xp.maximum(own_speed - allowed_speed(speed_limit, ahead.row), speed - ahead.speed)
    is_held_back = may_change & is_left & ahead.is_present & is_fast & (difference > 0.0)
    max_speed, must_brake_soon, advice = own_speed, speed < 0.0, vehicles.adjacent_advice
    if bool(is_held_back.any()):
        safe, brakes_soon = _speed_behind_left_leader(vehicles, context, is_held_back, difference[is_held_back])
        advice, max_speed = copy_array(advice), copy_array(own_speed)
        advice[is_held_back] = xp.minimum(advice[is_held_back], (safe - speed[is_held_back]) / step)
        must_brake_soon[is_held_back] = brakes_soon
        max_speed[is_held_back] = xp.minimum(own_speed[is_held_back], safe)
        relative = step * difference / clamp_min(own_speed, MIN_REFERENCE_SPEED)
        gain = gain + xp.where(must_brake_soon, relative, 0.0 * gain)
    # Anticipated speeds on both lanes.
    accelerates = ahead.is_present & (vehicles.acceleration[ahead.row] > 0.0)
    accelerates = accelerates | (leader.is_present & (vehicles.acceleration[leader.row] > 0.0))

    def anticipated_speed(neighbor: Neighbor, end_distance: Array) -> Array:
        gap = xp.where(neighbor.is_present, neighbor.gap, end_distance)
        leader_speed = xp.where(neighbor.is_present, neighbor.speed, 0.0 * speed)
        anticipated = drivers.safe_speed(gap, leader_speed, vehicles.braking[neighbor.row], step)
        later = (speed + vehicles.max_acceleration * (1.0 - step))[accelerates]
        gap = (gap + vehicles.minimum_gap)[accelerates]
        own_drivers = drivers.select(accelerates)
        anticipated[accelerates] = own_drivers.follow_speed(later, gap, leader_speed[accelerates], step)
        return anticipated

    there = xp.minimum(target_speed, anticipated_speed(ahead, remaining))
    # At steady speeds, the safe speeds are compared, without the restriction against passing on the right.
    here = xp.minimum(xp.where(accelerates, max_speed, own_speed), anticipated_speed(leader, own_remaining))
    relative = (there - here) / clamp_min(there, MIN_REFERENCE_SPEED)
    continues = remaining / clamp_min(speed, 0.1) > MIN_REMAINING_TIME
    # To the right.
    right = may_change & (context.target_lane < vehicles.lane)
    is_slower = here - RIGHT_SPEED_TOLERANCE > there
    decay = xp.where(right & is_slower & (gain < 0.0), 0.5**step, 1.0)
    is_suitable = right & ~is_slower
    is_counted = is_suitable & ((gain < 0.0) | (relative > 0.0))
    gain = gain * decay - xp.where(is_counted, step * relative, 0.0 * gain)
    accepted = KEEP_RIGHT_ACCEPTANCE_TIME * (own_speed / speed_limit) * clamp_min(speed, 1.0)
    distance = clamp_min(remaining - drivers.brake_gap(own_speed, step), 0.0)
    seconds = xp.minimum(accepted, distance / own_speed)
    closes_in = ahead.is_present & (ahead.speed < own_speed)
    secure = clamp_min(xp.minimum(distance, ahead.gap - drivers.secure_gap(own_speed, ahead.speed)), 0.0)
    closing_seconds = xp.minimum(seconds, secure / clamp_min(own_speed - ahead.speed, 1e-6))
    seconds, distance = xp.where(closes_in, closing_seconds, seconds), xp.where(closes_in, secure, distance)
    is_behind = is_suitable & is_fast & leader.is_present & (allowed_speed(speed_limit, leader.row) < own_speed)
    surplus = own_speed - leader.speed
    surplus = xp.where(surplus * surplus < 1e-12, 1e-6, surplus)
    seconds = xp.where(is_behind, xp.minimum(seconds, xp.minimum(distance, leader.gap) / surplus), seconds)
    obligation = step * RIGHT_GAIN_THRESHOLD * seconds / accepted / KEEP_RIGHT_TIME
    keep = keep - xp.where(is_suitable, obligation, 0.0 * keep)
    keeps_right = is_suitable & (keep < -RIGHT_GAIN_THRESHOLD)
    wants_change = keeps_right | (right & (gain < -RIGHT_GAIN_THRESHOLD) & continues)
    # To the left.
    left = may_change & is_left
    decay = xp.where(here > there, 0.5**step, 0.8**step)
    gain = xp.where(left & (here >= there) & (gain > 0.0), gain * decay, gain)
    gain = gain + xp.where(left & (here < there), step * relative, 0.0 * gain)
    gains = (gain > LEFT_GAIN_THRESHOLD) & ((relative > 1e-3) | must_brake_soon) & continues
    merges = (vehicles.lane == 0) & (relative >= 0.0) & (gain > 0.0)
    vehicles = vehicles._replace(speed_gain=gain, keep_right=keep, adjacent_advice=advice)
    return vehicles, wants_change | (left & (gains | merges))


def _speed_behind_left_leader(
    vehicles: MotorwayVehicles, context: LaneChangeContext, rows: Array, speed_difference: Array
) -> tuple[Array, Array]:
    """Return the speeds of vehicles that do not pass a slower one on the left, and whether each must brake soon."""
    xp, speed, drivers, step = namespace(rows), vehicles.speed[rows], context.drivers.select(rows), context.step
    leader_speed, gap = context.target_leader.speed[rows], (context.target_leader.gap + vehicles.minimum_gap)[rows]
    comfortable = clamp_min(speed - vehicles.braking[rows] * step, 0.0)
    safe = drivers.follow_speed(speed, gap, leader_speed, step)
    limited = xp.maximum(comfortable, leader_speed - mandatory_changes.HELP_SPEED_DIFFERENCE)
    safe = xp.where(safe >= comfortable, safe, limited)
    safe = xp.where(vehicles.speed_gain[rows] < LEFT_GAIN_THRESHOLD, xp.maximum(safe, leader_speed), safe)
    later = drivers.follow_speed(speed, gap - speed_difference * OVERTAKING_LOOK_AHEAD, leader_speed, step)
    return safe, later < safe


def _has_change_conflict(vehicles: MotorwayVehicles, changes_lane: Array, geometry: MotorwayGeometry) -> Array:
    """Return which vehicles would change into a gap of the right lane into which a vehicle merges from the ramp."""
    xp, position = namespace(vehicles.position), vehicles.position
    merges = changes_lane & (vehicles.lane == 0)
    if not bool(merges.any()):
        return merges
    neighbors = find_neighbors(vehicles._replace(lane=xp.where(merges, 1, vehicles.lane)), 2)
    ahead, behind = (neighbors_on_lane(each, 1 + 0 * vehicles.lane) for each in neighbors)
    min_distance = 2.0 * (geometry.vehicle_length + vehicles.minimum_gap)
    is_tight_ahead = (ahead >= 0) & merges[ahead] & (position[ahead] - position < min_distance)
    is_tight_behind = (behind >= 0) & merges[behind] & (position - position[behind] < min_distance)
    return changes_lane & (vehicles.lane == 2) & (is_tight_ahead | is_tight_behind)
