import hashlib
import io
import json
import pickle
import struct
import tempfile
import zipfile
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from tests.conftest import random_network
from unjam.controller import controller_bytes, load_controller
from unjam.controller.file import MANIFEST_PART, WEIGHTS_PART
from unjam.controller.manifest import MANIFEST_FORMAT
from unjam.drivers import IDM, FollowerStopper, PISaturation, ResidualDriver
from unjam.drivers.check import random_state
from unjam.drivers.driver import Driver
from unjam.drivers.observation import FeatureName, observation_size
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.user_driver import FileDriver
from unjam.drivers.wrappers import MixedDriver
from unjam.errors import InputError
from unjam.trust import trusting_code

ALL_PARTS: tuple[FeatureName, ...] = (
    *("local", "expert_acceleration", "expert_memory", "loop_length", "lap_position", "route_position"),
)
ABOUT = {"scenario": {"kind": "ring"}, "iteration": 3}


def residual(
    expert: Driver, seed: int = 0, hold: int = 1, outputs: int = 1, parts: tuple[FeatureName, ...] = ALL_PARTS
) -> ResidualDriver:
    network = random_network(observation_size(parts, expert), seed, outputs=outputs)
    return ResidualDriver(expert, network, 1.0, parts, hold)


def actions(driver: Driver) -> np.ndarray:
    generator, memory, found = np.random.default_rng(0), driver.initial_memory(3), []
    for _ in range(30):
        acceleration, memory = driver.act(random_state(generator, 3), memory)
        found.append(acceleration)
    return np.array(found)


def written(folder: Path, content: bytes) -> Path:
    path = folder / "it.unjam"
    path.write_bytes(content)
    return path


def refusal_message(path: Path) -> str:
    """The one line with which a controller is refused."""
    with pytest.raises(InputError) as caught:
        load_controller(path)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith("controller")
    return line


def parts_of(content: bytes) -> tuple[dict[str, Any], bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return json.loads(archive.read(MANIFEST_PART)), archive.read(WEIGHTS_PART)


def archive_of(**parts: bytes | str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, part in parts.items():
            archive.writestr({"manifest": MANIFEST_PART, "weights": WEIGHTS_PART}.get(name, name), part)
    return content.getvalue()


def with_weights(weights: bytes, change: Callable[[dict[str, Any]], object] = lambda manifest: None) -> bytes:
    """A controller with arbitrary weights and the hash of them."""
    manifest, _ = parts_of(controller_bytes(residual(IDM()), ABOUT))
    manifest["sha256"][WEIGHTS_PART] = hashlib.sha256(weights).hexdigest()
    change(manifest)
    return archive_of(manifest=json.dumps(manifest), weights=weights)


def with_manifest(change: Callable[[dict[str, Any]], object]) -> bytes:
    return with_weights(save(driver_recipe(residual(IDM()))[1]), change)


@pytest.mark.parametrize(
    "driver",
    [
        PISaturation(window=20),
        residual(PISaturation()),
        residual(FollowerStopper(), hold=7),
        residual(PISaturation(), outputs=2),
        residual(residual(residual(PISaturation(), 1, hold=3), 2), 3, hold=5),
    ],
    ids=["expert", "residual", "held residual", "residual of sac", "residual of a residual of a residual"],
)
def test_a_controller_acts_as_the_driver_it_was_made_of(tmp_path: Path, driver: Driver) -> None:
    loaded = load_controller(written(tmp_path, controller_bytes(driver, ABOUT)))
    np.testing.assert_array_equal(actions(loaded), actions(driver))
    assert type(loaded) is type(driver)


def test_the_networks_of_a_nested_residual_are_not_mixed_up(tmp_path: Path) -> None:
    inner = residual(IDM(), 1)
    driver = residual(inner, 2)
    loaded = load_controller(written(tmp_path, controller_bytes(driver, ABOUT)))
    assert isinstance(loaded, ResidualDriver)
    assert isinstance(loaded.expert, ResidualDriver)
    for found, given_ in ((loaded.network, driver.network), (loaded.expert.network, inner.network)):
        for one, other in zip(chain(*found.layers), chain(*given_.layers), strict=True):
            np.testing.assert_array_equal(one, other)
        assert (found.authority, found.exploration_std) == (given_.authority, given_.exploration_std)


def test_the_same_driver_has_the_same_bytes(tmp_path: Path) -> None:
    content = controller_bytes(residual(PISaturation()), ABOUT)
    assert controller_bytes(residual(PISaturation()), ABOUT) == content
    assert controller_bytes(load_controller(written(tmp_path, content)), ABOUT) == content
    assert controller_bytes(residual(PISaturation(), seed=1), ABOUT) != content
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert {part.date_time for part in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}  # no matter when


def test_the_manifest_says_what_it_is() -> None:
    manifest, weights = parts_of(controller_bytes(residual(IDM()), ABOUT))
    assert manifest["format"] == MANIFEST_FORMAT
    assert manifest["scenario"] == {"kind": "ring"}
    assert manifest["iteration"] == 3
    assert manifest["driver"]["expert"]["kind"] == "idm"
    assert manifest["sha256"] == {WEIGHTS_PART: hashlib.sha256(weights).hexdigest()}


def test_an_expert_of_the_users_own_is_named_with_the_hash_of_its_file(my_drivers: Path) -> None:
    manifest, _ = parts_of(controller_bytes(residual(FileDriver(my_drivers, "gentle")), ABOUT))
    assert manifest["driver"]["expert"]["path"] == str(my_drivers)
    assert hashlib.sha256(my_drivers.read_bytes()).hexdigest() in json.dumps(manifest)


def test_an_expert_of_the_users_own_works_in_its_run_folder_and_its_loss_is_told(
    tmp_path: Path, my_drivers: Path
) -> None:
    driver = residual(FileDriver(my_drivers, "gentle"))
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(driver, ABOUT))
    np.testing.assert_array_equal(actions(load_controller(tmp_path)), actions(driver))
    my_drivers.unlink()
    with pytest.raises(InputError, match=r"mine\.py' is not a file"):
        load_controller(tmp_path)


def test_an_expert_of_the_users_own_that_has_changed_is_another(tmp_path: Path, my_drivers: Path) -> None:
    driver = residual(FileDriver(my_drivers, "gentle"))
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(driver, ABOUT))
    my_drivers.write_text(my_drivers.read_text() + "# changed")
    with pytest.raises(InputError, match=r"its code '.*mine\.py' has changed since"):
        load_controller(tmp_path)


@pytest.mark.parametrize("nested", [False, True])
def test_a_file_by_itself_never_runs_code_that_it_names(tmp_path: Path, nested: bool) -> None:
    code = tmp_path / "code.py"
    code.write_text("from pathlib import Path\ndef trap(state):\n    return state.speed\n")
    expert: Driver = FileDriver(code, "trap")
    content = controller_bytes(residual(MixedDriver((IDM(), residual(expert))) if nested else expert), ABOUT)
    code.write_text(code.read_text() + f"Path({str(tmp_path / 'sprung')!r}).touch()\n")
    assert "is Python code (code.py), which a file by itself may not run" in refusal_message(written(tmp_path, content))
    assert not (tmp_path / "sprung").exists()


@pytest.fixture
def seen_by_own(tmp_path: Path) -> tuple[Path, dict[str, Any], bytes]:
    """A Python file that leaves a mark when it runs, and manifest and weights of a mixture with its feature."""
    code = tmp_path / "eyes.py"
    code.write_text("def look(state):\n    return state.speed\n")
    driver = MixedDriver((IDM(), residual(IDM(), parts=("local", f"{code}:look"))))
    manifest, weights = parts_of(controller_bytes(driver, ABOUT))
    trap = f"from pathlib import Path\nPath({str(tmp_path / 'sprung')!r}).touch()\n"
    code.write_text(trap + code.read_text())
    manifest["driver"]["drivers"][1]["files"][0]["sha256"] = hashlib.sha256(code.read_bytes()).hexdigest()
    return code, manifest, weights


@pytest.mark.parametrize(
    "hide",
    [
        lambda recipe: recipe.pop("files"),
        lambda recipe: recipe.update(files=[]),
        lambda recipe: recipe["files"][0].update(path="/other.py"),
        lambda recipe: recipe["files"][0].update(name="other"),
    ],
    ids=["no list", "empty list", "another file", "another name"],
)
@pytest.mark.parametrize("own", [False, True], ids=["by itself", "run folder"])
def test_a_feature_whose_file_is_not_listed_is_never_run(
    tmp_path: Path, seen_by_own: tuple[Path, dict[str, Any], bytes], hide: Callable[[dict[str, Any]], object], own: bool
) -> None:
    _, manifest, weights = seen_by_own
    hide(manifest["driver"]["drivers"][1])
    content = archive_of(manifest=json.dumps(manifest), weights=weights)
    (tmp_path / "controller.unjam").write_bytes(content)
    reasons = "recipe lists with their hashes|may not run; use|is not a file|, as in inputs|runs only with --trust-code"
    with pytest.raises(InputError, match=reasons):
        load_controller(tmp_path if own else written(tmp_path, content))
    assert not (tmp_path / "sprung").exists()


def test_a_feature_that_changes_after_it_was_checked_is_never_run(
    tmp_path: Path, seen_by_own: tuple[Path, dict[str, Any], bytes]
) -> None:
    code, manifest, weights = seen_by_own
    code.write_text(f"{code.read_text()}# replaced\n")
    with pytest.raises(InputError, match=r"eyes\.py:look: its file has changed since; allowed: as it was"):
        driver_from_recipe(manifest["driver"], load(weights))
    assert not (tmp_path / "sprung").exists()


def test_a_feature_of_the_users_own_runs_from_its_run_folder_alone_and_unchanged(
    tmp_path: Path, seen_by_own: tuple[Path, dict[str, Any], bytes]
) -> None:
    code, manifest, weights = seen_by_own
    content = archive_of(manifest=json.dumps(manifest), weights=weights)
    (tmp_path / "controller.unjam").write_bytes(content)
    assert "is Python code (eyes.py), which a file by itself may not run" in refusal_message(written(tmp_path, content))
    assert not (tmp_path / "sprung").exists()
    assert "runs only with --trust-code" in refusal_message(tmp_path)
    assert not (tmp_path / "sprung").exists()
    with trusting_code():
        assert isinstance(load_controller(tmp_path), MixedDriver)
    code.write_text(code.read_text() + "# changed")
    assert "has changed since" in refusal_message(tmp_path)


def test_changed_weights_are_noticed(tmp_path: Path) -> None:
    manifest, weights = parts_of(controller_bytes(residual(IDM()), ABOUT))
    changed = bytearray(weights)
    changed[-3] ^= 1
    content = archive_of(manifest=json.dumps(manifest), weights=bytes(changed))
    assert f"damaged: {WEIGHTS_PART} does not have the hash that it names" in refusal_message(
        written(tmp_path, content)
    )


@pytest.mark.parametrize("change", [{"sample.safetensors": "0"}, {"another": "0"}])
def test_parts_that_are_not_those_that_are_named_are_refused(tmp_path: Path, change: dict[str, str]) -> None:
    content = with_manifest(lambda manifest: manifest["sha256"].update(change))
    assert "damaged: its parts are not those that it names" in refusal_message(written(tmp_path, content))


def test_weights_of_no_network_are_refused(tmp_path: Path) -> None:
    arrays = {**driver_recipe(residual(IDM()))[1], "expert.network.layers.0.0": np.zeros((2, 2))}
    words = refusal_message(written(tmp_path, with_weights(save(arrays))))
    assert "weights 'expert.network.layers.0.0' belong to no network" in words


def test_a_memory_that_would_fill_the_machine_is_refused(tmp_path: Path) -> None:
    pi = {"kind": "pi", "window": 1e12}
    content = with_manifest(lambda manifest: manifest["driver"].update(expert=pi))
    with pytest.raises(InputError, match=r"window: 1000000000000\.0 is not allowed"):
        load_controller(written(tmp_path, content))


@settings(max_examples=60)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_a_changed_byte_is_refused_or_changes_nothing(place: float, bits: int) -> None:
    driver = residual(PISaturation())
    content = bytearray(controller_bytes(driver, ABOUT))
    content[int(place * len(content))] ^= bits
    with tempfile.TemporaryDirectory() as folder:
        try:
            loaded = load_controller(written(Path(folder), bytes(content)))
        except InputError:
            return
    assert controller_bytes(loaded, ABOUT) == controller_bytes(driver, ABOUT)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.5, 0.9, 0.99])
def test_a_file_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    content = controller_bytes(residual(IDM()), ABOUT)
    assert "not a controller" in refusal_message(written(tmp_path, content[: int(share * len(content))]))


def archive_with_script(place: str, script: bytes) -> bytes:
    """An archive of a controller with a script outside its parts."""
    content, made = controller_bytes(residual(IDM()), ABOUT), io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(made, "w") as other:
        other.comment = script if place == "comment" else b""
        for entry in archive.infolist():
            part = archive.read(entry)
            entry.extra = struct.pack("<HH", 0x7075, len(script)) + script if place == "extra field" else b""
            other.writestr(entry, part)
        if place == "left out of the index":
            other.writestr("run.sh", script)
            other.filelist.pop()
    return {"before": script + content, "after": content + script}.get(place, made.getvalue())


@pytest.mark.parametrize("place", ["before", "after", "comment", "extra field", "left out of the index"])
def test_bytes_outside_the_parts_of_an_archive_are_refused(tmp_path: Path, place: str) -> None:
    file = written(tmp_path, archive_with_script(place, b"#!/bin/sh\ntouch run\n"))
    assert "has bytes outside its parts" in refusal_message(file)


DIRECTORY = b"PK\x01\x02"
"""how an entry of a zip archive's directory begins"""


@pytest.mark.parametrize(
    ("offset", "kind", "value"),
    [
        (8, "<H", 1),
        (10, "<H", 8),
        (10, "<H", 12),
        (10, "<H", 14),
        (10, "<H", 77),
        (24, "<I", 10),
        (42, "<I", 2**31),
        (42, "<I", 2**32 - 1),
    ],
    ids=[
        "encrypted",
        "deflated, it says",
        "bzip2, it says",
        "lzma, it says",
        "unknown compression",
        "smaller than it is",
        "beyond the end",
        "far beyond the end",
    ],
)
@pytest.mark.parametrize("part", [0, 1])
def test_an_archive_that_lies_about_a_part_is_refused(
    tmp_path: Path, part: int, offset: int, kind: str, value: int
) -> None:
    content = bytearray(controller_bytes(residual(IDM()), ABOUT))
    entry = content.index(DIRECTORY)
    if part == 1:
        entry = content.index(DIRECTORY, entry + 1)
    struct.pack_into(kind, content, entry + offset, value)
    refusal_message(written(tmp_path, bytes(content)))


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 not really", bytes(1000)])
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    assert "controller it.unjam: not a controller" in refusal_message(written(tmp_path, content))


def test_an_archive_without_a_part_is_refused(tmp_path: Path) -> None:
    manifest, weights = parts_of(controller_bytes(residual(IDM()), ABOUT))
    assert WEIGHTS_PART in refusal_message(written(tmp_path, archive_of(manifest=json.dumps(manifest))))
    assert MANIFEST_PART in refusal_message(written(tmp_path, archive_of(weights=weights)))
    refusal_message(written(tmp_path, archive_of()))


@pytest.mark.parametrize("manifest", ["", "{", "[]", "3", "null", "{}", '"format"', "\xff", '{"format": 1}'])
def test_a_manifest_that_is_none_is_refused(tmp_path: Path, manifest: str) -> None:
    content = archive_of(manifest=manifest.encode("latin-1"), weights=save({"x": np.zeros(1)}))
    refusal_message(written(tmp_path, content))


@pytest.mark.parametrize("number", [0, 1, 2, 3, -4])
def test_another_format_is_refused_with_the_version_that_wrote_it(tmp_path: Path, number: int) -> None:
    content = with_manifest(lambda manifest: manifest.update(format=number, unjam="9.8.7"))
    line = refusal_message(written(tmp_path, content))
    assert f"format {number}, written by unjam '9.8.7', is not allowed; allowed: format {MANIFEST_FORMAT}, " in line


@pytest.mark.parametrize("number", [True, 2.0, 4.0, "4", None, [4], {}], ids=str)
def test_a_format_that_is_no_integer_is_refused(tmp_path: Path, number: object) -> None:
    content = with_manifest(lambda manifest: manifest.update(format=number))
    assert f"manifest.format: {number!r} is not allowed" in refusal_message(written(tmp_path, content))


DEEP = '"driver": ' + "[" * 100_000 + "]" * 100_000
NO_STRICT_JSON = {
    "a key twice": ('"format": 4', "it names 'format' twice"),
    "a nested key twice": ('"scenario": {"kind": "ring", "kind": "merge"}', "it names 'kind' twice"),
    "NaN": ('"time_step": NaN', "the number NaN is not finite"),
    "infinity": ('"time_step": -Infinity', "the number -Infinity is not finite"),
    "a float that overflows": ('"time_step": 1e999', "the number 1e999 is not finite"),
    "a huge integer": (f'"iteration": {2**63}', "has more than 64 bits"),
    "a number of many digits": (f'"iteration": {"9" * 5000}', "has more than 64 bits"),
    "nesting": (DEEP, "it is nested too deep"),
    "no UTF-8": ('"summary": "\udcff"', "'utf-8' codec"),
}


@pytest.mark.parametrize("name", NO_STRICT_JSON)
def test_a_manifest_in_loose_json_is_refused(tmp_path: Path, name: str) -> None:
    text, words = NO_STRICT_JSON[name]
    manifest, weights = parts_of(controller_bytes(residual(IDM()), {}))
    part = f"{json.dumps(manifest)[:-1]}, {text}}}".encode(errors="surrogateescape")
    assert words in refusal_message(written(tmp_path, archive_of(manifest=part, weights=weights)))


def test_a_manifest_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    content = with_manifest(lambda manifest: manifest.update(summary="x" * 2**20))
    assert "part 'manifest.json' has " in refusal_message(written(tmp_path, content))


@pytest.mark.parametrize("key", ["time_step", "action_limit"])
def test_statements_that_contradict_the_scenario_are_refused(tmp_path: Path, key: str) -> None:
    scenario = {"simulation_step": 0.1, "steps_per_control_step": 5, "action_limit": 2.0}
    about = {"scenario": scenario, "time_step": 0.5, "action_limit": 2.0}
    load_controller(written(tmp_path, controller_bytes(residual(IDM()), about)))
    content = controller_bytes(residual(IDM()), {**about, key: 0.25})
    assert f"manifest.{key}: 0.25 is not allowed; allowed: " in refusal_message(written(tmp_path, content))


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "magic"},
        {"kind": None},
        {"kind": ["pi"]},
        {"kind": "pi", "window": -1},
        {"kind": "pi", "window": 10**400},
        {"kind": "pi", "charm": 1},
        {"expert": None},
        {"expert": "pi"},
        {"expert": []},
        {"inputs": ["stars"]},
        {"inputs": []},
        {"inputs": 3},
        {"action_repeat": 0},
        {"action_repeat": 2.5},
        {"action_repeat": "long"},
        {"action_limit": -1.0},
        {"action_limit": float("nan")},
        {"action_limit": "much"},
        {"network": {"authority": float("inf")}},
        {"network": {"authority": "all"}},
        {"network": {"authority": 10**400}},
        {"network": {"exploration_std": float("nan")}},
        {"network": {"exploration_std": None}},
        {"network": {"episode_noise": 1}},
        {"network": {"layers": []}},
        {"network": {"layers": [[1.0, 2.0]]}},
        {"network": {"layers": [[{"array": "none"}, {"array": "none"}]]}},
    ],
    ids=str,
)
def test_a_recipe_that_makes_no_sense_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    network, others = change.get("network", {}), {key: value for key, value in change.items() if key != "network"}

    def change_recipe(manifest: dict[str, Any]) -> None:
        manifest["driver"].update(others)
        manifest["driver"]["network"].update(network)

    path = written(tmp_path, with_manifest(change_recipe))
    with pytest.raises(InputError) as caught:
        load_controller(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("recipe", [None, [], "pi", 3])
def test_a_recipe_that_is_no_table_is_refused(tmp_path: Path, recipe: object) -> None:
    with pytest.raises(InputError) as caught:
        load_controller(written(tmp_path, with_manifest(lambda manifest: manifest.update(driver=recipe))))
    assert "\n" not in str(caught.value)


def test_a_recipe_of_endless_depth_is_refused(tmp_path: Path) -> None:
    manifest = '{"format": 1, "driver": ' + '{"expert": ' * 100_000 + "1" + "}" * 100_001
    refusal_message(written(tmp_path, archive_of(manifest=manifest, weights=save({"x": np.zeros(1)}))))


@pytest.mark.parametrize(
    "change",
    [
        {"network.layers.1.0": np.zeros((3, 16))},
        {"network.layers.1.1": np.zeros(3)},
        {"network.layers.0.0": np.zeros(16)},
        {"network.layers.2.0": np.zeros((16, 3)), "network.layers.2.1": np.zeros(3)},
        {"network.layers.1.1": np.full(16, np.nan)},
        {"network.layers.1.1": np.full(16, np.inf)},
        {"network.layers.0.0": np.zeros((3, 16))},
    ],
    ids=["inputs", "bias", "dimensions", "outputs", "nan", "infinite", "not what it observes"],
)
def test_weights_of_a_wrong_shape_or_not_finite_are_refused(tmp_path: Path, change: dict[str, np.ndarray]) -> None:
    arrays = {**driver_recipe(residual(IDM()))[1], **change}
    with pytest.raises(InputError) as caught:
        load_controller(written(tmp_path, with_weights(save(arrays))))
    assert "\n" not in str(caught.value)


def test_weights_that_are_missing_are_refused(tmp_path: Path) -> None:
    arrays = driver_recipe(residual(IDM()))[1]
    del arrays["network.layers.1.1"]
    with pytest.raises(InputError, match=r"array .network\.layers\.1\.1. is missing"):
        load_controller(written(tmp_path, with_weights(save(arrays))))


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("part", ["weights", "manifest", "data.pkl"])
def test_a_pickle_inside_is_never_run(tmp_path: Path, part: str) -> None:
    sprung = tmp_path / "sprung"
    trap = pickle.dumps(Trap(sprung))
    manifest, weights = parts_of(with_weights(trap if part == "weights" else save(driver_recipe(residual(IDM()))[1])))
    parts = {"manifest": json.dumps(manifest).encode(), "weights": weights, part: trap}
    refusal_message(written(tmp_path, archive_of(**parts)))
    assert not sprung.exists()


def test_a_run_folder_stands_for_its_controller(tmp_path: Path) -> None:
    driver = residual(PISaturation())
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(driver, ABOUT))
    for made in (load_controller(tmp_path), load_controller(str(tmp_path))):
        np.testing.assert_array_equal(actions(made), actions(driver))


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    assert "does not exist" in refusal_message(tmp_path / "none.unjam")
    assert "controller.unjam' does not exist" in refusal_message(tmp_path)
