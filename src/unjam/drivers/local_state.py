"""The observation of a CAV, the same in every world."""

from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple

from unjam.physics.arrays import Array, namespace


class LocalState(NamedTuple):
    """The surroundings of n CAVs, one row each; NumPy arrays or torch tensors of shape (n,), SI units.

    Drivers that do not need arrays may also be given floats, for a single CAV. Without a vehicle ahead (or
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
    """length of the closed road [m]; NaN on an open one"""

    # Fields that only some roads provide; None elsewhere.

    distance_to_crossing: Array = None
    """distance to the next crossing of a closed road with itself [m]"""
    allowed_speed: Array = None
    """speed limit at the current position times the speed factor of the vehicle [m/s]"""
    distance_to_merge: Array = None
    """distance to the point where the lane of a ramp begins to run next to the road [m]; negative behind it"""
    lane_speeds: Array = None
    """last received mean speeds of the road sections ahead in the own lane, beginning with the own section:
    (n, SECTIONS_AHEAD) [m/s]; empty sections have the allowed speed"""
    road_speeds: Array = None
    """mean speeds of the same sections, over all lanes of the main road [m/s]"""
    adjacent_gaps: Array = None
    """gaps to vehicles on adjacent lanes, ordered as `ADJACENT_POSITIONS`: (n, 4) [m]; negative for vehicles alongside,
    `MAX_OBSERVED_GAP` without a vehicle or lane. Before a merge, the ramp counts as the lane that it becomes"""
    adjacent_speeds: Array = None
    """speeds of these vehicles [m/s]; the own speed where there is none"""
    penetration_rate: Array = None
    """share of CAVs among all vehicles that have entered so far, as counted by a roadside service"""
    congestion: Array = None
    """1 where a roadside service reports a section of `lane_speeds` as congested, else 0: (n, SECTIONS_AHEAD); values
    between these where messages are smoothed"""

    def map(self, function: Callable[..., Any], *others: "LocalState") -> "LocalState":
        """Return `function` applied to each field, together with the same field of the other states."""
        return LocalState(
            *(None if values[0] is None else function(*values) for values in zip(self, *others, strict=True))
        )

    def select(self, index: Any) -> "LocalState":
        """Return the state of some rows or steps; `index` is any array index."""
        return self.map(lambda values: values[index])

    def as_read_only(self) -> "LocalState":
        """Return a copy with write-protected arrays."""
        copy = self.map(lambda values: values.copy())
        for values in copy:
            if values is not None:
                values.flags.writeable = False
        return copy


MAX_OBSERVED_GAP = 100.0
"""the largest observed gap, which also stands for "no vehicle" [m]"""
ROAD_SECTION_LENGTH = 100.0
"""length of the road sections with measured mean speeds [m]"""
SECTIONS_AHEAD = 11
SPEED_SCALE = 10.0
"""divisor of speeds in network inputs [m/s]"""

_FIELD_UNITS = ("m/s", "m/s", "m", "m/s", "m", "m", "m", "m", "m/s", "m", "m/s", "m/s", "m", "m/s", "", "")
STATE_UNITS = dict(zip(LocalState._fields, _FIELD_UNITS, strict=True))
"""units of the fields of `LocalState`"""
COMMON_FIELDS = tuple(name for name in LocalState._fields if name not in LocalState._field_defaults)
"""fields that every road provides"""
ADJACENT_POSITIONS = ("ahead on the left", "behind on the left", "ahead on the right", "behind on the right")
FIELD_SIZES = {
    **dict.fromkeys(("lane_speeds", "road_speeds", "congestion"), SECTIONS_AHEAD),
    **dict.fromkeys(("adjacent_gaps", "adjacent_speeds"), len(ADJACENT_POSITIONS)),
}
"""numbers per CAV of the fields that have several"""


def state_of_ones(names: Sequence[str], make_ones: Callable[..., Any], rows: int = 1) -> LocalState:
    """Return a state in which the fields `names` are ones, as an example input for drivers."""
    shapes = {name: (rows, FIELD_SIZES[name]) if name in FIELD_SIZES else (rows,) for name in names}
    return LocalState(**{name: make_ones(shape) for name, shape in shapes.items()})


def observe_neighbor(is_present: Array, gap: Array, speed: Array, own_speed: Array) -> tuple[Array, Array]:
    """Return speed and gap of neighbors as CAVs observe them; those beyond `MAX_OBSERVED_GAP` count as missing."""
    xp, is_near = namespace(gap), is_present & (gap < MAX_OBSERVED_GAP)
    return xp.where(is_near, speed, own_speed), xp.where(is_near, gap, MAX_OBSERVED_GAP)


class ScaledInput(NamedTuple):
    """One input of a network: a quantity divided by a fixed scale."""

    name: str
    scale: float
    unit: str

    def __str__(self) -> str:
        return f"{self.name} / {self.scale:g} {self.unit}".strip()


def lap_angle(state: LocalState) -> Array:
    """Return the position on a closed road as an angle, 0 to 2 pi from its start, shape (n,)."""
    return 2.0 * pi * state.route_position / state.loop_length
