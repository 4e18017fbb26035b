"""The observation of a CAV, the same in every world."""

from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple

from unjam.physics.arrays import Array, namespace


class LocalState(NamedTuple):
    """The speeds and positions of n CAVs and their neighbors: NumPy arrays or torch tensors of shape (n,), SI units.

    Drivers that do not need arrays may also receive floats, for a single CAV. Without a vehicle ahead (or
    behind), the gap is `MAX_OBSERVED_GAP` and the speed of the leader (follower) is that of the CAV.
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
    """own front bumper along the route [m]; NaN on roads without a coordinate"""
    loop_length: Array
    """length of the closed road [m]; NaN on an open road"""

    # Fields that only some roads provide; None elsewhere.

    distance_to_crossing: Array = None
    """distance to the next crossing of a closed road with itself [m]"""
    allowed_speed: Array = None
    """speed limit at the current position times the speed factor of the vehicle [m/s]"""
    distance_to_merge: Array = None
    """distance to the point where the lane of a ramp begins to run next to the road [m]; negative after this point"""
    lane_speeds: Array = None
    """last received mean speeds of the sections of the own lane, from the own section on: shape (n, SECTIONS_AHEAD)
    [m/s]; the allowed speed for sections without vehicles"""
    road_speeds: Array = None
    """mean speeds of the same sections, over all lanes of the main road [m/s]"""
    adjacent_gaps: Array = None
    """gaps to vehicles on adjacent lanes in the order of `ADJACENT_POSITIONS`, shape (n, 4) [m]: negative to vehicles
    alongside, `MAX_OBSERVED_GAP` without a vehicle or lane; before a merge, the ramp counts as the lane next to it"""
    adjacent_speeds: Array = None
    """speeds of these vehicles [m/s]; the own speed without a vehicle"""
    penetration_rate: Array = None
    """share of CAVs among all vehicles that have entered so far, as counted by a roadside service"""
    congestion: Array = None
    """1 for sections of `lane_speeds` that a roadside service reports as congested, else 0, shape (n, SECTIONS_AHEAD);
    in between if messages are smoothed"""

    def map(self, function: Callable[..., Any], *other_states: "LocalState") -> "LocalState":
        """Return a state with `function` of each field and the same field of the other states; None stays None."""
        field_values = zip(self, *other_states, strict=True)
        return LocalState(*(None if values[0] is None else function(*values) for values in field_values))

    def select(self, index: Any) -> "LocalState":
        """Return the state of some rows or steps; `index` is any array index."""
        return self.map(lambda array: array[index])

    def as_read_only(self) -> "LocalState":
        """Return a copy with write-protected arrays."""
        copy = self.map(lambda array: array.copy())
        for array in copy:
            if array is not None:
                array.flags.writeable = False
        return copy


MAX_OBSERVED_GAP = 100.0
"""largest observed gap, also reported without a vehicle [m]"""
ROAD_SECTION_LENGTH = 100.0
"""length of the road sections with measured mean speeds [m]"""
SECTIONS_AHEAD = 11
"""number of these sections that a CAV receives"""
SPEED_SCALE = 10.0
"""divisor of speeds in network inputs [m/s]"""

_FIELD_UNITS = ("m/s", "m/s", "m", "m/s", "m", "m", "m", "m", "m/s", "m", "m/s", "m/s", "m", "m/s", "", "")
STATE_UNITS = dict(zip(LocalState._fields, _FIELD_UNITS, strict=True))
"""units of the fields of `LocalState`"""
COMMON_FIELDS = tuple(name for name in LocalState._fields if name not in LocalState._field_defaults)
"""fields that every road provides"""
ADJACENT_POSITIONS = ("ahead on the left", "behind on the left", "ahead on the right", "behind on the right")
"""positions of neighbors on adjacent lanes"""
FIELD_SIZES = {
    **dict.fromkeys(("lane_speeds", "road_speeds", "congestion"), SECTIONS_AHEAD),
    **dict.fromkeys(("adjacent_gaps", "adjacent_speeds"), len(ADJACENT_POSITIONS)),
}
"""count of numbers per CAV, for fields with several numbers"""


def state_of_ones(names: Sequence[str], make_ones: Callable[..., Any], rows: int = 1) -> LocalState:
    """Return an example state with arrays of ones in the fields `names`; `make_ones` is like `numpy.ones`."""
    shapes = {name: (rows, FIELD_SIZES[name]) if name in FIELD_SIZES else (rows,) for name in names}
    return LocalState(**{name: make_ones(shape) for name, shape in shapes.items()})


def observe_neighbor(is_present: Array, gap: Array, speed: Array, own_speed: Array) -> tuple[Array, Array]:
    """Return speed and gap of neighbors as CAVs observe them; neighbors beyond `MAX_OBSERVED_GAP` count as missing."""
    xp, is_near = namespace(gap), is_present & (gap < MAX_OBSERVED_GAP)
    return xp.where(is_near, speed, own_speed), xp.where(is_near, gap, MAX_OBSERVED_GAP)


class ScaledInput(NamedTuple):
    """The description of one input of a network: a quantity divided by a fixed scale."""

    name: str
    scale: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} / {self.scale:g} {self.unit}".strip()


def lap_angle(state: LocalState) -> Array:
    """Return the position on a closed road as an angle, from 0 at its start to 2 pi, shape (n,)."""
    return 2.0 * pi * state.route_position / state.loop_length
