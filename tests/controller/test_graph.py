"""Graphs made by hand; those of real controllers are in tests/controller/test_onnx_graph.py."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.controller.test_sample import perceived
from unjam.controller.verify import check_graph, run_graph
from unjam.drivers import LACC, Constant
from unjam.drivers.local_state import EVERYWHERE
from unjam.errors import InputError, MissingPartError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
TensorProto, helper = onnx.TensorProto, onnx.helper

Change = Callable[[Any], object]


def graph(change: Change = lambda model: None, remembered: tuple[str, ...] = ()) -> bytes:
    """A graph whose acceleration is the leader's speed less the own."""
    rows = helper.make_tensor_value_info

    def value(name: str) -> Any:
        return rows(name, TensorProto.DOUBLE, ["cavs"])

    inputs = [*EVERYWHERE, *(f"memory.{name}" for name in remembered)]
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


def outside(model: Any) -> None:
    tensor = helper.make_tensor("far", TensorProto.DOUBLE, [1], [0.0])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    model.graph.initializer.append(tensor)


def outside_in_a_node(model: Any) -> None:
    outside(model)
    node = helper.make_node("Constant", [], ["far"], value=model.graph.initializer.pop())
    model.graph.node.insert(0, node)


def function(model: Any) -> None:
    model.functions.add(name="f", domain="own")


WRONG: dict[str, tuple[Change, str]] = {
    "other inputs": (rename, "velocity"),
    "an output more": (lambda model: model.graph.output.append(model.graph.input[0]), "not allowed"),
    "a loop": (loop, "operator 'Loop' is not allowed"),
    "an operator from elsewhere": (foreign, "operator 'Sub' is not allowed"),
    "weights in another file": (outside, "weights in another file"),
    "weights of a node in another file": (outside_in_a_node, "weights in another file"),
    "functions": (function, "functions and sparse weights"),
}


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
