"""A run is killed, or the disk is full, before, within and after every single thing it does to its folder."""

import builtins
import errno
import json
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NoReturn

import pytest
import torch

from tests.training.test_run import small_config
from unjam import files
from unjam.drivers import PISaturation
from unjam.errors import DiskError, InputError
from unjam.files import append_line, to_json
from unjam.folders import Folder
from unjam.reports.results import read_results
from unjam.scenarios import Ring
from unjam.training import run_folder
from unjam.training.evaluate import evaluate, save_evaluation
from unjam.training.run_folder import (
    PROGRESS_FILE,
    create_run_folder,
    restore_newest_checkpoint,
    resume_run_folder,
    save_checkpoint,
)
from unjam.worlds.worker_pool import WorkerPool

ITERATIONS = 4
Moment = Literal["before", "half", "after"]
Content = dict[str, bytes]


class Killed(BaseException):
    """The process is no more: nothing that it does from now on happens."""


class Disk:
    """Counts what is done to files, and fails at one of them: by death, or as a full disk does."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int, moment: Moment, kill: bool) -> None:
        self.at, self.moment, self.kill = at, moment, kill
        self.count, self.dead = 0, False
        for name in ("replace", "mkdir", "unlink", "rmdir"):
            patch.setattr(os, name, self.failing(getattr(os, name)))
        patch.setattr(os, "fsync", self.failing(lambda descriptor: None))  # no power is lost here
        patch.setattr(Folder, "open", self.failing(Folder.open))
        patch.setattr(files, "open", self.opened, raising=False)

    def fail(self) -> NoReturn:
        if self.kill:
            self.dead = True
            raise Killed
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def now(self, moment: Moment) -> bool:
        return self.count == self.at and self.moment == moment

    def failing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def done(*arguments: Any, **options: Any) -> Any:
            if self.dead:
                raise Killed
            self.count += 1
            if self.now("before"):
                self.fail()
            found = function(*arguments, **options)
            if self.now("after"):
                self.fail()
            return found

        return done

    def opened(self, *arguments: Any, **options: Any) -> Any:
        file = self.failing(builtins.open)(*arguments, **options)
        write = file.write

        def written(data: Any) -> int:
            if self.now_within():
                write(data[: len(data) // 2])
                file.flush()
                self.fail()
            return self.failing(write)(data)

        return _Written(file, written)

    def now_within(self) -> bool:
        if self.count + 1 == self.at and self.moment == "half" and not self.dead:
            self.count += 1
            return True
        return False


class _Written:
    """A file that is written to in another way."""

    def __init__(self, file: Any, write: Callable[[Any], int]) -> None:
        self._file, self.write = file, write
        self.flush, self.fileno = file.flush, file.fileno

    def __enter__(self) -> "_Written":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


@pytest.fixture(autouse=True)
def no_manifest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "manifest", lambda: {"started": "some day"})


def run(folder: Path) -> None:
    """The file operations of a training that is started, or resumed if it was started before."""
    if (folder / "config.toml").is_file():
        resume_run_folder(folder, small_config())
    else:
        create_run_folder(folder, small_config())
    found = restore_newest_checkpoint(folder, {folder})
    state, tensors = found or ({"iteration": 0, "sum": 0}, {"weight": torch.zeros(2)})
    while state["iteration"] < ITERATIONS:
        number = state["iteration"] + 1
        state = {"iteration": number, "sum": state["sum"] + number}
        tensors = {"weight": tensors["weight"] * 2 + number}
        append_line(folder / PROGRESS_FILE, to_json({**state, "return": 1 / 3}))
        save_checkpoint(folder / "checkpoint", state, tensors)


def content_of(folder: Path) -> Content:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def crash(folder: Path, at: int, moment: Moment, kill: bool, command: Callable[[Path], None] = run) -> Disk:
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, at, moment, kill)
        with suppress(Killed, DiskError):
            command(folder)
        return disk


@pytest.mark.long
@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_run_resumes_to_the_same_files_after_any_failure(every: int, tmp_path: Path) -> None:
    wanted_in, trial = tmp_path / "wanted", 0
    total = crash(wanted_in, 0, "before", False).count
    wanted = content_of(wanted_in)
    assert total > 50
    assert [json.loads(line)["iteration"] for line in wanted[PROGRESS_FILE].splitlines()] == [1, 2, 3, 4]
    moments: tuple[Moment, ...] = ("before", "half", "after")
    for kill in (True, False):
        for moment in moments:
            for at in range(1, total + 1, every):
                trial += 1
                folder = tmp_path / str(trial)
                crash(folder, at, moment, kill)
                run(folder)
                assert content_of(folder) == wanted, (kill, moment, at)


@pytest.mark.long
def test_run_resumes_after_two_failures(tmp_path: Path) -> None:
    crash(tmp_path / "wanted", 0, "before", False)
    wanted = content_of(tmp_path / "wanted")
    for first in range(1, 60, 11):
        for second in range(1, 60, 7):
            folder = tmp_path / f"{first}-{second}"
            crash(folder, first, "after", True)
            crash(folder, second, "before", True)
            run(folder)
            assert content_of(folder) == wanted, (first, second)


@pytest.mark.long
def test_an_evaluation_that_replaces_another_is_never_mixed_with_it(tmp_path: Path) -> None:
    ring = Ring(length=(60, 60), vehicles=5, horizon=20)
    with WorkerPool(1) as pool:
        old, new = (evaluate(ring, {"PI": PISaturation()}, [(seed,)], pool) for seed in (1, 2))
    total = crash(tmp_path / "wanted", 0, "before", False, partial(save_evaluation, evaluation=new, metadata={})).count
    refused = 0
    moments: tuple[Moment, ...] = ("before", "half", "after")
    for kill, moment, at in product((True, False), moments, range(1, total + 1)):
        folder = tmp_path / f"{kill}-{moment}-{at}"
        save_evaluation(folder, old, {})
        crash(folder, at, moment, kill, partial(save_evaluation, evaluation=new, metadata={}))
        try:
            found = read_results(folder)
        except InputError:
            refused += 1
        else:
            assert tuple(found.plot_episodes["PI"].seed) == (found.rows["PI"][0]["seed"],)
        save_evaluation(folder, new, {})
        assert content_of(folder) == content_of(tmp_path / "wanted")
    assert 0 < refused < 3 * total
