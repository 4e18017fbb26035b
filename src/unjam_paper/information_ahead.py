"""Fuel that a CAV behind recorded vehicles saves with received speeds from ahead, by distance and latency.

The recorded vehicle is connected. Human drivers follow it, then the CAV, then other human drivers. The CAV receives the
speed of the recorded vehicle before its waves arrive. Fuel is that of the CAV and of the vehicles behind it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from optuna.distributions import FloatDistribution

from unjam.drivers import Human
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.smooth_acc import SmoothACC, update_mean
from unjam.physics.arrays import Array, Floats
from unjam.scenarios import Recorded
from unjam.scenarios.road import RecordedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.run import run_batches
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.fuel_optimal_plan import PlanLimits, PlannedDriver, plan_speeds
from unjam_paper.parameter_search import RowScores, SearchBudget, measure_candidates, search_parameters
from unjam_paper.recorded_roads import (
    IDEAL_CAR,
    PLAN_LABEL,
    SEARCH_SPACES,
    TEST_DRIVES_PART,
    TEST_MONTH,
    TIME_STEP,
    TRAINING_MONTH,
    recorded_drives,
)
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table, mean_text

VEHICLES_BETWEEN = (10, 20, 40)
"""human drivers between the connected vehicle and the CAV"""
LATENCIES: tuple[float | None, ...] = (None, 0.0, 5.0, 15.0)
"""latencies of the received speed [s]; None: nothing is received"""
FOLLOWERS = 5
"""human drivers behind the CAV"""
VALUE_BUDGET = SearchBudget(generations=10, size=24)
SHARED_SPACE = {name: SEARCH_SPACES["smooth-acc"][name] for name in ("time_gap", "averaging_time", "leader_weight")}
SPACE_AHEAD = {"ahead_weight": FloatDistribution(0, 1), "ahead_averaging_time": FloatDistribution(1, 60, log=True)}
FIXED_PARAMETERS = {
    **{"gap_gain": 0.05, "catch_up_speed": 2.7, "time_constant": 0.3},
    **{"acceleration_limit": 0.53, "braking_limit": 0.36, "largest_gap": 91.0},
}
"""result of the search without information, see `unjam_paper.recorded_roads`"""
INFORMATION_STUDY, VALUE_PART = "information-ahead", "value"


@dataclass(frozen=True, eq=False)
class InformedACC(SmoothACC):
    """Follows a weighted mean of the mean speeds of its leader and of a connected vehicle far ahead."""

    ahead_weight: float = 0.0
    """weight of the mean of the received speeds"""
    ahead_averaging_time: float = 10.0
    """time constant of the exponential mean of the received speeds [s]"""
    received_speeds: Floats = field(default_factory=lambda: np.zeros((1, 1)), repr=False)
    """speeds by control step and road, shape (steps, n) [m/s]"""

    def initial_memory(self, n: int) -> Memory:
        """Return the initial memory of `SmoothACC`, no received speed, and the index of the first step."""
        return {**super().initial_memory(n), "mean_received_speed": np.full(n, np.nan), "step": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the accelerations and the new memory; rows are the roads of each candidate in turn."""
        step = min(int(memory["step"][0]), len(self.received_speeds) - 1)
        received = np.tile(self.received_speeds[step], len(state.speed) // self.received_speeds.shape[1])
        ahead = update_mean(memory["mean_received_speed"], received, self.ahead_averaging_time, self.time_step)
        mean = update_mean(memory["mean_leader_speed"], state.leader_speed, self.averaging_time, self.time_step)
        new_memory = {"mean_leader_speed": mean, "mean_received_speed": ahead, "step": memory["step"] + 1.0}
        return self.acceleration_from_mean(mean + self.ahead_weight * (ahead - mean), state), new_memory


def received_speeds(scenarios: list[Recorded], latency: float) -> Floats:
    """Return the speeds of the first vehicles that are received with a latency [s], shape (steps, roads) [m/s]."""
    roads = [cast(RecordedRoad, scenario.draw_from_seed((0,))[0]) for scenario in scenarios]
    replayed, delay = [road.replayed_speeds for road in roads], round(latency / TIME_STEP)
    longest = max(map(len, replayed))
    return np.stack([np.pad(speeds, (delay, longest - len(speeds)), "edge") for speeds in replayed], 1)


def roads_with_vehicles_between(folder: Path, count: int, month: str = TRAINING_MONTH) -> list[Recorded]:
    """Return the drives of a month with `count` human drivers between the recorded vehicle and the CAV."""
    platoon = f"human*{count} cav human*{FOLLOWERS}"
    return [replace(drive, platoon=platoon) for drive in recorded_drives(folder, month)]


def informed_driver(scenarios: list[Recorded], latency: float | None, parameters: Mapping[str, float]) -> InformedACC:
    """Return the controller with these parameters, which receives the speeds of the first vehicles with a latency."""
    received = np.zeros((1, len(scenarios))) if latency is None else received_speeds(scenarios, latency)
    return InformedACC(**{**FIXED_PARAMETERS, **parameters}, time_step=TIME_STEP, received_speeds=received)


def measure_value(folder: str, count: int, latency: float | None, workers: int) -> Table:
    """Return the best parameters for a distance and a latency on the training drives, as a list of one row."""
    scenarios = roads_with_vehicles_between(Path(folder), count)
    space = SHARED_SPACE if latency is None else SHARED_SPACE | SPACE_AHEAD
    best = search_parameters(scenarios, informed_driver(scenarios, latency, {}), space, VALUE_BUDGET)[-1]
    return [{"between": count, "latency": latency, **best}]


def measure_test_value(folder: str, count: int, tuned: dict[float | None, dict[str, float]], workers: int) -> Table:
    """Return the fuel on each test drive, with the tuned parameters of each latency, and by the plan."""
    scenarios = roads_with_vehicles_between(Path(folder), count, TEST_MONTH)
    human = measure_candidates(scenarios, Human())
    scores: dict[float | str | None, RowScores] = {
        latency: measure_candidates(scenarios, informed_driver(scenarios, latency, parameters))
        for latency, parameters in tuned.items()
    }
    ideal_scenarios = [replace(scenario, **IDEAL_CAR) for scenario in scenarios]
    scores[PLAN_LABEL] = measure_candidates(ideal_scenarios, plan_behind_humans(ideal_scenarios))
    return [
        {
            **{"between": count, "latency": latency, "by_drive": (100.0 * (score.fuel / human.fuel - 1.0))[0].tolist()},
            **{"mean_gap": float(score.mean_gap.mean()), "max_gap": float(score.max_gap.max())},
        }
        for latency, score in scores.items()
    ]


def plan_behind_humans(scenarios: list[Recorded]) -> PlannedDriver:
    """Return the plan of a CAV that knows the future speeds of its leader, which do not depend on the CAV."""
    speeds, gaps = list[Floats](), list[float]()
    for episode in run_batches([EpisodeTask(scenario, Human(), (0,)) for scenario in scenarios]):
        speeds.append(episode.speeds[:, FOLLOWERS + 1])
        positions = episode.positions[0]
        gaps.append(float(positions[FOLLOWERS + 1] - positions[FOLLOWERS]) - VEHICLE_LENGTH)
    return PlannedDriver(tuple(plan_speeds(speeds, gaps, TIME_STEP, PlanLimits())), TIME_STEP)


def make_value_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return a search for each distance and latency, and after the searches the test drives for each distance."""
    root, folder = str(study_folder.folder), study_folder.folder / INFORMATION_STUDY
    parts: dict[str, StudyPart] = {
        f"{VALUE_PART}/{count} {latency}": (measure_value, (root, count, latency))
        for count, latency in product(VEHICLES_BETWEEN, LATENCIES)
    }
    if not (folder / f"{VALUE_PART}.json").is_file():
        return parts
    for count in VEHICLES_BETWEEN:
        tuned = {row["latency"]: row["parameters"] for row in read_part(folder, VALUE_PART) if row["between"] == count}
        parts[f"{TEST_DRIVES_PART}/{count}"] = measure_test_value, (root, count, tuned)
    return parts


def value_table(folder: Path) -> pd.DataFrame:
    """Return the savings on the test drives by distance and latency, and their difference to no information."""
    rows, table = read_part(folder, TEST_DRIVES_PART), list[dict[str, str]]()
    by_case = {(row["between"], row["latency"]): np.array(row["by_drive"]) for row in rows}
    names = {None: "nothing received", PLAN_LABEL: PLAN_LABEL}
    for (between, latency), changes in by_case.items():
        cells = {"vehicles between": str(between), "latency [s]": names.get(latency) or f"{latency:g}"}
        cells["fuel [%]"] = mean_text(changes, 2, "+")
        difference = mean_text(changes - by_case[between, None], 2, "+")
        cells["difference to nothing received"] = NO_VALUE_TEXT if latency is None else difference
        cells["share of the plan's saving"] = f"{changes.mean() / by_case[between, PLAN_LABEL].mean():.2f}"
        table.append(cells)
    gaps = [f"{row['mean_gap']:.0f} / {row['max_gap']:.0f}" for row in rows]
    return pd.DataFrame(table).assign(**{"gap: mean / largest [m]": gaps})


INFORMATION_AHEAD = Study(
    title="value of speeds from ahead behind recorded vehicles, by distance and latency",
    make_parts=make_value_parts,
    minutes=75.0,
    tables={"value": value_table},
)
