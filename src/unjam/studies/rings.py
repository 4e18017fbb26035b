"""What one residual gains on each ring of the family, seen and held out, that was trained on all together.

Beside the expert that was tuned for all of them at once, and the best tuned expert of each. Rings are stepped
in batches, which are SUMO's but for rounding.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.gain import Rows, gain_by_seed, worth
from unjam.measures.statistics import Estimate, crossed_estimate, estimate, signed
from unjam.measures.table import PEOPLE
from unjam.physics.arrays import Floats
from unjam.studies.everywhere import (
    CHOOSING,
    HELD_OUT,
    JUDGING,
    PI_ON_RINGS,
    TUNED,
    best_of,
    driven,
    rows_of,
)
from unjam.studies.study import VARIANTS, PlannedRun, Study, StudyFolder, measure_parts
from unjam.training.family import FAMILY
from unjam.training.presets import RINGS_TUNED
from unjam.worlds.batch.run import run_batches

ROAD = "rings"
"""the roads that are trained on together"""
PI = "PI, tuned on the rings"
BESIDE = {RINGS_TUNED: RINGS_TUNED, PI: PI_ON_RINGS, "unjam:ring-best": "unjam:ring-best"}
"""who is driven beside those that are trained, by label"""
RINGS = [name for name, road in FAMILY.items() if road.scenario == "ring"]
BEYOND = f"beyond {RINGS_TUNED}"


def on_rings(title: str, variants: dict[str, int]) -> Study:
    """Return the study of some variants, each with the most trainings that it wants."""

    def runs(seeds: int) -> list[PlannedRun]:
        return [
            PlannedRun(ROAD, name, seed)
            for name, most in variants.items()
            for seed in range(min(seeds, most))
        ]

    def write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        trained = {
            f"{VARIANTS[run.variant].label} {run.seed}": str(studies.controller_of(run))
            for run in runs(seeds)
        }
        parts = {f"{number:02d}": (_on_ring, (name, trained)) for number, name in enumerate(RINGS)}
        measure_parts(folder, parts, workers)

    labels = [VARIANTS[name].label for name in variants]
    tables: dict[str, Callable[[Path], pd.DataFrame]] = {
        "seen": partial(table, labels, ("seen",)),
        "held out": partial(table, labels, HELD_OUT),
    }
    return Study(title, runs, write, minutes=10.0, goes_on=True, tables=tables)


def _on_ring(name: str, trained: dict[str, str]) -> dict[str, Any]:
    """Return what everybody did on a ring of the family on the seeds that judge; others choose its best."""
    scenario = FAMILY[name].make()
    tried = {driver: driver for driver in (PEOPLE, *TUNED[ROAD])}
    best = best_of(driven(scenario, tried, CHOOSING, run_batches))
    drivers = {PEOPLE: PEOPLE, best: best, **BESIDE, **trained}
    rows = driven(scenario, drivers, JUDGING, run_batches)
    return {"road": name, "part": FAMILY[name].part, "best": best, "rows": rows}


def _gains(folder: Path, parts: tuple[str, ...], labels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return of each ring its best expert, and by label the gains, shape (drivers of that label, seeds).

    Besides the mean speed of the whole episode, start and waves included, in the same shape [m/s].
    """
    found: dict[str, dict[str, Any]] = {}
    for file in sorted(folder.glob("[0-9]*.json")):
        of = json.loads(file.read_text())
        if of["part"] in parts:
            rows = rows_of(of)
            best = float(np.mean([worth(row) for row in rows[of["best"]]]))
            groups = {label: [who for who in rows if _named(who, label)] for label in labels}
            found[of["road"]] = {
                "best": of["best"],
                "gains": {
                    label: np.array([gain_by_seed(rows[who], rows[PEOPLE], best) for who in group])
                    for label, group in groups.items()
                },
                "speed": {
                    label: np.array([[row["mean_speed"] for row in rows[who]] for who in group])
                    for label, group in groups.items()
                },
                "undrivable": {label: _undrivable(rows, group) for label, group in groups.items()},
            }
    return found


def _named(who: str, label: str) -> bool:
    return who == label or who.rpartition(" ")[0] == label


def _undrivable(rows: dict[str, Rows], group: Sequence[str]) -> int:
    """Return how many of these no car could have driven in all episodes."""
    return sum(drivable_in_all(rows[who], rows[PEOPLE]) != DRIVABLE for who in group)


def table(labels: Sequence[str], parts: tuple[str, ...], folder: Path) -> pd.DataFrame:
    """Return what each gains on each ring, and trainings beyond the expert that was tuned for all rings.

    Of several trainings the interval knows that they share the seeds.
    """
    everybody = (*BESIDE, *labels)
    found = _gains(folder, parts, everybody)
    gains, speeds = ({road: of[name] for road, of in found.items()} for name in ("gains", "speed"))
    rows = [
        {
            "road": road,
            "best expert there": found[road]["best"].removeprefix("unjam:"),
            **_cells(of, speeds[road], labels),
        }
        for road, of in gains.items()
    ]
    mean: dict[str, Floats] = {}
    speed: dict[str, Floats] = {}
    worst, undrivable = {"road": "worst"}, {"road": "not drivable"}
    for label in everybody:
        mean[label], speed[label] = (
            np.mean([of[label] for of in each.values()], axis=0) for each in (gains, speeds)
        )
        worst[label] = f"{min(float(of[label].mean()) for of in gains.values()):+.2f}"
        count = sum(of["undrivable"][label] for of in found.values())
        undrivable[label] = f"{count} of {len(mean[label]) * len(found)}"
    rows += [{"road": "mean", **_cells(mean, speed, labels)}, worst, undrivable]
    return pd.DataFrame(rows).fillna("")


def _cells(gains: dict[str, Floats], speeds: dict[str, Floats], labels: Sequence[str]) -> dict[str, str]:
    beyond = {f"{label}, {BEYOND}": gains[label] - gains[RINGS_TUNED] for label in labels}
    beyond |= {f"{label}, mean speed {BEYOND} [m/s]": speeds[label] - speeds[RINGS_TUNED] for label in labels}
    return {label: signed(_estimate(values), 2) for label, values in {**gains, **beyond}.items()}


def _estimate(values: Floats) -> Estimate:
    return crossed_estimate(values) if len(values) > 1 else estimate(values[0].tolist())
