"""Feasible controllers: their gain over tuned experts, and their feasibility far from their training roads.

Residuals are compared with tuned experts on the same test seeds, on closed roads of every size and on the on-ramp. The
study `envelope` takes packaged controllers to other sizes, roads without SUMO's safety checks, and impaired vehicles.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller.certificate import make_certificate
from unjam.controller.file import SUFFIX, read_controller
from unjam.drivers.car_following import FollowerStopper
from unjam.drivers.driver import Driver
from unjam.drivers.safety import INSTANT_ACTUATOR, STANDARD_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.physics.arrays import Floats
from unjam.road_family import LONG_WARM_UP
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.motorway import ON_RAMP, Motorway, Ramp
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.export import export_controller
from unjam.training.presets import preset_values
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import (
    NO_VALUE_TEXT,
    DriverComparison,
    DriverSource,
    PlannedRun,
    Study,
    StudyFolder,
    evaluate_in_batches,
    evaluate_metrics,
    mean_text,
    planned_runs,
)
from unjam_paper.variants import ON_RAMP_JAM_AHEAD

SEEDS_PER_SIZE = 10
"""test seeds for each length or radius"""
PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL = "PI, tuned", "gap PI, tuned", "gap PI, tuned on the jammed ring"
GAP_PI_JAMMED_LONG_LABEL = f"{GAP_PI_JAMMED_LABEL}, double budget"
GAP_PI_RETUNED_LABEL, GAP_PI_IDEAL_LABEL = (
    "gap PI, tuned for usual cars",
    "gap PI, tuned on the jammed ring for ideal cars",
)
IDEAL_RESIDUAL_LABEL = "residual trained for ideal cars"
PI_LONG_TUNED = (
    "pi:window=13.31,catch_up_speed=1.193,gap_lower=5.997,gap_upper=58.76,"
    "safe_gap=1.037,safe_gap_rule=closing,time_constant=0.8318,first_command=own-speed"
)
"""result of `unjam tune ring --expert pi --max-string-gain 0 --steps 12000000` for vehicles that obey at once; that of
`pi-from-gap` is `unjam:ring-gap-tuned`"""
GAP_PI_JAMMED_LONG_TUNED = (
    "pi-from-gap:window=23,catch_up_speed=2.916,gap_lower=6,gap_upper=80,safe_gap=2,"
    "time_constant=2.976,fade_time=26,history_factor=0"
)
"""result of `unjam tune ring-jammed --expert pi-from-gap --max-string-gain 0 --steps 12000000` within the ranges of
`unjam:ring-jammed-tuned-ideal`, which had half of these steps: results/tuned.json has both commands"""
GAP_PI_RETUNED = (
    "pi-from-gap:window=9.933,catch_up_speed=0.3504,gap_lower=5.84,gap_upper=30.25,safe_gap=1.177,"
    "safe_gap_rule=closing,time_constant=9.995,human_time_headway=0.4,human_standstill_gap=2.634,"
    "fade_time=14.6,history_factor=0.3465"
)
"""result of `unjam tune ring --expert pi-from-gap --max-string-gain 0 --steps 12000000` for usual cars: on tuning seeds
it has the return of `unjam:ring-gap-tuned`, which was tuned for ideal cars"""
PACER_LONG_TUNED = (
    "pacer:use_tuned=true,gathering_speed=1.96,gathering_gap=0.319,regathering_gap=0.1595,time_constant=0.0966"
)
"""result of `unjam tune figure-eight --expert pacer --max-string-gain 0 --reward eq16 --steps 4860000`, without
parameters that have no effect; with 600,000 steps it is `unjam:figure-eight-tuned-ideal`"""
PACER_TUNED_LABEL, PACER_GENTLE_LABEL = "pacer, tuned", "pacer, tuned, gentle"
PACER_LONG_LABEL = "pacer, tuned, training budget"
FEASIBILITY_STUDY_METRICS = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "outflow_veh_per_h", "fuel_ml_per_km"),
    *("feasibility", "min_time_gap", "cav_max_braking", "filter_override_share", "speed_std_fleet_steady"),
    "time_to_dissolve",
)
ON_RAMP_ROAD = replace(ON_RAMP, penetration_rate=0.05)
ON_RAMP_SEEDS = 100
ON_RAMP_TUNED_LABEL, LARGER_BUDGET_LABEL = "unjam:on-ramp-tuned", "tuned, larger budget"
ON_RAMP_DRIVERS = {
    **{HUMAN_LABEL: "human", "ACC baseline": "cruise"},
    **{ON_RAMP_TUNED_LABEL: ON_RAMP_TUNED_LABEL, LARGER_BUDGET_LABEL: ON_RAMP_JAM_AHEAD},
}
"""drivers that do not learn; residuals are added to one of the last two"""
ON_RAMP_TIME, ON_RAMP_FLOW = "travel_time", "outflow_veh_per_h"
ON_RAMP_METRICS = (
    *(ON_RAMP_TIME, ON_RAMP_FLOW, "human_braking_beyond_4_5", "mean_speed", "fuel_ml_per_km"),
    *("feasibility", "min_time_gap", "cav_max_braking"),
)
ENVELOPE_SEEDS, RAW_ACTUATION_SEEDS, IMPAIRED_SEEDS = 2, 5, 8
"""test seeds of each driver on each road"""
CONTROLLER_ROADS: dict[str, str] = {
    "unjam:best": "ring-jammed",
    **{f"unjam:{name}": "ring" for name in ("ring-best-ideal", "ring-gap-tuned", "ring-tuned")},
    **{f"unjam:{name}": "ring" for name in ("rings-tuned", "shared-rings-tuned")},
    **{f"unjam:{name}-ideal": "ring-jammed" for name in ("ring-jammed-best", "ring-jammed-tuned")},
    **{f"unjam:{name}": "figure-eight" for name in ("figure-eight-best", "figure-eight-tuned-ideal")},
}
"""packaged controllers for closed roads that were tuned or trained for ideal cars, and the road of each"""
USUAL_CAR_ROADS: dict[str, str] = {
    **{"unjam:ring-best": "ring", "unjam:ring-gap-tuned": "ring"},
    **{f"unjam:{name}": "ring-jammed" for name in ("ring-jammed-best", "ring-jammed-tuned")},
}
"""those that are evaluated in usual cars"""
LANE_CONTROLLERS = ("unjam:on-ramp-tuned",)
RING_CONTROLLERS = tuple(name for name, road in CONTROLLER_ROADS.items() if road != "figure-eight")
RING_STEPS: dict[str, Any] = {"simulation_step": 0.1, "steps_per_control_step": 1}
"""those of the rings, which their controllers need on any road"""
LANE_SECONDS = 900.0
"""duration of an episode on a motorway lane [s]"""
IMPAIRED_DRIVERS = "unjam:best", "unjam:ring-best", "unjam:ring-jammed-best", "unjam:ring-jammed-tuned"
VEHICLE_SPACINGS = {"shorter": (8, 10), "as trained on": (10, 12), "longer": (13, 18)}
"""range of the road length per vehicle [m]"""
WORST_PART, USUAL_CAR_WORST_PART = "worst", "worst-usual-car"
"""parts with the worst cases of the certificates"""
ENVELOPE_METRICS = ("return", "mean_speed", "min_time_gap", "cav_max_braking", "steps", "collisions")
LANE_CONDITIONS: dict[str, dict[str, Any]] = {
    "a free lane": {"inflow": 1200.0, "off_peak_inflow": 1200.0},
    "a full lane": {"inflow": 2400.0, "off_peak_inflow": 2000.0},
    "a full lane, half of all automated": {"inflow": 2400.0, "off_peak_inflow": 2000.0, "penetration_rate": 0.5},
}
"""demand on one lane of a motorway without cut-ins"""
SENSED = ("gap_error", "speed_error")
IMPAIRMENTS: dict[str, dict[str, Any]] = {
    "usual car, exact sensors": {},
    "ideal car": {"actuator": INSTANT_ACTUATOR},
    "delay 0.2 s, lag 0.5 s": {"actuator": Actuator(delay=0.2, lag=0.5)},
    "delay 0.5 s, lag 0.5 s": {"actuator": Actuator(delay=0.5, lag=0.5)},
    **{
        label: {
            "sensors": Sensors(**dict.fromkeys(SENSED, error)),
            "safety": SafetyFilter(**dict.fromkeys(SENSED, error)),
        }
        for label, error in {"gap and speed off by up to 0.3": 0.3, "off by up to 1.0": 1.0}.items()
    },
    "every tenth reading missing": {"sensors": Sensors(dropout=0.1)},
    "every third reading missing": {"sensors": Sensors(dropout=1.0 / 3.0)},
}
"""changes to the actuation and the sensors of CAVs, which else are usual cars"""


@dataclass(frozen=True)
class EvaluationRoad:
    """A closed road and the drivers that are evaluated on it."""

    sizes: tuple[int, ...]
    """lengths or radii [m]"""
    make_scenario: Callable[[int], Scenario]
    drivers: dict[str, DriverSource]
    baselines: tuple[str, ...]
    """labels of the tuned experts to which drivers are compared"""
    metric: str = "return"
    """the return that the trainings maximize"""
    evaluate: Callable[..., dict[str, Any]] = evaluate_metrics


def _limit_leader(ring: Ring) -> Driver:
    return FollowerStopper(desired_speed=ring.limit_speed(ring.length[0]), gaps=(0.5, 1.0, 1.5), time_constant=3.0)


CEILING: dict[str, DriverSource] = {"speed-limit leader": _limit_leader}
"""a driver that leads all vehicles to the speed limit of the road, which no vehicle can know"""
RING_LENGTHS = (220, 230, 240, 250, 260, 270)
RING_DRIVERS: dict[str, DriverSource] = {
    **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0", PI_TUNED_LABEL: PI_LONG_TUNED},
    **{GAP_PI_LABEL: "unjam:ring-gap-tuned", GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned-ideal"},
}
USUAL_CAR_DRIVERS: dict[str, DriverSource] = {
    **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0"},
    **{GAP_PI_LABEL: "unjam:ring-gap-tuned", GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned"},
}
FEASIBLE_ROADS = {
    "ring": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), actuator=INSTANT_ACTUATOR),
        drivers=RING_DRIVERS | CEILING,
        baselines=(PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL),
    ),
    "ring-jammed": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), warmup=LONG_WARM_UP, actuator=INSTANT_ACTUATOR),
        drivers={**RING_DRIVERS, GAP_PI_JAMMED_LONG_LABEL: GAP_PI_JAMMED_LONG_TUNED, **CEILING},
        baselines=(GAP_PI_LABEL, GAP_PI_JAMMED_LABEL, GAP_PI_JAMMED_LONG_LABEL),
    ),
    "ring-usual-car": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length)),
        drivers={
            **{**USUAL_CAR_DRIVERS, GAP_PI_RETUNED_LABEL: GAP_PI_RETUNED},
            **{IDEAL_RESIDUAL_LABEL: "unjam:ring-best-ideal", **CEILING},
        },
        baselines=(GAP_PI_LABEL, GAP_PI_RETUNED_LABEL),
        evaluate=evaluate_in_batches,
    ),
    "ring-jammed-usual-car": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), warmup=LONG_WARM_UP),
        drivers={
            **{**USUAL_CAR_DRIVERS, GAP_PI_IDEAL_LABEL: "unjam:ring-jammed-tuned-ideal"},
            **{IDEAL_RESIDUAL_LABEL: "unjam:ring-jammed-best-ideal", **CEILING},
        },
        baselines=(GAP_PI_JAMMED_LABEL, GAP_PI_IDEAL_LABEL),
        evaluate=evaluate_in_batches,
    ),
    "figure-eight": EvaluationRoad(
        sizes=(32, 33, 34, 35),
        make_scenario=lambda radius: FigureEight(radius=(radius, radius), actuator=INSTANT_ACTUATOR),
        drivers={
            **{HUMAN_LABEL: "human", "pacer": "pacer", "varying pacer": "pacer:use_tuned=true"},
            **{PACER_TUNED_LABEL: "unjam:figure-eight-tuned-ideal", PACER_LONG_LABEL: PACER_LONG_TUNED},
            PACER_GENTLE_LABEL: preset_values("best", "figure-eight")["expert"],
        },
        baselines=(PACER_TUNED_LABEL, PACER_LONG_LABEL, PACER_GENTLE_LABEL),
        metric="return_eq16",
    ),
}


def _feasible_parts(variants: Mapping[str, str], study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    parts: dict[str, StudyPart] = {}
    for name, variant in variants.items():
        road, runs = FEASIBLE_ROADS[name], planned_runs([name], [variant], seeds)
        trained = {f"training {run.seed}": run for run in runs}
        for other in variants.keys() - {name}:
            trained["residual trained on the other road"] = PlannedRun(other, variants[other], 0)
        drivers = road.drivers | {label: study_folder.run_folder(run) for label, run in trained.items()}
        for size in road.sizes:
            arguments = road.make_scenario(size), drivers, SEEDS_PER_SIZE, FEASIBILITY_STUDY_METRICS
            parts[f"{name}/{size}"] = road.evaluate, arguments
    return parts


def feasible_table(road: str, folder: Path) -> pd.DataFrame:
    """Return for each driver the metrics over all sizes, and the differences to the tuned experts."""
    comparison, about = DriverComparison([*read_part(folder, road).values()]), FEASIBLE_ROADS[road]
    rows = []
    for label, group in comparison.groups({"training": "residual"}).items():
        row = {"driver": label, "return": comparison.mean(group, about.metric, 0)}
        for baseline in (each for each in about.baselines if each in comparison.roads[0]):
            row[f"difference to {baseline}"] = comparison.difference(group, baseline, about.metric, 0)
        row["mean speed [m/s]"] = comparison.mean(group, "mean_speed", 2)
        row["difference to human baseline [m/s]"] = comparison.difference(group, HUMAN_LABEL, "mean_speed", 2)
        row["flow [veh/h]"] = comparison.mean(group, "outflow_veh_per_h", 0)
        row["fuel [ml/km]"] = comparison.mean(group, "fuel_ml_per_km", 0)
        row["dissolved after [s]"] = _dissolution_text(comparison.values(group, "time_to_dissolve"))
        row["min time gap [s]"] = comparison.min_time_gap(group)
        rows.append({**row, "feasible": comparison.feasibility(group)})
    table = pd.DataFrame(rows)
    return table.loc[:, (table != NO_VALUE_TEXT).any()]


def _dissolution_text(times: Floats) -> str:
    share = np.isfinite(times).mean()
    return NO_VALUE_TEXT if not share else f"{np.nanmean(times):.1f}" + (f" ({share:.0%})" if share < 1.0 else "")


def feasible_study(title: str, variants: Mapping[str, str], minutes: float) -> Study:
    """Return the study that compares trainings with tuned experts of closed roads; `variants`: one by road."""
    return Study(
        title=title,
        make_runs=lambda seeds: [
            run for road, variant in variants.items() for run in planned_runs([road], [variant], seeds)
        ],
        make_parts=partial(_feasible_parts, variants),
        minutes=minutes,
        tables={road: partial(feasible_table, road) for road in variants},
    )


def on_ramp_study(variants: Mapping[str, str]) -> Study:
    """Return the study of variants that are trained on the on-ramp, with their labels in the table."""
    return Study(
        title="residual compared with tuned experts on the on-ramp, 5 % CAVs",
        make_runs=partial(planned_runs, ["on-ramp"], tuple(variants)),
        make_parts=partial(_on_ramp_parts, tuple(variants)),
        minutes=35.0,
        tables={"on-ramp": partial(_on_ramp_table, variants)},
    )


def _on_ramp_parts(variants: Sequence[str], study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    drivers: dict[str, DriverSource] = {**ON_RAMP_DRIVERS}
    for variant, seed in product(variants, range(seeds)):
        drivers[f"{variant} {seed}"] = study_folder.controller_folder(PlannedRun("on-ramp", variant, seed))
    return {"on-ramp": (evaluate_metrics, (ON_RAMP_ROAD, drivers, ON_RAMP_SEEDS, ON_RAMP_METRICS))}


def _on_ramp_table(variants: Mapping[str, str], folder: Path) -> pd.DataFrame:
    """Return travel time and flow of each driver, and the differences to tuned experts and to the human baseline."""
    comparison = DriverComparison([read_part(folder, "on-ramp")])
    rows = []
    for label, group in comparison.groups(variants).items():
        row = {"driver": label, "travel time [s]": comparison.mean(group, ON_RAMP_TIME, 1)}
        for baseline in (ON_RAMP_TUNED_LABEL, LARGER_BUDGET_LABEL):
            row[f"difference to {baseline} [s]"] = comparison.difference(group, baseline, ON_RAMP_TIME, 1)
        row["difference to human baseline [s]"] = comparison.difference(group, HUMAN_LABEL, ON_RAMP_TIME, 1)
        flow = comparison.difference(group, HUMAN_LABEL, ON_RAMP_FLOW, 0)
        row["flow, difference to human baseline [veh/h]"] = flow
        row["min time gap [s]"] = NO_VALUE_TEXT if label == HUMAN_LABEL else comparison.min_time_gap(group)
        several = f"{comparison.verdicts(group).count(FEASIBLE)} of {len(group)}"
        rows.append({**row, "feasible": comparison.feasibility(group) if len(group) == 1 else several})
    return pd.DataFrame(rows)


def envelope_rings(**changes: Any) -> Iterator[tuple[str, Ring]]:
    """Yield the rings by name, with changes to all of them."""
    each = product((5, 11, 22, 44), (1, 2, 3), VEHICLE_SPACINGS.items(), (0, LONG_WARM_UP))
    for vehicles, cavs, (words, (low, high)), warmup in each:
        name = f"{vehicles} vehicles, {cavs} automated, {words}{', jammed' if warmup else ''}"
        length = low * vehicles, high * vehicles
        size: dict[str, Any] = {"vehicles": vehicles, "cavs": cavs, "length": length, "warmup": warmup}
        yield name, Ring(**{"actuator": INSTANT_ACTUATOR, **size, **changes})


def envelope_figure_eights() -> Iterator[tuple[str, FigureEight]]:
    """Yield the figure eights by name."""
    for low, high in ((27, 29), (30, 31), (32, 35), (36, 40), (41, 50)):
        yield f"radius {low} to {high} m", FigureEight(radius=(low, high), actuator=INSTANT_ACTUATOR)


def envelope_lanes(**changes: Any) -> Iterator[tuple[str, Motorway]]:
    """Yield motorway lanes by name on which the safety filter is active and the checks of SUMO are not."""
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
    closed, parts = tuple(CONTROLLER_ROADS), dict[str, StudyPart]()
    for part, road_by_driver in ((WORST_PART, CONTROLLER_ROADS), (USUAL_CAR_WORST_PART, USUAL_CAR_ROADS)):
        actuator = INSTANT_ACTUATOR if part == WORST_PART else STANDARD_ACTUATOR
        for driver, road in road_by_driver.items():
            parts[f"{part}/{driver}"] = _certify_worst_cases, (driver, road, actuator)
    usual_cars: dict[str, Any] = {"actuator": STANDARD_ACTUATOR}
    tests: tuple[tuple[str, Iterator[tuple[str, Scenario]], tuple[str, ...], int], ...] = (
        ("rings", envelope_rings(), closed, ENVELOPE_SEEDS),
        ("figure-eights", envelope_figure_eights(), closed, ENVELOPE_SEEDS),
        ("rings-raw", envelope_rings(actuation="raw"), closed, RAW_ACTUATION_SEEDS),
        ("rings-raw-usual-car", envelope_rings(actuation="raw", **usual_cars), tuple(USUAL_CAR_ROADS), ENVELOPE_SEEDS),
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


def _certify_worst_cases(controller: str, road: str, actuator: Actuator, workers: int) -> dict[str, Any]:
    with TemporaryDirectory() as folder:
        file = Path(folder, f"controller{SUFFIX}")
        export_controller(controller, file, scenario=road, settings={"actuator": asdict(actuator)})
        return make_certificate(read_controller(file))["worst_cases"]


def worst_table(part: str, folder: Path) -> pd.DataFrame:
    """Return how close each controller came to leaders that brake to a stop and to leaders found by a search."""
    rows: list[dict[str, Any]] = []
    for controller, worst in read_part(folder, part).items():
        road = {**CONTROLLER_ROADS, **USUAL_CAR_ROADS}[controller]
        row = {"controller": controller, "road": road, "stops": f"{worst['leader_stops']:,}"}
        row |= {"steps": f"{worst['steps']:,}", "contacts": worst["contacts"], "min gap [m]": f"{worst['min_gap']:.2f}"}
        row["min time gap [s]"] = f"{worst['min_time_gap']:.2f}"
        rows.append({**row, "max braking [m/s²]": f"{worst['max_braking']:.1f}"})
    return pd.DataFrame(rows)


def domain_table(part: str, folder: Path) -> pd.DataFrame:
    """Return on how many roads each controller is feasible, and its gain in speed in the mean and on the worst road."""
    roads, rows = read_part(folder, part), []
    comparison = DriverComparison([*roads.values()])
    for driver in (driver for driver in comparison.roads[0] if driver != HUMAN_LABEL):
        speeds = (comparison.values([label], "mean_speed").mean((1, 2)) for label in (driver, HUMAN_LABEL))
        gains = np.subtract(*speeds)
        least = int(np.argmin(gains))
        feasible = f"{comparison.verdicts([driver]).count(FEASIBLE)} of {len(roads)} roads"
        row = {"controller": driver, "feasible on": feasible, **_safety_cells(comparison, driver)}
        row["mean difference to human baseline [m/s]"] = f"{gains.mean():+.2f}"
        rows.append({**row, "smallest difference [m/s]": f"{gains[least]:+.2f} ({list(roads)[least]})"})
    return pd.DataFrame(rows)


def contact_table(part: str, folder: Path) -> pd.DataFrame:
    """Return the contacts and the smallest time gap of each controller where SUMO's safety checks are off."""
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
    """Return the return of each controller with impaired vehicles, its minimum time gap, and why it is infeasible."""
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
        **{part: partial(domain_table, part) for part in ("rings", "figure-eights")},
        "rings-usual-car": partial(domain_table, "rings-raw-usual-car"),
        **{part: partial(contact_table, part) for part in ("rings-raw", "rings-raw-usual-car", "lanes-raw")},
        **{part: partial(impaired_table, part) for part in ("impaired", "impaired-jammed")},
    },
)
