"""Modules in the working folder are never imported, and settings there not read."""

import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pandas as pd
import pytest

from tests.system.conftest import UNJAM, Run
from tests.training.test_run import small_config
from tests.worlds.sumo.user_networks import straight
from unjam.training.config import to_toml

FOUND_AT_START = {"sitecustomize", "usercustomize", "unjam", "planted", "no_such_module_anywhere"}
DRIVER = """
import numpy as np
import json, queue, random, safetensors
from gains import GAIN
def gentle(state):
    import later
    return GAIN * later.ONE * np.subtract(state.leader_speed, state.speed)
"""
SMALL = {"scenario_options__horizon": 50, "trpo__steps_per_iteration": 100, "steps": 100}
CARS = "".join(f'<vehicle id="{n}" type="car" route="along" depart="{2 * n}"/>' for n in range(6))


@pytest.fixture(scope="module")
def planted_module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Make a folder with a module for every importable name, and files that name others."""
    folder = tmp_path_factory.mktemp("planted")
    canary = folder / "canary"
    code = f"open({str(canary)!r}, 'a').write(__name__ + '\\n')\n"
    names = {name for name in packages_distributions() if name.isidentifier()}
    for number, name in enumerate(sorted(names | set(sys.stdlib_module_names) | FOUND_AT_START)):
        place = folder / name / "__init__.py" if number % 2 else folder / f"{name}.py"
        place.parent.mkdir(exist_ok=True)
        place.write_text(code)
    (folder / "planted.pth").write_text(f"import os; {code}")
    (folder / "pyvenv.cfg").write_text(f"home = {folder}\ninclude-system-site-packages = true\n")
    (folder / "matplotlibrc").write_text("backend: module://planted\ntext.usetex: True\n")
    (folder / "planted-1.0.dist-info").mkdir()
    (folder / "planted-1.0.dist-info" / "METADATA").write_text("Name: planted\nVersion: 1.0\n")
    groups = "".join(f"[{group}]\nit = planted\n" for group in ("gymnasium.envs", "matplotlib.backend"))
    (folder / "planted-1.0.dist-info" / "entry_points.txt").write_text(groups)
    straight(folder, CARS, length=100.0, end=20.0)
    (folder / "mine.py").write_text(DRIVER)
    (folder / "gains.py").write_text("GAIN = 0.5\n")
    (folder / "later.py").write_text("ONE = 1.0\n")
    (folder / "small.toml").write_text(to_toml(small_config(**SMALL)))
    steps = range(60)
    columns = {"pair": 1, "follower": 1, "time": [0.5 * step for step in steps], "gap": 10.0}
    speeds = {"speed": [8.0 + 0.01 * step for step in steps], "leader_speed": [8.0] * len(steps)}
    pd.DataFrame({**columns, **speeds}).to_csv(folder / "data.csv", index=False)
    before = {**os.environ}
    os.environ["UNJAM_STATE"] = str(tmp_path_factory.mktemp("state"))
    yield folder
    os.environ.clear()
    os.environ.update(before)


def check_nothing_ran(folder: Path) -> None:
    canary = folder / "canary"
    ran = canary.read_text().split() if canary.exists() else []
    canary.unlink(missing_ok=True)
    assert ran == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("doctor",),
        ("drive", "straight.sumocfg", "--penetration-rate", "0.5", "-n", "1", "-d", "acc", "--no-report"),
        ("train", "--config", "small.toml", "--expert", "mine.py:gentle", "--out", "own"),
    ],
    ids=lambda words: words[0],
)
def test_command_and_children_import_nothing_from_the_working_folder(
    words: tuple[str, ...], planted_module: Path
) -> None:
    done = subprocess.run([UNJAM, *words], cwd=planted_module, capture_output=True, text=True, check=False)
    assert done.returncode in ((0, 3) if words == ("doctor",) else (0,)), done.stderr
    check_nothing_ran(planted_module)


COMMANDS = """
scenarios ring
scenarios straight.sumocfg --picture road.png
drivers
drive ring --set horizon=20 --set warmup=0 -n 2 --workers 2 -d mine.py:gentle --out driven
report driven --out page.html
runs --folder .
watch ring --set horizon=20 --set warmup=0 -d pi --video video.gif
reproduce theory --dry-run
"""
SLOW_COMMANDS = """
assess straight.sumocfg -d acc --penetration-rates 0.5 -n 34 --out assessed
train --config small.toml --out run
train --resume run --steps 200
evaluate run -n 1
model run
export run --out it.unjam --onnx
verify it.unjam
certify it.unjam
keys maker
sign it.unjam --key maker.key
watch ring --set horizon=20 --set warmup=0 -d pi --video video.mp4
search ring --config small.toml --vary trpo.target_kl=0.1,0.2 --trials 1 --out search
tune ring --set horizon=20 --set warmup=0 --expert pi --steps 8000 --out tuned
fit-drivers data.csv --set calibration.generations=2
"""


@pytest.mark.long
@pytest.mark.parametrize("commands", [COMMANDS, pytest.param(SLOW_COMMANDS, marks=pytest.mark.slow)], ids=["", "slow"])
def test_commands_import_nothing_from_the_working_folder(commands: str, planted_module: Path, preloaded: Run) -> None:
    for words in map(str.split, commands.strip().splitlines()):
        done = preloaded(*words, folder=planted_module, pictures=True)
        assert "Traceback" not in done.stderr, (words, done.stderr)
        assert done.returncode in ((0, 1) if words[0] == "certify" else (0,)), (words, done.stderr)
        check_nothing_ran(planted_module)


SCRIPT = """
import sys
here = sys.path.pop(0)  # as the last entry, children inherit it, but this program imports nothing from it
import numpy
import unjam, unjam.kernels
from tests.training.test_run import small_config
sys.path.append({here})
unjam.kernels._unpinned_reason = "numpy was imported before unjam"  # so a training runs in a child
if __name__ == "__main__":
    unjam.drive("ring", "mine.py:gentle", episodes=2, out="api-{name}", workers=2)
    road = unjam.make_scenario("straight.sumocfg", {{"penetration_rate": 0.5, "horizon": 20}})
    unjam.run_episode(road, lambda state: 0.0 * state.speed, (0,))
    unjam.train(small_config(scenario_options__horizon=50, trpo__steps_per_iteration=100, steps=100), "trained-{name}")
    unjam.write_report(["api-{name}"], "api-{name}.html")
"""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "here"), [("script", "here"), ("notebook", "''")])
def test_children_of_a_program_import_nothing_from_its_folder(name: str, here: str, planted_module: Path) -> None:
    (planted_module / "program.py").write_text(SCRIPT.format(name=name, here=here))
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": root}
    done = subprocess.run(
        [sys.executable, "program.py"], cwd=planted_module, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    check_nothing_ran(planted_module)


def test_python_m_unjam_imports_nothing_from_the_working_folder(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    for name in ("gymnasium", "numpy", "typer", "platform", "typing"):
        (tmp_path / f"{name}.py").write_text(f"open({str(canary)!r}, 'w').close()\n")
    command = [sys.executable, "-m", "unjam", "--version"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout[:6]) == (0, "unjam "), done.stderr
    assert not canary.exists()


CHILD = "from unjam.worlds.messages import open_answer_pipe; open_answer_pipe(); import matplotlib"


@pytest.mark.parametrize(
    "command", [[UNJAM, "model", "missing"], [sys.executable, "-c", CHILD]], ids=["unjam", "child"]
)
def test_settings_of_matplotlib_in_the_working_folder_are_not_read(command: list[str], tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"\xff")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
