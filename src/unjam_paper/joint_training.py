"""What one controller gains on each of many roads, seen and held out, that was trained on all together.

Beside what it was trained on, and the best tuned expert of each road. Rings are stepped in batches, which are
SUMO's but for rounding.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.feasibility import FEASIBLE
from unjam.measures.gain import EpisodeRows
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.statistics import estimate_on_shared_seeds, format_difference
from unjam.physics.arrays import Floats
from unjam.training.presets import RINGS_EXPERT, SHARED_RINGS_EXPERT
from unjam.training.road_family import (
    ACTUATOR_LATENCY,
    AGGRESSIVE_IDM,
    GROUP_BY_SCENARIO,
    LONG_WARM_UP,
    SHARED_RINGS_GROUP,
    SHORT_WARM_UP,
    FamilyRoad,
    family_roads,
    ring_options,
)
from unjam.training.seeds import make_test_seeds
from unjam.worlds.batch.run import run_batches
from unjam.worlds.batch.support import unsupported_reason
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.all_roads import (
    EXPERT_SELECTION_SEEDS,
    FAMILY_DRIVERS,
    FAMILY_EXPERTS,
    FAMILY_TEST_SEEDS,
    UNSEEN_PARTS,
    best_feasible_driver,
    drive_by_label,
    family_metrics,
    road_gains,
)
from unjam_paper.parts import StudyPart, measure_parts
from unjam_paper.study import VARIANTS, PlannedRun, Study, StudyFolder

RING_GROUP = "rings"
RING_BASELINES = {
    RINGS_EXPERT: RINGS_EXPERT,
    **{label: FAMILY_DRIVERS[label] for label in ("PI, tuned on the rings", "unjam:ring-best")},
}
"""who is driven on rings beside those that are trained, by label"""
SHARED_RING_BASELINES = {SHARED_RINGS_EXPERT: SHARED_RINGS_EXPERT, RINGS_EXPERT: RINGS_EXPERT}
ALL_ROADS_BASELINES = {label: FAMILY_DRIVERS[label] for label in ("unjam:best", "PI, tuned on the rings", "jam-ahead")}
SHARED_RING_ROADS = {
    **family_roads(SHARED_RINGS_GROUP),
    "ring-88-grown-6-cavs": FamilyRoad("ring", ring_options(88, 6, LONG_WARM_UP), "axis"),
    "ring-44-hurried-3-cavs": FamilyRoad("ring", ring_options(44, 3, LONG_WARM_UP, humans=AGGRESSIVE_IDM), "axis"),
    "ring-44-late-4-cavs": FamilyRoad("ring", ring_options(44, 4, LONG_WARM_UP, actuator=ACTUATOR_LATENCY), "axis"),
    "ring-55-dense-4-cavs": FamilyRoad("ring", ring_options(55, 4, LONG_WARM_UP, (9.1, 9.8)), "axis"),
    "ring-66-wide-4-cavs": FamilyRoad("ring", ring_options(66, 4, LONG_WARM_UP, (13.0, 16.0)), "axis"),
    "ring-44-standing-3-cavs": FamilyRoad("ring", ring_options(44, 3, 0), "axis"),
    "ring-33-growing-2-cavs": FamilyRoad("ring", ring_options(33, 2, SHORT_WARM_UP), "axis"),
    "ring-66-growing-4-cavs": FamilyRoad("ring", ring_options(66, 4, SHORT_WARM_UP), "axis"),
}
"""rings that several CAVs share: those of the family, and more that nobody has trained or tuned on"""
FRESH_TEST_SEEDS = make_test_seeds(20, 1000)
"""seeds on which nobody was driven when it was decided which rings want a law of their own"""


def joint_training_study(
    title: str,
    variants: dict[str, int],
    group: str = RING_GROUP,
    baselines: Mapping[str, str] = RING_BASELINES,
    roads: Mapping[str, FamilyRoad] | None = None,
    test_seeds: Sequence[tuple[int, ...]] = FAMILY_TEST_SEEDS,
) -> Study:
    """Return the study of some variants, each with the most trainings that it wants.

    They are trained on what is seen of a group of the family, and judged on all of it, or on `roads`, beside
    drivers by label; the first of these is for the same roads, and trainings are compared with it.
    """
    judged_on = family_roads(group) if roads is None else roads

    def runs(seeds: int) -> list[PlannedRun]:
        return [PlannedRun(group, name, seed) for name, most in variants.items() for seed in range(min(seeds, most))]

    def write(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        parts: dict[str, StudyPart] = {}
        for number, (name, road) in enumerate(judged_on.items()):
            trained = {
                f"{VARIANTS[run.variant].label} {run.seed}": str(joint_controller(road, run, study_folder))
                for run in runs(seeds)
            }
            parts[f"{number:02d}"] = _measure_road, (name, road, {**baselines, **trained}, list(test_seeds))
        measure_parts(folder, parts, workers)

    labels = [VARIANTS[name].label for name in variants]
    tables: dict[str, Callable[[Path], pd.DataFrame]] = {
        "seen": partial(joint_training_table, labels, ("seen",), baselines),
        "held out": partial(joint_training_table, labels, UNSEEN_PARTS, baselines),
    }
    return Study(title, runs, write, minutes=25.0, is_resumable=True, tables=tables)


def joint_controller(road: FamilyRoad, run: PlannedRun, study_folder: StudyFolder) -> Path:
    """Return where the controller of a training is that drives a road.

    One network drives all, but limits and the length of decisions are those of a kind of road: that of the
    first such road is taken.
    """
    roads, kind = run.config.task_configs(), GROUP_BY_SCENARIO[road.scenario]
    return study_folder.run_folder(run) / next(
        name for name, each in roads.items() if GROUP_BY_SCENARIO[each.scenario] == kind
    )


def _measure_road(
    name: str, road: FamilyRoad, evaluated_drivers: dict[str, str], seeds: list[tuple[int, ...]]
) -> dict[str, Any]:
    """Return what everybody did on a road on the seeds that judge; others choose its best."""
    scenario = road.make_scenario()
    tried = {driver: driver for driver in (HUMAN_LABEL, *FAMILY_EXPERTS[GROUP_BY_SCENARIO[road.scenario]])}
    with WorkerPool() as workers:
        run = partial(_run_episodes, workers)
        best = best_feasible_driver(drive_by_label(scenario, tried, EXPERT_SELECTION_SEEDS, run))
        drivers = {HUMAN_LABEL: HUMAN_LABEL, best: best, **evaluated_drivers}
        rows = drive_by_label(scenario, drivers, seeds, run)
    return {"road": name, "part": road.part, "best": best, "rows": rows}


def _run_episodes(workers: WorkerPool, tasks: list[EpisodeTask]) -> EpisodeRows:
    """Return what is kept of the episodes of one road, which may have several drivers."""
    if unsupported_reason(tasks[0].scenario):
        return workers.run_and_map(tasks, family_metrics)
    by_driver = groupby(tasks, key=lambda task: id(task.driver))
    return [family_metrics(*each) for _, some in by_driver for each in enumerate(run_batches(list(some)))]


def joint_training_table(
    labels: Sequence[str], parts: tuple[str, ...], baselines: Mapping[str, str], folder: Path
) -> pd.DataFrame:
    """Return what each gains on each road, and trainings beyond the driver that is for such roads.

    Of several trainings the interval knows that they share the seeds.
    """
    roads = {name: road for name, road in road_gains(folder).items() if road["part"] in parts}
    drivers = next(iter(roads.values()))["gains"]
    expert = next(iter(baselines))
    groups = {label: [who for who in drivers if _has_label(who, label)] for label in (*baselines, *labels)}

    def values_by_label(name: str) -> dict[str, Floats]:
        """Return a number of each label's drivers, shape (roads, drivers, seeds)."""
        return {
            label: np.array([[road[name][who] for who in group] for road in roads.values()])
            for label, group in groups.items()
        }

    gains, speeds = values_by_label("by_seed"), values_by_label("speeds")
    shown = dict(gains)
    pairs = [(label, expert) for label in labels]
    if expert != RINGS_EXPERT and RINGS_EXPERT in baselines:
        pairs.append((expert, RINGS_EXPERT))
    for one, other in pairs:
        shown[f"{one}, beyond {other}"] = gains[one] - gains[other]
        shown[f"{one}, mean speed beyond {other} [m/s]"] = speeds[one] - speeds[other]
    rows = [
        {
            "road": name,
            "best expert there": road["best"].removeprefix("unjam:"),
            **{column: _seed_cell(values[number]) for column, values in shown.items()},
        }
        for number, (name, road) in enumerate(roads.items())
    ]
    rows.append({"road": "mean", **{column: _seed_cell(values.mean(0)) for column, values in shown.items()}})
    worst, undrivable = {"road": "worst"}, {"road": "not drivable"}
    for label, group in groups.items():
        worst[label] = f"{gains[label].mean((1, 2)).min():+.2f}"
        verdicts = [road["verdicts"][who] for road in roads.values() for who in group]
        undrivable[label] = f"{sum(verdict != FEASIBLE for verdict in verdicts)} of {len(verdicts)}"
    return pd.DataFrame([*rows, worst, undrivable]).fillna("")


def _has_label(driver: str, label: str) -> bool:
    return driver == label or driver.rpartition(" ")[0] == label


def _seed_cell(values: Floats) -> str:
    """Return the mean of drivers on seeds, shape (drivers, seeds), with its interval."""
    return format_difference(estimate_on_shared_seeds(values), 2)
