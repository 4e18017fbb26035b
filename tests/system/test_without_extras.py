"""`drive` and `assess` run without optional packages; a command that needs one names the extra that installs it."""

import os
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path

import pytest

from tests.recordings.synthetic_trajectories import write_table
from tests.system.conftest import PLAIN, ROOT
from tests.worlds.sumo.user_networks import straight
from unjam.adapters.stable_baselines3_file import DATA_PART, POLICY_PART
from unjam.controller import packaged_file
from unjam.errors import EXTRAS

# Python runs a file of this name at its start, also in workers.
SITE = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {HIDDEN}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
"""
RunWithout = Callable[[Collection[str], list[str]], "subprocess.CompletedProcess[str]"]


@pytest.fixture
def run_without(tmp_path: Path) -> RunWithout:
    """Return a function that runs Python with some packages hidden."""

    def run(packages: Collection[str], words: list[str]) -> "subprocess.CompletedProcess[str]":
        (tmp_path / "site").mkdir()
        (tmp_path / "site" / "sitecustomize.py").write_text(SITE.replace("{HIDDEN}", repr(set(packages))))
        paths = [str(tmp_path / "site"), *filter(None, [os.environ.get("PYTHONPATH")])]
        core = {**os.environ, **PLAIN, "PYTHONPATH": os.pathsep.join(paths)}
        command = [sys.executable, *words]
        return subprocess.run(command, cwd=tmp_path, env=core, capture_output=True, text=True, timeout=300, check=False)

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "drive ring -d human -d unjam:ring-best -n 1 --set horizon=60",
        "assess straight.sumocfg --penetration-rates 0.5 -d acc -n 34 --set horizon=100",
        "fit-drivers trajectories.csv --out people.json",
        "watch ring --driver pi --video wave.gif --set horizon=20",
        "doctor",
    ],
)
def test_commands_of_the_core_run_without_extras(run_without: RunWithout, tmp_path: Path, command: str) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>')
    write_table(tmp_path / "trajectories.csv")
    ran = run_without(EXTRAS, ["-m", "unjam", *command.split()])
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "command"),
    [
        ("torch", "train ring --preset demo"),
        ("torch", "reproduce table-2 --dry-run"),
        ("torch", "export pi --out pi.unjam --onnx"),
        ("torch", "drive ring -d ppo.zip"),
        ("stable_baselines3", "train ring --preset demo"),
        ("tensorboard", "train ring --preset demo --tensorboard"),
        ("onnxscript", "export pi --out pi.unjam --onnx"),
        ("optuna", "search ring --vary trpo.target_kl=0.003..0.1:log"),
        ("optuna", "tune ring --expert pi"),
        ("optuna", "calibrate straight.sumocfg --detectors detectors.csv"),
        ("imageio_ffmpeg", "watch ring --driver pi --video wave.mp4"),
        ("cryptography", "keys maker"),
        ("cryptography", "sign ring.unjam --key maker.key"),
        ("cryptography", "verify ring.unjam --signer maker.pub"),
    ],
)
def test_command_without_its_package_names_the_extra_in_one_line(
    run_without: RunWithout, tmp_path: Path, package: str, command: str
) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>')
    (tmp_path / "detectors.csv").write_text("edge,position,begin,end,flow_veh_per_h,speed\nroad,100,0,60,900,15\n")
    (tmp_path / "ring.unjam").write_bytes(packaged_file("ring-best").read_bytes())
    with zipfile.ZipFile(tmp_path / "ppo.zip", "w") as model:
        model.writestr(DATA_PART, "{}")
        model.writestr(POLICY_PART, "")
    before = set(tmp_path.rglob("*"))
    ran = run_without([package], ["-m", "unjam", *command.split()])
    assert ran.returncode == 3, ran.stderr
    *plan, error = ran.stderr.splitlines()
    assert error == f"unjam: {package} is not installed; install it: pip install 'unjam[{EXTRAS[package]}]'"
    assert all(line.startswith("training ") for line in plan)
    assert {path for path in tmp_path.rglob("*") if path.is_file() and "site" not in path.parts} <= before


@pytest.mark.parametrize(("package", "name"), [("torch", "train"), ("pettingzoo", "parallel_env")])
def test_python_function_without_its_package_names_the_extra(run_without: RunWithout, package: str, name: str) -> None:
    ran = run_without([package], ["-c", f"import unjam; unjam.{name}"])
    last = ran.stderr.splitlines()[-1]
    assert last.startswith("unjam.errors.MissingPartError")
    assert f"pip install 'unjam[{EXTRAS[package]}]'" in last


def test_extras_of_messages_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = {
        requirement.partition(">")[0].replace("-", "_"): extra
        for extra, requirements in project["optional-dependencies"].items()
        for requirement in requirements
        if extra not in ("all", "dev", "docs")
    }
    assert installed == EXTRAS
    assert project["optional-dependencies"]["all"] == [f"unjam[{','.join(sorted(set(EXTRAS.values())))}]"]
    assert not [name for name in EXTRAS if any(dependency.startswith(name) for dependency in project["dependencies"])]
