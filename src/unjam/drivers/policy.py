"""Policies that others have trained: what their numbers mean, and the driver around them."""

from collections.abc import Callable
from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from functools import cached_property
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import ACC, Constant
from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler, Recipe
from unjam.drivers.local_state import LocalState, ScaledInput
from unjam.drivers.observation import (
    FEATURES,
    FeatureInputs,
    NetworkInput,
    PolicyInput,
    Scale,
    compute_observation,
    feature,
    observation_inputs,
    unit_factor,
)
from unjam.drivers.requirements import Requirements, RoadInterface, merge_requirements
from unjam.drivers.residual import EXPERT_KEY
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import STRICT, Positive, build_dataclass
from unjam.physics.arrays import Array
from unjam.tree import map_leaves

POLICY_KEY, ACTION_KEY, AGE_KEY = "policy", "action", "age"
"""names in the memory: that of the policy; its repeated action, and the control steps so far"""
OUTPUT_UNITS = {"acceleration": "m/s2", "desired_speed": "m/s", "set_speed": "m/s"}
REPEAT_TOLERANCE = 1e-6
"""allowed deviation of a number of control steps from an integer"""


@dataclass(frozen=True, config=STRICT)
class PolicyOutput:
    """The output of a policy: `offset + scale * number` is a quantity in a unit."""

    quantity: Literal["acceleration", "desired_speed", "set_speed"] = "acceleration"
    """`desired_speed` is reached within one control step; `set_speed` is that of an ACC, which also follows leaders"""
    unit: str = ""
    """km/h instead of m/s; empty: the SI unit"""
    scale: Scale = 1.0
    offset: float = 0.0
    """in the unit"""
    limits: tuple[float, float] | None = None
    """lowest and highest value in the unit; those of an acceleration also limit the expert's and the sum"""
    tensor: str = ""
    """output of an ONNX graph; empty: the only one"""

    @model_validator(mode="after")
    def _check(self) -> "PolicyOutput":
        unit_factor(self.unit, OUTPUT_UNITS[self.quantity])
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError(f"limits: {list(self.limits)} is not allowed; allowed: a lower and a higher value")
        return self

    def acceleration(self, numbers: Array, state: LocalState, time_step: float) -> Array:
        """Return accelerations [m/s2] for the numbers of a policy with this control step [s], shape (n,)."""
        value = numbers * self.scale + self.offset
        if self.limits is not None:
            value = value.clip(*self.limits)
        value = value / unit_factor(self.unit, OUTPUT_UNITS[self.quantity])
        if self.quantity == "set_speed":
            return ACC().acceleration(state, value)
        return (value - state.speed) / time_step if self.quantity == "desired_speed" else value


def _without_nan(value: Any) -> Any:
    """Return a value of JSON, which has no NaN."""
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if value != value else value


@dataclass(frozen=True, config=STRICT)
class PolicyMemory:
    """Recurrent state of an ONNX graph: an input and an output whose first axis is the row of the CAV."""

    input: str
    output: str
    initial: Annotated[float | list[Any] | None, BeforeValidator(_without_nan)] = 0.0
    """initial value of all numbers, or of each number of one CAV; None: NaN"""


def _as_input(value: Any) -> Any:
    if isinstance(value, dict):
        return build_dataclass(PolicyInput, value, "inputs")
    if not isinstance(value, PolicyInput) and value not in FEATURES:
        raise unknown_name("inputs", value, FEATURES)
    return value


@dataclass(frozen=True, config=STRICT)
class PolicyDescription:
    """What the inputs and outputs of an ONNX graph mean."""

    inputs: Annotated[tuple[Annotated[Any, BeforeValidator(_as_input)], ...], Field(min_length=1)]
    """columns in order: quantities, and names of features as in `policy.inputs`"""
    output: PolicyOutput = field(default_factory=PolicyOutput)
    time_step: Positive | None = None
    """control step of the policy, a multiple of that of the road [s]; None: that of the road"""
    memory: tuple[PolicyMemory, ...] = ()


class Policy(Protocol):
    """The deterministic function of a policy."""

    def initial_memory(self, n: int) -> Memory:
        """Return its recurrent state for `n` CAVs."""
        ...

    def __call__(self, observation: NDArray[np.float64], memory: Memory) -> tuple[Any, Memory]:
        """Return numbers, shape (n,) or (n, 1), and the new state, for observations, shape (n, inputs)."""
        ...


@plain_dataclass(frozen=True, eq=False)
class MemorylessPolicy:
    """A function of the observation as a `Policy`."""

    function: Callable[[NDArray[np.float64]], Any]

    def initial_memory(self, n: int) -> Memory:
        """Return nothing."""
        return {}

    def __call__(self, observation: NDArray[np.float64], memory: Memory) -> tuple[Any, Memory]:
        """Return the numbers of the function, and nothing."""
        return self.function(observation), memory


@plain_dataclass(frozen=True, eq=False)
class PolicyDriver(Driver):
    """A policy that others have trained, alone or added to an expert; other processes cannot build it."""

    policy: Policy
    label: str
    """name of the policy in messages and tables"""
    inputs: tuple[NetworkInput, ...]
    output: PolicyOutput
    expert: Driver = field(default_factory=Constant)
    time_step: float | None = None
    """control step of the road [s]; None: any, as neither the output nor the action repeat depends on it"""
    action_repeat: int = 1
    """control steps for which one action is repeated"""
    limits: Limits | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """limits of the expert and of the sum [m/s2]; None: those of the road"""

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:
        """The expert."""
        return {EXPERT_KEY: self.expert}

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return those of the expert and of the inputs."""
        return merge_requirements(super().requirements(road), *(feature(each).requirements for each in self.inputs))

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...]:
        """Its inputs, in order."""
        return observation_inputs(self.inputs, self.expert)

    def initial_memory(self, n: int) -> Memory:
        """Return those of expert and policy and, with an action repeat, the action and its age."""
        own = {} if self.action_repeat == 1 else {ACTION_KEY: np.zeros(n), AGE_KEY: np.zeros(n)}
        return {**super().initial_memory(n), POLICY_KEY: self.policy.initial_memory(n), **own}

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision with its components; raise `InputError` with `noise`, or for invalid numbers."""
        if noise is not None:
            raise InputError("explore: a policy of another library drives without exploration noise; allowed: 0")
        if not len(state.speed):  # the policy may need a row
            return Decision(Command(np.zeros(0)), np.zeros(0), np.zeros(0), None, memory)
        expert, expert_memory = self.expert.act(state, memory[EXPERT_KEY])
        expert = expert if self.limits is None else self.limits.clip(expert)
        observation = compute_observation(self.inputs, FeatureInputs(state, expert, self.expert, expert_memory))
        numbers, policy_memory = self.evaluate(observation, memory[POLICY_KEY])
        action = self.output.acceleration(numbers, state, self.action_repeat * (self.time_step or 0.0))
        after = {EXPERT_KEY: expert_memory, POLICY_KEY: policy_memory}
        if self.action_repeat > 1:
            is_due = memory[AGE_KEY] % self.action_repeat == 0

            def keep(new: Array, old: Array) -> Array:
                return np.where(is_due.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

            action = keep(action, memory[ACTION_KEY])
            after[POLICY_KEY] = map_leaves(keep, policy_memory, memory[POLICY_KEY])
            after |= {ACTION_KEY: action, AGE_KEY: memory[AGE_KEY] + 1.0}
        total = expert + action
        command = Command(total if self.limits is None else self.limits.clip(total), self.time_gaps(state, memory))
        return Decision(command, expert, action, None, after)

    def evaluate(self, observation: Any, memory: Memory) -> tuple[Array, Memory]:
        """Return the numbers of the policy, shape (n,), and its new memory.

        Raise `InputError` if they are not finite, or of another shape.
        """
        rows = len(observation)
        answer, after = self.policy(observation, memory)
        numbers = np.asarray(answer)
        if numbers.shape not in ((rows,), (rows, 1)):
            allowed = f"allowed: ({rows},) or ({rows}, 1)"
            raise InputError(f"driver {self.label}: returns shape {numbers.shape} for {rows} CAVs; {allowed}")
        if not np.isfinite(numbers).all():
            raise InputError(f"driver {self.label}: returns {numbers[~np.isfinite(numbers)][0]}; allowed: finite")
        return numbers.reshape(rows), after

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration and the new memory."""
        decision = self.decide(state, memory)
        return decision.command.acceleration, decision.memory

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the expert."""
        return self.expert.time_gaps(state, memory[EXPERT_KEY])

    def describe(self) -> str:
        """Return the name of the policy, after the expert's description if there is one."""
        return self.label if self.expert == Constant() else f"{self.expert.describe()} + {self.label}"

    def recipe(self) -> Recipe:
        """Return the recipe of a driver without a name, which cannot be built from it."""
        return {"kind": "named", "name": "", "parameters": {}}


def action_limits(output: PolicyOutput, expert: Driver) -> Limits | None:
    """Return the limits of an expert and of its sum with an output; raise `InputError` if they cannot be added."""
    if output.quantity != "acceleration" and expert != Constant():
        raise invalid_value("output.quantity", output.quantity, "acceleration, which is added to an expert")
    return Limits(*output.limits) if output.quantity == "acceleration" and output.limits is not None else None


def assumed_time_step(output: PolicyOutput, policy_step: float | None, time_step: float) -> float | None:
    """Return the control step of the road that a policy driver assumes [s]; None: any."""
    return time_step if output.quantity == "desired_speed" or policy_step is not None else None


def action_repeat(policy_step: float | None, time_step: float) -> int:
    """Return the control steps of the road in one of the policy [s]; raise `InputError` if it is not an integer."""
    ratio = 1.0 if policy_step is None else policy_step / time_step
    if round(ratio) < 1 or abs(ratio - round(ratio)) > REPEAT_TOLERANCE:
        raise invalid_value("time_step", policy_step, f"multiples of the road's control step, {time_step:g} s")
    return round(ratio)
