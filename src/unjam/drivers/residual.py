"""An expert plus a learned residual: the full policy of the paper, Eq. 8."""

from dataclasses import field
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, InstanceOf

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler
from unjam.drivers.local_state import LocalState, ScaledInput
from unjam.drivers.network import Network
from unjam.drivers.observation import (
    FEATURES,
    FeatureArguments,
    FeatureName,
    NetworkInput,
    compute_observation,
    feature,
    load_feature,
    observation_inputs,
)
from unjam.drivers.requirements import NO_REQUIREMENTS, Requirements, RoadInterface, merge_requirements
from unjam.drivers.user_driver import FileReference
from unjam.drivers.wrappers import COMPOSITE_CONFIG, DriverWrapper, select_rows
from unjam.errors import invalid_value
from unjam.parameters import Positive, PositiveInt, parameter_dataclass
from unjam.physics.arrays import Array, namespace
from unjam.tree import map_leaves

EXPERT_KEY, RESIDUAL_KEY, RESIDUAL_AGE_KEY = "expert", "residual", "age"
"""keys in the memory: memory of the expert; repeated residual, and number of control steps so far"""
MAX_AUTHORITY = 2.0
"""largest authority of a network relative to the action limit: the residual can then replace one limit by the other"""


class ExpertWrapper(DriverWrapper):
    """Adds a residual to the acceleration of an expert, within the limits, and can repeat it for several steps."""

    inner_key: ClassVar[str] = EXPERT_KEY

    expert: Driver
    features: tuple[NetworkInput, ...]
    """inputs of the network or policy that computes the residual"""

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return the requirements of the expert and of the features."""
        return merge_requirements(super().requirements(road), *(feature(name).requirements for name in self.features))

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...]:
        """Descriptions of the inputs of the network or policy, in order."""
        return observation_inputs(self.features, self.expert)

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the expert and, with an action repeat, the residual and its age."""
        repeated = {} if self.action_repeat == 1 else {RESIDUAL_KEY: np.zeros(n), RESIDUAL_AGE_KEY: np.zeros(n)}
        return {**super().initial_memory(n), **repeated}

    def residual(
        self, observation: Any, state: LocalState, memory: Memory, noise: NoiseSampler | None
    ) -> tuple[Array, Memory]:
        """Return the residual [m/s2], and the new memory of the network or policy."""
        raise NotImplementedError

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision with its components; with `noise`, the residual explores."""
        acceleration, expert_memory = self.expert.act(state, memory[EXPERT_KEY])
        limits, repeat, new_memory = self.limits, self.action_repeat, {}
        expert = acceleration if limits is None else limits.clip(acceleration)
        is_due: Any = True if repeat == 1 else memory[RESIDUAL_AGE_KEY] % repeat == 0
        if is_due is False:  # only for plain numbers: for arrays `is_due` is an array
            observation, residual = (), memory[RESIDUAL_KEY]
        else:
            arguments = FeatureArguments(state, expert, self.expert, expert_memory)
            observation = compute_observation(self.features, arguments)
            residual, new_memory = self.residual(observation, state, memory, noise)
            if is_due is not True:
                residual = namespace(residual).where(is_due, residual, memory[RESIDUAL_KEY])
                new_memory = map_leaves(partial(select_rows, is_due), new_memory, memory)
        new_memory = {**memory, EXPERT_KEY: expert_memory, **new_memory}
        if repeat > 1:
            new_memory |= {RESIDUAL_KEY: residual, RESIDUAL_AGE_KEY: memory[RESIDUAL_AGE_KEY] + 1.0}
        total = expert + residual
        command = Command(total if limits is None else limits.clip(total), self.time_gaps(state, memory))
        return Decision(command, expert, residual, observation, new_memory)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the deterministic acceleration, clip(expert + residual), and the new memory."""
        decision = self.decide(state, memory)
        return decision.command.acceleration, decision.memory


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class ResidualDriver(ExpertWrapper):
    """Adds the output of a network to any driver, the expert, within the action limit: Eq. 8 of the paper."""

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS

    expert: Driver
    network: InstanceOf[Network]
    action_limit: Positive
    """largest acceleration in either direction [m/s2]"""
    inputs: Annotated[tuple[FeatureName, ...], Field(min_length=1)] = ("local",)
    """features that the network reads"""
    action_repeat: PositiveInt = 1
    """control steps for which one residual is repeated; the expert decides in every control step"""
    files: tuple[FileReference, ...] = field(default=(), repr=False, compare=False)
    """the user's files of features; references with hashes require files with these hashes"""

    def __post_init__(self) -> None:
        if self.network.authority > (highest := MAX_AUTHORITY * self.action_limit):
            raise invalid_value("network: authority", self.network.authority, f"at most {highest} m/s2")
        references = [FileReference.parse(name) for name in self.inputs if name not in FEATURES]
        files = self.files or references  # files of a recipe have absolute paths and hashes
        if list(map(str, references)) != list(map(str, files)):
            raise invalid_value("files", list(map(str, files)), f"{list(map(str, references))}, as in inputs")
        user_features = list(map(load_feature, files))
        next_user_feature = iter(user_features)
        features = tuple(FEATURES.get(name) or next(next_user_feature)[0] for name in self.inputs)
        object.__setattr__(self, "features", features)
        object.__setattr__(self, "files", tuple(file for _, file in user_features))

    @cached_property
    def limits(self) -> Limits:
        """Limits of the expert's acceleration, and of the sum of acceleration and residual [m/s2]."""
        return Limits.symmetric(self.action_limit)

    @property
    def episode_noise_size(self) -> int:
        """Number of exploration noise values of the network that are constant in an episode."""
        return self.network.episode_noise_size

    def residual(
        self, observation: Any, state: LocalState, memory: Memory, noise: NoiseSampler | None
    ) -> tuple[Array, Memory]:
        """Return the output of the network, which has no memory."""
        return self.network(observation) if noise is None else self.network.explore(observation, noise()), {}

    def observation(self, state: LocalState, memory: Memory) -> Array:
        """Return the current input of the network, also while its residual is repeated."""
        acceleration, new_memory = self.expert.act(state, memory[EXPERT_KEY])
        arguments = FeatureArguments(state, self.limits.clip(acceleration), self.expert, new_memory)
        return compute_observation(self.features, arguments)

    def describe(self) -> str:
        """Return the description of the expert, and that there is a residual."""
        return f"{self.expert.describe()} + residual"
