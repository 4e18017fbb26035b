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

from tests.conftest import random_network, strangers_driver
from tests.controller.test_file import ABOUT, residual, written
from tests.controller.test_sample import perceived
from unjam.controller import controller_bytes, load_controller
from unjam.controller.file import GRAPH, MANIFEST, SAMPLE, hash_of, pack_parts, sample_bytes, unpack_parts
from unjam.controller.verify import verify_controller
from unjam.drivers import Constant, Driver, PISaturation, ResidualDriver
from unjam.errors import InputError
from unjam.trust import trusting_code

HELD = residual(PISaturation(), hold=3)


def content_of(
    driver: Driver = HELD, limit: float | None = None, parts: dict[str, bytes] | None = None
) -> bytes:
    about = ABOUT if limit is None else {**ABOUT, "action_limit": limit}
    sample = sample_bytes(driver, perceived(), limit or 1.0)
    return controller_bytes(driver, about, {SAMPLE: sample, **(parts or {})})


def changed(folder: Path, change: Callable[[dict[str, Any]], object], content: bytes | None = None) -> Path:
    """A controller with another manifest."""
    parts = unpack_parts(written(folder, content or content_of()))
    manifest = json.loads(parts[MANIFEST])
    change(manifest)
    return written(folder, pack_parts({**parts, MANIFEST: json.dumps(manifest).encode()}))


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        verify_controller(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def names(path: Path) -> list[str]:
    return [each.name for each in verify_controller(path)]


def test_a_whole_controller_is_verified(tmp_path: Path) -> None:
    path = written(tmp_path, content_of())
    assert names(path) == ["parts", "signature", "driver", "weights", "manifest", "sample"]
    assert "40 decisions, its driver within 0.0e+00 m/s2" in verify_controller(path)[-1].found


def test_code_of_a_folder_runs_only_where_it_is_trusted(tmp_path: Path) -> None:
    code, ran = tmp_path / "code.py", tmp_path / "ran"
    code.write_text("def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n")
    held = residual(strangers_driver(code, f"open({str(ran)!r}, 'w').close()\n"))
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(held, ABOUT))
    alone = refused(tmp_path / "controller.unjam")
    assert alone.endswith("Python code (code.py), which a file by itself may not run; use the run folder")
    assert f"names Python code ({str(code)!r}), which " in refused(tmp_path)
    assert refused(tmp_path).endswith("it runs only with --trust-code")
    assert not ran.exists()
    with trusting_code():
        assert names(tmp_path)[-1] == "manifest"
    assert ran.exists()
    assert names(tmp_path)[-1] == "manifest"  # it is remembered


def test_a_feature_of_a_folder_is_code_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, ran = tmp_path / "eyes.py", tmp_path / "ran"
    code.write_text("def seen(state):\n    return state.speed\n")
    network = random_network(inputs=1)
    held = ResidualDriver(PISaturation(), network, 1.0, (f"{code}:seen",))
    code.write_text(f"open({str(ran)!r}, 'w').close()\n" + code.read_text())
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(held, ABOUT))
    ran.unlink(missing_ok=True)
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "of another user"))
    assert refused(tmp_path).endswith("it runs only with --trust-code")
    assert not ran.exists()


def test_a_controller_of_a_run_has_no_sample_and_is_verified(tmp_path: Path) -> None:
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(HELD, ABOUT))
    assert names(tmp_path) == ["parts", "signature", "driver", "weights", "manifest"]


def test_a_controller_of_the_first_format_has_no_description_and_is_verified(tmp_path: Path) -> None:
    path = changed(tmp_path, lambda manifest: manifest.update(format=1), controller_bytes(HELD, ABOUT))
    assert names(path) == ["parts", "signature", "driver", "weights"]


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
        (lambda said: said.update(hold=4), "hold"),
        (lambda said: said.pop("hold"), "hold"),
    ],
)
def test_a_manifest_that_says_something_else_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], key: str
) -> None:
    assert f"its manifest says of {key}: " in refused(changed(tmp_path, change))


def test_a_sample_that_the_driver_does_not_answer_so_is_refused(tmp_path: Path) -> None:
    other = sample_bytes(residual(PISaturation(), seed=1), perceived(), 1.0)
    words = refused(written(tmp_path, content_of(parts={SAMPLE: other})))
    assert words.startswith("controller: step 0 of its sample: its driver answers ")


def test_a_sample_without_bounds_is_refused(tmp_path: Path) -> None:
    assert "names no bounds" in refused(written(tmp_path, content_of(PISaturation())))
    assert names(written(tmp_path, content_of(PISaturation(), limit=1.0)))[-1] == "sample"


def test_a_graph_without_a_sample_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, controller_bytes(HELD, ABOUT, {GRAPH: b"graph"}))
    assert "a graph or a certificate, but no recorded sample" in refused(path)


def test_a_graph_that_answers_something_else_is_refused(tmp_path: Path) -> None:
    from .test_graph import graph

    driver = Constant()
    path = written(tmp_path, content_of(driver, limit=20.0, parts={GRAPH: graph()}))
    assert "step 0 of its sample: its graph answers " in refused(path)


def test_without_onnx_the_graph_is_not_run_and_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    path = written(tmp_path, content_of(parts={GRAPH: b"anything"}))
    last = verify_controller(path)[-1]
    assert last.name == "graph"
    assert last.found.startswith("not run: onnx is not installed")


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
            verify_controller(path)
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
    return [
        *([path] if path else []),
        *(found for key, part in inner for found in places(part, (*path, key))),
    ]


@settings(max_examples=60)
@given(number=st.integers(0), value=JSON)
def test_whatever_a_manifest_says_it_is_refused_in_one_line_or_drives(number: int, value: Any) -> None:
    """A manifest with one thing replaced, by a forger who also made the hashes fit."""

    def change(manifest: dict[str, Any]) -> None:
        found = places({key: part for key, part in manifest.items() if key != "sha256"})
        *path, last = found[number % len(found)]
        inner = manifest
        for key in path:
            inner = inner[key]
        inner[last] = value

    with tempfile.TemporaryDirectory() as folder:
        path = changed(Path(folder), change)
        try:
            verify_controller(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
            return
        answer, _ = load_controller(path).act(perceived(1), HELD.initial_memory(1))
    assert np.isfinite(answer).all()


def test_hashes_are_sha256() -> None:
    assert hash_of(b"abc").startswith("ba7816bf")


def test_what_a_stranger_wrote_of_the_road_stays_on_its_line_and_out_of_the_terminal(tmp_path: Path) -> None:
    def forge(manifest: dict[str, Any]) -> None:
        manifest["scenario"] = {"kind": "ring\nok signature: of 'maker.pub'\x1b[31m"}

    (said,) = [each.found for each in verify_controller(changed(tmp_path, forge)) if each.name == "road"]
    assert said == "made for the ring?ok signature: of 'maker.pub'?[31m"
