"""Leads one queue round a road that crosses itself while it holds, and then drives another way."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.road_experts import BROKEN_LAP_FRACTION, GATHERED_LAP_FRACTION
from unjam.drivers.wrappers import CompositeDriver
from unjam.parameters import Positive
from unjam.physics.arrays import Array, namespace
from unjam.tree import map_leaves

MAX_GATHERING_TIME = 30.0
"""time in which all gather, where their queue fits [s]"""
PRIMARY_KEY, FALLBACK_KEY = "primary", "fallback"
"""names of both drivers in the memory"""
ELAPSED_KEY, GATHERED_KEY, GAVE_UP_KEY = "elapsed", "has_gathered", "gave_up"
"""names in the memory: time since it began [s]; whether all had gathered; whether the other one drives"""


@dataclass(frozen=True)
class QueueFallback(CompositeDriver):
    """Drives by who leads all others in one queue, and by another from when that queue did not hold.

    People who keep longer distances, or are more, make a queue that is longer than half a lap at the pace of
    who leads it, and meets its own tail at the crossing. No map tells how people drive; that nobody gathered
    in `PATIENCE`, or that the queue broke, does. There is no way back.
    """

    primary: Driver
    fallback: Driver
    time_step: Positive
    """time between two decisions [s]"""

    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleMethodOverride]

    @property
    def inner_drivers(self) -> dict[str, Driver]:
        """Both."""
        return {PRIMARY_KEY: self.primary, FALLBACK_KEY: self.fallback}

    @property
    def accepts_floats(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether both take plain numbers."""
        return self.primary.accepts_floats and self.fallback.accepts_floats

    def initial_memory(self, n: int) -> Memory:
        """Return that of both, and that all is still to come."""
        return {
            **super().initial_memory(n),
            ELAPSED_KEY: np.zeros(n),
            GATHERED_KEY: np.zeros(n),
            GAVE_UP_KEY: np.zeros(n),
        }

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the one who drives wants, and the new memory; the other one's begins when it drives."""
        after = self._update_memory(state, memory)
        up = after[GAVE_UP_KEY]
        if type(up) is float:
            who, driver = (FALLBACK_KEY, self.fallback) if up else (PRIMARY_KEY, self.primary)
            wanted, after[who] = driver.act(state, memory[who])
            return wanted, after
        wanted, after[PRIMARY_KEY] = self.primary.act(state, memory[PRIMARY_KEY])
        other, begun = self.fallback.act(state, memory[FALLBACK_KEY])

        def select_rows(if_given_up: Array, if_not_given_up: Array) -> Array:
            return np.where((up > 0.0).reshape(-1, *[1] * (np.ndim(if_given_up) - 1)), if_given_up, if_not_given_up)

        after[FALLBACK_KEY] = map_leaves(select_rows, begun, memory[FALLBACK_KEY])
        return select_rows(other, wanted), after

    def _update_memory(self, state: LocalState, memory: Memory) -> Memory:
        """Return the memory with what is seen of the queue now."""
        free, waited = state.leader_gap / state.loop_length, memory[ELAPSED_KEY] + self.time_step
        xp, one = namespace(free), memory[GATHERED_KEY] * 0.0 + 1.0
        queue = xp.where(free >= GATHERED_LAP_FRACTION, one, memory[GATHERED_KEY])
        failed = ((queue > 0.0) & (free < BROKEN_LAP_FRACTION)) | ((queue == 0.0) & (waited > MAX_GATHERING_TIME))
        given_up = xp.where(failed, one, memory[GAVE_UP_KEY])
        return {**memory, ELAPSED_KEY: waited, GATHERED_KEY: queue, GAVE_UP_KEY: given_up}

    def describe(self) -> str:
        """Return both."""
        return f"{self.primary.describe()} while the queue holds, else {self.fallback.describe()}"

    def recipe(self) -> Recipe:
        """Return what both are made from, and the time between two decisions."""
        drivers = {name: held.recipe() for name, held in self.inner_drivers.items()}
        return {"kind": "queue-fallback", "drivers": drivers, "time_step": self.time_step}
