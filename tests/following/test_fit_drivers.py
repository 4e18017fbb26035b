from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.recordings.synthetic_trajectories import idm_driver, write_table
from unjam.errors import DiskError, InputError
from unjam.following.calibration import CalibrationSettings, MultiStepSettings
from unjam.following.fit_drivers import FitDriversSettings, fit_drivers, fit_drivers_from_files
from unjam.physics.idm import IDMParameters
from unjam.recordings.trajectories import FollowingTrajectory
from unjam.scenarios.population import Population, reserve_population

HEADWAYS = (0.9, 1.1, 1.3, 1.5, 1.7)
QUICK = CalibrationSettings(generations=15)


@pytest.fixture(scope="module")
def trajectories() -> list[FollowingTrajectory]:
    return [
        idm_driver(IDMParameters(time_headway=headway), f"driver {headway}", seed, seconds=25.0)
        for seed, headway in enumerate(HEADWAYS)
    ]


@pytest.mark.slow
def test_each_driver_has_its_headway_and_the_common_parameters(trajectories: list[FollowingTrajectory]) -> None:
    progress: list[tuple[int, int]] = []
    population = fit_drivers(trajectories, FitDriversSettings(calibration=QUICK), lambda *done: progress.append(done))
    headways = [driver.time_headway for driver in population.drivers]
    assert headways == sorted(headways)
    assert all(driver.max_acceleration == population.typical.max_acceleration for driver in population.drivers)
    assert [detail["name"] for detail in population.details] == [trajectory.driver for trajectory in trajectories]
    assert all(detail["gap_error"] < population.metadata["fit"]["common"]["gap_error"] for detail in population.details)
    assert population.residual is None
    assert progress[-1] == (5, 5)
    assert headways[0] < population.typical.time_headway < headways[-1]


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_typical_headway_is_in_the_middle(seed: int) -> None:
    trajectories = [
        idm_driver(IDMParameters(time_headway=headway), f"{headway}", number, seconds=20.0)
        for number, headway in enumerate((1.0, 1.4, 1.8))
    ]
    quick = CalibrationSettings(generations=25, candidates=3, seed=seed)
    population = fit_drivers(trajectories, FitDriversSettings(calibration=quick, rounds=2))
    assert 1.1 < population.typical.time_headway < 1.7


@pytest.mark.long
def test_residual_is_used_only_if_it_is_better(trajectories: list[FollowingTrajectory]) -> None:
    multi_step = MultiStepSettings(
        hidden=(4,), segment_seconds=5.0, batch_size=8, gradient_steps=2, validation_interval=1
    )
    settings = FitDriversSettings(calibration=CalibrationSettings(generations=2), residual=True, multi_step=multi_step)
    population = fit_drivers(trajectories, settings)
    fit = population.metadata["fit"]
    assert fit["residual_is_better"] == (min(fit["residual_gap_errors"]) < fit["residual_gap_errors"][0])
    assert (population.residual is not None) == fit["residual_is_better"]


def test_unsupported_data_and_settings_are_refused(trajectories: list[FollowingTrajectory]) -> None:
    with pytest.raises(InputError, match=r"drivers: 2 is not allowed; allowed: >= 5 for a residual"):
        fit_drivers(trajectories[:2], FitDriversSettings(residual=True))
    with pytest.raises(InputError, match="individual: 'exponent' is not allowed"):
        fit_drivers(trajectories, FitDriversSettings(individual=("exponent",)))


ONE_DRIVER = Population(IDMParameters(), (IDMParameters(),), (-5.0, 2.0))
CHANGES = {"calibration.generations": 2, "residual": False}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    path = tmp_path / "data.parquet"
    write_table(path, [{"kind": kind} for kind in ("human", "human", "ACC")])
    return path


def test_population_whose_error_is_not_a_number_is_refused(trajectories: list[FollowingTrajectory]) -> None:
    broken = replace(trajectories[0], gap=np.full_like(trajectories[0].gap, np.nan))
    settings = FitDriversSettings(calibration=CalibrationSettings(generations=1, candidates=1), rounds=1)
    with pytest.raises(InputError, match="gap error of one IDM for all: nan is not allowed; allowed: a finite number"):
        fit_drivers([broken], settings)


@pytest.mark.long
def test_file_is_fitted_to_a_population(data: Path) -> None:
    fit = fit_drivers_from_files([data], CHANGES)
    assert len(fit.population.drivers) == 3
    assert fit.notes == ["data.parquet: 3 trajectories with 603 of 603 rows"]
    assert fit.population.metadata["data"] == ["data.parquet"]
    assert "one IDM for all" in fit.report_lines()[0]
    assert fit.facts()["drivers"] == 3


@pytest.mark.long
def test_trajectories_with_different_time_steps_are_fitted_at_the_longest(data: Path, tmp_path: Path) -> None:
    rows = pd.read_parquet(data)
    slower = rows.assign(pair=rows["pair"] + 3, t=2 * rows["t"])
    pd.concat([rows, slower]).to_parquet(tmp_path / "both.parquet")
    fit = fit_drivers_from_files([tmp_path / "both.parquet"], CHANGES)
    assert fit.notes[:2] == [
        "both.parquet: 6 trajectories with 1,206 of 1,206 rows",
        "trajectories with a shorter time step are interpolated to 0.2 s",
    ]
    assert len(fit.population.drivers) == 6


@pytest.mark.long
def test_population_names_no_folder_of_the_machine(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["unjam", "fit-drivers", str(data)])
    command = fit_drivers_from_files([data], CHANGES).population.metadata["manifest"]["command"]
    assert command == ["unjam", "fit-drivers", "data.parquet"]


@pytest.mark.long
def test_filters_select_trajectories(data: Path) -> None:
    assert len(fit_drivers_from_files([data], CHANGES, filters={"kind": "human"}).population.drivers) == 2


@pytest.mark.slow
def test_drivers_of_several_files_have_different_names(data: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.parquet"
    write_table(other, [{}])
    names = [detail["name"] for detail in fit_drivers_from_files([data, other], CHANGES).population.details]
    assert names == ["data-0", "data-1", "data-2", "other-0"]


@pytest.mark.parametrize(
    ("changes", "more", "words"),
    [
        ({"calibration.speed": 2}, {}, "calibration.speed: unknown name"),
        ({}, {"filters": {"kind": "robot"}}, "no trajectory has the kind 'robot'; available: ACC, human"),
        ({}, {"filters": {"color": "red"}}, "select: 'color' is not allowed"),
    ],
)
def test_invalid_input_is_refused(data: Path, changes: dict, more: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        fit_drivers_from_files([data], {**CHANGES, **changes}, **more)


@pytest.mark.parametrize("name", ["drivers.json", "drivers.safetensors"])
def test_existing_files_are_not_overwritten_even_if_they_appear_during_the_calibration(
    name: str, tmp_path: Path
) -> None:
    with reserve_population(tmp_path / "drivers.json") as write:
        (tmp_path / name).write_text("mine")
        with pytest.raises(InputError, match=rf"out: .*{name}' exists; allowed: a new file"):
            write(ONE_DRIVER)
    with pytest.raises(InputError, match="exists"), reserve_population(tmp_path / "drivers.json"):
        pass
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]


def test_two_calibrations_cannot_have_the_same_output(tmp_path: Path) -> None:
    out = tmp_path / "drivers.json"
    with reserve_population(out) as write:
        with pytest.raises(InputError, match="is being written by another process"), reserve_population(out):
            pass
        write(ONE_DRIVER)
    assert [path.name for path in tmp_path.iterdir()] == ["drivers.json"]


@pytest.mark.parametrize(("name", "error"), [("gone/drivers.json", DiskError), ("drivers.csv", InputError)])
def test_a_wrong_output_is_refused_before_the_calibration(name: str, error: type[Exception], tmp_path: Path) -> None:
    with pytest.raises(error), reserve_population(tmp_path / name):
        pass


@pytest.mark.slow
def test_drivers_of_files_with_the_same_name_have_different_names(data: Path, tmp_path: Path) -> None:
    days = [tmp_path / day / data.name for day in ("monday", "tuesday")]
    for day in days:
        day.parent.mkdir()
        day.write_bytes(data.read_bytes())
    names = [detail["name"] for detail in fit_drivers_from_files(days, CHANGES).population.details]
    assert len(set(names)) == len(names) == 2 * len(fit_drivers_from_files([data], CHANGES).population.details)
    assert {name.partition("-")[0] for name in names} == {"1", "2"}
    with pytest.raises(InputError, match=r"data: .* is not allowed; allowed: each file once"):
        fit_drivers_from_files([days[0], days[0]], CHANGES)
