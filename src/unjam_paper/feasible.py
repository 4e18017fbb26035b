"""Gain of feasible residuals over tuned experts on the same test seeds, on closed roads and on the on-ramp."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.drivers.car_following import FollowerStopper
from unjam.drivers.driver import Driver
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.physics.arrays import Floats
from unjam.road_family import LONG_WARM_UP
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.presets import preset_values
from unjam_paper import study
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.string_stability import measure_string_gains
from unjam_paper.variants import ON_RAMP_JAM_AHEAD

GAINS_SUFFIX = "-string-gains"
"""suffix of the names of parts with the string gains of drivers on a road"""
SEEDS_PER_SIZE = 10
"""test seeds for each length or radius"""
PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL = "PI, tuned", "gap PI, tuned", "gap PI, tuned on the jammed ring"
GAP_PI_JAMMED_LONG_LABEL = f"{GAP_PI_JAMMED_LABEL}, double budget"
GAP_PI_RETUNED_LABEL = "gap PI, tuned for usual cars"
GAP_PI_IDEAL_LABEL = "gap PI, tuned on the jammed ring for ideal cars"
IDEAL_RESIDUAL_LABEL = "residual trained for ideal cars"
PI_LONG_TUNED = (
    "pi:window=13.31,catch_up_speed=1.193,gap_lower=5.997,gap_upper=58.76,"
    "safe_gap=1.037,safe_gap_rule=closing,time_constant=0.8318,first_command=own-speed"
)
"""result of `unjam tune ring --expert pi --max-string-gain 0 --steps 12000000` for ideal cars; the result for
`pi-from-gap` is `unjam:ring-gap-tuned`"""
GAP_PI_JAMMED_LONG_TUNED = (
    "pi-from-gap:window=23,catch_up_speed=2.916,gap_lower=6,gap_upper=80,safe_gap=2,"
    "time_constant=2.976,fade_time=26,history_factor=0"
)
"""result of `unjam tune ring-jammed --expert pi-from-gap --max-string-gain 0 --steps 12000000` with the ranges of
`unjam:ring-jammed-tuned-ideal` and twice its steps; results/tuned.json has both commands"""
GAP_PI_RETUNED = (
    "pi-from-gap:window=9.933,catch_up_speed=0.3504,gap_lower=5.84,gap_upper=30.25,safe_gap=1.177,"
    "safe_gap_rule=closing,time_constant=9.995,human_time_headway=0.4,human_standstill_gap=2.634,"
    "fade_time=14.6,history_factor=0.3465"
)
"""result of `unjam tune ring --expert pi-from-gap --max-string-gain 0 --steps 12000000` for usual cars. On tuning seeds
its return equals that of `unjam:ring-gap-tuned`, which was tuned for ideal cars"""
FIRST_GAP_LABEL = "speed of the first gap"
FIRST_GAP_SPEED = (
    "pi-from-gap:window=10.11,catch_up_speed=0.02,gap_lower=4,gap_upper=24.92,safe_gap=0.5,time_constant=3,"
    "human_time_headway=1,human_standstill_gap=2,fade_time=1e6"
)
"""a driver that keeps the speed at which human drivers follow with its first observed gap: the limit speed, if vehicles
start evenly spaced. Its parameters were set by hand, outside the ranges of `unjam tune`"""
PACER_LONG_TUNED = (
    "pacer:use_tuned=true,gathering_speed=1.96,gathering_gap=0.319,regathering_gap=0.1595,time_constant=0.0966"
)
"""result of `unjam tune figure-eight --expert pacer --max-string-gain 0 --reward eq16 --steps 4860000`; both gaps
have no effect with `use_tuned`. The result of 600,000 steps is `unjam:figure-eight-tuned-ideal`"""
PACER_USUAL_LONG_TUNED = (
    "pacer:use_tuned=true,gathering_speed=2.126,gathering_gap=0.4935,regathering_gap=0.1352,time_constant=0.3639"
)
"""result of the same command for usual cars"""
PACER_TUNED_LABEL, PACER_GENTLE_LABEL = "pacer, tuned", "pacer, tuned, gentle"
PACER_LONG_LABEL = "pacer, tuned, training budget"
PACER_GENTLE: str = preset_values("best", "figure-eight")["expert"]
PACERS = {HUMAN_LABEL: "human", "pacer": "pacer", "varying pacer": "pacer:use_tuned=true"}
FIGURE_EIGHT_RADII = (32, 33, 34, 35)
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


@dataclass(frozen=True)
class EvaluationRoad:
    """A closed road and the drivers that are evaluated on it."""

    sizes: tuple[int, ...]
    """lengths or radii [m]"""
    make_scenario: Callable[[int], Scenario]
    drivers: dict[str, study.DriverSource]
    baselines: tuple[str, ...]
    """labels of the tuned experts to which drivers are compared"""
    metric: str = "return"
    """the return that the trainings maximize"""
    evaluate: Callable[..., dict[str, Any]] = study.evaluate_metrics
    gain_road: str = ""
    """scenario on which string gains are measured; empty: they are not measured"""


def _limit_speed_driver(ring: Ring) -> Driver:
    return FollowerStopper(desired_speed=ring.limit_speed(ring.length[0]), gaps=(0.5, 1.0, 1.5), time_constant=3.0)


LIMIT_DRIVERS: dict[str, study.DriverSource] = {"speed-limit leader": _limit_speed_driver}
"""a driver that leads all vehicles at the limit speed of the ring, which it knows"""
RING_LENGTHS = (220, 230, 240, 250, 260, 270)
RING_DRIVERS: dict[str, study.DriverSource] = {
    **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0", PI_TUNED_LABEL: PI_LONG_TUNED},
    **{GAP_PI_LABEL: "unjam:ring-gap-tuned", GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned-ideal"},
}
USUAL_CAR_DRIVERS: dict[str, study.DriverSource] = {
    **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0"},
    **{GAP_PI_LABEL: "unjam:ring-gap-tuned", GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned"},
}
FEASIBLE_ROADS = {
    "ring": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), actuator=INSTANT_ACTUATOR),
        drivers=RING_DRIVERS | LIMIT_DRIVERS,
        baselines=(PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL),
    ),
    "ring-jammed": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), warmup=LONG_WARM_UP, actuator=INSTANT_ACTUATOR),
        drivers={**RING_DRIVERS, GAP_PI_JAMMED_LONG_LABEL: GAP_PI_JAMMED_LONG_TUNED, **LIMIT_DRIVERS},
        baselines=(GAP_PI_LABEL, GAP_PI_JAMMED_LABEL, GAP_PI_JAMMED_LONG_LABEL),
    ),
    "ring-usual-car": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length)),
        drivers={
            **{**USUAL_CAR_DRIVERS, GAP_PI_RETUNED_LABEL: GAP_PI_RETUNED, FIRST_GAP_LABEL: FIRST_GAP_SPEED},
            **{IDEAL_RESIDUAL_LABEL: "unjam:ring-best-ideal", **LIMIT_DRIVERS},
        },
        baselines=(GAP_PI_LABEL, GAP_PI_RETUNED_LABEL, FIRST_GAP_LABEL),
        evaluate=study.evaluate_in_batches,
        gain_road="ring",
    ),
    "ring-jammed-usual-car": EvaluationRoad(
        sizes=RING_LENGTHS,
        make_scenario=lambda length: Ring(length=(length, length), warmup=LONG_WARM_UP),
        drivers={
            **{**USUAL_CAR_DRIVERS, GAP_PI_IDEAL_LABEL: "unjam:ring-jammed-tuned-ideal"},
            **{IDEAL_RESIDUAL_LABEL: "unjam:ring-jammed-best-ideal", **LIMIT_DRIVERS},
        },
        baselines=(GAP_PI_JAMMED_LABEL, GAP_PI_IDEAL_LABEL),
        evaluate=study.evaluate_in_batches,
        gain_road="ring-jammed",
    ),
    "figure-eight-usual-car": EvaluationRoad(
        sizes=FIGURE_EIGHT_RADII,
        make_scenario=lambda radius: FigureEight(radius=(radius, radius)),
        drivers={
            **PACERS,
            **{PACER_TUNED_LABEL: "unjam:figure-eight-tuned", PACER_LONG_LABEL: PACER_USUAL_LONG_TUNED},
            **{PACER_GENTLE_LABEL: PACER_GENTLE, IDEAL_RESIDUAL_LABEL: "unjam:figure-eight-best-ideal"},
        },
        baselines=(PACER_TUNED_LABEL, PACER_LONG_LABEL, PACER_GENTLE_LABEL),
        metric="return_eq16",
        gain_road="figure-eight",
    ),
    "figure-eight": EvaluationRoad(
        sizes=FIGURE_EIGHT_RADII,
        make_scenario=lambda radius: FigureEight(radius=(radius, radius), actuator=INSTANT_ACTUATOR),
        drivers={
            **{**PACERS, PACER_TUNED_LABEL: "unjam:figure-eight-tuned-ideal", PACER_LONG_LABEL: PACER_LONG_TUNED},
            PACER_GENTLE_LABEL: PACER_GENTLE,
        },
        baselines=(PACER_TUNED_LABEL, PACER_LONG_LABEL, PACER_GENTLE_LABEL),
        metric="return_eq16",
    ),
}


def _feasible_parts(variants: Mapping[str, str], study_folder: study.StudyFolder, seeds: int) -> dict[str, StudyPart]:
    parts: dict[str, StudyPart] = {}
    for name, variant in variants.items():
        road, runs = FEASIBLE_ROADS[name], study.planned_runs([name], [variant], seeds)
        trained = {f"training {run.seed}": run for run in runs}
        for other_road in variants.keys() - {name}:
            trained["residual trained on the other road"] = study.PlannedRun(other_road, variants[other_road], 0)
        drivers = road.drivers | {label: study_folder.run_folder(run) for label, run in trained.items()}
        for size in road.sizes:
            arguments = road.make_scenario(size), drivers, SEEDS_PER_SIZE, FEASIBILITY_STUDY_METRICS
            parts[f"{name}/{size}"] = road.evaluate, arguments
        if road.gain_road:
            cav_drivers = {
                label: source for label, source in drivers.items() if label not in (HUMAN_LABEL, *LIMIT_DRIVERS)
            }
            parts[f"{name}{GAINS_SUFFIX}"] = measure_string_gains, (road.gain_road, cav_drivers)
    return parts


def feasible_table(road: str, folder: Path) -> pd.DataFrame:
    """Return means of metrics of each driver over all sizes, and its differences to the tuned experts."""
    comparison, evaluation = study.DriverComparison([*read_part(folder, road).values()]), FEASIBLE_ROADS[road]
    gains: dict[str, float | None] = read_part(folder, f"{road}{GAINS_SUFFIX}") if evaluation.gain_road else {}
    rows = []
    for label, group in comparison.groups({"training": "residual"}).items():
        row = {"driver": label, "return": comparison.mean(group, evaluation.metric, 0)}
        for baseline in evaluation.baselines:
            if baseline in comparison.roads[0]:
                row[f"difference to {baseline}"] = comparison.difference(group, baseline, evaluation.metric, 0)
        row["mean speed [m/s]"] = comparison.mean(group, "mean_speed", 2)
        row["difference to human baseline [m/s]"] = comparison.difference(group, HUMAN_LABEL, "mean_speed", 2)
        row["flow [veh/h]"] = comparison.mean(group, "outflow_veh_per_h", 0)
        row["fuel [ml/km]"] = comparison.mean(group, "fuel_ml_per_km", 0)
        row["dissolved after [s]"] = _dissolution_text(comparison.values(group, "time_to_dissolve"))
        row["min time gap [s]"] = comparison.min_time_gap(group)
        row["string gain"] = _gain_text([gains[driver] for driver in group if driver in gains])
        rows.append({**row, "feasible": comparison.feasibility(group)})
    table = pd.DataFrame(rows)
    return table.loc[:, (table != study.NO_VALUE_TEXT).any()]


def _gain_text(gains: Sequence[float | None]) -> str:
    """Return the range of string gains as text; None: the driver falls behind its leader."""
    known = [gain for gain in gains if gain is not None]
    texts = [" to ".join(f"{gain:.2f}" for gain in sorted({min(known), max(known)}))] if known else []
    texts += [f"{len(gains) - len(known)} of {len(gains)} fall behind their leaders"] if len(known) < len(gains) else []
    return "; ".join(texts) or study.NO_VALUE_TEXT


def _dissolution_text(times: Floats) -> str:
    """Return the mean time until waves dissolve, with the share of episodes in which they do."""
    share = np.isfinite(times).mean()
    return study.NO_VALUE_TEXT if not share else f"{np.nanmean(times):.1f}" + (f" ({share:.0%})" if share < 1.0 else "")


def feasible_study(title: str, variants: Mapping[str, str], minutes: float) -> study.Study:
    """Return the study that compares trainings with tuned experts on closed roads; `variants` has one for each road."""
    return study.Study(
        title=title,
        make_runs=lambda seeds: [
            run for road, name in variants.items() for run in study.planned_runs([road], [name], seeds)
        ],
        make_parts=partial(_feasible_parts, variants),
        minutes=minutes,
        tables={road: partial(feasible_table, road) for road in variants},
    )


def on_ramp_study(variants: Mapping[str, str]) -> study.Study:
    """Return the study of trainings on the on-ramp; `variants` has the labels in the table by variant."""
    return study.Study(
        title="residual compared with tuned experts on the on-ramp, 5 % CAVs",
        make_runs=partial(study.planned_runs, ["on-ramp"], tuple(variants)),
        make_parts=partial(_on_ramp_parts, tuple(variants)),
        minutes=35.0,
        tables={"on-ramp": partial(_on_ramp_table, variants)},
    )


def _on_ramp_parts(variants: Sequence[str], study_folder: study.StudyFolder, seeds: int) -> dict[str, StudyPart]:
    drivers: dict[str, study.DriverSource] = {**ON_RAMP_DRIVERS}
    for variant, seed in product(variants, range(seeds)):
        drivers[f"{variant} {seed}"] = study_folder.controller_folder(study.PlannedRun("on-ramp", variant, seed))
    return {"on-ramp": (study.evaluate_metrics, (ON_RAMP_ROAD, drivers, ON_RAMP_SEEDS, ON_RAMP_METRICS))}


def _on_ramp_table(variants: Mapping[str, str], folder: Path) -> pd.DataFrame:
    """Return travel time and flow of each driver, and its differences to tuned experts and to the human baseline."""
    comparison = study.DriverComparison([read_part(folder, "on-ramp")])
    rows = []
    for label, group in comparison.groups(variants).items():
        row = {"driver": label, "travel time [s]": comparison.mean(group, ON_RAMP_TIME, 1)}
        for baseline in (ON_RAMP_TUNED_LABEL, LARGER_BUDGET_LABEL):
            row[f"difference to {baseline} [s]"] = comparison.difference(group, baseline, ON_RAMP_TIME, 1)
        row["difference to human baseline [s]"] = comparison.difference(group, HUMAN_LABEL, ON_RAMP_TIME, 1)
        flow = comparison.difference(group, HUMAN_LABEL, ON_RAMP_FLOW, 0)
        row["flow, difference to human baseline [veh/h]"] = flow
        row["min time gap [s]"] = study.NO_VALUE_TEXT if label == HUMAN_LABEL else comparison.min_time_gap(group)
        count = f"{comparison.verdicts(group).count(FEASIBLE)} of {len(group)}"
        rows.append({**row, "feasible": comparison.feasibility(group) if len(group) == 1 else count})
    return pd.DataFrame(rows)
