"""Policies of third parties: the description of their inputs and outputs, and the driver that contains them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from unjam.drivers.car_following import ACC, Constant
from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import FEATURES, Feature, NetworkInput, PolicyInput, Scale, unit_factor
from unjam.drivers.requirements import Requirements
from unjam.drivers.residual import ExpertWrapper
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import STRICT, Number, build_dataclass, parameter_dataclass
from unjam.physics.arrays import Array, namespace
from unjam.text import format_count

POLICY_KEY = "policy"
"""key of the policy's memory in the memory of a driver"""
OUTPUT_UNITS = {"acceleration": "m/s2", "desired_speed": "m/s", "set_speed": "m/s"}
"""quantities of a policy's output, with their SI units"""
REPEAT_TOLERANCE = 1e-6
"""allowed deviation of a number of control steps from an integer"""


@parameter_dataclass(frozen=True, config=STRICT)
class PolicyOutput:
    """The output of a policy: `offset + scale * number` is a quantity in `unit`."""

    quantity: Literal["acceleration", "desired_speed", "set_speed"] = "acceleration"
    """`desired_speed` is reached within one control step; `set_speed` is the set speed of an ACC, which also keeps its
    time gap to leaders"""
    unit: str = ""
    """km/h instead of m/s; empty: the SI unit"""
    scale: Scale = 1.0
    offset: Number = 0.0
    """value that is added, in `unit`"""
    limits: tuple[Number, Number] | None = None
    """lowest and highest value in `unit`; limits of an acceleration also limit the expert and the sum"""
    tensor: str = ""
    """output of an ONNX graph; empty: the only one"""

    @model_validator(mode="after")
    def _check_unit_and_limits(self) -> "PolicyOutput":
        unit_factor(self.unit, OUTPUT_UNITS[self.quantity])
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError(f"limits: {list(self.limits)} is not allowed; allowed: a lower and a higher value")
        return self

    def acceleration(self, numbers: Array, state: LocalState, time_step: float) -> Array:
        """Return accelerations [m/s2] for the numbers of a policy, shape (n,); `time_step` is the control step [s]."""
        value = numbers * self.scale + self.offset
        if self.limits is not None:
            value = value.clip(*self.limits)
        value = value / unit_factor(self.unit, OUTPUT_UNITS[self.quantity])
        if self.quantity == "set_speed":
            return ACC().acceleration(state, value)
        return (value - state.speed) / time_step if self.quantity == "desired_speed" else value


@parameter_dataclass(frozen=True, config=STRICT)
class PolicyMemory:
    """Recurrent state of an ONNX graph: names of an input and an output, which have one row for each CAV."""

    input: str
    output: str
    initial: Any = 0.0
    """one initial value for all numbers, or an array of initial values for one CAV; None is NaN, as in JSON"""


def _as_network_input(value: Any) -> NetworkInput:
    if isinstance(value, dict):
        return build_dataclass(PolicyInput, value, "inputs")
    if not isinstance(value, PolicyInput | Feature) and value not in FEATURES:
        raise unknown_name("inputs", value, FEATURES)
    return value


@parameter_dataclass(frozen=True, config=STRICT)
class PolicyDescription:
    """Meaning of the inputs and outputs of a policy."""

    inputs: Annotated[tuple[Annotated[Any, BeforeValidator(_as_network_input)], ...], Field(min_length=1)]
    """quantities, and names of features as in `policy.inputs`, in the order of the columns"""
    output: PolicyOutput = field(default_factory=PolicyOutput)
    time_step: Annotated[Number, Field(gt=0)] | None = None
    """control step of the policy, a multiple of that of the road [s]; None: that of the road"""
    memory: tuple[PolicyMemory, ...] = ()


@dataclass(frozen=True, eq=False)
class PolicyDriver(ExpertWrapper):
    """A policy of a third party, alone or added to an expert; other processes cannot build it."""

    portable_form: ClassVar[str] = "its .onnx file with a description, or, except in export, path.py:name that loads it"

    policy: Callable[[Any, Memory], tuple[Any, Memory]]
    """function of observations, shape (n, inputs), and memory; returns numbers, shape (n,) or (n, 1), and new memory"""
    label: str
    """name of the policy in messages and tables"""
    description: PolicyDescription
    expert: Driver = field(default_factory=Constant)
    time_step: float | None = None
    """control step of the road [s]; None: any control step, because neither output nor action repeat depends on it"""
    features: tuple[NetworkInput, ...] = field(init=False)
    action_repeat: int = field(init=False)

    def __post_init__(self) -> None:
        output, policy_step, road_step = self.description.output, self.description.time_step, self.time_step
        if output.quantity != "acceleration" and self.expert != Constant():
            raise invalid_value("output.quantity", output.quantity, "acceleration, which is added to an expert")
        ratio = 1.0 if policy_step is None or road_step is None else policy_step / road_step
        if round(ratio) < 1 or abs(ratio - round(ratio)) > REPEAT_TOLERANCE:
            raise invalid_value("time_step", policy_step, f"multiples of the road's control step, {road_step:g} s")
        if output.quantity != "desired_speed" and policy_step is None:
            object.__setattr__(self, "time_step", None)
        object.__setattr__(self, "features", self.description.inputs)
        object.__setattr__(self, "action_repeat", round(ratio))

    @cached_property
    def limits(self) -> Limits | None:
        """Limits of the expert's acceleration, and of the sum with the policy's output [m/s2]; None: of the road."""
        output = self.description.output
        return Limits(*output.limits) if output.quantity == "acceleration" and output.limits is not None else None

    def policy_memory(self, n: int) -> Memory:
        """Return the initial memory of the policy for `n` CAVs."""
        return {}

    def initial_memory(self, n: int) -> Memory:
        """Return the memories of expert and policy and, with an action repeat, the residual and its age."""
        return {**super().initial_memory(n), POLICY_KEY: self.policy_memory(n)}

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision with its components; raise `InputError` with `noise`, or for invalid numbers."""
        if noise is not None:
            raise InputError("explore: a policy of another library drives without exploration noise; allowed: 0")
        if not len(state.speed):  # the policy may fail without rows
            return Decision(Command(np.zeros(0)), np.zeros(0), np.zeros(0), None, memory)
        return super().decide(state, memory)._replace(observation=None)

    def residual(
        self, observation: Any, state: LocalState, memory: Memory, noise: NoiseSampler | None
    ) -> tuple[Array, Memory]:
        """Return the output of the policy as acceleration, and its new memory."""
        numbers, new_memory = self.evaluate(observation, memory[POLICY_KEY])
        step = self.action_repeat * (self.time_step or 0.0)
        return self.description.output.acceleration(numbers, state, step), {POLICY_KEY: new_memory}

    def evaluate(self, observation: Any, memory: Memory) -> tuple[Array, Memory]:
        """Return the numbers of the policy, shape (n,), and its new memory; `InputError` unless numbers are finite."""
        rows, xp = len(observation), namespace(observation)
        answer, new_memory = self.policy(observation, memory)
        numbers = np.asarray(answer) if xp is np else xp.as_tensor(answer)
        if numbers.shape not in ((rows,), (rows, 1)):
            problem = f"returns shape {numbers.shape} for {format_count(rows, 'CAV')}"
            raise InputError(f"driver {self.label}: {problem}; allowed: ({rows},) or ({rows}, 1)")
        if not (is_finite := xp.isfinite(numbers)).all():
            raise InputError(f"driver {self.label}: returns {numbers[~is_finite][0]}; allowed: finite")
        return numbers.reshape(rows), new_memory

    def describe(self) -> str:
        """Return the name of the policy, after the expert's description if there is one."""
        return self.label if self.expert == Constant() else f"{self.expert.describe()} + {self.label}"


@dataclass(frozen=True, eq=False)
class TensorPolicyDriver(PolicyDriver):
    """A policy that also takes torch tensors, through which gradients flow from the state to the acceleration."""

    class_requirements: ClassVar[Requirements] = Requirements(needs_arrays=True)
