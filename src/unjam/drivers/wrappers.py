"""Drivers around drivers: several side by side, worse sensors, the safety filter, a memory of the past."""

from dataclasses import asdict, dataclass
from functools import cached_property
from math import exp
from typing import ClassVar

import numpy as np

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.drivers.safety import FollowingState, SafetyFilter
from unjam.drivers.sensors import MIN_SENSED_GAP
from unjam.errors import InputError
from unjam.parameters import NonNegative, Positive
from unjam.physics.arrays import Array, clamp_min, join_columns, namespace, square_root, stack_columns

DRIVER_INDEX_KEY = "driver_index"
"""name in the memory of a mixture: which driver a CAV has"""
INNER_KEY, STEP_KEY, PENDING_KEY = "inner", "step", "pending"
"""names in the memory of a wrapper: the other driver's own; of an impaired one besides: decisions made so
far; what was said and not yet done"""
AVERAGING_TIMES = (10.0, 40.0, 160.0)
"""time constants of the means [s]: within a wave, of a wave, of several"""
SPEED_STD_SCALE, MEAN_GAP_SCALE = 2.0, 20.0
"""of the spread of speeds [m/s] and of the mean gap [m], before a network sees them"""
HISTORY_STEPS_KEY = "steps"
"""name in the memory: moments that were watched"""
MEAN_SPEED_KEY, MEAN_SQUARE_KEY, MEAN_GAP_KEY = "mean_speed", "mean_square", "mean_gap"
"""names of the means in the memory, by their span"""


class CompositeDriver(Driver):
    """A driver that drives by those which it holds."""

    @property
    def accepts_tensors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all that it holds take tensors."""
        return all(held.accepts_tensors for held in self.inner_drivers.values())

    @property
    def needs_loop(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether one that it holds must know its place on a closed road."""
        return any(held.needs_loop for held in self.inner_drivers.values())

    @property
    def policy_inputs(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What networks in those that it holds see."""
        return tuple(name for held in self.inner_drivers.values() for name in held.policy_inputs)


class DriverWrapper(CompositeDriver):
    """A driver around one other."""

    driver: Driver

    @property
    def accepts_floats(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the other driver takes plain numbers."""
        return self.driver.accepts_floats

    @property
    def inner_drivers(self) -> dict[str, Driver]:
        """The other driver."""
        return {INNER_KEY: self.driver}

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the other driver's are."""
        return self.driver.memory_inputs

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the other driver."""
        return self.driver.time_gaps(state, memory[INNER_KEY])

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the other driver's."""
        return self.driver.memory_features(memory[INNER_KEY])


@dataclass(frozen=True)
class MixedDriver(CompositeDriver):
    """Gives the CAVs different drivers: the first CAV has the first driver, the next the next, and so on.

    After the last driver it begins anew; where CAVs come and go, they are counted as they enter.
    """

    drivers: tuple[Driver, ...]

    def __post_init__(self) -> None:
        """Raise `InputError` where one of them is the simulator itself."""
        if any(driver.is_native for driver in self.drivers):
            raise InputError("driver: 'human' is not allowed among several; idm drives like people")

    @property
    def inner_drivers(self) -> dict[str, Driver]:
        """All of them, by their number."""
        return {str(number): driver for number, driver in enumerate(self.drivers)}

    def initial_memory(self, n: int) -> Memory:
        """Return which driver each CAV has, and what all drivers would remember of it."""
        return {DRIVER_INDEX_KEY: np.arange(n, dtype=np.float64) % len(self.drivers), **super().initial_memory(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration that each CAV's own driver wants, and the new memory."""
        after, chosen = dict(memory), None
        for number, (key, driver) in enumerate(self.inner_drivers.items()):
            wanted, after[key] = driver.act(state, memory[key])
            mine = memory[DRIVER_INDEX_KEY] == number
            chosen = wanted if chosen is None else namespace(wanted).where(mine, wanted, chosen)
        return chosen, after

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return for each CAV that of its own driver."""
        chosen = None
        for number, (key, driver) in enumerate(self.inner_drivers.items()):
            wanted = driver.time_gaps(state, memory[key])
            if wanted is not None:
                others = np.nan if chosen is None else chosen
                chosen = np.where(memory[DRIVER_INDEX_KEY] == number, wanted, others)
        return chosen

    def describe(self) -> str:
        """Return all of them, joined by +."""
        return "+".join(driver.describe() for driver in self.drivers)

    def recipe(self) -> Recipe:
        """Return what all of them are made from."""
        return {"kind": "mixed", "drivers": [driver.recipe() for driver in self.drivers]}


@dataclass(frozen=True)
class ImpairedDriver(DriverWrapper):
    """Passes what it sees, with noise, to another driver, and hands on what that one said a while ago."""

    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]
    accepts_floats: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleMethodOverride]

    driver: Driver
    delay: NonNegative = 0.0
    """time after which a command is carried out, rounded to whole decisions [s]"""
    gap_noise: NonNegative = 0.0
    """standard deviation of both gaps, anew in every decision [m]"""
    time_step: float = 0.1
    """time between two decisions [s]"""

    def initial_memory(self, n: int) -> Memory:
        """Return that of the other driver, that nothing was said yet, and that no decision was made."""
        late = round(self.delay / self.time_step)
        return {**super().initial_memory(n), STEP_KEY: np.zeros(n), PENDING_KEY: np.zeros((n, late))}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what was said `delay` ago, and remember what is said now."""
        said, after = self.driver.act(self._add_gap_noise(state, memory[STEP_KEY]), memory[INNER_KEY])
        sent = np.concatenate([memory[PENDING_KEY], np.asarray(said)[:, None]], axis=1)
        return sent[:, 0], {INNER_KEY: after, STEP_KEY: memory[STEP_KEY] + 1.0, PENDING_KEY: sent[:, 1:]}

    def _add_gap_noise(self, state: LocalState, step: Array) -> LocalState:
        if self.gap_noise == 0.0 or not len(step):
            return state
        # A driver's answer must not depend on who drives beside it: what it sees is the seed.
        rows = np.stack([step, state.speed, state.leader_gap, state.follower_gap], -1)
        noise = [np.random.default_rng(row.view(np.uint64).tolist()).normal(size=2) for row in rows]
        ahead, behind = self.gap_noise * np.array(noise).T
        return state._replace(
            leader_gap=np.maximum(state.leader_gap + ahead, MIN_SENSED_GAP),
            follower_gap=np.maximum(state.follower_gap + behind, MIN_SENSED_GAP),
        )

    def describe(self) -> str:
        """Return the other driver, and what is worse about it."""
        worse = (("delay", self.delay, "s"), ("gap noise", self.gap_noise, "m"))
        words = [f"{name} {value:g} {unit}" for name, value, unit in worse if value]
        return f"{self.driver.describe()} ({', '.join(words) or 'unimpaired'})"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and what is worse about it."""
        worse = {"delay": self.delay, "gap_noise": self.gap_noise, "time_step": self.time_step}
        return {"kind": "impaired", "driver": self.driver.recipe(), **worse}


@dataclass(frozen=True)
class FilteredDriver(DriverWrapper):
    """Another driver with the limits and the safety filter of a road, for a car that has none of its own.

    A controller is shipped so: what drives elsewhere is what was proven, of a car that obeys at once. Where
    the road filters as well, and a decision is one simulation step, nothing changes.
    """

    driver: Driver
    action_limit: float
    """largest acceleration in either direction that the driver may ask for [m/s2]"""
    safety: SafetyFilter
    time_step: float
    """time between two decisions [s]"""

    @cached_property
    def limits(self) -> Limits:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What comes out: the driver's limits, and a car's brakes."""
        return Limits(-max(self.action_limit, self.safety.braking), self.action_limit)

    @cached_property
    def _driver_limits(self) -> Limits:
        """Within which the driver may ask."""
        return Limits.symmetric(self.action_limit)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the filter lets pass of what the other driver wants, and the new memory."""
        wanted, after = self.driver.act(state, memory[INNER_KEY])
        return self.safety.limit(self._driver_limits.clip(wanted), FollowingState(*state[:3]), self.time_step), {
            INNER_KEY: after
        }

    def describe(self) -> str:
        """Return the other driver, and that it is filtered."""
        return f"{self.driver.describe()}, filtered"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and the filter's settings."""
        settings = {"action_limit": self.action_limit, "safety": asdict(self.safety)}
        return {"kind": "filtered", "driver": self.driver.recipe(), **settings, "time_step": self.time_step}


@dataclass(frozen=True)
class HistoryDriver(DriverWrapper):
    """Drives as another driver does, and remembers means of its own speed, its square, and its gap.

    Until a span has passed, its mean is that of all that was watched.
    """

    driver: Driver
    time_step: Positive
    """time between two decisions [s]"""

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the other driver's are, and its own."""
        mine: list[ScaledInput] = []
        for span in AVERAGING_TIMES:
            mine += [
                ScaledInput(f"mean own speed over {span:g} s", SPEED_SCALE, "m/s"),
                ScaledInput(f"standard deviation of own speed over {span:g} s", SPEED_STD_SCALE, "m/s"),
                ScaledInput(f"mean gap over {span:g} s", MEAN_GAP_SCALE, "m"),
            ]
        return (*self.driver.memory_inputs, *mine)

    @cached_property
    def _step_weights(self) -> tuple[tuple[float, float], ...]:
        """Spans, and what a step weighs in their means."""
        return tuple((span, 1.0 - exp(-self.time_step / span)) for span in AVERAGING_TIMES)

    def initial_memory(self, n: int) -> Memory:
        """Return that of the other driver, and that nothing was watched yet."""
        means = {
            f"{name}_{span:g}": np.zeros(n)
            for span in AVERAGING_TIMES
            for name in (MEAN_SPEED_KEY, MEAN_SQUARE_KEY, MEAN_GAP_KEY)
        }
        return {**super().initial_memory(n), HISTORY_STEPS_KEY: np.zeros(n), **means}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if both had watched `history`."""
        memory = super().recall(memory, history)
        for moment in range(history.speed.shape[1]):
            memory = self._update_means(memory, history.speed[:, moment], history.leader_gap[:, moment])
        return memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the other driver wants, and the new memory."""
        wanted, after = self.driver.act(state, memory[INNER_KEY])
        return wanted, {**self._update_means(memory, state.speed, state.leader_gap), INNER_KEY: after}

    def _update_means(self, memory: Memory, speed: Array, gap: Array) -> Memory:
        xp, after = namespace(speed), dict(memory)
        after[HISTORY_STEPS_KEY] = memory[HISTORY_STEPS_KEY] + 1.0
        early = 1.0 / after[HISTORY_STEPS_KEY]
        for span, fading in self._step_weights:
            weight = xp.where(early > fading, early, early * 0.0 + fading)
            for name, now in ((MEAN_SPEED_KEY, speed), (MEAN_SQUARE_KEY, speed * speed), (MEAN_GAP_KEY, gap)):
                before = memory[f"{name}_{span:g}"]
                after[f"{name}_{span:g}"] = before + weight * (now - before)
        return after

    def memory_features(self, memory: Memory) -> Array:
        """Return the other driver's features, and for each span mean speed, its spread and the mean gap."""
        columns: list[Array] = []
        for span in AVERAGING_TIMES:
            speed, square, room = (
                memory[f"{name}_{span:g}"] for name in (MEAN_SPEED_KEY, MEAN_SQUARE_KEY, MEAN_GAP_KEY)
            )
            spread = square_root(clamp_min(square - speed * speed, 0.0) + 1e-9)  # never the root of zero
            columns += [speed / SPEED_SCALE, spread / SPEED_STD_SCALE, room / MEAN_GAP_SCALE]
        mine = stack_columns(tuple(columns))
        others = self.driver.memory_features(memory[INNER_KEY])
        return mine if others is None else join_columns([others, mine])

    def describe(self) -> str:
        """Return the other driver, and that it remembers."""
        return f"{self.driver.describe()}, with history"

    def recipe(self) -> Recipe:
        """Return what the other driver is made from, and the time between two decisions."""
        return {"kind": "history", "driver": self.driver.recipe(), "time_step": self.time_step}
