"""Tuning keeps to settings that do not amplify the oscillations of their leaders."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optuna.distributions import FloatDistribution

from tests.pictures import empty_pictures
from tests.training.test_run import small_config
from unjam.controller import load_controller, make_driver, string_stability
from unjam.drivers.registry import driver_from_name
from unjam.drivers.safety import Actuator
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, UnjamError
from unjam.reports.results import read_progress
from unjam.scenarios import Ring
from unjam.scenarios.motorway import ON_RAMP
from unjam.training.search_space import SearchSpace
from unjam.training.string_limit import MAX_STRING_GAIN, OperatingPoint, find_operating_points
from unjam.training.train import train
from unjam.training.trial_log import TRIALS_FILE
from unjam.training.tune import TUNING_EPISODES, TUNING_FINALISTS, tune
from unjam.worlds.worker_pool import WorkerPool

SMALL = Ring(horizon=30, vehicles=8, length=(80, 90), warmup=300)
STEPS = ((TUNING_FINALISTS + 1) * 2 + 2) * TUNING_EPISODES * 30
TIME_GAPS: SearchSpace = {"time_gap": FloatDistribution(0.1, 4.0), "gap_gain": FloatDistribution(0.02, 0.2)}


@pytest.fixture(autouse=True)
def few_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(string_stability, "OSCILLATION_FREQUENCIES", np.geomspace(0.005, 0.2, 5))
    monkeypatch.setattr(string_stability, "SETTLING_SECONDS", 40.0)


@pytest.mark.slow
def test_settings_that_amplify_are_never_tried_and_a_resumed_tuning_knows_them(tmp_path: Path) -> None:
    def run() -> tuple[list[str], float]:
        with WorkerPool(1) as workers:
            found = tune({"ring": SMALL}, "smooth-acc", TIME_GAPS, STEPS, tmp_path, workers, max_string_gain=1.02)
        return [trial.driver for trial in found.trials], found.best.score or 0.0

    tried = run()
    log = (tmp_path / TRIALS_FILE).read_text()
    measured = {json.loads(line)["driver"] for line in log.splitlines() if "largest string gain" in line}
    with WorkerPool(1) as workers:
        (point,) = find_operating_points({"ring": SMALL}, workers).values()
    assert all(point.string_gain(driver_from_name(driver, 0.1)) <= 1.02 for driver in tried[0])
    refused = measured - {*tried[0], "smooth-acc"}
    assert refused
    assert all(point.string_gain(driver_from_name(driver, 0.1)) > 1.02 for driver in refused)
    assert run() == tried
    assert (tmp_path / TRIALS_FILE).read_text() == log


def test_the_gain_of_a_file_is_that_with_the_filter_and_the_actuator_of_the_road() -> None:
    """The file has a filter for a car that obeys at once."""
    controller = make_driver("unjam:ring-best-ideal", 0.1)
    assert isinstance(controller, FilteredDriver)
    gains = []
    for lag in (0.0, 1.0):
        point = OperatingPoint(replace(SMALL, actuator=Actuator(lag=lag)), 85.0, (4.0,))
        gains.append(point.string_gain(controller))
        assert gains[-1] == point.string_gain(controller.driver)
    assert gains[0] != gains[1]


def test_an_expert_that_always_amplifies_ends_the_tuning_with_its_smallest_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.training.tune.MAX_REFUSED_SETTINGS", 3)
    space: SearchSpace = {"catch_up_speed": FloatDistribution(1.0, 3.0)}
    message = r"3 settings of pi in a row have a string gain of at least 1\.\d+; allowed: at most 1.02, or another"
    lines: list[str] = []
    options: dict[str, Any] = {"max_string_gain": MAX_STRING_GAIN, "on_message": lines.append}
    with WorkerPool(1) as workers, pytest.raises(UnjamError, match=message):
        tune({"ring": SMALL}, "pi", space, STEPS, tmp_path, workers, **options)
    assert len(lines) == 3
    assert all("not tried: a string gain of 1." in line for line in lines)


def test_a_limit_on_an_open_road_is_refused(tmp_path: Path) -> None:
    message = "max_string_gain: 1.02 is not allowed; allowed: 0 on on-ramp"
    with WorkerPool(1) as workers, pytest.raises(InputError, match=message):
        tune({"on-ramp": ON_RAMP}, "jam-ahead", {}, 10**9, tmp_path, workers, max_string_gain=1.02)


def test_without_a_limit_no_gain_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("unjam.training.tune.find_operating_points")
    with WorkerPool(1) as workers:
        found = tune({"ring": SMALL}, "pi", {}, STEPS, tmp_path, workers, max_string_gain=0.0)
    assert "string_gain" not in json.loads((tmp_path / "tuned.json").read_text())
    assert found.best.score is not None


@pytest.mark.long
def test_a_trained_controller_keeps_the_limit(tmp_path: Path) -> None:
    changes = {"expert": "smooth-acc", "policy__max_string_gain": 1.02, "policy__exploration_std": 0.3}
    config = small_config(**changes, model__model_ratio=0.0, trpo__target_kl=1.0)
    with empty_pictures():
        train(config, tmp_path / "run")
    rows = read_progress(tmp_path / "run")
    assert all(0.0 <= row["learner"]["kept_update"] <= 1.0 for row in rows)
    with WorkerPool(1) as workers:
        (point,) = find_operating_points({"": config.make_scenario()}, workers).values()
    assert point.string_gain(load_controller(tmp_path / "run")) <= 1.02


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({"scenario_options__warmup": 300}, "at least 1.*, the gain of the first policy, or another expert"),
        ({"scenario": "merge", "scenario_options": {}}, "none on merge: it is no closed road"),
    ],
)
def test_a_training_that_cannot_keep_the_limit_is_refused(
    changes: dict[str, Any], allowed: str, tmp_path: Path
) -> None:
    config = small_config(policy__max_string_gain=1.02, model__model_ratio=0.0, **changes)
    with pytest.raises(InputError, match=f"policy.max_string_gain: 1.02 is not allowed; allowed: {allowed}"):
        train(config, tmp_path / "run")


def test_infeasible_trials_of_an_expert_with_an_amplifying_default_end_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.training.tune._score_rows", lambda rows, human_rows: (None, "brakes too hard"))
    monkeypatch.setattr(OperatingPoint, "string_gain", lambda self, driver: 1.0 + float(driver.catch_up_speed == 1.0))
    space: SearchSpace = {"catch_up_speed": FloatDistribution(2.0, 3.0)}
    lines, roads, limit = list[str](), {"ring": SMALL}, MAX_STRING_GAIN
    with WorkerPool(1) as workers, pytest.raises(UnjamError, match="all 2 settings of pi are infeasible"):
        tune(roads, "pi", space, STEPS, tmp_path, workers, on_message=lines.append, max_string_gain=limit)
    assert lines[-1] == "pi: not selected: a string gain of 2; allowed: at most 1.02"
