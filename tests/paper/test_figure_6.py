import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from unjam.following.four_regimes import FourRegimesSettings
from unjam.following.networks import OneStepSettings
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import next_speed
from unjam.recordings.trajectories import FollowingSamples
from unjam_paper import figure_6
from unjam_paper.figure_6 import (
    NEAREST_ROW,
    TRAINING_SIZES,
    FourRegimeFit,
    average_acceleration,
    four_regime_fits,
    measure_fit,
    split_rows,
)
from unjam_paper.study import StudyFolder


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    settings = {
        name: FourRegimesSettings(samples=6000, driver=data.driver) for name, data in figure_6.DATA_SETTINGS.items()
    }
    monkeypatch.setattr(figure_6, "DATA_SETTINGS", settings)
    monkeypatch.setattr(figure_6, "OneStepSettings", lambda: OneStepSettings(hidden=(4,), epochs=2))
    split_rows.cache_clear()
    yield
    split_rows.cache_clear()


def test_every_size_is_repeated_five_times_with_both_networks() -> None:
    main_fits = [
        fit for fit in four_regime_fits() if (fit.driver, fit.split, fit.is_long) == ("other", "trajectories", False)
    ]
    counts = Counter((fit.size, fit.network) for fit in main_fits if fit.network != NEAREST_ROW)
    assert counts == {(size, network): 5 for size in TRAINING_SIZES for network in ("knowledge", "vanilla")}
    assert len({fit.name for fit in four_regime_fits()}) == len(four_regime_fits())


def test_test_rows_are_always_the_same_and_only_the_released_split_leaks(small: None) -> None:
    overlaps = {split: split_rows("other", split).overlap for split in ("trajectories", "rows", "released")}
    assert overlaps["trajectories"] == overlaps["rows"] == 0.0
    assert overlaps["released"] == pytest.approx(0.696, abs=0.03)
    rows = split_rows("other", "trajectories")
    training = set(map(tuple, np.column_stack([rows.training.leader_speed, rows.training.gap]).tolist()))
    test = set(map(tuple, np.column_stack([rows.test.leader_speed, rows.test.gap]).tolist()))
    assert not training & test


@pytest.mark.parametrize("network", ["knowledge", "vanilla", NEAREST_ROW])
def test_a_fit_has_an_error_with_and_without_noise(small: None, network: str) -> None:
    row = measure_fit(FourRegimeFit("same", network, 0.1, 0))
    assert row["noise"] == pytest.approx(0.2, abs=0.02)
    assert row["rows"] == round(0.1 * 4200)
    assert row["driver_error"] < row["error"] or network == "vanilla"


@pytest.mark.parametrize("speed", [0.0, 0.01, 10.0])
def test_noise_can_only_start_a_standing_vehicle(speed: float) -> None:
    count, settings = 200_000, FourRegimesSettings()
    rows = FollowingSamples(*(np.full(count, value) for value in (speed, 0.0, 2.0 + speed * 5, 0.0)))
    noise = np.random.default_rng(0).normal(0.0, settings.acceleration_noise, count)
    accelerations = idm_acceleration(rows.speed, rows.leader_speed, rows.gap, settings.driver) + noise
    drawn = (next_speed(rows.speed, accelerations, settings.time_step) - rows.speed) / settings.time_step
    assert average_acceleration(rows, settings)[0] == pytest.approx(drawn.mean(), abs=2e-3)


def test_with_the_true_model_as_base_the_error_is_smaller(small: None) -> None:
    errors = {
        name: measure_fit(FourRegimeFit("same", name, 1.0, 0))["driver_error"] for name in ("knowledge", "vanilla")
    }
    assert errors["knowledge"] < errors["vanilla"]


def test_the_study_writes_results_and_a_figure(small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    main_fits = [FourRegimeFit("other", name, size, 0) for name in ("knowledge", "vanilla") for size in (0.3, 1.0)]
    long_fits = [FourRegimeFit("other", name, 0.01, 0, is_long=True) for name in ("knowledge", "vanilla")]
    monkeypatch.setattr(figure_6, "four_regime_fits", lambda: [*main_fits, *long_fits])
    figure_6.FIGURE_6.run(StudyFolder(tmp_path), 1, tmp_path, 1)
    rows = json.loads((tmp_path / "figure-6.json").read_text())["rows"]
    assert len(rows) == 6
    assert ["training_loss" in row for row in rows] == [False, True, False, True, False, False]
    assert (tmp_path / "figure-6.png").stat().st_size > 10_000
