"""What drivers gain on every road of the family, seen and held out: one controller beside experts.

On each road 0 is people alone, and 1 the best tuned expert that is known there; which that is, other seeds
decide than those that judge.
"""

import json
from collections.abc import Callable, Mapping, Sequence
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
"""of each driver on each road"""
EXPERT_SELECTION_SEEDS, FAMILY_TEST_SEEDS = tuning_seeds(EPISODES_PER_ROAD, 1000), make_test_seeds(EPISODES_PER_ROAD)
"""seeds that choose the best tuned expert of a road, and those that judge"""
EpisodeRunner = Callable[[list[EpisodeTask]], EpisodeRows]
"""drives tasks, and returns what `family_metrics` makes of their episodes, in their order"""
PI_TUNED_ON_RINGS = "pi:window=23,catch_up_speed=0.5994,gap_lower=3,gap_upper=50,time_constant=0.9775,safe_gap=4"
"""what `unjam tune rings --expert pi` finds"""
PI_TUNED_ON_ALL = (
    "pi:window=24.09,catch_up_speed=0.9343,gap_lower=2.263,gap_upper=88.15,safe_gap=4.505,"
    "safe_gap_rule=closing,time_constant=1.18,first_command=zero"
)
GAP_PI_TUNED_ON_ALL = (
    "pi-from-gap:window=70.13,catch_up_speed=0.5547,gap_lower=5.578,gap_upper=14.74,safe_gap=1.398,"
    "safe_gap_rule=closing,time_constant=1.159,first_command=zero,people_headway=1.933,"
    "people_gap=0.5038,fading=12.94,watched_share=1.242"
)
JAM_AHEAD_TUNED_ON_ALL = (
    "jam-ahead:first=2,last=3,margin=-2.086,margin_by_share=19.15,lowest=3.369,slowing=0.5985,"
    "all_lanes=False,time_constant=1.678,jam=0.652"
)
"""what `unjam tune everywhere` finds for three experts, results/tuned.json"""
FAMILY_EXPERTS: dict[str, tuple[str, ...]] = {
    "rings": (
        *("pi", "unjam:ring-tuned", "unjam:ring-gap-tuned", "unjam:ring-jammed-tuned", "unjam:rings-tuned"),
        *("unjam:shared-rings-tuned", "follower-stopper", PI_TUNED_ON_ALL, GAP_PI_TUNED_ON_ALL),
    ),
    "figure-eights": ("unjam:figure-eight-tuned", "pacer:use_tuned=true", PI_TUNED_ON_ALL),
    "motorways": ("jam-ahead", "unjam:on-ramp-tuned", "cruise", "adaptive-acc", JAM_AHEAD_TUNED_ON_ALL),
}
"""experts of which the best on a road is its 1"""
UNSEEN_PARTS = ("combination", "axis")
"""parts of the family that nobody has trained or tuned on"""
SINGLE_CONTROLLERS: dict[str, str] = {
    "unjam:best": "unjam:best",
    "PI, tuned on all": PI_TUNED_ON_ALL,
    "PI from its gap, tuned on all": GAP_PI_TUNED_ON_ALL,
    "jam-ahead, tuned on all": JAM_AHEAD_TUNED_ON_ALL,
    "PI, tuned on the rings": PI_TUNED_ON_RINGS,
}
"""one law for every road, or one file that has several: each has a column of its own"""
FAMILY_DRIVERS: dict[str, str] = {
    **SINGLE_CONTROLLERS,
    "jam-ahead": "jam-ahead",
    "FollowerStopper": "follower-stopper",
    "unjam:ring-best": "unjam:ring-best",
    "unjam:ring-jammed-best": "unjam:ring-jammed-best",
    "unjam:figure-eight-best": "unjam:figure-eight-best",
    "unjam:on-ramp-tuned": "unjam:on-ramp-tuned",
}
"""who is judged on every road, by label"""
TWO_LAWS_LABEL = "the two best tuned on all: PI, on motorways jam-ahead"
"""what a choice by the kind of road makes of two single laws: their own rows"""
FAMILY_METRICS = (
    *("seed", "status", "travel_time", "delay", "mean_speed", "mean_speed_second_half", "speed_limit_ratio"),
    *("outflow_veh_per_h", "fuel_ml_per_km", "floor", "lanes", "collisions", "min_time_gap", "cav_min_ttc"),
    *("cav_max_braking", "cut_in_max_braking", "share_short_time_gap", "overridden", "people_beyond_4_5"),
)
"""of each episode"""


def drive_by_label(
    scenario: Scenario, drivers: dict[str, str], seeds: list[tuple[int, ...]], run_episodes: EpisodeRunner
) -> dict[str, EpisodeRows]:
    """Return what is kept of each driver's episodes, by label; `drivers` are names of drivers by label."""
    made = [make_driver(name, scenario.control_step) for name in drivers.values()]  # one each: networks
    tasks = [
        EpisodeTask(scenario.stratum(index, len(seeds)), driver, seed)
        for driver in made
        for index, seed in enumerate(seeds)
    ]
    rows, count = run_episodes(tasks), len(seeds)
    return {label: rows[n * count : (n + 1) * count] for n, label in enumerate(drivers)}


def family_metrics(index: int, episode: Episode) -> dict[str, Any]:
    """Return what is kept of an episode, for `Workers.run_and_map`: a motorway's whole one takes 80 MB."""
    measured = measure(episode)
    return {key: measured[key] for key in FAMILY_METRICS}


def _write_all_roads(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    made = [(number, name, road, road.make_scenario()) for number, (name, road) in enumerate(FAMILY.items())]
    with WorkerPool(workers) as pool:
        for number, name, road, scenario in sorted(made, key=lambda each: not each[3].is_closed):  # quick first
            file = folder / f"{number:02d}.json"
            found: dict[str, Any] = {"road": name, "part": road.part, "best": HUMAN_LABEL}
            found |= {"tried": {}, "drove": {}, "rows": {}}
            if file.is_file():
                found |= json.loads(file.read_text())
            _drive_missing(
                scenario,
                FAMILY_EXPERTS[GROUP_BY_SCENARIO[road.scenario]],
                found,
                partial(pool.run_and_map, transform=family_metrics),
            )
            atomic_write(file, to_json(found))


def _drive_missing(
    scenario: Scenario, experts: Sequence[str], results: dict[str, Any], run_episodes: EpisodeRunner
) -> None:
    """Drive what is not known yet of a road, and add it to what was found.

    Experts and drivers that came later, or whose shipped file is another one now, are not known.
    """
    new = [driver for driver in experts if results["tried"].get(driver) != controller_digest(driver)]
    if new:
        others = experts if results["best"] in new else (results["best"], *new)
        candidates = dict.fromkeys((HUMAN_LABEL, *others))
        rows = drive_by_label(scenario, {driver: driver for driver in candidates}, EXPERT_SELECTION_SEEDS, run_episodes)
        results["best"] = best_feasible_driver(rows)
        results["tried"] |= {driver: controller_digest(driver) for driver in new}
    asked = {HUMAN_LABEL: HUMAN_LABEL, results["best"]: results["best"], **FAMILY_DRIVERS}
    missing = {
        label: driver
        for label, driver in asked.items()
        if label not in results["rows"] or results["drove"].get(label) != driver_identity(driver)
    }
    if missing:
        results["rows"] |= drive_by_label(scenario, missing, FAMILY_TEST_SEEDS, run_episodes)
        results["drove"] |= {label: driver_identity(driver) for label, driver in missing.items()}


def driver_identity(driver: str) -> str:
    """Return what tells a driver from others under its label: its file, or its name with all parameters."""
    return controller_digest(driver) or driver


def best_feasible_driver(rows: dict[str, EpisodeRows]) -> str:
    """Return who is best of those who could have driven so in every episode: people alone, if nobody."""
    people = rows[HUMAN_LABEL]
    could = [who for who, of in rows.items() if who == HUMAN_LABEL or overall_feasibility(of, people) == FEASIBLE]
    return max(could, key=lambda who: float(np.mean([performance(row) for row in rows[who]])))


def road_gains(folder: Path) -> dict[str, dict[str, Any]]:
    """Return of each road its part, its best expert, and each driver's gain, speeds and verdict, by label.

    `counts` is whether there is something to gain there.

    Speeds are means of the whole episode, start and waves included, seed by seed [m/s].
    """
    roads: dict[str, dict[str, Any]] = {}
    for number, found in read_parts(folder).items():
        if not number.isdecimal():
            continue
        rows: dict[str, EpisodeRows] = {
            label: [{key: np.nan if value is None else value for key, value in row.items()} for row in of]
            for label, of in found["rows"].items()
        }
        best = [performance(row) for row in rows[found["best"]]]
        people = rows.pop(HUMAN_LABEL)
        roads[found["road"]] = {
            **{key: found[key] for key in ("part", "best")},
            "people": float(np.mean([performance(row) for row in people])),
            "counts": not is_gain_negligible(people, best),
            "gains": {label: normalized_gain(of, people, best) for label, of in rows.items()},
            "by_seed": {label: gain_by_seed(of, people, best) for label, of in rows.items()},
            "speeds": {label: np.array([row["mean_speed"] for row in of]) for label, of in rows.items()},
            "verdicts": {label: overall_feasibility(of, people) for label, of in rows.items()},
        }
    return roads


def all_roads_table(parts: tuple[str, ...], folder: Path) -> pd.DataFrame:
    """Return what each law gains on each road of some parts of the family, with the mean and the worst."""
    roads = _roads_in_parts(road_gains(folder), parts)
    rows = [{"road": name, **_gain_cells(road)} for name, road in roads.items()]
    mean, worst = {"road": "mean"}, {"road": "worst"}
    gainful = {"road": "mean, where there is something to gain"}
    for label in SINGLE_CONTROLLERS:
        mean[label] = _mean_gain([road["by_seed"][label] for road in roads.values()])
        gainful[label] = _mean_gain([road["by_seed"][label] for road in roads.values() if road["counts"]])
        worst[label] = _worst_gain(roads, label)
    rows += [mean, gainful, worst]
    return pd.DataFrame(rows).fillna("")


def all_drivers_table(folder: Path) -> pd.DataFrame:
    """Return what each driver gains over the roads of each part, and what the first gains more than it."""
    (first, *others), every = FAMILY_DRIVERS, road_gains(folder)
    for name, road in every.items():
        motorway = GROUP_BY_SCENARIO[FAMILY[name].scenario] == "motorways"
        for found in (road["gains"], road["by_seed"]):
            found[TWO_LAWS_LABEL] = found["jam-ahead, tuned on all" if motorway else "PI, tuned on all"]
    rows = {label: {"": label} for label in (first, TWO_LAWS_LABEL, *others)}
    for heading, parts in {"seen": ("seen",), "held out": UNSEEN_PARTS}.items():
        roads = _roads_in_parts(every, parts)
        for label, row in rows.items():
            more = [road["by_seed"][first] - road["by_seed"][label] for road in roads.values()]
            row[heading] = _mean_gain([road["by_seed"][label] for road in roads.values()])
            row[f"worst, {heading}"] = _worst_gain(roads, label)
            row[f"{first} beyond it, {heading}"] = "" if label == first else _mean_gain(more)
    return pd.DataFrame([*rows.values()])


def _roads_in_parts(roads: Mapping[str, dict[str, Any]], parts: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    return {name: road for name, road in roads.items() if road["part"] in parts}


def _worst_gain(roads: Mapping[str, dict[str, Any]], label: str) -> str:
    return f"{min(road['gains'][label].mean for road in roads.values()):+.2f}"


def _mean_gain(by_road: list[Floats]) -> str:
    return format_difference(estimate(np.mean(by_road, 0)), 2)


def _gain_cells(road: dict[str, Any]) -> dict[str, str]:
    cells = {label: format_difference(road["gains"][label], 2) for label in SINGLE_CONTROLLERS}
    best: str = road["best"]
    best = {driver: label for label, driver in FAMILY_DRIVERS.items()}.get(best, best)
    return {"best expert there": best.removeprefix(PACKAGED_PREFIX), **cells}


def all_roads_figure(folder: Path) -> Figure:
    """Return roads by drivers: what each gains, people alone being 0 and the best tuned expert 1."""
    roads = road_gains(folder)
    values = np.array([[road["gains"][label].mean for label in FAMILY_DRIVERS] for road in roads.values()])
    figure = new_figure(0.3 * len(roads) + 1.0)
    axes = figure.subplots()
    # Within half of the colours, which are pale: numbers stay legible on them.
    shown = axes.imshow(values, cmap="RdYlGn", vmin=-2 * MAX_GAIN, vmax=2 * MAX_GAIN, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, f"{value:+.2f}", ha="center", va="center", color=TEXT_COLOR, fontsize=8)
    axes.set_xticks(range(len(FAMILY_DRIVERS)), list(FAMILY_DRIVERS), rotation=40, ha="right", rotation_mode="anchor")
    marks = {"seen": "", "combination": " (new combination)", "axis": " (new)"}
    axes.set_yticks(range(len(roads)), [f"{name}{marks[road['part']]}" for name, road in roads.items()])
    axes.grid(visible=False)
    figure.colorbar(shown, ax=axes, label=f"gain, kept within {MIN_GAIN:g} and {MAX_GAIN:g}", shrink=0.5)
    return figure


ALL_ROADS_STUDY = Study(
    title="what one controller gains on every road of the family, seen and held out",
    make_runs=lambda seeds: [],
    write=_write_all_roads,
    minutes=60.0,
    is_resumable=True,
    tables={
        "seen": partial(all_roads_table, ("seen",)),
        "held out": partial(all_roads_table, UNSEEN_PARTS),
        "drivers": all_drivers_table,
    },
)
