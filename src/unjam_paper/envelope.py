"""Feasibility of packaged controllers far from their training roads, with actuation delay and with sensor errors.

Rings with 5 to 44 vehicles, shorter and longer than in training, jammed or not, with one to three CAVs; smaller and
larger figure eights; the rings and a motorway lane without SUMO's safety checks; and the default ring with actuation
delay, lag and sensor errors.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
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
from unjam_paper.results_file import read_part, write_part
from unjam_paper.study import NO_VALUE_TEXT, DriverComparison, Study, StudyFolder, evaluate_on_test_seeds

ENVELOPE_SEEDS, RAW_ACTUATION_SEEDS, IMPAIRED_SEEDS = 2, 5, 8
"""test seeds of each driver on each road"""
CONTROLLER_ROADS: dict[str, str] = {
    "unjam:best": "ring-jammed",
    **{f"unjam:{name}": "ring" for name in ("ring-best", "ring-gap-tuned", "ring-tuned")},
    **{f"unjam:{name}": "ring" for name in ("rings-tuned", "shared-rings-tuned")},
    **{f"unjam:{name}": "ring-jammed" for name in ("ring-jammed-best", "ring-jammed-tuned")},
    **{f"unjam:{name}": "figure-eight" for name in ("figure-eight-best", "figure-eight-tuned")},
}
"""packaged controllers for closed roads, and the road of each"""
LANE_CONTROLLERS = ("unjam:on-ramp-tuned", *(name for name, road in CONTROLLER_ROADS.items() if road != "figure-eight"))
IMPAIRED_DRIVERS = ("unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned")
VEHICLE_SPACINGS = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""range of the road length per vehicle [m]"""
WORST_FILE, CONTROLLER_HASHES_FILE = "worst", "controller-hashes"
"""names of parts: the worst cases of the certificates, and the digests of the controllers by part"""
ENVELOPE_METRICS = ("return", "mean_speed", "min_time_gap", "cav_max_braking", "steps", "collisions")
LANE_CONDITIONS: dict[str, dict[str, Any]] = {
    "a free lane": {"inflow": 1200.0, "off_peak_inflow": 1200.0},
    "a full lane": {"inflow": 2400.0, "off_peak_inflow": 2000.0},
    "a full lane, half of all automated": {"inflow": 2400.0, "off_peak_inflow": 2000.0, "penetration_rate": 0.5},
}
"""demand on one lane of a motorway without cut-ins"""
IMPAIRMENTS: dict[str, dict[str, Any]] = {
    "at once, exact": {},
    "lag 0.2 s": {"actuator": Actuator(lag=0.2)},
    "lag 0.5 s": {"actuator": Actuator(lag=0.5)},
    "delay 0.2 s": {"actuator": Actuator(delay=0.2)},
    "delay 0.5 s": {"actuator": Actuator(delay=0.5)},
    "lag 0.3 s, delay 0.2 s": {"actuator": Actuator(lag=0.3, delay=0.2)},
    **{
        label: {
            "sensors": Sensors(gap_error=error, speed_error=error),
            "safety": SafetyFilter(gap_error=error, speed_error=error),
        }
        for label, error in {"gap and speed off by up to 0.3": 0.3, "off by up to 1.0": 1.0}.items()
    },
    "every tenth reading missing": {"sensors": Sensors(dropout=0.1)},
    "every third reading missing": {"sensors": Sensors(dropout=1.0 / 3.0)},
}
"""changes to the actuation and the sensors of CAVs"""

NamedRoads = Iterator[tuple[str, Scenario]]
"""scenarios with their names"""


def envelope_rings(**changes: Any) -> Iterator[tuple[str, Ring]]:
    """Yield the rings by name, with changes to all of them."""
    each = product((5, 11, 22, 44), (1, 2, 3), VEHICLE_SPACINGS.items(), (0, LONG_WARM_UP))
    for vehicles, cavs, (words, (low, high)), warmup in each:
        name = f"{vehicles} vehicles, {cavs} automated, {words}{', jammed' if warmup else ''}"
        length = low * vehicles, high * vehicles
        yield name, Ring(vehicles=vehicles, cavs=cavs, length=length, warmup=warmup, **changes)


def envelope_figure_eights() -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high))


def envelope_lanes() -> Iterator[tuple[str, OnRamp]]:
    """Yield motorway lanes by name on which the safety filter is active and the checks of SUMO are not."""
    for name, changes in LANE_CONDITIONS.items():
        lane = OnRamp(lanes=1, ramp_flow=0.0, off_peak_ramp_flow=0.0, horizon=900)
        yield name, replace(lane, actuation="raw", safety=SafetyFilter(), **changes)


def impaired_rings(warmup: int) -> Iterator[tuple[str, Ring]]:
    """Yield the default ring with each impairment, by its name."""
    for name, changes in IMPAIRMENTS.items():
        yield name, replace(Ring(warmup=warmup), **changes)


def _write_envelope(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    closed = tuple(CONTROLLER_ROADS)
    parts: dict[str, tuple[NamedRoads, tuple[str, ...], int]] = {
        WORST_FILE: (iter(()), closed, 1),
        "rings": (envelope_rings(), closed, ENVELOPE_SEEDS),
        "figure-eights": (envelope_figure_eights(), closed, ENVELOPE_SEEDS),
        "rings-raw": (envelope_rings(actuation="raw"), closed, RAW_ACTUATION_SEEDS),
        "lanes-raw": (envelope_lanes(), LANE_CONTROLLERS, RAW_ACTUATION_SEEDS),
        "impaired": (impaired_rings(0), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
        "impaired-jammed": (impaired_rings(LONG_WARM_UP), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
    }
    digests = _read_optional_part(folder, CONTROLLER_HASHES_FILE)
    with WorkerPool(workers) as pool:
        for part, (roads, drivers, count) in parts.items():
            known = digests.setdefault(part, {})
            missing = [driver for driver in drivers if known.get(driver) != controller_digest(driver)]
            if not missing:
                continue
            results = _read_optional_part(folder, part)
            if part == WORST_FILE:
                results |= {driver: _certify_worst_cases(driver, CONTROLLER_ROADS[driver]) for driver in missing}
            for name, road in roads:
                made = {driver: make_driver(driver, road.control_step) for driver in (HUMAN_LABEL, *missing)}
                found = evaluate_on_test_seeds(road, made, count, ENVELOPE_METRICS, pool)
                results[name] = results.get(name, {}) | found
            atomic_write(folder / f"{part}.json", to_json(results))
            known |= {driver: controller_digest(driver) for driver in missing}
            write_part(folder, CONTROLLER_HASHES_FILE, digests)


def _read_optional_part(folder: Path, name: str) -> dict[str, Any]:
    return read_part(folder, name) if (folder / f"{name}.json").is_file() else {}


def _certify_worst_cases(controller: str, road: str) -> dict[str, Any]:
    """Return the worst cases that the certificate finds for a controller on its road."""
    with TemporaryDirectory() as folder:
        file = Path(folder, f"controller{SUFFIX}")
        export_controller(controller, file, scenario=road)
        return make_certificate(read_controller(file))["worst_cases"]


def worst_table(folder: Path) -> pd.DataFrame:
    """Return how close each controller came to leaders that brake to a stop and to leaders found by a search."""
    return pd.DataFrame(
        {
            "controller": controller,
            "road": CONTROLLER_ROADS[controller],
            "stops": f"{worst['leader_stops']:,}",
            "steps": f"{worst['steps']:,}",
            "contacts": worst["contacts"],
            "min gap [m]": f"{worst['min_gap']:.2f}",
            "min time gap [s]": f"{worst['min_time_gap']:.2f}",
            "max braking [m/s²]": f"{worst['max_braking']:.1f}",
        }
        for controller, worst in read_part(folder, WORST_FILE).items()
    )


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is feasible, and its gain in speed in the mean and on the worst road."""
    roads, rows = read_part(folder, part), []
    comparison = DriverComparison([*roads.values()])
    for driver in (driver for driver in comparison.roads[0] if driver != HUMAN_LABEL):
        speeds = (comparison.values([label], "mean_speed").mean((1, 2)) for label in (driver, HUMAN_LABEL))
        gains = np.subtract(*speeds)
        least = int(np.argmin(gains))
        rows.append(
            {
                "controller": driver,
                "feasible on": f"{comparison.verdicts([driver]).count(FEASIBLE)} of {len(roads)} roads",
                **_safety_cells(comparison, driver),
                "mean difference to human baseline [m/s]": f"{gains.mean():+.2f}",
                "smallest difference [m/s]": f"{gains[least]:+.2f} ({list(roads)[least]})",
            }
        )
    return pd.DataFrame(rows)


def contact_table(part: str, folder: Path) -> pd.DataFrame:
    """Return the contacts and the smallest time gap of each controller where SUMO's safety checks are off."""
    comparison = DriverComparison([*read_part(folder, part).values()])
    return pd.DataFrame(
        {
            "controller": driver,
            "episodes": comparison.values([driver], "steps").size,
            "control steps": f"{comparison.values([driver], 'steps').sum():,.0f}",
            "in contact": int(comparison.values([driver], "collisions").sum()),
            **_safety_cells(comparison, driver),
        }
        for driver in comparison.roads[0]
        if driver != HUMAN_LABEL
    )


def _safety_cells(comparison: DriverComparison, driver: str) -> dict[str, str]:
    max_braking = comparison.values([driver], "cav_max_braking").max()
    return {"min time gap [s]": comparison.min_time_gap([driver]), "max braking [m/s²]": f"{max_braking:.1f}"}


def impaired_table(part: str, folder: Path) -> pd.DataFrame:
    """Return the return of each controller with impaired vehicles, its minimum time gap, and why it is infeasible."""
    rows: list[dict[str, Any]] = []
    for name, results in read_part(folder, part).items():
        comparison, row = DriverComparison([results]), {"impairment": name}
        for driver in results:
            row[driver] = str(estimate_cell(estimate(comparison.values([driver], "return").ravel().tolist()), 0))
            time_gap, verdict = comparison.min_time_gap([driver]), comparison.feasibility([driver])
            if driver != HUMAN_LABEL and time_gap != NO_VALUE_TEXT:
                row[driver] += f"; {time_gap} s" + ("" if verdict == "yes" else f", {verdict}")
        rows.append(row)
    return pd.DataFrame(rows)


ENVELOPE = Study(
    title="feasibility of packaged controllers far from their training roads, with actuation delay and sensor errors",
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
