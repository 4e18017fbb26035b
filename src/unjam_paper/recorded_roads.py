"""Controllers behind recorded vehicles: fuel that they save in a platoon, and the gaps that they need for it.

The recordings are drives on I-24 (10.5281/zenodo.6366761). Those of March 2021 are for tuning; those of April are test
drives, which no part of this study reads yet.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from optuna.distributions import FloatDistribution

from unjam.controller import make_driver
from unjam.drivers.car_following import ACC, FollowerStopper
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.smooth_acc import SmoothACC
from unjam.errors import InputError
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.physics.arrays import Array, Floats
from unjam.recordings.leaders import recording_files
from unjam.scenarios import Recorded
from unjam.scenarios.road import RecordedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.training.evaluate import raise_failure
from unjam.worlds.batch.run import run_batches
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.fuel_optimal_plan import PlanLimits, PlannedDriver, plan_speeds
from unjam_paper.parameter_search import SearchBudget, measure_candidates, search_parameters
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table

RECORDED_STUDY = "recorded-roads"
RECORDINGS_FOLDER, PUBLISHED_FILE = "recordings/i24", "recordings/model.onnx"
"""in the folder of all studies: the drives, and controllers/cra/model.onnx of CIRCLES-consortium/algos-stack"""
TRAINING_MONTH = "2021-03"
TIME_STEP = 0.1
TUNED_SET_SPEED = 45.0
"""above all recorded speeds [m/s]"""
MOTORWAY_TIME_GAPS = (0.4, 0.6, 0.8)
SPEED_CONTROL_TIME = 0.6
"""time in which the speed controller of a car reaches a commanded speed; of the published controller, too [s]"""
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
    *("mean_abs_jerk", "filter_override_share", "feasibility"),
)
SEARCH_SEED, SEARCH_BUDGET = 0, SearchBudget()
PUBLISHED_LABEL, PLAN_LABEL = "published", "plan that knows the recording"
SEARCH_PART, DRIVES_PART = "search", "training drives"


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


def training_drives(folder: Path) -> list[Recorded]:
    """Return a road for each drive of March; raise `InputError` if the drives are missing."""
    path = folder / RECORDINGS_FOLDER
    found = [file for file in recording_files(path) if file.name.startswith(TRAINING_MONTH)] if path.is_dir() else []
    if not found:
        raise InputError(
            f"{RECORDED_STUDY}: {path} has no drives; download them: https://doi.org/10.5281/zenodo.6366761"
        )
    return [Recorded(recordings=str(file)) for file in found]


def untuned_driver(method: str) -> Driver:
    """Return a driver before the search of its parameters."""
    return SmoothACC(time_step=TIME_STEP) if method == "smooth-acc" else ACC(set_speed=TUNED_SET_SPEED)


def tune_driver(folder: str, method: str, workers: int) -> Table:
    """Return the best candidates of a method after each generation, on the training drives."""
    scenarios = training_drives(Path(folder))
    human = measure_candidates(scenarios, make_driver(HUMAN_LABEL, TIME_STEP))
    return search_parameters(
        scenarios, untuned_driver(method), SEARCH_SPACES[method], human, SEARCH_SEED, SEARCH_BUDGET
    )


def tuned_name(rows: Table, method: str) -> str:
    """Return the tuned driver as on the command line."""
    fixed = {"set_speed": TUNED_SET_SPEED} if method == "acc" else {}
    values = ",".join(f"{key}={value:g}" for key, value in {**fixed, **rows[-1]["parameters"]}.items())
    return f"{method}:{values}"


def measure_driver(folder: str, name: str, workers: int) -> Table:
    """Return the metrics of a driver behind each training drive, one row for each."""
    scenarios, driver = training_drives(Path(folder)), None
    if name == PLAN_LABEL:
        ideal = {"actuator": Actuator(), "safety": SafetyFilter(active=False), "actuation": "raw"}
        scenarios = [replace(each, **ideal) for each in scenarios]
        driver = plan_driver(scenarios)
    elif name == PUBLISHED_LABEL:
        driver = PublishedController(str(Path(folder) / PUBLISHED_FILE))
    made = driver or make_driver(name, TIME_STEP)
    rows = [measure(episode) for episode in run_batches([EpisodeTask(each, made, (0,)) for each in scenarios])]
    raise_failure(rows)
    drives = (Path(each.recordings).stem for each in scenarios)
    metrics = ({name: row[name] for name in DRIVE_METRICS} for row in rows)
    return [{"driver": name, "drive": drive, **row} for drive, row in zip(drives, metrics, strict=True)]


def plan_driver(scenarios: list[Recorded]) -> PlannedDriver:
    """Return a driver that follows a fuel-optimal plan for each road."""
    roads = [cast(RecordedRoad, each.draw_from_seed((0,))[0]) for each in scenarios]
    gaps = [float(np.diff(road.start_positions[-2:])[0]) - VEHICLE_LENGTH for road in roads]
    speeds = [road.replayed_speeds for road in roads]
    return PlannedDriver(tuple(plan_speeds(speeds, gaps, TIME_STEP, PlanLimits())), TIME_STEP)


def make_recorded_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return the searches of parameters, and then the drivers behind the training drives."""
    root, folder = str(study_folder.folder), study_folder.folder / RECORDED_STUDY
    parts: dict[str, StudyPart] = {f"{SEARCH_PART} {method}": (tune_driver, (root, method)) for method in SEARCH_SPACES}
    if not all((folder / f"{part}.json").is_file() for part in parts):
        return parts
    tuned = [tuned_name(read_part(folder, f"{SEARCH_PART} {method}"), method) for method in SEARCH_SPACES]
    gaps = ",".join(map(str, MOTORWAY_TIME_GAPS))
    stopper = f"follower-stopper:window={TIME_STEP:g},boundary_time_gaps=[{gaps}],time_constant={SPEED_CONTROL_TIME:g}"
    names = (HUMAN_LABEL, stopper, PUBLISHED_LABEL, *tuned, PLAN_LABEL)
    return parts | {f"{DRIVES_PART}/{name.partition(':')[0]}": (measure_driver, (root, name)) for name in names}


def drivers_table(folder: Path) -> pd.DataFrame:
    """Return fuel, gaps, lost time and flow of the drivers behind the training drives, compared with human drivers."""
    rows = read_part(folder, DRIVES_PART)
    names = dict.fromkeys(row["driver"] for row in rows)
    by_driver = {name: pd.DataFrame([row for row in rows if row["driver"] == name]) for name in names}
    human = by_driver[HUMAN_LABEL]
    return pd.DataFrame([_table_row(name, own, human) for name, own in by_driver.items()])


def _table_row(name: str, own: pd.DataFrame, human: pd.DataFrame) -> dict[str, str]:
    def change(metric: str, relative: bool) -> str:
        values, base = own[metric].to_numpy(np.float64), human[metric].to_numpy(np.float64)
        difference: Floats = 100.0 * (values / base - 1.0) if relative else values - base
        is_same = name == HUMAN_LABEL
        return NO_VALUE_TEXT if is_same else str(estimate_cell(estimate(difference.tolist()), 2, sign="+"))

    reasons = [text for text in own["feasibility"] if text and text != FEASIBLE]
    gaps = own["cav_mean_gap"].mean(), own["cav_gap_95"].mean(), own["cav_max_gap"].max()
    return {
        "driver": name,
        "fuel of the platoon [%]": change("fuel_by_power", relative=True),
        "fuel of the CAV [%]": change("cav_fuel_by_power", relative=True),
        "gap: mean / 95 % / largest [m]": " / ".join(f"{each:.0f}" for each in gaps),
        "smallest time gap [s]": f"{own['min_time_gap'].min():.2f}",
        "lost time [s]": change("time_behind_leader", relative=False),
        "flow [%]": change("outflow_veh_per_h", relative=True),
        "feasible": reasons[0] if reasons else "yes",
    }


def search_table(folder: Path) -> pd.DataFrame:
    """Return the best candidate of each method after some generations of the search."""
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
    minutes=25.0,
    tables={"drivers": drivers_table, "search": search_table},
)
