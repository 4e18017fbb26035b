"""Check untrusted ONNX models, and run them with limited memory.

ONNX has loops, functions, operators of other domains, and tensors in external files. To allow only arithmetic, all
content that is not listed here is refused, at any depth.
"""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from math import prod
from threading import Timer
from typing import Any

from unjam.errors import InputError, import_optional, invalid_value
from unjam.text import to_one_line

_OPERATORS = """
Abs Add And BatchNormalization Cast Ceil Clip Concat Constant Cos Div Elu Equal Erf Exp Expand Flatten Floor Gather
GatherElements GatherND Gelu Gemm Greater GreaterOrEqual HardSigmoid HardSwish Identity IsNaN LayerNormalization
LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow Reciprocal ReduceMax
ReduceMean ReduceMin ReduceSum Relu Reshape Round ScatterElements Selu Shape Sigmoid Sign Sin Slice Softmax Softplus
Softsign Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Transpose Unsqueeze Where
"""
ALLOWED_OPERATORS = set(_OPERATORS.split())  # arithmetic, without subgraphs
VALUE_FIELDS = {"INT": "i", "FLOAT": "f", "STRING": "s", "TENSOR": "t", "INTS": "ints"}
"""field with the value of an attribute, by the type of the attribute"""
REFUSED_ATTRIBUTES = {"value_string", "value_ints", "saturate", "round_mode"}  # policies do not need these
TENSOR_KINDS = "double", "float", "int32", "int64"
ALLOWED_FIELDS = {
    "ModelProto": {"ir_version", "producer_name", "producer_version", "opset_import", "graph"},
    "OperatorSetIdProto": {"domain", "version"},
    "GraphProto": {"name", "node", "initializer", "input", "output", "value_info"},
    "NodeProto": {"name", "op_type", "domain", "input", "output", "attribute"},
    "AttributeProto": {"name", "type", "i", "f", "s", "t", "ints"},
    "TensorProto": {"name", "dims", "data_type", "raw_data", *(f"{kind}_data" for kind in TENSOR_KINDS)},
    "ValueInfoProto": {"name", "type"},
    "TypeProto": {"tensor_type"},
    "Tensor": {"elem_type", "shape"},
    "TensorShapeProto": {"dim"},
    "Dimension": {"dim_param", "dim_value"},
}  # fields that messages of a model may set: no functions, subgraphs, sparse tensors, metadata
ONNX_DOMAINS = "", "ai.onnx"  # both names of the domain of ONNX itself
TEXT_FIELDS = {"doc_string", "metadata_props", "model_version", "producer_name", "producer_version", "denotation"}
"""fields with texts for readers, which have no effect on numbers"""
EXPORT_NOTE = "the first axis is the row of the CAV"
"""part of the note in a graph that `unjam export` writes"""
MAX_MODEL_BYTES = 64 * 2**20
MAX_TENSOR_NUMBERS = MAX_MODEL_BYTES // 4  # numbers in a constant
MAX_TRIAL_SECONDS = 10.0  # duration of all trial runs of a model; usual networks need milliseconds
MAX_RUN_BYTES = 256 * 2**20  # memory of all models that run in this process


def parse_model(content: bytes) -> Any:
    """Parse a model without checking it, and return its protobuf message; raise `InputError` if this fails."""
    if len(content) > MAX_MODEL_BYTES:
        raise InputError(f"graph: {len(content):,} bytes are not allowed; allowed: at most {MAX_MODEL_BYTES:,}")
    onnx = import_optional("onnx")
    try:
        return onnx.load_model_from_string(content)
    except Exception as error:  # protobuf has its own error classes
        raise InputError(f"graph: cannot be read: {to_one_line(error)}") from None


def remove_texts(message: Any) -> None:
    """Remove the texts of a message and of all messages nested in it."""
    for field, value in message.ListFields():
        # `onnx.save` adds to each constant that its data are in the graph.
        if field.name in TEXT_FIELDS or (field.name == "data_location" and value == message.DEFAULT):
            message.ClearField(field.name)
        elif field.message_type is not None:
            for nested in (value,) if hasattr(value, "ListFields") else value:
                remove_texts(nested)


def check_model(model: Any, size: int, opsets: range, ir_versions: range) -> None:
    """Raise `InputError` unless a model of `size` bytes has only arithmetic, in these versions of ONNX."""
    _check_fields(model)
    model.DiscardUnknownFields()
    if model.ByteSize() != size:
        raise InputError("graph: it contains bytes that ONNX does not know; allowed: fields of ONNX, each once")
    if model.ir_version not in ir_versions:
        raise invalid_value("graph: ir_version", model.ir_version, f"{ir_versions[0]} to {ir_versions[-1]}")
    model_opsets = [(entry.domain, entry.version) for entry in model.opset_import]
    if len(model_opsets) != 1 or model_opsets[0][0] not in ONNX_DOMAINS or model_opsets[0][1] not in opsets:
        allowed = f"[('', {opsets[0]})]" + (f" to [('', {opsets[-1]})]" if len(opsets) > 1 else "")
        raise invalid_value("graph: opset_import", model_opsets, allowed)
    graph = model.graph
    input_dependent = {tensor.name for tensor in graph.input}  # depend on values, not only on shapes
    if constant_inputs := {tensor.name for tensor in graph.initializer} & input_dependent:
        raise invalid_value("graph: initializer", min(constant_inputs), "constants, not inputs")
    for node in graph.node:
        _check_node(node, model_opsets[0][1])
        if node.op_type != "Shape" and input_dependent.intersection(node.input):
            input_dependent.update(node.output)
        if node.op_type == "Expand" and input_dependent.intersection(node.input[1:]):
            raise invalid_value("graph: shape of Expand", node.input[1], "one that does not depend on observed values")


def _check_fields(message: Any) -> None:
    """Raise `InputError` if a message, or a message nested in it, sets a field that is not allowed."""
    kind = message.DESCRIPTOR.name
    if kind == "TensorProto" and message.data_location != message.DEFAULT:
        allowed = "in the graph, as torch.onnx.export(..., external_data=False) writes it"
        raise invalid_value("graph: data of a constant", "in another file", allowed)
    for field, value in message.ListFields():
        if field.name not in ALLOWED_FIELDS.get(kind, ()):
            allowed = ", ".join(sorted(ALLOWED_FIELDS.get(kind, ()))) or "no message of this kind"
            raise InputError(f"graph: {kind}.{field.name} is not allowed; allowed: {allowed}")
        if field.message_type is not None:
            for nested in (value,) if hasattr(value, "ListFields") else value:
                _check_fields(nested)
    if kind == "TensorProto" and (min(message.dims, default=0) < 0 or prod(message.dims) > MAX_TENSOR_NUMBERS):
        allowed = f"at most {MAX_TENSOR_NUMBERS:,} numbers"
        raise invalid_value(f"graph: shape of constant {message.name!r}", [*message.dims], allowed)


def _check_node(node: Any, opset: int) -> None:
    schemas = import_optional("onnx").defs
    if node.domain not in ONNX_DOMAINS or node.op_type not in ALLOWED_OPERATORS or not schemas.has(node.op_type, opset):
        operator = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
        raise InputError(f"graph: operator {operator!r} is not allowed; allowed: arithmetic")
    attributes = schemas.get_schema(node.op_type, opset).attributes.items()
    types = {name: schema.type for name, schema in attributes if name not in REFUSED_ATTRIBUTES}
    types = {name: kind for name, kind in types.items() if kind.name in VALUE_FIELDS}
    seen = set[str]()
    for attribute in node.attribute:
        name, kind = attribute.name, types.get(attribute.name)
        fields = {field.name for field, _ in attribute.ListFields()}
        if kind is None or name in seen or fields != {"name", "type", VALUE_FIELDS[kind.name]}:
            raise invalid_value(f"graph: attribute of {node.op_type}", name, f"{', '.join(types) or 'none'}, each once")
        if attribute.type != kind.value:
            raise invalid_value(f"graph: type of {node.op_type}.{name}", attribute.type, kind.value)
        seen.add(name)


def open_session(content: bytes) -> Any:
    """Return a session of onnxruntime for a checked model, with one thread and at most `MAX_RUN_BYTES`."""
    runtime = import_optional("onnxruntime")
    _limit_memory()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.use_env_allocators", "1")
    providers, disabled = ["CPUExecutionProvider"], ["ConstantFolding"]  # folding ignores the memory limit
    try:
        return runtime.InferenceSession(content, options, providers=providers, disabled_optimizers=disabled)
    except Exception as error:  # the runtime has its own error classes
        raise _run_error(error) from None


def run_session(session: Any, outputs: list[str] | None, values: dict[str, Any]) -> list[Any]:
    """Run a model on the values of its inputs, and return the named outputs (None: all); `InputError` if it fails."""
    try:
        return session.run(outputs, values, _run_options.get())
    except Exception as error:  # the runtime has its own error classes
        raise _run_error(error) from None


def _run_error(error: Exception) -> InputError:
    return InputError(f"graph: cannot be run: {to_one_line(error)}")


_run_options: ContextVar[Any] = ContextVar("run_options", default=None)


@contextmanager
def time_limit() -> Iterator[None]:
    """Raise `InputError` if all runs of models within the block take more than `MAX_TRIAL_SECONDS` together."""
    options = import_optional("onnxruntime").RunOptions()
    timer = Timer(MAX_TRIAL_SECONDS, setattr, (options, "terminate", True))
    timer.daemon = True
    timer.start()
    token = _run_options.set(options)
    try:
        yield
    except InputError:
        if options.terminate:
            reason = f"it has not answered within {MAX_TRIAL_SECONDS:g} s of trial runs"
            raise InputError(f"graph: {reason}; allowed: a policy that answers within milliseconds") from None
        raise
    finally:
        _run_options.reset(token)
        timer.cancel()


@cache
def _limit_memory() -> None:
    """Register the limited memory that all sessions of this process share."""
    runtime = import_optional("onnxruntime")
    memory = runtime.OrtMemoryInfo("Cpu", runtime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, runtime.OrtMemType.DEFAULT)
    grow_as_requested = 1
    limits = runtime.OrtArenaCfg({"max_mem": MAX_RUN_BYTES, "arena_extend_strategy": grow_as_requested})
    runtime.create_and_register_allocator(memory, limits)


@contextmanager
def quiet_onnx_export() -> Iterator[None]:
    """Silence messages of torch about missing optional packages while it exports a graph."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(level)
