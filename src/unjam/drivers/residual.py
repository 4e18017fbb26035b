"""An expert plus a learned residual: the paper's full policy, Eq. 8."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import (
    ACCELERATION_SCALE,
    LOOP_LENGTH_SCALE,
    OBSERVED,
    ROUTE_POSITION_SCALE,
    LocalState,
    ObservationPart,
    Observed,
    lap_place,
    local_vector,
)
from unjam.drivers.network import Network
from unjam.errors import InputError
from unjam.physics.arrays import Array, as_column, clip, join_columns, namespace


class Decision(NamedTuple):
    """One step of a residual driver, taken apart; every array has a row per CAV, plain numbers have none."""

    acceleration: Array
    """what is asked for: clip(expert + residual) [m/s2], shape (n,)"""
    expert: Array
    """the expert's share, clipped to the action limit [m/s2], shape (n,)"""
    residual: Array
    """the network's share with its exploration noise, not clipped [m/s2], shape (n,)"""
    observation: Array
    """what the network saw, shape (n, inputs); empty for a single CAV whose residual is being held"""
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
        elif part == "loop_length":
            blocks.append(as_column(state.loop_length / LOOP_LENGTH_SCALE))
        elif part == "place":
            blocks.append(lap_place(state))
        elif part == "route_position":
            blocks.append(as_column(state.route_position / ROUTE_POSITION_SCALE))
        elif part == "expert_acceleration":
            blocks.append(as_column(expert_acceleration / ACCELERATION_SCALE))
        else:
            features = expert.memory_features(memory)
            if features is not None:
                blocks.append(features)
    if not blocks:
        raise InputError("policy.observe: expert_memory alone is not allowed: the expert remembers nothing")
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
    hold: int = 1
    """decisions for which one residual is held; the expert goes on deciding in each of them"""

    @property
    def plain_numbers(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the expert takes plain numbers."""
        return self.expert.plain_numbers

    @property
    def tensors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the expert takes tensors; the network does."""
        return getattr(self.expert, "tensors", False)

    @property
    def needs_loop(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the expert must know its place on a closed road."""
        return self.expert.needs_loop

    @property
    def observed_memory(self) -> tuple[Observed, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the expert's `memory_features` are."""
        return self.expert.observed_memory

    @cached_property
    def _keys(self) -> tuple[str, str]:
        """Names of the held residual and its age in the memory: others than those of an expert like this."""
        depth, expert = 0, self.expert
        while isinstance(expert, ResidualDriver):
            depth, expert = depth + 1, expert.expert
        return f"residual_{depth}", f"residual_age_{depth}"

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's memory and, where a residual is held, the residual and its age."""
        memory = self.expert.initial_memory(n)
        if self.hold == 1:
            return memory
        return {**memory, **{key: np.zeros(n) for key in self._keys}}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the expert makes of the warm-up."""
        return {**memory, **self.expert.recall(memory, history)}

    def expert_memory(self, memory: Memory) -> Memory:
        """Return what of `memory` is the expert's."""
        return {key: value for key, value in memory.items() if key not in self._keys}

    def decide(self, state: LocalState, memory: Memory, noise: Array | None = None) -> Decision:
        """Return the decision taken apart; with standard normal `noise`, shape (n,), it explores."""
        wanted, after = self.expert.act(state, memory)
        expert = clip(wanted, -self.action_limit, self.action_limit)
        if self.hold == 1:
            observation, residual = self._look(state, expert, after, noise)
        else:
            held, age = self._keys
            observation, residual = self._look_or_hold(state, expert, after, noise, memory)
            after = {**after, held: residual, age: memory[age] + 1.0}
        acceleration = clip(expert + residual, -self.action_limit, self.action_limit)
        return Decision(acceleration, expert, residual, observation, after)

    def observation(self, state: LocalState, memory: Memory) -> Array:
        """Return what the network would see now, whether or not its residual is being held."""
        wanted, after = self.expert.act(state, memory)
        expert = clip(wanted, -self.action_limit, self.action_limit)
        return observe(self.parts, state, expert, self.expert, after)

    def _look(
        self, state: LocalState, expert: Array, after: Memory, noise: Array | None
    ) -> tuple[Array, Array]:
        """Return what the network sees, and its residual."""
        observation = observe(self.parts, state, expert, self.expert, after)
        network = self.network
        return observation, network(observation) if noise is None else network.explore(observation, noise)

    def _look_or_hold(
        self, state: LocalState, expert: Array, after: Memory, noise: Array | None, memory: Memory
    ) -> tuple[Array, Array]:
        """Return what the network sees and the residual: a new one where the held one is old enough."""
        held, age = self._keys
        due = memory[age] % self.hold == 0
        if due is False:  # a single CAV in plain numbers: the network need not be asked
            return (), memory[held]
        observation, fresh = self._look(state, expert, after, noise)
        return observation, namespace(fresh).where(due, fresh, memory[held])

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the expert's new memory."""
        decision = self.decide(state, memory)
        return decision.acceleration, decision.memory

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the expert's."""
        return self.expert.memory_features(memory)


def observed(parts: tuple[ObservationPart, ...], expert: Driver) -> tuple[Observed, ...]:
    """Return what the network sees with this expert, in the order of `observe`."""
    remembered = observation_size(parts, expert) - sum(len(OBSERVED.get(part, ())) for part in parts)
    unnamed = tuple(Observed(f"expert's memory {number}", 1.0, "") for number in range(remembered))
    names = {**OBSERVED, "expert_memory": expert.observed_memory or unnamed}
    return tuple(number for part in parts for number in names[part])


def observation_size(parts: tuple[ObservationPart, ...], expert: Driver) -> int:
    """Return how many numbers the network sees with this expert."""
    one = np.ones(1)
    state = LocalState(*([one] * len(LocalState._fields)))
    acceleration, memory = expert.act(state, expert.initial_memory(1))
    if np.shape(acceleration) != (1,):
        shape = np.shape(acceleration)
        raise InputError(f"driver: acceleration has shape {shape}; allowed: one for each CAV")
    return observe(parts, state, acceleration, expert, memory).shape[1]
