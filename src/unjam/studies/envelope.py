"""How far from its own road a shipped controller stays drivable, and what late cars and wrong sensors cost.

Rings from 5 to 44 vehicles, shorter and longer than trained on, jammed or not, with one to three CAVs; figure
eights smaller and larger; and the usual ring with cars that obey late, and whose sensors err.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE, verdicts
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, estimate
from unjam.measures.table import cell_of
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.studies.study import Study, StudyFolder, read_part
from unjam.training.evaluate import Rows
from unjam.training.seeds import held_out_seeds
from unjam.worlds.batch.run import run_batches
from unjam.worlds.batch.world import why_not
from unjam.worlds.workers import EpisodeTask, Workers

SEEDS = 4
"""of each driver on each road"""
SEEDS_IMPAIRED = 12
JAMMED = 6000
"""steps of a warm-up in which a wave grows"""
ON_RINGS = ("unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned")
ON_FIGURE_EIGHTS = ("unjam:best", "unjam:figure-eight-best", "unjam:figure-eight-tuned")
PEOPLE = "human"
ROOM = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""road for each vehicle [m], from and to"""
KEPT = ("return", "mean_speed", "min_headway", "cav_min_ttc", "cav_max_braking", "time_to_dissolve")
"""of each episode"""
IMPAIRED: dict[str, dict[str, Any]] = {
    "at once, exact": {},
    "lag 0.2 s": {"actuator": Actuator(lag=0.2)},
    "lag 0.5 s": {"actuator": Actuator(lag=0.5)},
    "delay 0.2 s": {"actuator": Actuator(delay=0.2)},
    "delay 0.5 s": {"actuator": Actuator(delay=0.5)},
    "lag 0.3 s, delay 0.2 s": {"actuator": Actuator(lag=0.3, delay=0.2)},
    "gap and speed off by up to 0.3": {
        "sensors": Sensors(gap_error=0.3, speed_error=0.3),
        "safety": SafetyFilter(gap_error=0.3, speed_error=0.3),
    },
    "off by up to 1.0": {
        "sensors": Sensors(gap_error=1.0, speed_error=1.0),
        "safety": SafetyFilter(gap_error=1.0, speed_error=1.0),
    },
    "every tenth reading missing": {"sensors": Sensors(dropout=0.1)},
    "every third reading missing": {"sensors": Sensors(dropout=1.0 / 3.0)},
}
"""what is worse about cars, by label"""


def rings() -> Iterator[tuple[str, Ring]]:
    """Yield the rings, by name."""
    for vehicles, cavs, (words, room), warmup in product(
        (5, 11, 22, 44), (1, 2, 3), ROOM.items(), (0, JAMMED)
    ):
        low, high = room
        name = f"{vehicles} vehicles, {cavs} automated, {words}{', jammed' if warmup else ''}"
        yield (
            name,
            Ring(vehicles=vehicles, cavs=cavs, length=(low * vehicles, high * vehicles), warmup=warmup),
        )


def figure_eights() -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights, by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high))


def impaired(warmup: int) -> Iterator[tuple[str, Ring]]:
    """Yield the usual ring with cars that are worse, by what is worse about them."""
    for words, changes in IMPAIRED.items():
        yield words, replace(Ring(warmup=warmup), **changes)


def _rows(scenario: Scenario, drivers: tuple[str, ...], seeds: int, workers: Workers) -> dict[str, Any]:
    """Return what each driver did: its verdict, and some numbers of each episode."""
    found: Rows = {}
    for driver in drivers:
        made = make_driver(driver, scenario.decision_step)
        judged = enumerate(held_out_seeds(seeds))
        tasks = [EpisodeTask(scenario.part(index, seeds), made, seed) for index, seed in judged]
        episodes = workers.run(tasks) if why_not(scenario) else run_batches(tasks)
        found[driver] = [measure(episode) for episode in episodes]
    said = verdicts(found)
    return {
        driver: {"verdict": said[driver], "episodes": [{name: row[name] for name in KEPT} for row in rows]}
        for driver, rows in found.items()
    }


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    parts: dict[str, tuple[Iterator[tuple[str, Scenario]], tuple[str, ...], int]] = {
        "rings": (rings(), ON_RINGS, SEEDS),
        "figure-eights": (figure_eights(), ON_FIGURE_EIGHTS, SEEDS),
        "impaired": (impaired(0), ON_RINGS, SEEDS_IMPAIRED),
        "impaired-jammed": (impaired(JAMMED), ON_RINGS, SEEDS_IMPAIRED),
    }
    with Workers(workers) as pool:
        for part, (roads, drivers, count) in parts.items():
            found = {name: _rows(road, (PEOPLE, *drivers), count, pool) for name, road in roads}
            write_whole(folder / f"{part}.json", to_json(found))


def _smallest(episodes: list[dict[str, Any]], name: str) -> float:
    """Return the smallest of a number of all episodes, which some may not have."""
    return min((row[name] for row in episodes if row[name] is not None), default=np.inf)


def _gain(found: dict[str, Any], driver: str) -> Estimate:
    """Return what a driver gains over people alone in mean speed, paired [m/s]."""
    own, people = ([row["mean_speed"] for row in found[each]["episodes"]] for each in (driver, PEOPLE))
    return estimate([one - other for one, other in zip(own, people, strict=True)])


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is drivable, and where it is worst."""
    roads = read_part(folder, part)
    rows: list[dict[str, Any]] = []
    for driver in next(iter(roads.values())):
        if driver == PEOPLE:
            continue
        drivable = [name for name, found in roads.items() if found[driver]["verdict"] == DRIVABLE]
        closest = {name: _smallest(found[driver]["episodes"], "min_headway") for name, found in roads.items()}
        gains = {name: _gain(found, driver).mean for name, found in roads.items()}
        slowest = min(gains, key=lambda name: gains[name])
        hardest = max(row["cav_max_braking"] for found in roads.values() for row in found[driver]["episodes"])
        rows.append(
            {
                "controller": driver,
                "drivable on": f"{len(drivable)} of {len(roads)} roads",
                "smallest headway [s]": f"{min(closest.values()):.2f}",
                "hardest braking [m/s²]": f"{hardest:.1f}",
                "beyond people, mean [m/s]": f"{np.mean(list(gains.values())):+.2f}",
                "least beyond people [m/s]": f"{gains[slowest]:+.2f} ({slowest})",
            }
        )
    return pd.DataFrame(rows)


def impaired_table(part: str, folder: Path) -> pd.DataFrame:
    """Return what each controller earns with cars that are worse, and whether it is drivable with them."""
    rows: list[dict[str, Any]] = []
    for words, found in read_part(folder, part).items():
        row: dict[str, Any] = {"cars": words}
        for driver, of in found.items():
            cell = str(cell_of(estimate([each["return"] for each in of["episodes"]]), 0))
            headway = _smallest(of["episodes"], "min_headway")
            if isfinite(headway) and driver != PEOPLE:
                cell += f"; {headway:.2f} s" + ("" if of["verdict"] == DRIVABLE else f", {of['verdict']}")
            row[driver] = cell
        rows.append(row)
    return pd.DataFrame(rows)


ENVELOPE = Study(
    title="how far from its own road a shipped controller stays drivable, also late and with wrong sensors",
    runs=lambda seeds: [],
    write=_write,
    minutes=15.0,
    tables={
        **{part: partial(domain_table, part) for part in ("rings", "figure-eights")},
        **{part: partial(impaired_table, part) for part in ("impaired", "impaired-jammed")},
    },
)
