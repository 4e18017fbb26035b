"""What a CAV perceives, in every world."""

from collections.abc import Callable
from math import pi
from typing import Any, NamedTuple

from unjam.physics.arrays import Array


class LocalState(NamedTuple):
    """The surroundings of n CAVs, one row each; NumPy arrays or torch tensors of shape (n,), SI units.

    Drivers that take plain numbers (`Driver.plain_numbers`) may also be given floats, for a single CAV.

    Where nobody is ahead (or behind), the gap is `LARGEST_GAP` and the leader (follower) as fast as the CAV.
    """

    speed: Array
    """own speed [m/s]"""
    leader_speed: Array
    """speed of the vehicle ahead [m/s]"""
    leader_gap: Array
    """own front bumper to the leader's rear bumper [m]"""
    follower_speed: Array
    """speed of the vehicle behind [m/s]"""
    follower_gap: Array
    """the follower's front bumper to own rear bumper [m]"""
    route_position: Array
    """own front bumper along the route [m]; NaN where the road has no coordinate of its own"""
    loop_length: Array
    """length of the closed road [m]; NaN on an open one"""

    def each(self, function: Callable[..., Any], *others: "LocalState") -> "LocalState":
        """Return `function` of each quantity, and of the same quantity of the other states."""
        return LocalState(*map(function, self, *others))


LARGEST_GAP = 100.0
"""The gap that stands for `nobody there` [m]."""

SPEED_SCALE = 10.0
"""what speeds are divided by before a network sees them [m/s]"""

STATE_UNITS = dict(zip(LocalState._fields, ("m/s", "m/s", "m", "m/s", "m", "m", "m"), strict=True))
"""units of a `LocalState`, in its order"""


class Observed(NamedTuple):
    """One number that a network sees: a quantity divided by a fixed scale."""

    name: str
    scale: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} / {self.scale:g} {self.unit}".strip()


def lap_angle(state: LocalState) -> Array:
    """Return the place on a closed road as an angle, 0 to 2 pi from its start, shape (n,)."""
    return 2.0 * pi * state.route_position / state.loop_length
