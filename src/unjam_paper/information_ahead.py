"""What speeds from ahead are worth to a CAV behind recorded vehicles, by distance and latency.

The recorded vehicle is connected. Human drivers follow it, then the CAV, then other human drivers: the CAV receives the
speed of the first vehicle before its waves arrive. Fuel counts from the CAV on.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from optuna.distributions import FloatDistribution

from unjam.controller import make_driver
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.smooth_acc import SmoothACC, update_mean
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import estimate
from unjam.physics.arrays import Array, Floats
from unjam.scenarios import Recorded
from unjam.scenarios.road import RecordedRoad
from unjam_paper.parameter_search import RowScores, SearchBudget, measure_candidates, search_parameters
from unjam_paper.recorded_roads import SEARCH_SEED, SEARCH_SPACES, TIME_STEP, recorded_drives
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table

VEHICLES_BETWEEN = (10, 20, 40)
"""human drivers between the connected vehicle and the CAV"""
LATENCIES: tuple[float | None, ...] = (None, 0.0, 5.0, 15.0)
"""of the received speed [s]; None: nothing is received"""
FOLLOWERS = 5
VALUE_BUDGET = SearchBudget(generations=10, size=24)
SHARED_SPACE = {name: SEARCH_SPACES["smooth-acc"][name] for name in ("time_gap", "averaging_time", "leader_weight")}
SPACE_AHEAD = {
    "ahead_weight": FloatDistribution(0.0, 1.0),
    "ahead_averaging_time": FloatDistribution(1.0, 60.0, log=True),
}
FIXED_PARAMETERS = {
    **{"gap_gain": 0.05, "catch_up_speed": 2.7, "time_constant": 0.3},
    **{"acceleration_limit": 0.53, "braking_limit": 0.36, "largest_gap": 91.0},
}
"""of the search without information, see `unjam_paper.recorded_roads`"""
PART = "value"


@dataclass(frozen=True, eq=False)
class InformedACC(SmoothACC):
    """Replaces a part of the leader's mean speed by the mean of received speeds of a vehicle far ahead."""

    ahead_weight: float = 0.0
    """share of the received mean"""
    ahead_averaging_time: float = 10.0
    """time constant of its exponential mean [s]"""
    received_speeds: Floats = field(default_factory=lambda: np.zeros((1, 1)), repr=False)
    """in each control step on each of the n roads [m/s], shape (steps, n)"""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory without information, and the first step."""
        return {**super().initial_memory(n), "mean_received_speed": np.full(n, np.nan), "step": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration, and the new memory; rows are those of all roads, for one candidate after another."""
        step = min(int(memory["step"][0]), len(self.received_speeds) - 1)
        received = np.tile(self.received_speeds[step], len(state.speed) // self.received_speeds.shape[1])
        ahead = update_mean(memory["mean_received_speed"], received, self.ahead_averaging_time, self.time_step)
        mean = update_mean(memory["mean_leader_speed"], state.leader_speed, self.averaging_time, self.time_step)
        after = {"mean_leader_speed": mean, "mean_received_speed": ahead, "step": memory["step"] + 1.0}
        return self.acceleration_from_mean(mean + self.ahead_weight * (ahead - mean), state), after


def received_speeds(scenarios: list[Recorded], latency: float) -> Floats:
    """Return the speeds of the first vehicle as received with a latency [s], in all control steps [m/s]."""
    roads = [cast(RecordedRoad, each.draw_from_seed((0,))[0]) for each in scenarios]
    speeds, delay = [road.replayed_speeds for road in roads], round(latency / TIME_STEP)
    longest = max(map(len, speeds))
    return np.stack([np.pad(each, (delay, longest - len(each)), "edge") for each in speeds], 1)


def roads_with_vehicles_between(folder: Path, count: int) -> list[Recorded]:
    """Return the training drives with `count` human drivers between the recorded vehicle and the CAV."""
    return [replace(each, platoon=f"human*{count} cav human*{FOLLOWERS}") for each in recorded_drives(folder)]


def measure_value(folder: str, count: int, latency: float | None, workers: int) -> Table:
    """Return the best parameters with a latency, and what they save on each drive, as a list of one row."""
    scenarios = roads_with_vehicles_between(Path(folder), count)
    human = measure_candidates(scenarios, make_driver(HUMAN_LABEL, TIME_STEP))
    received = np.zeros((1, len(scenarios))) if latency is None else received_speeds(scenarios, latency)
    driver = InformedACC(**FIXED_PARAMETERS, time_step=TIME_STEP, received_speeds=received)
    space = SHARED_SPACE if latency is None else SHARED_SPACE | SPACE_AHEAD
    best = search_parameters(scenarios, driver, space, human, SEARCH_SEED, VALUE_BUDGET)[-1]
    scores = measure_candidates(scenarios, replace(driver, **best["parameters"]))
    return [{"between": count, "latency": latency, **best, "by_drive": _fuel_changes(scores, human)}]


def _fuel_changes(scores: RowScores, human: RowScores) -> list[float]:
    """Return the fuel relative to human drivers on each drive [%]."""
    return (100.0 * (scores.fuel / human.fuel - 1.0))[0].tolist()


def make_value_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return a part for each distance and latency."""
    root = str(study_folder.folder)
    return {
        f"{PART}/{count} {latency}": (measure_value, (root, count, latency))
        for count, latency in product(VEHICLES_BETWEEN, LATENCIES)
    }


def value_table(folder: Path) -> pd.DataFrame:
    """Return what the CAV saves by distance and latency, and the difference to no information, paired by drive."""
    rows = read_part(folder, PART)
    without = {row["between"]: np.array(row["by_drive"]) for row in rows if row["latency"] is None}
    return pd.DataFrame(_value_row(row, without[row["between"]]) for row in rows)


def _value_row(row: dict[str, Any], without: Floats) -> dict[str, str]:
    changes, cell = np.array(row["by_drive"]), partial(estimate_cell, digits=2, sign="+")
    is_informed = row["latency"] is not None
    return {
        "vehicles between": str(row["between"]),
        "latency [s]": f"{row['latency']:g}" if is_informed else "nothing received",
        "fuel [%]": str(cell(estimate(changes.tolist()))),
        "difference to nothing received": str(cell(estimate((changes - without).tolist())))
        if is_informed
        else NO_VALUE_TEXT,
        "gap: mean / largest [m]": f"{row['mean_gap']:.0f} / {row['max_gap']:.0f}",
        "share of the received speed": f"{row['parameters'].get('ahead_weight', 0.0):.2f}",
    }


INFORMATION_AHEAD = Study(
    title="value of speeds from ahead behind recorded vehicles, by distance and latency",
    make_parts=make_value_parts,
    minutes=60.0,
    tables={"value": value_table},
)
