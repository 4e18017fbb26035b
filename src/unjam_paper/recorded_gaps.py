"""Fuel that two laws with equal limits save behind recorded vehicles, each tuned for several mean gaps.

The laws are tuned on the drives of March 2021, as in `unjam_paper.recorded_roads`, and measured on those of April.
Which part of a saving is due to the opening of the gap, to kinetic energy and to the lower mean speed is measured on
the drives of March.
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
"""largest mean gap for which a law is tuned; human drivers keep 30 m [m]"""
LARGEST_GAP_RATIO = PlanLimits().largest_gap / PlanLimits().largest_mean_gap
AVERAGING, LIMITED = "smooth-acc", "acc with the limits of smooth-acc"
FIXED_BY_LAW: dict[str, dict[str, float]] = {AVERAGING: {}, LIMITED: {"averaging_time": 0.0, "leader_weight": 1.0}}
"""the law is the same: without averaging it follows the present speed of its leader, as an ACC does"""
GAPS_BUDGET = SearchBudget(generations=14, size=24)

START_SECONDS = 60.0
"""time in which controllers open their gaps, at the start of each episode"""
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
"""headings of the fuel of the platoon, each relative to human drivers, and of the mean gap"""


def gap_limits(mean_gap: float) -> PlanLimits:
    """Return the limits of a search: the largest gap shrinks with the mean gap [m]."""
    return PlanLimits(largest_mean_gap=mean_gap, largest_gap=LARGEST_GAP_RATIO * mean_gap)


def search_space(law: str, limits: PlanLimits) -> dict[str, FloatDistribution]:
    """Return the parameters of a law that are searched."""
    space = SEARCH_SPACES[AVERAGING] | {"largest_gap": FloatDistribution(35.0, limits.largest_gap - 1.0)}
    return {name: each for name, each in space.items() if name not in FIXED_BY_LAW[law]}


def tune_law(folder: str, law: str, mean_gap: float, workers: int) -> Table:
    """Return the best parameters of a law with a mean gap [m] on the training drives, as a list of one row."""
    driver, limits = replace(SmoothACC(time_step=TIME_STEP), **FIXED_BY_LAW[law]), gap_limits(mean_gap)
    space, scenarios = search_space(law, limits), recorded_drives(Path(folder))
    best = search_parameters(scenarios, driver, space, GAPS_BUDGET, limits)[-1]
    return [{"law": law, "mean gap": mean_gap, **best}]


def _driver_name(row: dict[str, Any]) -> str:
    parameters = FIXED_BY_LAW[row["law"]] | row["parameters"]
    return f"{AVERAGING}:" + ",".join(f"{key}={value:g}" for key, value in parameters.items())


def _label(law: str, mean_gap: float) -> str:
    return f"{law}, {mean_gap:g} m"


def measure_law(folder: str, label: str, name: str, workers: int) -> Table:
    """Return the metrics of a driver behind each test drive, under a label."""
    return [{**row, "driver": label} for row in measure_driver(folder, TEST_MONTH, STANDARD_SETTING, name, workers)]


def measure_sources(folder: str, label: str, workers: int) -> Table:
    """Return the `SOURCES` of a driver behind each training drive, fuel in ml/km."""
    scenarios, driver = recorded_drives(Path(folder)), make_driver(SOURCE_DRIVERS[label], TIME_STEP)
    episodes = run_batches([EpisodeTask(each, driver, (0,)) for each in scenarios])
    return [{"driver": label, **_fuel_sources(episode), "gap": cav_mean_gap(episode)} for episode in episodes]


def _fuel_sources(episode: Episode) -> dict[str, float]:
    step, start = episode.control_step, round(START_SECONDS / episode.control_step)
    speeds, accelerations = episode.speeds[1:], np.diff(episode.speeds, axis=0) / step
    fuel, kinetic = fuel_rate(speeds, accelerations), kinetic_fuel_rate(speeds, accelerations)
    mean = float(speeds.mean())
    return {
        "whole": fuel_by_power(episode),
        "later": float(1000.0 * fuel[start:].sum() / speeds[start:].sum()),
        "net": float(1000.0 * (fuel - kinetic).sum() / speeds.sum()),
        "steady": float(1000.0 * fuel_rate(np.array(mean), np.array(0.0)) / mean),
    }


def sources_table(folder: Path) -> pd.DataFrame:
    """Return which part of the fuel that drivers save is due to the start, to kinetic energy and to the mean speed."""
    rows, table = read_part(folder, SOURCES_PART), list[dict[str, str]]()
    values = {label: pd.DataFrame([row for row in rows if row["driver"] == label]) for label in SOURCE_DRIVERS}
    for label in (each for each in values if each != HUMAN_LABEL):
        own, human = values[label], values[HUMAN_LABEL]
        changes = {name: 100.0 * (own[name] - human[name]) / human[name] for name in SOURCES if name != "gap"}
        cells = {SOURCES[name]: estimate_text(estimate(each.tolist()), 2, "+") for name, each in changes.items()}
        table.append({"driver": label, **cells, SOURCES["gap"]: f"{own['gap'].mean():.0f}"})
    return pd.DataFrame(table)


def make_gap_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return a search for each law and mean gap, and then the test drives."""
    root, folder = str(study_folder.folder), study_folder.folder / GAPS_STUDY
    parts: dict[str, StudyPart] = {
        f"{SEARCH_PART}/{_label(law, gap)}": (tune_law, (root, law, gap))
        for law, gap in product(FIXED_BY_LAW, MEAN_GAPS)
    }
    parts |= {f"{SOURCES_PART}/{label}": (measure_sources, (root, label)) for label in SOURCE_DRIVERS}
    if not (folder / f"{SEARCH_PART}.json").is_file():
        return parts
    drivers = {name: name for name in (HUMAN_LABEL, *PUBLISHED_FILES)}
    drivers |= {_label(row["law"], row["mean gap"]): _driver_name(row) for row in read_part(folder, SEARCH_PART)}
    for label, name in drivers.items():
        parts[f"{TEST_DRIVES_PART}/{label}"] = measure_law, (root, label, name)
    return parts


def gaps_table(folder: Path) -> pd.DataFrame:
    """Return fuel, gaps, flow and waves behind the test drives, by the mean gap that a law was tuned for."""
    results = DriveResults(read_part(folder, TEST_DRIVES_PART))
    return pd.DataFrame(_gap_row(results, label) for label in results.groups() if label != HUMAN_LABEL)


def _gap_row(results: DriveResults, label: str) -> dict[str, str]:
    law, _, gap = label.rpartition(", ")
    is_tuned = law in FIXED_BY_LAW
    acc = f"{LIMITED}, {gap}" if law == AVERAGING else label
    mean_gap, largest = results.values(label, "cav_mean_gap").mean(), results.values(label, "cav_max_gap").max()
    return {
        "law": law if is_tuned else label,
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
