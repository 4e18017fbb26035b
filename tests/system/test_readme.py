"""All commands and snippets of the README run."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.adapters.onnx_policies import follower, write
from tests.recordings.synthetic_trajectories import write_table
from tests.system.conftest import ROOT, Run
from tests.worlds.sumo.user_networks import straight

README = (ROOT / "README.md").read_text()
TINY_TRAINING = shlex.split(
    "--steps 320 --length 60 --vehicles 5 --set scenario_options.horizon=80 --set trpo.steps_per_iteration=160"
    " --set evaluation.episodes=2 --set evaluation.validation_episodes=1 --set evaluation.validation_interval=2"
)
SHORTENING = {
    "drive": ["-n", "1", "--set", "horizon=200"],
    "train": TINY_TRAINING,
    "assess": shlex.split("--penetration-rates 0.5 -d acc -n 34 --set horizon=100"),
    "calibrate": shlex.split("--trials 2 --seeds 1"),
    "reproduce": ["--dry-run"],
    "search": shlex.split(
        "--trials 1 --steps 300 --set scenario_options.horizon=60 --set trpo.steps_per_iteration=150"
    ),
    "tune": shlex.split("--steps 8000 --set horizon=20"),
    "evaluate": ["--episodes", "1"],
    "watch": ["--set", "horizon=60"],
}
"""options that are added to a command so that it takes seconds"""

SHORT_WARMUP = ["--set", "warmup=600"]
"""a wave takes ten minutes of human-only traffic to form"""


def commands(text: str) -> list[list[str]]:
    """Return the words of all commands in the consoles of a text, without comments."""
    consoles = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    lines = [line for console in consoles for line in console.splitlines() if line.startswith("$ ")]
    single = [command for line in lines for command in line.removeprefix("$ ").split(" && ")]
    return [shlex.split(command, comments=True) for command in single]


COMMANDS = commands(README)


@pytest.fixture
def files(tmp_path: Path) -> None:
    """Write the files of the user."""
    page = (ROOT / "docs/own-driver.md").read_text()
    (own,) = re.findall(r"```python\n(# my_driver.py\n.*?)```", page, re.DOTALL)
    (tmp_path / "my_driver.py").write_text(own)
    write(tmp_path, follower())
    vehicles = '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>'
    straight(tmp_path, vehicles).rename(tmp_path / "my.sumocfg")
    write_table(tmp_path / "trajectories.csv")
    measured = ["edge,position,begin,end,flow_veh_per_h,speed", "road,100,0,60,900,15"]
    (tmp_path / "detectors.csv").write_text("\n".join(measured))


@pytest.mark.slow
def test_all_unjam_commands_of_the_readme_run_in_order(
    unjam: Run, files: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unjam_commands = [words for words in COMMANDS if words[0] == "unjam"]
    assert len(unjam_commands) > 12
    for _, command, *words in unjam_commands:
        short = SHORT_WARMUP if command in ("drive", "watch") and "ring-jammed" in words else []
        ran = unjam(command, *words, *SHORTENING.get(command, []), *short, pictures=False)
        assert ran.returncode == 0, f"unjam {command} {shlex.join(words)}: {ran.stderr[-2000:]}"
    assert (tmp_path / "wave.mp4").stat().st_size > 1000
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "docs/controller.md").read_text(), re.DOTALL)
    graph = next(snippet for snippet in snippets if "onnxruntime" in snippet)
    answers: dict[str, Any] = {}
    exec(graph, answers)  # reads the exported ring.unjam
    assert np.isfinite(answers["acceleration"]).all()
    exec(next(snippet for snippet in snippets if "TRPO.load" in snippet), answers)  # reads the exported ring.zip
    answers["environment"].close()
    assert answers["environment"].action_space.contains(answers["action"])


def test_targets_and_packages_of_the_readme_exist() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    others = [words for words in COMMANDS if words[0] != "unjam"]
    assert others.pop(0)[:2] == ["git", "clone"]
    assert others.pop(0) == ["cd", "unjam"]
    assert [words[0] for words in others].count("make") == 2
    for program, target, *arguments in others:
        if program == "make":
            assert target in targets
        else:
            assert (program, target) == ("pip", "install")
            named = re.fullmatch(r"\.(?:\[(\w+)\])?", arguments[0])
            assert named is not None
            assert named[1] is None or named[1] in extras


def test_the_readme_has_at_most_600_words_with_its_commands() -> None:
    assert len(README.split()) <= 600


@pytest.mark.long
def test_python_snippets_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(snippets) == 1
    for snippet in snippets:
        exec(snippet.replace("episodes=5", "episodes=1, scenario_options={'horizon': 40}"), {})
    assert list((tmp_path / "runs" / "first").glob("report.html"))
