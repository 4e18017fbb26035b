"""Gain of drivers on every road of the family, training roads and unseen roads.

On each road a gain of 0 is the human baseline and 1 is the best tuned expert known there, which is selected on other
seeds than the test seeds.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from unjam.controller import PACKAGED_PREFIX, make_driver
from unjam.files import atomic_write, to_json
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.gain import (
    MAX_GAIN,
    MIN_GAIN,
    EpisodeRows,
    gain_by_seed,
    is_gain_negligible,
    normalized_gain,
    performance,
)
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate, format_difference
from unjam.physics.arrays import Floats
from unjam.reports.figures import TEXT_COLOR, new_figure
from unjam.scenarios.scenario import Scenario
from unjam.training.road_family import FAMILY, GROUP_BY_SCENARIO
from unjam.training.seeds import make_test_seeds, tuning_seeds
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.parts import controller_digest
from unjam_paper.results_file import read_parts
from unjam_paper.study import Study, StudyFolder

EPISODES_PER_ROAD = 10
"""episodes of each driver on each road"""
EXPERT_SELECTION_SEEDS, FAMILY_TEST_SEEDS = tuning_seeds(EPISODES_PER_ROAD, 1000), make_test_seeds(EPISODES_PER_ROAD)
EpisodeRunner = Callable[[list[EpisodeTask]], EpisodeRows]
"""runs tasks and returns the result of `family_metrics` for each of them, in order"""
PI_TUNED_ON_RINGS = "pi:window=23,catch_up_speed=0.5994,gap_lower=3,gap_upper=50,time_constant=0.9775,safe_gap=4"
"""result of `unjam tune rings --expert pi`"""
PI_TUNED_ON_ALL = (
    "pi:window=24.09,catch_up_speed=0.9343,gap_lower=2.263,gap_upper=88.15,safe_gap=4.505,"
    "safe_gap_rule=closing,time_constant=1.18,first_command=zero"
)
GAP_PI_TUNED_ON_ALL = (
    "pi-from-gap:window=70.13,catch_up_speed=0.5547,gap_lower=5.578,gap_upper=14.74,safe_gap=1.398,"
    "safe_gap_rule=closing,time_constant=1.159,first_command=zero,human_time_headway=1.933,"
    "human_standstill_gap=0.5038,fade_time=12.94,history_factor=1.242"
)
JAM_AHEAD_TUNED_ON_ALL = (
    "jam-ahead:first_section=2,last_section=3,speed_margin=-2.086,margin_by_penetration=19.15,min_speed=3.369,"
    "max_deceleration=0.5985,all_lanes=False,time_constant=1.678,jam_speed_ratio=0.652"
)
"""results of `unjam tune all-roads` for three experts (results/tuned.json)"""
FAMILY_EXPERTS: dict[str, tuple[str, ...]] = {
    "rings": (
        *("pi", "unjam:ring-tuned", "unjam:ring-gap-tuned", "unjam:ring-jammed-tuned", "unjam:rings-tuned"),
        *("unjam:shared-rings-tuned", "follower-stopper", PI_TUNED_ON_ALL, GAP_PI_TUNED_ON_ALL),
    ),
    "figure-eights": ("unjam:figure-eight-tuned", "pacer:use_tuned=true", PI_TUNED_ON_ALL),
    "motorways": ("jam-ahead", "unjam:on-ramp-tuned", "cruise", "adaptive-acc", JAM_AHEAD_TUNED_ON_ALL),
}
"""experts by group of roads; the best one on a road has a gain of 1 there"""
UNSEEN_PARTS = ("combination", "axis")
"""parts of the family that no driver was trained or tuned on"""
TABLE_PARTS = {"training": ("training",), "unseen": UNSEEN_PARTS}
"""tables of a page, and the parts of the family in each"""
PI_ON_ALL_LABEL, JAM_AHEAD_ON_ALL_LABEL = "PI, tuned on all roads", "jam-ahead, tuned on all roads"
PI_ON_RINGS_LABEL = "PI, tuned on the rings"
SINGLE_CONTROLLERS: dict[str, str] = {
    "unjam:best": "unjam:best",
    PI_ON_ALL_LABEL: PI_TUNED_ON_ALL,
    "gap PI, tuned on all roads": GAP_PI_TUNED_ON_ALL,
    JAM_AHEAD_ON_ALL_LABEL: JAM_AHEAD_TUNED_ON_ALL,
    PI_ON_RINGS_LABEL: PI_TUNED_ON_RINGS,
}
"""controllers for all roads: one expert, or one file with several"""
FAMILY_DRIVERS: dict[str, str] = {
    **SINGLE_CONTROLLERS,
    **{"jam-ahead": "jam-ahead", "FollowerStopper": "follower-stopper"},
    **{f"unjam:{name}": f"unjam:{name}" for name in ("ring-best", "ring-jammed-best", "figure-eight-best")},
    "unjam:on-ramp-tuned": "unjam:on-ramp-tuned",
}
"""drivers that are evaluated on every road, by label"""
TWO_LAWS_LABEL = "PI on rings and figure eights, jam-ahead on motorways (tuned on all roads)"
"""the combination of two single controllers by the type of road: its rows are theirs"""
FAMILY_METRICS = (
    *("seed", "status", "travel_time", "delay", "mean_speed", "mean_speed_second_half", "speed_limit_ratio"),
    *("outflow_veh_per_h", "fuel_ml_per_km", "required_time_gap", "has_lanes", "collisions", "min_time_gap"),
    *("cav_min_ttc", "cav_max_braking", "cut_in_max_braking", "share_short_time_gap", "override_share"),
    "human_braking_beyond_4_5",
)


def drive_by_label(
    scenario: Scenario, drivers: Mapping[str, str], seeds: list[tuple[int, ...]], run_episodes: EpisodeRunner
) -> dict[str, EpisodeRows]:
    """Return the metrics of each driver's episodes by label; `drivers` are names of drivers by label."""
    made = [make_driver(name, scenario.control_step) for name in drivers.values()]  # one each: networks have memory
    tasks = [
        EpisodeTask(scenario.stratum(index, len(seeds)), driver, seed)
        for driver in made
        for index, seed in enumerate(seeds)
    ]
    rows, count = run_episodes(tasks), len(seeds)
    return {label: rows[number * count : (number + 1) * count] for number, label in enumerate(drivers)}


def family_metrics(index: int, episode: Episode) -> dict[str, Any]:
    """Return the metrics of an episode, for `WorkerPool.run_and_map`: a whole motorway episode takes 80 MB."""
    measured = measure(episode)
    return {key: measured[key] for key in FAMILY_METRICS}


def _write_all_roads(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    roads = [(number, name, road, road.make_scenario()) for number, (name, road) in enumerate(FAMILY.items())]
    with WorkerPool(workers) as pool:
        run_episodes = partial(pool.run_and_map, transform=family_metrics)
        for number, name, road, scenario in sorted(roads, key=lambda each: not each[3].is_closed):  # quick ones first
            file = folder / f"{number:02d}.json"
            results: dict[str, Any] = {"road": name, "part": road.part, "best": HUMAN_LABEL}
            results |= {"expert_files": {}, "driver_files": {}, "rows": {}}
            if file.is_file():
                results |= json.loads(file.read_text(encoding="utf-8"))
            _drive_missing(scenario, FAMILY_EXPERTS[GROUP_BY_SCENARIO[road.scenario]], results, run_episodes)
            atomic_write(file, to_json(results))


def _drive_missing(
    scenario: Scenario, experts: Sequence[str], results: dict[str, Any], run_episodes: EpisodeRunner
) -> None:
    """Run the drivers of a road without results, or with a changed packaged file, and add their results."""
    new = [driver for driver in experts if results["expert_files"].get(driver) != controller_digest(driver)]
    if new:
        others = experts if results["best"] in new else (results["best"], *new)
        candidates = {driver: driver for driver in (HUMAN_LABEL, *others)}
        rows = drive_by_label(scenario, candidates, EXPERT_SELECTION_SEEDS, run_episodes)
        results["best"] = best_feasible_driver(rows)
        results["expert_files"] |= {driver: controller_digest(driver) for driver in new}
    drivers = {HUMAN_LABEL: HUMAN_LABEL, results["best"]: results["best"], **FAMILY_DRIVERS}
    missing = {
        label: driver
        for label, driver in drivers.items()
        if label not in results["rows"] or results["driver_files"].get(label) != driver_identity(driver)
    }
    if missing:
        results["rows"] |= drive_by_label(scenario, missing, FAMILY_TEST_SEEDS, run_episodes)
        results["driver_files"] |= {label: driver_identity(driver) for label, driver in missing.items()}


def driver_identity(driver: str) -> str:
    """Return what distinguishes a driver from others with the same label: its digest, or its name with parameters."""
    return controller_digest(driver) or driver


def best_feasible_driver(rows: Mapping[str, EpisodeRows]) -> str:
    """Return the best driver of those that are feasible in every episode; `human` if none is."""
    baseline = rows[HUMAN_LABEL]
    feasible = [
        label for label, own in rows.items() if label == HUMAN_LABEL or overall_feasibility(own, baseline) == FEASIBLE
    ]
    return max(feasible, key=lambda label: float(np.mean([performance(row) for row in rows[label]])))


def road_gains(folder: Path) -> dict[str, dict[str, Any]]:
    """Return for each road its part, its best expert, and for each label the gain, the speeds and the verdict.

    `has_potential_gain` is whether the best expert is better than the human baseline by more than a negligible amount.
    Speeds are means of whole episodes by seed [m/s].
    """
    roads: dict[str, dict[str, Any]] = {}
    for number, results in read_parts(folder).items():
        if not number.isdecimal():
            continue
        rows: dict[str, EpisodeRows] = {
            label: [{key: np.nan if value is None else value for key, value in row.items()} for row in own]
            for label, own in results["rows"].items()
        }
        best = [performance(row) for row in rows[results["best"]]]
        baseline = rows.pop(HUMAN_LABEL)
        roads[results["road"]] = {
            **{key: results[key] for key in ("part", "best")},
            "human": float(np.mean([performance(row) for row in baseline])),
            "has_potential_gain": not is_gain_negligible(baseline, best),
            "gains": {label: normalized_gain(own, baseline, best) for label, own in rows.items()},
            "by_seed": {label: gain_by_seed(own, baseline, best) for label, own in rows.items()},
            "speeds": {label: np.array([row["mean_speed"] for row in own]) for label, own in rows.items()},
            "verdicts": {label: overall_feasibility(own, baseline) for label, own in rows.items()},
        }
    return roads


def all_roads_table(parts: Sequence[str], folder: Path) -> pd.DataFrame:
    """Return the gain of each single controller on each road of some parts of the family, the mean and the worst."""
    roads = _roads_in_parts(road_gains(folder), parts)
    labels = {driver: label for label, driver in FAMILY_DRIVERS.items()}
    rows = []
    for name, road in roads.items():
        best: str = road["best"]
        best = labels.get(best, best).removeprefix(PACKAGED_PREFIX)
        gains = {label: format_difference(road["gains"][label], 2) for label in SINGLE_CONTROLLERS}
        rows.append({"road": name, "best expert": best, **gains})
    gainful = [road for road in roads.values() if road["has_potential_gain"]]
    for name, of in (("mean", [*roads.values()]), ("mean, roads with a potential gain", gainful)):
        rows.append(
            {"road": name, **{label: _mean_gain(road["by_seed"][label] for road in of) for label in SINGLE_CONTROLLERS}}
        )
    rows.append({"road": "worst", **{label: _worst_gain(roads, label) for label in SINGLE_CONTROLLERS}})
    return pd.DataFrame(rows).fillna("")


def all_drivers_table(folder: Path) -> pd.DataFrame:
    """Return the mean gain of each driver over the roads of each part, and how much larger that of the first is."""
    (first, *others), gains = FAMILY_DRIVERS, road_gains(folder)
    for name, road in gains.items():
        is_motorway = GROUP_BY_SCENARIO[FAMILY[name].scenario] == "motorways"
        for values in (road["gains"], road["by_seed"]):
            values[TWO_LAWS_LABEL] = values[JAM_AHEAD_ON_ALL_LABEL if is_motorway else PI_ON_ALL_LABEL]
    rows = {label: {"": label} for label in (first, TWO_LAWS_LABEL, *others)}
    for heading, parts in TABLE_PARTS.items():
        roads = _roads_in_parts(gains, parts)
        for label, row in rows.items():
            differences = (road["by_seed"][first] - road["by_seed"][label] for road in roads.values())
            row[heading] = _mean_gain(road["by_seed"][label] for road in roads.values())
            row[f"worst, {heading}"] = _worst_gain(roads, label)
            row[f"{first}, difference to it, {heading}"] = "" if label == first else _mean_gain(differences)
    return pd.DataFrame([*rows.values()])


def _roads_in_parts(roads: Mapping[str, dict[str, Any]], parts: Sequence[str]) -> dict[str, dict[str, Any]]:
    return {name: road for name, road in roads.items() if road["part"] in parts}


def _worst_gain(roads: Mapping[str, dict[str, Any]], label: str) -> str:
    return f"{min(road['gains'][label].mean for road in roads.values()):+.2f}"


def _mean_gain(by_road: Iterable[Floats]) -> str:
    return format_difference(estimate(np.mean(list(by_road), 0)), 2)


def all_roads_figure(folder: Path) -> Figure:
    """Return a map of the gains, roads by drivers."""
    roads = road_gains(folder)
    values = np.array([[road["gains"][label].mean for label in FAMILY_DRIVERS] for road in roads.values()])
    figure = new_figure(0.3 * len(roads) + 1.0)
    axes = figure.subplots()
    # The pale half of the color map: numbers stay legible on it.
    image = axes.imshow(values, cmap="RdYlGn", vmin=-2 * MAX_GAIN, vmax=2 * MAX_GAIN, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, f"{value:+.2f}", ha="center", va="center", color=TEXT_COLOR, fontsize=8)
    axes.set_xticks(range(len(FAMILY_DRIVERS)), list(FAMILY_DRIVERS), rotation=40, ha="right", rotation_mode="anchor")
    marks = {"training": "", "combination": " (new combination)", "axis": " (new)"}
    axes.set_yticks(range(len(roads)), [f"{name}{marks[road['part']]}" for name, road in roads.items()])
    axes.grid(visible=False)
    figure.colorbar(image, ax=axes, label=f"gain, limited to {MIN_GAIN:g} to {MAX_GAIN:g}", shrink=0.5)
    return figure


ALL_ROADS_STUDY = Study(
    title="gain of one controller on every road of the family, training roads and unseen roads",
    write=_write_all_roads,
    minutes=60.0,
    is_resumable=True,
    tables={
        **{name: partial(all_roads_table, parts) for name, parts in TABLE_PARTS.items()},
        "drivers": all_drivers_table,
    },
)
