"""Simulation of driver models behind leaders that repeat their recorded speeds.

Errors of single steps do not suffice to compare models: a model with smaller errors can collide more often.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.physics.arrays import Array, clamp_min, clip, namespace
from unjam.physics.idm import IDM_PARAMETER_NAMES, IDMArrays, IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.recordings.trajectories import Floats, Segments
from unjam.scenarios.population import residual_inputs

AccelerationFunction = Callable[[Array, Array, Array], Array]
"""function that returns the acceleration [m/s2] for own speed [m/s], leader speed [m/s] and gap [m]"""
DriverModel = Callable[[Array, Array], AccelerationFunction]
"""function that returns the `AccelerationFunction` of drivers with given initial speeds [m/s] and gaps [m]"""
ResidualFunction = Callable[[Array], Array]
"""function that returns residual accelerations [m/s2] for `residual_inputs`, shape (..., 3)"""
AnyIDM = IDMParameters | IDMArrays
"""one set of IDM parameters, or an array for each parameter"""
AccelerationBounds = tuple[float, float]
"""smallest and largest acceleration [m/s2]"""

MIN_HEADWAY_SPEED = 2.0
"""smallest divisor in an estimated time headway, gap divided by speed [m/s]; at low speeds the ratio is meaningless"""
HEADWAY_LIMITS = (0.2, 6.0)
"""smallest and largest estimated time headway [s]"""


def as_driver_model(acceleration_function: AccelerationFunction) -> DriverModel:
    """Return a driver model with the same acceleration function for any initial speed and gap."""
    return lambda speed, gap: acceleration_function


def replace_parameters(parameters: AnyIDM, **values: Array) -> IDMArrays:
    """Return the parameters as arrays, with `values` in place of some of them."""
    return IDMArrays(*(values.get(name, getattr(parameters, name)) for name in IDM_PARAMETER_NAMES))


def idm_function(parameters: AnyIDM, limits: AccelerationBounds | None = None) -> AccelerationFunction:
    """Return the acceleration function of the IDM, clipped to `limits` [m/s2] unless they are None."""

    def compute_acceleration(speed: Array, leader_speed: Array, gap: Array) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, MIN_IDM_GAP), parameters)
        return acceleration if limits is None else clip(acceleration, *limits)

    return compute_acceleration


def individual_idm(parameters: AnyIDM, headway_weight: Array, limits: AccelerationBounds | None = None) -> DriverModel:
    """Return the IDM with time headways that depend on initial speed and gap, because drivers differ most in headways.

    The headway is T^(1 - w) T0^w with T of `parameters`, T0 = (gap - s0) / v of the first state, and the weight w.
    """
    p = parameters

    def make_idm(speed: Array, gap: Array) -> AccelerationFunction:
        initial_headway = clip((gap - p.minimum_gap) / clamp_min(speed, MIN_HEADWAY_SPEED), *HEADWAY_LIMITS)
        headway = p.time_headway ** (1.0 - headway_weight) * initial_headway**headway_weight
        return idm_function(replace_parameters(p, time_headway=headway), limits)

    return make_idm


def add_residual(
    base: DriverModel | None, network: ResidualFunction, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return a driver model with the sum of base (if any) and network as acceleration, within `limits` [m/s2]."""

    def make_function(speed: Array, gap: Array) -> AccelerationFunction:
        base_function = base(speed, gap) if base is not None else None

        def compute_acceleration(speed: Array, leader_speed: Array, gap: Array) -> Array:
            acceleration = network(residual_inputs(speed, leader_speed, gap))
            if base_function is not None:
                acceleration = acceleration + base_function(speed, leader_speed, gap)
            return acceleration if limits is None else clip(acceleration, *limits)

        return compute_acceleration

    return make_function


def follow_leader(
    acceleration_function: AccelerationFunction, initial_state: tuple[Array, Array], leader: Any, step: float
) -> Iterator[Any]:
    """Yield speed [m/s] and gap [m] of followers after each step behind recorded leaders.

    A follower with the gap zero stays in contact with the leader, and is not faster than the leader, until it brakes.
    `initial_state` is speed and gap of shape (..., n), `leader` speeds [m/s] and positions [m] as in
    `FollowingTrajectory`, shape (T, n).
    """
    (speed, gap), (leader_speeds, leader_paths) = initial_state, leader
    position = gap * 0.0
    steps = zip(leader_speeds[:-1], leader_speeds[1:], leader_paths[1:], strict=True)
    for leader_speed, next_leader_speed, leader_path in steps:
        speed = next_speed(speed, acceleration_function(speed, leader_speed, gap), step)
        gap = leader_path - next_position(position, speed, step)
        is_in_contact, xp = gap <= 0.0, namespace(gap)
        gap = clamp_min(gap, 0.0)
        position = leader_path - gap
        speed = xp.where(is_in_contact & (speed > next_leader_speed), next_leader_speed, speed)
        yield speed, gap


class SimulationErrors(NamedTuple):
    """Errors of a driver model behind recorded leaders, in n segments."""

    speed_mse: Floats
    """mean squared difference to the recorded speed in each segment [m2/s2], shape (n,)"""
    gap_mse: Floats
    """mean squared difference to the recorded gap in each segment [m2], shape (n,)"""
    has_collided: NDArray[np.bool_]
    """whether the gap became zero in a segment, shape (n,)"""


def simulate_followers(model: DriverModel, segments: Segments) -> SimulationErrors:
    """Return the errors of a driver model that starts behind the leader of each segment at the first sample."""
    initial_state, is_present, counts = segments.initial_state, segments.is_present, segments.sample_counts
    states = follow_leader(model(*initial_state), initial_state, segments.leader, segments.time_step)
    speeds, gaps = map(np.stack, zip(initial_state, *states, strict=True))
    speed_mse = (np.square(speeds - segments.speed) * is_present).sum(0) / counts
    gap_mse = (np.square(gaps - segments.gap) * is_present).sum(0) / counts
    return SimulationErrors(speed_mse, gap_mse, np.any((gaps <= 0.0) & is_present, axis=0))
