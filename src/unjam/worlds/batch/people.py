"""How SUMO moves people who drive its IDM, as one formula on arrays: the model, and what SUMO clips of it.

Sources: SUMO's MSCFModel_IDM (`_v`), MSCFModel (`finalizeSpeed`) and MSVehicle (`executeMove`).
"""

from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from unjam.physics.arrays import Array, at_least, at_most, namespace
from unjam.physics.idm import (
    PARAMETER_NAMES,
    IDMParameters,
    IDMRows,
    by_squaring,
    idm_acceleration,
    parameter_rows,
)
from unjam.physics.kinematics import next_speed
from unjam.scenarios.road import ClosedRoad
from unjam.worlds.batch.lanes import Leader, end_of_lane, leaders
from unjam.worlds.batch.noise import Numbers

People = Callable[[Array, Array, Array], Array]
"""speeds, leaders' speeds and gaps to them, shape (vehicles, W), to the speeds after a step without noise"""

SMALLEST_GAP = 1e-3
"""gap below which `_v` takes this one, SUMO's NUMERICAL_EPS [m]"""
EMERGENCY_BRAKING = 9.0
"""`emergencyDecel` of a passenger car, beyond which `finalizeSpeed` lets nobody brake [m/s2]"""
LEAST_BRAKING = 1.5
"""deceleration that `executeMove` allows at least to who is faster than he wants [m/s2]"""
MORE_BRAKING = 1e-3
"""what it allows beyond, SUMO's NUMERICAL_EPS [m/s]"""
CREEPING = 1e-4
"""SUMO's NUMERICAL_EPS_SPEED over the time step: people no faster than that after a step stand [m/s2]"""


def people_speed(
    speed: Array, leader_speed: Array, gap: Array, people: IDMParameters | IDMRows, step: float
) -> Array:
    """Return the speeds after a step of people behind leaders, before noise is added [m/s].

    Shapes: any, broadcast together. Units: m/s, m/s, m, s. SUMO divides steps of more than 0.375 s; those
    are not here.
    """
    gap = at_least(gap, SMALLEST_GAP)
    acceleration = idm_acceleration(speed, leader_speed, gap, people, by_squaring)
    wanted = next_speed(speed, at_least(acceleration, -EMERGENCY_BRAKING), step)
    wanted = at_most(wanted, people.desired_speed)
    return wanted * (wanted > CREEPING * step)


def speed_on_ring(
    speed: Array,
    position: Array,
    ahead: Leader,
    loop: Array,
    people: IDMParameters | IDMRows,
    step: float,
) -> Array:
    """Return the speeds after a step of people on a ring of four lanes, before noise is added [m/s].

    Arguments as of `lanes.leaders`.
    """
    xp, seen = namespace(speed), leaders(speed, position, ahead, loop, people, step)
    found = reduce(xp.minimum, (people_speed(speed, *each, people, step) for each in seen))
    beyond = speed > people.desired_speed  # noise did it
    if bool(beyond.any()):
        end = end_of_lane(speed, position, loop, people)
        slower = people_speed(speed, *end, without_gap(people), step)
        slowest = speed - at_least(people.comfortable_deceleration, LEAST_BRAKING) * step - MORE_BRAKING
        found = xp.where(beyond, xp.minimum(found, xp.maximum(slower, slowest)), found)
    return found


def without_gap(people: IDMParameters | IDMRows) -> IDMRows:
    """Return people who keep no gap at standstill, as to the end of a lane."""
    return IDMRows(**{name: getattr(people, name) for name in PARAMETER_NAMES})._replace(minimum_gap=0.0)


def parameters_of(
    roads: Sequence[ClosedRoad], alike: IDMParameters, numbers: Numbers
) -> IDMParameters | IDMRows:
    """Return how the people of W roads drive: all alike, or each vehicle's driver, shape (vehicles, W)."""
    if not roads[0].people:
        return alike
    drivers = [parameter_rows([road.people[name] for name in road.vehicle_ids]) for road in roads]
    return IDMRows(*(numbers(np.stack(values, 1)) for values in zip(*drivers, strict=True)))
