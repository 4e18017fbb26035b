"""How SUMO moves people who drive its IDM, as one formula on arrays: the model, and what SUMO clips of it.

Sources: SUMO's MSCFModel_IDM (`_v`), MSCFModel (`finalizeSpeed`) and MSVehicle (`executeMove`).
"""

from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.idm import (
    IDM_PARAMETER_NAMES,
    IDMArrays,
    IDMParameters,
    fast_power,
    idm_acceleration,
    stack_idm_parameters,
)
from unjam.physics.kinematics import next_speed
from unjam.scenarios.road import ClosedRoad
from unjam.worlds.batch.leaders import Leader, lane_end_leader, leaders
from unjam.worlds.batch.noise import ArrayFactory

HumanSpeedModel = Callable[[Array, Array, Array], Array]
"""speeds, leaders' speeds and gaps to them, shape (vehicles, W), to the speeds after a step without noise"""

SUMO_MIN_GAP = 1e-3
"""gap below which `_v` takes this one, SUMO's NUMERICAL_EPS [m]"""
EMERGENCY_BRAKING = 9.0
"""`emergencyDecel` of a passenger car, beyond which `finalizeSpeed` lets nobody brake [m/s2]"""
MIN_OVERSPEED_BRAKING = 1.5
"""deceleration that `executeMove` allows at least to who is faster than he wants [m/s2]"""
OVERSPEED_BRAKING_TOLERANCE = 1e-3
"""what it allows beyond, SUMO's NUMERICAL_EPS [m/s]"""
STANDSTILL_ACCELERATION = 1e-4
"""SUMO's NUMERICAL_EPS_SPEED over the time step: people no faster than that after a step stand [m/s2]"""


def human_idm_speed(
    speed: Array, leader_speed: Array, gap: Array, parameters: IDMParameters | IDMArrays, step: float
) -> Array:
    """Return the speeds after a step of people behind leaders, before noise is added [m/s].

    Shapes: any, broadcast together. Units: m/s, m/s, m, s. SUMO divides steps of more than 0.375 s; those
    are not here.
    """
    gap = clamp_min(gap, SUMO_MIN_GAP)
    acceleration = idm_acceleration(speed, leader_speed, gap, parameters, fast_power)
    wanted = next_speed(speed, clamp_min(acceleration, -EMERGENCY_BRAKING), step)
    wanted = clamp_max(wanted, parameters.desired_speed)
    return wanted * (wanted > STANDSTILL_ACCELERATION * step)


def human_ring_speed(
    speed: Array,
    position: Array,
    leader: Leader,
    loop_length: Array,
    parameters: IDMParameters | IDMArrays,
    step: float,
) -> Array:
    """Return the speeds after a step of people on a ring of four lanes, before noise is added [m/s].

    Arguments as of `lanes.leaders`.
    """
    xp, seen = namespace(speed), leaders(speed, position, leader, loop_length, parameters, step)
    found = reduce(xp.minimum, (human_idm_speed(speed, *each, parameters, step) for each in seen))
    beyond = speed > parameters.desired_speed  # noise did it
    if bool(beyond.any()):
        end = lane_end_leader(speed, position, loop_length, parameters)
        slower = human_idm_speed(speed, *end, without_minimum_gap(parameters), step)
        slowest = (
            speed
            - clamp_min(parameters.comfortable_deceleration, MIN_OVERSPEED_BRAKING) * step
            - OVERSPEED_BRAKING_TOLERANCE
        )
        found = xp.where(beyond, xp.minimum(found, xp.maximum(slower, slowest)), found)
    return found


def without_minimum_gap(parameters: IDMParameters | IDMArrays) -> IDMArrays:
    """Return people who keep no gap at standstill, as to the end of a lane."""
    return IDMArrays(**{name: getattr(parameters, name) for name in IDM_PARAMETER_NAMES})._replace(minimum_gap=0.0)


def human_parameters(
    roads: Sequence[ClosedRoad], shared_parameters: IDMParameters, to_array: ArrayFactory
) -> IDMParameters | IDMArrays:
    """Return how the people of W roads drive: all alike, or each vehicle's driver, shape (vehicles, W)."""
    if not roads[0].human_parameters:
        return shared_parameters
    drivers = [stack_idm_parameters([road.human_parameters[name] for name in road.vehicle_ids]) for road in roads]
    return IDMArrays(*(to_array(np.stack(values, 1)) for values in zip(*drivers, strict=True)))
