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

from unjam.measures.drivable import DRIVABLE
from unjam.measures.gain import Rows
from unjam.measures.statistics import estimate_on_shared_seeds, signed
from unjam.measures.table import PEOPLE
from unjam.physics.arrays import Floats
from unjam.studies.everywhere import (
    CHOOSING,
    HELD_OUT,
    JUDGED,
    JUDGING,
    TUNED,
    best_of,
    driven,
    gains_of,
    kept_of,
)
from unjam.studies.parts import Part, measure_parts
from unjam.studies.study import VARIANTS, PlannedRun, Study, StudyFolder
from unjam.training.family import (
    GROWING,
    GROWN,
    HURRIED,
    KINDS,
    LATE,
    SHARED_RINGS,
    FamilyRoad,
    family_roads,
    ring_changes,
)
from unjam.training.presets import RINGS_TUNED, SHARED_RINGS_TUNED
from unjam.training.seeds import held_out_seeds
from unjam.worlds.batch.possible import why_not
from unjam.worlds.batch.run import run_batches
from unjam.worlds.workers import EpisodeTask, Workers

RINGS = "rings"
BESIDE = {
    RINGS_TUNED: RINGS_TUNED,
    **{label: JUDGED[label] for label in ("PI, tuned on the rings", "unjam:ring-best")},
}
"""who is driven on rings beside those that are trained, by label"""
BESIDE_SHARED = {SHARED_RINGS_TUNED: SHARED_RINGS_TUNED, RINGS_TUNED: RINGS_TUNED}
BESIDE_EVERYWHERE = {label: JUDGED[label] for label in ("unjam:best", "PI, tuned on the rings", "jam-ahead")}
SHARED = {
    **family_roads(SHARED_RINGS),
    "ring-88-grown-6-cavs": FamilyRoad("ring", ring_changes(88, 6, GROWN), "axis"),
    "ring-44-hurried-3-cavs": FamilyRoad("ring", ring_changes(44, 3, GROWN, humans=HURRIED), "axis"),
    "ring-44-late-4-cavs": FamilyRoad("ring", ring_changes(44, 4, GROWN, actuator=LATE), "axis"),
    "ring-55-dense-4-cavs": FamilyRoad("ring", ring_changes(55, 4, GROWN, (9.1, 9.8)), "axis"),
    "ring-66-wide-4-cavs": FamilyRoad("ring", ring_changes(66, 4, GROWN, (13.0, 16.0)), "axis"),
    "ring-44-standing-3-cavs": FamilyRoad("ring", ring_changes(44, 3, 0), "axis"),
    "ring-33-growing-2-cavs": FamilyRoad("ring", ring_changes(33, 2, GROWING), "axis"),
    "ring-66-growing-4-cavs": FamilyRoad("ring", ring_changes(66, 4, GROWING), "axis"),
}
"""rings that several CAVs share: those of the family, and more that nobody has trained or tuned on"""
FRESH = held_out_seeds(20, 1000)
"""seeds on which nobody was driven when it was decided which rings want a law of their own"""


def trained_together(
    title: str,
    variants: dict[str, int],
    group: str = RINGS,
    beside: Mapping[str, str] = BESIDE,
    roads: Mapping[str, FamilyRoad] | None = None,
    seeds_that_judge: Sequence[tuple[int, ...]] = JUDGING,
) -> Study:
    """Return the study of some variants, each with the most trainings that it wants.

    They are trained on what is seen of a group of the family, and judged on all of it, or on `roads`, beside
    drivers by label; the first of these is for the same roads, and trainings are compared with it.
    """
    judged_on = family_roads(group) if roads is None else roads

    def runs(seeds: int) -> list[PlannedRun]:
        return [
            PlannedRun(group, name, seed)
            for name, most in variants.items()
            for seed in range(min(seeds, most))
        ]

    def write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        parts: dict[str, Part] = {}
        for number, (name, road) in enumerate(judged_on.items()):
            trained = {
                f"{VARIANTS[run.variant].label} {run.seed}": str(controller_for(road, run, studies))
                for run in runs(seeds)
            }
            parts[f"{number:02d}"] = _on_road, (name, road, {**beside, **trained}, list(seeds_that_judge))
        measure_parts(folder, parts, workers)

    labels = [VARIANTS[name].label for name in variants]
    tables: dict[str, Callable[[Path], pd.DataFrame]] = {
        "seen": partial(table, labels, ("seen",), beside),
        "held out": partial(table, labels, HELD_OUT, beside),
    }
    return Study(title, runs, write, minutes=25.0, goes_on=True, tables=tables)


def controller_for(road: FamilyRoad, run: PlannedRun, studies: StudyFolder) -> Path:
    """Return where the controller of a training is that drives a road.

    One network drives all, but limits and the length of decisions are those of a kind of road: that of the
    first such road is taken.
    """
    roads, kind = run.config.roads(), KINDS[road.scenario]
    return studies.folder_of(run) / next(name for name, each in roads.items() if KINDS[each.scenario] == kind)


def _on_road(
    name: str, road: FamilyRoad, judged: dict[str, str], seeds: list[tuple[int, ...]]
) -> dict[str, Any]:
    """Return what everybody did on a road on the seeds that judge; others choose its best."""
    scenario = road.make()
    tried = {driver: driver for driver in (PEOPLE, *TUNED[KINDS[road.scenario]])}
    with Workers() as workers:
        run = partial(_measured, workers)
        best = best_of(driven(scenario, tried, CHOOSING, run))
        drivers = {PEOPLE: PEOPLE, best: best, **judged}
        rows = driven(scenario, drivers, seeds, run)
    return {"road": name, "part": road.part, "best": best, "rows": rows}


def _measured(workers: Workers, tasks: list[EpisodeTask]) -> Rows:
    """Return what is kept of the episodes of one road, which may have several drivers."""
    if why_not(tasks[0].scenario):
        return workers.run_each(tasks, kept_of)
    by_driver = groupby(tasks, key=lambda task: id(task.driver))
    return [kept_of(*each) for _, some in by_driver for each in enumerate(run_batches(list(some)))]


def table(
    labels: Sequence[str], parts: tuple[str, ...], beside: Mapping[str, str], folder: Path
) -> pd.DataFrame:
    """Return what each gains on each road, and trainings beyond the driver that is for such roads.

    Of several trainings the interval knows that they share the seeds.
    """
    roads = {name: road for name, road in gains_of(folder).items() if road["part"] in parts}
    drivers = next(iter(roads.values()))["gains"]
    expert = next(iter(beside))
    groups = {label: [who for who in drivers if _named(who, label)] for label in (*beside, *labels)}

    def grouped(name: str) -> dict[str, Floats]:
        """Return a number of each label's drivers, shape (roads, drivers, seeds)."""
        return {
            label: np.array([[road[name][who] for who in group] for road in roads.values()])
            for label, group in groups.items()
        }

    gains, speeds = grouped("by_seed"), grouped("speeds")
    shown = dict(gains)
    pairs = [(label, expert) for label in labels]
    if expert != RINGS_TUNED and RINGS_TUNED in beside:
        pairs.append((expert, RINGS_TUNED))
    for one, other in pairs:
        shown[f"{one}, beyond {other}"] = gains[one] - gains[other]
        shown[f"{one}, mean speed beyond {other} [m/s]"] = speeds[one] - speeds[other]
    rows = [
        {
            "road": name,
            "best expert there": road["best"].removeprefix("unjam:"),
            **{column: _cell(values[number]) for column, values in shown.items()},
        }
        for number, (name, road) in enumerate(roads.items())
    ]
    rows.append({"road": "mean", **{column: _cell(values.mean(0)) for column, values in shown.items()}})
    worst, undrivable = {"road": "worst"}, {"road": "not drivable"}
    for label, group in groups.items():
        worst[label] = f"{gains[label].mean((1, 2)).min():+.2f}"
        verdicts = [road["verdicts"][who] for road in roads.values() for who in group]
        undrivable[label] = f"{sum(verdict != DRIVABLE for verdict in verdicts)} of {len(verdicts)}"
    return pd.DataFrame([*rows, worst, undrivable]).fillna("")


def _named(who: str, label: str) -> bool:
    return who == label or who.rpartition(" ")[0] == label


def _cell(values: Floats) -> str:
    """Return the mean of drivers on seeds, shape (drivers, seeds), with its interval."""
    return signed(estimate_on_shared_seeds(values), 2)
