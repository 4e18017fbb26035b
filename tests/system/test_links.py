"""No command writes through links that a foreign folder contains."""

import os
import re
import shutil
import stat
import subprocess
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.faults.links import KINDS, plant, state_of, with_temporary_names
from tests.recordings.synthetic_trajectories import write_table
from tests.system.conftest import PLAIN, UNJAM, Run
from tests.system.test_calibrate import CALIBRATE, DEMAND, ROWS
from tests.system.test_commands import SMALL, TINY_RUN
from tests.worlds.sumo.user_networks import straight
from unjam.processes import LOCK_FILE

ROAD = {
    "scenario_options.length": "[60,60]",
    "scenario_options.vehicles": 5,
    "scenario_options.horizon": 40,
    "model.model_ratio": 0,
}
TRIAL = {**ROAD, "trpo.steps_per_iteration": 160, "steps": 160, "evaluation.validation_episodes": 1}
SEARCH = ["search", "ring", *(word for key, value in TRIAL.items() for word in ("--set", f"{key}={value}"))]
SEARCH += ["--vary", "trpo.target_kl=0.01,0.02", "--workers", "1", "--out", "searched"]
TUNE = ["tune", "ring", "--length", "60", "--vehicles", "5", "--set", "horizon=20", "--expert", "pi"]
TUNE += ["--max-string-gain", "0"]
TUNE += ["--vary", "window=10,30", "--steps", "3000", "--out", "tuned"]
ASSESS = ["assess", "straight.sumocfg", "--penetration-rates", "0.5", "-d", "acc", "--set", "horizon=40", "-n", "36"]
FIT = ["fit-drivers", "data.parquet", "--set", "calibration.generations=2", "--out", "files/people.json"]
STUDY = ["reproduce", "table-1", "--seeds", "1", "--workers", "1", "--out", "studies"]
DRIVE = ["drive", "ring", "-d", "pi", "-n", "1", *SMALL, "--out", "new"]
VIDEO = ["watch", "ring", *SMALL, "-d", "pi", "--video"]
TWO_ROADS = '[[tasks]]\nscenario_options = {length = [70, 70]}\n[[tasks]]\nname = "short"\n[model]\nmodel_ratio = 0\n'


class Case(NamedTuple):
    """A command line, the folder that it writes to, and whether it only reads."""

    words: list[str]
    folder: str
    is_read_only: bool = False


CASES = {
    "train": Case([*TINY_RUN, "--steps", "160", "--set", "model.model_ratio=0", "--out", "new"], "new"),
    "resume": Case(["train", "--resume", "run", "--steps", "320", "--tensorboard"], "run"),
    "resume, several roads": Case(["train", "--resume", "roads", "--steps", "640"], "roads"),
    "evaluate": Case(["evaluate", "run", "-n", "1", "--workers", "1"], "run"),
    "model": Case(["model", "run"], "run"),
    "report": Case(["report", "run"], "run"),
    "search": Case([*SEARCH, "--trials", "2"], "searched"),
    "tune": Case(TUNE, "tuned"),
    "calibrate": Case([*map(str, CALIBRATE), "--out", "calibrated"], "calibrated"),
    "drive": Case(DRIVE, "new"),
    "assess": Case([*ASSESS, "--out", "new"], "new"),
    "export": Case(["export", "run", "--out", "files/ring.unjam"], "files"),
    "certify": Case(["certify", "files/it.unjam"], "files"),
    "keys": Case(["keys", "files/another"], "files"),
    "sign": Case(["sign", "files/it.unjam", "--key", "files/maker.key"], "files"),
    "watch": Case([*VIDEO, "files/video.gif"], "files"),
    "watch, .mp4": Case([*VIDEO, "files/video.mp4"], "files"),
    "scenarios": Case(["scenarios", "ring", "--picture", "files/road.png"], "files"),
    "fit-drivers": Case(FIT, "files"),
    "runs": Case(["runs", "--folder", "."], "run", is_read_only=True),
    "verify": Case(["verify", "run"], "run", is_read_only=True),
    "runs remove": Case(["runs", "remove", "run", "--folder", ".", "--yes"], "run"),
}
SLOW = (
    "resume",
    "train",
    "search",
    "tune",
    "calibrate",
    "assess",
    "certify",
    "fit-drivers",
    "watch",
    "watch, .mp4",
    "resume, several roads",
)
BASE = {
    "search": [*SEARCH, "--trials", "1"],
    "tune": TUNE,
    "calibrate": CASES["calibrate"].words,
    "resume, several roads": [*TINY_RUN, "--config", "roads.toml", "--steps", "160", "--out", "roads"],
}
"""what makes the files that a command continues"""
PARAMETERS = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES]
TOO_LONG = {"reproduce": (Case(STUDY, "studies"), ("configs", "runs", "logs", "references", "table-1"))}
"""commands that take hours, and the names that they write, where links are refused at the start"""
SYMBOLIC = [kind for kind in KINDS if kind != "hard link"]
RANDOM = re.compile(r"\.[0-9a-f]{16}(\.part)?$")
"""end of random names"""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, preloaded: Run) -> Path:
    """Make a folder with examples of the files that commands write or continue."""
    place = tmp_path_factory.mktemp("base")
    (place / "files").mkdir()
    (place / "studies").mkdir()
    straight(place, DEMAND, length=100.0)
    (place / "detectors.csv").write_text("\n".join(ROWS).replace("100", "50"))
    write_table(place / "data.parquet", [{}, {}])
    (place / "roads.toml").write_text(TWO_ROADS)
    for words in (
        [*TINY_RUN, "--steps", "160", "--out", "run", "--tensorboard"],
        ["export", "run", "--out", "files/it.unjam"],
        ["keys", "files/maker"],
    ):
        ran = preloaded(*words, folder=place, pictures=False)
        assert ran.returncode == 0, ran.stderr
    return place


def complete_base(command: str, base: Path, tmp_path: Path, preloaded: Run) -> Path:
    """Return the base with the files that a command continues."""
    if command not in BASE:
        return base
    copy = shutil.copytree(base, tmp_path / "base")
    ran = preloaded(*BASE[command], folder=copy, pictures=False)
    assert ran.returncode == 0, ran.stderr
    return copy


class Sandbox:
    """A copy of the base, with links to files outside."""

    def __init__(self, base: Path, tmp_path: Path, folder: str) -> None:
        self.place, self.outside = tmp_path / "place", tmp_path / "outside"
        shutil.copytree(base, self.place)
        self.outside.mkdir()
        self.folder = self.place / folder

    def run(self, preloaded: Run, case: Case) -> None:
        """Run a command: it succeeds, or ends with one line, and nothing outside has changed."""
        before = state_of(self.outside)
        ran = preloaded(*case.words, folder=self.place, pictures=False)
        assert "Traceback" not in ran.stderr, ran.stderr
        assert ran.returncode in (0, 2), ran.stderr
        if ran.returncode == 2:
            assert ran.stderr.splitlines()[-1].startswith("unjam: "), ran.stderr
        assert state_of(self.outside) == before, ran.stderr
        assert {path.name for path in self.place.parent.iterdir()} == {"place", "outside"}


def written_by(case: Case, base: Path, tmp_path: Path, preloaded: Run) -> dict[str, bool]:
    """Return the names that a command writes in its folder, and whether they are folders."""
    scene = Sandbox(base, tmp_path, case.folder)
    before = state_of(scene.folder) if scene.folder.is_dir() else {}
    ran = preloaded(*case.words, folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr
    after = state_of(scene.folder) if scene.folder.is_dir() else {}
    changed = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    return {
        name: stat.S_ISDIR((after.get(name) or before[name])[0])
        for name in sorted(changed)
        if name != "." and not RANDOM.search(name)
    }


def plantings(written: dict[str, bool]) -> list[list[tuple[str, str]]]:
    """Return groups of names and kinds of links to plant together: those in subfolders at the same time."""
    files = [name for name, is_folder in written.items() if not is_folder]
    top = [name for name in written if "/" not in name] or ["progress.jsonl"]
    deep = [name for name in files if "/" in name]
    deep_folders = [name for name in written if "/" in name and name not in files]
    return [
        [(name, "hard link") for name in (*files, LOCK_FILE)],
        list(zip(deep, cycle(SYMBOLIC), strict=False)),
        [(name, "a folder") for name in deep_folders if str(Path(name).parent) not in deep_folders],
        *([(name, kind)] for name, kind in zip(with_temporary_names(top), cycle(SYMBOLIC), strict=False)),
    ]


@pytest.mark.long
@pytest.mark.parametrize("command", PARAMETERS)
def test_commands_do_not_write_through_links(command: str, base: Path, tmp_path: Path, preloaded: Run) -> None:
    case, base = CASES[command], complete_base(command, base, tmp_path, preloaded)
    written = written_by(case, base, tmp_path / "first", preloaded)
    assert not case.is_read_only or not written
    for number, planted in enumerate(filter(None, plantings(written))):
        scene = Sandbox(base, tmp_path / str(number), case.folder)
        for name, kind in planted:
            plant(scene.folder / name, kind, scene.outside)
        scene.run(preloaded, case)
        shutil.rmtree(scene.place.parent)


@pytest.mark.long
@pytest.mark.parametrize("command", TOO_LONG)
def test_long_commands_refuse_links_at_the_start(command: str, base: Path, tmp_path: Path, preloaded: Run) -> None:
    case, names = TOO_LONG[command]
    for number, (name, kind) in enumerate(zip(with_temporary_names([*names]), cycle(SYMBOLIC), strict=False)):
        scene = Sandbox(base, tmp_path / str(number), case.folder)
        plant(scene.folder / name, kind, scene.outside)
        scene.run(preloaded, case)
        assert [path.name for path in scene.folder.iterdir()] == [Path(name).name]


@pytest.mark.long
def test_a_folder_may_be_reached_through_links(base: Path, tmp_path: Path, preloaded: Run) -> None:
    scene = Sandbox(base, tmp_path, "run")
    (scene.place / "data").mkdir()
    shutil.move(scene.folder, scene.place / "data" / "run")
    (scene.place / "link").symlink_to("data")
    ran = preloaded("report", "link/run", folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr
    (scene.place / "last").symlink_to("data/run")
    ran = preloaded("evaluate", "last", "-n", "1", folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr


CALL = re.compile(r"(?:\[pid +\d+\] )?(\w+)\((.*)\) += (-?\d+)(?:<(.*)>)?")
QUOTED = re.compile(r'(AT_FDCWD|\d+)?(?:<([^>]*)>)?(?:, )?"((?:[^"\\]|\\.)*)"')
CHANGES = "mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,rmdir,link,linkat,symlink,symlinkat,truncate"


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("strace"), reason="no strace")
@pytest.mark.parametrize("command", CASES)
def test_commands_write_relative_to_open_folders(command: str, base: Path, tmp_path: Path, preloaded: Run) -> None:
    """All system calls are checked, including those of other packages and programs."""
    case, log, base = CASES[command], tmp_path / "log", complete_base(command, base, tmp_path, preloaded)
    scene = Sandbox(base, tmp_path, case.folder)
    trace = ["strace", "-f", "-qq", "-y", "-s", "4096", "-e", f"trace=open,creat,openat,{CHANGES}", "-o", str(log)]
    environment = {**os.environ, **PLAIN}
    ran = subprocess.run(
        [*trace, str(UNJAM), *case.words], cwd=scene.place, env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    unsafe = [line for line in log.read_text().splitlines() if is_unsafe(line, scene.folder)]
    assert unsafe == []


def is_unsafe(line: str, folder: Path) -> bool:
    """Return whether a line of strace modifies a folder by a path that may contain links."""
    found = CALL.search(line)
    if found is None:
        return False
    call, arguments, code, opened = found.groups()
    if int(code) < 0 or (call in ("open", "openat") and not re.search("O_WRONLY|O_RDWR|O_CREAT", arguments)):
        return False
    for number, at, name in QUOTED.findall(arguments):
        path = Path(at or "/", name)
        if not (path.is_relative_to(folder) and path != folder) and not Path(opened or "/").is_relative_to(folder):
            continue
        if RANDOM.search(name) and "events.out.tfevents" in name:
            continue
        if number in ("", "AT_FDCWD") or "/" in name or (call == "openat" and "O_NOFOLLOW" not in arguments):
            return True
    return False
