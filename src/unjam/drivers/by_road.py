"""A driver for every road: one law for each kind of road, chosen by what the road lets a car know of it."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.wrappers import Wrapper
from unjam.physics.arrays import Array, namespace

KINDS_OF_ROAD = ("motorway", "crossing", "loop", "elsewhere", "shared")
SEVERAL = 0.06
"""share of CAVs from which a closed road counts as shared among them; that of one CAV among sixteen does,
too, for a share does not say how many they are"""


@dataclass(frozen=True)
class ByRoad(Wrapper):
    """Drives by one of those that it holds: a car's map and its messages say on what kind of road it is.

    All of its CAVs are on one road, as those of an episode are. What it remembers of the other roads stays as
    it began.
    """

    tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    sees: ClassVar[tuple[str, ...]] = ()  # pyright: ignore[reportIncompatibleMethodOverride]
    told: ClassVar[tuple[str, ...]] = ("to_crossing", "cav_share")

    motorway: Driver
    """where a service tells how fast the lanes ahead are"""
    crossing: Driver
    """on a closed road that crosses itself"""
    loop: Driver
    """on any other closed road"""
    elsewhere: Driver
    """on roads with ends of which nothing is told"""
    shared: Driver | None = None
    """on closed roads that do not cross themselves, where a service tells that at least `SEVERAL` of all are
    CAVs; None: as on others of the kind"""

    @cached_property
    def inner(self) -> dict[str, Driver]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """All of them, by the kind of road."""
        held = {kind: getattr(self, kind) for kind in KINDS_OF_ROAD}
        return {kind: driver for kind, driver in held.items() if driver is not None}

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether those of closed roads take plain numbers: nobody else is given them."""
        closed = (self.crossing, self.loop, self.shared or self.loop)
        return all(driver.plain_numbers for driver in closed)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the driver of this kind of road wants, and the new memory."""
        kind = self._kind(state)
        wanted, after = self.inner[kind].act(state, memory[kind])
        return wanted, {**memory, kind: after}

    def time_headways(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the driver of this kind of road."""
        kind = self._kind(state)
        return self.inner[kind].time_headways(state, memory[kind])

    def describe(self) -> str:
        """Return all of them with their roads."""
        return ", ".join(f"{kind}: {driver.describe()}" for kind, driver in self.inner.items())

    def recipe(self) -> Recipe:
        """Return what all of them are made from."""
        drivers = {kind: held.recipe() for kind, held in self.inner.items()}
        return {"kind": "by-road", "drivers": drivers}

    def _kind(self, state: LocalState) -> str:
        """Return on what kind of road the CAVs are."""
        if state.lane_speeds is not None:
            return "motorway"
        if state.to_crossing is not None:
            return "crossing"
        length, share = state.loop_length, state.cav_share
        ends = length != length if isinstance(length, float) else namespace(length).isnan(length).all()
        if bool(ends):
            return "elsewhere"
        if self.shared is None or share is None:
            return "loop"
        told = share if isinstance(share, float) else float(share[0])
        return "shared" if told >= SEVERAL else "loop"
