"""Gain of drivers on the training roads and unseen roads of the family, and of trainings on many roads together.

On each road the human baseline has a gain of 0, and the best tuned expert, selected on other seeds, a gain of 1.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from unjam.benchmarks.result import FAMILY_TEST_SEEDS
from unjam.benchmarks.run import Seeds, drive_by_label
from unjam.controller import PACKAGED_PREFIX
from unjam.measures import gain
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.gain import EpisodeRows
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.statistics import estimate, estimate_on_shared_seeds, format_difference
from unjam.physics.arrays import Floats
from unjam.reports.figures import TEXT_COLOR, new_figure
from unjam.reports.results import replace_null
from unjam.road_family import (
    AGGRESSIVE_IDM,
    FAMILY,
    GROUP_BY_SCENARIO,
    LATENCY,
    LONG_WARM_UP,
    SHARED_RINGS_GROUP,
    SHORT_WARM_UP,
    FamilyRoad,
    ring_options,
)
from unjam.scenarios import make_scenario
from unjam.scenarios.family import family_roads
from unjam.seeds import held_out_seeds, tuning_seeds
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import StudyPart, read_parts
from unjam_paper.study import PlannedRun, Study, StudyFolder
from unjam_paper.variants import RINGS_EXPERT, SHARED_RINGS_EXPERT, VARIANTS

EXPERT_SELECTION_SEEDS = tuning_seeds(len(FAMILY_TEST_SEEDS), 1000)
PI_TUNED_ON_RINGS = "pi:window=23,catch_up_speed=0.5994,gap_lower=3,gap_upper=50,time_constant=0.9775,safe_gap=4"
"""result of `unjam tune rings --expert pi --max-string-gain 0`"""
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
        *("pi", "unjam:ring-tuned", "unjam:ring-gap-tuned", "unjam:ring-jammed-tuned-ideal", "unjam:rings-tuned"),
        *("unjam:shared-rings-tuned", "follower-stopper", PI_TUNED_ON_ALL, GAP_PI_TUNED_ON_ALL),
    ),
    "figure-eights": ("unjam:figure-eight-tuned-ideal", "pacer:use_tuned=true", PI_TUNED_ON_ALL),
    "motorways": ("jam-ahead", "unjam:on-ramp-tuned", "cruise", "adaptive-acc", JAM_AHEAD_TUNED_ON_ALL),
}
"""experts by group of roads; the best one on a road has a gain of 1 there"""
UNSEEN_PARTS = ("combination", "axis")
"""parts of the family on which no driver was trained or tuned"""
TABLE_PARTS = {"training": ("training",), "unseen": UNSEEN_PARTS}
"""parts of the family by name of a table"""
PI_ON_ALL_LABEL, JAM_AHEAD_ON_ALL_LABEL = "PI, tuned on all roads", "jam-ahead, tuned on all roads"
PI_ON_RINGS_LABEL = "PI, tuned on the rings"
SINGLE_CONTROLLERS: dict[str, str] = {
    **{"unjam:best": "unjam:best", PI_ON_ALL_LABEL: PI_TUNED_ON_ALL, "gap PI, tuned on all roads": GAP_PI_TUNED_ON_ALL},
    **{JAM_AHEAD_ON_ALL_LABEL: JAM_AHEAD_TUNED_ON_ALL, PI_ON_RINGS_LABEL: PI_TUNED_ON_RINGS},
}
"""drivers for all roads, by label: experts, and a file with several experts"""
CLOSED_ROAD_CONTROLLERS = ("unjam:ring-best-ideal", "unjam:ring-jammed-best-ideal", "unjam:figure-eight-best-ideal")
MOTORWAY_CONTROLLERS = ("unjam:on-ramp-tuned",)
"""packaged controllers with the control step of closed roads, and with that of motorways"""
FAMILY_DRIVERS: dict[str, str] = {
    **SINGLE_CONTROLLERS,
    **{"jam-ahead": "jam-ahead", "FollowerStopper": "follower-stopper"},
    **{name: name for name in (*CLOSED_ROAD_CONTROLLERS, *MOTORWAY_CONTROLLERS)},
}
"""drivers that are evaluated on every road, by label"""
TWO_FORMULAS_LABEL = "PI on rings and figure eights, jam-ahead on motorways (tuned on all roads)"
"""label of the combination of two controllers by type of road; its results are those of the two controllers"""
RING_GROUP = "rings"
RING_BASELINES = {
    RINGS_EXPERT: RINGS_EXPERT,
    **{label: FAMILY_DRIVERS[label] for label in (PI_ON_RINGS_LABEL, "unjam:ring-best-ideal")},
}
SHARED_RING_BASELINES = {SHARED_RINGS_EXPERT: SHARED_RINGS_EXPERT, RINGS_EXPERT: RINGS_EXPERT}
ALL_ROADS_BASELINES = {label: FAMILY_DRIVERS[label] for label in ("unjam:best", PI_ON_RINGS_LABEL, "jam-ahead")}
"""drivers that are compared with trainings, by label; the first one is the expert for these roads"""
UNSEEN_SHARED_RINGS = {
    "ring-88-grown-6-cavs": ring_options(88, 6, LONG_WARM_UP),
    "ring-44-aggressive-3-cavs": ring_options(44, 3, LONG_WARM_UP, humans=AGGRESSIVE_IDM),
    "ring-44-delayed-4-cavs": ring_options(44, 4, LONG_WARM_UP, actuator=LATENCY),
    "ring-55-dense-4-cavs": ring_options(55, 4, LONG_WARM_UP, (9.1, 9.8)),
    "ring-66-wide-4-cavs": ring_options(66, 4, LONG_WARM_UP, (13.0, 16.0)),
    "ring-44-no-warm-up-3-cavs": ring_options(44, 3, 0),
    "ring-33-growing-2-cavs": ring_options(33, 2, SHORT_WARM_UP),
    "ring-66-growing-4-cavs": ring_options(66, 4, SHORT_WARM_UP),
}
SHARED_RING_ROADS = family_roads(SHARED_RINGS_GROUP)
SHARED_RING_ROADS |= {name: FamilyRoad("ring", options, "axis") for name, options in UNSEEN_SHARED_RINGS.items()}
"""rings with several CAVs: those of the family, and other unseen rings"""
FRESH_TEST_SEEDS = held_out_seeds(20, 1000)
"""test seeds that were not used to decide which rings have an expert of their own"""


def _family_drivers(road: FamilyRoad) -> dict[str, str]:
    """Return the drivers of a road by label, with `human` for controllers that cannot drive on it: their gain is 0."""
    unsuitable = CLOSED_ROAD_CONTROLLERS if _is_motorway(road) else MOTORWAY_CONTROLLERS
    return FAMILY_DRIVERS | dict.fromkeys(unsuitable, HUMAN_LABEL)


def road_parts(
    roads: Mapping[str, FamilyRoad],
    make_drivers: Callable[[FamilyRoad], Mapping[str, str]],
    test_seeds: Seeds,
    in_batches: bool,
) -> dict[str, StudyPart]:
    """Return a part for each road, with the drivers that are evaluated on it."""
    parts: dict[str, StudyPart] = {}
    for index, (name, road) in enumerate(roads.items()):
        experts = FAMILY_EXPERTS[GROUP_BY_SCENARIO[road.scenario]]
        parts[f"{index:02d}"] = measure_road, (name, road, experts, make_drivers(road), test_seeds, in_batches)
    return parts


def _is_motorway(road: FamilyRoad) -> bool:
    return GROUP_BY_SCENARIO[road.scenario] == "motorways"


def measure_road(
    name: str,
    road: FamilyRoad,
    experts: Sequence[str],
    drivers: Mapping[str, str],
    test_seeds: Seeds,
    in_batches: bool,
    workers: int,
) -> dict[str, Any]:
    """Return the metrics of all drivers of a road on the test seeds, and its best expert, selected on other seeds."""
    scenario = make_scenario(road.scenario, road.options)
    candidates = {driver: driver for driver in (HUMAN_LABEL, *experts)}
    with WorkerPool(workers) as pool:
        best = best_feasible_driver(drive_by_label(scenario, candidates, EXPERT_SELECTION_SEEDS, pool, in_batches))
        evaluated = {HUMAN_LABEL: HUMAN_LABEL, best: best, **drivers}
        rows = drive_by_label(scenario, evaluated, test_seeds, pool, in_batches)
    return {"road": name, "part": road.part, "best": best, "rows": rows}


def best_feasible_driver(rows: Mapping[str, EpisodeRows]) -> str:
    """Return the best of the drivers that are feasible in all episodes; `human` if none is."""
    baseline, candidates = rows[HUMAN_LABEL], [label for label in rows if label != HUMAN_LABEL]
    feasible = [HUMAN_LABEL, *(label for label in candidates if overall_feasibility(rows[label], baseline) == FEASIBLE)]
    return max(feasible, key=lambda label: float(np.mean([gain.performance(row) for row in rows[label]])))


def road_gains(folder: Path, parts: Sequence[str] = ("training", *UNSEEN_PARTS)) -> dict[str, dict[str, Any]]:
    """Return for each road its part of the family, its best expert, and gains, speeds and feasibility by driver.

    `has_potential_gain`: the best expert is more than negligibly better than human traffic. Speeds are by seed [m/s].
    """
    roads: dict[str, dict[str, Any]] = {}
    for name, results in read_parts(folder).items():
        if not name.isdecimal() or results["part"] not in parts:
            continue
        stored: dict[str, EpisodeRows] = results["rows"]
        rows = {label: list(map(replace_null, episodes)) for label, episodes in stored.items()}
        best = [gain.performance(row) for row in rows[results["best"]]]
        baseline = rows.pop(HUMAN_LABEL)
        roads[results["road"]] = {
            **{key: results[key] for key in ("part", "best")},
            "has_potential_gain": not gain.is_gain_negligible(baseline, best),
            "gains": {label: gain.normalized_gain(episodes, baseline, best) for label, episodes in rows.items()},
            "by_seed": {label: gain.gain_by_seed(episodes, baseline, best) for label, episodes in rows.items()},
            "speeds": {label: np.array([row["mean_speed"] for row in episodes]) for label, episodes in rows.items()},
            "verdicts": {label: overall_feasibility(episodes, baseline) for label, episodes in rows.items()},
        }
    return roads


def suite_references(path: Path) -> dict[str, Any]:
    """Return by road the best expert, and its performance and that of human drivers by seed, for benchmarks."""
    parts = read_parts(path)
    manifest, references = parts["manifest"], dict[str, Any]()
    for name, part in parts.items():
        if name.isdecimal():
            rows = {label: map(replace_null, part["rows"][label]) for label in (HUMAN_LABEL, part["best"])}
            human, best = (list(map(gain.performance, rows[label])) for label in (HUMAN_LABEL, part["best"]))
            references[part["road"]] = {"expert": part["best"], "baseline": human, "performance": best}
    origin = {key: manifest[key] for key in ("unjam", "commit", "started")}
    return {"study": "all-roads", **origin, "sumo": manifest["packages"]["eclipse-sumo"], "roads": references}


def all_roads_table(parts: Sequence[str], folder: Path) -> pd.DataFrame:
    """Return the gains of the `SINGLE_CONTROLLERS` on roads of some parts of the family, their means and minima."""
    roads = road_gains(folder, parts)
    labels = {driver: label for label, driver in FAMILY_DRIVERS.items()}
    rows = []
    for name, road in roads.items():
        best: str = road["best"]
        gains = {label: format_difference(road["gains"][label], 2) for label in SINGLE_CONTROLLERS}
        rows.append({"road": name, "best expert": labels.get(best, best).removeprefix(PACKAGED_PREFIX), **gains})
    roads_with_gain = [road for road in roads.values() if road["has_potential_gain"]]
    for heading, group in (("mean", [*roads.values()]), ("mean, roads with a potential gain", roads_with_gain)):
        means = {label: _mean_gain(road["by_seed"][label] for road in group) for label in SINGLE_CONTROLLERS}
        rows.append({"road": heading, **means})
    rows.append({"road": "worst", **{label: _worst_gain(roads, label) for label in SINGLE_CONTROLLERS}})
    return pd.DataFrame(rows).fillna("")


def all_drivers_table(folder: Path) -> pd.DataFrame:
    """Return the mean and the smallest gain of each driver by part of the family, and the difference to the first."""
    first, *others = FAMILY_DRIVERS
    rows = {label: {"": label} for label in (first, TWO_FORMULAS_LABEL, *others)}
    for heading, parts in TABLE_PARTS.items():
        roads = road_gains(folder, parts)
        for name, road in roads.items():
            formula = JAM_AHEAD_ON_ALL_LABEL if _is_motorway(FAMILY[name]) else PI_ON_ALL_LABEL
            for gains in (road["gains"], road["by_seed"]):
                gains[TWO_FORMULAS_LABEL] = gains[formula]
        for label, row in rows.items():
            differences = (road["by_seed"][first] - road["by_seed"][label] for road in roads.values())
            row[heading] = _mean_gain(road["by_seed"][label] for road in roads.values())
            row[f"worst, {heading}"] = _worst_gain(roads, label)
            row[f"{first}, difference to it, {heading}"] = "" if label == first else _mean_gain(differences)
    return pd.DataFrame([*rows.values()])


def _worst_gain(roads: Mapping[str, dict[str, Any]], label: str) -> str:
    return f"{min(road['gains'][label].mean for road in roads.values()):+.2f}"


def _mean_gain(by_road: Iterable[Floats]) -> str:
    """Return the mean over roads with its 95 % CI over roads, which differ more than seeds."""
    return format_difference(estimate([float(np.mean(values)) for values in by_road]), 2)


def all_roads_figure(folder: Path) -> Figure:
    """Draw a map of the gains, roads by drivers."""
    roads = road_gains(folder)
    values = np.array([[road["gains"][label].mean for label in FAMILY_DRIVERS] for road in roads.values()])
    figure = new_figure(0.3 * len(roads) + 1.0)
    axes = figure.subplots()
    # Limits twice as wide as the gains select the pale half of the color map, on which numbers are legible.
    image = axes.imshow(values, cmap="RdYlGn", vmin=-2 * gain.MAX_GAIN, vmax=2 * gain.MAX_GAIN, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, f"{value:+.2f}", ha="center", va="center", color=TEXT_COLOR, fontsize=8)
    axes.set_xticks(range(len(FAMILY_DRIVERS)), list(FAMILY_DRIVERS), rotation=40, ha="right", rotation_mode="anchor")
    marks = {"training": "", "combination": " (new combination)", "axis": " (new)"}
    axes.set_yticks(range(len(roads)), [f"{name}{marks[road['part']]}" for name, road in roads.items()])
    axes.grid(visible=False)
    figure.colorbar(image, ax=axes, label=f"gain, limited to {gain.MIN_GAIN:g} to {gain.MAX_GAIN:g}", shrink=0.5)
    return figure


ALL_ROADS_STUDY = Study(
    title="gain of one controller on every road of the family, training roads and unseen roads",
    make_parts=lambda study_folder, seeds: road_parts(FAMILY, _family_drivers, FAMILY_TEST_SEEDS, in_batches=False),
    minutes=60.0,
    tables={
        **{name: partial(all_roads_table, parts) for name, parts in TABLE_PARTS.items()},
        "drivers": all_drivers_table,
    },
)


def joint_training_study(
    title: str,
    variants: Mapping[str, int],
    group: str = RING_GROUP,
    baselines: Mapping[str, str] = RING_BASELINES,
    roads: Mapping[str, FamilyRoad] | None = None,
    test_seeds: Seeds = FAMILY_TEST_SEEDS,
) -> Study:
    """Return the study of variants that were trained on a group of roads, on all roads of this group, or on `roads`.

    `variants` has the maximum number of trainings by variant.
    """

    def make_runs(seeds: int) -> list[PlannedRun]:
        return [PlannedRun(group, name, seed) for name, limit in variants.items() for seed in range(min(seeds, limit))]

    def make_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
        def make_drivers(road: FamilyRoad) -> dict[str, str]:
            trained = {
                f"{VARIANTS[run.variant].label} {run.seed}": str(joint_controller(road, run, study_folder))
                for run in make_runs(seeds)
            }
            return {**baselines, **trained}

        return road_parts(roads or family_roads(group), make_drivers, test_seeds, in_batches=True)

    labels = [VARIANTS[name].label for name in variants]
    tables = {name: partial(joint_training_table, labels, parts, baselines) for name, parts in TABLE_PARTS.items()}
    return Study(title, make_runs, make_parts, minutes=25.0, tables=tables)


def joint_controller(road: FamilyRoad, run: PlannedRun, study_folder: StudyFolder) -> Path:
    """Return the folder of the controller of a training for the first of its roads that has the type of `road`."""
    group = GROUP_BY_SCENARIO[road.scenario]
    configs = run.config.task_configs().items()
    name = next(name for name, config in configs if GROUP_BY_SCENARIO[config.scenario] == group)
    return study_folder.run_folder(run) / name


def joint_training_table(
    labels: Sequence[str], parts: Sequence[str], baselines: Mapping[str, str], folder: Path
) -> pd.DataFrame:
    """Return gains of baselines and trainings on each road, and differences of trainings to the first baseline."""
    roads = road_gains(folder, parts)
    drivers = next(iter(roads.values()))["gains"]
    expert = next(iter(baselines))
    groups = {
        label: [driver for driver in drivers if label in (driver, driver.rpartition(" ")[0])]
        for label in (*baselines, *labels)
    }

    def values_by_label(name: str) -> dict[str, Floats]:
        """Return a quantity of the drivers of each label, shape (roads, drivers, seeds)."""
        return {
            label: np.array([[road[name][driver] for driver in group] for road in roads.values()])
            for label, group in groups.items()
        }

    def cell_text(values: Floats) -> str:
        return format_difference(estimate_on_shared_seeds(values), 2)

    gains, speeds = values_by_label("by_seed"), values_by_label("speeds")
    columns = dict(gains)
    pairs = [(label, expert) for label in labels]
    if expert != RINGS_EXPERT and RINGS_EXPERT in baselines:
        pairs.append((expert, RINGS_EXPERT))
    for label, baseline in pairs:
        columns[f"{label}, difference to {baseline}"] = gains[label] - gains[baseline]
        columns[f"{label}, mean speed, difference to {baseline} [m/s]"] = speeds[label] - speeds[baseline]
    rows: list[dict[str, str]] = []
    for index, (name, road) in enumerate(roads.items()):
        cells = {column: cell_text(values[index]) for column, values in columns.items()}
        rows.append({"road": name, "best expert": road["best"].removeprefix("unjam:"), **cells})
    rows.append({"road": "mean", **{column: cell_text(values.mean(0)) for column, values in columns.items()}})
    worst, infeasible = {"road": "worst"}, {"road": "infeasible"}
    for label, group in groups.items():
        worst[label] = f"{gains[label].mean((1, 2)).min():+.2f}"
        verdicts = [road["verdicts"][driver] for road in roads.values() for driver in group]
        infeasible[label] = f"{sum(verdict != FEASIBLE for verdict in verdicts)} of {len(verdicts)}"
    return pd.DataFrame([*rows, worst, infeasible]).fillna("")
