"""Fuel that two formulas with equal limits save behind recorded vehicles, each tuned for several mean gaps.

The formulas are tuned on the drives of March 2021, as in `unjam_paper.recorded_roads`, and measured on the drives of
April. On the drives of March the study also measures which part of a saving is due to the opening of the gap at the
start, to kinetic energy, and to the lower mean speed.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from optuna.distributions import FloatDistribution

from unjam.controller import make_driver
from unjam.drivers.smooth_acc import SmoothACC
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import METRICS
from unjam.measures.platoon_metrics import cav_mean_gap, fuel_by_power
from unjam.measures.statistics import estimate
from unjam.physics.fuel import fuel_rate, kinetic_fuel_rate
from unjam.worlds.batch.run import run_batches
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.fuel_optimal_plan import PlanLimits
from unjam_paper.parameter_search import SearchBudget, search_parameters
from unjam_paper.recorded_roads import (
    PUBLISHED_FILES,
    SEARCH_PART,
    SEARCH_SPACES,
    STANDARD_SETTING,
    TEST_DRIVES_PART,
    TEST_MONTH,
    TIME_STEP,
    WAVE_METRICS,
    DriveResults,
    measure_driver,
    recorded_drives,
)
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table, estimate_text

GAPS_STUDY = "recorded-gaps"
MEAN_GAPS = (73.0, 60.0, 50.0, 40.0)
"""largest mean gaps for which a formula is tuned [m]; the mean gap of human drivers is 30 m"""
LARGEST_GAP_RATIO = PlanLimits().largest_gap / PlanLimits().largest_mean_gap
SMOOTH_ACC, LIMITED_ACC = "smooth-acc", "acc with the limits of smooth-acc"
FIXED_BY_FORMULA: dict[str, dict[str, float]] = {
    SMOOTH_ACC: {},
    LIMITED_ACC: {"averaging_time": 0.0, "leader_weight": 1.0},
}
"""fixed parameters of `smooth-acc` by formula; without averaging it follows the current speed of its leader"""
GAPS_BUDGET = SearchBudget(generations=14, size=24)
START_SECONDS = 60.0
"""time at the start of each episode in which controllers open their gaps [s]"""
SOURCES_PART = "sources"
SOURCE_DRIVERS = {
    HUMAN_LABEL: HUMAN_LABEL,
    "smooth-acc, tuned": "unjam:recorded-tuned",
    "acc, tuned": "acc:set_speed=45,time_gap=2.4496,gap_gain=0.0044,speed_gain=0.2017",
    "acc with default gains, 2.4 s": "acc:set_speed=45,time_gap=2.4",
    "human driver with a time headway of 2.4 s": "idm:desired_speed=45,time_headway=2.4",
}
SOURCES = {
    "whole": "whole drives [%]",
    "later": "from the second minute [%]",
    "net": "without the change of kinetic energy [%]",
    "steady": "of steady driving with the mean speeds [%]",
    "gap": "mean gap [m]",
}
"""headings by name: fuel of the platoon, relative to human drivers, and mean gap"""


def gap_limits(mean_gap: float) -> PlanLimits:
    """Return the limits of a search for a mean gap [m]; the largest gap is proportional to it."""
    return PlanLimits(largest_mean_gap=mean_gap, largest_gap=LARGEST_GAP_RATIO * mean_gap)


def search_space(formula: str, limits: PlanLimits) -> dict[str, FloatDistribution]:
    """Return the ranges of the parameters of a formula that are searched."""
    space = SEARCH_SPACES[SMOOTH_ACC] | {"largest_gap": FloatDistribution(35.0, limits.largest_gap - 1.0)}
    fixed = FIXED_BY_FORMULA[formula]
    return {name: distribution for name, distribution in space.items() if name not in fixed}


def tune_formula(folder: str, formula: str, mean_gap: float, workers: int) -> Table:
    """Return the best parameters of a formula for a mean gap [m] on the training drives, as a list of one row."""
    driver = replace(SmoothACC(time_step=TIME_STEP), **FIXED_BY_FORMULA[formula])
    limits = gap_limits(mean_gap)
    space, scenarios = search_space(formula, limits), recorded_drives(Path(folder))
    best = search_parameters(scenarios, driver, space, GAPS_BUDGET, limits)[-1]
    return [{"law": formula, "mean gap": mean_gap, **best}]


def _tuned_driver(row: dict[str, Any]) -> str:
    """Return the name of the driver with the best parameters of a search."""
    parameters = FIXED_BY_FORMULA[row["law"]] | row["parameters"]
    return f"{SMOOTH_ACC}:" + ",".join(f"{key}={value:g}" for key, value in parameters.items())


def _formula_label(formula: str, mean_gap: float) -> str:
    return f"{formula}, {mean_gap:g} m"


def measure_test_drives(folder: str, label: str, name: str, workers: int) -> Table:
    """Return the metrics of a driver behind each test drive, with this label."""
    return [{**row, "driver": label} for row in measure_driver(folder, TEST_MONTH, STANDARD_SETTING, name, workers)]


def measure_sources(folder: str, label: str, workers: int) -> Table:
    """Return the `SOURCES` of a driver behind each training drive, fuel in ml/km."""
    scenarios, driver = recorded_drives(Path(folder)), make_driver(SOURCE_DRIVERS[label], TIME_STEP)
    episodes = run_batches([EpisodeTask(scenario, driver, (0,)) for scenario in scenarios])
    return [{"driver": label, **_fuel_sources(episode), "gap": cav_mean_gap(episode)} for episode in episodes]


def _fuel_sources(episode: Episode) -> dict[str, float]:
    """Return the fuel of the platoon [ml/km] by name in `SOURCES`."""
    step, start_steps = episode.control_step, round(START_SECONDS / episode.control_step)
    speeds, accelerations = episode.speeds[1:], np.diff(episode.speeds, axis=0) / step
    fuel, kinetic = fuel_rate(speeds, accelerations), kinetic_fuel_rate(speeds, accelerations)
    mean_speed = float(speeds.mean())
    return {
        "whole": fuel_by_power(episode),
        "later": float(1000.0 * fuel[start_steps:].sum() / speeds[start_steps:].sum()),
        "net": float(1000.0 * (fuel - kinetic).sum() / speeds.sum()),
        "steady": float(1000.0 * fuel_rate(np.array(mean_speed), np.array(0.0)) / mean_speed),
    }


def sources_table(folder: Path) -> pd.DataFrame:
    """Return the change of fuel by drivers: in all, without the start, without kinetic energy, and by speed alone."""
    rows, table = read_part(folder, SOURCES_PART), list[dict[str, str]]()
    values = {label: pd.DataFrame([row for row in rows if row["driver"] == label]) for label in SOURCE_DRIVERS}
    human = values.pop(HUMAN_LABEL)
    for label, driver in values.items():
        changes = {name: 100.0 * (driver[name] - human[name]) / human[name] for name in SOURCES if name != "gap"}
        cells = {SOURCES[name]: estimate_text(estimate(change.tolist()), 2, "+") for name, change in changes.items()}
        table.append({"driver": label, **cells, SOURCES["gap"]: f"{driver['gap'].mean():.0f}"})
    return pd.DataFrame(table)


def make_gap_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return a search for each formula and mean gap, and after the searches the test drives."""
    root, folder = str(study_folder.folder), study_folder.folder / GAPS_STUDY
    parts: dict[str, StudyPart] = {
        f"{SEARCH_PART}/{_formula_label(formula, gap)}": (tune_formula, (root, formula, gap))
        for formula, gap in product(FIXED_BY_FORMULA, MEAN_GAPS)
    }
    parts |= {f"{SOURCES_PART}/{label}": (measure_sources, (root, label)) for label in SOURCE_DRIVERS}
    if not (folder / f"{SEARCH_PART}.json").is_file():
        return parts
    drivers = {name: name for name in (HUMAN_LABEL, *PUBLISHED_FILES)}
    drivers |= {
        _formula_label(row["law"], row["mean gap"]): _tuned_driver(row) for row in read_part(folder, SEARCH_PART)
    }
    for label, name in drivers.items():
        parts[f"{TEST_DRIVES_PART}/{label}"] = measure_test_drives, (root, label, name)
    return parts


def gaps_table(folder: Path) -> pd.DataFrame:
    """Return fuel, gaps, flow and waves behind the test drives, by formula and the mean gap of its tuning."""
    results = DriveResults(read_part(folder, TEST_DRIVES_PART))
    return pd.DataFrame(_gap_row(results, label) for label in results.groups() if label != HUMAN_LABEL)


def _gap_row(results: DriveResults, label: str) -> dict[str, str]:
    formula, _, gap = label.rpartition(", ")
    is_tuned = formula in FIXED_BY_FORMULA
    acc = f"{LIMITED_ACC}, {gap}" if formula == SMOOTH_ACC else label
    mean_gap, largest = results.values(label, "cav_mean_gap").mean(), results.values(label, "cav_max_gap").max()
    return {
        "law": formula if is_tuned else label,
        "tuned for a mean gap of": gap if is_tuned else NO_VALUE_TEXT,
        "fuel of the platoon [%]": results.change_text(label, "fuel_by_power"),
        "difference to that ACC [points]": results.change_text(label, "fuel_by_power", baseline=acc),
        "gap: mean / largest [m]": f"{mean_gap:.0f} / {largest:.0f}",
        "flow [%]": results.change_text(label, "outflow_veh_per_h"),
        **{METRICS[name].label: f"{results.values(label, name).mean():.2f}" for name in WAVE_METRICS[:2]},
    }


RECORDED_GAPS = Study(
    title="fuel that laws with equal limits save behind recorded vehicles, by their mean gap",
    make_parts=make_gap_parts,
    minutes=30.0,
    tables={"gaps": gaps_table, "sources": sources_table},
)
