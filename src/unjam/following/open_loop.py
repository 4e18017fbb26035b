"""Driving behind a recorded leader: what a model of a driver is worth over a whole trajectory.

One step ahead, errors say little: models that are better there collide more often when they drive on from
their own predictions.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import _MIN_GAP
from unjam.following.pairs import Floats, Segments
from unjam.physics.arrays import Array, clamp_min, clip, namespace
from unjam.physics.idm import IDM_PARAMETER_NAMES, IDMArrays, IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import residual_inputs

AccelerationFunction = Callable[[Array, Array, Array], Array]
"""a model of a driver: (own speed, leader's speed, gap) -> acceleration; [m/s], [m] and [m/s2]"""

DriverModel = Callable[[Array, Array], AccelerationFunction]
"""a driver who takes over: (speed, gap) at that moment -> how it drives on"""

ResidualFunction = Callable[[Array], Array]
"""a network: what it sees, shape (..., 3) -> acceleration"""
AccelerationBounds = tuple[float, float]
"""lowest and highest acceleration [m/s2]"""

MIN_HEADWAY_SPEED = 2.0
"""speed below which a time headway is not to be told from the gap [m/s]: it counts as this"""
HEADWAY_LIMITS = (0.2, 6.0)
"""what a time headway may be [s]"""


def fixed_driver(follow: AccelerationFunction) -> DriverModel:
    """Return the driver that drives alike wherever it takes over."""
    return lambda speed, gap: follow


def replace_parameters(parameters: IDMParameters | IDMArrays, **values: Array) -> IDMArrays:
    """Return the parameters with arrays in some places."""
    return IDMArrays(*(values.get(name, getattr(parameters, name)) for name in IDM_PARAMETER_NAMES))


def idm_function(
    parameters: IDMParameters | IDMArrays, limits: AccelerationBounds | None = None
) -> AccelerationFunction:
    """Return the IDM as a model of a driver, its acceleration kept within `limits` [m/s2]."""

    def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
        found = idm_acceleration(speed, leader_speed, clamp_min(gap, _MIN_GAP), parameters)
        return found if limits is None else clip(found, *limits)

    return follow


def individual_idm(
    parameters: IDMParameters | IDMArrays, initial_headway_weight: Array, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return an IDM that keeps a part of the headway with which a driver was found.

    People differ most in the distance they keep. Of a driver nothing is known but the moment of taking over,
    whose time headway T0 = (gap - s0) / v says a part of it: the driver's own T is T^(1 - kept) T0^kept. With
    `remaining_rows` 0 all drive alike, with 1 everybody keeps the headway of that moment.
    """
    p = parameters

    def take_over(speed: Array, gap: Array) -> AccelerationFunction:
        found = clip((gap - p.minimum_gap) / clamp_min(speed, MIN_HEADWAY_SPEED), *HEADWAY_LIMITS)
        own = p.time_headway ** (1.0 - initial_headway_weight) * found**initial_headway_weight
        return idm_function(replace_parameters(p, time_headway=own), limits)

    return take_over


def add_residual(
    base: DriverModel | None, network: ResidualFunction, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return a network on a base, or alone where there is none, kept within `limits` [m/s2]."""

    def take_over(speed: Array, gap: Array) -> AccelerationFunction:
        known = base(speed, gap) if base is not None else None

        def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
            found = network(residual_inputs(speed, leader_speed, gap))
            if known is not None:
                found = found + known(speed, leader_speed, gap)
            return found if limits is None else clip(found, *limits)

        return follow

    return take_over


def follow_leader(follow: AccelerationFunction, start: tuple[Array, Array], leader: Any, step: float) -> Iterator[Any]:
    """Yield (speed, gap) after each step of driving behind a recorded leader.

    Who uses the gap up touches the leader and is no faster, until it brakes: without that, a network that has
    driven through its leader would be asked what nobody can know.

    Starts are a speed [m/s] and a gap [m], shape (..., n); leaders (speeds, paths), each of shape (T, n),
    paths as in `Pair.leader_path`; `step` lies between two moments [s].
    """
    (speed, gap), (leader_speeds, paths) = start, leader
    position = gap * 0.0
    for moment in range(len(paths) - 1):
        acceleration = follow(speed, leader_speeds[moment], gap)
        speed = next_speed(speed, acceleration, step)
        position = next_position(position, speed, step)
        gap = paths[moment + 1] - position
        touches, xp = gap <= 0.0, namespace(gap)
        gap = clamp_min(gap, 0.0)
        position = paths[moment + 1] - gap
        speed = xp.where(touches & (speed > leader_speeds[moment + 1]), leader_speeds[moment + 1], speed)
        yield speed, gap


@dataclass(frozen=True, eq=False)
class OpenLoopResult:
    """How a model drove behind recorded leaders, beside those who really did; n stretches of T moments."""

    speed: Floats
    """[m/s], shape (T, n)"""
    gap: Floats
    """[m], shape (T, n)"""
    speed_mse: Floats
    """mean squared error of the speed, of each stretch, shape (n,)"""
    gap_mse: Floats
    """mean squared error of the gap, shape (n,)"""
    has_collided: NDArray[np.bool_]
    """whether the gap was used up, shape (n,)"""
    sample_counts: NDArray[np.int64]
    """moments of each stretch but the first, shape (n,)"""


def simulate_open_loop(model: DriverModel, segments: Segments) -> OpenLoopResult:
    """Drive behind the leader of each stretch from its first moment on, and compare with the follower."""
    start, present, moments = segments.start, segments.is_present, segments.sample_counts
    driven = follow_leader(model(*start), start, segments.leader, segments.step)
    speed, gap = map(np.stack, zip(start, *driven, strict=True))
    return OpenLoopResult(
        speed,
        gap,
        (np.square(speed - segments.speed) * present).sum(0) / moments,
        (np.square(gap - segments.gap) * present).sum(0) / moments,
        np.any((gap <= 0.0) & present, axis=0),
        moments,
    )


def one_step_error(model: DriverModel, segments: Segments) -> Floats:
    """Return the mean squared error of the acceleration until the next moment [(m/s2)2], shape (n,)."""
    predicted = model(*segments.start)(segments.speed[:-1], segments.leader_speed[:-1], segments.gap[:-1])
    error = predicted - np.diff(segments.speed, axis=0) / segments.step
    return (np.square(error) * segments.is_present[1:]).sum(0) / segments.sample_counts
