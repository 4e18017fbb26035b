"""An ONNX graph of a whole controller: looked at before it is run, and run beside its driver."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError, MissingPartError

Floats = NDArray[np.float64]

ACCELERATION = "acceleration"
OPERATORS = {
    *("Abs", "Add", "And", "Cast", "Clip", "Concat", "Constant", "Cos", "Div", "Equal", "Expand", "Floor"),
    *(
        "Gather",
        "GatherElements",
        "GatherND",
        "Gemm",
        "Greater",
        "GreaterOrEqual",
        "Identity",
        "IsNaN",
        "Less",
    ),
    *("LessOrEqual", "MatMul", "Max", "Min", "Mod", "Mul", "Neg", "Not", "Or", "Pow", "Relu", "Reshape"),
    *("ScatterElements", "Shape", "Sin", "Slice", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose"),
    *("Unsqueeze", "Where"),
}
"""all that the graph of a controller is made of: arithmetic, without loops and without files"""


def input_name(remembered: str) -> str:
    """Return the graph's name for what was remembered before a decision."""
    return f"memory.{remembered}"


def output_name(remembered: str) -> str:
    """Return the graph's name for what is remembered after a decision."""
    return f"next.{remembered}"


def check_graph(part: bytes, driver: Driver) -> None:
    """Raise `InputError` unless a graph has a controller's inputs and outputs, and only arithmetic between.

    Raises:
        MissingPartError: onnx is not installed.
    """
    onnx = _import("onnx")
    try:
        model = onnx.load_model_from_string(part)
    except Exception as error:  # protobuf's own kinds of error
        raise InputError(f"graph: cannot be read: {error}") from None
    graph, memory = model.graph, driver.initial_memory(1)
    wanted = [*LocalState._fields, *map(input_name, memory)], [ACCELERATION, *map(output_name, memory)]
    found = [value.name for value in graph.input], [value.name for value in graph.output]
    if found != wanted:
        raise InputError(f"graph: inputs and outputs {found} are not allowed; allowed: {wanted}")
    if model.functions or graph.sparse_initializer:
        raise InputError("graph: functions and sparse weights are not allowed")
    tensors = list(graph.initializer)
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            raise InputError(f"graph: operator {node.op_type!r} is not allowed; allowed: arithmetic")
        tensors += [attribute.t for attribute in node.attribute if attribute.HasField("t")]
    if any(tensor.external_data or tensor.data_location for tensor in tensors):
        raise InputError("graph: weights in another file are not allowed")


def run_graph(part: bytes, driver: Driver, states: LocalState) -> Floats:
    """Return what a graph answers when it perceives `states` one after the other, from its first memory.

    Args:
        part: the graph, checked.
        driver: whose graph it is; its memory is the graph's.
        states: arrays of shape (T,).

    Returns:
        Accelerations [m/s2], shape (T,).

    Raises:
        InputError: onnxruntime refuses it.
        MissingPartError: onnxruntime is not installed.
    """
    runtime = _import("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    memory, answers = driver.initial_memory(1), np.zeros(len(states.speed))
    try:
        session = runtime.InferenceSession(part, options, providers=["CPUExecutionProvider"])
        for step in range(len(answers)):
            one = {name: values[step : step + 1] for name, values in states._asdict().items()}
            fed = {**one, **{input_name(name): rows for name, rows in memory.items()}}
            acceleration, *after = session.run(None, fed)
            memory = dict(zip(memory, after, strict=True))
            answers[step] = acceleration[0]
    except Exception as error:  # the runtime's own kinds of error
        raise InputError(f"graph: cannot be run: {error}") from None
    return answers


def _import(name: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise MissingPartError(f"{name} is not installed; install it: pip install 'unjam[onnx]'") from None
