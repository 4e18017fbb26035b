"""Tuning keeps to settings that do not amplify the oscillations of their leaders."""

from math import inf
from pathlib import Path

import numpy as np
import pytest
from optuna.distributions import FloatDistribution

from unjam.controller import string_stability
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, UnjamError
from unjam.scenarios import Ring
from unjam.scenarios.motorway import ON_RAMP
from unjam.training import setting_sampler
from unjam.training.search_space import SearchSpace
from unjam.training.string_limit import MAX_STRING_GAIN, find_operating_points
from unjam.training.trial_log import TRIALS_FILE
from unjam.training.tune import STRING_GAIN_SEED, TUNING_EPISODES, TUNING_FINALISTS, tune
from unjam.worlds.worker_pool import WorkerPool

SMALL = Ring(horizon=60, vehicles=8, length=(80, 90), warmup=300)
STEPS = ((TUNING_FINALISTS + 1) * 2 + 4) * TUNING_EPISODES * 60
TIME_GAPS: SearchSpace = {"time_gap": FloatDistribution(0.1, 8.0), "gap_gain": FloatDistribution(0.02, 0.2)}


@pytest.fixture(autouse=True)
def few_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(string_stability, "OSCILLATION_FREQUENCIES", np.geomspace(0.005, 0.2, 5))
    monkeypatch.setattr(string_stability, "SETTLING_SECONDS", 40.0)


@pytest.mark.long
def test_settings_that_amplify_are_never_tried_and_a_resumed_tuning_knows_them(tmp_path: Path) -> None:
    def run() -> tuple[list[str], float]:
        with WorkerPool(1) as workers:
            found = tune({"ring": SMALL}, "smooth-acc", TIME_GAPS, STEPS, tmp_path, workers, max_string_gain=1.02)
        return [trial.driver for trial in found.trials], found.best.score or 0.0

    tried = run()
    rows = [line for line in (tmp_path / TRIALS_FILE).read_text().splitlines() if "largest string gain" in line]
    with WorkerPool(1) as workers:
        (point,) = find_operating_points({"ring": SMALL}, workers).values()
    assert all(point.string_gain(driver_from_name(driver, 0.1)) <= 1.02 for driver in tried[0])
    assert len(rows) > len(tried[0])  # some were refused
    assert f'"first_seed": {STRING_GAIN_SEED}' in rows[0]
    assert run() == tried
    assert len((tmp_path / TRIALS_FILE).read_text().splitlines()) == len(rows) + len(tried[0]) + TUNING_FINALISTS


def test_an_expert_that_always_amplifies_ends_the_tuning_with_its_smallest_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(setting_sampler, "MAX_REFUSED_SETTINGS", 3)
    space: SearchSpace = {"catch_up_speed": FloatDistribution(1.0, 3.0)}
    message = r"3 settings of pi in a row have a string gain of at least 1\.\d+; allowed: at most 1.02, or another"
    with WorkerPool(1) as workers, pytest.raises(UnjamError, match=message):
        tune({"ring": SMALL}, "pi", space, STEPS, tmp_path, workers, max_string_gain=MAX_STRING_GAIN)


def test_a_limit_on_an_open_road_is_refused(tmp_path: Path) -> None:
    message = "max_string_gain: 1.02 is not allowed; allowed: inf on on-ramp"
    with WorkerPool(1) as workers, pytest.raises(InputError, match=message):
        tune({"on-ramp": ON_RAMP}, "jam-ahead", {}, 10**9, tmp_path, workers, max_string_gain=1.02)


def test_without_a_limit_no_gain_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("unjam.training.tune.find_operating_points")
    with WorkerPool(1) as workers:
        found = tune({"ring": SMALL}, "pi", {}, STEPS, tmp_path, workers, max_string_gain=inf)
    assert "string_gain" not in (tmp_path / "tuned.json").read_text()
    assert found.best.score is not None
