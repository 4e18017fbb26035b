"""A driver for all roads: one control law per road type, selected by the fields that the road provides."""

from typing import ClassVar

from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.wrappers import COMPOSITE_CONFIG, CompositeDriver
from unjam.physics.arrays import Array, namespace

ROAD_TYPES = ("motorway", "crossing_loop", "loop", "open_road", "shared_loop")
MIN_SHARED_PENETRATION_RATE = 0.06
"""penetration rate from which a closed road counts as shared by several CAVs; one CAV among 16 vehicles counts, too,
because the rate does not give their number"""


@dataclass(frozen=True, config=COMPOSITE_CONFIG)
class RoadTypeSwitch(CompositeDriver):
    """Drives by one of its inner drivers, selected by road type: from the vehicle's map and roadside messages.

    All CAVs of an episode are on one road. The memories for other road types keep their initial values.
    """

    kind: ClassVar[str] = "road-type-switch"
    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    policy_inputs: ClassVar[tuple[str, ...]] = ()  # pyright: ignore[reportIncompatibleMethodOverride]
    required_fields: ClassVar[tuple[str, ...]] = ("distance_to_crossing", "penetration_rate")

    motorway: Driver
    """on roads with measured speeds of the lanes ahead"""
    crossing_loop: Driver
    """on a closed road that crosses itself"""
    loop: Driver
    """on any other closed road"""
    open_road: Driver
    """on open roads without roadside information"""
    shared_loop: Driver | None = None
    """on closed roads without a crossing and with at least `MIN_SHARED_PENETRATION_RATE`; None: `loop`"""

    @property
    def accepts_floats(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether those of closed roads take plain numbers, which no other road uses."""
        closed = (self.crossing_loop, self.loop, self.shared_loop or self.loop)
        return all(driver.accepts_floats for driver in closed)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration by the driver for this road type, and the new memory."""
        name = self._road_type(state)
        acceleration, after = self.inner_drivers[name].act(state, memory[name])
        return acceleration, {**memory, name: after}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the driver for this road type."""
        name = self._road_type(state)
        return self.inner_drivers[name].time_gaps(state, memory[name])

    def describe(self) -> str:
        """Return all of them with their road types."""
        return ", ".join(f"{name}: {driver.describe()}" for name, driver in self.inner_drivers.items())

    def _road_type(self, state: LocalState) -> str:
        if state.lane_speeds is not None:
            return "motorway"
        if state.distance_to_crossing is not None:
            return "crossing_loop"
        length, rate = state.loop_length, state.penetration_rate
        is_open = length != length if isinstance(length, float) else namespace(length).isnan(length).all()
        if bool(is_open):
            return "open_road"
        if self.shared_loop is None or rate is None:
            return "loop"
        rate = rate if isinstance(rate, float) else float(rate[0])
        return "shared_loop" if rate >= MIN_SHARED_PENETRATION_RATE else "loop"
