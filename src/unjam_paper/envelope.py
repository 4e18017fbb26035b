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
from unjam.controller.certificate import make_certificate
from unjam.controller.file import SUFFIX, read_controller
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.files import atomic_write, to_json
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import estimate
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.export import export_controller
from unjam.training.road_family import LONG_WARM_UP
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.parts import controller_digest
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, StudyFolder, evaluate_on_test_seeds

ENVELOPE_SEEDS = 2
"""of each driver on each road"""
RAW_ACTUATION_SEEDS, IMPAIRED_SEEDS = 5, 8
CONTROLLER_ROADS: dict[str, str] = {
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
LANE_CONTROLLERS = ("unjam:on-ramp-tuned", *(name for name, road in CONTROLLER_ROADS.items() if road != "figure-eight"))
IMPAIRED_DRIVERS = ("unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned")
VEHICLE_SPACINGS = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""road for each vehicle [m], from and to"""
WORST_FILE, CONTROLLER_HASHES_FILE = "worst", "drove"
"""names of files: of the worst cases; and which shipped file drove each part, for others replace it"""
ENVELOPE_METRICS = ("return", "mean_speed", "min_time_gap", "cav_max_braking", "steps", "collisions")
"""of each episode"""
LANE_CONDITIONS: dict[str, dict[str, Any]] = {
    "a free lane": {"inflow": 1200.0, "off_peak_inflow": 1200.0},
    "a full lane": {"inflow": 2400.0, "off_peak_inflow": 2000.0},
    "a full lane, half of all automated": {"inflow": 2400.0, "off_peak_inflow": 2000.0, "penetration_rate": 0.5},
}
"""one lane of a motorway, onto which nobody cuts in, by label"""
IMPAIRMENTS: dict[str, dict[str, Any]] = {
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


def envelope_rings() -> Iterator[tuple[str, Ring]]:
    """Yield the rings, by name."""
    each = product((5, 11, 22, 44), (1, 2, 3), VEHICLE_SPACINGS.items(), (0, LONG_WARM_UP))
    for vehicles, cavs, (words, (low, high)), warmup in each:
        length = low * vehicles, high * vehicles
        name = f"{vehicles} vehicles, {cavs} automated, {words}{', jammed' if warmup else ''}"
        yield name, Ring(vehicles=vehicles, cavs=cavs, length=length, warmup=warmup)


def envelope_figure_eights() -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights, by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high))


def without_sumo_safety(roads: Iterator[tuple[str, Ring]]) -> Iterator[tuple[str, Ring]]:
    """Yield rings on which SUMO does not keep CAVs apart."""
    for name, road in roads:
        yield name, replace(road, actuation="raw")


def envelope_lanes() -> Iterator[tuple[str, OnRamp]]:
    """Yield lanes of a motorway on which the filter keeps CAVs apart, and not SUMO, by name."""
    for name, changes in LANE_CONDITIONS.items():
        nobody = OnRamp(lanes=1, ramp_flow=0.0, off_peak_ramp_flow=0.0, horizon=900)
        yield name, replace(nobody, actuation="raw", safety=SafetyFilter(), **changes)


def impaired_rings(warmup: int) -> Iterator[tuple[str, Ring]]:
    """Yield the usual ring with cars that are worse, by what is worse about them."""
    for words, changes in IMPAIRMENTS.items():
        yield words, replace(Ring(warmup=warmup), **changes)


def _write_envelope(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    parts: dict[str, tuple[Iterator[tuple[str, Scenario]], tuple[str, ...], int]] = {
        "rings": (envelope_rings(), tuple(CONTROLLER_ROADS), ENVELOPE_SEEDS),
        "figure-eights": (envelope_figure_eights(), tuple(CONTROLLER_ROADS), ENVELOPE_SEEDS),
        "rings-raw": (without_sumo_safety(envelope_rings()), tuple(CONTROLLER_ROADS), RAW_ACTUATION_SEEDS),
        "lanes-raw": (envelope_lanes(), LANE_CONTROLLERS, RAW_ACTUATION_SEEDS),
        "impaired": (impaired_rings(0), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
        "impaired-jammed": (impaired_rings(LONG_WARM_UP), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
    }
    drove = _read_optional_part(folder, CONTROLLER_HASHES_FILE)
    with WorkerPool(workers) as pool:
        for part, (roads, drivers, count) in {WORST_FILE: (iter(()), tuple(CONTROLLER_ROADS), 1), **parts}.items():
            known = drove.setdefault(part, {})
            missing = [driver for driver in drivers if known.get(driver) != controller_digest(driver)]
            if not missing:
                continue
            found = _read_optional_part(folder, part)
            if part == WORST_FILE:
                found |= {driver: _certify_worst_cases(driver, CONTROLLER_ROADS[driver]) for driver in missing}
            for name, road in roads:
                made = {driver: make_driver(driver, road.control_step) for driver in (HUMAN_LABEL, *missing)}
                found[name] = found.get(name, {}) | evaluate_on_test_seeds(road, made, count, ENVELOPE_METRICS, pool)
            atomic_write(folder / f"{part}.json", to_json(found))
            known |= {driver: controller_digest(driver) for driver in missing}
            atomic_write(folder / f"{CONTROLLER_HASHES_FILE}.json", to_json(drove, indent=1))


def _read_optional_part(folder: Path, name: str) -> dict[str, Any]:
    """Return what a file of the study holds; nothing where there is none yet."""
    return read_part(folder, name) if (folder / f"{name}.json").is_file() else {}


def _certify_worst_cases(controller: str, road: str) -> dict[str, Any]:
    """Return what was tried to make a controller touch its leader, from all that it visits on its road."""
    with TemporaryDirectory() as folder:
        file = Path(folder, f"controller{SUFFIX}")
        export_controller(controller, file, scenario=road)
        return make_certificate(read_controller(file))["worst"]


def worst_table(folder: Path) -> pd.DataFrame:
    """Return how close leaders that brake and attack came to each controller."""
    return pd.DataFrame(
        {
            "controller": controller,
            "road": CONTROLLER_ROADS[controller],
            "stops": f"{worst['stops']:,}",
            "steps": f"{worst['steps']:,}",
            "contacts": worst["contacts"],
            "smallest gap [m]": f"{worst['min_gap']:.2f}",
            "smallest headway [s]": f"{worst['min_time_gap']:.2f}",
            "hardest braking [m/s²]": f"{worst['max_braking']:.1f}",
        }
        for controller, worst in read_part(folder, WORST_FILE).items()
    )


def _min_time_gap(episodes: list[dict[str, Any]]) -> float:
    """Return the smallest time headway of all episodes [s]; in some nobody was faster than 1 m/s."""
    headways = (row["min_time_gap"] for row in episodes)
    return min((headway for headway in headways if headway is not None), default=np.inf)


def _speed_gain(results: dict[str, Any], driver: str) -> float:
    """Return how much faster the mean of all is than people alone [m/s]."""
    own, people = ([row["mean_speed"] for row in results[each]["episodes"]] for each in (driver, HUMAN_LABEL))
    return float(np.mean(own) - np.mean(people))


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is drivable, and where it is worst."""
    roads = read_part(folder, part)
    rows: list[dict[str, Any]] = []
    for driver in next(iter(roads.values())):
        if driver == HUMAN_LABEL:
            continue
        drivable = [name for name, found in roads.items() if found[driver]["drivable"] == FEASIBLE]
        closest = min(_min_time_gap(found[driver]["episodes"]) for found in roads.values())
        gains = {name: _speed_gain(found, driver) for name, found in roads.items()}
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
        if driver == HUMAN_LABEL:
            continue
        found.append(
            {
                "controller": driver,
                "episodes": len(episodes),
                "decisions": f"{sum(row['steps'] for row in episodes):,}",
                "in contact": int(sum(row["collisions"] for row in episodes)),
                "smallest headway [s]": f"{_min_time_gap(episodes):.2f}",
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
            cell = str(estimate_cell(estimate([each["return"] for each in of["episodes"]]), 0))
            headway = _min_time_gap(of["episodes"])
            if isfinite(headway) and driver != HUMAN_LABEL:
                cell += f"; {headway:.2f} s" + ("" if of["drivable"] == FEASIBLE else f", {of['drivable']}")
            row[driver] = cell
        rows.append(row)
    return pd.DataFrame(rows)


ENVELOPE = Study(
    title="how far from its own road a shipped controller stays drivable, also late and with wrong sensors",
    make_runs=lambda seeds: [],
    write=_write_envelope,
    minutes=30.0,
    is_resumable=True,
    tables={
        WORST_FILE: worst_table,
        **{part: partial(domain_table, part) for part in ("rings", "figure-eights")},
        **{part: partial(contact_table, part) for part in ("rings-raw", "lanes-raw")},
        **{part: partial(impaired_table, part) for part in ("impaired", "impaired-jammed")},
    },
)
