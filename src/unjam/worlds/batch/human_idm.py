"""SUMO's IDM of human drivers as one formula on arrays: the model and the limits that SUMO applies to it.

Sources: SUMO's MSCFModel_IDM (`_v`), MSCFModel (`finalizeSpeed`) and MSVehicle (`executeMove`).
"""

from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.idm import IDMArrays, IDMParameters, fast_power, idm_acceleration, stack_idm_parameters
from unjam.physics.kinematics import next_speed
from unjam.scenarios.road import ClosedRoad
from unjam.worlds.batch.leaders import HumanParameters, Leader, lane_end_leader, leaders
from unjam.worlds.batch.noise import ArrayFactory

HumanSpeedModel = Callable[[Array, Array, Array], Array]
"""from speeds, leader speeds and gaps, shape (vehicles, W), to the speeds after a step without noise"""

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


def human_idm_speed(speed: Array, leader_speed: Array, gap: Array, parameters: HumanParameters, step: float) -> Array:
    """Return the speeds of human drivers after a step behind their leaders, before noise is added [m/s].

    Shapes: any, broadcast together. Units: m/s, m/s, m, s. Steps are at most 0.375 s; SUMO divides longer ones.
    """
    gap = clamp_min(gap, SUMO_MIN_GAP)
    acceleration = idm_acceleration(speed, leader_speed, gap, parameters, fast_power)
    desired = next_speed(speed, clamp_min(acceleration, -EMERGENCY_BRAKING), step)
    desired = clamp_max(desired, parameters.desired_speed)
    return desired * (desired > STANDSTILL_ACCELERATION * step)


def human_ring_speed(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Array:
    """Return the speeds of human drivers after a step on a ring, before noise [m/s]; arguments as of `leaders`."""
    xp, visible = namespace(speed), leaders(speed, position, leader, loop_length, parameters, step)
    new_speed = reduce(xp.minimum, (human_idm_speed(speed, *each, parameters, step) for each in visible))
    is_too_fast = speed > parameters.desired_speed  # because of noise
    if bool(is_too_fast.any()):
        end = lane_end_leader(speed, position, loop_length, parameters)
        slower = human_idm_speed(speed, *end, without_minimum_gap(parameters), step)
        braking = clamp_min(parameters.comfortable_deceleration, MIN_OVERSPEED_BRAKING)
        min_speed = speed - braking * step - OVERSPEED_BRAKING_TOLERANCE
        new_speed = xp.where(is_too_fast, xp.minimum(new_speed, xp.maximum(slower, min_speed)), new_speed)
    return new_speed


def without_minimum_gap(parameters: HumanParameters) -> IDMArrays:
    """Return drivers with a standstill gap of zero, as at the end of a lane."""
    return IDMArrays(*(getattr(parameters, name) for name in IDMArrays._fields))._replace(minimum_gap=0.0)


def human_parameters(roads: Sequence[ClosedRoad], shared: IDMParameters, to_array: ArrayFactory) -> HumanParameters:
    """Return the parameters of the human drivers of W roads: shared, or of each vehicle, shape (vehicles, W)."""
    if not roads[0].human_parameters:
        return shared
    drivers = [stack_idm_parameters([road.human_parameters[name] for name in road.vehicle_ids]) for road in roads]
    return IDMArrays(*(to_array(np.stack(values, 1)) for values in zip(*drivers, strict=True)))
