"""A driver for every road: one law for each kind of road, chosen by what the road lets a car know of it."""

from dataclasses import dataclass
from typing import ClassVar

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.wrappers import Wrapper
from unjam.physics.arrays import Array, namespace

KINDS_OF_ROAD = ("motorway", "crossing", "loop", "elsewhere")


@dataclass(frozen=True)
class ByRoad(Wrapper):
    """Drives by one of those that it holds: a car's map and its messages say on what kind of road it is.

    All of its CAVs are on one road, as those of an episode are. What it remembers of the other roads stays as
    it began.
    """

    tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    told: ClassVar[tuple[str, ...]] = ("to_crossing",)

    motorway: Driver
    """where a service tells how fast the lanes ahead are"""
    crossing: Driver
    """on a closed road that crosses itself"""
    loop: Driver
    """on any other closed road"""
    elsewhere: Driver
    """on roads with ends of which nothing is told"""

    @property
    def inner(self) -> dict[str, Driver]:
        """All of them, by the kind of road."""
        return {kind: getattr(self, kind) for kind in KINDS_OF_ROAD}

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether those of closed roads take plain numbers: nobody else is given them."""
        return self.crossing.plain_numbers and self.loop.plain_numbers

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the driver of this kind of road wants, and the new memory."""
        kind = _kind(state)
        wanted, after = self.inner[kind].act(state, memory[kind])
        return wanted, {**memory, kind: after}

    def time_headways(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the driver of this kind of road."""
        kind = _kind(state)
        return self.inner[kind].time_headways(state, memory[kind])

    def describe(self) -> str:
        """Return all of them with their roads."""
        return ", ".join(f"{kind}: {driver.describe()}" for kind, driver in self.inner.items())

    def recipe(self) -> Recipe:
        """Return what all of them are made from."""
        return {"kind": "by-road", "drivers": {kind: held.recipe() for kind, held in self.inner.items()}}


def _kind(state: LocalState) -> str:
    """Return on what kind of road the CAVs are."""
    if state.lane_speeds is not None:
        return "motorway"
    if state.to_crossing is not None:
        return "crossing"
    length = state.loop_length
    ends = length != length if isinstance(length, float) else bool(namespace(length).isnan(length).all())
    return "elsewhere" if ends else "loop"
