"""Open-loop simulation of driver models behind recorded leaders.

One-step errors say little: models with smaller ones collide more often when they drive from their own predictions.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.following.pairs import Floats, Segments
from unjam.physics.arrays import Array, clamp_min, clip, namespace
from unjam.physics.idm import IDM_PARAMETER_NAMES, IDMArrays, IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import residual_inputs

AccelerationFunction = Callable[[Array, Array, Array], Array]
"""from own speed, leader speed and gap to the acceleration; [m/s], [m] and [m/s2]"""
DriverModel = Callable[[Array, Array], AccelerationFunction]
"""a driver that takes over: from speed and gap at that moment to how it drives on"""
ResidualFunction = Callable[[Array], Array]
"""a network: from inputs, shape (..., 3), to the acceleration"""
AnyIDM = IDMParameters | IDMArrays
AccelerationBounds = tuple[float, float]
"""lowest and highest acceleration [m/s2]"""

MIN_HEADWAY_SPEED = 2.0
"""minimum speed in the estimation of a time headway, which slow driving does not reveal [m/s]"""
HEADWAY_LIMITS = (0.2, 6.0)
"""of estimated time headways [s]"""


def fixed_driver(follow: AccelerationFunction) -> DriverModel:
    """Return a driver that drives the same wherever it takes over."""
    return lambda speed, gap: follow


def replace_parameters(parameters: AnyIDM, **values: Array) -> IDMArrays:
    """Return the parameters with arrays for some of them."""
    return IDMArrays(*(values.get(name, getattr(parameters, name)) for name in IDM_PARAMETER_NAMES))


def idm_function(parameters: AnyIDM, limits: AccelerationBounds | None = None) -> AccelerationFunction:
    """Return the IDM as a function, with its acceleration within `limits` [m/s2]."""

    def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, MIN_IDM_GAP), parameters)
        return acceleration if limits is None else clip(acceleration, *limits)

    return follow


def individual_idm(
    parameters: AnyIDM, initial_headway_weight: Array, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return an IDM that keeps a part of the time headway at which it takes over.

    Human drivers differ most in their distance, of which a model only knows the headway T0 = (gap - s0) / v at that
    moment. The driver's own headway is T^(1 - w) T0^w: with the initial headway weight w = 0 all drivers are equal.
    """
    p = parameters

    def take_over(speed: Array, gap: Array) -> AccelerationFunction:
        initial = clip((gap - p.minimum_gap) / clamp_min(speed, MIN_HEADWAY_SPEED), *HEADWAY_LIMITS)
        own = p.time_headway ** (1.0 - initial_headway_weight) * initial**initial_headway_weight
        return idm_function(replace_parameters(p, time_headway=own), limits)

    return take_over


def add_residual(
    base: DriverModel | None, network: ResidualFunction, limits: AccelerationBounds | None = None
) -> DriverModel:
    """Return a base with a network as its residual, or the network alone, within `limits` [m/s2]."""

    def take_over(speed: Array, gap: Array) -> AccelerationFunction:
        base_function = base(speed, gap) if base is not None else None

        def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
            acceleration = network(residual_inputs(speed, leader_speed, gap))
            if base_function is not None:
                acceleration = acceleration + base_function(speed, leader_speed, gap)
            return acceleration if limits is None else clip(acceleration, *limits)

        return follow

    return take_over


def follow_leader(follow: AccelerationFunction, start: tuple[Array, Array], leader: Any, step: float) -> Iterator[Any]:
    """Yield speed and gap after each step behind a recorded leader.

    A vehicle that uses up its gap touches the leader and drives at most at its speed until it brakes: data contain no
    states inside a leader, on which a network could act. `start` is speed [m/s] and gap [m], shape (..., n); `leader`
    is speeds and paths as in `Pair`, shape (T, n); `step` is the time between two moments [s].
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
    """A model behind recorded leaders, compared with the recorded followers; n segments of T moments."""

    speed: Floats
    """[m/s], shape (T, n)"""
    gap: Floats
    """[m], shape (T, n)"""
    speed_mse: Floats
    """mean squared error of the speed in each segment, shape (n,)"""
    gap_mse: Floats
    """mean squared error of the gap, shape (n,)"""
    has_collided: NDArray[np.bool_]
    """whether the gap was used up, shape (n,)"""
    sample_counts: NDArray[np.int64]
    """number of moments of each segment after the first, shape (n,)"""


def simulate_open_loop(model: DriverModel, segments: Segments) -> OpenLoopResult:
    """Simulate a model behind the leader of each segment from its first moment on."""
    start, is_present, counts = segments.start, segments.is_present, segments.sample_counts
    states = follow_leader(model(*start), start, segments.leader, segments.step)
    speed, gap = map(np.stack, zip(start, *states, strict=True))
    speed_mse = (np.square(speed - segments.speed) * is_present).sum(0) / counts
    gap_mse = (np.square(gap - segments.gap) * is_present).sum(0) / counts
    return OpenLoopResult(speed, gap, speed_mse, gap_mse, np.any((gap <= 0.0) & is_present, axis=0), counts)


def one_step_error(model: DriverModel, segments: Segments) -> Floats:
    """Return the mean squared error of the acceleration until the next moment [(m/s2)2], shape (n,)."""
    predicted = model(*segments.start)(segments.speed[:-1], segments.leader_speed[:-1], segments.gap[:-1])
    error = predicted - np.diff(segments.speed, axis=0) / segments.step
    return (np.square(error) * segments.is_present[1:]).sum(0) / segments.sample_counts
