"""Leads one queue round a road that crosses itself while it holds, and then drives another way."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.road_experts import BROKEN, GATHERED
from unjam.drivers.wrappers import Wrapper
from unjam.parameters import Positive
from unjam.physics.arrays import Array, namespace
from unjam.tree import mapped

PATIENCE = 30.0
"""time in which all gather, where their queue fits [s]"""
LEADING, OTHERWISE = "leading", "otherwise"
"""names of both drivers in the memory"""
WAITED, QUEUE, GIVEN_UP = "waited", "queue", "given_up"
"""names in the memory: time since it began [s]; whether all had gathered; whether the other one drives"""


@dataclass(frozen=True)
class WhileGathered(Wrapper):
    """Drives by who leads all others in one queue, and by another from when that queue did not hold.

    People who keep longer distances, or are more, make a queue that is longer than half a lap at the pace of
    who leads it, and meets its own tail at the crossing. No map tells how people drive; that nobody gathered
    in `PATIENCE`, or that the queue broke, does. There is no way back.
    """

    leading: Driver
    otherwise: Driver
    time_step: Positive
    """time between two decisions [s]"""

    tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleMethodOverride]

    @property
    def inner(self) -> dict[str, Driver]:
        """Both."""
        return {LEADING: self.leading, OTHERWISE: self.otherwise}

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether both take plain numbers."""
        return self.leading.plain_numbers and self.otherwise.plain_numbers

    def initial_memory(self, n: int) -> Memory:
        """Return that of both, and that all is still to come."""
        return {**super().initial_memory(n), WAITED: np.zeros(n), QUEUE: np.zeros(n), GIVEN_UP: np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the one who drives wants, and the new memory; the other one's begins when it drives."""
        after = self._watched(state, memory)
        up = after[GIVEN_UP]
        if type(up) is float:
            who, driver = (OTHERWISE, self.otherwise) if up else (LEADING, self.leading)
            wanted, after[who] = driver.act(state, memory[who])
            return wanted, after
        wanted, after[LEADING] = self.leading.act(state, memory[LEADING])
        other, begun = self.otherwise.act(state, memory[OTHERWISE])

        def where_given_up(then: Array, otherwise: Array) -> Array:
            return np.where((up > 0.0).reshape(-1, *[1] * (np.ndim(then) - 1)), then, otherwise)

        after[OTHERWISE] = mapped(where_given_up, begun, memory[OTHERWISE])
        return where_given_up(other, wanted), after

    def _watched(self, state: LocalState, memory: Memory) -> Memory:
        """Return the memory with what is seen of the queue now."""
        free, waited = state.leader_gap / state.loop_length, memory[WAITED] + self.time_step
        xp, one = namespace(free), memory[QUEUE] * 0.0 + 1.0
        queue = xp.where(free >= GATHERED, one, memory[QUEUE])
        failed = ((queue > 0.0) & (free < BROKEN)) | ((queue == 0.0) & (waited > PATIENCE))
        given_up = xp.where(failed, one, memory[GIVEN_UP])
        return {**memory, WAITED: waited, QUEUE: queue, GIVEN_UP: given_up}

    def describe(self) -> str:
        """Return both."""
        return f"{self.leading.describe()} while all gather, else {self.otherwise.describe()}"

    def recipe(self) -> Recipe:
        """Return what both are made from, and the time between two decisions."""
        drivers = {name: held.recipe() for name, held in self.inner.items()}
        return {"kind": "while-gathered", "drivers": drivers, "time_step": self.time_step}
