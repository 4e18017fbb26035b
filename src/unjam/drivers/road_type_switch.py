"""A driver for every road: one law for each kind of road, chosen by what the road lets a car know of it."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.wrappers import CompositeDriver
from unjam.physics.arrays import Array, namespace

ROAD_TYPES = ("motorway", "crossing_loop", "loop", "open_road", "shared_loop")
MIN_SHARED_PENETRATION_RATE = 0.06
"""share of CAVs from which a closed road counts as shared among them; that of one CAV among sixteen does,
too, for a share does not say how many they are"""


@dataclass(frozen=True)
class RoadTypeSwitch(CompositeDriver):
    """Drives by one of those that it holds: a car's map and its messages say on what kind of road it is.

    All of its CAVs are on one road, as those of an episode are. What it remembers of the other roads stays as
    it began.
    """

    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    policy_inputs: ClassVar[tuple[str, ...]] = ()  # pyright: ignore[reportIncompatibleMethodOverride]
    required_fields: ClassVar[tuple[str, ...]] = ("distance_to_crossing", "penetration_rate")

    motorway: Driver
    """where a service tells how fast the lanes ahead are"""
    crossing_loop: Driver
    """on a closed road that crosses itself"""
    loop: Driver
    """on any other closed road"""
    open_road: Driver
    """on roads with ends of which nothing is told"""
    shared_loop: Driver | None = None
    """on closed roads that do not cross themselves, where a service tells that at least `MIN_SHARED_PENETRATION_RATE` of all are
    CAVs; None: as on others of the kind"""

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """All of them, by the kind of road."""
        held = {kind: getattr(self, kind) for kind in ROAD_TYPES}
        return {kind: driver for kind, driver in held.items() if driver is not None}

    @property
    def accepts_floats(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether those of closed roads take plain numbers: nobody else is given them."""
        closed = (self.crossing_loop, self.loop, self.shared_loop or self.loop)
        return all(driver.accepts_floats for driver in closed)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the driver of this kind of road wants, and the new memory."""
        kind = self._road_type(state)
        wanted, after = self.inner_drivers[kind].act(state, memory[kind])
        return wanted, {**memory, kind: after}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the driver of this kind of road."""
        kind = self._road_type(state)
        return self.inner_drivers[kind].time_gaps(state, memory[kind])

    def describe(self) -> str:
        """Return all of them with their roads."""
        return ", ".join(f"{kind}: {driver.describe()}" for kind, driver in self.inner_drivers.items())

    def recipe(self) -> Recipe:
        """Return what all of them are made from."""
        drivers = {kind: held.recipe() for kind, held in self.inner_drivers.items()}
        return {"kind": "road-type-switch", "drivers": drivers}

    def _road_type(self, state: LocalState) -> str:
        """Return on what kind of road the CAVs are."""
        if state.lane_speeds is not None:
            return "motorway"
        if state.distance_to_crossing is not None:
            return "crossing_loop"
        length, share = state.loop_length, state.penetration_rate
        ends = length != length if isinstance(length, float) else namespace(length).isnan(length).all()
        if bool(ends):
            return "open_road"
        if self.shared_loop is None or share is None:
            return "loop"
        told = share if isinstance(share, float) else float(share[0])
        return "shared_loop" if told >= MIN_SHARED_PENETRATION_RATE else "loop"
