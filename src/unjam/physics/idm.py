"""The Intelligent Driver Model (Treiber, Hennecke, Helbing 2000): car following of human drivers."""

from collections.abc import Callable, Sequence
from functools import cached_property
from math import sqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from unjam.parameters import STRICT, Positive, Subclassable, parameter_dataclass
from unjam.physics.arrays import Array, clamp_min, square_root


@parameter_dataclass(frozen=True, config=STRICT)
class IDMParameters(Subclassable):
    """Parameters of the Intelligent Driver Model; the defaults are Table B1 of the paper."""

    desired_speed: Positive = 30.0
    """v0 [m/s]"""
    time_headway: Positive = 1.0
    """T [s]"""
    max_acceleration: Positive = 1.0
    """a [m/s2]"""
    comfortable_deceleration: Positive = 1.5
    """b [m/s2]"""
    exponent: Annotated[float, Field(ge=0.1)] = 4.0
    """delta; smaller values allow no computation of equilibria"""
    minimum_gap: Positive = 2.0
    """s0 [m], bumper-to-bumper gap at standstill"""

    @cached_property
    def interaction_scale(self) -> float:
        """2 sqrt(a b) of Eq. 6 [m/s2], cached for use in every step of a simulator."""
        return 2.0 * square_root(self.max_acceleration * self.comfortable_deceleration)


class IDMArrays(NamedTuple):
    """The parameters of many drivers, as in `IDMParameters`: arrays that broadcast with the states."""

    desired_speed: Array
    time_headway: Array
    max_acceleration: Array
    comfortable_deceleration: Array
    exponent: Array
    minimum_gap: Array

    @property
    def interaction_scale(self) -> Array:
        """2 sqrt(a b) of Eq. 6 [m/s2]."""
        return 2.0 * square_root(self.max_acceleration * self.comfortable_deceleration)


PAPER_IDM = IDMParameters()
IDM_PARAMETER_NAMES = IDMArrays._fields
BISECTION_STEPS = 60  # number of bisections that make an equilibrium speed exact to the last bit


def stack_idm_parameters(drivers: Sequence[IDMParameters]) -> IDMArrays:
    """Return the parameters of `drivers` as arrays of shape (drivers,)."""
    return IDMArrays(**{name: np.array([getattr(driver, name) for driver in drivers]) for name in IDM_PARAMETER_NAMES})


def desired_gap(speed: Array, approach_rate: Array, parameters: IDMParameters | IDMArrays = PAPER_IDM) -> Array:
    """Return the desired bumper-to-bumper gap s* [m] (Eq. 6); `approach_rate` is speed minus leader speed [m/s]."""
    p = parameters
    return p.minimum_gap + clamp_min(speed * p.time_headway + speed * approach_rate / p.interaction_scale, 0.0)


def fast_power(base: Array, exponent: Array) -> Array:
    """Return `base` to the power of `exponent`; fourth powers are 50 times faster than `pow`, up to rounding."""
    if type(exponent) is float and exponent == 4.0:
        square = base * base
        return square * square
    return base**exponent


def idm_acceleration(
    speed: Array,
    leader_speed: Array,
    gap: Array,
    parameters: IDMParameters | IDMArrays = PAPER_IDM,
    power: Callable[[Array, Array], Array] = pow,
) -> Array:
    """Return the acceleration of a driver behind a leader [m/s2] (Eq. 5), unbounded below as the gap closes.

    Speeds [m/s] and bumper-to-bumper gaps [m], which must be positive, have the same shape. `parameters` are those of
    one driver or of each row. `power` computes powers: `pow` or `fast_power`.
    """
    p = parameters
    free_road = power(speed / p.desired_speed, p.exponent)
    interaction = (desired_gap(speed, speed - leader_speed, p) / gap) ** 2
    return p.max_acceleration * (1.0 - free_road - interaction)


def desired_speed_from_acceleration(
    acceleration: Array, speed: Array, parameters: IDMParameters | IDMArrays = PAPER_IDM
) -> Array:
    """Return the desired speed [m/s] of a driver without a leader, given the acceleration (Eq. 5)."""
    return speed / (1.0 - acceleration / parameters.max_acceleration) ** (1.0 / parameters.exponent)


def equilibrium_gap(speed: float, parameters: IDMParameters = PAPER_IDM) -> float:
    """Return the gap of a platoon at constant `speed`, in [0, v0) m/s, without acceleration [m] (Eq. 5)."""
    p = parameters
    if not 0 <= speed < p.desired_speed:
        raise ValueError(f"speed {speed} m/s has no equilibrium gap: it must be in [0, {p.desired_speed})")
    return (p.minimum_gap + speed * p.time_headway) / sqrt(1.0 - (speed / p.desired_speed) ** p.exponent)


def equilibrium_speed(gap: float, parameters: IDMParameters = PAPER_IDM) -> float:
    """Return the inverse of `equilibrium_gap` [m/s]; 0 if the gap is not above the minimum gap."""
    if gap <= parameters.minimum_gap:
        return 0.0
    low, high = 0.0, parameters.desired_speed
    # Importing a root finder of scipy would add half a second to the start of a worker.
    for _ in range(BISECTION_STEPS):
        middle = (low + high) / 2.0
        if equilibrium_gap(middle, parameters) < gap:
            low = middle
        else:
            high = middle
    return low
