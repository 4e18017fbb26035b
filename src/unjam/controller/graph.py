"""The ONNX graph of a controller: its inputs and outputs, its allowed content, and its execution.

An untrusted graph is only data if it is pure arithmetic: ONNX has loops, functions, operators of other domains, and
tensors in external files. Therefore anything that is not listed here is refused, at any depth.
"""

from typing import Any

import numpy as np

from unjam.controller.file import ACTION_NAME
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError, import_optional, invalid_value
from unjam.physics.arrays import Floats
from unjam.tree import leaves

ONNX_OPSET = 20
ONNX_IR_VERSIONS = range(10, 14)
"""version of the ONNX operators, and versions of the ONNX format for graphs of this opset"""
ALLOWED_OPERATORS: dict[str, dict[str, str]] = {
    **{
        name: {}
        for name in (
            *("Abs", "Add", "And", "Clip", "Cos", "Div", "Equal", "Expand", "Floor", "Greater", "GreaterOrEqual"),
            *("Identity", "IsNaN", "Less", "LessOrEqual", "MatMul", "Max", "Min", "Mul", "Neg", "Not", "Or", "Pow"),
            *("Reciprocal", "Relu", "Sin", "Slice", "Sqrt", "Squeeze", "Sub", "Tanh", "Unsqueeze", "Where"),
        )
    },
    "Cast": {"to": "i"},
    "Concat": {"axis": "i"},
    "Constant": {"value": "t"},
    "Gather": {"axis": "i"},
    "GatherElements": {"axis": "i"},
    "GatherND": {"batch_dims": "i"},
    "Gemm": {"alpha": "f", "beta": "f", "transA": "i", "transB": "i"},
    "Mod": {"fmod": "i"},
    "ReduceMean": {"keepdims": "i", "noop_with_empty_axes": "i"},
    "Reshape": {"allowzero": "i"},
    "ScatterElements": {"axis": "i", "reduction": "s"},
    "Shape": {"end": "i", "start": "i"},
    "Transpose": {"perm": "ints"},
}
"""all allowed operators: arithmetic, without subgraphs; with the field that stores each of their attributes"""
ALLOWED_FIELDS = {
    "ModelProto": {"ir_version", "producer_name", "producer_version", "opset_import", "graph"},
    "OperatorSetIdProto": {"domain", "version"},
    "GraphProto": {"name", "node", "initializer", "input", "output", "value_info"},
    "NodeProto": {"name", "op_type", "domain", "input", "output", "attribute"},
    "AttributeProto": {"name", "type", "i", "f", "s", "t", "ints"},
    "TensorProto": {"name", "dims", "data_type", "raw_data", "double_data", "float_data"}
    | {"int32_data", "int64_data"},
    "ValueInfoProto": {"name", "type"},
    "TypeProto": {"tensor_type"},
    "Tensor": {"elem_type", "shape"},
    "TensorShapeProto": {"dim"},
    "Dimension": {"dim_param", "dim_value"},
}
"""all fields that messages of a graph may set: no function, subgraph, sparse or external tensor, metadata"""
BATCH_TOLERANCE = 1e-9
"""allowed difference between equal rows [m/s2]: rounding of matrix products depends on their size"""


def graph_names(driver: Driver) -> tuple[list[str], list[str]]:
    """Return the names of a graph's inputs (state, memory) and outputs (acceleration, memory after it)."""
    memory = [name for name, _ in leaves(driver.initial_memory(1))]
    inputs = [*driver.input_fields, *(f"memory.{name}" for name in memory)]
    return inputs, [ACTION_NAME, *(f"next.{name}" for name in memory)]


def check_graph(part: bytes, driver: Driver) -> None:
    """Raise `InputError` unless a graph has the inputs and outputs of a controller and only arithmetic between them."""
    onnx = import_optional("onnx")
    try:
        model = onnx.load_model_from_string(part)
    except Exception as error:  # protobuf has its own error classes
        raise InputError(f"graph: cannot be read: {error}") from None
    _check_fields(model)
    model.DiscardUnknownFields()
    if model.ByteSize() != len(part):
        raise InputError("graph: it contains bytes that ONNX does not know; allowed: output of `unjam export`")
    if model.ir_version not in ONNX_IR_VERSIONS:
        raise invalid_value("graph: ir_version", model.ir_version, f"{ONNX_IR_VERSIONS[0]} to {ONNX_IR_VERSIONS[-1]}")
    imported = [(each.domain, each.version) for each in model.opset_import]
    if imported != [("", ONNX_OPSET)]:
        raise invalid_value("graph: opset_import", imported, f"{[('', ONNX_OPSET)]}")
    graph, expected = model.graph, graph_names(driver)
    found = [value.name for value in graph.input], [value.name for value in graph.output]
    if found != expected:
        raise InputError(f"graph: inputs and outputs {found} are not allowed; allowed: {expected}")
    kinds = {value.type.tensor_type.elem_type for value in (*graph.input, *graph.output)}
    if kinds != {onnx.TensorProto.DOUBLE}:
        raise InputError("graph: inputs and outputs of another type are not allowed; allowed: float64")
    if fixed := {each.name for each in graph.initializer} & {*found[0]}:
        raise invalid_value("graph: initializer", min(fixed), "constants, not inputs")
    for node in graph.node:
        _check_node(node, onnx.AttributeProto)


def _check_fields(message: Any) -> None:
    """Raise `InputError` if a message, or one nested in it, sets a field that is not allowed."""
    kind = message.DESCRIPTOR.name
    for each, value in message.ListFields():
        if each.name not in ALLOWED_FIELDS.get(kind, ()):
            allowed = ", ".join(sorted(ALLOWED_FIELDS.get(kind, ()))) or "no message of this kind"
            raise InputError(f"graph: {kind}.{each.name} is not allowed; allowed: {allowed}")
        if each.message_type is not None:
            for inner in (value,) if hasattr(value, "ListFields") else value:
                _check_fields(inner)


def _check_node(node: Any, types: Any) -> None:
    if node.domain or node.op_type not in ALLOWED_OPERATORS:
        operator = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
        raise InputError(f"graph: operator {operator!r} is not allowed; allowed: arithmetic")
    allowed, seen = ALLOWED_OPERATORS[node.op_type], set[str]()
    types_of = {"i": types.INT, "f": types.FLOAT, "s": types.STRING, "t": types.TENSOR, "ints": types.INTS}
    for attribute in node.attribute:
        value_field = allowed.get(attribute.name)
        fields = {each.name for each, _ in attribute.ListFields()}
        if value_field is None or attribute.name in seen or fields != {"name", "type", value_field}:
            names = ", ".join(allowed) or "none"
            raise invalid_value(f"graph: attribute of {node.op_type}", attribute.name, f"{names}, each once")
        if attribute.type != types_of[value_field]:
            field = f"graph: type of {node.op_type}.{attribute.name}"
            raise invalid_value(field, attribute.type, types_of[value_field])
        seen.add(attribute.name)


def run_graph(part: bytes, driver: Driver, states: LocalState, rows: int = 1) -> Floats:
    """Return the accelerations of a checked graph for consecutive `states` [m/s2].

    It begins with the initial memory of its `driver`; all arrays have the shape (T,). It runs for `rows` CAVs with the
    same observation at once. Raise `InputError` if onnxruntime refuses it, or CAVs with the same observation get
    different answers, `MissingPartError` if onnxruntime is not installed.
    """
    runtime = import_optional("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    (inputs, _), answers, is_equal = graph_names(driver), np.zeros(len(states.speed)), True
    memory: list[Any] = [rows for _, rows in leaves(driver.initial_memory(rows))]
    try:
        session = runtime.InferenceSession(part, options, providers=["CPUExecutionProvider"])
        for step in range(len(answers)):
            now = states.select(np.full(rows, step))
            values = [*(getattr(now, name) for name in driver.input_fields), *memory]
            acceleration, *memory = session.run(None, dict(zip(inputs, values, strict=True)))
            answers[step] = acceleration[0]
            is_equal &= np.shape(acceleration) == (rows,)
            is_equal &= bool(np.all(np.abs(acceleration - answers[step]) <= BATCH_TOLERANCE))
    except Exception as error:  # the runtime has its own error classes
        raise InputError(f"graph: cannot be run: {error}") from None
    if not is_equal:
        raise InputError(f"graph: {rows} CAVs with the same observation get different answers")
    return answers
