"""Graphs made by hand; those of real controllers are in tests/controller/test_onnx_graph.py."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.controller.test_sample import perceived
from unjam.controller.verify import check_graph, run_graph
from unjam.drivers import LACC, Constant
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.errors import InputError, MissingPartError
from unjam.onnx_models import ALLOWED_FIELDS

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
TensorProto, helper = onnx.TensorProto, onnx.helper

Change = Callable[[Any], object]


def graph(change: Change = lambda model: None, remembered: tuple[str, ...] = ()) -> bytes:
    """A graph with the acceleration leader speed minus own speed."""
    rows = helper.make_tensor_value_info

    def value(name: str) -> Any:
        return rows(name, TensorProto.DOUBLE, ["cavs"])

    inputs = [*COMMON_FIELDS, *(f"memory.{name}" for name in remembered)]
    outputs = ["acceleration", *(f"next.{name}" for name in remembered)]
    nodes = [helper.make_node("Sub", ["leader_speed", "speed"], ["acceleration"])]
    nodes += [helper.make_node("Add", [f"memory.{name}", "speed"], [f"next.{name}"]) for name in remembered]
    made = helper.make_graph(nodes, "it", [*map(value, inputs)], [*map(value, outputs)])
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    change(model)
    return model.SerializeToString()


def test_a_graph_is_run_on_one_moment_after_the_other() -> None:
    states = perceived()
    check_graph(graph(), Constant())
    np.testing.assert_array_equal(run_graph(graph(), Constant(), states), states.leader_speed - states.speed)


def test_cavs_that_perceive_the_same_must_get_the_same_answers() -> None:
    def answer_by_row(model: Any) -> None:
        sums = helper.make_node("CumSum", ["acceleration", "axis"], ["sums"])
        axis = helper.make_node("Constant", [], ["axis"], value_int=0)
        model.graph.node.extend([axis, sums])
        model.graph.output[0].name = "sums"

    part, states = graph(answer_by_row), perceived()
    np.testing.assert_array_equal(run_graph(part, Constant(), states), states.leader_speed - states.speed)
    with pytest.raises(InputError, match="graph: 3 CAVs with the same observation get different answers"):
        run_graph(part, Constant(), states, rows=3)


def test_what_it_remembers_is_given_back_to_it() -> None:
    def remember(model: Any) -> None:
        model.graph.node[0].input[1] = "memory.acceleration"

    driver, states = LACC(), perceived()
    part = graph(remember, ("acceleration",))
    check_graph(part, driver)
    before = np.concatenate([[0.0], np.cumsum(states.speed)[:-1]])
    np.testing.assert_allclose(run_graph(part, driver, states), states.leader_speed - before, atol=1e-9)


def rename(model: Any) -> None:
    model.graph.input[0].name = "velocity"
    model.graph.node[0].input[1] = "velocity"


def loop(model: Any) -> None:
    model.graph.node[0].op_type = "Loop"


def foreign(model: Any) -> None:
    model.graph.node[0].domain = "com.evil"


def external() -> Any:
    """A tensor with values in another file."""
    tensor = helper.make_tensor("far", TensorProto.DOUBLE, [1], [0.0])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    return tensor


def sparse() -> Any:
    tensor = onnx.SparseTensorProto(dims=[3])
    tensor.values.CopyFrom(external())
    tensor.indices.CopyFrom(external())
    return tensor


def subgraph() -> Any:
    inner = helper.make_graph([], "inner", [], [])
    inner.initializer.append(external())
    return inner


def constant(**attribute: Any) -> Change:
    """A node `Constant` with an attribute."""

    def change(model: Any) -> None:
        node = model.graph.node.add(op_type="Constant", output=["made"])
        node.attribute.append(helper.make_attribute(*attribute.popitem()))

    return change


def attribute_of(node: int, **fields: Any) -> Change:
    """An attribute, field by field, of the first node."""
    return lambda model: model.graph.node[node].attribute.add(**fields)


def with_type(change: Callable[[Any], object]) -> Change:
    """Another type of a value within the graph."""
    return lambda model: change(model.graph.value_info.add(name="inner").type)


def unknown_field(model: Any) -> None:
    model.graph.node[0].MergeFromString(b"\xf2\x3f\x03abc")


def initialized_input(model: Any) -> None:
    model.graph.initializer.append(helper.make_tensor("speed", TensorProto.DOUBLE, [1], [0.0]))


def training(model: Any) -> None:
    model.training_info.add().algorithm.CopyFrom(subgraph())


INT, TENSOR, GRAPH = (getattr(onnx.AttributeProto, kind) for kind in ("INT", "TENSOR", "GRAPH"))
WRONG: dict[str, tuple[Change, str]] = {
    "other inputs": (rename, "velocity"),
    "an output more": (lambda model: model.graph.output.append(model.graph.input[0]), "not allowed"),
    "inputs of float32": (
        lambda model: setattr(model.graph.input[0].type.tensor_type, "elem_type", TensorProto.FLOAT),
        "of another type",
    ),
    "an input with a value": (initialized_input, "graph: initializer: 'speed'"),
    "a loop": (loop, "operator 'Loop' is not allowed"),
    "an operator from elsewhere": (foreign, "operator 'com.evil.Sub' is not allowed"),
    "an operator of a function": (lambda model: setattr(model.graph.node[0], "overload", "f"), "overload"),
    "functions": (lambda model: model.functions.add(name="f", domain="own"), "ModelProto.functions"),
    "training": (training, "ModelProto.training_info"),
    "metadata": (lambda model: model.metadata_props.add(key="k", value="v"), "ModelProto.metadata_props"),
    "metadata of a node": (
        lambda model: model.graph.node[0].metadata_props.add(key="k", value="v"),
        "NodeProto.metadata_props",
    ),
    "metadata of a value": (
        lambda model: model.graph.output[0].metadata_props.add(key="k", value="v"),
        "ValueInfoProto.metadata_props",
    ),
    "a text": (lambda model: setattr(model, "doc_string", "text"), "ModelProto.doc_string"),
    "another domain": (lambda model: setattr(model, "domain", "com.evil"), "ModelProto.domain"),
    "other operators' versions": (
        lambda model: model.opset_import.add(domain="com.evil", version=1),
        "graph: opset_import: ",
    ),
    "another version of operators": (
        lambda model: setattr(model.opset_import[0], "version", 19),
        "graph: opset_import: ",
    ),
    "no version of operators": (lambda model: model.ClearField("opset_import"), "graph: opset_import: "),
    "an old ir_version": (lambda model: setattr(model, "ir_version", 3), "graph: ir_version: 3 is not"),
    "a new ir_version": (lambda model: setattr(model, "ir_version", 99), "graph: ir_version: 99 is not"),
    "unknown bytes": (unknown_field, "bytes that ONNX does not know"),
    "quantization": (
        lambda model: model.graph.quantization_annotation.add(tensor_name="speed"),
        "GraphProto.quantization_annotation",
    ),
    "external initializer": (lambda model: model.graph.initializer.append(external()), "in another file"),
    "external data that is not said to be": (
        lambda model: model.graph.initializer.add(name="far").external_data.add(key="location", value="x"),
        "TensorProto.external_data",
    ),
    "a place without external data": (
        lambda model: model.graph.initializer.add(name="far", data_location=TensorProto.EXTERNAL),
        "in another file",
    ),
    "sparse initializer": (lambda model: model.graph.sparse_initializer.append(sparse()), "sparse_init"),
    "a segment": (lambda model: model.graph.initializer.add(name="s").segment.SetInParent(), "segment"),
    "texts": (lambda model: model.graph.initializer.add(name="s", string_data=[b"x"]), "string_data"),
    "external constant": (constant(value=external()), "in another file"),
    "sparse constant": (constant(sparse_value=sparse()), "AttributeProto.sparse_tensor"),
    "text as a constant": (constant(value_string="x"), "attribute of Constant: 'value_string'"),
    "texts as a constant": (constant(value_strings=["x"]), "AttributeProto.strings"),
    "numbers as a constant": (constant(value_floats=[1.0]), "AttributeProto.floats"),
    "tensors": (constant(value=[external(), external()]), "AttributeProto.tensors"),
    "sparse tensors": (constant(value=[sparse(), sparse()]), "AttributeProto.sparse_tensors"),
    "subgraph": (constant(value=subgraph()), "AttributeProto.g"),
    "subgraphs": (constant(value=[subgraph(), subgraph()]), "AttributeProto.graphs"),
    "a type": (attribute_of(0, name="t", tp=onnx.TypeProto()), "AttributeProto.tp"),
    "types": (attribute_of(0, name="t", type_protos=[onnx.TypeProto()]), "AttributeProto.type_protos"),
    "a reference": (attribute_of(0, name="axis", ref_attr_name="other"), "AttributeProto.ref_attr_name"),
    "an attribute of another operator": (attribute_of(0, name="axis", i=1, type=INT), "attribute of Sub"),
    "a sequence": (with_type(lambda kind: kind.sequence_type.SetInParent()), "TypeProto.sequence_type"),
    "a map": (with_type(lambda kind: kind.map_type.SetInParent()), "TypeProto.map_type"),
    "a sparse type": (with_type(lambda kind: kind.sparse_tensor_type.SetInParent()), "TypeProto.sparse_tensor_type"),
    "an optional type": (with_type(lambda kind: kind.optional_type.SetInParent()), "optional_type"),
}
"""one for each place where a file, code, an operator or a text could hide, and what the refusal names"""


@pytest.mark.parametrize(
    "fields",
    [
        [{"name": "value", "type": TENSOR}],
        [{"name": "value", "type": TENSOR, "i": 1}],
        [{"name": "value", "type": INT, "t": helper.make_tensor("v", 11, [1], [0.0])}],
        [{"name": "value", "type": GRAPH, "t": helper.make_tensor("v", 11, [1], [0.0])}],
        [{"name": "value", "type": TENSOR, "t": helper.make_tensor("v", 11, [1], [0.0])}] * 2,
        [{"name": "", "type": TENSOR, "t": helper.make_tensor("v", 11, [1], [0.0])}],
    ],
    ids=["no value", "another value", "type of a number", "type of a graph", "twice", "no name"],
)
def test_an_attribute_has_one_value_of_its_type(fields: list[dict[str, Any]]) -> None:
    def change(model: Any) -> None:
        node = model.graph.node.add(op_type="Constant", output=["made"])
        for field in fields:
            node.attribute.add(**field)

    with pytest.raises(InputError, match=r"graph: (attribute|type) of Constant"):
        check_graph(graph(change), Constant())


def test_every_field_of_onnx_that_is_not_listed_is_refused() -> None:
    """Fields of messages that later versions of ONNX add are refused without being named here."""
    seen, left = set[str](), [onnx.ModelProto.DESCRIPTOR]
    while left:
        kind = left.pop()
        seen.add(kind.name)
        allowed = ALLOWED_FIELDS[kind.name]
        assert allowed <= {*kind.fields_by_name}, kind.name
        kinds = {kind.fields_by_name[name].message_type for name in allowed} - {None}
        left += [each for each in kinds if each.name not in seen]
    assert seen == ALLOWED_FIELDS.keys(), "the list names what cannot be reached"
    names = {"external_data", "data_location", "sparse_tensor", "g", "functions", "training_info"}
    assert not names & set().union(*ALLOWED_FIELDS.values())


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_graph_of_a_controller_is_refused(name: str) -> None:
    change, words = WRONG[name]
    with pytest.raises(InputError, match="graph: ") as caught:
        check_graph(graph(change), Constant())
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", [b"", b"nonsense", b"\xff" * 100])
def test_what_is_no_graph_is_refused(part: bytes) -> None:
    with pytest.raises(InputError, match="graph: "):
        check_graph(part, Constant())


def test_a_graph_that_cannot_be_run_is_refused_in_one_line() -> None:
    def dangling(model: Any) -> None:
        model.graph.node[0].input[1] = "nowhere"

    check_graph(graph(dangling), Constant())
    with pytest.raises(InputError, match="graph: cannot be run: ") as caught:
        run_graph(graph(dangling), Constant(), perceived())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["onnx", "onnxruntime"])
def test_what_is_not_installed_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    part = graph()
    with pytest.raises(MissingPartError, match=rf"{name} is not installed.*unjam\[train\]"):
        check_graph(part, Constant()) if name == "onnx" else run_graph(part, Constant(), perceived())
