"""Does everything run that README tells a newcomer to type?"""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.following.made_up import write_table
from tests.system.conftest import ROOT, Run
from tests.worlds.sumo.user_networks import straight

README = (ROOT / "README.md").read_text()
TINY_TRAINING = shlex.split(
    "--steps 320 --length 60 --vehicles 5 --set road.horizon=80 --set trpo.batch_steps=160"
    " --set evaluation.episodes=2 --set evaluation.validation_episodes=1 --set evaluation.every=2"
)
LESS = {
    "drive": ["-n", "1", "--set", "horizon=200"],
    "train": TINY_TRAINING,
    "assess": shlex.split("--shares 0.5 -d acc -n 34 --set horizon=100"),
    "calibrate": shlex.split("--trials 2 --seeds 1"),
    "reproduce": ["--dry-run"],
    "search": shlex.split(
        "--trials 1 --steps 300 --set scenario_options.horizon=60 --set trpo.steps_per_iteration=150"
    ),
    "tune": shlex.split("--steps 8000 --set horizon=20"),
    "evaluate": ["--episodes", "1"],
    "watch": ["--set", "horizon=60"],
}
"""what is added to a command, for it to take seconds: options that its --help names, nothing else"""

WITHOUT_WAVE = ["--set", "warmup=600"]
"""for a wave to be there takes ten minutes of people alone"""


def commands(text: str) -> list[list[str]]:
    """The words of every command in the text's consoles, without what is said about it."""
    consoles = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    lines = [line for console in consoles for line in console.splitlines() if line.startswith("$ ")]
    alone = [command for line in lines for command in line.removeprefix("$ ").split(" && ")]
    return [shlex.split(command, comments=True) for command in alone]


COMMANDS = commands(README)


@pytest.fixture
def files(tmp_path: Path) -> None:
    """The files that are a user's own."""
    page = (ROOT / "docs/own-driver.md").read_text()
    (own,) = re.findall(r"```python\n(# my_driver.py\n.*?)```", page, re.DOTALL)
    (tmp_path / "my_driver.py").write_text(own)
    vehicles = '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>'
    straight(tmp_path, vehicles).rename(tmp_path / "my.sumocfg")
    write_table(tmp_path / "trajectories.csv")
    measured = ["edge,position,begin,end,flow_veh_per_h,speed", "road,100,0,60,900,15"]
    (tmp_path / "detectors.csv").write_text("\n".join(measured))


@pytest.mark.long
def test_every_unjam_command_of_the_readme_runs_in_its_order(
    unjam: Run, files: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verbs = [words for words in COMMANDS if words[0] == "unjam"]
    assert len(verbs) > 12
    for _, verb, *words in verbs:
        short = WITHOUT_WAVE if verb in ("drive", "watch") and "ring-jammed" in words else []
        ran = unjam(verb, *words, *LESS.get(verb, []), *short, pictures=False)
        assert ran.returncode == 0, f"unjam {verb} {shlex.join(words)}: {ran.stderr[-2000:]}"
    assert (tmp_path / "wave.mp4").stat().st_size > 1000
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "docs/controller.md").read_text(), re.DOTALL)
    graph = next(snippet for snippet in snippets if "onnxruntime" in snippet)
    answers: dict[str, Any] = {}
    exec(graph, answers)  # of the ring.unjam that was exported
    assert np.isfinite(answers["acceleration"]).all()


def test_what_the_readme_makes_and_installs_is_there() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    others = [words for words in COMMANDS if words[0] != "unjam"]
    assert [words[0] for words in others].count("make") == 2
    for program, what, *more in others:
        if program == "make":
            assert what in targets
        else:
            assert (program, what) == ("pip", "install")
            named = re.fullmatch(r"\.(?:\[(\w+)\])?", more[0])
            assert named is not None
            assert named[1] is None or named[1] in extras


@pytest.mark.long
def test_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(snippets) == 2
    for snippet in snippets:
        exec(snippet.replace("episodes=5", "episodes=1, road={'horizon': 40}"), {})
    assert list((tmp_path / "runs" / "first").glob("report.html"))
