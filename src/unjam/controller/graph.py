"""The ONNX graph of a controller: its inputs and outputs, their check, and its execution."""

import numpy as np

from unjam.controller.file import ACTION_NAME
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError, import_optional
from unjam.onnx_models import check_model, open_session, parse_model, run_session
from unjam.physics.arrays import Floats
from unjam.tree import leaves

ONNX_OPSET = 20
ONNX_IR_VERSIONS = range(10, 14)
"""version of the ONNX operators, and versions of the ONNX format for graphs of this opset"""
BATCH_TOLERANCE = 1e-9  # between equal rows [m/s2]: rounding of matrix products depends on their size


def graph_names(driver: Driver) -> tuple[list[str], list[str]]:
    """Return the names of a graph's inputs (state, memory) and outputs (acceleration, memory after it)."""
    memory = [name for name, _ in leaves(driver.initial_memory(1))]
    inputs = [*driver.requirements().input_fields, *(f"memory.{name}" for name in memory)]
    return inputs, [ACTION_NAME, *(f"next.{name}" for name in memory)]


def check_graph(part: bytes, driver: Driver) -> None:
    """Raise `InputError` unless a graph has the inputs and outputs of a controller and only arithmetic between them."""
    model = parse_model(part)
    check_model(model, len(part), range(ONNX_OPSET, ONNX_OPSET + 1), ONNX_IR_VERSIONS)
    graph, expected = model.graph, graph_names(driver)
    found = [value.name for value in graph.input], [value.name for value in graph.output]
    if found != expected:
        raise InputError(f"graph: inputs and outputs {found} are not allowed; allowed: {expected}")
    kinds = {value.type.tensor_type.elem_type for value in (*graph.input, *graph.output)}
    if kinds != {import_optional("onnx").TensorProto.DOUBLE}:
        raise InputError("graph: inputs and outputs of another type are not allowed; allowed: float64")


def run_graph(part: bytes, driver: Driver, states: LocalState, rows: int = 1) -> Floats:
    """Return the accelerations of a checked graph for consecutive `states` [m/s2], all of shape (T,).

    It runs for `rows` CAVs with the same observation at once. Raise `InputError` if onnxruntime refuses it or they get
    different answers, `MissingPartError` without onnxruntime.
    """
    (inputs, _), answers, is_equal = graph_names(driver), np.zeros(len(states.speed)), True
    fields, memory = driver.requirements().input_fields, [rows for _, rows in leaves(driver.initial_memory(rows))]
    session = open_session(part)
    for step in range(len(answers)):
        now = states.select(np.full(rows, step))
        values = [*(getattr(now, name) for name in fields), *memory]
        acceleration, *memory = run_session(session, None, dict(zip(inputs, values, strict=True)))
        answers[step] = acceleration[0]
        is_equal &= np.shape(acceleration) == (rows,)
        is_equal &= bool(np.all(np.abs(acceleration - answers[step]) <= BATCH_TOLERANCE))
    if not is_equal:
        raise InputError(f"graph: {rows} CAVs with the same observation get different answers")
    return answers
