import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import helper

import unjam
from tests.adapters.onnx_policies import (
    DESCRIPTION,
    DOUBLE,
    FLOAT,
    INT64,
    Change,
    expected,
    follower,
    linear,
    model,
    value,
    write,
)
from unjam import onnx_models
from unjam.adapters import PolicyDescription, PolicyInput, PolicyOutput, onnx_driver
from unjam.controller import make_driver
from unjam.drivers.car_following import ACC
from unjam.drivers.check import random_state
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.errors import InputError, MissingPartError
from unjam.onnx_models import MAX_RUN_BYTES

STATE = random_state(np.random.default_rng(0), 6)


def answers(driver: Any, state: Any = STATE) -> Any:
    return driver.act(state, driver.initial_memory(len(state.speed)))[0]


@pytest.mark.parametrize("name", ["policy.onnx", "policy.toml"])
def test_a_graph_with_three_inputs_drives_as_described(name: str, tmp_path: Path) -> None:
    write(tmp_path, follower())
    driver = make_driver(str(tmp_path / name), 0.1)
    unjam.check_driver(driver)
    np.testing.assert_allclose(answers(driver), expected(STATE), atol=1e-6)
    assert driver.describe() == name
    assert [str(each) for each in driver.network_inputs or ()] == [
        "speed / 1 m/s",
        "leader speed / 1 m/s",
        "leader gap / 1 m",
    ]


def test_other_processes_build_the_same_driver_from_data_alone(tmp_path: Path) -> None:
    path = write(tmp_path, follower())
    driver = onnx_driver(path)
    recipe, weights = driver_recipe(driver)
    path.unlink()
    rebuilt = driver_from_recipe(recipe, weights)
    np.testing.assert_array_equal(answers(rebuilt), answers(driver))
    assert driver_recipe(rebuilt)[0] == recipe
    assert b"elsewhere" not in weights["graph"].tobytes()


def test_columns_have_units_scales_and_offsets(tmp_path: Path) -> None:
    path = tmp_path / "linear.onnx"
    path.write_bytes(linear(3, [1.0, 2.0, 4.0], kind=DOUBLE).SerializeToString())
    inputs = (
        PolicyInput("speed", "km/h", scale=10.0, offset=20.0),
        PolicyInput("leader_relative_speed"),
        PolicyInput("leader_gap", scale=100.0),
    )
    driver = onnx_driver(path, PolicyDescription(inputs, PolicyOutput(scale=0.5, offset=0.1)))
    state = STATE
    numbers = (3.6 * state.speed - 20.0) / 10.0 + 2.0 * (state.leader_speed - state.speed) + state.leader_gap / 25.0
    np.testing.assert_allclose(answers(driver), 0.5 * numbers + 0.1, atol=1e-12)


@pytest.mark.parametrize("quantity", ["desired_speed", "set_speed"])
def test_speeds_become_accelerations(quantity: Any, tmp_path: Path) -> None:
    path = tmp_path / "speed.onnx"
    path.write_bytes(linear(1, [1.0], kind=DOUBLE).SerializeToString())
    output = PolicyOutput(quantity, "km/h", scale=2.0, limits=(0.0, 36.0))
    driver = onnx_driver(path, PolicyDescription((PolicyInput("leader_speed", "km/h"),), output, time_step=0.5))
    target = np.minimum(2.0 * STATE.leader_speed, 10.0)
    by_quantity = {
        "desired_speed": (target - STATE.speed) / 0.5,
        "set_speed": [
            ACC(set_speed=float(max(speed, 1e-12))).act(STATE.select(slice(row, row + 1)), {})[0][0]
            for row, speed in enumerate(target)
        ],
    }
    np.testing.assert_allclose(answers(driver), by_quantity[quantity], atol=1e-9)


def test_an_action_is_repeated_for_the_control_step_of_the_policy(tmp_path: Path) -> None:
    driver = onnx_driver(write(tmp_path, follower(), f"{DESCRIPTION}\ntime_step = 0.3"))
    memory, found = driver.initial_memory(6), []
    for factor in (1.0, 0.5, 0.2, 0.1):
        acceleration, memory = driver.act(STATE._replace(leader_gap=factor * STATE.leader_gap), memory)
        found.append(acceleration)
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])
    assert (found[3] != found[0]).any()
    with pytest.raises(InputError, match=r"time_step: 0.3 is not allowed; allowed: multiples of the road's .*, 0.2 s"):
        onnx_driver(tmp_path / "policy.onnx", time_step=0.2)


RECURRENT = """
inputs = [{ quantity = "speed", tensor = "x" }]
output = { tensor = "y" }
memory = [{ input = "h", output = "h_next", initial = [1.0, 2.0] }]
"""


def test_recurrent_state_belongs_to_each_cav(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Add", ["h", "x"], ["h_next"]),
        helper.make_node("ReduceMean", ["h_next"], ["y"], axes=[1], keepdims=1),
    ]
    inputs, outputs = [value("x", ("n", 1)), value("h", ("n", 2))], [value("y", ("n", 1)), value("h_next", ("n", 2))]
    driver = onnx_driver(write(tmp_path, model(nodes, inputs, outputs), RECURRENT))
    unjam.check_driver(driver)
    first, memory = driver.act(STATE, driver.initial_memory(6))
    second, _ = driver.act(STATE, memory)
    np.testing.assert_allclose(first, 1.5 + STATE.speed, rtol=1e-6)
    np.testing.assert_allclose(second, 1.5 + 2.0 * STATE.speed, rtol=1e-6)


@pytest.mark.parametrize("time_step", [0.1, 0.3])
def test_an_age_that_all_cavs_share_changes_nothing(time_step: float, tmp_path: Path) -> None:
    node = helper.make_node("Add", ["h", "x"], ["h_next"])
    copy = helper.make_node("Identity", ["h_next"], ["y"])
    names = ("x", "h"), ("y", "h_next")
    inputs, outputs = ([value(name, ("n", 1)) for name in each] for each in names)
    description = RECURRENT.replace("[1.0, 2.0]", "0.5") + f"time_step = {time_step}"
    driver = onnx_driver(write(tmp_path, model([node, copy], inputs, outputs), description))
    memory = driver.initial_memory(6)
    shared = memory | ({"age": 0.0} if "age" in memory else {})  # as in the batch
    for _ in range(7):
        expected_acceleration, memory = driver.act(STATE, memory)
        acceleration, shared = driver.act(STATE, shared)
        np.testing.assert_array_equal(acceleration, expected_acceleration)


def test_a_graph_for_one_row_runs_once_for_each_cav(tmp_path: Path) -> None:
    path = tmp_path / "one.onnx"
    path.write_bytes(linear(5, [1.0, -2.0, 0.5, 1.0, 0.25], rows=1).SerializeToString())
    driver = onnx_driver(path, PolicyDescription(("local",)))
    unjam.check_driver(driver)
    assert answers(driver, STATE.select(slice(0, 0))).shape == (0,)


def test_actions_are_added_to_an_expert_with_a_name(tmp_path: Path) -> None:
    description = 'inputs = ["expert_acceleration"]\nexpert = "pi"\noutput = { limits = [-1.0, 1.0] }'
    driver = onnx_driver(write(tmp_path, linear(1, [0.5]), description))
    expert = PISaturation()
    alone = expert.act(STATE, expert.initial_memory(6))[0].clip(-1.0, 1.0)
    np.testing.assert_allclose(answers(driver), (1.5 * alone).clip(-1.0, 1.0), atol=1e-6)
    assert driver.describe() == "pi + policy.onnx"
    assert (
        onnx_driver(tmp_path / "policy.onnx", expert=unjam.make_driver("lacc", 0.1)).describe() == "lacc + policy.onnx"
    )
    np.testing.assert_array_equal(answers(driver_from_recipe(*driver_recipe(driver))), answers(driver))


@pytest.mark.long
def test_a_torch_module_that_torch_exports_drives_as_in_python(tmp_path: Path) -> None:
    import torch

    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Linear(3, 16), torch.nn.ELU(), torch.nn.Linear(16, 1), torch.nn.Sigmoid()
    ).eval()
    observation = torch.ones(2, 3)
    shapes = ({0: torch.export.Dim("n")},)
    torch.onnx.export(network, (observation,), tmp_path / "policy.onnx", dynamic_shapes=shapes, verbose=False)
    (tmp_path / "policy.toml").write_text(DESCRIPTION)
    rows = torch.as_tensor(np.array(STATE[:3]).T, dtype=torch.float32)
    driver = onnx_driver(tmp_path / "policy.onnx")
    np.testing.assert_allclose(answers(driver), network(rows)[:, 0].detach().numpy(), atol=1e-6)


def change_of(**fields: str) -> Change:
    def change(made: Any) -> None:
        for name, text in fields.items():
            setattr(made.graph.node[0], name, text)

    return change


def nameless(made: Any) -> None:
    made.graph.node[0].name = "\x1b[2J"
    made.graph.node[0].input[0] = "\x1b[2J"


def external(made: Any) -> None:
    tensor = made.graph.initializer[0]
    tensor.data_location = 1
    tensor.external_data.add(key="location", value="/etc/passwd")


def of_type(kind: int) -> Change:
    return lambda made: setattr(made.graph.input[0].type.tensor_type, "elem_type", kind)


def of_shape(*lengths: int | str) -> Change:
    def change(made: Any) -> None:
        made.graph.input[0].CopyFrom(value("speed", lengths))

    return change


def expand(count: int) -> Change:
    """Makes the answer a mean over many numbers."""

    def change(made: Any) -> None:
        made.graph.initializer.append(helper.make_tensor("count", INT64, [2], [count, 1]))
        made.graph.node[-1].output[0] = "few"
        made.graph.node.add(op_type="Expand", input=["few", "count"], output=["much"])
        mean = helper.make_node("ReduceMean", ["much"], ["acceleration"], axes=[0], keepdims=0)
        made.graph.node.append(mean)

    return change


def measured_shape(made: Any) -> None:
    made.graph.node.append(helper.make_node("Cast", ["speed"], ["count"], to=INT64))
    made.graph.node.add(op_type="Reshape", input=["count", "one"], output=["counts"])
    made.graph.initializer.append(helper.make_tensor("one", INT64, [1], [-1]))
    made.graph.node.add(op_type="Expand", input=["gain", "counts"], output=["much"])


def slow(made: Any) -> None:
    made.graph.node[-1].output[0] = "few"
    made.graph.initializer.append(helper.make_tensor("square", INT64, [2], [2000, 2000]))
    made.graph.node.add(op_type="Expand", input=["gain", "square"], output=["power_0"])
    for number in range(2000):
        product = helper.make_node("MatMul", [f"power_{number}", "power_0"], [f"power_{number + 1}"])
        made.graph.node.append(product)
    made.graph.node.append(helper.make_node("ReduceMean", ["power_2000"], ["mean"], keepdims=0))
    made.graph.node.add(op_type="Add", input=["few", "mean"], output=["acceleration"])


def mixing(made: Any) -> None:
    made.graph.node[-1].output[0] = "alone"
    made.graph.node.append(helper.make_node("ReduceMean", ["alone"], ["mean"], axes=[0], keepdims=1))
    made.graph.node.append(helper.make_node("Sub", ["alone", "mean"], ["acceleration"]))


HOSTILE: dict[str, tuple[Change, str]] = {
    "external data": (external, "allowed: in the graph, as torch.onnx.export(..., external_data=False) writes it"),
    "huge constant": (
        lambda made: made.graph.initializer[0].dims.extend([2**40]),
        "graph: shape of constant 'time_gap': [1099511627776] is not allowed; allowed: at most 16,777,216 numbers",
    ),
    "huge intermediate result": (expand(2**33), "graph: cannot be run: "),
    "size by a speed": (measured_shape, "graph: shape of Expand: 'counts' is not allowed; allowed: one that does not"),
    "thousands of large products": (slow, "graph: it has not answered within 1 s of trial runs; allowed: a policy"),
    "unknown operator": (change_of(op_type="Loop"), "graph: operator 'Loop' is not allowed; allowed: arithmetic"),
    "another domain": (change_of(domain="com.evil"), "graph: operator 'com.evil.Sub' is not allowed"),
    "control characters": (change_of(op_type="\x1b[31m\n"), r"graph: operator '\x1b[31m\n' is not allowed"),
    "control characters in a name": (nameless, "graph: cannot be run: "),
    "integers": (of_type(INT64), "graph: 'speed' has the type 7; allowed: 1 (float32) or 11 (float64)"),
    "different types": (of_type(DOUBLE), "graph: cannot be run: "),
    "wrong shape": (of_shape("n", 4), "input 'speed': shape (n, 4) is not allowed; allowed: (n, 1)"),
    "no row": (of_shape(), "input 'speed': shape () is not allowed; allowed: (n, 1)"),
    "function": (lambda made: made.functions.add(name="f", domain="own"), "graph: ModelProto.functions"),
    "unknown version": (lambda made: setattr(made.opset_import[0], "version", 99), "graph: opset_import: [('', 99)]"),
    "not a number": (
        lambda made: made.graph.initializer[0].CopyFrom(helper.make_tensor("time_gap", FLOAT, [], [float("nan")])),
        "returns nan; allowed: finite",
    ),
    "mixed rows": (mixing, "graph: CAVs influence each other; allowed: rows that are computed independently"),
    "dangling input": (lambda made: made.graph.node[0].input.__setitem__(0, "nowhere"), "graph: cannot be run: "),
    "several outputs": (
        lambda made: made.graph.output.append(value("excess")),
        "output.tensor: '' is not allowed; allowed: acceleration, excess",
    ),
    "input without meaning": (
        lambda made: made.graph.input.append(value("other")),
        "inputs: nothing for the input 'other' of the graph; allowed: a quantity, or memory",
    ),
}


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        onnx_driver(path)
    text = str(caught.value)
    assert "policy.onnx" in text or "policy.toml" in text
    assert text.isprintable(), text
    assert len(text) < 500
    return text


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_graph_is_refused_in_one_line(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_models, "MAX_TRIAL_SECONDS", 1.0)
    change, words = HOSTILE[name]
    made = follower()
    change(made)
    text = refusal(write(tmp_path, made))
    assert words in text


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory as Linux reports it")
def test_constants_do_not_grow_while_a_graph_is_loaded(tmp_path: Path) -> None:
    import resource

    def folded(made: Any) -> None:
        many = [helper.make_tensor("count", INT64, [1], [2 * MAX_RUN_BYTES])]
        made.graph.initializer.extend(many)
        made.graph.node.add(op_type="Expand", input=["gain", "count"], output=["much"])
        made.graph.node.append(helper.make_node("ReduceMean", ["much"], ["mean"], keepdims=0))
        made.graph.node[-3].output[0] = "few"
        made.graph.node.append(helper.make_node("Mul", ["few", "mean"], ["acceleration"]))

    made = follower()
    folded(made)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "graph: cannot be run: " in refusal(write(tmp_path, made))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2 * MAX_RUN_BYTES / 1024


DESCRIPTIONS = {
    "not TOML": ("inputs = [", "driver policy.toml: not TOML: "),
    "no inputs": ("", "driver policy.onnx: inputs: missing"),
    "unknown key": ('inputs = ["local"]\nreward = 1', "reward: unknown name"),
    "unknown quantity": ('inputs = [{ quantity = "sped" }]', "quantity: 'sped' is not allowed; allowed: speed, "),
    "code as a feature": ('inputs = ["mine.py:f"]', "inputs: 'mine.py:f' is not allowed; allowed: local, "),
    "code as an expert": (f'expert = "mine.py:f"\n{DESCRIPTION}', "expert: 'mine.py:f' is not allowed; allowed: "),
    "unknown unit": ('inputs = [{ quantity = "speed", unit = "mph" }]', "unit: 'mph' is not allowed; allowed: m/s,"),
    "scale of zero": ('inputs = [{ quantity = "speed", scale = 0.0 }]', "scale: 0.0 is not allowed; allowed: a number"),
    "file elsewhere": (f'graph = "../policy.onnx"\n{DESCRIPTION}', "graph: '../policy.onnx' is not allowed; "),
    "scale as text": (
        'inputs = [{ quantity = "speed", scale = "10" }]',
        "scale: '10' is not allowed; allowed: a valid",
    ),
    "another graph": (
        f'graph = "other.onnx"\n{DESCRIPTION}',
        "driver policy.toml: graph: 'other.onnx' is not allowed; allowed: policy.onnx, which was given",
    ),
    "optional speed": (
        'inputs = [{ quantity = "speed", optional = true }]',
        "optional: True is not allowed; allowed: only for loop_length, route_position",
    ),
    "reversed limits": (
        'inputs = ["local"]\noutput = { limits = [1.0, -1.0] }',
        "limits: [1.0, -1.0] is not allowed; allowed: a lower and a higher value",
    ),
    "too few": ('inputs = [{ quantity = "speed" }]', "inputs: nothing for the input 'leader_speed' of the graph"),
    "unknown tensor": (
        'inputs = [{ quantity = "speed", tensor = "x" }]',
        "inputs: tensor of 'speed': 'x' is not allowed; allowed: speed, leader_speed, leader_gap",
    ),
    "unknown state": (
        f'{DESCRIPTION}\nmemory = [{{ input = "h", output = "i" }}]',
        "memory.input: 'h' is not allowed; allowed: speed",
    ),
}


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_a_wrong_description_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    description, words = DESCRIPTIONS[name]
    (tmp_path / "mine.py").write_text("raise SystemExit")
    assert words in refusal(write(tmp_path, follower(), description))


def test_a_description_can_lie_in_the_graph_and_is_needed(tmp_path: Path) -> None:
    made = follower()
    path = write(tmp_path, made)
    (tmp_path / "policy.toml").unlink()
    needed = "needed: policy.toml, with the inputs and the output of the graph"
    assert refusal(path) == f"driver policy.onnx: its description is missing; {needed}"
    made.metadata_props.add(key="unjam", value=DESCRIPTION)
    path.write_bytes(made.SerializeToString())
    np.testing.assert_allclose(answers(onnx_driver(path)), expected(STATE), atol=1e-6)


def test_the_examples_of_the_documentation_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "own-driver.md").read_text()
    section = page.partition("### An ONNX file")[2].partition("\n### ")[0]
    (description,), (code,) = (re.findall(f"```{kind}\n(.*?)```", section, re.S) for kind in ("toml", "python"))
    monkeypatch.chdir(tmp_path)
    driver = onnx_driver(write(tmp_path, linear(3, [1.0, 0.5, 0.25]), description))
    unjam.check_driver(driver)
    assert driver.action_repeat == 5
    (tmp_path / "policy.toml").unlink()
    found: dict[str, Any] = {}
    exec(compile(code, "own-driver.md", "exec"), found)
    numbers = np.array(STATE[:3]).T @ [1.0, 0.5, 0.25]
    np.testing.assert_allclose(answers(found["driver"]), (numbers / 3.6 - STATE.speed) / 0.1, atol=1e-4)


def test_only_regular_files_of_a_limited_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, follower())
    for name in ("policy.onnx", "policy.toml"):
        (tmp_path / name).rename(tmp_path / "moved")
        (tmp_path / name).symlink_to("moved")
        assert refusal(path) == f"driver {name}: a symbolic link is not allowed; allowed: the file itself"
        (tmp_path / "moved").rename(tmp_path / name)
    path.unlink()
    assert "policy.onnx': No such file or directory" in refusal(path)
    os.mkfifo(path)
    assert refusal(path) == "driver policy.onnx: it is not a file"
    path.unlink()
    path.write_bytes(b"nonsense")
    assert "driver policy.onnx: graph: cannot be read: " in refusal(path)
    monkeypatch.setattr("unjam.adapters.onnx_file.MAX_MODEL_BYTES", 7)
    assert refusal(path) == "driver policy.onnx: more than 7 bytes are not allowed; allowed: a smaller file"


@pytest.mark.parametrize("name", ["onnx", "onnxruntime"])
def test_a_missing_package_is_named_with_its_extra(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = follower()
    made.graph.name = name  # not in a cache
    path = write(tmp_path, made)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingPartError, match=rf"{name} is not installed.*unjam\[train\]"):
        onnx_driver(path)


def test_a_closed_road_is_needed_for_its_length(tmp_path: Path) -> None:
    path = tmp_path / "length.onnx"
    path.write_bytes(linear(1, [1.0]).SerializeToString())
    driver = onnx_driver(path, PolicyDescription((PolicyInput("loop_length"),)))
    with pytest.raises(InputError, match="not allowed on motorway: it needs a closed road"):
        unjam.run_episode(unjam.make_scenario("on-ramp"), driver, 0)
