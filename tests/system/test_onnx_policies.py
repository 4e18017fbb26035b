"""A third party's ONNX controller on the command line: driven, filtered, audited and certified."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.adapters.onnx_policies import follower, linear, write
from tests.system.conftest import Run
from tests.system.test_invalid_inputs import one_line
from unjam import make_scenario, run_episode
from unjam.adapters import onnx_driver

SMALL = ["--length", "60", "--vehicles", "5", "--set", "horizon=80"]


RASH = """
inputs = [{ quantity = "speed" }]
output = { offset = 1.0 }
"""


def driven(unjam: Run, *arguments: str) -> Any:
    done = unjam("drive", "ring", *SMALL, *arguments, "--episodes", "2", "--json", pictures=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["drivers"]


def test_a_graph_drives_in_workers_and_is_filtered_and_audited(unjam: Run, tmp_path: Path) -> None:
    write(tmp_path, follower())
    write(tmp_path, linear(1, [0.0]), RASH, "rash")
    calm, rash = driven(unjam, "-d", "policy.onnx", "-d", "rash.toml")
    assert (calm["driver"], rash["driver"]) == ("policy.onnx", "rash.toml")
    scenario = make_scenario("ring", {"length": (60, 60), "vehicles": 5, "horizon": 80})
    episode = run_episode(scenario, onnx_driver(tmp_path / "policy.onnx"), 0)
    assert calm["episodes"][0]["return"] == pytest.approx(float(np.sum(episode.reward)), abs=1e-9)
    assert rash["mean"]["filter_override_share"] > 0
    for driver in (calm, rash):
        assert driver["feasibility"] == "feasible"
        assert all(row["contacts"] == 0 and row["cav_max_braking"] < 6.0 for row in driver["episodes"])


@pytest.mark.slow
def test_an_exported_policy_is_filtered_verified_and_certified(unjam: Run, tmp_path: Path) -> None:
    write(tmp_path, follower())
    for arguments in (["export", "policy.toml", "--scenario", "ring", "--out", "it.unjam"], ["certify", "it.unjam"]):
        done = unjam(*arguments)
        assert done.returncode == 0, done.stderr
    assert ": 0 contacts, minimum gap " in " ".join(done.stdout.split())
    for name in ("policy.onnx", "policy.toml"):
        (tmp_path / name).unlink()
    verified = unjam("verify", "it.unjam", "--json")
    assert verified.returncode == 0, verified.stderr
    parts = {part["part"]: part for part in json.loads(verified.stdout)["parts"]}
    assert {parts[name]["status"] for name in ("driver", "weights", "sample", "certificate")} == {"checked"}
    assert parts["code"]["status"] == "absent"
    (row,) = driven(unjam, "-d", "it.unjam")
    assert row["feasibility"] == "feasible"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"nonsense", "unjam: driver policy.onnx: graph: cannot be read: "),
        (linear(3, [np.nan] * 3).SerializeToString(), "unjam: driver policy.onnx: returns nan; allowed: finite"),
    ],
    ids=["damaged", "not a number"],
)
def test_a_wrong_graph_is_refused_in_one_line(content: bytes, words: str, unjam: Run, tmp_path: Path) -> None:
    write(tmp_path, follower())
    (tmp_path / "policy.onnx").write_bytes(content)
    done = unjam("drive", "ring", *SMALL, "-d", "policy.onnx")
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line(done.stderr), done.stderr
    assert done.stderr.startswith(words)
