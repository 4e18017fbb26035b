"""How far from its own road a shipped controller stays drivable, and what late cars and wrong sensors cost.

Rings from 5 to 44 vehicles, shorter and longer than trained on, jammed or not, with one to three CAVs; figure
eights smaller and larger; the rings and a lane of a motorway without SUMO's own safety; and the usual ring
with cars that obey late, and whose sensors err.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.controller.certificate import certificate_of
from unjam.controller.file import SUFFIX, read_controller
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE
from unjam.measures.statistics import estimate
from unjam.measures.table import PEOPLE, cell_of
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.studies.parts import file_of
from unjam.studies.results_file import read_part
from unjam.studies.study import Study, StudyFolder, judged
from unjam.training.export import export_controller
from unjam.training.family import GROWN
from unjam.worlds.workers import Workers

SEEDS = 2
"""of each driver on each road"""
SEEDS_RAW, SEEDS_IMPAIRED = 5, 8
ROADS: dict[str, str] = {
    "unjam:best": "ring-jammed",
    "unjam:ring-best": "ring",
    "unjam:ring-gap-tuned": "ring",
    "unjam:ring-tuned": "ring",
    "unjam:rings-tuned": "ring",
    "unjam:shared-rings-tuned": "ring",
    "unjam:ring-jammed-best": "ring-jammed",
    "unjam:ring-jammed-tuned": "ring-jammed",
    "unjam:figure-eight-best": "figure-eight",
    "unjam:figure-eight-tuned": "figure-eight",
}
"""what ships for closed roads, and the road that it is for"""
OF_LANES = ("unjam:on-ramp-tuned", *(name for name, road in ROADS.items() if road != "figure-eight"))
IMPAIRED_DRIVERS = ("unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned")
ROOM = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""road for each vehicle [m], from and to"""
WORST, DROVE = "worst", "drove"
"""names of files: of the worst cases; and which shipped file drove each part, for others replace it"""
KEPT = ("return", "mean_speed", "min_headway", "cav_max_braking", "steps", "collisions")
"""of each episode"""
LANES: dict[str, dict[str, Any]] = {
    "a free lane": {"inflow": 1200.0, "calm_inflow": 1200.0},
    "a full lane": {"inflow": 2400.0, "calm_inflow": 2000.0},
    "a full lane, half of all automated": {"inflow": 2400.0, "calm_inflow": 2000.0, "cav_share": 0.5},
}
"""one lane of a motorway, onto which nobody cuts in, by label"""
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
    each = product((5, 11, 22, 44), (1, 2, 3), ROOM.items(), (0, GROWN))
    for vehicles, cavs, (words, (low, high)), warmup in each:
        length = low * vehicles, high * vehicles
        name = f"{vehicles} vehicles, {cavs} automated, {words}{', jammed' if warmup else ''}"
        yield name, Ring(vehicles=vehicles, cavs=cavs, length=length, warmup=warmup)


def figure_eights() -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights, by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high))


def alone(roads: Iterator[tuple[str, Ring]]) -> Iterator[tuple[str, Ring]]:
    """Yield rings on which SUMO does not keep CAVs apart."""
    for name, road in roads:
        yield name, replace(road, actuation="raw")


def lanes() -> Iterator[tuple[str, OnRamp]]:
    """Yield lanes of a motorway on which the filter keeps CAVs apart, and not SUMO, by name."""
    for name, changes in LANES.items():
        nobody = OnRamp(lanes=1, ramp_flow=0.0, calm_ramp_flow=0.0, horizon=900)
        yield name, replace(nobody, actuation="raw", safety=SafetyFilter(), **changes)


def impaired(warmup: int) -> Iterator[tuple[str, Ring]]:
    """Yield the usual ring with cars that are worse, by what is worse about them."""
    for words, changes in IMPAIRED.items():
        yield words, replace(Ring(warmup=warmup), **changes)


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    parts: dict[str, tuple[Iterator[tuple[str, Scenario]], tuple[str, ...], int]] = {
        "rings": (rings(), tuple(ROADS), SEEDS),
        "figure-eights": (figure_eights(), tuple(ROADS), SEEDS),
        "rings-raw": (alone(rings()), tuple(ROADS), SEEDS_RAW),
        "lanes-raw": (lanes(), OF_LANES, SEEDS_RAW),
        "impaired": (impaired(0), IMPAIRED_DRIVERS, SEEDS_IMPAIRED),
        "impaired-jammed": (impaired(GROWN), IMPAIRED_DRIVERS, SEEDS_IMPAIRED),
    }
    drove = _read(folder, DROVE)
    with Workers(workers) as pool:
        for part, (roads, drivers, count) in {WORST: (iter(()), tuple(ROADS), 1), **parts}.items():
            known = drove.setdefault(part, {})
            missing = [driver for driver in drivers if known.get(driver) != file_of(driver)]
            if not missing:
                continue
            found = _read(folder, part)
            if part == WORST:
                found |= {driver: _worst_cases(driver, ROADS[driver]) for driver in missing}
            for name, road in roads:
                made = {driver: make_driver(driver, road.decision_step) for driver in (PEOPLE, *missing)}
                found[name] = found.get(name, {}) | judged(road, made, count, KEPT, pool)
            write_whole(folder / f"{part}.json", to_json(found))
            known |= {driver: file_of(driver) for driver in missing}
            write_whole(folder / f"{DROVE}.json", to_json(drove, indent=1))


def _read(folder: Path, name: str) -> dict[str, Any]:
    """Return what a file of the study holds; nothing where there is none yet."""
    return read_part(folder, name) if (folder / f"{name}.json").is_file() else {}


def _worst_cases(controller: str, road: str) -> dict[str, Any]:
    """Return what was tried to make a controller touch its leader, from all that it visits on its road."""
    with TemporaryDirectory() as folder:
        file = Path(folder, f"controller{SUFFIX}")
        export_controller(controller, file, scenario=road)
        return certificate_of(read_controller(file))["worst"]


def worst_table(folder: Path) -> pd.DataFrame:
    """Return how close leaders that brake and attack came to each controller."""
    return pd.DataFrame(
        {
            "controller": controller,
            "road": ROADS[controller],
            "stops": f"{worst['stops']:,}",
            "steps": f"{worst['steps']:,}",
            "contacts": worst["contacts"],
            "smallest gap [m]": f"{worst['smallest_gap']:.2f}",
            "smallest headway [s]": f"{worst['smallest_headway']:.2f}",
            "hardest braking [m/s²]": f"{worst['hardest_braking']:.1f}",
        }
        for controller, worst in read_part(folder, WORST).items()
    )


def _closest(episodes: list[dict[str, Any]]) -> float:
    """Return the smallest time headway of all episodes [s]; in some nobody was faster than 1 m/s."""
    headways = (row["min_headway"] for row in episodes)
    return min((headway for headway in headways if headway is not None), default=np.inf)


def _gain(found: dict[str, Any], driver: str) -> float:
    """Return how much faster the mean of all is than people alone [m/s]."""
    own, people = ([row["mean_speed"] for row in found[each]["episodes"]] for each in (driver, PEOPLE))
    return float(np.mean(own) - np.mean(people))


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is drivable, and where it is worst."""
    roads = read_part(folder, part)
    rows: list[dict[str, Any]] = []
    for driver in next(iter(roads.values())):
        if driver == PEOPLE:
            continue
        drivable = [name for name, found in roads.items() if found[driver]["drivable"] == DRIVABLE]
        closest = min(_closest(found[driver]["episodes"]) for found in roads.values())
        gains = {name: _gain(found, driver) for name, found in roads.items()}
        slowest = min(gains, key=lambda name: gains[name])
        hardest = max(row["cav_max_braking"] for found in roads.values() for row in found[driver]["episodes"])
        rows.append(
            {
                "controller": driver,
                "drivable on": f"{len(drivable)} of {len(roads)} roads",
                "smallest headway [s]": f"{closest:.2f}",
                "hardest braking [m/s²]": f"{hardest:.1f}",
                "beyond people, mean [m/s]": f"{np.mean(list(gains.values())):+.2f}",
                "least beyond people [m/s]": f"{gains[slowest]:+.2f} ({slowest})",
            }
        )
    return pd.DataFrame(rows)


def contact_table(part: str, folder: Path) -> pd.DataFrame:
    """Return how many touched somebody, and how close they came, where SUMO does not keep CAVs apart."""
    roads = read_part(folder, part)
    found: list[dict[str, Any]] = []
    for driver in next(iter(roads.values())):
        episodes = [row for each in roads.values() for row in each[driver]["episodes"]]
        if driver == PEOPLE:
            continue
        found.append(
            {
                "controller": driver,
                "episodes": len(episodes),
                "decisions": f"{sum(row['steps'] for row in episodes):,}",
                "in contact": int(sum(row["collisions"] for row in episodes)),
                "smallest headway [s]": f"{_closest(episodes):.2f}",
                "hardest braking [m/s²]": f"{max(row['cav_max_braking'] for row in episodes):.1f}",
            }
        )
    return pd.DataFrame(found)


def impaired_table(part: str, folder: Path) -> pd.DataFrame:
    """Return what each controller earns with cars that are worse, and whether it is drivable with them."""
    rows: list[dict[str, Any]] = []
    for words, found in read_part(folder, part).items():
        row: dict[str, Any] = {"cars": words}
        for driver, of in found.items():
            cell = str(cell_of(estimate([each["return"] for each in of["episodes"]]), 0))
            headway = _closest(of["episodes"])
            if isfinite(headway) and driver != PEOPLE:
                cell += f"; {headway:.2f} s" + ("" if of["drivable"] == DRIVABLE else f", {of['drivable']}")
            row[driver] = cell
        rows.append(row)
    return pd.DataFrame(rows)


ENVELOPE = Study(
    title="how far from its own road a shipped controller stays drivable, also late and with wrong sensors",
    runs=lambda seeds: [],
    write=_write,
    minutes=30.0,
    goes_on=True,
    tables={
        WORST: worst_table,
        **{part: partial(domain_table, part) for part in ("rings", "figure-eights")},
        **{part: partial(contact_table, part) for part in ("rings-raw", "lanes-raw")},
        **{part: partial(impaired_table, part) for part in ("impaired", "impaired-jammed")},
    },
)
