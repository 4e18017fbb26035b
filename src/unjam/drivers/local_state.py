"""What a CAV perceives, in every world."""

from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple

from unjam.physics.arrays import Array


class LocalState(NamedTuple):
    """The surroundings of n CAVs, one row each; NumPy arrays or torch tensors of shape (n,), SI units.

    Drivers that take plain numbers (`Driver.accepts_floats`) may also be given floats, for a single CAV.

    Where nobody is ahead (or behind), the gap is `MAX_OBSERVED_GAP` and the leader (follower) as fast as the CAV.
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

    # What only some roads offer; None elsewhere.

    distance_to_crossing: Array = None
    """how far ahead a closed road next crosses itself [m]"""
    allowed_speed: Array = None
    """as fast as it may and wants to drive here [m/s]"""
    distance_to_merge: Array = None
    """how far ahead a ramp's lane begins to run beside the road [m]; negative behind it"""
    lane_speeds: Array = None
    """mean speeds in its own lane of the sections of `ROAD_SECTION_LENGTH` metres ahead, its own first, as a message
    said: (n, SECTIONS_AHEAD) [m/s]; where nobody is, what is allowed"""
    road_speeds: Array = None
    """the same over all lanes of the main road"""
    adjacent_gaps: Array = None
    """gaps to those on the lanes beside it, as in `BESIDE`: (n, 4) [m]; negative alongside, `MAX_OBSERVED_GAP`
    where nobody or no lane is. Before a ramp joins, its vehicles are on the lane that it becomes"""
    adjacent_speeds: Array = None
    """their speeds [m/s]; its own where nobody is"""
    penetration_rate: Array = None
    """how many of all that have entered so far are CAVs, as a roadside service counts"""
    congestion: Array = None
    """whether the sections of `lane_speeds` are congested, as a service reports: (n, SECTIONS_AHEAD);
    1 or 0, between these where messages are smoothed"""

    def map(self, function: Callable[..., Any], *others: "LocalState") -> "LocalState":
        """Return `function` of each quantity, and of the same quantity of the other states."""
        return LocalState(
            *(None if values[0] is None else function(*values) for values in zip(self, *others, strict=True))
        )

    def select(self, index: Any) -> "LocalState":
        """Return the state of some rows or moments, as an array's `index` says."""
        return self.map(lambda values: values[index])

    def as_read_only(self) -> "LocalState":
        """Return a copy of arrays that cannot be changed; by force they can, and this one stays as it is."""
        copy = self.map(lambda values: values.copy())
        for values in copy:
            if values is not None:
                values.flags.writeable = False
        return copy


MAX_OBSERVED_GAP = 100.0
"""The gap that stands for `nobody there` [m]."""

ROAD_SECTION_LENGTH = 100.0
"""of a road whose mean speeds are told [m]"""
SECTIONS_AHEAD = 11

SPEED_SCALE = 10.0
"""what speeds are divided by before a network sees them [m/s]"""

_FIELD_UNITS = ("m/s", "m/s", "m", "m/s", "m", "m", "m", "m", "m/s", "m", "m/s", "m/s", "m", "m/s", "", "")
STATE_UNITS = dict(zip(LocalState._fields, _FIELD_UNITS, strict=True))
"""units of a `LocalState`, in its order"""


COMMON_FIELDS = tuple(name for name in LocalState._fields if name not in LocalState._field_defaults)
"""what every road offers"""
ADJACENT_POSITIONS = ("ahead on the left", "behind on the left", "ahead on the right", "behind on the right")
FIELD_SIZES = {
    "lane_speeds": SECTIONS_AHEAD,
    "road_speeds": SECTIONS_AHEAD,
    "congestion": SECTIONS_AHEAD,
    "adjacent_gaps": len(ADJACENT_POSITIONS),
    "adjacent_speeds": len(ADJACENT_POSITIONS),
}
"""what has several numbers for each CAV, and how many"""


def state_of_ones(names: Sequence[str], make_ones: Callable[..., Any], rows: int = 1) -> LocalState:
    """Return a state of which `names` are there, all ones: for drivers that are asked what they answer."""
    shapes = {name: (rows, FIELD_SIZES[name]) if name in FIELD_SIZES else (rows,) for name in names}
    return LocalState(**{name: make_ones(shape) for name, shape in shapes.items()})


class ScaledInput(NamedTuple):
    """One number that a network sees: a quantity divided by a fixed scale."""

    name: str
    scale: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} / {self.scale:g} {self.unit}".strip()


def lap_angle(state: LocalState) -> Array:
    """Return the place on a closed road as an angle, 0 to 2 pi from its start, shape (n,)."""
    return 2.0 * pi * state.route_position / state.loop_length
