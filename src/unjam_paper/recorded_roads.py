"""Controllers behind recorded vehicles: fuel that they save in a platoon, and the gaps that they need for it.

The recordings are drives on I-24 (10.5281/zenodo.6366761). Drives of March 2021 are for tuning and training; drives of
April are for tests only. Residuals on the tuned formula are trained with and without the model. Their policy also
observes means of the CAV's speed and gap over ten seconds to some minutes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from optuna.distributions import FloatDistribution

from unjam.controller import make_driver
from unjam.controller.file import SUFFIX
from unjam.drivers.car_following import ACC, FollowerStopper
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.onnx_policy import OnnxDriver
from unjam.drivers.policy import PolicyDescription, PolicyInput
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.smooth_acc import SmoothACC
from unjam.errors import InputError, raise_failure
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import METRICS, measure
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.onnx_models import parse_model
from unjam.physics.arrays import Array, Floats
from unjam.scenarios import Recorded
from unjam.scenarios.road import RecordedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.run import run_batches
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.fuel_optimal_plan import PlanLimits, PlannedDriver, plan_speeds
from unjam_paper.parameter_search import SearchBudget, search_parameters
from unjam_paper.recorded_residuals import RESIDUALS_PART, planned_residuals, residuals_table, train_residual
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table, estimate_text

TUNED_METHOD = "smooth-acc"
"""the formula to which residuals are added"""
SEARCH_PART, SUMO_FUEL_PART = "search", "in SUMO"
TRAINING_DRIVES_PART, TEST_DRIVES_PART = "training drives", "test drives"
STANDARD_SETTING = "as tuned"
DRIVE_SETTINGS: dict[str, dict[str, Any]] = {
    STANDARD_SETTING: {},
    "20 human drivers behind the CAV": {"platoon": "cav human*20"},
    "human drivers calibrated with NGSIM": {"population": "unjam:ngsim"},
    "human drivers calibrated with AstaZero": {"population": "unjam:astazero"},
    "human drivers without noise": {"noise": 0.0},
    "CAV without delay and lag": {"actuator": Actuator()},
    "CAV with a delay of 0.4 s and a lag of 0.6 s": {"actuator": Actuator(delay=0.4, lag=0.6)},
}
"""changes to the scenario by name: each changes one assumption on which the savings may depend"""
PLATOONS = {cavs: " ".join([f"cav human*{24 // cavs - 1}"] * cavs) for cavs in (1, 2, 4)}
"""platoons of 24 vehicles by number of CAVs"""
PLATOONS_PART = "several CAVs"
WAVE_METRICS = ("amplification_long", "amplification_medium", "amplification_short")
RECORDED_STUDY = "recorded-roads"
RECORDINGS_FOLDER = "recordings/i24"
"""folder of the drives, in the folder of all studies"""
PUBLISHED_LABEL, LATER_LABEL = "published", "published, later version"
PUBLISHED_FILES = {PUBLISHED_LABEL: "recordings/model.onnx", LATER_LABEL: "recordings/later/model.onnx"}
"""files in the folder of all studies: controllers/cra/model.onnx of CIRCLES-consortium/algos-stack, from its branches
`master` and `cra_08_04`"""
PUBLISHED_DESCRIPTION = PolicyDescription(tuple(map(PolicyInput, ("speed", "leader_speed", "leader_gap"))))
TRAINING_MONTH, TEST_MONTH = "2021-03", "2021-04"
TIME_STEP = 0.1
TUNED_SET_SPEED = 45.0
"""set speed of tuned drivers, above all recorded speeds [m/s]"""
MOTORWAY_TIME_GAPS = (0.4, 0.6, 0.8)
SPEED_CONTROL_TIME = 0.6
"""time in which the speed controllers of cars, and the published controller, reach a commanded speed [s]"""
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
"""settings of the CAV that follows a plan"""
SEARCH_BUDGET = SearchBudget()
PLAN_LABEL = "plan that knows the recording"
RING_DRIVER = "pi"
"""expert of the paper on rings, which is only compared behind the drives"""
DRIVES_PARTS = {TRAINING_DRIVES_PART: TRAINING_MONTH, TEST_DRIVES_PART: TEST_MONTH}
PLATOON_METRICS = (*WAVE_METRICS, "fuel_by_power", "outflow_veh_per_h")
SETTING_METRICS = "fuel_by_power", "cav_mean_gap", "min_time_gap", "feasibility"
SUMO_METRICS = ("fuel_ml_per_km", "fuel_by_power")


@dataclass(frozen=True)
class PublishedController(Driver):
    """The published controller of the CIRCLES experiment: a FollowerStopper limits the acceleration of a network."""

    file: str
    """path of the ONNX graph of the network"""

    @cached_property
    def network(self) -> Driver:
        """The network for one vehicle at a time, because the later version mixes the rows of its input."""
        path = Path(self.file)
        model = parse_model(path.read_bytes())
        model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1
        graph = np.frombuffer(model.SerializeToString(), np.uint8)
        return OnnxDriver(path.name, PUBLISHED_DESCRIPTION, time_step=TIME_STEP, graph=graph)

    @cached_property
    def stopper(self) -> FollowerStopper:
        """The FollowerStopper with parameters for motorways."""
        return FollowerStopper(boundary_time_gaps=MOTORWAY_TIME_GAPS, time_constant=SPEED_CONTROL_TIME)

    def initial_memory(self, n: int) -> Memory:
        """Return no memory."""
        return {}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the FollowerStopper towards the speed that the network commands."""
        acceleration, _ = self.network.act(state, self.network.initial_memory(len(state.speed)))
        return self.stopper.acceleration(state, state.speed + SPEED_CONTROL_TIME * acceleration), memory


def recorded_drives(folder: Path, month: str = TRAINING_MONTH) -> list[Recorded]:
    """Return a scenario for each drive of a month; raise `InputError` if there are none."""
    path = folder / RECORDINGS_FOLDER
    files = sorted(path.glob(f"{month}*"))
    if not files:
        raise InputError(
            f"{RECORDED_STUDY}: {path} has no drives of {month}; download them: https://doi.org/10.5281/zenodo.6366761"
        )
    return [Recorded(recordings=str(file)) for file in files]


def untuned_driver(method: str) -> Driver:
    """Return a driver with the parameters before the search."""
    return SmoothACC(time_step=TIME_STEP) if method == "smooth-acc" else ACC(set_speed=TUNED_SET_SPEED)


def tune_driver(folder: str, method: str, workers: int) -> Table:
    """Return the best candidate of a method on the training drives after each generation."""
    drives = recorded_drives(Path(folder))
    return search_parameters(drives, untuned_driver(method), SEARCH_SPACES[method], SEARCH_BUDGET)


def tuned_name(rows: Table, method: str) -> str:
    """Return the tuned driver as a name for the command line."""
    fixed = {"set_speed": TUNED_SET_SPEED} if method == "acc" else {}
    return f"{method}:" + ",".join(f"{key}={value:g}" for key, value in {**fixed, **rows[-1]["parameters"]}.items())


def measure_driver(folder: str, month: str, setting: str, name: str, workers: int) -> Table:
    """Return the metrics of a driver behind each drive of a month with changed assumptions, one row for each drive."""
    scenarios = [replace(drive, **DRIVE_SETTINGS[setting]) for drive in recorded_drives(Path(folder), month)]
    if name == PLAN_LABEL:
        scenarios = [replace(scenario, **IDEAL_CAR) for scenario in scenarios]
        driver = plan_driver(scenarios)
    else:
        driver = compared_driver(Path(folder), name)
    rows = _measure_in_batches(scenarios, driver)
    metrics = DRIVE_METRICS if setting == STANDARD_SETTING else SETTING_METRICS
    return _drive_rows(name, scenarios, rows, metrics)


def measure_platoon(folder: str, cavs: int, name: str, workers: int) -> Table:
    """Return the waves, fuel and flow of a platoon with several CAVs behind each training drive."""
    scenarios = [replace(drive, platoon=PLATOONS[cavs]) for drive in recorded_drives(Path(folder))]
    driver = compared_driver(Path(folder), name)
    rows = _measure_in_batches(scenarios, driver)
    return [{"cavs": cavs, **row} for row in _drive_rows(name, scenarios, rows, PLATOON_METRICS)]


def _measure_in_batches(scenarios: Sequence[Recorded], driver: Driver) -> Table:
    rows = [measure(episode) for episode in run_batches([EpisodeTask(road, driver, (0,)) for road in scenarios])]
    raise_failure(rows)
    return rows


def measure_fuel_in_sumo(folder: str, month: str, name: str, workers: int) -> Table:
    """Return the fuel of the platoon by SUMO's emission model behind each drive of a month."""
    scenarios, driver = recorded_drives(Path(folder), month), compared_driver(Path(folder), name)
    rows = [measure(run_episode(scenario, driver, (0,), record_details=True)) for scenario in scenarios]
    raise_failure(rows)
    return _drive_rows(name, scenarios, rows, SUMO_METRICS)


def compared_driver(folder: Path, name: str) -> Driver:
    """Return a driver by its name in tables."""
    if name in PUBLISHED_FILES:
        return PublishedController(str(folder / PUBLISHED_FILES[name]))
    return make_driver(name, TIME_STEP)


def _drive_rows(name: str, scenarios: Sequence[Recorded], rows: Table, metrics: Sequence[str]) -> Table:
    label = _short_label(name) if name.endswith(SUFFIX) else name
    return [
        {"driver": label, "drive": Path(scenario.recordings).stem, **{metric: row[metric] for metric in metrics}}
        for scenario, row in zip(scenarios, rows, strict=True)
    ]


def plan_driver(scenarios: list[Recorded]) -> PlannedDriver:
    """Return a driver that follows a fuel-optimal plan for each road."""
    roads = [cast(RecordedRoad, scenario.draw_from_seed((0,))[0]) for scenario in scenarios]
    gaps = [float(np.diff(road.start_positions[-2:])[0]) - VEHICLE_LENGTH for road in roads]
    speeds = [road.replayed_speeds for road in roads]
    return PlannedDriver(tuple(plan_speeds(speeds, gaps, TIME_STEP, PlanLimits())), TIME_STEP)


def make_recorded_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return the searches for parameters, after them the trainings, and after these the evaluations of all drivers."""
    root, folder = str(study_folder.folder), study_folder.folder / RECORDED_STUDY
    parts: dict[str, StudyPart] = {f"{SEARCH_PART} {method}": (tune_driver, (root, method)) for method in SEARCH_SPACES}
    if not all((folder / f"{part}.json").is_file() for part in parts):
        return parts
    tuned = [tuned_name(read_part(folder, f"{SEARCH_PART} {method}"), method) for method in SEARCH_SPACES]
    recorded_drives(study_folder.folder, TEST_MONTH)  # raises before the trainings if test drives are missing
    drives = str(study_folder.folder / RECORDINGS_FOLDER / f"{TRAINING_MONTH}*")
    runs = planned_residuals(folder / RESIDUALS_PART, drives, tuned[0], seeds)
    parts |= {f"{RESIDUALS_PART}/{run.name}": (train_residual, (run,)) for run in runs}
    if not all(run.controller.is_file() for run in runs):
        return parts
    names = (HUMAN_LABEL, STOPPER, PUBLISHED_LABEL, *tuned)
    drivers = (*names, RING_DRIVER, PLAN_LABEL, *(str(run.controller) for run in runs))
    for (part, month), name in product(DRIVES_PARTS.items(), drivers):
        parts[f"{part}/{_short_label(name)}"] = measure_driver, (root, month, STANDARD_SETTING, name)
    for cavs, name in product(PLATOONS, (HUMAN_LABEL, tuned[0])):
        parts[f"{PLATOONS_PART}/{cavs}-{_short_label(name)}"] = measure_platoon, (root, cavs, name)
    for name in names:
        parts[f"{SUMO_FUEL_PART}/{_short_label(name)}"] = measure_fuel_in_sumo, (root, TEST_MONTH, name)
        for setting in DRIVE_SETTINGS:
            if setting != STANDARD_SETTING:
                parts[f"{setting}/{_short_label(name)}"] = measure_driver, (root, TEST_MONTH, setting, name)
    return parts


def _short_label(name: str) -> str:
    """Return the name of a driver without parameters, or the name of the file of a trained controller."""
    return Path(name).stem if name.endswith(SUFFIX) else name.partition(":")[0]


@dataclass(frozen=True)
class DriveResults:
    """Metrics of drivers behind the same drives; all trainings with the same label are one driver."""

    rows: Table

    def groups(self) -> dict[str, Table]:
        """Return the rows of each driver by label."""
        groups: dict[str, Table] = {}
        for row in self.rows:
            label, _, seed = row["driver"].rpartition(" ")
            trained = f"{TUNED_METHOD} and residual {label}"
            groups.setdefault(trained if seed.isdigit() else row["driver"], []).append(row)
        return groups

    def values(self, label: str, metric: str) -> Floats:
        """Return a metric of a driver, shape (trainings, drives)."""
        rows, count = self.groups()[label], len({row["drive"] for row in self.rows})
        return np.array([row[metric] for row in rows], np.float64).reshape(-1, count)

    def change(self, label: str, metric: str, is_relative: bool = True, baseline: str = HUMAN_LABEL) -> Floats:
        """Return the difference to a baseline, in percent of human drivers if relative, shape (trainings, drives)."""
        human = self.values(HUMAN_LABEL, metric)
        scale = human / 100.0 if is_relative else 1.0
        return (self.values(label, metric) - self.values(baseline, metric)) / scale

    def change_text(self, label: str, metric: str, is_relative: bool = True, baseline: str = HUMAN_LABEL) -> str:
        """Return the mean difference with its 95 % CI over drives and trainings; a dash for baselines."""
        if label in (HUMAN_LABEL, baseline):
            return NO_VALUE_TEXT
        values = self.change(label, metric, is_relative, baseline)
        return estimate_text(estimate_on_shared_seeds(values), 2, "+")


def _heading(label: str) -> str:
    """Return the name of a driver in tables: `METHOD, tuned`, or without parameters."""
    method, _, parameters = label.partition(":")
    return f"{method}, tuned" if parameters and method in SEARCH_SPACES else method


def drivers_table(part: str, folder: Path) -> pd.DataFrame:
    """Return fuel, gaps, lost time and flow of the drivers behind drives, compared with human drivers."""
    results = DriveResults(read_part(folder, part))
    tuned = next(label for label in results.groups() if label.partition(":")[0] == TUNED_METHOD)
    table: Table = []
    for label, rows in results.groups().items():
        reasons = (row["feasibility"] for row in rows if row["feasibility"] not in (None, "", FEASIBLE))
        gap, gap_95, largest = (results.values(label, f"cav_{name}") for name in ("mean_gap", "gap_95", "max_gap"))
        cells = {"driver": _heading(label), "fuel of the platoon [%]": results.change_text(label, "fuel_by_power")}
        difference = results.change_text(label, "fuel_by_power", baseline=tuned)
        cells[f"difference to {TUNED_METHOD} [points]"] = difference
        cells["fuel of the CAV [%]"] = results.change_text(label, "cav_fuel_by_power")
        cells["gap: mean / 95 % / largest [m]"] = f"{gap.mean():.0f} / {gap_95.mean():.0f} / {largest.max():.0f}"
        cells["smallest time gap [s]"] = f"{results.values(label, 'min_time_gap').min():.2f}"
        cells["lost time [s]"] = results.change_text(label, "time_behind_leader", is_relative=False)
        cells["flow [%]"] = results.change_text(label, "outflow_veh_per_h")
        table.append({**cells, "feasible": next(reasons, "yes")})
    return pd.DataFrame(table)


def waves_table(folder: Path) -> pd.DataFrame:
    """Return the amplification of waves by period, in the platoon of each driver behind the test drives."""
    results = DriveResults(read_part(folder, TEST_DRIVES_PART))
    table: Table = []
    for label in results.groups():
        cells = {"driver": _heading(label)}
        cells |= {METRICS[name].label: f"{results.values(label, name).mean():.2f}" for name in WAVE_METRICS}
        braking = results.values(label, "cav_max_braking").max()
        cells["hardest braking [m/s²]"] = NO_VALUE_TEXT if label == HUMAN_LABEL else f"{braking:.1f}"
        table.append({**cells, "mean jerk [m/s³]": f"{results.values(label, 'mean_abs_jerk').mean():.2f}"})
    return pd.DataFrame(table)


def platoons_table(folder: Path) -> pd.DataFrame:
    """Return waves at the end of platoons without and with CAVs, and changes of fuel and flow, by number of CAVs."""
    rows, table = read_part(folder, PLATOONS_PART), list[dict[str, Any]]()
    for cavs in PLATOONS:
        results = DriveResults([row for row in rows if row["cavs"] == cavs])
        tuned = next(label for label in results.groups() if label != HUMAN_LABEL)
        cells: dict[str, Any] = {"CAVs among 24 vehicles": cavs}
        for name in WAVE_METRICS:
            human, cav = (results.values(label, name).mean() for label in (HUMAN_LABEL, tuned))
            cells[METRICS[name].label] = f"{human:.2f} → {cav:.2f}"
        cells["fuel of the platoon [%]"] = results.change_text(tuned, "fuel_by_power")
        table.append({**cells, "flow [%]": results.change_text(tuned, "outflow_veh_per_h")})
    return pd.DataFrame(table)


def assumptions_table(folder: Path) -> pd.DataFrame:
    """Return the change of fuel by each driver under other assumptions, and by SUMO's emission model."""
    in_sumo = DriveResults(read_part(folder, SUMO_FUEL_PART))
    labels = [label for label in in_sumo.groups() if label != HUMAN_LABEL]
    parts = {setting: TEST_DRIVES_PART if setting == STANDARD_SETTING else setting for setting in DRIVE_SETTINGS}
    rows = [(name, DriveResults(read_part(folder, part)), "fuel_by_power") for name, part in parts.items()]
    rows.append(("fuel by SUMO's emission model", in_sumo, "fuel_ml_per_km"))
    return pd.DataFrame(
        {"assumption": name, **{_heading(label): results.change_text(label, metric) for label in labels}}
        for name, results, metric in rows
    )


def search_table(folder: Path) -> pd.DataFrame:
    """Return the best candidate of each method after every fifth generation of the search."""
    return pd.DataFrame(
        {
            "method": method,
            "generation": row["generation"] + 1,
            "fuel of the platoon [%]": f"{row['fuel']:+.2f}",
            "mean gap [m]": f"{row['mean_gap']:.0f}",
            "largest gap [m]": f"{row['max_gap']:.0f}",
        }
        for method in SEARCH_SPACES
        for row in read_part(folder, f"{SEARCH_PART} {method}")[4::5]
    )


RECORDED_ROADS = Study(
    title="controllers behind recorded vehicles: fuel of a platoon, and the gaps that it needs",
    make_parts=make_recorded_parts,
    minutes=180.0,
    tables={
        "drivers": partial(drivers_table, TRAINING_DRIVES_PART),
        "test": partial(drivers_table, TEST_DRIVES_PART),
        **{"waves": waves_table, "assumptions": assumptions_table, "search": search_table},
        "residuals": residuals_table,
        "platoons": platoons_table,
    },
)
