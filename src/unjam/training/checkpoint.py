"""Checkpoints at the end of iterations: written whole, checked by hash, two generations kept."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save

from unjam.errors import InputError
from unjam.files import make_folder, write_whole
from unjam.learners.learner import Tensors

FORMAT = 2
"""of what a checkpoint holds; one of another unjam is refused"""
GENERATIONS = 2
STATE, TENSORS = "state.json", "tensors.safetensors"


def save_checkpoint(folder: Path, state: dict[str, Any], tensors: Tensors) -> None:
    """Write the checkpoint of an iteration under `folder`, and remove all but the newest two.

    `state["iteration"]` names it. The state is written last and holds the hash of both: a
    checkpoint without it does not count.
    """
    place = folder / f"{state['iteration']:06d}"
    make_folder(place)
    state, data = {**state, "format": FORMAT}, save(tensors)
    write_whole(place / TENSORS, data)
    write_whole(place / STATE, json.dumps({**state, "sha256": _hash(state, data)}, indent=1))
    for old in _places(folder)[:-GENERATIONS]:
        shutil.rmtree(old, ignore_errors=True)


def load_checkpoint(folder: Path) -> tuple[dict[str, Any], Tensors] | None:
    """Return the newest checkpoint that is whole; None where there was never any.

    Raises:
        InputError: there are some, and all of them are damaged, or another unjam made them.
    """
    places = _places(folder)
    for place in reversed(places):
        try:
            state = json.loads((place / STATE).read_text())
            data = (place / TENSORS).read_bytes()
            if state.pop("sha256") != _hash(state, data):
                continue
            found, known = state.pop("format", 1), load(data)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, SafetensorError):
            continue
        if found != FORMAT:
            raise InputError(
                f"checkpoint: {place} has format {found!r}, of another version of unjam; allowed: {FORMAT}"
            )
        return state, known
    if places:
        raise InputError(f"checkpoint: all {len(places)} under {folder} are damaged")
    return None


def _hash(state: dict[str, Any], data: bytes) -> str:
    return hashlib.sha256(json.dumps(state, sort_keys=True).encode() + data).hexdigest()


def _places(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(place for place in folder.iterdir() if place.is_dir() and place.name.isdigit())
