"""Tables of the study of recorded roads: drivers, waves, assumptions, residuals and the search of parameters."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.drivers.safety import Actuator
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.physics.arrays import Floats
from unjam_paper.recorded_residuals import MODEL_RATIOS
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, Table, trainings_text

TUNED_METHODS = ("smooth-acc", "acc")
"""laws with parameters that the study searches"""
TUNED_METHOD = "smooth-acc"
"""the law that residuals are added to"""
SEARCH_PART, RESIDUALS_PART, TRAINING_DRIVES_PART, TEST_DRIVES_PART = (
    "search",
    "residuals",
    "training drives",
    "test drives",
)
SUMO_FUEL_PART = "in SUMO"
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
"""assumptions on which the saving may depend, each changed alone"""
WAVE_METRICS = ("amplification_long", "amplification_medium", "amplification_short")


@dataclass(frozen=True)
class DriveResults:
    """The metrics of drivers behind the same drives; several trainings are one driver."""

    rows: Table

    def groups(self) -> dict[str, Table]:
        """Return the rows of each driver, with those of all trainings together."""
        groups: dict[str, Table] = {}
        for row in self.rows:
            label, _, seed = row["driver"].rpartition(" ")
            trained = f"{TUNED_METHOD} and residual {label}"
            groups.setdefault(trained if seed.isdigit() else row["driver"], []).append(row)
        return groups

    def values(self, label: str, metric: str) -> Floats:
        """Return a metric of a driver, shape (trainings, drives)."""
        own, count = self.groups()[label], len({row["drive"] for row in self.rows})
        return np.array([row[metric] for row in own], np.float64).reshape(-1, count)

    def change(self, label: str, metric: str, is_relative: bool = True, baseline: str = HUMAN_LABEL) -> Floats:
        """Return the change from human drivers, minus that of another baseline, shape (trainings, drives)."""
        human = self.values(HUMAN_LABEL, metric)
        scale = human / 100.0 if is_relative else 1.0
        return (self.values(label, metric) - self.values(baseline, metric)) / scale

    def change_text(self, label: str, metric: str, is_relative: bool = True, baseline: str = HUMAN_LABEL) -> str:
        """Return the mean change with its 95 % CI over drives and trainings; a dash for the baseline itself."""
        if label in (HUMAN_LABEL, baseline):
            return NO_VALUE_TEXT
        values = self.change(label, metric, is_relative, baseline)
        return str(estimate_cell(estimate_on_shared_seeds(values), 2, sign="+"))

    def label_of(self, method: str) -> str:
        """Return the label of the driver with the parameters that were tuned."""
        return next(label for label in self.groups() if label.partition(":")[0] == method)


def _short_name(label: str) -> str:
    """Return the name of a driver without its parameters, and whether they were tuned."""
    method, _, parameters = label.partition(":")
    return f"{method}, tuned" if parameters and method in TUNED_METHODS else method


def drivers_table(part: str, folder: Path) -> pd.DataFrame:
    """Return fuel, gaps, lost time and flow of the drivers behind drives, compared with human drivers."""
    results = DriveResults(read_part(folder, part))
    tuned = results.label_of(TUNED_METHOD)
    return pd.DataFrame(_driver_row(results, label, own, tuned) for label, own in results.groups().items())


def _driver_row(results: DriveResults, label: str, own: Table, tuned: str) -> dict[str, Any]:
    reasons = [row["feasibility"] for row in own if row["feasibility"] and row["feasibility"] != FEASIBLE]
    gap, gap_95, largest = (results.values(label, f"cav_{name}") for name in ("mean_gap", "gap_95", "max_gap"))
    return {
        "driver": _short_name(label),
        "fuel of the platoon [%]": results.change_text(label, "fuel_by_power"),
        f"difference to {TUNED_METHOD} [points]": results.change_text(label, "fuel_by_power", baseline=tuned),
        "fuel of the CAV [%]": results.change_text(label, "cav_fuel_by_power"),
        "gap: mean / 95 % / largest [m]": f"{gap.mean():.0f} / {gap_95.mean():.0f} / {largest.max():.0f}",
        "smallest time gap [s]": f"{results.values(label, 'min_time_gap').min():.2f}",
        "lost time [s]": results.change_text(label, "time_behind_leader", is_relative=False),
        "flow [%]": results.change_text(label, "outflow_veh_per_h"),
        "feasible": reasons[0] if reasons else "yes",
    }


def waves_table(folder: Path) -> pd.DataFrame:
    """Return by how much each driver's platoon amplifies waves, by their period, behind the test drives."""
    results = DriveResults(read_part(folder, TEST_DRIVES_PART))
    return pd.DataFrame(
        {
            "driver": _short_name(label),
            **{METRICS[name].label: f"{results.values(label, name).mean():.2f}" for name in WAVE_METRICS},
            "hardest braking [m/s²]": NO_VALUE_TEXT
            if label == HUMAN_LABEL
            else f"{results.values(label, 'cav_max_braking').max():.1f}",
            "mean jerk [m/s³]": f"{results.values(label, 'mean_abs_jerk').mean():.2f}",
        }
        for label in results.groups()
    )


def assumptions_table(folder: Path) -> pd.DataFrame:
    """Return the change of fuel by each driver under other assumptions, and by SUMO's emission model."""
    in_sumo = DriveResults(read_part(folder, SUMO_FUEL_PART))
    labels = [label for label in in_sumo.groups() if label != HUMAN_LABEL]

    def table_row(setting: str, results: DriveResults, metric: str = "fuel_by_power") -> dict[str, str]:
        cells = {_short_name(label): results.change_text(label, metric) for label in labels}
        return {"assumption": setting, **cells}

    changed = (setting for setting in DRIVE_SETTINGS if setting != STANDARD_SETTING)
    return pd.DataFrame(
        [
            table_row(STANDARD_SETTING, DriveResults(read_part(folder, TEST_DRIVES_PART))),
            *(table_row(setting, DriveResults(read_part(folder, setting))) for setting in changed),
            table_row("fuel by SUMO's emission model", in_sumo, "fuel_ml_per_km"),
        ]
    )


def residuals_table(folder: Path) -> pd.DataFrame:
    """Return the gains of the trainings over their law on validation windows of the training drives."""
    rows = read_part(folder, RESIDUALS_PART)
    groups = {label: [row for row in rows if row["residual"] == label] for label in MODEL_RATIOS}
    return pd.DataFrame(_residual_row(label, own) for label, own in groups.items())


def _residual_row(label: str, own: Table) -> dict[str, Any]:
    gains: dict[int, list[float]] = {}
    for row in own:
        gains.setdefault(row["seed"], []).append(row["return_validation"] - row["return_expert"])
    return {
        "residual": label,
        "trainings": len(gains),
        "environment steps": f"{max(row['environment_steps'] for row in own):,}",
        "best gain in validation": trainings_text([max(each) for each in gains.values()], 1, sign="+"),
        "last gain in validation": trainings_text([each[-1] for each in gains.values()], 1, sign="+"),
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
        for method in TUNED_METHODS
        for row in read_part(folder, f"{SEARCH_PART} {method}")[4::5]
    )
