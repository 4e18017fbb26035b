"""An expert plus a learned residual: the paper's full policy, Eq. 8."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import ACCELERATION_SCALE, LocalState, ObservationPart, local_vector
from unjam.drivers.network import Network
from unjam.physics.arrays import Array, as_column, clip, join_columns


class Decision(NamedTuple):
    """One step of a residual driver, taken apart; every array has a row per CAV, plain numbers have none."""

    acceleration: Array
    """what is asked for: clip(expert + residual) [m/s2], shape (n,)"""
    expert: Array
    """the expert's share, clipped to the action limit [m/s2], shape (n,)"""
    residual: Array
    """the network's share with its exploration noise, not clipped [m/s2], shape (n,)"""
    observation: Array
    """what the network saw, shape (n, inputs)"""
    memory: Memory


def observe(
    parts: tuple[ObservationPart, ...],
    state: LocalState,
    expert_acceleration: Array,
    expert: Driver,
    memory: Memory,
) -> Array:
    """Return what the network sees: the chosen parts side by side, shape (n, inputs), no unit.

    `memory` is the expert's after its decision: what it will act on next.
    """
    blocks = []
    for part in parts:
        if part == "local":
            blocks.append(local_vector(state))
        elif part == "expert_acceleration":
            blocks.append(as_column(expert_acceleration / ACCELERATION_SCALE))
        else:
            features = expert.memory_features(memory)
            if features is not None:
                blocks.append(features)
    return join_columns(blocks)


@dataclass(frozen=True)
class ResidualDriver(Driver):
    """Adds what a network has learned to what an expert does, within the action limit.

    Any driver can be the expert, another `ResidualDriver` too.
    """

    expert: Driver
    network: Network
    action_limit: float
    """largest acceleration in either direction [m/s2]"""
    parts: tuple[ObservationPart, ...] = ("local",)
    """what the network sees"""

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the expert takes plain numbers."""
        return self.expert.plain_numbers

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's memory; the network has none."""
        return self.expert.initial_memory(n)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the expert makes of the warm-up."""
        return self.expert.recall(memory, history)

    def decide(self, state: LocalState, memory: Memory, noise: Array | None = None) -> Decision:
        """Return the decision taken apart; with standard normal `noise`, shape (n,), it explores."""
        wanted, memory = self.expert.act(state, memory)
        expert = clip(wanted, -self.action_limit, self.action_limit)
        observation = observe(self.parts, state, expert, self.expert, memory)
        network = self.network
        residual = network(observation) if noise is None else network.explore(observation, noise)
        acceleration = clip(expert + residual, -self.action_limit, self.action_limit)
        return Decision(acceleration, expert, residual, observation, memory)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the expert's new memory."""
        decision = self.decide(state, memory)
        return decision.acceleration, decision.memory

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.memory_features(memory)


def observation_size(parts: tuple[ObservationPart, ...], expert: Driver) -> int:
    """Return how many numbers the network sees with this expert."""
    one = np.ones(1)
    state = LocalState(*([one] * len(LocalState._fields)))
    acceleration, memory = expert.act(state, expert.initial_memory(1))
    return observe(parts, state, acceleration, expert, memory).shape[1]
