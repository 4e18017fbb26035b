"""The experts of motorways: a car's own ACC, and caps on its speed from what is told of the road ahead."""

from typing import Annotated, ClassVar

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Formula, Memory
from unjam.drivers.local_state import SECTIONS_AHEAD, LocalState
from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, at_least, namespace

FREELY = 100.0
"""acceleration that no ACC has: nothing holds it back [m/s2]"""

Section = Annotated[int, Field(ge=0, lt=SECTIONS_AHEAD)]


@dataclass(frozen=True, config=STRICT)
class Cruise(Formula):
    """Never holds the car back: where it has its own ACC, that one drives.

    What the ACC is like is the road's to say (`cruise.time_headway`, `cruise.acceleration`). Without an ACC
    it accelerates as hard as it may.
    """

    name: ClassVar[str] = "cruise"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return an acceleration beyond what any ACC wants; nothing is remembered."""
        return state.speed * 0.0 + FREELY, memory


@dataclass(frozen=True, config=STRICT)
class JamAhead(Formula):
    """Upstream of a ramp, drives no faster than its own lane does a few hundred metres ahead.

    So it arrives at the tail of a jam as fast as the jam moves, keeps room for those who merge, and the jam
    ahead gets less than it lets go. Elsewhere, and where no message says how fast the road ahead is, its own
    ACC drives. It gives way to nobody on purpose: those behind pass where there are lanes.
    """

    name: ClassVar[str] = "jam-ahead"
    plain_numbers: ClassVar[bool] = False
    told: ClassVar[tuple[str, ...]] = ("allowed_speed", "to_merge", "lane_speeds", "road_speeds")

    first: Section = 0
    """first section ahead that counts, of 100 m each; 0 is the one that it is in"""
    last: Section = 4
    """last section ahead that counts"""
    margin: float = 0.0
    """how much faster than the mean ahead it may drive [m/s]"""
    lowest: NotNegative = 5.0
    """it is never held back below this [m/s]"""
    slowing: Positive = 1.5
    """largest braking for the sake of the cap [m/s2]"""
    all_lanes: bool = False
    """whether the mean is that of all lanes of the main road"""
    time_constant: Positive = 1.0
    """time over which the cap is reached [s]"""

    @model_validator(mode="after")
    def _in_order(self) -> "JamAhead":
        if self.last < self.first:
            raise ValueError(f"last: {self.last} is not allowed; allowed: >= first, {self.first}")
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap, beyond any ACC's where there is none."""
        speeds = state.road_speeds if self.all_lanes else state.lane_speeds
        free = state.speed * 0.0 + FREELY
        if speeds is None:
            return free, memory
        ahead = speeds[..., self.first : self.last + 1].mean(-1)
        xp = namespace(free)
        cap = xp.minimum(at_least(ahead + self.margin, self.lowest), state.allowed_speed)
        towards = at_least((cap - state.speed) / self.time_constant, -self.slowing)
        return xp.where(state.to_merge > 0.0, towards, free), memory
