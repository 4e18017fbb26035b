"""Controllers on roads, in traffic, with sensors or with numbers of vehicles that differ from training."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from math import nan
from pathlib import Path
from typing import Any

import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.wrappers import ImpairedDriver
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.statistics import Estimate, paired_difference
from unjam.road_family import NGSIM_IDM
from unjam.scenarios.scenario import Scenario
from unjam.training.config import load_config
from unjam.training.evaluate import TRAINED_LABEL
from unjam_paper import study
from unjam_paper.comparison import COMPARISON_METRICS, comparison_rows, estimate_metrics, training_curves
from unjam_paper.results_file import StudyPart, read_part, write_part
from unjam_paper.variants import VARIANTS

CONDITION_EPISODES = 10
"""number of episodes of each driver under each condition"""
TUNED_EXPERT = "tuned expert"
ROBUSTNESS_METRICS = (
    *("mean_speed", "mean_speed_steady", "speed_std_fleet", "min_time_gap", "collisions"),
    "insertion_backlog_veh",
)
COMMON_CONDITIONS: dict[str, dict[str, Any]] = {
    "as in training": {},
    "twice the noise": {"noise": 0.4},
    "NGSIM drivers": {"humans": NGSIM_IDM},
    "gaps ± 0.5 m": {"impairments": {"gap_noise": 0.5}},
    "0.3 s delay": {"impairments": {"delay": 0.3}},
    "two CAVs": {"cavs": 2},
}
"""changes to the scenario of the training, and arguments of `ImpairedDriver` as `impairments`, by name"""
RING_CONDITIONS: dict[str, dict[str, Any]] = {
    **COMMON_CONDITIONS,
    "one CAV in 44, 520 m": {"vehicles": 44, "length": [520, 520]},
    "200 to 219 m": {"length": [200, 219]},
    "271 to 300 m": {"length": [271, 300]},
}
ROAD_CONDITIONS: dict[str, dict[str, dict[str, Any]]] = {
    "ring": {**RING_CONDITIONS, "after ten minutes of jam": {"warmup": 6000}},
    "ring-jammed": {**RING_CONDITIONS, "before there is a jam": {"warmup": 0}},
    "figure-eight": {
        **COMMON_CONDITIONS,
        "radius 30 m": {"radius": [30, 30]},
        "radius 36 to 38 m": {"radius": [36, 38]},
        "twice as long": {"horizon": 3000},
    },
}
ROAD_CONTROLLERS = {
    "ring": ("unjam:ring-best-ideal", "unjam:ring-gap-tuned"),
    "ring-jammed": ("unjam:ring-jammed-best-ideal", "unjam:ring-jammed-tuned-ideal"),
    "figure-eight": ("unjam:figure-eight-best-ideal", "unjam:figure-eight-tuned-ideal"),
}
"""trained packaged controller and best tuned expert by road"""
VOLUME_ROADS = ("ring-5", "ring-11", "ring")
"""roads of Figure 10"""
VOLUME_VARIANTS = ("trpo", "ppo", "sac", "without-model", "proposed", "ours")
TRANSFER_VARIANTS, TRANSFER_SOURCE, TRANSFER_EPISODES = ("proposed", "ours"), "ring", 20
"""variants, road of their trainings, and number of episodes on each of the `TRANSFER_ROADS`"""
LONG_RING = {"scenario_options.vehicles": 44, "scenario_options.length": [520, 520]}
TRANSFER_ROADS: dict[str, dict[str, Any]] = {
    **{f"{count} vehicles": study.STUDY_ROADS[road] for count, road in ((5, "ring-5"), (11, "ring-11"), (22, "ring"))},
    "44 vehicles on 520 m": study.STUDY_ROADS["ring"] | LONG_RING,
}


def condition_rows(
    road: str, condition: str, changes: Mapping[str, Any], controllers: tuple[str, str], episodes: int, workers: int
) -> study.Table:
    """Return a row for the human baseline and for both `controllers`: the trained one, then the tuned expert."""
    trained, tuned = controllers
    names = {HUMAN_LABEL: HUMAN_LABEL, TUNED_EXPERT: tuned, TRAINED_LABEL: trained}
    options = {f"scenario_options.{key}": value for key, value in changes.items() if key != "impairments"}
    scenario = load_config(changes={**study.STUDY_ROADS[road], **options}).make_scenario()
    drivers = {label: partial(_impaired_driver, name, changes.get("impairments", {})) for label, name in names.items()}
    rows = study.evaluate_drivers(scenario, drivers, episodes, workers)
    return [
        {
            **{"road": road, "condition": condition, "driver": label},
            **{"feasibility": overall_feasibility(driver_rows, rows[HUMAN_LABEL])},
            **estimate_metrics(driver_rows, ROBUSTNESS_METRICS),
            "speed_gain_over_expert": asdict(paired_difference(driver_rows, rows[TUNED_EXPERT], "mean_speed")),
        }
        for label, driver_rows in rows.items()
    ]


def _impaired_driver(name: str, impairments: Mapping[str, float], scenario: Scenario) -> Driver:
    """Return a driver with impairments; human drivers have none."""
    driver = make_driver(name, scenario.control_step)
    if driver.is_driven_by_simulator or not impairments:
        return driver
    return ImpairedDriver(driver, **impairments, time_step=scenario.control_step)


def _robustness_table(road: str, folder: Path) -> pd.DataFrame:
    """Return the mean speed of all vehicles by condition and driver, and the gain of training over the expert."""
    table: dict[str, dict[str, str]] = {}
    for row in read_part(folder, "robustness"):
        if row["road"] == road:
            cells = table.setdefault(row["condition"], {"": row["condition"]})
            label = "human baseline" if row["driver"] == HUMAN_LABEL else row["driver"]
            cells[f"{label} [m/s]"] = study.number_text(row["mean_speed"]["mean"], 2)
            if row["driver"] == TRAINED_LABEL:
                cells["difference to expert [m/s]"] = study.interval_text(row["speed_gain_over_expert"], 2, "+")
                cells["min time gap [s]"] = study.number_text(row["min_time_gap"]["smallest"], 2)
                cells["feasible"] = row["feasibility"]
    return pd.DataFrame(table.values())


def transfer_rows(road: str, drivers: Mapping[str, str], workers: int) -> study.Table:
    """Return the metrics of drivers on one of the `TRANSFER_ROADS`."""
    scenario = load_config(changes=TRANSFER_ROADS[road]).make_scenario()
    rows = study.evaluate_drivers(scenario, drivers, TRANSFER_EPISODES, workers)
    return [
        {"road": road, "driver": name, **estimate_metrics(driver_rows, COMPARISON_METRICS)}
        for name, driver_rows in rows.items()
    ]


def _transfer_parts(study_folder: study.StudyFolder, seeds: int) -> dict[str, StudyPart]:
    drivers = {"human": "human", "pi": "pi"}
    for variant, seed in product(TRANSFER_VARIANTS, range(seeds)):
        drivers[f"{variant} {seed}"] = str(study_folder.run_folder(study.PlannedRun(TRANSFER_SOURCE, variant, seed)))
    return {f"transfer/{road}": (transfer_rows, (road, drivers)) for road in TRANSFER_ROADS}


def _figure_10_study(title: str, roads: tuple[str, ...]) -> study.Study:
    def write(study_folder: study.StudyFolder, seeds: int, folder: Path) -> None:
        tables = (comparison_rows(study_folder, road, VOLUME_VARIANTS, seeds) for road in roads)
        write_part(folder, "table", [row for rows in tables for row in rows])
        curves = {road: training_curves(study_folder, road, VOLUME_VARIANTS, seeds) for road in roads}
        write_part(folder, "curves", curves)

    return study.Study(title, lambda seeds: study.planned_runs(roads, VOLUME_VARIANTS, seeds), write=write, roads=roads)


def _transfer_table(folder: Path) -> pd.DataFrame:
    """Return the mean speed of all vehicles by driver and road, with the range over trainings."""

    def mean_and_range(values: pd.Series) -> str:
        return study.interval_text(
            asdict(Estimate(values.mean(), nan, nan, len(values), values.min(), values.max())), 2
        )

    rows = pd.json_normalize(read_part(folder, "transfer"))
    rows["trained as"] = rows["driver"].str.rstrip(" 0123456789")
    speeds = rows.pivot_table("mean_speed.mean", "road", "trained as", mean_and_range, sort=False)
    labels = {variant: VARIANTS[variant].label for variant in TRANSFER_VARIANTS}
    return speeds.rename_axis(index="", columns=None).rename(columns=labels).reset_index()


ROBUSTNESS = study.Study(
    title="packaged controllers with roads, human drivers and sensors that differ from training",
    make_parts=lambda study_folder, seeds: {
        f"robustness/{road}, {key}": (condition_rows, (road, key, changes, ROAD_CONTROLLERS[road], CONDITION_EPISODES))
        for road, conditions in ROAD_CONDITIONS.items()
        for key, changes in conditions.items()
    },
    minutes=20.0,
    tables={road: partial(_robustness_table, road) for road in ROAD_CONDITIONS},
)
FIGURE_10_UNFILTERED = _figure_10_study(
    "5, 11 and 22 vehicles, trained for each, without the safety filter",
    tuple(study.UNFILTERED_ROADS[road] for road in VOLUME_ROADS),
)
FIGURE_10 = replace(
    _figure_10_study("5, 11 and 22 vehicles, trained for each, and transfer between them", VOLUME_ROADS),
    make_parts=_transfer_parts,
    minutes=3.0,
    tables={"transfer": _transfer_table},
)
