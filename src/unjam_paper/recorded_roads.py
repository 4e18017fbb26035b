"""Controllers behind recorded vehicles: fuel that they save in a platoon, and the gaps that they need for it.

The recordings are drives on I-24 (10.5281/zenodo.6366761). Those of March 2021 are for tuning and training; those of
April are test drives, which choose nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from optuna.distributions import FloatDistribution

from unjam.controller import make_driver
from unjam.controller.file import SUFFIX
from unjam.drivers.car_following import ACC, FollowerStopper
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.smooth_acc import SmoothACC
from unjam.errors import InputError
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.physics.arrays import Array
from unjam.scenarios import Recorded
from unjam.scenarios.road import RecordedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.training.evaluate import raise_failure
from unjam.worlds.batch.run import run_batches
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.fuel_optimal_plan import PlanLimits, PlannedDriver, plan_speeds
from unjam_paper.parameter_search import SearchBudget, measure_candidates, search_parameters
from unjam_paper.recorded_residuals import planned_residuals, train_residual
from unjam_paper.recorded_tables import (
    DRIVE_SETTINGS,
    RESIDUALS_PART,
    SEARCH_PART,
    STANDARD_SETTING,
    SUMO_FUEL_PART,
    TEST_DRIVES_PART,
    TRAINING_DRIVES_PART,
    WAVE_METRICS,
    assumptions_table,
    drivers_table,
    residuals_table,
    search_table,
    waves_table,
)
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import Study, StudyFolder, Table

RECORDED_STUDY = "recorded-roads"
RECORDINGS_FOLDER = "recordings/i24"
"""the drives, in the folder of all studies"""
PUBLISHED_LABEL, LATER_LABEL = "published", "published, later version"
PUBLISHED_FILES = {PUBLISHED_LABEL: "recordings/model.onnx", LATER_LABEL: "recordings/later/model.onnx"}
"""controllers/cra/model.onnx of CIRCLES-consortium/algos-stack, there: of the branches `master` and `cra_08_04`"""
TRAINING_MONTH, TEST_MONTH = "2021-03", "2021-04"
TIME_STEP = 0.1
TUNED_SET_SPEED = 45.0
"""above all recorded speeds [m/s]"""
MOTORWAY_TIME_GAPS = (0.4, 0.6, 0.8)
SPEED_CONTROL_TIME = 0.6
"""time in which the speed controller of a car reaches a commanded speed; of the published controller, too [s]"""
STOPPER = (
    f"follower-stopper:window={TIME_STEP:g},boundary_time_gaps=[{','.join(map(str, MOTORWAY_TIME_GAPS))}],"
    f"time_constant={SPEED_CONTROL_TIME:g}"
)
SEARCH_SPACES: dict[str, dict[str, FloatDistribution]] = {
    "smooth-acc": {
        "time_gap": FloatDistribution(1.0, 4.0),
        "averaging_time": FloatDistribution(3.0, 80.0, log=True),
        "leader_weight": FloatDistribution(0.0, 0.6),
        "gap_gain": FloatDistribution(0.002, 0.2, log=True),
        "catch_up_speed": FloatDistribution(0.3, 6.0, log=True),
        "time_constant": FloatDistribution(0.3, 8.0, log=True),
        "acceleration_limit": FloatDistribution(0.08, 1.0, log=True),
        "braking_limit": FloatDistribution(0.1, 1.5, log=True),
        "largest_gap": FloatDistribution(70.0, 104.0),
    },
    "acc": {
        "time_gap": FloatDistribution(1.0, 4.0),
        "gap_gain": FloatDistribution(0.003, 0.3, log=True),
        "speed_gain": FloatDistribution(0.05, 1.0, log=True),
    },
}
DRIVE_METRICS = (
    *("fuel_by_power", "cav_fuel_by_power", "human_fuel_by_power", "cav_mean_gap", "cav_gap_95", "cav_max_gap"),
    *("min_time_gap", "share_short_time_gap", "time_behind_leader", "outflow_veh_per_h", "cav_max_braking"),
    *(*WAVE_METRICS, "mean_abs_jerk", "filter_override_share", "feasibility"),
)
IDEAL_CAR: dict[str, Any] = {"actuator": Actuator(), "safety": SafetyFilter(active=False), "actuation": "raw"}
"""the car of a plan"""
SEARCH_SEED, SEARCH_BUDGET = 0, SearchBudget()
PLAN_LABEL = "plan that knows the recording"
DRIVES_PARTS = {TRAINING_DRIVES_PART: TRAINING_MONTH, TEST_DRIVES_PART: TEST_MONTH}
SETTING_METRICS = "fuel_by_power", "cav_mean_gap", "min_time_gap", "feasibility"
SUMO_METRICS = ("fuel_ml_per_km", "fuel_by_power")


@dataclass(frozen=True)
class PublishedController(Driver):
    """The published controller of the CIRCLES experiment: a FollowerStopper limits the acceleration of a network."""

    file: str
    """its ONNX graph; the same folder has the description"""

    @cached_property
    def network(self) -> Driver:
        """The graph, which has no memory."""
        return make_driver(self.file, TIME_STEP)

    @cached_property
    def stopper(self) -> FollowerStopper:
        """The version for motorways."""
        return FollowerStopper(boundary_time_gaps=MOTORWAY_TIME_GAPS, time_constant=SPEED_CONTROL_TIME)

    def initial_memory(self, n: int) -> Memory:
        """Return no memory."""
        return {}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the FollowerStopper towards the speed that the network commands."""
        acceleration, _ = self.network.act(state, self.network.initial_memory(len(state.speed)))
        return self.stopper.acceleration(state, state.speed + SPEED_CONTROL_TIME * acceleration), memory


def recorded_drives(folder: Path, month: str = TRAINING_MONTH) -> list[Recorded]:
    """Return a road for each drive of a month; raise `InputError` if the drives are missing."""
    found = _drive_files(folder, month)
    if not found:
        path = folder / RECORDINGS_FOLDER
        raise InputError(
            f"{RECORDED_STUDY}: {path} has no drives of {month}; download them: https://doi.org/10.5281/zenodo.6366761"
        )
    return [Recorded(recordings=str(file)) for file in found]


def _drive_files(folder: Path, month: str) -> list[Path]:
    return sorted((folder / RECORDINGS_FOLDER).glob(f"{month}*"))


def untuned_driver(method: str) -> Driver:
    """Return a driver before the search of its parameters."""
    return SmoothACC(time_step=TIME_STEP) if method == "smooth-acc" else ACC(set_speed=TUNED_SET_SPEED)


def tune_driver(folder: str, method: str, workers: int) -> Table:
    """Return the best candidates of a method after each generation, on the training drives."""
    scenarios = recorded_drives(Path(folder))
    human = measure_candidates(scenarios, make_driver(HUMAN_LABEL, TIME_STEP))
    return search_parameters(
        scenarios, untuned_driver(method), SEARCH_SPACES[method], human, SEARCH_SEED, SEARCH_BUDGET
    )


def tuned_name(rows: Table, method: str) -> str:
    """Return the tuned driver as on the command line."""
    fixed = {"set_speed": TUNED_SET_SPEED} if method == "acc" else {}
    values = ",".join(f"{key}={value:g}" for key, value in {**fixed, **rows[-1]["parameters"]}.items())
    return f"{method}:{values}"


def measure_driver(folder: str, month: str, setting: str, name: str, workers: int) -> Table:
    """Return the metrics of a driver behind each drive of a month with changed assumptions, one row for each drive."""
    scenarios = [replace(each, **DRIVE_SETTINGS[setting]) for each in recorded_drives(Path(folder), month)]
    if name == PLAN_LABEL:
        scenarios = [replace(each, **IDEAL_CAR) for each in scenarios]
        driver = plan_driver(scenarios)
    else:
        driver = compared_driver(Path(folder), name)
    rows = [measure(episode) for episode in run_batches([EpisodeTask(each, driver, (0,)) for each in scenarios])]
    raise_failure(rows)
    metrics = DRIVE_METRICS if setting == STANDARD_SETTING else SETTING_METRICS
    return _drive_rows(name, scenarios, rows, metrics)


def measure_fuel_in_sumo(folder: str, month: str, name: str, workers: int) -> Table:
    """Return the fuel of the platoon by SUMO's emission model behind each drive of a month."""
    scenarios, driver = recorded_drives(Path(folder), month), compared_driver(Path(folder), name)
    rows = [measure(run_episode(each, driver, (0,), record_details=True)) for each in scenarios]
    raise_failure(rows)
    return _drive_rows(name, scenarios, rows, SUMO_METRICS)


def compared_driver(folder: Path, name: str) -> Driver:
    """Return a driver by its name in tables."""
    if name in PUBLISHED_FILES:
        return PublishedController(str(folder / PUBLISHED_FILES[name]))
    return make_driver(name, TIME_STEP)


def _drive_rows(name: str, scenarios: Sequence[Recorded], rows: Table, metrics: Sequence[str]) -> Table:
    drives = (Path(each.recordings).stem for each in scenarios)
    label = _entry(name) if name.endswith(SUFFIX) else name
    return [
        {"driver": label, "drive": drive, **{metric: row[metric] for metric in metrics}}
        for drive, row in zip(drives, rows, strict=True)
    ]


def plan_driver(scenarios: list[Recorded]) -> PlannedDriver:
    """Return a driver that follows a fuel-optimal plan for each road."""
    roads = [cast(RecordedRoad, each.draw_from_seed((0,))[0]) for each in scenarios]
    gaps = [float(np.diff(road.start_positions[-2:])[0]) - VEHICLE_LENGTH for road in roads]
    speeds = [road.replayed_speeds for road in roads]
    return PlannedDriver(tuple(plan_speeds(speeds, gaps, TIME_STEP, PlanLimits())), TIME_STEP)


def make_recorded_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return the searches of parameters, then the trainings, and then the drivers behind the drives of both months."""
    root, folder = str(study_folder.folder), study_folder.folder / RECORDED_STUDY
    parts: dict[str, StudyPart] = {f"{SEARCH_PART} {method}": (tune_driver, (root, method)) for method in SEARCH_SPACES}
    if not all((folder / f"{part}.json").is_file() for part in parts):
        return parts
    tuned = [tuned_name(read_part(folder, f"{SEARCH_PART} {method}"), method) for method in SEARCH_SPACES]
    recorded_drives(study_folder.folder, TEST_MONTH)  # refused before the trainings
    drives = str(study_folder.folder / RECORDINGS_FOLDER / f"{TRAINING_MONTH}*")
    runs = planned_residuals(folder / RESIDUALS_PART, drives, tuned[0], seeds)
    parts |= {f"{RESIDUALS_PART}/{run.name}": (train_residual, (run,)) for run in runs}
    if not all(run.controller.is_file() for run in runs):
        return parts
    names = (HUMAN_LABEL, STOPPER, PUBLISHED_LABEL, *tuned)
    residuals = tuple(str(run.controller) for run in runs)
    for part, month in DRIVES_PARTS.items():
        for name in (*names, PLAN_LABEL, *residuals):
            parts[f"{part}/{_entry(name)}"] = measure_driver, (root, month, STANDARD_SETTING, name)
    for name in names:
        parts[f"{SUMO_FUEL_PART}/{_entry(name)}"] = measure_fuel_in_sumo, (root, TEST_MONTH, name)
        for setting in (each for each in DRIVE_SETTINGS if each != STANDARD_SETTING):
            parts[f"{setting}/{_entry(name)}"] = measure_driver, (root, TEST_MONTH, setting, name)
    return parts


def _entry(name: str) -> str:
    """Return a short label: the name of a law, or that of a trained controller's file."""
    return Path(name).stem if name.endswith(SUFFIX) else name.partition(":")[0]


RECORDED_ROADS = Study(
    title="controllers behind recorded vehicles: fuel of a platoon, and the gaps that it needs",
    make_parts=make_recorded_parts,
    minutes=180.0,
    tables={
        **{
            name: partial(drivers_table, part)
            for name, part in (("drivers", TRAINING_DRIVES_PART), ("test", TEST_DRIVES_PART))
        },
        **{
            "waves": waves_table,
            "assumptions": assumptions_table,
            "search": search_table,
            "residuals": residuals_table,
        },
    },
)
