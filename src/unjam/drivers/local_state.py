"""What a CAV perceives, and the vector of numbers that a network sees of it: one place for both worlds."""

from math import pi
from typing import Literal, NamedTuple

from unjam.physics.arrays import Array, namespace, stack_columns


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


LARGEST_GAP = 100.0
"""The gap that stands for `nobody there` [m]."""

SPEED_SCALE = 10.0
RELATIVE_SPEED_SCALE = 5.0
GAP_SCALE = 20.0
ACCELERATION_SCALE = 1.0
LOOP_LENGTH_SCALE = 250.0
ROUTE_POSITION_SCALE = 100.0

ObservationPart = Literal[
    "local", "expert_acceleration", "expert_memory", "loop_length", "place", "route_position"
]
"""Parts of an observation: the paper's five numbers; the expert's acceleration; what the expert remembers;
the length of the closed road; the place on it; the position along a road with ends."""

STATE_UNITS = {
    "speed": "m/s",
    "leader_speed": "m/s",
    "leader_gap": "m",
    "follower_speed": "m/s",
    "follower_gap": "m",
    "route_position": "m",
    "loop_length": "m",
}
"""units of a `LocalState`, in its order"""


class Observed(NamedTuple):
    """One number that a network sees: a quantity divided by a fixed scale."""

    name: str
    scale: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} / {self.scale:g} {self.unit}".strip()


OBSERVED: dict[str, tuple[Observed, ...]] = {
    "local": (
        Observed("own speed", SPEED_SCALE, "m/s"),
        Observed("leader's speed - own", RELATIVE_SPEED_SCALE, "m/s"),
        Observed("gap to the leader", GAP_SCALE, "m"),
        Observed("follower's speed - own", RELATIVE_SPEED_SCALE, "m/s"),
        Observed("gap to the follower", GAP_SCALE, "m"),
    ),
    "expert_acceleration": (Observed("expert's acceleration", ACCELERATION_SCALE, "m/s2"),),
    "loop_length": (Observed("length of the closed road", LOOP_LENGTH_SCALE, "m"),),
    "place": (Observed("cosine of the place on the lap", 1.0, ""), Observed("sine of the same", 1.0, "")),
    "route_position": (Observed("position along the road", ROUTE_POSITION_SCALE, "m"),),
}
"""what each part of an observation holds, in order; what an expert remembers is its own to say"""


def lap_angle(state: LocalState) -> Array:
    """Return the place on a closed road as an angle, 0 to 2 pi from its start, shape (n,)."""
    return 2.0 * pi * state.route_position / state.loop_length


def lap_place(state: LocalState) -> Array:
    """Return cosine and sine of the place on a closed road, 0 to 2 pi from its start.

    Returns:
        Shape (n, 2), no unit; a tuple of two for plain numbers.
    """
    xp = namespace(state.speed)
    angle = lap_angle(state)
    return stack_columns((xp.cos(angle), xp.sin(angle)))


def local_vector(state: LocalState) -> Array:
    """Return the paper's observation: five numbers a row, divided by fixed physical scales.

    Own speed; relative speed and gap to the leader; relative speed and gap to the follower.
    Relative speeds are the other's minus the own; gaps are bumper to bumper.

    Returns:
        Shape (n, 5), no unit; a tuple of five for plain numbers.
    """
    return stack_columns(
        (
            state.speed / SPEED_SCALE,
            (state.leader_speed - state.speed) / RELATIVE_SPEED_SCALE,
            state.leader_gap / GAP_SCALE,
            (state.follower_speed - state.speed) / RELATIVE_SPEED_SCALE,
            state.follower_gap / GAP_SCALE,
        )
    )
