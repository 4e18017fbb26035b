"""Controllers behind recorded vehicles: search of parameters, plans, and the study."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.adapters.onnx_policies import linear, mixing, write
from unjam.controller import make_driver
from unjam.drivers.check import random_state
from unjam.errors import InputError
from unjam.physics.fuel import fuel_rate
from unjam.worlds.batch.run import run_batches
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper import fuel_optimal_plan, information_ahead, recorded_gaps, recorded_residuals, recorded_roads
from unjam_paper.fuel_optimal_plan import PlanLimits, plan_speeds
from unjam_paper.information_ahead import (
    FIXED_PARAMETERS,
    INFORMATION_AHEAD,
    InformedACC,
    plan_behind_humans,
    received_speeds,
    roads_with_vehicles_between,
)
from unjam_paper.parameter_search import SearchBudget, measure_candidates
from unjam_paper.recorded_gaps import FIXED_BY_FORMULA, LIMITED_ACC, RECORDED_GAPS, gap_limits, search_space
from unjam_paper.recorded_residuals import MODEL_RATIOS, planned_residuals
from unjam_paper.recorded_roads import (
    DRIVE_SETTINGS,
    DRIVES_PARTS,
    IDEAL_CAR,
    PLAN_LABEL,
    PUBLISHED_FILES,
    RECORDED_ROADS,
    RECORDINGS_FOLDER,
    RING_DRIVER,
    TEST_DRIVES_PART,
    TRAINING_DRIVES_PART,
    DriveResults,
    PublishedController,
    recorded_drives,
    tuned_name,
    untuned_driver,
)
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, StudyFolder

STEP = 0.1


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of studies with three drives, one of them a test drive, and networks with three inputs."""
    drives = tmp_path / RECORDINGS_FOLDER
    drives.mkdir(parents=True)
    times = STEP * np.arange(400)
    for number, name in enumerate(("2021-03-01_a", "2021-03-02_b", "2021-04-01_c")):
        speeds = 15.0 + 4.0 * np.sin(times / (6.0 + number))
        pd.DataFrame({"time": times, "speed": speeds}).to_csv(drives / f"{name}.csv", index=False)
    for file, make_graph in zip(map(Path, PUBLISHED_FILES.values()), (linear, mixing), strict=True):
        (tmp_path / file.parent).mkdir(exist_ok=True)
        write(tmp_path / file.parent, make_graph(3, [-0.2, 0.15, 0.01]), name=file.stem)
    return tmp_path


@pytest.mark.parametrize("file", PUBLISHED_FILES.values())
def test_published_networks_drive_several_vehicles_as_each_alone(folder: Path, file: str) -> None:
    controller = PublishedController(str(folder / file))
    state = random_state(np.random.default_rng(0), 3)
    together, _ = controller.act(state, {})
    alone = [controller.act(state.select(slice(row, row + 1)), {})[0].item() for row in range(3)]
    np.testing.assert_array_equal(together, alone)


def test_drives_are_split_by_month(folder: Path) -> None:
    names = [[Path(each.recordings).stem for each in recorded_drives(folder, month)] for month in DRIVES_PARTS.values()]
    assert names == [["2021-03-01_a", "2021-03-02_b"], ["2021-04-01_c"]]


def test_missing_drives_are_named_with_their_source(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"recorded-roads: .* has no drives of 2021-03; .*doi\.org"):
        recorded_drives(tmp_path)


def test_missing_recordings_of_other_roads_are_named(folder: Path) -> None:
    with pytest.raises(
        InputError, match=r"openacc: .*openacc_astazero_pairs\.parquet does not exist; allowed: pairs of"
    ):
        planned_residuals(folder, str(folder / RECORDINGS_FOLDER / "2021-03*"), "smooth-acc", 1)


@pytest.mark.parametrize("method", ["smooth-acc", "acc"])
def test_candidates_that_drive_at_once_equal_those_that_drive_alone(folder: Path, method: str) -> None:
    scenarios = recorded_drives(folder)
    parameters = {"time_gap": np.array([1.5, 2.5, 3.5]), "gap_gain": np.array([0.02, 0.05, 0.2])}
    together = measure_candidates(scenarios, untuned_driver(method), parameters)
    for number in range(3):
        values = {name: float(each[number]) for name, each in parameters.items()}
        alone = measure_candidates(scenarios, make_driver(tuned_name([{"parameters": values}], method), STEP))
        for all_values, values in zip(together, alone, strict=True):
            np.testing.assert_allclose(all_values[number], values[0], rtol=1e-9)


def test_a_plan_saves_fuel_within_its_limits() -> None:
    times = STEP * np.arange(901)
    leader = 14.0 + 5.0 * np.sin(times * 2.0 * np.pi / 30.0)
    limits = PlanLimits(largest_gap=60.0)
    (speed,) = plan_speeds([leader], [20.0], STEP, limits)
    gap = 20.0 + STEP * np.cumsum((leader - speed)[1:])
    assert gap.max() < 61.0
    assert (gap - limits.standstill_gap - speed[1:]).min() > -1.0
    assert speed[[0, -1]] == pytest.approx(leader[[0, -1]])

    def fuel(speeds: np.ndarray) -> float:
        return float(fuel_rate(speeds[1:], np.diff(speeds) / STEP).sum() / speeds[1:].sum())

    assert fuel(speed) < 0.85 * fuel(leader)


def test_the_study_tunes_trains_and_then_compares_all_drivers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_roads, "SEARCH_BUDGET", SearchBudget(5, 6))
    small_settings = {name: DRIVE_SETTINGS[name] for name in (*DRIVE_SETTINGS,)[:2]}
    monkeypatch.setattr(recorded_roads, "DRIVE_SETTINGS", small_settings)
    monkeypatch.setitem(fuel_optimal_plan.OPTIMIZER_OPTIONS, "maxiter", 20)
    monkeypatch.setattr(recorded_residuals, "STEPS_PER_ITERATION", 2000)
    monkeypatch.setattr(recorded_residuals, "TRAINING_STEPS", 4000)
    monkeypatch.setitem(recorded_residuals.TASK_OPTIONS, "window", 30.0)
    for name, value in {"evaluation.validation_episodes": 2, "evaluation.validation_interval": 1}.items():
        monkeypatch.setitem(recorded_residuals.TRAINING_CHANGES, name, value)
    other_recordings = {"other": {"recordings": f"{RECORDINGS_FOLDER}/2021-03-01_a.csv", "window": 20.0}}
    monkeypatch.setattr(recorded_residuals, "OTHER_RECORDINGS", other_recordings)
    study = folder / "recorded-roads"
    RECORDED_ROADS.run(StudyFolder(folder), 1, study, 1)
    formulas = ["human", "follower-stopper", "published", "smooth-acc, tuned", "acc, tuned"]
    trained = [f"smooth-acc and residual {name}" for name in MODEL_RATIOS]
    for table, part, drives in (("drivers", TRAINING_DRIVES_PART, 2), ("test", TEST_DRIVES_PART, 1)):
        frame = pd.read_csv(study / f"{table}.csv")
        assert list(frame["driver"]) == [*formulas, RING_DRIVER, PLAN_LABEL, *trained]
        assert frame["fuel of the platoon [%]"].tolist()[0] == "–"
        assert len(read_part(study, part)) == 10 * drives
    assert list(pd.read_csv(study / "search.csv")["method"]) == ["smooth-acc", "acc"]
    settings = pd.read_csv(study / "assumptions.csv")
    assert list(settings.columns[1:]) == formulas[1:]
    assert len(settings) == 3  # two settings, and fuel in SUMO
    assert list(pd.read_csv(study / "residuals.csv")["trainings"]) == [1, 1, 1]
    assert len(pd.read_csv(study / "waves.csv")) == 10


def test_several_trainings_are_one_driver_with_paired_drives() -> None:
    fuel = {
        "human": [100.0, 50.0],
        "smooth-acc:gap=2": [98.0, 50.0],
        "with model 0": [97.0, 49.0],
        "with model 1": [99.0, 50.0],
    }
    rows = [
        {"driver": name, "drive": drive, "fuel_by_power": value}
        for name, values in fuel.items()
        for drive, value in zip("ab", values, strict=True)
    ]
    results = DriveResults(rows)
    trained = "smooth-acc and residual with model"
    assert [*results.groups()] == ["human", "smooth-acc:gap=2", trained]
    np.testing.assert_allclose(results.change(trained, "fuel_by_power"), [[-3.0, -2.0], [-1.0, 0.0]])
    against_law = results.change(trained, "fuel_by_power", baseline="smooth-acc:gap=2")
    np.testing.assert_allclose(against_law, [[-1.0, -2.0], [1.0, 0.0]])
    assert results.change_text("human", "fuel_by_power") == "–"


def test_received_speeds_are_those_of_the_first_vehicle_after_the_latency(folder: Path) -> None:
    scenarios = roads_with_vehicles_between(folder, 3)
    current, delayed = received_speeds(scenarios, 0.0), received_speeds(scenarios, 2.0)
    np.testing.assert_array_equal(delayed[20:], current)
    np.testing.assert_array_equal(delayed[:20], np.tile(current[0], (20, 1)))
    assert current[:, 0] == pytest.approx(15.0 + 4.0 * np.sin(STEP * np.arange(400) / 6.0))


def test_each_candidate_receives_the_speeds_of_its_own_road(folder: Path) -> None:
    scenarios = roads_with_vehicles_between(folder, 3)
    driver = InformedACC(**FIXED_PARAMETERS, received_speeds=received_speeds(scenarios, 1.0))
    weights = {"ahead_weight": np.array([0.0, 0.7])}
    together = measure_candidates(scenarios, driver, weights)
    without = measure_candidates(
        scenarios, untuned_driver("smooth-acc"), {name: np.array([value]) for name, value in FIXED_PARAMETERS.items()}
    )
    np.testing.assert_allclose(together.fuel[0], without.fuel[0], rtol=1e-9)
    for number, scenario in enumerate(scenarios):
        informed = InformedACC(**FIXED_PARAMETERS, ahead_weight=0.7, received_speeds=received_speeds([scenario], 1.0))
        alone = measure_candidates([scenario], informed)
        np.testing.assert_allclose(together.fuel[1, number], alone.fuel[0, 0], rtol=1e-9)
    assert abs(together.fuel[1] / together.fuel[0] - 1.0).max() > 1e-4


def test_the_value_of_information_is_that_on_test_drives(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(information_ahead, "VEHICLES_BETWEEN", (2,))
    monkeypatch.setattr(information_ahead, "LATENCIES", (None, 1.0))
    monkeypatch.setattr(information_ahead, "VALUE_BUDGET", SearchBudget(1, 6))
    monkeypatch.setitem(fuel_optimal_plan.OPTIMIZER_OPTIONS, "maxiter", 20)
    study = folder / "information-ahead"
    INFORMATION_AHEAD.run(StudyFolder(folder), 1, study, 1)
    rows = read_part(study, TEST_DRIVES_PART)
    assert [(row["between"], row["latency"]) for row in rows] == [(2, None), (2, 1.0), (2, PLAN_LABEL)]
    assert {len(row["by_drive"]) for row in rows} == {1}
    table = pd.read_csv(study / "value.csv")
    assert table["latency [s]"].tolist() == ["nothing received", "1", PLAN_LABEL]
    difference = np.mean(np.subtract(rows[1]["by_drive"], rows[0]["by_drive"]))
    assert float(str(table["difference to nothing received"][1]).split()[0]) == pytest.approx(difference, abs=0.01)
    assert table["share of the plan's saving"].tolist()[-1] == 1.0


def test_laws_are_tuned_for_each_gap_with_the_same_limits(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_gaps, "MEAN_GAPS", (60.0, 40.0))
    monkeypatch.setattr(recorded_gaps, "GAPS_BUDGET", SearchBudget(1, 6))
    study = folder / "recorded-gaps"
    RECORDED_GAPS.run(StudyFolder(folder), 1, study, 1)
    names = {law: set(row["parameters"]) for row in read_part(study, "search") if (law := row["law"])}
    assert (
        names["smooth-acc"] - names[LIMITED_ACC]
        == {"averaging_time", "leader_weight"}
        == set(FIXED_BY_FORMULA[LIMITED_ACC])
    )
    table = pd.read_csv(study / "gaps.csv", keep_default_na=False)
    assert table["law"].tolist() == [*PUBLISHED_FILES, "smooth-acc", "smooth-acc", LIMITED_ACC, LIMITED_ACC]
    assert table["tuned for a mean gap of"].tolist()[2:] == ["60 m", "40 m"] * 2
    assert (table["difference to that ACC [points]"] == NO_VALUE_TEXT).tolist() == [
        True,
        True,
        False,
        False,
        True,
        True,
    ]


def test_the_largest_gap_of_a_search_shrinks_with_its_mean_gap() -> None:
    for gap in (73.0, 40.0):
        limits = gap_limits(gap)
        assert limits.largest_gap / limits.largest_mean_gap == pytest.approx(105.0 / 73.0)
        assert search_space("smooth-acc", limits)["largest_gap"].high < limits.largest_gap


def test_a_plan_behind_human_drivers_starts_with_their_speeds_and_gaps(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(fuel_optimal_plan.OPTIMIZER_OPTIONS, "maxiter", 60)
    scenarios = [replace(each, **IDEAL_CAR) for each in roads_with_vehicles_between(folder, 3)]
    plan = plan_behind_humans(scenarios)
    planned = run_batches([EpisodeTask(each, plan, (0,)) for each in scenarios])
    human = run_batches([EpisodeTask(each, make_driver("human", STEP), (0,)) for each in scenarios])
    for planned_episode, human_episode in zip(planned, human, strict=True):
        leader = planned_episode.cav_columns[0] + 1
        np.testing.assert_array_equal(planned_episode.speeds[:, leader:], human_episode.speeds[:, leader:])
        assert (
            np.diff(planned_episode.positions[:, leader - 1 : leader + 1]).min() > 5.0
        )  # vehicles have a length of 5 m
        assert np.std(planned_episode.speeds[:, leader - 1]) < np.std(human_episode.speeds[:, leader - 1])
