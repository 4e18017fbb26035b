import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from tests.conftest import random_network, unrun_driver
from tests.controller.test_file import ABOUT, residual, written
from tests.controller.test_sample import perceived
from unjam.controller import controller_bytes, load_controller
from unjam.controller.file import (
    GRAPH_PART,
    MANIFEST_PART,
    SAMPLE_PART,
    pack_parts,
    read_controller,
    sample_bytes,
    unpack_parts,
)
from unjam.controller.verify import check_parts, verify_controller_file
from unjam.drivers import IDM, Constant, Driver, PISaturation, ResidualDriver
from unjam.errors import InputError, MissingPartError
from unjam.files import sha256_of
from unjam.physics.idm import PAPER_IDM, equilibrium_gap
from unjam.trust import trusting_code

HELD = residual(PISaturation(), hold=3)


def content_of(driver: Driver = HELD, limit: float | None = None, parts: dict[str, bytes] | None = None) -> bytes:
    about = ABOUT if limit is None else {**ABOUT, "action_limit": limit}
    sample = sample_bytes(driver, perceived(), limit or 1.0)
    return controller_bytes(driver, about, {SAMPLE_PART: sample, **(parts or {})})


def write_changed(folder: Path, change: Callable[[dict[str, Any]], object], content: bytes | None = None) -> Path:
    """A controller with another manifest."""
    parts = unpack_parts(written(folder, content or content_of()))
    manifest = json.loads(parts[MANIFEST_PART])
    change(manifest)
    return written(folder, pack_parts({**parts, MANIFEST_PART: json.dumps(manifest).encode()}))


def refusal_message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        verify_controller_file(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def statuses(path: Path) -> dict[str, str]:
    return {each.part: each.status for each in verify_controller_file(path)}


FORMULA_IN_FOLDER = {
    **dict.fromkeys(("parts", "driver", "weights", "manifest"), "checked"),
    **dict.fromkeys(("signature", "code", "sample", "graph", "certificate"), "absent"),
    **dict.fromkeys(("origin", "road"), "stated"),
}
"""what is known of a controller with a network and nothing else"""


def test_each_part_of_a_controller_is_checked_absent_or_stated(tmp_path: Path) -> None:
    path = written(tmp_path, content_of())
    assert statuses(path) == {**FORMULA_IN_FOLDER, "sample": "checked"}
    (sample,) = [each.detail for each in verify_controller_file(path) if each.part == "sample"]
    assert sample.startswith("40 control steps: the driver repeats them within 0.0e+00 m/s2 (allowed 1e-09); ")


def test_what_a_recipe_leaves_out_is_said_to_be_a_default(tmp_path: Path) -> None:
    def leave_out(manifest: dict[str, Any]) -> None:
        del manifest["driver"]["expert"]["time_constant"]

    for content, words in (
        (content_of(), "built from all entries of its recipe"),
        (write_changed(tmp_path, leave_out).read_bytes(), "missing parameters have the defaults of this version"),
    ):
        found = verify_controller_file(written(tmp_path, content))
        assert [each.detail.endswith(words) for each in found if each.part == "driver"] == [True]


def test_code_of_a_folder_runs_only_where_it_is_trusted(tmp_path: Path) -> None:
    code, ran = tmp_path / "code.py", tmp_path / "ran"
    code.write_text("def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n")
    held = residual(unrun_driver(code, f"open({str(ran)!r}, 'w').close()\n"))
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(held, ABOUT))
    alone = refusal_message(tmp_path / "controller.unjam")
    assert alone.endswith("Python code (code.py), which a file by itself may not run; use the run folder")
    assert f"names Python code ({str(code)!r}), which " in refusal_message(tmp_path)
    assert refusal_message(tmp_path).endswith("it runs only with --trust-code")
    assert not ran.exists()
    with trusting_code():
        assert statuses(tmp_path)["code"] == "checked"
    assert ran.exists()
    assert statuses(tmp_path)["code"] == "checked"  # it is remembered


def test_a_feature_of_a_folder_is_code_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, ran = tmp_path / "eyes.py", tmp_path / "ran"
    code.write_text("def seen(state):\n    return state.speed\n")
    network = random_network(inputs=1)
    code.write_text(f"open({str(ran)!r}, 'w').close()\n" + code.read_text())
    held = ResidualDriver(PISaturation(), network, 1.0, (f"{code}:seen",))
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(held, ABOUT))
    ran.unlink(missing_ok=True)
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "of another user"))
    assert refusal_message(tmp_path).endswith("it runs only with --trust-code")
    assert not ran.exists()


def test_a_controller_of_a_run_has_no_sample_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(HELD, ABOUT))
    assert statuses(tmp_path) == FORMULA_IN_FOLDER


def test_a_formula_without_any_statement_is_said_to_have_none(tmp_path: Path) -> None:
    found = statuses(written(tmp_path, controller_bytes(PISaturation(), {})))
    assert (found["weights"], found["origin"]) == ("absent", "absent")
    assert "road" not in found


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda said: said["observation"].reverse(), "observation"),
        (lambda said: said["observation"][0].update(unit="km/h"), "observation"),
        (lambda said: said["networks"][""][0].update(scale=20.0), "networks"),
        (lambda said: said["networks"].pop(""), "networks"),
        (lambda said: said["memory"].pop(), "memory"),
        (lambda said: said["memory"][0].update(shape=[3]), "memory"),
        (lambda said: said["action"].update(high=3.0), "action"),
        (lambda said: said.update(action_repeat=4), "action_repeat"),
        (lambda said: said.pop("action_repeat"), "action_repeat"),
    ],
)
def test_a_manifest_that_says_something_else_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], key: str
) -> None:
    words = refusal_message(write_changed(tmp_path, change))
    assert f"controller: manifest.{key}" in words or f"manifest.{key}: missing" in words


def test_a_sample_that_the_driver_does_not_answer_so_is_refused(tmp_path: Path) -> None:
    other = sample_bytes(residual(PISaturation(), seed=1), perceived(), 1.0)
    words = refusal_message(written(tmp_path, content_of(parts={SAMPLE_PART: other})))
    assert words.startswith("controller: step 0 of its sample: its driver answers ")


def test_a_sample_without_bounds_is_refused(tmp_path: Path) -> None:
    assert "names no bounds" in refusal_message(written(tmp_path, content_of(PISaturation())))
    assert statuses(written(tmp_path, content_of(PISaturation(), limit=1.0)))["sample"] == "checked"


@pytest.mark.parametrize("count", [0, 1001])
def test_a_sample_that_checks_nothing_or_takes_long_is_refused(tmp_path: Path, count: int) -> None:
    longest = load(sample_bytes(HELD, perceived(1001), 1.0))
    sample = save({name: values[:count] for name, values in longest.items()})
    words = refusal_message(written(tmp_path, content_of(parts={SAMPLE_PART: sample})))
    assert words == f"sample: control steps: {count} is not allowed; allowed: 1 to 1000"


def test_a_graph_without_a_sample_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, controller_bytes(HELD, ABOUT, {GRAPH_PART: b"graph"}))
    assert "has controller.onnx, but no recorded sample" in refusal_message(path)


def test_a_graph_that_answers_something_else_is_refused(tmp_path: Path) -> None:
    from .test_graph import graph

    driver = Constant()
    path = written(tmp_path, content_of(driver, limit=20.0, parts={GRAPH_PART: graph()}))
    assert "step 0 of its sample: its graph answers " in refusal_message(path)


def test_a_graph_that_agrees_on_the_makers_sample_alone_is_refused(tmp_path: Path) -> None:
    """A sample of one constant state, and a graph that always answers as the driver does there."""
    from .test_graph import graph, helper

    def constant(model: Any) -> None:
        model.graph.node[0].CopyFrom(helper.make_node("Sub", ["speed", "speed"], ["acceleration"]))

    driver, same = IDM(), perceived(1)
    states = same.select(np.zeros(30, int))._replace(speed=np.full(30, 5.0), leader_speed=np.full(30, 5.0))
    resting = states._replace(leader_gap=np.full(30, equilibrium_gap(5.0, PAPER_IDM)))
    parts = {SAMPLE_PART: sample_bytes(driver, resting, 9.0), GRAPH_PART: graph(constant)}
    words = refusal_message(written(tmp_path, controller_bytes(driver, {"action_limit": 9.0}, parts)))
    assert words.startswith("controller: random state ")


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_graph_that_cannot_be_run_here_is_not_checked_and_never_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    from .test_graph import graph

    driver = Constant()
    path = written(tmp_path, content_of(driver, limit=20.0, parts={GRAPH_PART: graph()}))
    monkeypatch.setitem(sys.modules, package, None)
    (found,) = [check_part for check_part in check_parts(read_controller(path)) if check_part.part == "graph"]
    assert found.status == "not checked"
    with pytest.raises(MissingPartError, match=f"^controller: graph: not checked: {package} is not installed"):
        verify_controller_file(path)


def mutated(content: bytes, kind: str, place: float, other: bytes) -> bytes:
    """An archive with bytes changed, cut off, put in or doubled."""
    at = int(place * len(content))
    return {
        "change": content[:at] + other + content[at + len(other) :],
        "cut": content[:at],
        "insert": content[:at] + other + content[at:],
        "double": content + content[at:],
        "swap": content[at:] + content[:at],
    }[kind]


@settings(max_examples=60)
@given(
    kind=st.sampled_from(["change", "cut", "insert", "double", "swap"]),
    place=st.floats(0, 1, exclude_max=True),
    other=st.binary(min_size=1, max_size=4),
)
def test_a_damaged_file_is_refused_or_drives_as_before(kind: str, place: float, other: bytes) -> None:
    content = content_of()
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), mutated(content, kind, place, other))
        try:
            verify_controller_file(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017  (the other way out is no error)
            return
        assert controller_bytes(load_controller(path), ABOUT) == controller_bytes(HELD, ABOUT)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [*([path] if path else []), *(place for key, part in inner for place in places(part, (*path, key)))]


@settings(max_examples=60)
@given(number=st.integers(0), value=JSON)
def test_whatever_a_manifest_says_it_is_refused_in_one_line_or_drives(number: int, value: Any) -> None:
    """A manifest with one thing replaced, by a forger that also adapted the hashes."""

    def change(manifest: dict[str, Any]) -> None:
        found = places({key: part for key, part in manifest.items() if key != "sha256"})
        *path, last = found[number % len(found)]
        inner = manifest
        for key in path:
            inner = inner[key]
        inner[last] = value

    with tempfile.TemporaryDirectory() as folder:
        path = write_changed(Path(folder), change)
        try:
            verify_controller_file(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
            return
        answer, _ = load_controller(path).act(perceived(1), HELD.initial_memory(1))
    assert np.isfinite(answer).all()


def test_hashes_are_sha256() -> None:
    assert sha256_of(b"abc").startswith("ba7816bf")


def test_what_a_stranger_wrote_of_the_road_stays_on_its_line_and_out_of_the_terminal(tmp_path: Path) -> None:
    def forge(manifest: dict[str, Any]) -> None:
        manifest["scenario"] = {"kind": "ring\nchecked signature: by 'maker.pub'\x1b[31m"}

    (said,) = [each.detail for each in verify_controller_file(write_changed(tmp_path, forge)) if each.part == "road"]
    assert said == "made for the ring checked signature: by 'maker.pub'?[31m"
