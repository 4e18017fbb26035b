import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from unjam.errors import DiskError, InputError
from unjam.training import run_folder
from unjam.training.run_folder import CHECKPOINT_STATE_FILE, CHECKPOINT_TENSORS_FILE, load_checkpoint, save_checkpoint

Content = tuple[dict[str, Any], dict[str, torch.Tensor]]


def content_of(iteration: int) -> Content:
    state = {
        "iteration": iteration,
        "environment_steps": 300 * iteration,
        "best_validation": 1 / 3,
        "expert_returns": [-1e9],
    }
    generator = torch.Generator().manual_seed(iteration)
    tensors = {"policy.weight": torch.randn(3, 2, generator=generator), "optimizer.0.step": torch.tensor(4.0)}
    return state, tensors


def save_all(folder: Path, *iterations: int) -> None:
    for iteration in iterations:
        save_checkpoint(folder, *content_of(iteration))


def is_content(found: Content | None, iteration: int) -> bool:
    if found is None:
        return False
    state, tensors = content_of(iteration)
    same = all(torch.equal(found[1][name], tensors[name]) for name in tensors)
    return found[0] == state and found[1].keys() == tensors.keys() and same


def test_saved_checkpoint_is_loaded(tmp_path: Path) -> None:
    save_all(tmp_path, 7)
    assert is_content(load_checkpoint(tmp_path), 7)


def test_nonfinite_numbers_are_restored(tmp_path: Path) -> None:
    state = {"iteration": 1, "best_validation": float("-inf"), "expert_returns": [float("nan")]}
    save_checkpoint(tmp_path, state, {})
    found = load_checkpoint(tmp_path)
    assert found is not None
    assert found[0]["best_validation"] == float("-inf")
    (expert,) = found[0]["expert_returns"]
    assert expert != expert


def test_missing_checkpoint_is_none(tmp_path: Path) -> None:
    assert load_checkpoint(tmp_path) is None
    assert load_checkpoint(tmp_path / "nowhere") is None


def test_newest_two_checkpoints_are_kept(tmp_path: Path) -> None:
    save_all(tmp_path, 1, 2, 9, 10, 11)
    assert sorted(place.name for place in tmp_path.iterdir()) == ["000010", "000011"]
    assert is_content(load_checkpoint(tmp_path), 11)


def test_other_files_are_not_changed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "old").mkdir()
    save_all(tmp_path, 1, 2, 3)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "old").is_dir()
    assert is_content(load_checkpoint(tmp_path), 3)


def test_checkpoint_of_another_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "CHECKPOINT_FORMAT", 1)
    save_all(tmp_path, 1)
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"000001 has format 1, of another version of unjam; allowed: \d+$"):
        load_checkpoint(tmp_path)


def swap(one: Path, other: Path) -> None:
    middle = one.with_suffix(".swap")
    one.rename(middle)
    other.rename(one)
    middle.rename(other)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edit_state(place: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = place / CHECKPOINT_STATE_FILE
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


DAMAGE: dict[str, Callable[[Path], object]] = {
    "no state": lambda place: (place / CHECKPOINT_STATE_FILE).unlink(),
    "no tensors": lambda place: (place / CHECKPOINT_TENSORS_FILE).unlink(),
    "nothing": lambda place: (shutil.rmtree(place), place.mkdir()),
    "half a state": lambda place: halve(place / CHECKPOINT_STATE_FILE),
    "half the tensors": lambda place: halve(place / CHECKPOINT_TENSORS_FILE),
    "empty state": lambda place: (place / CHECKPOINT_STATE_FILE).write_bytes(b""),
    "empty tensors": lambda place: (place / CHECKPOINT_TENSORS_FILE).write_bytes(b""),
    "more than the tensors": lambda place: (place / CHECKPOINT_TENSORS_FILE).open("ab").write(b"\0"),
    "state of zeros": lambda place: (place / CHECKPOINT_STATE_FILE).write_bytes(bytes(300)),
    "state that is a list": lambda place: (place / CHECKPOINT_STATE_FILE).write_text("[]"),
    "state that is a number": lambda place: (place / CHECKPOINT_STATE_FILE).write_text("3"),
    "state that is null": lambda place: (place / CHECKPOINT_STATE_FILE).write_text("null"),
    "state without its hash": lambda place: edit_state(place, lambda s: {k: s[k] for k in s if k != "sha256"}),
    "state with another number": lambda place: edit_state(place, lambda s: {**s, "environment_steps": 601}),
    "hash that is none": lambda place: edit_state(place, lambda s: {**s, "sha256": None}),
    "tensors of another iteration": lambda place: swap(
        place / CHECKPOINT_TENSORS_FILE, place.parent / "000001" / CHECKPOINT_TENSORS_FILE
    ),
}


@pytest.mark.parametrize("name", [name for name in DAMAGE if "another iteration" not in name])
def test_previous_checkpoint_replaces_a_damaged_one(tmp_path: Path, name: str) -> None:
    save_all(tmp_path, 1, 2)
    DAMAGE[name](tmp_path / "000002")
    assert is_content(load_checkpoint(tmp_path), 1)


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_checkpoints_are_reported(tmp_path: Path, name: str) -> None:
    save_all(tmp_path, 1, 2)
    for place in ("000002",) if "another iteration" in name else ("000002", "000001"):
        DAMAGE[name](tmp_path / place)
    with pytest.raises(InputError, match=r"checkpoint: all 2 under .* are damaged") as caught:
        load_checkpoint(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.long
@settings(max_examples=60)
@given(
    part=st.sampled_from([CHECKPOINT_STATE_FILE, CHECKPOINT_TENSORS_FILE]),
    place=st.floats(0, 1, exclude_max=True),
    bits=st.integers(1, 255),
)
@example(part=CHECKPOINT_STATE_FILE, place=0.0, bits=0x20)
@example(part=CHECKPOINT_TENSORS_FILE, place=0.0, bits=1)
@example(part=CHECKPOINT_TENSORS_FILE, place=0.999, bits=128)
def test_changed_byte_never_changes_the_loaded_content(part: str, place: float, bits: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_all(folder, 1, 2)
        path = folder / "000002" / part
        content = bytearray(path.read_bytes())
        content[int(place * len(content))] ^= bits
        path.write_bytes(content)
        found = load_checkpoint(folder)
    # A blank between two entries of the state says nothing, so a state with another one is still whole.
    harmless = part == CHECKPOINT_STATE_FILE and is_content(found, 2)
    assert harmless or is_content(found, 1)


@settings(max_examples=60)
@given(part=st.sampled_from([CHECKPOINT_STATE_FILE, CHECKPOINT_TENSORS_FILE]), share=st.floats(0, 1, exclude_max=True))
def test_truncated_file_is_detected(part: str, share: float) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_all(folder, 1, 2)
        path = folder / "000002" / part
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        assert is_content(load_checkpoint(folder), 1)


def test_damaged_checkpoint_is_overwritten(tmp_path: Path) -> None:
    save_all(tmp_path, 1, 2)
    halve(tmp_path / "000002" / CHECKPOINT_TENSORS_FILE)
    save_all(tmp_path, 2)
    assert is_content(load_checkpoint(tmp_path), 2)


def test_full_disk_keeps_earlier_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_all(tmp_path, 1, 2)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DiskError, match="No space left on device"):
        save_checkpoint(tmp_path, *content_of(3))
    monkeypatch.undo()
    assert is_content(load_checkpoint(tmp_path), 2)
    save_all(tmp_path, 3)
    assert is_content(load_checkpoint(tmp_path), 3)
