"""A driver that leads one queue around a crossing loop, and switches to another driver if the queue does not hold."""

from typing import ClassVar

import numpy as np
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.road_experts import BROKEN_LAP_FRACTION, GATHERED_LAP_FRACTION
from unjam.drivers.wrappers import COMPOSITE_CONFIG, CompositeDriver
from unjam.parameters import Positive
from unjam.physics.arrays import Array, namespace
from unjam.tree import map_leaves

MAX_GATHERING_TIME = 30.0
"""time in which all vehicles gather if their queue fits on the road [s]"""
PRIMARY_KEY, FALLBACK_KEY = "primary", "fallback"
"""names of both drivers in the memory, as of their fields"""
ELAPSED_KEY, GATHERED_KEY, GAVE_UP_KEY = "elapsed", "has_gathered", "gave_up"
"""names in the memory: elapsed time [s]; whether all had gathered; whether the fallback drives"""


@dataclass(frozen=True, config=COMPOSITE_CONFIG)
class QueueFallback(CompositeDriver):
    """Drives by a driver that leads all others in one queue, and by a fallback once that queue has not held.

    Human drivers with larger time gaps, or more of them, form a queue that is longer than half a lap at the pace of
    the CAV, and meets its own tail at the crossing. No map provides their time gaps. The criterion is therefore that
    the queue has not formed within `MAX_GATHERING_TIME`, or has broken. The switch is final.
    """

    primary: Driver
    fallback: Driver
    time_step: Positive
    """control step [s]"""

    kind: ClassVar[str] = "queue-fallback"
    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    needs_loop: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleMethodOverride]

    def initial_memory(self, n: int) -> Memory:
        """Return the memories of both, without elapsed time, queue and switch."""
        own = {key: np.zeros(n) for key in (ELAPSED_KEY, GATHERED_KEY, GAVE_UP_KEY)}
        return {**super().initial_memory(n), **own}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration by the active driver, and the new memory; that of the fallback starts with it."""
        after = self._update_memory(state, memory)
        gave_up = after[GAVE_UP_KEY]
        if type(gave_up) is float:
            key, driver = (FALLBACK_KEY, self.fallback) if gave_up else (PRIMARY_KEY, self.primary)
            acceleration, after[key] = driver.act(state, memory[key])
            return acceleration, after
        acceleration, after[PRIMARY_KEY] = self.primary.act(state, memory[PRIMARY_KEY])
        fallback_acceleration, fallback_memory = self.fallback.act(state, memory[FALLBACK_KEY])

        def select_rows(if_given_up: Array, if_not_given_up: Array) -> Array:
            rows = (gave_up > 0.0).reshape(-1, *[1] * (np.ndim(if_given_up) - 1))
            return np.where(rows, if_given_up, if_not_given_up)

        after[FALLBACK_KEY] = map_leaves(select_rows, fallback_memory, memory[FALLBACK_KEY])
        return select_rows(fallback_acceleration, acceleration), after

    def _update_memory(self, state: LocalState, memory: Memory) -> Memory:
        free, elapsed = state.leader_gap / state.loop_length, memory[ELAPSED_KEY] + self.time_step
        xp, one = namespace(free), memory[GATHERED_KEY] * 0.0 + 1.0
        gathered = xp.where(free >= GATHERED_LAP_FRACTION, one, memory[GATHERED_KEY])
        is_broken = (gathered > 0.0) & (free < BROKEN_LAP_FRACTION)
        failed = is_broken | ((gathered == 0.0) & (elapsed > MAX_GATHERING_TIME))
        gave_up = xp.where(failed, one, memory[GAVE_UP_KEY])
        return {**memory, ELAPSED_KEY: elapsed, GATHERED_KEY: gathered, GAVE_UP_KEY: gave_up}

    def describe(self) -> str:
        """Return both."""
        return f"{self.primary.describe()} while the queue holds, else {self.fallback.describe()}"
