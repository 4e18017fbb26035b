"""ONNX files as third parties write them: with the packages onnx and torch alone."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import helper

FLOAT, DOUBLE, INT64 = onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.INT64
DESCRIPTION = """
inputs = [
  { quantity = "speed" },
  { quantity = "leader_speed" },
  { quantity = "leader_gap" },
]
output = { quantity = "acceleration", limits = [-1.0, 1.0] }
"""


def value(name: str, shape: Sequence[str | int] = ("n",), kind: int = FLOAT) -> Any:
    return helper.make_tensor_value_info(name, kind, shape)


def constant(name: str, number: float) -> Any:
    return helper.make_tensor(name, FLOAT, [], [number])


def model(nodes: Sequence[Any], inputs: Sequence[Any], outputs: Sequence[Any], constants: Sequence[Any] = ()) -> Any:
    graph = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="me")


def follower() -> Any:
    """A controller with three inputs, (n,) each: `tanh(0.2 (gap - 1.4 speed) + leader speed - speed)`."""
    nodes = [
        helper.make_node("Sub", ["leader_speed", "speed"], ["difference"], doc_string="of speeds"),
        helper.make_node("Mul", ["speed", "time_gap"], ["wanted"]),
        helper.make_node("Sub", ["leader_gap", "wanted"], ["excess"]),
        helper.make_node("Mul", ["excess", "gain"], ["following"]),
        helper.make_node("Add", ["following", "difference"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["acceleration"]),
    ]
    inputs = [value(name) for name in ("speed", "leader_speed", "leader_gap")]
    constants = [constant("time_gap", 1.4), constant("gain", 0.2)]
    made = model(nodes, inputs, [value("acceleration")], constants)
    made.metadata_props.add(key="trained", value="elsewhere")
    made.graph.initializer[0].data_location = onnx.TensorProto.DEFAULT  # as `onnx.save` does after `onnx.load`
    return made


def expected(state: Any) -> Any:
    return np.tanh(0.2 * (state.leader_gap - 1.4 * state.speed) + state.leader_speed - state.speed)


def linear(columns: int, weights: Sequence[float], rows: str | int = "n", kind: int = FLOAT) -> Any:
    """A graph with one input, (n, columns), and an output, (n, 1)."""
    matrix = helper.make_tensor("weights", kind, [columns, 1], weights)
    node = helper.make_node("MatMul", ["observation", "weights"], ["action"])
    return model([node], [value("observation", (rows, columns), kind)], [value("action", (rows, 1), kind)], [matrix])


def mixing(columns: int, weights: Sequence[float]) -> Any:
    """The same graph with an output of (n, n), because it mixes the rows of its input: for one vehicle only."""
    made = linear(columns, weights)
    made.graph.node[0].output[0] = "product"
    transpose = helper.make_node("Transpose", ["product"], ["row"])
    made.graph.node.extend([transpose, helper.make_node("Add", ["product", "row"], ["action"])])
    made.graph.output[0].CopyFrom(value("action", ("n", "n")))
    return made


def write(folder: Path, made: Any, description: str = DESCRIPTION, name: str = "policy") -> Path:
    (folder / f"{name}.toml").write_text(description)
    path = folder / f"{name}.onnx"
    path.write_bytes(made.SerializeToString())
    return path


Change = Callable[[Any], object]
