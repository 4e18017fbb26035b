"""Driving behind a recorded leader: what a model of a driver is worth over a whole trajectory.

One step ahead, errors say little: models that are better there collide more often when they drive on from
their own predictions.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.following.pairs import Floats, Stretches
from unjam.physics.arrays import Array, at_least, clip, namespace
from unjam.physics.idm import PARAMETER_NAMES, IDMParameters, IDMRows, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import residual_inputs

Follow = Callable[[Array, Array, Array], Array]
"""a model of a driver: (own speed, leader's speed, gap) -> acceleration; [m/s], [m] and [m/s2]"""

Model = Callable[[Array, Array], Follow]
"""a driver who takes over: (speed, gap) at that moment -> how it drives on"""

Residual = Callable[[Array], Array]
"""a network: what it sees, shape (..., 3) -> acceleration"""
Bounds = tuple[float, float]
"""lowest and highest acceleration [m/s2]"""

SLOWEST = 2.0
"""speed below which a time headway is not to be told from the gap [m/s]: it counts as this"""
HEADWAYS = (0.2, 6.0)
"""what a time headway may be [s]"""


def always(follow: Follow) -> Model:
    """Return the driver that drives alike wherever it takes over."""
    return lambda speed, gap: follow


def with_values(parameters: IDMParameters | IDMRows, **values: Array) -> IDMRows:
    """Return the parameters with arrays in some places."""
    return IDMRows(*(values.get(name, getattr(parameters, name)) for name in PARAMETER_NAMES))


def idm_follow(parameters: IDMParameters | IDMRows, limits: Bounds | None = None) -> Follow:
    """Return the IDM as a model of a driver, its acceleration kept within `limits` [m/s2]."""

    def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
        found = idm_acceleration(speed, leader_speed, at_least(gap, SMALLEST_GAP), parameters)
        return found if limits is None else clip(found, *limits)

    return follow


def personal_idm(parameters: IDMParameters | IDMRows, kept: Array, limits: Bounds | None = None) -> Model:
    """Return an IDM that keeps a part of the headway with which a driver was found.

    People differ most in the distance they keep. Of a driver nothing is known but the moment of taking over,
    whose time headway T0 = (gap - s0) / v says a part of it: the driver's own T is T^(1 - kept) T0^kept. With
    `kept` 0 all drive alike, with 1 everybody keeps the headway of that moment.
    """
    p = parameters

    def begin(speed: Array, gap: Array) -> Follow:
        found = clip((gap - p.minimum_gap) / at_least(speed, SLOWEST), *HEADWAYS)
        own = p.time_headway ** (1.0 - kept) * found**kept
        return idm_follow(with_values(p, time_headway=own), limits)

    return begin


def with_residual(base: Model | None, network: Residual, limits: Bounds | None = None) -> Model:
    """Return a network on a base, or alone where there is none, kept within `limits` [m/s2]."""

    def begin(speed: Array, gap: Array) -> Follow:
        known = base(speed, gap) if base is not None else None

        def follow(speed: Array, leader_speed: Array, gap: Array) -> Array:
            found = network(residual_inputs(speed, leader_speed, gap))
            if known is not None:
                found = found + known(speed, leader_speed, gap)
            return found if limits is None else clip(found, *limits)

        return follow

    return begin


def drive_behind(follow: Follow, start: tuple[Array, Array], leader: Any, step: float) -> Iterator[Any]:
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
        gap = at_least(gap, 0.0)
        position = paths[moment + 1] - gap
        speed = xp.where(touches & (speed > leader_speeds[moment + 1]), leader_speeds[moment + 1], speed)
        yield speed, gap


@dataclass(frozen=True, eq=False)
class DrivenBehind:
    """How a model drove behind recorded leaders, beside those who really did; n stretches of T moments."""

    speed: Floats
    """[m/s], shape (T, n)"""
    gap: Floats
    """[m], shape (T, n)"""
    speed_square: Floats
    """mean squared error of the speed, of each stretch, shape (n,)"""
    gap_square: Floats
    """mean squared error of the gap, shape (n,)"""
    collided: NDArray[np.bool_]
    """whether the gap was used up, shape (n,)"""
    moments: NDArray[np.int64]
    """moments of each stretch but the first, shape (n,)"""


def open_loop(model: Model, stretches: Stretches) -> DrivenBehind:
    """Drive behind the leader of each stretch from its first moment on, and compare with the follower."""
    start, present, moments = stretches.start, stretches.present, stretches.moments
    driven = drive_behind(model(*start), start, stretches.leader, stretches.step)
    speed, gap = map(np.stack, zip(start, *driven, strict=True))
    return DrivenBehind(
        speed,
        gap,
        (np.square(speed - stretches.speed) * present).sum(0) / moments,
        (np.square(gap - stretches.gap) * present).sum(0) / moments,
        np.any((gap <= 0.0) & present, axis=0),
        moments,
    )


def one_step_error(model: Model, stretches: Stretches) -> Floats:
    """Return the mean squared error of the acceleration until the next moment [(m/s2)2], shape (n,)."""
    predicted = model(*stretches.start)(stretches.speed[:-1], stretches.leader_speed[:-1], stretches.gap[:-1])
    error = predicted - np.diff(stretches.speed, axis=0) / stretches.step
    return (np.square(error) * stretches.present[1:]).sum(0) / stretches.moments
