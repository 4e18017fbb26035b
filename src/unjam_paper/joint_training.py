"""Gain of one controller that is trained on many roads together, on each training road and on unseen roads.

Rings are stepped in batches, which equal SUMO's except for rounding.
"""

from collections.abc import Mapping, Sequence
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
    PI_ON_RINGS_LABEL,
    TABLE_PARTS,
    best_feasible_driver,
    drive_by_label,
    family_metrics,
    road_gains,
)
from unjam_paper.parts import StudyPart, measure_parts
from unjam_paper.study import PlannedRun, Study, StudyFolder
from unjam_paper.variants import RINGS_EXPERT, SHARED_RINGS_EXPERT, VARIANTS

RING_GROUP = "rings"
RING_BASELINES = {
    RINGS_EXPERT: RINGS_EXPERT,
    **{label: FAMILY_DRIVERS[label] for label in (PI_ON_RINGS_LABEL, "unjam:ring-best")},
}
SHARED_RING_BASELINES = {SHARED_RINGS_EXPERT: SHARED_RINGS_EXPERT, RINGS_EXPERT: RINGS_EXPERT}
ALL_ROADS_BASELINES = {label: FAMILY_DRIVERS[label] for label in ("unjam:best", PI_ON_RINGS_LABEL, "jam-ahead")}
"""drivers that are evaluated together with the trained ones; the first is the expert for these roads"""
SHARED_RING_ROADS = {
    **family_roads(SHARED_RINGS_GROUP),
    **{
        name: FamilyRoad("ring", options, "axis")
        for name, options in {
            "ring-88-grown-6-cavs": ring_options(88, 6, LONG_WARM_UP),
            "ring-44-aggressive-3-cavs": ring_options(44, 3, LONG_WARM_UP, humans=AGGRESSIVE_IDM),
            "ring-44-delayed-4-cavs": ring_options(44, 4, LONG_WARM_UP, actuator=ACTUATOR_LATENCY),
            "ring-55-dense-4-cavs": ring_options(55, 4, LONG_WARM_UP, (9.1, 9.8)),
            "ring-66-wide-4-cavs": ring_options(66, 4, LONG_WARM_UP, (13.0, 16.0)),
            "ring-44-no-warm-up-3-cavs": ring_options(44, 3, 0),
            "ring-33-growing-2-cavs": ring_options(33, 2, SHORT_WARM_UP),
            "ring-66-growing-4-cavs": ring_options(66, 4, SHORT_WARM_UP),
        }.items()
    },
}
"""rings that several CAVs share: those of the family, and further unseen ones"""
FRESH_TEST_SEEDS = make_test_seeds(20, 1000)
"""test seeds that were not used in the decision which rings get an expert of their own"""


def joint_training_study(
    title: str,
    variants: Mapping[str, int],
    group: str = RING_GROUP,
    baselines: Mapping[str, str] = RING_BASELINES,
    roads: Mapping[str, FamilyRoad] | None = None,
    test_seeds: Sequence[tuple[int, ...]] = FAMILY_TEST_SEEDS,
) -> Study:
    """Return the study of variants, each with its maximum number of trainings.

    They are trained on the training roads of a group of the family, and evaluated on all its roads, or on `roads`.
    """
    test_roads = family_roads(group) if roads is None else roads

    def make_runs(seeds: int) -> list[PlannedRun]:
        return [PlannedRun(group, name, seed) for name, limit in variants.items() for seed in range(min(seeds, limit))]

    def write(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        parts: dict[str, StudyPart] = {}
        for number, (name, road) in enumerate(test_roads.items()):
            trained = {
                f"{VARIANTS[run.variant].label} {run.seed}": str(joint_controller(road, run, study_folder))
                for run in make_runs(seeds)
            }
            parts[f"{number:02d}"] = _measure_road, (name, road, {**baselines, **trained}, list(test_seeds))
        measure_parts(folder, parts, workers)

    labels = [VARIANTS[name].label for name in variants]
    tables = {name: partial(joint_training_table, labels, parts, baselines) for name, parts in TABLE_PARTS.items()}
    return Study(title, write, make_runs, minutes=25.0, is_resumable=True, tables=tables)


def joint_controller(road: FamilyRoad, run: PlannedRun, study_folder: StudyFolder) -> Path:
    """Return the folder of a training's controller for a road.

    One network drives all roads, but limits and control step are those of a type of road: the controller of the first
    training road of the same type.
    """
    group = GROUP_BY_SCENARIO[road.scenario]
    configs = run.config.task_configs().items()
    name = next(name for name, config in configs if GROUP_BY_SCENARIO[config.scenario] == group)
    return study_folder.run_folder(run) / name


def _measure_road(
    name: str, road: FamilyRoad, evaluated_drivers: Mapping[str, str], seeds: list[tuple[int, ...]]
) -> dict[str, Any]:
    """Return the metrics of all drivers on a road on the test seeds; its best expert is selected on other seeds."""
    scenario = road.make_scenario()
    candidates = {driver: driver for driver in (HUMAN_LABEL, *FAMILY_EXPERTS[GROUP_BY_SCENARIO[road.scenario]])}
    with WorkerPool() as workers:
        run = partial(_run_episodes, workers)
        best = best_feasible_driver(drive_by_label(scenario, candidates, EXPERT_SELECTION_SEEDS, run))
        rows = drive_by_label(scenario, {HUMAN_LABEL: HUMAN_LABEL, best: best, **evaluated_drivers}, seeds, run)
    return {"road": name, "part": road.part, "best": best, "rows": rows}


def _run_episodes(workers: WorkerPool, tasks: list[EpisodeTask]) -> EpisodeRows:
    """Return the metrics of episodes of one road and several drivers, in batches where they are supported."""
    if unsupported_reason(tasks[0].scenario):
        return workers.run_and_map(tasks, family_metrics)
    by_driver = groupby(tasks, key=lambda task: id(task.driver))
    return [family_metrics(*each) for _, own in by_driver for each in enumerate(run_batches(list(own)))]


def joint_training_table(
    labels: Sequence[str], parts: Sequence[str], baselines: Mapping[str, str], folder: Path
) -> pd.DataFrame:
    """Return the gain of each driver on each road, and the difference of trainings to the expert for such roads.

    Confidence intervals of several trainings take into account that they share the seeds.
    """
    roads = {name: road for name, road in road_gains(folder).items() if road["part"] in parts}
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

    gains, speeds = values_by_label("by_seed"), values_by_label("speeds")
    columns = dict(gains)
    pairs = [(label, expert) for label in labels]
    if expert != RINGS_EXPERT and RINGS_EXPERT in baselines:
        pairs.append((expert, RINGS_EXPERT))
    for one, other in pairs:
        columns[f"{one}, difference to {other}"] = gains[one] - gains[other]
        columns[f"{one}, mean speed, difference to {other} [m/s]"] = speeds[one] - speeds[other]
    rows = [
        {
            "road": name,
            "best expert": road["best"].removeprefix("unjam:"),
            **{column: _seed_cell(values[number]) for column, values in columns.items()},
        }
        for number, (name, road) in enumerate(roads.items())
    ]
    rows.append({"road": "mean", **{column: _seed_cell(values.mean(0)) for column, values in columns.items()}})
    worst, infeasible = {"road": "worst"}, {"road": "infeasible"}
    for label, group in groups.items():
        worst[label] = f"{gains[label].mean((1, 2)).min():+.2f}"
        verdicts = [road["verdicts"][driver] for road in roads.values() for driver in group]
        infeasible[label] = f"{sum(verdict != FEASIBLE for verdict in verdicts)} of {len(verdicts)}"
    return pd.DataFrame([*rows, worst, infeasible]).fillna("")


def _seed_cell(values: Floats) -> str:
    """Return the mean over drivers and seeds with its 95 % CI; values have the shape (drivers, seeds)."""
    return format_difference(estimate_on_shared_seeds(values), 2)
