"""Each entry of a signed controller's manifest as something else: it is refused, or means what it meant."""

import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.controller.test_file import residual
from tests.controller.test_sample import perceived
from tests.controller.test_signature import KEY, OTHER
from tests.controller.test_verify import places
from unjam.controller import controller_bytes
from unjam.controller.file import (
    MANIFEST_PART,
    SAMPLE_PART,
    SIGNATURE_PART,
    add_signature,
    pack_parts,
    read_controller,
    sample_bytes,
    unpack_parts,
)
from unjam.controller.manifest import PROVENANCE_ENTRIES, first_difference
from unjam.controller.signature import signature_of
from unjam.controller.verify import PartCheck, check_parts
from unjam.drivers import PISaturation
from unjam.drivers.registry import driver_recipe
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.scenarios import Ring
from unjam.training.run_folder import controller_origin

MAKER_ONLY = {*PROVENANCE_ENTRIES, "unjam"}
"""entries that nothing in the file can prove"""


@pytest.fixture(scope="module")
def signed_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller with all that an exported one of a run says of itself, signed."""
    driver = FilteredDriver(residual(PISaturation(), hold=3), 1.0, SafetyFilter(), 0.1)
    run = {"scenario": "ring", "agent": "trpo", "seed": 3}
    counted = {"iteration": 5, "environment_steps": 1000, "metrics": {"reward": "released"}}
    about = {**controller_origin(Ring(), driver), "run": run, **counted}
    path = tmp_path_factory.mktemp("signed") / "it.unjam"
    path.write_bytes(controller_bytes(driver, about, {SAMPLE_PART: sample_bytes(driver, perceived(), 6.0)}))
    add_signature(path, read_controller(path), KEY)
    return path


def known(path: Path) -> tuple[Any, dict[str, PartCheck]]:
    """The recipe of a controller's driver, and what is checked of it; the signature is another's.

    How a training explored is left out: a controller drives without exploration.
    """
    controller = read_controller(path)
    checks = {check_part.part: check_part for check_part in check_parts(controller) if check_part.status != "stated"}
    del checks["signature"]
    recipe = driver_recipe(controller.driver)[0]
    return replace_values(recipe, exploration_std=0.0, episode_noise=False), checks


def replace_values(tree: Any, **values: Any) -> Any:
    """A JSON value with these values wherever a table has the key."""
    if isinstance(tree, dict):
        return {key: values.get(key, replace_values(entry, **values)) for key, entry in tree.items()}
    return [replace_values(entry, **values) for entry in tree] if isinstance(tree, list) else tree


def replace_entry(manifest: Any, place: tuple[Any, ...], change: Callable[[Any, Any], None]) -> Any:
    """The manifest with a change (of the table or list around a place, at its key)."""
    copy = deepcopy(manifest)
    around = copy
    for key in place[:-1]:
        around = around[key]
    change(around, place[-1])
    return copy


def put(make: Callable[[Any], Any]) -> Callable[[Any, Any], None]:
    def change(around: Any, key: Any) -> None:
        around[key] = make(around[key])

    return change


def remove(around: Any, key: Any) -> None:
    del around[key]


def add(around: Any, key: Any) -> None:
    if isinstance(around[key], dict):
        around[key]["another"] = around[key].get("kind", 1)
    elif isinstance(around[key], list):
        around[key].append(deepcopy(around[key][-1]) if around[key] else 1)


KINDS: dict[str, Callable[[Any, Any], None]] = {
    "true": put(lambda value: True),
    "false": put(lambda value: False),
    "number of a Boolean": put(lambda value: int(value) if isinstance(value, bool) else value),
    "float": put(lambda value: float(value) if type(value) is int else value),
    "integer": put(lambda value: int(value) if type(value) is float and value.is_integer() else value),
    "text": put(str),
    "JSON as text": put(json.dumps),
    "null": put(lambda value: None),
    "list": put(lambda value: [value]),
    "table": put(lambda value: {"value": value}),
    "empty": put(lambda value: type(value)() if isinstance(value, str | list | dict) else value),
    "missing": remove,
    "extra": add,
}


def changes(manifest: Any, kind: str) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Manifests with one change; lists are of a kind, so of each the first entry stands for all."""
    for place in places(manifest):
        alike = any(type(key) is int and key > 0 for key in place)
        if not alike and len(place) <= (2 if place[0] in MAKER_ONLY else 9):
            changed = replace_entry(manifest, place, KINDS[kind])
            if json.dumps(changed) != json.dumps(manifest):
                yield place, changed


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_an_entry_of_another_type_is_refused_or_means_the_same(kind: str, signed_file: Path, tmp_path: Path) -> None:
    """A forger signs with a key of their own; that the first signature no longer fits is tested, too."""
    parts = unpack_parts(signed_file)
    before, count, path = known(signed_file), 0, tmp_path / "it.unjam"
    for place, manifest in changes(json.loads(parts[MANIFEST_PART]), kind):
        forged = {**parts, MANIFEST_PART: json.dumps(manifest).encode()}
        path.write_bytes(pack_parts(forged))
        with pytest.raises(InputError):
            read_controller(path)
        del forged[SIGNATURE_PART]
        path.write_bytes(pack_parts({**forged, SIGNATURE_PART: signature_of(forged, OTHER)}))
        count += 1
        try:
            after = known(path)
        except InputError as error:
            assert "\n" not in str(error), place  # noqa: PT017
            continue
        assert after[0] == before[0], place
        if place[0] in MAKER_ONLY:
            continue
        if place[0] == "driver" and kind in ("missing", "empty"):  # a default, and it is said so
            assert after[1].pop("driver").detail.endswith("have the defaults of this version"), place
            assert after[1] == {part: each for part, each in before[1].items() if part != "driver"}, place
        else:
            assert after[1] == before[1], place
    assert count > 0


@pytest.mark.parametrize(
    ("said", "found", "name"),
    [
        (True, 1, ""),
        ({"a": [1, False]}, {"a": [1, 0]}, "a[1]"),
        ({"a": None}, {}, "a"),
        ({}, {"a": None}, "a"),
        ([1], [1, 2], ""),
        ("1", 1, ""),
        ({"steps": 1_000_001}, {"steps": 1_000_000}, "steps"),
        ({"gap": 1.1}, {"gap": 1.0}, "gap"),
        ({"gap": None}, {"gap": 1.0}, "gap"),
    ],
)
def test_documents_that_mean_something_else_differ(said: Any, found: Any, name: str) -> None:
    difference = first_difference(said, found, tolerance=1e-3)
    assert difference is not None
    assert difference[0] == name


def test_documents_that_mean_the_same_do_not_differ() -> None:
    one = {"a": [1.0, None, True, "x"], "b": {"c": 3}}
    assert first_difference(one, {"b": {"c": 3.0}, "a": [1, None, True, "x"]}) is None
    assert first_difference({"gap": 1.0 + 1e-7}, {"gap": 1.0}, tolerance=1e-6) is None
    assert first_difference({"gap": np.inf}, {"gap": 1.0}, tolerance=1e-6) is not None
    assert first_difference({}, one, allows_missing=True) is None
