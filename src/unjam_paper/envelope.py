"""Packaged controllers far from their training roads: other sizes, no safety checks of SUMO, impaired vehicles."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller.certificate import make_certificate
from unjam.drivers.safety import INSTANT_ACTUATOR, STANDARD_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.road_family import LONG_WARM_UP
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.motorway import Motorway, Ramp
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.export import read_exported_controller
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import NO_VALUE_TEXT, DriverComparison, Study, StudyFolder, evaluate_metrics, mean_text

ENVELOPE_SEEDS, RAW_ACTUATION_SEEDS, IMPAIRED_SEEDS = 2, 5, 8
"""test seeds of each driver on each road"""
CONTROLLER_ROADS: dict[str, str] = {
    "unjam:best": "ring-jammed",
    **{f"unjam:{name}": "ring" for name in ("ring-best-ideal", "ring-gap-tuned", "ring-tuned")},
    **{f"unjam:{name}": "ring" for name in ("rings-tuned", "shared-rings-tuned")},
    **{f"unjam:{name}-ideal": "ring-jammed" for name in ("ring-jammed-best", "ring-jammed-tuned")},
    **{f"unjam:{name}": "figure-eight" for name in ("figure-eight-best-ideal", "figure-eight-tuned-ideal")},
}
"""roads of packaged controllers that were tuned or trained for ideal cars on closed roads"""
USUAL_CAR_ROADS: dict[str, str] = {
    **{"unjam:ring-best": "ring", "unjam:ring-gap-tuned": "ring"},
    **{f"unjam:{name}": "ring-jammed" for name in ("ring-jammed-best", "ring-jammed-tuned")},
    **{f"unjam:{name}": "figure-eight" for name in ("figure-eight-best", "figure-eight-tuned")},
}
"""roads of packaged controllers that are evaluated in usual cars on closed roads"""
LANE_CONTROLLERS = ("unjam:on-ramp-tuned",)
USUAL_CAR_CONTROLLERS = tuple(name for name, road in USUAL_CAR_ROADS.items() if road != "figure-eight")
USUAL_CAR_PACERS = tuple(name for name, road in USUAL_CAR_ROADS.items() if road == "figure-eight")
RING_CONTROLLERS = tuple(name for name, road in CONTROLLER_ROADS.items() if road != "figure-eight")
RING_STEPS: dict[str, Any] = {"simulation_step": 0.1, "steps_per_control_step": 1}
"""steps of the rings, which the controllers for rings need on other roads, too"""
LANE_SECONDS = 900.0
"""duration of an episode on a motorway lane [s]"""
IMPAIRED_DRIVERS = "unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned"
VEHICLE_SPACINGS = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""range of the road length per vehicle [m]"""
WORST_PART, USUAL_CAR_WORST_PART = "worst", "worst-usual-car"
"""names of the parts with the worst cases of the certificates"""
ENVELOPE_METRICS = ("return", "mean_speed", "min_time_gap", "cav_max_braking", "steps", "collisions")
LANE_CONDITIONS: dict[str, dict[str, Any]] = {
    "a free lane": {"inflow": 1200.0, "off_peak_inflow": 1200.0},
    "a full lane": {"inflow": 2400.0, "off_peak_inflow": 2000.0},
    "a full lane, half of all automated": {"inflow": 2400.0, "off_peak_inflow": 2000.0, "penetration_rate": 0.5},
}
"""demand on one lane of a motorway without cut-ins"""
SENSOR_ERROR_NAMES = ("gap_error", "speed_error")
IMPAIRMENTS: dict[str, dict[str, Any]] = {
    "usual car, exact sensors": {},
    "ideal car": {"actuator": INSTANT_ACTUATOR},
    "delay 0.2 s, lag 0.5 s": {"actuator": Actuator(delay=0.2, lag=0.5)},
    "delay 0.5 s, lag 0.5 s": {"actuator": Actuator(delay=0.5, lag=0.5)},
    **{
        label: {"sensors": Sensors(**errors), "safety": SafetyFilter(**errors)}
        for label, errors in {
            "gap and speed off by up to 0.3": dict.fromkeys(SENSOR_ERROR_NAMES, 0.3),
            "off by up to 1.0": dict.fromkeys(SENSOR_ERROR_NAMES, 1.0),
        }.items()
    },
    "every tenth reading missing": {"sensors": Sensors(dropout=0.1)},
    "every third reading missing": {"sensors": Sensors(dropout=1.0 / 3.0)},
}
"""changes to the actuation and the sensors of usual cars"""


def envelope_rings(**changes: Any) -> Iterator[tuple[str, Ring]]:
    """Yield the rings by name, with changes to all of them."""
    combinations = product((5, 11, 22, 44), (1, 2, 3), VEHICLE_SPACINGS.items(), (0, LONG_WARM_UP))
    for vehicles, cavs, (spacing, (low, high)), warmup in combinations:
        name = f"{vehicles} vehicles, {cavs} automated, {spacing}{', jammed' if warmup else ''}"
        length = low * vehicles, high * vehicles
        options: dict[str, Any] = {"vehicles": vehicles, "cavs": cavs, "length": length, "warmup": warmup}
        yield name, Ring(**{"actuator": INSTANT_ACTUATOR, **options, **changes})


def envelope_figure_eights(actuator: Actuator = INSTANT_ACTUATOR) -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high), actuator=actuator)


def envelope_lanes(**changes: Any) -> Iterator[tuple[str, Motorway]]:
    """Yield motorway lanes by name, with the safety filter and without the safety checks of SUMO."""
    lane = Motorway(lanes=1, ramps=(Ramp(position=2000.0, inflow=0.0, off_peak_inflow=0.0),), **changes)
    lane = replace(lane, horizon=round(LANE_SECONDS / lane.control_step), actuation="raw", safety=SafetyFilter())
    for name, demand in LANE_CONDITIONS.items():
        yield f"{name}, control step {lane.control_step:g} s", replace(lane, **demand)


def impaired_rings(warmup: int) -> Iterator[tuple[str, Ring]]:
    """Yield the default ring with each impairment, by its name."""
    for name, changes in IMPAIRMENTS.items():
        yield name, replace(Ring(warmup=warmup), **changes)


def envelope_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return the parts of the study `envelope`."""
    closed_road_controllers, parts = tuple(CONTROLLER_ROADS), dict[str, StudyPart]()
    cars = (WORST_PART, CONTROLLER_ROADS, INSTANT_ACTUATOR), (USUAL_CAR_WORST_PART, USUAL_CAR_ROADS, STANDARD_ACTUATOR)
    for part, road_by_driver, actuator in cars:
        for driver, road in road_by_driver.items():
            parts[f"{part}/{driver}"] = _measure_worst_cases, (driver, road, actuator)
    usual_cars: dict[str, Any] = {"actuator": STANDARD_ACTUATOR}
    tests: tuple[tuple[str, Iterator[tuple[str, Scenario]], tuple[str, ...], int], ...] = (
        ("rings", envelope_rings(), closed_road_controllers, ENVELOPE_SEEDS),
        ("figure-eights", envelope_figure_eights(), closed_road_controllers, ENVELOPE_SEEDS),
        ("figure-eights-usual-car", envelope_figure_eights(STANDARD_ACTUATOR), USUAL_CAR_PACERS, ENVELOPE_SEEDS),
        ("rings-raw-usual-car", envelope_rings(actuation="raw", **usual_cars), USUAL_CAR_CONTROLLERS, ENVELOPE_SEEDS),
        ("lanes-raw", envelope_lanes(), LANE_CONTROLLERS, RAW_ACTUATION_SEEDS),
        ("lanes-raw", envelope_lanes(**RING_STEPS), RING_CONTROLLERS, RAW_ACTUATION_SEEDS),
        ("impaired", impaired_rings(0), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
        ("impaired-jammed", impaired_rings(LONG_WARM_UP), IMPAIRED_DRIVERS, IMPAIRED_SEEDS),
    )
    for part, roads, controllers, count in tests:
        drivers = {driver: driver for driver in (HUMAN_LABEL, *controllers)}
        for name, scenario in roads:
            parts[f"{part}/{name}"] = evaluate_metrics, (scenario, drivers, count, ENVELOPE_METRICS)
    return parts


def _measure_worst_cases(controller: str, road: str, actuator: Actuator, workers: int) -> dict[str, Any]:
    return make_certificate(read_exported_controller(controller, {"actuator": asdict(actuator)}, road))["worst_cases"]


def worst_table(part: str, folder: Path) -> pd.DataFrame:
    """Return the smallest gaps of each controller to leaders that brake to a stop and to leaders found by a search."""
    rows: list[dict[str, Any]] = []
    for controller, worst in read_part(folder, part).items():
        road = {**CONTROLLER_ROADS, **USUAL_CAR_ROADS}[controller]
        row = {"controller": controller, "road": road, "stops": f"{worst['leader_stops']:,}"}
        row |= {"steps": f"{worst['steps']:,}", "contacts": worst["contacts"], "min gap [m]": f"{worst['min_gap']:.2f}"}
        row["min time gap [s]"] = f"{worst['min_time_gap']:.2f}"
        rows.append({**row, "max braking [m/s²]": f"{worst['max_braking']:.1f}"})
    return pd.DataFrame(rows)


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is feasible, and its mean and smallest gain in speed over the roads."""
    roads, rows = read_part(folder, part), []
    comparison = DriverComparison([*roads.values()])
    for driver in (driver for driver in comparison.roads[0] if driver != HUMAN_LABEL):
        speeds = (comparison.values([label], "mean_speed").mean((1, 2)) for label in (driver, HUMAN_LABEL))
        gains = np.subtract(*speeds)
        worst = int(np.argmin(gains))
        feasible = f"{comparison.verdicts([driver]).count(FEASIBLE)} of {len(roads)} roads"
        row = {"controller": driver, "feasible on": feasible, **_safety_cells(comparison, driver)}
        row["mean difference to human baseline [m/s]"] = f"{gains.mean():+.2f}"
        rows.append({**row, "smallest difference [m/s]": f"{gains[worst]:+.2f} ({list(roads)[worst]})"})
    return pd.DataFrame(rows)


def contact_table(part: str, folder: Path) -> pd.DataFrame:
    """Return the contacts and the smallest time gap of each controller without the safety checks of SUMO."""
    roads = [*read_part(folder, part).values()]
    rows = []
    for driver in dict.fromkeys(label for road in roads for label in road if label != HUMAN_LABEL):
        comparison = DriverComparison([road for road in roads if driver in road])
        steps, contacts = (comparison.values([driver], name) for name in ("steps", "collisions"))
        row = {"controller": driver, "episodes": steps.size, "control steps": f"{steps.sum():,.0f}"}
        rows.append(row | {"in contact": int(contacts.sum()), **_safety_cells(comparison, driver)})
    return pd.DataFrame(rows)


def _safety_cells(comparison: DriverComparison, driver: str) -> dict[str, str]:
    max_braking = comparison.values([driver], "cav_max_braking").max()
    return {"min time gap [s]": comparison.min_time_gap([driver]), "max braking [m/s²]": f"{max_braking:.1f}"}


def impaired_table(part: str, folder: Path) -> pd.DataFrame:
    """Return for each impairment the return of each controller, its minimum time gap, and why it is infeasible."""
    rows: list[dict[str, Any]] = []
    for name, results in read_part(folder, part).items():
        comparison, row = DriverComparison([results]), {"impairment": name}
        for driver in results:
            row[driver] = mean_text(comparison.values([driver], "return"), 0)
            time_gap, verdict = comparison.min_time_gap([driver]), comparison.feasibility([driver])
            if driver != HUMAN_LABEL and time_gap != NO_VALUE_TEXT:
                row[driver] += f"; {time_gap} s" + ("" if verdict == "yes" else f", {verdict}")
        rows.append(row)
    return pd.DataFrame(rows)


ENVELOPE = Study(
    title="feasibility of packaged controllers far from their training roads, with actuation delay and sensor errors",
    make_parts=envelope_parts,
    minutes=30.0,
    tables={
        **{part: partial(worst_table, part) for part in (WORST_PART, USUAL_CAR_WORST_PART)},
        **{part: partial(domain_table, part) for part in ("rings", "figure-eights", "figure-eights-usual-car")},
        "rings-usual-car": partial(domain_table, "rings-raw-usual-car"),
        **{part: partial(contact_table, part) for part in ("rings-raw-usual-car", "lanes-raw")},
        **{part: partial(impaired_table, part) for part in ("impaired", "impaired-jammed")},
    },
)
