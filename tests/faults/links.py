"""Links of another user in a folder of results."""

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
"""targets of a planted link"""
CANARY_NUMBERS = count()


def plant(path: Path, kind: str, outside: Path) -> None:
    """Replace a file or folder by a link to it, after moving it to `outside`; or by a link of another kind."""
    canary = outside / str(next(CANARY_NUMBERS))
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
"""mode, inode, time of the last change [ns] and content of each file in a folder, by path"""


def state_of(folder: Path) -> State:
    """Return the state of all files below a folder, without following links."""
    state: State = {}
    for path in sorted([folder, *folder.rglob("*")]):
        status = path.lstat()
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        state[str(path.relative_to(folder))] = (status.st_mode, status.st_ino, status.st_mtime_ns, content)
    return state


def with_temporary_names(names: list[str]) -> list[str]:
    """Return `names`, the name of the lock, and names of temporary files that earlier versions used."""
    parts = [str(Path(name).with_name(f".{Path(name).name}.part")) for name in names]
    return [*names, LOCK_FILE, *parts]


def links(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Plant links at up to three names of a stopped run, and resume it."""
    outcome, interrupted = Outcome(), folder / "interrupted"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder, "manifest", lambda: {"started": "some day"})
        total = crash(folder / "whole", 0, "before", False).count
        crash(interrupted, 2 * total // 3, "after", True)
        names = with_temporary_names([str(path.relative_to(interrupted)) for path in sorted(interrupted.rglob("*"))])
        for number in range(count):
            run_copy, outside = folder / str(number) / "run", folder / str(number) / "outside"
            shutil.copytree(interrupted, run_copy)
            outside.mkdir()
            kind = str(generator.choice(KINDS))
            for name in generator.choice(names, int(generator.integers(1, 4)), replace=False):
                if not any(path.is_symlink() for path in (run_copy / name).parents):
                    plant(run_copy / name, kind, outside)
            before, happened = state_of(outside), "the run went on"
            try:
                with lock_folder(run_copy):
                    run(run_copy)
            except UnjamError as error:
                one_line(error)
                happened = "one line"
            assert state_of(outside) == before
            outcome.happened[f"{kind}: {happened}, nothing changed outside"] += 1
            shutil.rmtree(run_copy.parent)
    return outcome
