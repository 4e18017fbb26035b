"""An expert plus a learned residual: the paper's full policy, Eq. 8."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, Noise, Recipe
from unjam.drivers.local_state import LocalState, Observed
from unjam.drivers.network import Network, network_arrays
from unjam.drivers.observation import Seen, asked_by, feature, observe, observed, own_files
from unjam.drivers.wrappers import Wrapper
from unjam.physics.arrays import Array, namespace
from unjam.tree import Arrays

EXPERT, RESIDUAL, AGE = "expert", "residual", "age"
"""names in the memory: the expert's own; the residual that is held, and for how many decisions it was"""


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
    def lasting_noise(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """How many numbers its network explores with that stay as they are."""
        return self.network.noise_numbers

    @property
    def told(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the features look at."""
        return tuple(name for part in self.parts for name in feature(part).told)

    @property
    def sees(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The features of its network, and those of networks in its expert."""
        return (*self.parts, *self.expert.sees)

    @property
    def asks(self) -> frozenset[str]:
        """What the expert and the features look at; features of the user's own, at all that is told."""
        return super().asks | asked_by(self.parts)

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
        limits, hold = self.limits, self.hold
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
        remembered = {EXPERT: after}
        if hold > 1:
            remembered = {EXPERT: after, RESIDUAL: residual, AGE: memory[AGE] + 1.0}
        command = Command(limits.keep(expert + residual), self.time_headways(state, memory))
        return Decision(command, expert, residual, observation, remembered)

    def observation(self, state: LocalState, memory: Memory) -> Array:
        """Return what the network would see now, whether or not its residual is being held."""
        wanted, after = self.expert.act(state, memory[EXPERT])
        return observe(self.parts, Seen(state, self.limits.keep(wanted), self.expert, after))

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the new memory."""
        decision = self.decide(state, memory)
        return decision.command.acceleration, decision.memory

    def time_headways(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.time_headways(state, memory[EXPERT])

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
            **({"lasts": True} if self.network.lasts else {}),
            **({"files": files} if files else {}),
        }

    def arrays(self) -> Arrays:
        """Return the weights of its network and, with their prefix, those of its expert."""
        return {**super().arrays(), **network_arrays(self.network)}
