"""Files of Stable-Baselines3 on the command line."""

import json
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import PPO

from tests.adapters.test_stable_baselines3 import Space
from tests.system.conftest import Run

SMALL = ["--length", "60", "--vehicles", "5", "--set", "horizon=80"]


def save_model(folder: Path, inputs: int = 5) -> str:
    model: Any = PPO("MlpPolicy", Space(inputs), seed=0, device="cpu")
    model.save(folder / "ppo.zip")
    return "ppo.zip"


@pytest.mark.slow
def test_a_file_drives_beside_drivers_with_names(unjam: Run, tmp_path: Path) -> None:
    done = unjam("drive", "ring", *SMALL, "-d", save_model(tmp_path), "-d", "pi", "--episodes", "1", "--json")
    assert done.returncode == 0, done.stderr
    assert "ppo.zip" in json.dumps(json.loads(done.stdout))


def test_a_model_with_other_features_and_a_training_are_refused_in_one_line(unjam: Run, tmp_path: Path) -> None:
    training = unjam("train", "ring", "--expert", save_model(tmp_path), "--out", "run")
    assert training.returncode == 2
    assert training.stderr.startswith("unjam: driver: 'ppo.zip' is not allowed here: it drives in its own process only")
    assert "path.py:name" in training.stderr
    assert not (tmp_path / "run" / "config.toml").exists()
    driven = unjam("drive", "ring", *SMALL, "-d", save_model(tmp_path, 8), "--episodes", "1")
    assert driven.returncode == 2
    assert driven.stderr.startswith("unjam: inputs: 5 numbers are not allowed; allowed: 8, the inputs of ppo.zip; ")
