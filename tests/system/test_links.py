"""Links that a stranger has planted in a folder: no verb writes through them, whatever it writes."""

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
from tests.paper.test_field import table
from tests.system.conftest import PLAIN, UNJAM, Run
from tests.system.test_calibrate import CALIBRATE, PEOPLE, ROWS
from tests.system.test_verbs import SMALL, TINY_RUN
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
TUNE += ["--vary", "window=10,30", "--steps", "3000", "--out", "tuned"]
ASSESS = ["assess", "straight.sumocfg", "--shares", "0.5", "-d", "acc", "--set", "horizon=40", "-n", "36"]
FIT = ["fit-drivers", "data.parquet", "--set", "calibration.generations=2", "--out", "files/people.json"]
STUDY = ["reproduce", "table-1", "--seeds", "1", "--workers", "1", "--out", "studies"]
DRIVE = ["drive", "ring", "-d", "pi", "-n", "1", *SMALL, "--out", "new"]
FILM = ["watch", "ring", *SMALL, "-d", "pi", "--video"]
TWO_ROADS = '[[tasks]]\nroad = {length = [70, 70]}\n[[tasks]]\nname = "short"\n[virtual]\nvirtual_ratio = 0\n'


class Case(NamedTuple):
    """A command line, the folder that it writes to, and whether it reads only."""

    words: list[str]
    folder: str
    reads: bool = False


CASES = {
    "train": Case([*TINY_RUN, "--steps", "160", "--set", "model.model_ratio=0", "--out", "new"], "new"),
    "train on": Case(["train", "--resume", "run", "--steps", "320", "--tensorboard"], "run"),
    "train on, several roads": Case(["train", "--resume", "roads", "--steps", "640"], "roads"),
    "evaluate": Case(["evaluate", "run", "-n", "1", "--workers", "1"], "run"),
    "model": Case(["model", "run"], "run"),
    "report": Case(["report", "run"], "run"),
    "search": Case([*SEARCH, "--trials", "2"], "searched"),
    "tune": Case(TUNE, "tuned"),
    "calibrate": Case([*map(str, CALIBRATE), "--out", "calibrated"], "calibrated"),
    "drive": Case(DRIVE, "new"),
    "assess": Case([*ASSESS, "--out", "new"], "new"),
    "export": Case(["export", "run", "--to", "files/ring.unjam"], "files"),
    "certify": Case(["certify", "files/it.unjam"], "files"),
    "keys": Case(["keys", "files/another"], "files"),
    "sign": Case(["sign", "files/it.unjam", "--key", "files/maker.key"], "files"),
    "watch": Case([*FILM, "files/film.gif"], "files"),
    "watch, .mp4": Case([*FILM, "files/film.mp4"], "files"),
    "scenarios": Case(["scenarios", "ring", "--picture", "files/road.png"], "files"),
    "fit-drivers": Case(FIT, "files"),
    "runs": Case(["runs", "--under", "."], "run", reads=True),
    "verify": Case(["verify", "run"], "run", reads=True),
    "runs remove": Case(["runs", "remove", "run", "--under", ".", "--yes"], "run"),
}
NEVER_ENDS = {"reproduce": (Case(STUDY, "studies"), ("plans", "runs", "logs", "drives", "table-1"))}
"""what would take hours; what it writes, where links are refused before it begins"""
SYMBOLIC = [kind for kind in KINDS if kind != "hard link"]
RANDOM = re.compile(r"\.[0-9a-f]{16}(\.part)?$")
"""how names end that nobody can guess"""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, warm: Run) -> Path:
    """A folder with one of everything that verbs write or go on with."""
    place = tmp_path_factory.mktemp("base")
    (place / "files").mkdir()
    (place / "studies").mkdir()
    straight(place, PEOPLE, length=100.0)
    (place / "detectors.csv").write_text("\n".join(ROWS).replace("100", "50"))
    table(place / "data.parquet", [{}, {}])
    (place / "roads.toml").write_text(TWO_ROADS)
    for words in (
        [*TINY_RUN, "--steps", "160", "--out", "run", "--tensorboard"],
        [*TINY_RUN, "--config", "roads.toml", "--steps", "160", "--out", "roads"],
        [*SEARCH, "--trials", "1"],
        TUNE,
        CASES["calibrate"].words,
        ["export", "run", "--to", "files/it.unjam"],
        ["keys", "files/maker"],
    ):
        made = warm(*words, folder=place, pictures=False)
        assert made.returncode == 0, made.stderr
    return place


class Scene:
    """A copy of the base, with links to canaries elsewhere."""

    def __init__(self, base: Path, tmp_path: Path, folder: str) -> None:
        self.place, self.outside = tmp_path / "place", tmp_path / "outside"
        shutil.copytree(base, self.place)
        self.outside.mkdir()
        self.folder = self.place / folder

    def run(self, warm: Run, case: Case) -> None:
        """Run a verb: it ends well, or with one line, and nothing has changed outside."""
        before = state_of(self.outside)
        ran = warm(*case.words, folder=self.place, pictures=False)
        assert "Traceback" not in ran.stderr, ran.stderr
        assert ran.returncode in (0, 2), ran.stderr
        if ran.returncode == 2:
            assert ran.stderr.splitlines()[-1].startswith("unjam: "), ran.stderr
        assert state_of(self.outside) == before, ran.stderr
        assert {path.name for path in self.place.parent.iterdir()} == {"place", "outside"}


def written_by(case: Case, base: Path, tmp_path: Path, warm: Run) -> dict[str, bool]:
    """The names that a verb writes below its folder, and which are folders, found by running it."""
    scene = Scene(base, tmp_path, case.folder)
    before = state_of(scene.folder) if scene.folder.is_dir() else {}
    ran = warm(*case.words, folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr
    after = state_of(scene.folder) if scene.folder.is_dir() else {}
    changed = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    return {
        name: stat.S_ISDIR((after.get(name) or before[name])[0])
        for name in sorted(changed)
        if name != "." and not RANDOM.search(name)
    }


def plantings(written: dict[str, bool]) -> list[list[tuple[str, str]]]:
    """What to plant together, name and kind: those in subfolders at once, as no verb sees them at first."""
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
@pytest.mark.parametrize("verb", CASES)
def test_no_verb_writes_through_a_link(verb: str, base: Path, tmp_path: Path, warm: Run) -> None:
    case = CASES[verb]
    written = written_by(case, base, tmp_path / "first", warm)
    assert not case.reads or not written
    for number, planted in enumerate(filter(None, plantings(written))):
        scene = Scene(base, tmp_path / str(number), case.folder)
        for name, kind in planted:
            plant(scene.folder / name, kind, scene.outside)
        scene.run(warm, case)
        shutil.rmtree(scene.place.parent)


@pytest.mark.long
@pytest.mark.parametrize("verb", NEVER_ENDS)
def test_what_takes_hours_refuses_links_before_it_begins(verb: str, base: Path, tmp_path: Path, warm: Run) -> None:
    case, names = NEVER_ENDS[verb]
    for number, (name, kind) in enumerate(zip(with_temporary_names([*names]), cycle(SYMBOLIC), strict=False)):
        scene = Scene(base, tmp_path / str(number), case.folder)
        plant(scene.folder / name, kind, scene.outside)
        scene.run(warm, case)
        assert [path.name for path in scene.folder.iterdir()] == [Path(name).name]


@pytest.mark.long
def test_a_folder_may_be_reached_through_links(base: Path, tmp_path: Path, warm: Run) -> None:
    scene = Scene(base, tmp_path, "run")
    (scene.place / "data").mkdir()
    shutil.move(scene.folder, scene.place / "data" / "run")
    (scene.place / "link").symlink_to("data")
    ran = warm("report", "link/run", folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr
    (scene.place / "last").symlink_to("data/run")
    ran = warm("evaluate", "last", "-n", "1", folder=scene.place, pictures=False)
    assert ran.returncode == 0, ran.stderr


CALL = re.compile(r"(?:\[pid +\d+\] )?(\w+)\((.*)\) += (-?\d+)(?:<(.*)>)?")
QUOTED = re.compile(r'(AT_FDCWD|\d+)?(?:<([^>]*)>)?(?:, )?"((?:[^"\\]|\\.)*)"')
CHANGES = "mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,rmdir,link,linkat,symlink,symlinkat,truncate"


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("strace"), reason="no strace")
@pytest.mark.parametrize("verb", CASES)
def test_whatever_a_verb_writes_it_names_from_an_open_folder(verb: str, base: Path, tmp_path: Path) -> None:
    """Also what other packages and programs write: each of the system's calls is looked at."""
    case, scene, log = CASES[verb], Scene(base, tmp_path, CASES[verb].folder), tmp_path / "log"
    trace = ["strace", "-f", "-qq", "-y", "-s", "4096", "-e", f"trace=open,creat,openat,{CHANGES}", "-o", str(log)]
    environment = {**os.environ, **PLAIN}
    ran = subprocess.run(
        [*trace, str(UNJAM), *case.words], cwd=scene.place, env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    unsafe = [line for line in log.read_text().splitlines() if is_unsafe(line, scene.folder)]
    assert unsafe == []


def is_unsafe(line: str, folder: Path) -> bool:
    """Whether a line of strace changes something inside a folder by a path that may lead through links."""
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
