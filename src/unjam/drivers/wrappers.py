"""Drivers around drivers: several side by side, one with worse sensors, one with its safety filter."""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead, SafetyFilter
from unjam.errors import InputError
from unjam.parameters import NotNegative
from unjam.physics.arrays import Array, namespace

KIND = "kind"
"""name in the memory of a mixture: which driver a CAV has"""
INNER, AGE, SENT = "inner", "age", "sent"
"""names in the memory of a wrapper: the other driver's own; of an impaired one besides: decisions made so
far; what was said and not yet done"""
SMALLEST_SEEN_GAP = 0.1
"""[m], however wrong a sensor is"""


class Wrapper(Driver):
    """A driver that drives by those which it holds."""

    @property
    def tensors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all that it holds take tensors."""
        return all(held.tensors for held in self.inner.values())

    @property
    def needs_loop(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether one that it holds must know its place on a closed road."""
        return any(held.needs_loop for held in self.inner.values())


@dataclass(frozen=True)
class Mixed(Wrapper):
    """Gives the CAVs different drivers: the first CAV has the first driver, the next the next, and so on.

    After the last driver it begins anew; where CAVs come and go, they are counted as they enter.
    """

    drivers: tuple[Driver, ...]

    def __post_init__(self) -> None:
        """Raise `InputError` where one of them is the simulator itself."""
        if any(driver.native for driver in self.drivers):
            raise InputError("driver: 'human' is not allowed among several; idm drives like people")

    @property
    def inner(self) -> dict[str, Driver]:
        """All of them, by their number."""
        return {str(number): driver for number, driver in enumerate(self.drivers)}

    def initial_memory(self, n: int) -> Memory:
        """Return which driver each CAV has, and what all drivers would remember of it."""
        return {KIND: np.arange(n, dtype=np.float64) % len(self.drivers), **super().initial_memory(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration that each CAV's own driver wants, and the new memory."""
        after, chosen = dict(memory), None
        for number, (key, driver) in enumerate(self.inner.items()):
            wanted, after[key] = driver.act(state, memory[key])
            mine = memory[KIND] == number
            chosen = wanted if chosen is None else namespace(wanted).where(mine, wanted, chosen)
        return chosen, after

    def describe(self) -> str:
        """Return all of them, joined by +."""
        return "+".join(driver.describe() for driver in self.drivers)

    def recipe(self) -> Recipe:
        """Return what all of them are made from."""
        return {"kind": "mixed", "drivers": [driver.recipe() for driver in self.drivers]}


@dataclass(frozen=True)
class Impaired(Wrapper):
    """Passes what it sees, with noise, to another driver, and hands on what that one said a while ago."""

    tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]

    driver: Driver
    delay: NotNegative = 0.0
    """time after which a command is carried out, rounded to whole decisions [s]"""
    gap_noise: NotNegative = 0.0
    """standard deviation of both gaps, anew in every decision [m]"""
    time_step: float = 0.1
    """time between two decisions [s]"""

    @property
    def inner(self) -> dict[str, Driver]:
        """The other driver."""
        return {INNER: self.driver}

    def initial_memory(self, n: int) -> Memory:
        """Return that of the other driver, that nothing was said yet, and that no decision was made."""
        late = round(self.delay / self.time_step)
        return {**super().initial_memory(n), AGE: np.zeros(n), SENT: np.zeros((n, late))}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what was said `delay` ago, and remember what is said now."""
        said, after = self.driver.act(self._seen(state, memory[AGE]), memory[INNER])
        sent = np.concatenate([memory[SENT], np.asarray(said)[:, None]], axis=1)
        return sent[:, 0], {INNER: after, AGE: memory[AGE] + 1.0, SENT: sent[:, 1:]}

    def _seen(self, state: LocalState, age: Array) -> LocalState:
        if self.gap_noise == 0.0 or not len(age):
            return state
        # A driver's answer must not depend on who drives beside it: what it sees is the seed.
        rows = np.stack([age, state.speed, state.leader_gap, state.follower_gap], -1)
        noise = [np.random.default_rng(row.view(np.uint64).tolist()).normal(size=2) for row in rows]
        ahead, behind = self.gap_noise * np.array(noise).T
        return state._replace(
            leader_gap=np.maximum(state.leader_gap + ahead, SMALLEST_SEEN_GAP),
            follower_gap=np.maximum(state.follower_gap + behind, SMALLEST_SEEN_GAP),
        )

    def describe(self) -> str:
        """Return the other driver, and what is worse about it."""
        worse = (("late", self.delay, "s"), ("gap noise", self.gap_noise, "m"))
        words = [f"{name} {value:g} {unit}" for name, value, unit in worse if value]
        return f"{self.driver.describe()} ({', '.join(words) or 'unimpaired'})"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and what is worse about it."""
        worse = {"delay": self.delay, "gap_noise": self.gap_noise, "time_step": self.time_step}
        return {"kind": "impaired", "driver": self.driver.recipe(), **worse}


@dataclass(frozen=True)
class Filtered(Wrapper):
    """Another driver with the limits and the safety filter of a road, for a car that has none of its own.

    A controller is shipped so: what drives elsewhere is what was proven. Where the road filters as well, as
    all of unjam's do, nothing changes.
    """

    driver: Driver
    action_limit: float
    """largest acceleration in either direction that the driver may ask for [m/s2]"""
    safety: SafetyFilter
    time_step: float
    """time between two decisions [s]"""

    @property
    def inner(self) -> dict[str, Driver]:
        """The other driver."""
        return {INNER: self.driver}

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the other driver takes plain numbers."""
        return self.driver.plain_numbers

    @cached_property
    def limits(self) -> Limits:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What comes out: the driver's limits, and a car's brakes."""
        return Limits(-max(self.action_limit, self.safety.braking), self.action_limit)

    @cached_property
    def _asked(self) -> Limits:
        """Within which the driver may ask."""
        return Limits.symmetric(self.action_limit)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the filter lets pass of what the other driver wants, and the new memory."""
        wanted, after = self.driver.act(state, memory[INNER])
        return self.safety.keep(self._asked.keep(wanted), Ahead(*state[:3]), self.time_step), {INNER: after}

    def describe(self) -> str:
        """Return the other driver, and that it is filtered."""
        return f"{self.driver.describe()}, filtered"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and the filter's settings."""
        settings = {"action_limit": self.action_limit, "safety": asdict(self.safety)}
        return {"kind": "filtered", "driver": self.driver.recipe(), **settings, "time_step": self.time_step}
