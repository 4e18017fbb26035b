"""What a drivable residual is worth on the ring: beside the tuned expert, people alone, and the ceiling.

Every driver on every length on the same seeds; the seeds are shared by all trainings, which the intervals
know. The ceiling leads all to the limit of the length, which no car can know.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE, verdicts
from unjam.measures.statistics import crossed_estimate, estimate
from unjam.measures.table import cell_of
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.studies.study import Study, StudyFolder, planned
from unjam.training.evaluate import Rows, evaluate
from unjam.training.seeds import held_out_seeds
from unjam.worlds.workers import Workers

LENGTHS = (220, 230, 240, 250, 260, 270)
SEEDS = 10
"""of each length"""
TUNED = "tuned PI"
CEILING = "leads all to the limit"
KEPT = (
    *("return", "mean_speed", "mean_speed_steady", "throughput_veh_per_h", "fuel_ml_per_km", "drivable"),
    *("min_headway", "cav_max_braking", "filter_share", "speed_std_fleet_steady", "time_to_dissolve"),
)
"""of each episode"""


def drivers_on(ring: Ring, trained: dict[str, Driver]) -> dict[str, Driver]:
    """Return all drivers of a ring of one length, by label."""
    named = {"human": "human", "PI": "pi", "PI (paper)": "pi:time_constant=0", TUNED: "unjam:ring-tuned"}
    made = {label: make_driver(name, ring.decision_step) for label, name in named.items()}
    limit = ring.limit(ring.length[0])
    made[CEILING] = FollowerStopper(desired_speed=limit, gaps=(0.5, 1.0, 1.5), time_constant=3.0)
    return {**made, **trained}


def _rows_on(ring: Scenario, drivers: dict[str, Driver], workers: Workers) -> dict[str, Any]:
    rows: Rows = evaluate(ring, drivers, held_out_seeds(SEEDS), workers).rows
    said = verdicts(rows)
    return {
        label: {"drivable": said[label], "episodes": [{name: row[name] for name in KEPT} for row in found]}
        for label, found in rows.items()
    }


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    runs = planned(["ring"], ["best"], seeds)
    trained = {f"training {run.seed}": make_driver(str(studies.folder_of(run)), 0.1) for run in runs}
    with Workers(workers) as pool:
        for name, warmup in (("ring", 0), ("ring-jammed", 6000)):
            found = {}
            for length in LENGTHS:
                ring = replace(Ring(), length=(length, length), warmup=warmup)
                found[str(length)] = _rows_on(ring, drivers_on(ring, trained), pool)
            write_whole(folder / f"{name}.json", to_json(found))


def table(road: str, folder: Path) -> pd.DataFrame:
    """Return who earns what on a road, over all lengths, and what each is beyond the tuned expert."""
    found = pd.read_json(folder / f"{road}.json", typ="series")
    labels = list(found.iloc[0])
    trainings = [label for label in labels if label.startswith("training")]
    shown = [label for label in labels if label not in trainings]
    rows = [_row(found, label, [label]) for label in shown]
    if trainings:
        rows.append(_row(found, f"residual, {len(trainings)} trainings", trainings))
    return pd.DataFrame(rows)


def _of(found: Any, label: str, name: str) -> np.ndarray:
    """Return a number of a driver's episodes: of each seed the mean over the lengths, shape (seeds,)."""
    by_length = [[row[name] for row in found[length][label]["episodes"]] for length in found.index]
    return np.array(by_length, np.float64).mean(0)


def _beyond(found: Any, members: list[str], baseline: str, name: str, digits: int) -> str:
    """Return what drivers, or several trainings, are beyond another driver on the same seeds."""
    beyond = np.array([_of(found, member, name) - _of(found, baseline, name) for member in members])
    return str(
        cell_of(crossed_estimate(beyond) if len(members) > 1 else estimate(beyond[0]), digits, sign="+")
    )


def _row(found: Any, label: str, members: list[str]) -> dict[str, Any]:
    mean = partial(_mean_of, found, members)
    drivable = [found[length][member]["drivable"] for length in found.index for member in members]
    worst = [each for each in drivable if each != DRIVABLE]
    headways = [row["min_headway"] for row in _episodes(found, members) if row["min_headway"] is not None]
    return {
        "driver": label,
        "return": f"{mean('return'):.0f}",
        "beyond the tuned expert": _beyond(found, members, TUNED, "return", 0),
        "mean speed [m/s]": f"{mean('mean_speed'):.2f}",
        "beyond people [m/s]": _beyond(found, members, "human", "mean_speed", 2),
        "flow [veh/h]": f"{mean('throughput_veh_per_h'):.0f}",
        "fuel [ml/km]": f"{mean('fuel_ml_per_km'):.0f}",
        "smallest headway [s]": f"{min(headways):.2f}" if headways else "–",
        "drivable": (worst[0] or "–") if worst else "yes",
    }


def _episodes(found: Any, members: list[str]) -> list[dict[str, Any]]:
    return [row for length in found.index for member in members for row in found[length][member]["episodes"]]


def _mean_of(found: Any, members: list[str], name: str) -> float:
    return float(np.mean([row[name] for row in _episodes(found, members)]))


DRIVABLE_STUDY = Study(
    title="what a drivable residual is worth beside the tuned expert, on the ring and the jammed ring",
    runs=lambda seeds: planned(["ring"], ["best"], seeds),
    write=_write,
    minutes=20.0,
    tables={road: partial(table, road) for road in ("ring", "ring-jammed")},
)
