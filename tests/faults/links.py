"""Links that a stranger plants in a folder of results."""

import os
import shutil
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from tests.faults.outcome import Outcome, one_line
from tests.training.test_crash_points import crash, run
from unjam.errors import UnjamError
from unjam.processes import LOCK_FILE, lock_folder
from unjam.training import run_folder

KINDS = ("a file", "a folder", "nothing", "hard link")
"""what a planted link leads to"""
NUMBERS = count()


def plant(path: Path, kind: str, outside: Path) -> None:
    """Put a link in place of a file or folder, to what was there, which is moved outside, or to the like."""
    canary = outside / str(next(NUMBERS))
    path.parent.mkdir(parents=True, exist_ok=True)
    if os.path.lexists(path):
        shutil.move(path, canary)
    else:
        canary.write_text("mine")
    if kind == "hard link" and canary.is_file():
        path.hardlink_to(canary)
        return
    if kind == "nothing":
        canary = canary.with_name(f"{canary.name}-gone")
    elif kind == "a folder" and canary.is_file():
        canary = canary.with_name(f"{canary.name}-folder")
        canary.mkdir()
        (canary / "canary").write_text("mine")
    path.symlink_to(canary)


State = dict[str, tuple[int, int, int, bytes]]
"""what a folder holds, by path: mode, number and time of change of a file, and its content"""


def state_of(folder: Path) -> State:
    """Return what a folder holds; links are not followed."""
    found: State = {}
    for path in sorted([folder, *folder.rglob("*")]):
        about = path.lstat()
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        found[str(path.relative_to(folder))] = (about.st_mode, about.st_ino, about.st_mtime_ns, content)
    return found


def with_temporary_names(names: list[str]) -> list[str]:
    """Return names, that of the lock, and temporary names that could be guessed in earlier versions."""
    parts = [str(Path(name).with_name(f".{Path(name).name}.part")) for name in names]
    return [*names, LOCK_FILE, *parts]


def links(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Plant links at up to three names of a run that was stopped, and let it go on."""
    outcome, interrupted = Outcome(), folder / "begun"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder, "manifest", lambda: {"started": "some day"})
        total = crash(folder / "whole", 0, "before", False).count
        crash(interrupted, 2 * total // 3, "after", True)
        names = with_temporary_names([str(path.relative_to(interrupted)) for path in sorted(interrupted.rglob("*"))])
        for number in range(count):
            place, outside = folder / str(number) / "run", folder / str(number) / "outside"
            shutil.copytree(interrupted, place)
            outside.mkdir()
            kind = str(generator.choice(KINDS))
            for name in generator.choice(names, int(generator.integers(1, 4)), replace=False):
                if not any(path.is_symlink() for path in (place / name).parents):
                    plant(place / name, kind, outside)
            before, happened = state_of(outside), "the run went on"
            try:
                with lock_folder(place):
                    run(place)
            except UnjamError as error:
                one_line(error)
                happened = "one line"
            assert state_of(outside) == before
            outcome.happened[f"{kind}: {happened}, nothing changed outside"] += 1
            shutil.rmtree(place.parent)
    return outcome
