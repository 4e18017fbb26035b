"""A driver that adds the actions of an environment to the accelerations of an expert."""

from typing import Any

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler, replace_memory_rows
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import FeatureArguments, NetworkInput, compute_observation, feature
from unjam.drivers.requirements import Requirements, RoadInterface, merge_requirements
from unjam.drivers.wrappers import INNER_KEY
from unjam.physics.arrays import replace_entries


class ExternalDriver(Driver):
    """Adds `actions`, which are set before each decision, to the accelerations of an expert."""

    def __init__(self, expert: Driver, features: tuple[NetworkInput, ...], limits: Limits) -> None:
        """Take an expert, the features of the observation, and the limits of accelerations."""
        self.expert, self.features, self._limits = expert, features, limits
        self.inner_drivers = {INNER_KEY: expert}
        self.actions: Any = np.zeros(0)
        """accelerations to add [m/s2], shape (CAVs,), or a float in a world with `is_scalar`"""

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return those of the expert and of the features."""
        of_features = (feature(name).requirements for name in self.features)
        return merge_requirements(self.expert.requirements(road), *of_features)

    def replace_rows(self, rows: Any, source: "ExternalDriver", source_rows: Any) -> None:
        """Replace the stored values of the CAVs in `rows` by those of `source_rows` of another driver."""
        acceleration = replace_entries(self._expert_acceleration, rows, source._expert_acceleration, source_rows)
        self._expert_acceleration = acceleration
        self._next_memory = replace_memory_rows(self._next_memory, rows, source._next_memory, source_rows)

    def observation(self, state: LocalState, memory: Memory) -> Any:
        """Return the observation as `compute_observation` does, and store the expert's acceleration and memory."""
        acceleration, new_memory = self.expert.act(state, memory[INNER_KEY])
        self._expert_acceleration, self._next_memory = self._limits.clip(acceleration), {INNER_KEY: new_memory}
        inputs = FeatureArguments(state, self._expert_acceleration, self.expert, new_memory)
        return compute_observation(self.features, inputs)

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the sum of the stored acceleration and the actions, within the limits."""
        if not isinstance(state.speed, float) and not len(state.speed):
            return Decision(Command(np.zeros(0)), np.zeros(0), np.zeros(0), None, memory)
        acceleration = self._limits.clip(self._expert_acceleration + self.actions)
        command = Command(acceleration, self.expert.time_gaps(state, memory[INNER_KEY]))
        return Decision(command, self._expert_acceleration, self.actions, None, self._next_memory)
