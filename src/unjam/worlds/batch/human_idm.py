"""SUMO's IDM of human drivers on arrays, with the limits that SUMO applies to it, and the leaders of these drivers.

A ring in SUMO consists of four lanes in a row. Drivers brake for the vehicle ahead on their own lane, and for the last
vehicle on each further lane that they see: the next lane, and lanes within their stopping distance or 25 m.
Sources: SUMO's MSCFModel_IDM (`_v`), MSCFModel (`finalizeSpeed`, `brakeGap`) and MSVehicle (`executeMove`,
`planMoveInternal`).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, as_indices, clamp_max, clamp_min, namespace
from unjam.physics.idm import IDMArrays, IDMParameters, fast_power, idm_acceleration, stack_idm_parameters
from unjam.physics.kinematics import next_speed, stopping_distance
from unjam.scenarios.ring import RING_EDGES
from unjam.scenarios.road import OrderedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.noise import ArrayFactory

HumanSpeedModel = Callable[[Array, Array, Array], Array]
"""returns noise-free speeds after a step, for speeds, leader speeds and gaps of shape (vehicles, W)"""

SUMO_MIN_GAP = 1e-3
"""minimum gap in `_v`: SUMO's NUMERICAL_EPS [m]"""
EMERGENCY_BRAKING = 9.0
"""`emergencyDecel` of a passenger car, the braking limit of `finalizeSpeed` [m/s2]"""
MIN_OVERSPEED_BRAKING = 1.5
"""braking that `executeMove` allows at least above the desired speed [m/s2]"""
OVERSPEED_BRAKING_TOLERANCE = 1e-3
"""tolerance of that limit: SUMO's NUMERICAL_EPS [m/s]"""
STANDSTILL_ACCELERATION = 1e-4
"""SUMO's NUMERICAL_EPS_SPEED over the time step; slower vehicles stand after a step [m/s2]"""
MIN_LOOK_AHEAD = 5 * VEHICLE_LENGTH
"""minimum length of visible lanes beyond the own lane: SUMO's CRLL_LOOK_AHEAD vehicle lengths [m]"""
CONTACT_GAP = -1e-3
"""gap below which SUMO reports a collision: its NUMERICAL_EPS [m]"""
FREE_GAP = 1e6
"""gap without a leader in SUMO's `freeSpeed`, where the leader speed is the desired speed [m]"""
HumanParameters = IDMParameters | IDMArrays


class Leader(NamedTuple):
    """Speeds of leaders [m/s] and gaps to them [m], arrays of shape (vehicles, W)."""

    speed: Array
    gap: Array


def visible_leaders(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Iterator[Leader]:
    """Yield the leader of each vehicle on its own lane, then on each next lane until no driver sees further.

    Shapes: (vehicles, W); `loop_length` (W,). Positions are those of front bumpers; `leader` is the vehicle ahead.
    """
    xp, lane_length, lap_position = namespace(speed), loop_length / RING_EDGES, position % loop_length
    lane = xp.floor(lap_position / lane_length)
    distance = (lane + 1.0) * lane_length - lap_position  # distance to the end of the last lane so far

    def leader_if_present(is_present: Array, leader_speed: Array, gap: Array) -> Leader:
        return Leader(xp.where(is_present, leader_speed, parameters.desired_speed), xp.where(is_present, gap, FREE_GAP))

    yield leader_if_present(leader.gap <= distance, *leader)
    max_speed = clamp_max(speed + parameters.max_acceleration * step, parameters.desired_speed)
    braking, time_headway = parameters.comfortable_deceleration, parameters.time_headway
    look_ahead = look_ahead_distance(max_speed, time_headway, braking, step)
    # This is the remainder modulo the loop length, without a slow division.
    offsets = xp.stack([lap_position - edge * lane_length for edge in range(RING_EDGES)])
    offsets = xp.where(offsets < 0.0, offsets + loop_length, offsets)
    # A user can set another default device of torch.
    rows, columns = (xp.arange(count, device=speed.device) for count in (RING_EDGES, speed.shape[1]))
    last_vehicle = offsets.argmin(1)
    fronts, speeds = offsets[rows[:, None], last_vehicle, columns], speed[last_vehicle, columns]
    sees_lane, seen_length = distance > 0.0, 0.0 * loop_length
    while bool(sees_lane.any()):
        lane = xp.where(lane == RING_EDGES - 1.0, 0.0, lane + 1.0)
        index = as_indices(lane)
        front, leader_speed = fronts[index, columns], speeds[index, columns]
        # A vehicle is also on the lane of its rear bumper.
        is_occupied = sees_lane & (front < lane_length + VEHICLE_LENGTH)
        yield leader_if_present(is_occupied, leader_speed, distance + front - VEHICLE_LENGTH)
        seen_length = seen_length + lane_length
        distance = distance + lane_length
        sees_lane = sees_lane & ((distance <= look_ahead) | (seen_length <= MIN_LOOK_AHEAD))


def look_ahead_distance(max_speed: Array, time_headway: Array, braking: Array, step: float) -> Array:
    """Return the look-ahead distance [m]: to stop from the maximum speed of this step after a time headway."""
    return max_speed * (step + time_headway) + stopping_distance(max_speed, braking, step)


def ring_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch their leader, (vehicles, ...); SUMO requires both fronts on the same lane."""
    xp = namespace(position)
    lane = xp.floor(position % loop_length / (loop_length / RING_EDGES))
    return (gap < CONTACT_GAP) & (lane == xp.concatenate([lane[1:], lane[:1]]))


def human_idm_speed(speed: Array, leader_speed: Array, gap: Array, parameters: HumanParameters, step: float) -> Array:
    """Return noise-free speeds of human drivers after a step of at most 0.375 s behind their leaders [m/s]."""
    gap = clamp_min(gap, SUMO_MIN_GAP)
    acceleration = idm_acceleration(speed, leader_speed, gap, parameters, fast_power)
    desired = next_speed(speed, clamp_min(acceleration, -EMERGENCY_BRAKING), step)
    desired = clamp_min(clamp_max(desired, parameters.desired_speed), speed - EMERGENCY_BRAKING * step)
    return desired * (desired > STANDSTILL_ACCELERATION * step)


def human_ring_speed(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Array:
    """Return noise-free speeds of human drivers after a step on a ring [m/s]; arguments as `visible_leaders`."""
    leaders = visible_leaders(speed, position, leader, loop_length, parameters, step)
    new_speeds = (human_idm_speed(speed, *lane_leader, parameters, step) for lane_leader in leaders)
    new_speed = reduce(namespace(speed).minimum, new_speeds)
    lane_length = loop_length / RING_EDGES
    return slow_to_desired_speed(new_speed, speed, lane_length - position % lane_length, parameters, step)


def slow_to_desired_speed(
    new_speed: Array, speed: Array, distance_to_end: Array, parameters: HumanParameters, step: float
) -> Array:
    """Limit the new speeds of drivers above their desired speed, who brake for the end of their lane [m/s]."""
    xp, desired = namespace(speed), parameters.desired_speed
    is_too_fast = speed > desired  # because of noise
    if bool(is_too_fast.any()):  # SUMO: the end of the lane is a standing leader, at least `getSecureGap` ahead
        secure_gap = desired * (parameters.time_headway + desired / parameters.interaction_scale)
        gap = clamp_min(distance_to_end, secure_gap)
        slower = human_idm_speed(speed, 0.0 * speed, gap, set_zero_minimum_gap(parameters), step)
        braking = clamp_min(parameters.comfortable_deceleration, MIN_OVERSPEED_BRAKING)
        min_speed = speed - braking * step - OVERSPEED_BRAKING_TOLERANCE
        new_speed = xp.where(is_too_fast, xp.minimum(new_speed, xp.maximum(slower, min_speed)), new_speed)
    return new_speed


def set_zero_minimum_gap(parameters: HumanParameters) -> IDMArrays:
    """Return parameters with a minimum gap of zero, as at the end of a lane."""
    return IDMArrays(*(getattr(parameters, name) for name in IDMArrays._fields))._replace(minimum_gap=0.0)


def human_parameters(roads: Sequence[OrderedRoad], shared: IDMParameters, to_array: ArrayFactory) -> HumanParameters:
    """Return parameters of human drivers on W roads: `shared`, or those of each vehicle, shape (vehicles, W)."""
    if not roads[0].human_parameters:
        return shared
    by_road = [stack_idm_parameters([road.human_parameters[name] for name in road.vehicle_ids]) for road in roads]
    return IDMArrays(*(to_array(np.stack(values, 1)) for values in zip(*by_road, strict=True)))
