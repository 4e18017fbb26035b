"""Drivers around drivers: an expert with a learned residual, several side by side, one that is impaired."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, Noise, Recipe
from unjam.drivers.local_state import LocalState, Observed
from unjam.drivers.network import Network, network_arrays
from unjam.drivers.observation import Seen, feature, observe, observed, own_files
from unjam.errors import InputError
from unjam.parameters import NotNegative
from unjam.physics.arrays import Array, namespace
from unjam.tree import Arrays

EXPERT, RESIDUAL, AGE = "expert", "residual", "age"
"""names in the memory of a residual driver: the expert's own; the residual that is held, and for how many
decisions it was"""
KIND = "kind"
"""name in the memory of a mixture: which driver a CAV has"""
INNER, SENT = "inner", "sent"
"""names in the memory of an impaired driver, beside the `AGE` in decisions: the other driver's own; what was
said and not yet done"""
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
class ResidualDriver(Wrapper):
    """Adds what a network has learned to what an expert does, within the action limit: the paper's Eq. 8.

    Any driver can be the expert, another `ResidualDriver` too.
    """

    expert: Driver
    network: Network
    action_limit: float
    """largest acceleration in either direction [m/s2]"""
    parts: tuple[str, ...] = ("local",)
    """what the network sees: features by name"""
    hold: int = 1
    """decisions for which one residual is held; the expert goes on deciding in each of them"""

    @cached_property
    def limits(self) -> Limits:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Within which expert and sum are kept."""
        return Limits.symmetric(self.action_limit)

    @cached_property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether expert and features take plain numbers."""
        return self.expert.plain_numbers and all(feature(name).plain for name in self.parts)

    @property
    def observed_memory(self) -> tuple[Observed, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the expert's `memory_features` are."""
        return self.expert.observed_memory

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's memory and, where a residual is held, the residual and its age."""
        memory = super().initial_memory(n)
        return memory if self.hold == 1 else {**memory, RESIDUAL: np.zeros(n), AGE: np.zeros(n)}

    def decide(self, state: LocalState, memory: Memory, noise: Noise | None = None) -> Decision:
        """Return the decision taken apart; with `noise`, the network explores."""
        wanted, after = self.expert.act(state, memory[EXPERT])
        limits, hold, remembered = self.limits, self.hold, {EXPERT: after}
        expert = limits.keep(wanted)
        due: Any = True if hold == 1 else memory[AGE] % hold == 0
        if due is False:  # where one age counts for all rows, as in plain numbers, no network is asked
            observation, residual = (), memory[RESIDUAL]
        else:
            observation = observe(self.parts, Seen(state, expert, self.expert, after))
            network = self.network
            residual = network(observation) if noise is None else network.explore(observation, noise())
            if due is not True:
                residual = namespace(residual).where(due, residual, memory[RESIDUAL])
        if hold > 1:
            remembered |= {RESIDUAL: residual, AGE: memory[AGE] + 1.0}
        command = Command(limits.keep(expert + residual))
        return Decision(command, expert, residual, observation, remembered)

    def observation(self, state: LocalState, memory: Memory) -> Array:
        """Return what the network would see now, whether or not its residual is being held."""
        wanted, after = self.expert.act(state, memory[EXPERT])
        return observe(self.parts, Seen(state, self.limits.keep(wanted), self.expert, after))

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the new memory."""
        decision = self.decide(state, memory)
        return decision.command.acceleration, decision.memory

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.memory_features(memory[EXPERT])

    @property
    def inner(self) -> dict[str, Driver]:
        """Its expert."""
        return {EXPERT: self.expert}

    @property
    def shown(self) -> tuple[Observed, ...]:
        """What its own network sees, in order."""
        return observed(self.parts, self.expert)

    def describe(self) -> str:
        """Return the expert in a few words, and that there is a residual."""
        return f"{self.expert.describe()} + residual"

    def recipe(self) -> Recipe:
        """Return what it is made from, without the network's weights."""
        files = own_files(self.parts)
        return {
            "kind": "residual",
            "expert": self.expert.recipe(),
            "action_limit": self.action_limit,
            "parts": list(self.parts),
            "hold": self.hold,
            "authority": self.network.authority,
            "exploration_std": self.network.exploration_std,
            **({"files": files} if files else {}),
        }

    def arrays(self) -> Arrays:
        """Return the weights of its network and, with their prefix, those of its expert."""
        return {**super().arrays(), **network_arrays(self.network)}


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
