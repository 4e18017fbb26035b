"""A driver with a memory of its own past: what a car can know of the wave that it drives through.

A wave is longer than what a car sees at a moment. How fast it drove over the last ten seconds, the last
minute and the last minutes, how much that changed, and how much room it had, tell whether there is one, how
long it is, and how fast traffic could flow.
"""

from dataclasses import dataclass
from functools import cached_property
from math import exp

import numpy as np

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import SPEED_SCALE, LocalState, Observed
from unjam.drivers.wrappers import INNER, Wrapper
from unjam.parameters import Positive
from unjam.physics.arrays import Array, at_least, join_columns, namespace, square_root, stack_columns

SPANS = (10.0, 40.0, 160.0)
"""time constants of the means [s]: within a wave, of a wave, of several"""
SPREAD_SCALE, ROOM_SCALE = 2.0, 20.0
"""of the spread of speeds [m/s] and of the mean gap [m], before a network sees them"""
WATCHED = "watched"
"""name in the memory: moments that were watched"""
SPEED, SQUARE, ROOM = "speed", "square", "room"
"""names of the means in the memory, by their span"""


@dataclass(frozen=True)
class Remembering(Wrapper):
    """Drives as another driver does, and remembers means of its own speed, its square, and its gap.

    Until a span has passed, its mean is that of all that was watched.
    """

    driver: Driver
    time_step: Positive
    """time between two decisions [s]"""

    @property
    def inner(self) -> dict[str, Driver]:
        """The other driver."""
        return {INNER: self.driver}

    @property
    def observed_memory(self) -> tuple[Observed, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the other driver's are, and its own."""
        mine: list[Observed] = []
        for span in SPANS:
            mine += [
                Observed(f"own mean speed over {span:g} s", SPEED_SCALE, "m/s"),
                Observed(f"spread of own speed over {span:g} s", SPREAD_SCALE, "m/s"),
                Observed(f"mean gap over {span:g} s", ROOM_SCALE, "m"),
            ]
        return (*self.driver.observed_memory, *mine)

    @cached_property
    def _fading(self) -> tuple[tuple[float, float], ...]:
        """Spans, and what a step weighs in their means."""
        return tuple((span, 1.0 - exp(-self.time_step / span)) for span in SPANS)

    def initial_memory(self, n: int) -> Memory:
        """Return that of the other driver, and that nothing was watched yet."""
        means = {f"{name}_{span:g}": np.zeros(n) for span in SPANS for name in (SPEED, SQUARE, ROOM)}
        return {**super().initial_memory(n), WATCHED: np.zeros(n), **means}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if both had watched `history`."""
        memory = super().recall(memory, history)
        for moment in range(history.speed.shape[1]):
            memory = self._watch(memory, history.speed[:, moment], history.leader_gap[:, moment])
        return memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the other driver wants, and the new memory."""
        wanted, after = self.driver.act(state, memory[INNER])
        return wanted, {**self._watch(memory, state.speed, state.leader_gap), INNER: after}

    def _watch(self, memory: Memory, speed: Array, gap: Array) -> Memory:
        xp, after = namespace(speed), dict(memory)
        after[WATCHED] = memory[WATCHED] + 1.0
        early = 1.0 / after[WATCHED]
        for span, fading in self._fading:
            weight = xp.where(early > fading, early, early * 0.0 + fading)
            for name, now in ((SPEED, speed), (SQUARE, speed * speed), (ROOM, gap)):
                before = memory[f"{name}_{span:g}"]
                after[f"{name}_{span:g}"] = before + weight * (now - before)
        return after

    def memory_features(self, memory: Memory) -> Array:
        """Return the other driver's features, and for each span mean speed, its spread and the mean gap."""
        columns: list[Array] = []
        for span in SPANS:
            speed, square, room = (memory[f"{name}_{span:g}"] for name in (SPEED, SQUARE, ROOM))
            spread = square_root(at_least(square - speed * speed, 0.0) + 1e-9)  # never the root of zero
            columns += [speed / SPEED_SCALE, spread / SPREAD_SCALE, room / ROOM_SCALE]
        mine = stack_columns(tuple(columns))
        others = self.driver.memory_features(memory[INNER])
        return mine if others is None else join_columns([others, mine])

    def describe(self) -> str:
        """Return the other driver, and that it remembers."""
        return f"{self.driver.describe()}, remembering"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and the time between two decisions."""
        return {"kind": "remembering", "driver": self.driver.recipe(), "time_step": self.time_step}
