"""An expert plus a learned residual: the paper's full policy, Eq. 8."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler, Recipe
from unjam.drivers.local_state import LocalState, ScaledInput
from unjam.drivers.network import Network, network_weights
from unjam.drivers.observation import (
    FeatureInputs,
    compute_observation,
    feature,
    feature_fields,
    observation_inputs,
    user_files,
)
from unjam.drivers.wrappers import CompositeDriver
from unjam.physics.arrays import Array, namespace
from unjam.tree import Arrays

EXPERT_KEY, RESIDUAL_KEY, RESIDUAL_AGE_KEY = "expert", "residual", "age"
"""names in the memory: the expert's own; the residual that is held, and for how many decisions it was"""


@dataclass(frozen=True)
class ResidualDriver(CompositeDriver):
    """Adds what a network has learned to what an expert does, within the action limit: the paper's Eq. 8.

    Any driver can be the expert, another `ResidualDriver` too.
    """

    expert: Driver
    network: Network
    action_limit: float
    """largest acceleration in either direction [m/s2]"""
    inputs: tuple[str, ...] = ("local",)
    """what the network sees: features by name"""
    action_repeat: int = 1
    """decisions for which one residual is held; the expert goes on deciding in each of them"""

    @cached_property
    def limits(self) -> Limits:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Within which expert and sum are kept."""
        return Limits.symmetric(self.action_limit)

    @cached_property
    def accepts_floats(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether expert and features take plain numbers."""
        return self.expert.accepts_floats and all(feature(name).accepts_floats for name in self.inputs)

    @property
    def episode_noise_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """How many numbers its network explores with that stay as they are."""
        return self.network.episode_noise_size

    @property
    def required_fields(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the features look at."""
        return tuple(name for part in self.inputs for name in feature(part).required_fields)

    @property
    def policy_inputs(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The features of its network, and those of networks in its expert."""
        return (*self.inputs, *self.expert.policy_inputs)

    @property
    def measured_fields(self) -> frozenset[str]:
        """What the expert and the features look at; features of the user's own, at all that is told."""
        return super().measured_fields | feature_fields(self.inputs)

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the expert's `memory_features` are."""
        return self.expert.memory_inputs

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's memory and, where a residual is held, the residual and its age."""
        memory = super().initial_memory(n)
        return (
            memory if self.action_repeat == 1 else {**memory, RESIDUAL_KEY: np.zeros(n), RESIDUAL_AGE_KEY: np.zeros(n)}
        )

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision taken apart; with `noise`, the network explores."""
        wanted, after = self.expert.act(state, memory[EXPERT_KEY])
        limits, hold = self.limits, self.action_repeat
        expert = limits.clip(wanted)
        due: Any = True if hold == 1 else memory[RESIDUAL_AGE_KEY] % hold == 0
        if due is False:  # where one age counts for all rows, as in plain numbers, no network is asked
            observation, residual = (), memory[RESIDUAL_KEY]
        else:
            observation = compute_observation(self.inputs, FeatureInputs(state, expert, self.expert, after))
            network = self.network
            residual = network(observation) if noise is None else network.explore(observation, noise())
            if due is not True:
                residual = namespace(residual).where(due, residual, memory[RESIDUAL_KEY])
        remembered = {EXPERT_KEY: after}
        if hold > 1:
            remembered = {EXPERT_KEY: after, RESIDUAL_KEY: residual, RESIDUAL_AGE_KEY: memory[RESIDUAL_AGE_KEY] + 1.0}
        command = Command(limits.clip(expert + residual), self.time_gaps(state, memory))
        return Decision(command, expert, residual, observation, remembered)

    def observation(self, state: LocalState, memory: Memory) -> Array:
        """Return what the network would see now, whether or not its residual is being held."""
        wanted, after = self.expert.act(state, memory[EXPERT_KEY])
        return compute_observation(self.inputs, FeatureInputs(state, self.limits.clip(wanted), self.expert, after))

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the new memory."""
        decision = self.decide(state, memory)
        return decision.command.acceleration, decision.memory

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.time_gaps(state, memory[EXPERT_KEY])

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.memory_features(memory[EXPERT_KEY])

    @property
    def inner_drivers(self) -> dict[str, Driver]:
        """Its expert."""
        return {EXPERT_KEY: self.expert}

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...]:
        """What its own network sees, in order."""
        return observation_inputs(self.inputs, self.expert)

    def describe(self) -> str:
        """Return the expert in a few words, and that there is a residual."""
        return f"{self.expert.describe()} + residual"

    def recipe(self) -> Recipe:
        """Return what it is made from, without the network's weights."""
        files = user_files(self.inputs)
        return {
            "kind": "residual",
            "expert": self.expert.recipe(),
            "action_limit": self.action_limit,
            "inputs": list(self.inputs),
            "action_repeat": self.action_repeat,
            "authority": self.network.authority,
            "exploration_std": self.network.exploration_std,
            **({"episode_noise": True} if self.network.episode_noise else {}),
            **({"files": files} if files else {}),
        }

    def weights(self) -> Arrays:
        """Return the weights of its network and, with their prefix, those of its expert."""
        return {**super().weights(), **network_weights(self.network)}
