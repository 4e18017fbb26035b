"""How SUMO's people change lanes on a motorway that a ramp joins, all of a step at once.

SUMO asks one vehicle after the other, from front to back; here those on the ramp's lane come first, who must
change, and then all who may gain by it, which is alike in distribution.
Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `anticipateFollowSpeed`).
"""

from unjam.physics.arrays import Array, clamp_min, namespace
from unjam.worlds.batch.on_ramp.lane_change_context import (
    LaneChangeContext,
    MotorwayGeometry,
    Neighbor,
    lane_change_context,
)
from unjam.worlds.batch.on_ramp.mandatory_changes import (
    HELP_SPEED_DIFFERENCE,
    UNCONGESTED_SPEED,
    mandatory_lane_changes,
)
from unjam.worlds.batch.on_ramp.vehicles import (
    NO_ADVICE,
    NO_VEHICLE,
    MotorwayVehicles,
    find_neighbors,
    neighbors_on_lane,
)

LOOK_AHEAD_RETENTION = 0.9
"""what a second leaves of the speed with which somebody looks ahead"""
LEFT_GAIN_THRESHOLD, RIGHT_GAIN_THRESHOLD = 0.2, 2.0
"""gains at which one changes"""
MIN_REFERENCE_SPEED = 10.0
"""over which gains are relative at least [m/s]"""
RIGHT_SPEED_TOLERANCE = 5.0 / 3.6
"""by so much before it matters [m/s]"""
KEEP_RIGHT_ACCEPTANCE_TIME, KEEP_RIGHT_TIME = 7.0, 5.0
"""[s]"""
MIN_REMAINING_TIME = 20.0
"""time that the other lane must go on for a change that is not needed [s]"""
OVERTAKING_LOOK_AHEAD = 8.0
"""time before it would have to brake in which one begins to overtake [s]"""


def change_lanes(vehicles: MotorwayVehicles, geometry: MotorwayGeometry, step: float) -> MotorwayVehicles:
    """Return the vehicles after all who want to and can have changed lanes, with advice for the next step."""
    xp, speed = namespace(vehicles.speed), vehicles.speed
    none = speed * 0.0 + NO_ADVICE
    kept = 1.0 - (1.0 - LOOK_AHEAD_RETENTION) * step
    look = xp.where(speed > vehicles.look_ahead_speed, speed, kept * vehicles.look_ahead_speed + (1.0 - kept) * speed)
    vehicles = vehicles._replace(
        own_advice=none, cooperative_advice=none + 0.0, adjacent_advice=none + 0.0, speed_bias=speed * 0.0, look_ahead_speed=look
    )
    scene = lane_change_context(vehicles, geometry, step)
    vehicles, urgent, help_wanted = mandatory_lane_changes(vehicles, scene, geometry)
    free = ~(scene.is_leader_blocking | scene.is_follower_blocking) & (scene.target_lane != NO_VEHICLE)
    vehicles, wants = _speed_gain_changes(vehicles, scene, geometry, ~urgent & (scene.target_lane != NO_VEHICLE))
    helps = help_wanted & (vehicles.lane > 0) & (scene.target_lane > vehicles.lane)
    goes = (urgent | wants | helps) & free
    held = helps & ~free
    leans = xp.where(held, xp.where(scene.is_leader_blocking, -1.0, 1.0), vehicles.speed_bias)
    vehicles = vehicles._replace(speed_bias=leans)
    goes = goes & ~_has_change_conflict(vehicles, scene, goes, geometry)
    return _apply_changes(vehicles, goes, scene.target_lane)


def _speed_gain_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, may_change: Array
) -> tuple[MotorwayVehicles, Array]:
    """Return the vehicles with what they would gain, and who wants to change for it or to keep right."""
    xp, speed, place, step = namespace(vehicles.speed), vehicles.speed, vehicles.position, context.step
    ahead, leader, drivers = context.target_leader, context.leader, context.drivers
    rises = context.target_lane > vehicles.lane
    there = xp.minimum(geometry.speed_limit * vehicles.speed_factor, vehicles.speed_cap)
    here = xp.where(
        (vehicles.lane == 0) & (place < geometry.merge_start), geometry.ramp_speed_limit, geometry.speed_limit
    )
    here = xp.minimum(here * vehicles.speed_factor, vehicles.speed_cap)
    goes_on = xp.where(place < geometry.merge_start, geometry.length, geometry.length - geometry.merge_start)
    goes_on = xp.where(place < geometry.merge_end, goes_on, geometry.length - geometry.merge_end)
    own_end = xp.where(vehicles.lane == 0, geometry.merge_end - geometry.merge_start, goes_on)
    gain, keep, fast = vehicles.speed_gain, vehicles.keep_right, speed >= UNCONGESTED_SPEED
    # Nobody passes on the right: who comes up to somebody slower on the left holds back, or goes there.
    its = xp.minimum(geometry.speed_limit * vehicles.speed_factor[ahead.row], vehicles.speed_cap[ahead.row])
    slower = xp.maximum(here - its, speed - ahead.speed)
    holds = may_change & rises & ahead.is_present & fast & (slower > 0.0)
    most, soon, advice = here, speed < 0.0, vehicles.adjacent_advice
    if bool(holds.any()):
        safe, soon_slow = _speed_behind_left_leader(vehicles, context, holds, slower[holds])
        advice, most = advice + 0.0, here + 0.0
        advice[holds] = xp.minimum(advice[holds], (safe - speed[holds]) / step)
        soon[holds] = soon_slow
        most[holds] = xp.minimum(here[holds], safe)
        gain = gain + xp.where(soon, step * slower / clamp_min(here, MIN_REFERENCE_SPEED), 0.0 * gain)
    # How fast either lane will be.
    speeds_up = (ahead.is_present & (vehicles.acceleration[ahead.row] > 0.0)) | (
        leader.is_present & (vehicles.acceleration[leader.row] > 0.0)
    )

    def anticipated_speed(neighbor: Neighbor, end_distance: Array) -> Array:
        gap, its = (
            xp.where(neighbor.is_present, neighbor.gap, end_distance),
            xp.where(neighbor.is_present, neighbor.speed, 0.0 * speed),
        )
        found = drivers.safe_speed(gap, its, vehicles.braking[neighbor.row], step)
        later = (speed + vehicles.max_acceleration * (1.0 - step))[speeds_up]
        gap = (gap + vehicles.minimum_gap)[speeds_up]
        found[speeds_up] = drivers.select(speeds_up).follow_speed(later, gap, its[speeds_up], step)
        return found

    that = xp.minimum(there, anticipated_speed(ahead, goes_on))
    # Speeds that are steady are compared as far as they are safe: there who holds back is not bound by it.
    this = xp.minimum(xp.where(speeds_up, most, here), anticipated_speed(leader, own_end))
    relative = (that - this) / clamp_min(that, MIN_REFERENCE_SPEED)
    lasts = goes_on / clamp_min(speed, 0.1) > MIN_REMAINING_TIME
    # To the right.
    right = may_change & (context.target_lane < vehicles.lane)
    bad = this - RIGHT_SPEED_TOLERANCE > that
    forgets = xp.where(right & bad & (gain < 0.0), 0.5**step, 1.0)
    good = right & ~bad
    gain = gain * forgets - xp.where(good & ((gain < 0.0) | (relative > 0.0)), step * relative, 0.0 * gain)
    accepted = KEEP_RIGHT_ACCEPTANCE_TIME * (here / geometry.speed_limit) * clamp_min(speed, 1.0)
    clear = clamp_min(goes_on - drivers.brake_gap(here, step), 0.0)
    seconds = xp.minimum(accepted, clear / here)
    closing = ahead.is_present & (ahead.speed < here)
    nearer = clamp_min(xp.minimum(clear, ahead.gap - drivers.secure_gap(here, ahead.speed)), 0.0)
    seconds = xp.where(closing, xp.minimum(seconds, nearer / clamp_min(here - ahead.speed, 1e-6)), seconds)
    clear = xp.where(closing, nearer, clear)
    wishes = xp.minimum(geometry.speed_limit * vehicles.speed_factor[leader.row], vehicles.speed_cap[leader.row])
    behind = good & fast & leader.is_present & (wishes < here)
    slack = here - leader.speed
    slack = xp.where(slack * slack < 1e-12, 1e-6, slack)
    seconds = xp.where(behind, xp.minimum(seconds, xp.minimum(clear, leader.gap) / slack), seconds)
    keep = keep - xp.where(good, step * RIGHT_GAIN_THRESHOLD * seconds / accepted / KEEP_RIGHT_TIME, 0.0 * keep)
    wants = (good & (keep < -RIGHT_GAIN_THRESHOLD)) | (right & (gain < -RIGHT_GAIN_THRESHOLD) & lasts)
    # To the left.
    left = may_change & rises
    forgets = xp.where(this > that, 0.5**step, 0.8**step)
    gain = xp.where(left & (this >= that) & (gain > 0.0), gain * forgets, gain)
    gain = gain + xp.where(left & (this < that), step * relative, 0.0 * gain)
    wants = wants | (left & (gain > LEFT_GAIN_THRESHOLD) & ((relative > 1e-3) | soon) & lasts)
    wants = wants | (left & (vehicles.lane == 0) & (relative >= 0.0) & (gain > 0.0))
    return vehicles._replace(speed_gain=gain, keep_right=keep, adjacent_advice=advice), wants


def _speed_behind_left_leader(
    vehicles: MotorwayVehicles, context: LaneChangeContext, is_held_back: Array, speed_difference: Array
) -> tuple[Array, Array]:
    """Return how fast those drive who do not pass somebody slower on the left, and who must brake soon."""
    speed, drivers, step = vehicles.speed[is_held_back], context.drivers.select(is_held_back), context.step
    xp, its, room = (
        namespace(speed),
        context.target_leader.speed[is_held_back],
        (context.target_leader.gap + vehicles.minimum_gap)[is_held_back],
    )
    brakes, safe = (
        clamp_min(speed - vehicles.braking[is_held_back] * step, 0.0),
        drivers.follow_speed(speed, room, its, step),
    )
    safe = xp.where(safe >= brakes, safe, xp.maximum(brakes, its - HELP_SPEED_DIFFERENCE))
    safe = xp.where(vehicles.speed_gain[is_held_back] < LEFT_GAIN_THRESHOLD, xp.maximum(safe, its), safe)
    return safe, drivers.follow_speed(speed, room - speed_difference * OVERTAKING_LOOK_AHEAD, its, step) < safe


def _has_change_conflict(
    vehicles: MotorwayVehicles, context: LaneChangeContext, changes_lane: Array, geometry: MotorwayGeometry
) -> Array:
    """Return who would come into a gap of the right lane into which somebody comes from the ramp's lane."""
    xp, place = namespace(vehicles.position), vehicles.position
    coming = changes_lane & (vehicles.lane == 0)
    if not bool(coming.any()):
        return coming
    joined = vehicles._replace(lane=xp.where(coming, 1, vehicles.lane))
    near = find_neighbors(joined, 2)
    there = 1 + 0 * vehicles.lane
    ahead, behind = neighbors_on_lane(near.leaders, there), neighbors_on_lane(near.followers, there)
    least = geometry.vehicle_length + vehicles.minimum_gap
    tight = ((ahead >= 0) & coming[ahead] & (place[ahead] - place < 2.0 * least)) | (
        (behind >= 0) & coming[behind] & (place - place[behind] < 2.0 * least)
    )
    return changes_lane & (vehicles.lane == 2) & tight


def _apply_changes(vehicles: MotorwayVehicles, changes_lane: Array, target_lane: Array) -> MotorwayVehicles:
    """Return the vehicles after changes; who has changed begins anew to wish for anything."""
    xp = namespace(vehicles.speed)

    def reset(values: Array, value: float) -> Array:
        return xp.where(changes_lane, 0.0 * values + value, values)

    return vehicles._replace(
        lane=xp.where(changes_lane, target_lane, vehicles.lane),
        speed_gain=reset(vehicles.speed_gain, 0.0),
        keep_right=reset(vehicles.keep_right, 0.0),
        look_ahead_speed=reset(vehicles.look_ahead_speed, 0.0),
        own_advice=reset(vehicles.own_advice, NO_ADVICE),
        cooperative_advice=reset(vehicles.cooperative_advice, NO_ADVICE),
        adjacent_advice=reset(vehicles.adjacent_advice, NO_ADVICE),
        speed_bias=reset(vehicles.speed_bias, 0.0),
    )
