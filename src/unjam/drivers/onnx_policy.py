"""An ONNX graph of a third party as a driver: data, which workers and controller files carry."""

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
MAX_MEMORY_NUMBERS = 100_000  # maximum count of numbers in the recurrent state of one CAV


class Tensor(NamedTuple):
    """An input or output of a graph."""

    type: type[np.floating[Any]]
    shape: tuple[int, ...] | None  # 0 for an axis without a fixed length; None: unknown


@dataclass(frozen=True, eq=False)
class OnnxPolicy:
    """A checked graph as the function of a policy."""

    graph: bytes
    columns: dict[str, tuple[int, ...]]  # columns of the observation, by input
    output: str
    memory: tuple[PolicyMemory, ...]
    tensors: dict[str, Tensor]  # inputs of the graph by name
    is_batched: bool  # whether the graph takes any number of rows; otherwise it runs once for each CAV

    def initial_memory(self, n: int) -> Memory:
        """Return the initial recurrent state of `n` CAVs, in the types of the graph."""
        rows: Memory = {}
        for entry in self.memory:
            tensor = self.tensors[entry.input]
            initial = np.array(entry.initial, tensor.type)
            rows[entry.input] = np.broadcast_to(initial, (n, *(tensor.shape or ())[1:])).copy()
        return rows

    def __call__(self, observation: NDArray[np.float64], memory: Memory) -> tuple[Any, Memory]:
        """Return the numbers of the graph and the new recurrent state; raise `InputError` if it cannot be run."""
        values = {name: self._as_input(name, observation[:, columns]) for name, columns in self.columns.items()}
        values |= memory
        outputs = [self.output, *(entry.output for entry in self.memory)]
        session = _cached_session(self.graph)
        if self.is_batched:
            answers = run_session(session, outputs, values)
        else:
            rows = range(len(observation))
            single = [run_session(session, outputs, {k: v[row : row + 1] for k, v in values.items()}) for row in rows]
            answers = [np.concatenate(parts) for parts in zip(*single, strict=True)]
        numbers, *new_values = answers
        return numbers, dict(zip(memory, new_values, strict=True))

    def _as_input(self, name: str, columns: NDArray[np.float64]) -> NDArray[Any]:
        tensor = self.tensors[name]
        values = columns.astype(tensor.type)
        return values[:, 0] if len(tensor.shape or ()) == 1 else values


_cached_session = lru_cache(maxsize=16)(open_session)


@dataclass(frozen=True, eq=False)
class OnnxDriver(PolicyDriver):
    """A policy from an ONNX graph, alone or added to an expert; raises errors as `unjam.adapters.onnx_driver`."""

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
                _probe(self)

    def policy_memory(self, n: int) -> Memory:
        """Return the initial recurrent state of the graph for `n` CAVs."""
        return self.policy.initial_memory(n)


def _read_policy(content: bytes, description: PolicyDescription, expert: Driver) -> OnnxPolicy:
    model = parse_model(content)
    remove_texts(model)
    check_model(model, model.ByteSize(), OPSETS, IR_VERSIONS)
    inputs = {tensor.name: _read_tensor(tensor) for tensor in model.graph.input}
    outputs = {tensor.name: _read_tensor(tensor) for tensor in model.graph.output}
    remembered = {entry.input for entry in description.memory}
    if unknown := remembered - inputs.keys():
        raise unknown_name("memory.input", min(unknown), inputs)
    columns = _assign_columns(description, expert, [name for name in inputs if name not in remembered])
    for name, positions in columns.items():
        _check_columns(name, inputs[name].shape, len(positions))
    memory_outputs = {entry.output for entry in description.memory}
    names = [name for name in outputs if name not in memory_outputs]
    output = description.output.tensor
    if output not in names and (output or len(names) != 1):
        raise unknown_name("output.tensor", output, names)
    for entry in description.memory:
        _check_memory(entry, inputs, outputs)
    is_batched = not any((inputs[name].shape or (0,))[0] for name in inputs)
    content = model.SerializeToString()
    return OnnxPolicy(content, columns, output or names[0], description.memory, inputs, is_batched)


def _read_tensor(value: Any) -> Tensor:
    if not value.name.isprintable():
        raise invalid_value("graph: name", value.name, "printable characters")
    tensor = value.type.tensor_type
    if tensor.elem_type not in TYPES:
        raise InputError(f"graph: {value.name!r} has the type {tensor.elem_type}; allowed: 1 (float32) or 11 (float64)")
    shape = tuple(dimension.dim_value for dimension in tensor.shape.dim) if tensor.HasField("shape") else None
    return Tensor(TYPES[tensor.elem_type], shape)


def _assign_columns(description: PolicyDescription, expert: Driver, names: list[str]) -> dict[str, tuple[int, ...]]:
    columns: dict[str, list[int]] = {name: [] for name in names}
    start = 0
    for policy_input in description.inputs:
        tensor, default = (
            (policy_input.tensor, policy_input.quantity) if isinstance(policy_input, PolicyInput) else ("", "")
        )
        if not tensor:
            tensor = default if default in columns else names[0] if len(names) == 1 else ""
        if tensor not in columns:
            raise unknown_name(f"inputs: tensor of {policy_input!r}", tensor, names)
        size = observation_size((policy_input,), expert)
        columns[tensor] += range(start, start + size)
        start += size
    for name in names:
        if not columns[name]:
            raise InputError(f"inputs: nothing for the input {name!r} of the graph; allowed: a quantity, or memory")
    return {name: tuple(positions) for name, positions in columns.items()}


def _check_columns(name: str, shape: tuple[int, ...] | None, count: int) -> None:
    allowed = {(count,), (0,), *([()] if count == 1 else [])}
    if shape is None or shape[:1] not in ((0,), (1,)) or shape[1:] not in allowed:
        raise InputError(f"input {name!r}: shape {_shape_text(shape)} is not allowed; allowed: (n, {count})")


def _check_memory(memory: PolicyMemory, inputs: dict[str, Tensor], outputs: dict[str, Tensor]) -> None:
    if memory.output not in outputs:
        raise unknown_name("memory.output", memory.output, outputs)
    received, returned = inputs[memory.input], outputs[memory.output]
    shape = received.shape
    if shape is None or shape[:1] not in ((0,), (1,)) or 0 in shape[1:] or np.prod(shape[1:]) > MAX_MEMORY_NUMBERS:
        allowed = f"(n, fixed lengths), at most {MAX_MEMORY_NUMBERS:,} numbers"
        raise InputError(f"memory {memory.input!r}: shape {_shape_text(shape)} is not allowed; allowed: {allowed}")
    if returned.type != received.type:
        raise InputError(f"memory {memory.output!r}: the type of {memory.input!r} is not allowed; allowed: the same")
    try:
        np.broadcast_to(np.array(memory.initial, received.type), shape[1:])
    except (TypeError, ValueError):
        allowed = f"a number, or numbers of shape {shape[1:]}"
        raise InputError(f"memory {memory.input!r}: initial value is not allowed; allowed: {allowed}") from None


def _shape_text(shape: tuple[int, ...] | None) -> str:
    return "unknown" if shape is None else f"({', '.join(str(length or 'n') for length in shape)})"


def _probe(driver: OnnxDriver) -> None:
    """Raise `InputError` unless a graph runs, returns numbers, and treats each row by itself."""
    size = observation_size(driver.features, driver.expert)
    observation = np.random.default_rng(0).uniform(0.0, 1.0, (PROBE_ROWS, size))
    initial = driver.policy_memory(PROBE_ROWS)
    _, new_memory = driver.evaluate(observation, initial)
    for name, rows in initial.items():
        if np.shape(new_memory[name]) != rows.shape:
            raise InputError(f"memory {name!r}: returns shape {np.shape(new_memory[name])}; allowed: {rows.shape}")
    check_row_independence(
        lambda rows: driver.evaluate(observation[rows], driver.policy_memory(len(observation[rows])))[0], "graph"
    )
