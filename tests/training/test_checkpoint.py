import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from unjam.errors import DiskError, InputError
from unjam.files import sha256_of
from unjam.training import run_folder
from unjam.training.run_folder import load_checkpoint, save_checkpoint

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


def file_of(folder: Path, iteration: int) -> Path:
    """The file of the checkpoint of an iteration."""
    (path,) = folder.glob(f"{iteration:06d}-*.safetensors")
    return path


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
    assert sorted(path.name[:7] for path in tmp_path.iterdir()) == ["000010-", "000011-"]
    assert is_content(load_checkpoint(tmp_path), 11)


def test_other_files_are_not_changed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "000000-old").mkdir()
    save_all(tmp_path, 1, 2, 3)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "000000-old").is_dir()
    assert is_content(load_checkpoint(tmp_path), 3)


def test_checkpoint_of_another_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "CHECKPOINT_FORMAT", 1)
    save_all(tmp_path, 1)
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"000001-.* has format 1, of another version of unjam; allowed: \d+$"):
        load_checkpoint(tmp_path)


def swap(one: Path, other: Path) -> None:
    middle = one.with_suffix(".swap")
    one.rename(middle)
    other.rename(one)
    middle.rename(other)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def rewrite(path: Path, content: bytes) -> None:
    """Replace a checkpoint by another content with the hash that belongs to it."""
    path.unlink()
    path.with_name(f"{path.name[:7]}{sha256_of(content)}.safetensors").write_bytes(content)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: path.write_bytes(b""),
    "half": halve,
    "zeros": lambda path: path.write_bytes(bytes(300)),
    "one byte more": lambda path: path.open("ab").write(b"\0"),
    "another number": lambda path: path.write_bytes(path.read_bytes().replace(b"00, ", b"01, ")),
    "another hash": lambda path: path.rename(path.with_name(f"{path.name[:7]}{'0' * 64}.safetensors")),
    "a list as state": lambda path: rewrite(path, save({}, {"state": "[1]"})),
    "null as state": lambda path: rewrite(path, save({}, {"state": "null"})),
    "no state": lambda path: rewrite(path, save({})),
    "no tensors": lambda path: rewrite(path, path.read_bytes()[:-1]),
    "of another iteration": lambda path: swap(path, file_of(path.parent, 1)),
}


@pytest.mark.parametrize("name", [name for name in DAMAGE if "another iteration" not in name])
def test_previous_checkpoint_replaces_a_damaged_one(tmp_path: Path, name: str) -> None:
    save_all(tmp_path, 1, 2)
    DAMAGE[name](file_of(tmp_path, 2))
    assert is_content(load_checkpoint(tmp_path), 1)


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_checkpoints_are_reported(tmp_path: Path, name: str) -> None:
    save_all(tmp_path, 1, 2)
    for iteration in (2,) if "another iteration" in name else (2, 1):
        DAMAGE[name](file_of(tmp_path, iteration))
    with pytest.raises(InputError, match=r"checkpoint: all 2 under .* are damaged") as caught:
        load_checkpoint(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.long
@settings(max_examples=60)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
@example(place=0.0, bits=1)
@example(place=0.999, bits=128)
def test_changed_byte_never_changes_the_loaded_content(place: float, bits: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_all(folder, 1, 2)
        path = file_of(folder, 2)
        content = bytearray(path.read_bytes())
        content[int(place * len(content))] ^= bits
        path.write_bytes(content)
        assert is_content(load_checkpoint(folder), 1)


@settings(max_examples=60)
@given(share=st.floats(0, 1, exclude_max=True))
def test_truncated_file_is_detected(share: float) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_all(folder, 1, 2)
        path = file_of(folder, 2)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        assert is_content(load_checkpoint(folder), 1)


@pytest.mark.parametrize("name", [name for name in DAMAGE if "another iteration" not in name])
def test_damaged_checkpoint_is_replaced(tmp_path: Path, name: str) -> None:
    save_all(tmp_path, 1, 2)
    DAMAGE[name](file_of(tmp_path, 2))
    save_all(tmp_path, 2)
    assert is_content(load_checkpoint(tmp_path), 2)
    assert len(list(tmp_path.iterdir())) == 2


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
