"""Simulation of driver models behind leaders that repeat their recorded speeds.

Errors one step ahead are not sufficient: a model with smaller ones can collide more often when it drives.
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
"""returns the acceleration [m/s2] for own speed [m/s], leader speed [m/s] and gap [m]"""
DriverModel = Callable[[Array, Array], AccelerationFunction]
"""returns the `AccelerationFunction` of a driver that starts with a speed [m/s] and a gap [m]"""
ResidualFunction = Callable[[Array], Array]
"""returns the acceleration that a network adds [m/s2], for inputs of `residual_inputs`, shape (..., 3)"""
AnyIDM = IDMParameters | IDMArrays
"""one set of IDM parameters, or an array for each parameter"""
AccelerationBounds = tuple[float, float]
"""smallest and largest acceleration [m/s2]"""

MIN_HEADWAY_SPEED = 2.0
"""smallest divisor when a time headway is estimated as gap over speed [m/s]; at low speeds the ratio means nothing"""
HEADWAY_LIMITS = (0.2, 6.0)
"""smallest and largest estimated time headway [s]"""


def as_driver_model(follow: AccelerationFunction) -> DriverModel:
    """Return a driver model that uses one acceleration function, whatever its initial speed and gap."""
    return lambda speed, gap: follow


def replace_parameters(parameters: AnyIDM, **values: Array) -> IDMArrays:
    """Return the parameters as arrays, with these `values` for some of them."""
    return IDMArrays(*(values.get(name, getattr(parameters, name)) for name in IDM_PARAMETER_NAMES))


def idm_function(parameters: AnyIDM, limits: AccelerationBounds | None = None) -> AccelerationFunction:
    """Return the acceleration function of the IDM; with `limits`, the acceleration is clipped to them [m/s2]."""

    def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, MIN_IDM_GAP), parameters)
        return acceleration if limits is None else clip(acceleration, *limits)

    return follow


def individual_idm(parameters: AnyIDM, headway_weight: Array, limits: AccelerationBounds | None = None) -> DriverModel:
    """Return an IDM whose time headway depends on its initial gap and speed: drivers differ most in their distance.

    The headway is T^(1 - w) T0^w with T of `parameters`, T0 = (gap - s0) / v of the first state, and the weight w.
    """
    p = parameters

    def start(speed: Array, gap: Array) -> AccelerationFunction:
        initial = clip((gap - p.minimum_gap) / clamp_min(speed, MIN_HEADWAY_SPEED), *HEADWAY_LIMITS)
        own = p.time_headway ** (1.0 - headway_weight) * initial**headway_weight
        return idm_function(replace_parameters(p, time_headway=own), limits)

    return start


def add_residual(
    base: DriverModel | None, network: ResidualFunction, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return a driver that adds a network to a base (None: the network alone), within `limits` [m/s2]."""

    def start(speed: Array, gap: Array) -> AccelerationFunction:
        base_function = base(speed, gap) if base is not None else None

        def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
            acceleration = network(residual_inputs(speed, leader_speed, gap))
            if base_function is not None:
                acceleration = acceleration + base_function(speed, leader_speed, gap)
            return acceleration if limits is None else clip(acceleration, *limits)

        return follow

    return start


def follow_leader(follow: AccelerationFunction, start: tuple[Array, Array], leader: Any, step: float) -> Iterator[Any]:
    """Yield the speed [m/s] and the gap [m] of a follower after each step behind a recorded leader.

    A follower that uses up its gap stays in contact with the leader, and is not faster, until it brakes. `start` is its
    speed and gap, (..., n); `leader` speeds [m/s] and paths [m] as in `FollowingTrajectory`, (T, n).
    """
    (speed, gap), (leader_speeds, paths) = start, leader
    position = gap * 0.0
    for leader_speed, next_leader_speed, path in zip(leader_speeds[:-1], leader_speeds[1:], paths[1:], strict=True):
        speed = next_speed(speed, follow(speed, leader_speed, gap), step)
        gap = path - next_position(position, speed, step)
        is_in_contact, xp = gap <= 0.0, namespace(gap)
        gap = clamp_min(gap, 0.0)
        position = path - gap
        speed = xp.where(is_in_contact & (speed > next_leader_speed), next_leader_speed, speed)
        yield speed, gap


class SimulationErrors(NamedTuple):
    """Errors of followers that a driver model drives behind recorded leaders, in n segments."""

    speed_mse: Floats
    """mean squared difference to the recorded speed in each segment [m2/s2], shape (n,)"""
    gap_mse: Floats
    """mean squared difference to the recorded gap in each segment [m2], shape (n,)"""
    has_collided: NDArray[np.bool_]
    """whether the gap became zero in a segment, shape (n,)"""


def simulate_followers(model: DriverModel, segments: Segments) -> SimulationErrors:
    """Simulate a driver model behind the leader of each segment, starting from the first recorded sample."""
    start, is_present, counts = segments.initial_state, segments.is_present, segments.sample_counts
    states = follow_leader(model(*start), start, segments.leader, segments.time_step)
    speed, gap = map(np.stack, zip(start, *states, strict=True))
    speed_mse = (np.square(speed - segments.speed) * is_present).sum(0) / counts
    gap_mse = (np.square(gap - segments.gap) * is_present).sum(0) / counts
    return SimulationErrors(speed_mse, gap_mse, np.any((gap <= 0.0) & is_present, axis=0))
