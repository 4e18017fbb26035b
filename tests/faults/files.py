"""Faults of files: damaged checkpoints, controllers, configurations and results, and a full disk."""

import json
import resource
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from safetensors.torch import save

from tests.controller.test_signature import FOR_ANY_MESSAGE, WEAK, forge, signature_part
from tests.controller.test_verify import HELD, content_of, mutated
from tests.faults.outcome import Outcome, one_line
from tests.pictures import empty_pictures
from unjam.controller import controller_bytes, load_controller
from unjam.controller.file import (
    ARCHIVE_PARTS,
    CERTIFICATE_PART,
    GRAPH_PART,
    MANIFEST_PART,
    SIGNATURE_PART,
    WEIGHTS_PART,
    add_signature,
    pack_parts,
    read_controller,
    unpack_parts,
)
from unjam.controller.signature import make_keys, read_private_key, signature_of
from unjam.controller.verify import verify_controller_file
from unjam.errors import DiskError, InputError
from unjam.reports.html import write_report_page
from unjam.training.config import load_config, to_toml
from unjam.training.drive import drive
from unjam.training.run_folder import load_checkpoint, save_checkpoint
from unjam.training.runs import list_runs

MUTATIONS = ("change", "cut", "insert", "double", "swap")
MAX_REFUSAL_SECONDS = 2.0
"""maximum time until an invalid configuration is refused [s]"""
INVALID_VALUES = [
    "nan",
    "-1",
    "1e400",
    '""',
    '"ghost"',
    "[]",
    "{}",
    "true",
    "9" * 30,
    "[[[[1]]]]",
    "0",
    "1979-05-27",
    "=",
]


def save_small_checkpoint(folder: Path, iteration: int) -> None:
    """Save a small checkpoint with values that depend on the iteration."""
    tensors = {"policy.weight": torch.full((20, 5), float(iteration)), "step": torch.tensor(iteration)}
    save_checkpoint(folder, {"iteration": iteration, "validation_best": 0.1 * iteration}, tensors)


def loaded_iteration(folder: Path) -> int:
    """Load the newest intact checkpoint, check that all values are of one iteration, and return the iteration."""
    found = load_checkpoint(folder)
    assert found is not None
    state, tensors = found
    assert state["validation_best"] == 0.1 * state["iteration"]
    assert (tensors["policy.weight"] == state["iteration"]).all()
    return state["iteration"]


def any_mutation(content: bytes, generator: np.random.Generator) -> bytes:
    """Return `content` with some bytes changed, cut off, inserted, doubled or swapped."""
    other = generator.bytes(int(generator.integers(1, 5)))
    return mutated(content, str(generator.choice(MUTATIONS)), generator.random(), other)


def checkpoints(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Damage the newest checkpoint: changed bytes, parts of another one, an older format, empty or missing files."""
    outcome = Outcome()
    for number in range(count):
        place = folder / str(number)
        save_small_checkpoint(place, 1)
        save_small_checkpoint(place, 2)
        other, path = sorted(place.iterdir())
        kind = generator.choice(["bytes", "bytes", "bytes", "empty", "missing", "another's", "old schema"])
        if kind == "bytes":
            path.write_bytes(any_mutation(path.read_bytes(), generator))
        elif kind == "empty":
            path.write_bytes(b"")
        elif kind == "missing":
            path.unlink()
        elif kind == "another's":
            path.write_bytes(other.read_bytes())
        else:
            path.write_bytes(save({}, {"state": '{"iteration": 2, "format": 0}'}))
        newest = loaded_iteration(place)
        outcome.happened["the generation before was used" if newest == 1 else "nothing was lost"] += 1
    return outcome


def controllers(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Damage the file of a controller."""
    outcome, content, path = Outcome(), content_of(), folder / "it.unjam"
    original = controller_bytes(HELD, {})
    for _ in range(count):
        path.write_bytes(any_mutation(content, generator))
        try:
            verify_controller_file(path)
        except InputError as error:
            one_line(error)
            outcome.happened["refused in one line"] += 1
            continue
        assert controller_bytes(load_controller(path), {}) == original
        outcome.happened["nothing was lost"] += 1
    return outcome


def signatures(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Change a signed controller as a forger would that adapts all hashes, or change its signature."""
    outcome, path, maker = Outcome(), folder / "it.unjam", make_keys(folder / "maker")
    key, other = read_private_key(maker.private), Ed25519PrivateKey.generate()
    path.write_bytes(content_of(parts={GRAPH_PART: b"drawn", CERTIFICATE_PART: b"{}"}))
    add_signature(path, read_controller(path), key)
    original = unpack_parts(path)
    while outcome.injected < count:
        parts = dict(original)
        kind, part = str(generator.choice(FORGERIES)), str(generator.choice(ARCHIVE_PARTS[1:-1]))
        if kind == "a part changed":
            parts[part] = any_mutation(parts[part], generator)
        elif kind == "a part gone" and part != WEIGHTS_PART:
            del parts[part]
        elif kind == "its manifest changed":
            parts[MANIFEST_PART] = with_invalid_entry(json.loads(parts[MANIFEST_PART]), generator).encode()
        elif kind == "its signature changed":
            parts[SIGNATURE_PART] = any_mutation(parts[SIGNATURE_PART], generator)
        elif kind == "signed by another":
            del parts[SIGNATURE_PART]
            parts[SIGNATURE_PART] = signature_of(parts, other)
        elif kind == "signed with a weak key":
            parts[SIGNATURE_PART] = signature_part(WEAK[int(generator.integers(len(WEAK)))], FOR_ANY_MESSAGE)
        elif kind == "its signature taken away":
            del parts[SIGNATURE_PART]
        if parts == original:
            continue
        path.write_bytes(pack_parts(parts) if kind == "its manifest changed" else forge(parts))
        signed = kind not in ("signed by another", "its signature taken away")
        for read in (lambda: verify_controller_file(path, maker.public), *([lambda: read_controller(path)] * signed)):
            with pytest.raises(InputError) as caught:
                read()
            one_line(caught.value)
        outcome.happened[f"{kind}: refused in one line"] += 1
    return outcome


FORGERIES = (
    *("a part changed", "a part gone", "its manifest changed", "its signature changed", "signed by another"),
    *("signed with a weak key", "its signature taken away"),
)


def configurations(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Change a configuration at random."""
    outcome, path, longest = Outcome(), folder / "config.toml", 0.0
    lines = to_toml(load_config()).splitlines()
    for _ in range(count):
        changed_lines, place = list(lines), int(generator.integers(len(lines)))
        key, equals, _ = changed_lines[place].partition(" = ")
        kind = generator.choice(["value", "value", "value", "name", "twice", "bytes"])
        if kind == "value" and equals:
            changed_lines[place] = f"{key} = {generator.choice(INVALID_VALUES)}"
        elif kind == "name":
            changed_lines[place] = f"ghost_{changed_lines[place]}"
        else:
            changed_lines.insert(place, changed_lines[place])
        content = "\n".join(changed_lines).encode()
        path.write_bytes(any_mutation(content, generator) if kind == "bytes" else content)
        started = time.monotonic()
        try:
            load_config(path)
            outcome.happened["it was still a valid one"] += 1
        except InputError as error:
            one_line(error)
            outcome.happened["refused in one line before anything started"] += 1
        longest = max(longest, time.monotonic() - started)
    assert longest < MAX_REFUSAL_SECONDS
    outcome.facts["slowest [s]"] = round(longest, 3)
    return outcome


def results(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Damage a folder of results; then write its report, and list all runs."""
    outcome, original = Outcome(), folder / "whole"
    drive("ring", "pi", 1, scenario_options={"horizon": 20, "warmup": 0}, workers=1, out=original)
    (original / "config.toml").write_text(to_toml(load_config()))
    (original / "progress.jsonl").write_text('{"iteration": 1, "environment_steps": 5}\n')
    (original / "manifest.json").write_text("{}")
    for number in range(count):
        place = folder / str(number)
        shutil.copytree(original, place)
        files = sorted(path for path in place.iterdir() if path.is_file())
        part = files[int(generator.integers(len(files)))]
        kind = generator.choice(["bytes", "value", "value", "value", "empty", "missing", "a folder", "nested"])
        if kind == "value" and part.suffix == ".json":
            part.write_text(with_invalid_entry(json.loads(part.read_text()), generator))
        elif kind in ("bytes", "value"):
            part.write_bytes(any_mutation(part.read_bytes(), generator))
        elif kind == "nested":
            part.write_text("[" * 100_000)
        else:
            part.unlink()
            if kind != "missing":
                part.mkdir() if kind == "a folder" else part.touch()
        happened = "the report was written"
        for read_folder in (lambda path: write_report_page([path], path / "page.html"), list_runs):
            try:
                with empty_pictures():
                    read_folder(place)
            except InputError as error:
                one_line(error)
                happened = "refused in one line"
        outcome.happened[happened] += 1
        shutil.rmtree(place)
    return outcome


def with_invalid_entry(document: Any, generator: np.random.Generator) -> str:
    """Return a JSON document with one entry removed or replaced."""
    place = document
    while isinstance(place, dict | list) and place:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = keys[int(generator.integers(len(keys)))]
        if generator.random() < 0.4 or not isinstance(place[key], dict | list) or not place[key]:
            if generator.random() < 0.3:
                del place[key]
            else:
                invalid = (None, {}, [], 5, "x", True, -1, 1e308, [[]])
                place[key] = invalid[int(generator.integers(len(invalid)))]
            break
        place = place[key]
    return json.dumps(document)


def full_disks(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Save checkpoints on a disk that is full after some bytes."""
    outcome, before = Outcome(), resource.getrlimit(resource.RLIMIT_FSIZE)
    newest = 1
    save_small_checkpoint(folder, newest)
    for _ in range(count):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(generator.integers(0, 1500)), before[1]))
        try:
            save_small_checkpoint(folder, newest + 1)
            newest += 1
            outcome.happened["it still had room"] += 1
        except DiskError as error:
            one_line(error)
            outcome.happened["the checkpoint before was whole, exit code 74"] += 1
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert loaded_iteration(folder) == newest
        assert not list(folder.rglob("*.part"))
    return outcome
