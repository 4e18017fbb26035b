"""Commands that do not train run without torch and related packages."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.following.synthetic_pairs import write_table
from tests.system.conftest import PLAIN
from tests.worlds.sumo.user_networks import straight
from unjam.errors import TRAIN_PACKAGES

# Python runs a file of this name at its start, also in workers.
SITE = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {TRAIN}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
"""


@pytest.fixture
def core(tmp_path: Path) -> dict[str, str]:
    """Return the environment of processes without torch."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE.replace("{TRAIN}", repr(TRAIN_PACKAGES)))
    paths = [str(tmp_path / "site"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, **PLAIN, "PYTHONPATH": os.pathsep.join(paths)}


def unjam(core: dict[str, str], folder: Path, command: str) -> "subprocess.CompletedProcess[str]":
    words = [sys.executable, "-m", "unjam", *command.split()]
    return subprocess.run(words, cwd=folder, env=core, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        "drive ring -d human -d unjam:ring-best -n 1 --set horizon=60",
        "assess straight.sumocfg --penetration-rates 0.5 -d acc -n 34 --set horizon=100",
        "fit-drivers trajectories.csv --out people.json",
        "doctor",
    ],
)
def test_commands_without_training_run_without_torch(core: dict[str, str], tmp_path: Path, command: str) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>')
    write_table(tmp_path / "trajectories.csv")
    ran = unjam(core, tmp_path, command)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.long
@pytest.mark.parametrize("command", ["train ring --preset demo", "reproduce table-2 --dry-run"])
def test_training_without_torch_names_the_package_to_install(
    core: dict[str, str], tmp_path: Path, command: str
) -> None:
    ran = unjam(core, tmp_path, command)
    assert ran.returncode == 3, ran.stderr
    assert ran.stderr.splitlines()[-1].startswith("unjam: ")
    assert "pip install 'unjam[train]'" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_training_in_python_without_torch_names_the_package_to_install(core: dict[str, str], tmp_path: Path) -> None:
    words = [sys.executable, "-c", "import unjam; unjam.train"]
    ran = subprocess.run(words, cwd=tmp_path, env=core, capture_output=True, text=True, check=False)
    last = ran.stderr.splitlines()[-1]
    assert last.startswith("unjam.errors.MissingPartError")
    assert "pip install 'unjam[train]'" in last
