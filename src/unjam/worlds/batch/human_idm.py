"""SUMO's IDM of human drivers as one formula on arrays, with the limits that SUMO applies to it, and their leaders.

SUMO's rings have four lanes in a row. Drivers brake for the vehicle ahead on their own lane, and for the last vehicle
on each visible lane further ahead: the next one, and others as far as they need to stop, but at least 25 m of lanes.
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
"""returns the speeds after a step without noise, for speeds, leader speeds and gaps of shape (vehicles, W)"""

SUMO_MIN_GAP = 1e-3
"""minimum gap in `_v`: SUMO's NUMERICAL_EPS [m]"""
EMERGENCY_BRAKING = 9.0
"""`emergencyDecel` of a passenger car, the braking limit of `finalizeSpeed` [m/s2]"""
MIN_OVERSPEED_BRAKING = 1.5
"""braking that `executeMove` allows at least above the desired speed [m/s2]"""
OVERSPEED_BRAKING_TOLERANCE = 1e-3
"""tolerance of that limit: SUMO's NUMERICAL_EPS [m/s]"""
STANDSTILL_ACCELERATION = 1e-4
"""SUMO's NUMERICAL_EPS_SPEED over the time step: slower vehicles stand after a step [m/s2]"""
MIN_LOOK_AHEAD = 5 * VEHICLE_LENGTH
"""minimum length of visible lanes beyond the own one: SUMO's CRLL_LOOK_AHEAD vehicle lengths [m]"""
CONTACT_GAP = -1e-3
"""gap below which SUMO reports a collision: its NUMERICAL_EPS [m]"""
FREE_GAP = 1e6
"""gap in SUMO's `freeSpeed` without a leader; the leader then drives at the desired speed [m]"""
HumanParameters = IDMParameters | IDMArrays


class Leader(NamedTuple):
    """Leaders of drivers: speed [m/s] and gap [m], arrays of shape (vehicles, W)."""

    speed: Array
    gap: Array


def leaders(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Iterator[Leader]:
    """Yield the leader of each vehicle on its own lane, on the next one, and so on as far as any driver sees.

    Shapes: (vehicles, W); `loop_length` (W,). Positions are those of front bumpers; `leader` is the vehicle ahead.
    """
    xp, lane_length, lap_position = namespace(speed), loop_length / RING_EDGES, position % loop_length
    lane = xp.floor(lap_position / lane_length)
    distance = (lane + 1.0) * lane_length - lap_position  # to the end of the lanes seen so far

    def leader_if_present(is_present: Array, leader_speed: Array, gap: Array) -> Leader:
        return Leader(xp.where(is_present, leader_speed, parameters.desired_speed), xp.where(is_present, gap, FREE_GAP))

    yield leader_if_present(leader.gap <= distance, *leader)
    max_speed = clamp_max(speed + parameters.max_acceleration * step, parameters.desired_speed)
    braking, time_headway = parameters.comfortable_deceleration, parameters.time_headway
    look_ahead = look_ahead_distance(max_speed, time_headway, braking, step)
    # A remainder takes longer than everything else here; the remainder of less than one loop needs no division.
    offsets = xp.stack([lap_position - edge * lane_length for edge in range(RING_EDGES)])
    offsets = xp.where(offsets < 0.0, offsets + loop_length, offsets)
    # The user can have set another default device of torch.
    rows, columns = (xp.arange(count, device=speed.device) for count in (RING_EDGES, speed.shape[1]))
    last = offsets.argmin(1)
    fronts, speeds = offsets[rows[:, None], last, columns], speed[last, columns]
    sees, seen_length = distance > 0.0, 0.0 * loop_length
    while bool(sees.any()):
        lane = xp.where(lane == RING_EDGES - 1.0, 0.0, lane + 1.0)
        index = as_indices(lane)
        front, leader_speed = fronts[index, columns], speeds[index, columns]
        # A vehicle with its rear bumper on a lane is on that lane, too.
        is_occupied = sees & (front < lane_length + VEHICLE_LENGTH)
        yield leader_if_present(is_occupied, leader_speed, distance + front - VEHICLE_LENGTH)
        seen_length = seen_length + lane_length
        distance = distance + lane_length
        sees = sees & ((distance <= look_ahead) | (seen_length <= MIN_LOOK_AHEAD))


def look_ahead_distance(max_speed: Array, time_headway: Array, braking: Array, step: float) -> Array:
    """Return how far drivers look ahead [m]: far enough to stop after a headway at the maximum speed of this step."""
    return max_speed * (step + time_headway) + stopping_distance(max_speed, braking, step)


def ring_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles, (vehicles, ...), touch the one ahead: SUMO requires both fronts on the same lane."""
    xp = namespace(position)
    lane = xp.floor(position % loop_length / (loop_length / RING_EDGES))
    return (gap < CONTACT_GAP) & (lane == xp.concatenate([lane[1:], lane[:1]]))


def human_idm_speed(speed: Array, leader_speed: Array, gap: Array, parameters: HumanParameters, step: float) -> Array:
    """Return the speeds of human drivers after a step of at most 0.375 s behind their leaders, before noise [m/s]."""
    gap = clamp_min(gap, SUMO_MIN_GAP)
    acceleration = idm_acceleration(speed, leader_speed, gap, parameters, fast_power)
    desired = next_speed(speed, clamp_min(acceleration, -EMERGENCY_BRAKING), step)
    desired = clamp_min(clamp_max(desired, parameters.desired_speed), speed - EMERGENCY_BRAKING * step)
    return desired * (desired > STANDSTILL_ACCELERATION * step)


def human_ring_speed(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Array:
    """Return the speeds of human drivers after a step on a ring, before noise [m/s]; arguments as of `leaders`."""
    xp, visible = namespace(speed), leaders(speed, position, leader, loop_length, parameters, step)
    new_speed = reduce(xp.minimum, (human_idm_speed(speed, *each, parameters, step) for each in visible))
    lane_length = loop_length / RING_EDGES
    return slow_to_desired_speed(new_speed, speed, lane_length - position % lane_length, parameters, step)


def slow_to_desired_speed(
    new_speed: Array, speed: Array, distance_to_end: Array, parameters: HumanParameters, step: float
) -> Array:
    """Return the speeds after a step where drivers above their desired speed brake for the end of their lane [m/s]."""
    xp, desired = namespace(speed), parameters.desired_speed
    is_too_fast = speed > desired  # because of noise
    if bool(is_too_fast.any()):  # the end of the lane is a standing leader, at least SUMO's `getSecureGap` ahead
        secure_gap = desired * (parameters.time_headway + desired / parameters.interaction_scale)
        gap = clamp_min(distance_to_end, secure_gap)
        slower = human_idm_speed(speed, 0.0 * speed, gap, without_minimum_gap(parameters), step)
        braking = clamp_min(parameters.comfortable_deceleration, MIN_OVERSPEED_BRAKING)
        min_speed = speed - braking * step - OVERSPEED_BRAKING_TOLERANCE
        new_speed = xp.where(is_too_fast, xp.minimum(new_speed, xp.maximum(slower, min_speed)), new_speed)
    return new_speed


def without_minimum_gap(parameters: HumanParameters) -> IDMArrays:
    """Return drivers with a standstill gap of zero, as at the end of a lane."""
    return IDMArrays(*(getattr(parameters, name) for name in IDMArrays._fields))._replace(minimum_gap=0.0)


def human_parameters(roads: Sequence[OrderedRoad], shared: IDMParameters, to_array: ArrayFactory) -> HumanParameters:
    """Return the parameters of the human drivers of W roads: shared, or of each vehicle, shape (vehicles, W)."""
    if not roads[0].human_parameters:
        return shared
    drivers = [stack_idm_parameters([road.human_parameters[name] for name in road.vehicle_ids]) for road in roads]
    return IDMArrays(*(to_array(np.stack(values, 1)) for values in zip(*drivers, strict=True)))
