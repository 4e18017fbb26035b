"""ONNX graphs of third parties as drivers: data that workers and controller files can contain."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.check import PROBE_ROWS, check_row_independence
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.observation import PolicyInput, observation_size
from unjam.drivers.policy import PolicyDescription, PolicyDriver, PolicyMemory
from unjam.errors import InputError, invalid_value, prefix_errors, unknown_name
from unjam.onnx_models import check_model, open_session, parse_model, remove_texts, run_session, time_limit

OPSETS, IR_VERSIONS = range(9, 26), range(4, 14)  # allowed versions of the operators and of the format
TYPES: dict[int, type[np.floating[Any]]] = {1: np.float32, 11: np.float64}
"""allowed types of inputs and outputs, by their numbers in ONNX"""
MAX_MEMORY_NUMBERS = 100_000  # largest count of numbers in the recurrent state of one CAV


class Tensor(NamedTuple):
    """An input or output of a graph."""

    type: type[np.floating[Any]]
    shape: tuple[int, ...] | None  # 0 for an axis without a fixed length; None: unknown


@dataclass(frozen=True, eq=False)
class OnnxPolicy:
    """A checked graph as the function of a policy."""

    graph: bytes
    columns: dict[str, tuple[int, ...]]  # columns of the observation by name of the input
    output: str
    memory: tuple[PolicyMemory, ...]
    inputs: dict[str, Tensor]  # inputs of the graph by name
    is_batched: bool  # whether the graph takes any number of rows; otherwise it runs once for each CAV

    def initial_memory(self, n: int) -> Memory:
        """Return the initial recurrent state of `n` CAVs, in the types of the graph."""
        initial_arrays: Memory = {}
        for entry in self.memory:
            tensor = self.inputs[entry.input]
            initial = np.array(entry.initial, tensor.type)
            initial_arrays[entry.input] = np.broadcast_to(initial, (n, *(tensor.shape or ())[1:])).copy()
        return initial_arrays

    def __call__(self, observation: NDArray[np.float64], memory: Memory) -> tuple[Any, Memory]:
        """Return the output of the graph and the new recurrent state; raise `InputError` if the graph fails."""
        inputs = {name: self._input_array(name, observation[:, columns]) for name, columns in self.columns.items()}
        inputs |= memory
        output_names = [self.output, *(entry.output for entry in self.memory)]
        session = _cached_session(self.graph)
        if self.is_batched:
            outputs = run_session(session, output_names, inputs)
        else:
            inputs_by_row = (
                {name: array[row : row + 1] for name, array in inputs.items()} for row in range(len(observation))
            )
            outputs_by_row = [run_session(session, output_names, row_inputs) for row_inputs in inputs_by_row]
            outputs = [np.concatenate(arrays) for arrays in zip(*outputs_by_row, strict=True)]
        numbers, *new_memory = outputs
        return numbers, dict(zip(memory, new_memory, strict=True))

    def _input_array(self, name: str, columns: NDArray[np.float64]) -> NDArray[Any]:
        tensor = self.inputs[name]
        array = columns.astype(tensor.type)
        return array[:, 0] if len(tensor.shape or ()) == 1 else array


_cached_session = lru_cache(maxsize=16)(open_session)


@dataclass(frozen=True, eq=False)
class OnnxDriver(PolicyDriver):
    """The policy of an ONNX graph, alone or added to an expert; raises the errors of `unjam.adapters.onnx_driver`."""

    policy: Any = field(init=False)  # an `OnnxPolicy`
    graph: NDArray[np.uint8] = field(kw_only=True, repr=False)  # bytes of the graph

    def __post_init__(self) -> None:
        with prefix_errors(f"driver {self.label}: "):
            super().__post_init__()
            if self.graph.dtype != np.uint8 or self.graph.ndim != 1:
                raise InputError("graph: it is not bytes")
            policy = _read_policy(self.graph.tobytes(), self.description, self.expert)
            object.__setattr__(self, "policy", policy)
            object.__setattr__(self, "graph", np.frombuffer(policy.graph, np.uint8))
            with time_limit():
                _check_outputs(self)

    def policy_memory(self, n: int) -> Memory:
        """Return the initial recurrent state of the graph for `n` CAVs."""
        return self.policy.initial_memory(n)


def _read_policy(content: bytes, description: PolicyDescription, expert: Driver) -> OnnxPolicy:
    """Return the policy of a graph; raise `InputError` if the graph is not allowed, or does not fit the description."""
    model = parse_model(content)
    remove_texts(model)
    check_model(model, model.ByteSize(), OPSETS, IR_VERSIONS)
    inputs = {tensor.name: _read_tensor(tensor) for tensor in model.graph.input}
    outputs = {tensor.name: _read_tensor(tensor) for tensor in model.graph.output}
    memory_inputs = {entry.input for entry in description.memory}
    if unknown_inputs := memory_inputs - inputs.keys():
        raise unknown_name("memory.input", min(unknown_inputs), inputs)
    columns = _assign_columns(description, expert, [name for name in inputs if name not in memory_inputs])
    for name, input_columns in columns.items():
        _check_columns(name, inputs[name].shape, len(input_columns))
    memory_outputs = {entry.output for entry in description.memory}
    policy_outputs = [name for name in outputs if name not in memory_outputs]
    output = description.output.tensor
    if output not in policy_outputs and (output or len(policy_outputs) != 1):
        raise unknown_name("output.tensor", output, policy_outputs)
    for entry in description.memory:
        _check_memory(entry, inputs, outputs)
    is_batched = not any((inputs[name].shape or (0,))[0] for name in inputs)
    content = model.SerializeToString()
    return OnnxPolicy(content, columns, output or policy_outputs[0], description.memory, inputs, is_batched)


def _read_tensor(value_info: Any) -> Tensor:
    if not value_info.name.isprintable():
        raise invalid_value("graph: name", value_info.name, "printable characters")
    tensor_type = value_info.type.tensor_type
    if (number := tensor_type.elem_type) not in TYPES:
        raise InputError(f"graph: {value_info.name!r} has the type {number}; allowed: 1 (float32) or 11 (float64)")
    shape = tuple(dimension.dim_value for dimension in tensor_type.shape.dim) if tensor_type.HasField("shape") else None
    return Tensor(TYPES[number], shape)


def _assign_columns(description: PolicyDescription, expert: Driver, names: list[str]) -> dict[str, tuple[int, ...]]:
    """Return the columns of the observation for each input of the graph; `names` are the inputs without memory."""
    columns: dict[str, list[int]] = {name: [] for name in names}
    first_column = 0
    for policy_input in description.inputs:
        name, quantity = (
            (policy_input.tensor, policy_input.quantity) if isinstance(policy_input, PolicyInput) else ("", "")
        )
        if not name:
            name = quantity if quantity in columns else names[0] if len(names) == 1 else ""
        if name not in columns:
            raise unknown_name(f"inputs: tensor of {policy_input!r}", name, names)
        size = observation_size((policy_input,), expert)
        columns[name] += range(first_column, first_column + size)
        first_column += size
    for name in names:
        if not columns[name]:
            raise InputError(f"inputs: nothing for the input {name!r} of the graph; allowed: a quantity, or memory")
    return {name: tuple(input_columns) for name, input_columns in columns.items()}


def _check_columns(name: str, shape: tuple[int, ...] | None, count: int) -> None:
    allowed_row_shapes = {(count,), (0,), *([()] if count == 1 else [])}
    if shape is None or shape[:1] not in ((0,), (1,)) or shape[1:] not in allowed_row_shapes:
        raise InputError(f"input {name!r}: shape {_shape_text(shape)} is not allowed; allowed: (n, {count})")


def _check_memory(memory: PolicyMemory, inputs: dict[str, Tensor], outputs: dict[str, Tensor]) -> None:
    if memory.output not in outputs:
        raise unknown_name("memory.output", memory.output, outputs)
    input_tensor, output_tensor = inputs[memory.input], outputs[memory.output]
    shape = input_tensor.shape
    if shape is None or shape[:1] not in ((0,), (1,)) or 0 in shape[1:] or np.prod(shape[1:]) > MAX_MEMORY_NUMBERS:
        allowed = f"(n, fixed lengths), at most {MAX_MEMORY_NUMBERS:,} numbers"
        raise InputError(f"memory {memory.input!r}: shape {_shape_text(shape)} is not allowed; allowed: {allowed}")
    if output_tensor.type != input_tensor.type:
        raise InputError(f"memory {memory.output!r}: type is not allowed; allowed: the type of {memory.input!r}")
    try:
        np.broadcast_to(np.array(memory.initial, input_tensor.type), shape[1:])
    except (TypeError, ValueError):
        allowed = f"a number, or numbers of shape {shape[1:]}"
        raise InputError(f"memory {memory.input!r}: initial value is not allowed; allowed: {allowed}") from None


def _shape_text(shape: tuple[int, ...] | None) -> str:
    return "unknown" if shape is None else f"({', '.join(str(length or 'n') for length in shape)})"


def _check_outputs(driver: OnnxDriver) -> None:
    """Raise `InputError` unless a graph runs, returns numbers, and computes rows independently."""
    size = observation_size(driver.features, driver.expert)
    observation = np.random.default_rng(0).uniform(0.0, 1.0, (PROBE_ROWS, size))
    initial_memory = driver.policy_memory(PROBE_ROWS)
    _, new_memory = driver.evaluate(observation, initial_memory)
    for name, array in initial_memory.items():
        if np.shape(new_memory[name]) != array.shape:
            raise InputError(f"memory {name!r}: returns shape {np.shape(new_memory[name])}; allowed: {array.shape}")
    check_row_independence(
        lambda rows: driver.evaluate(observation[rows], driver.policy_memory(len(observation[rows])))[0], "graph"
    )
