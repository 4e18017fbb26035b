"""Gain of feasible residuals over tuned experts, on closed roads of every size and on the on-ramp.

All drivers are evaluated on the same test seeds; the confidence intervals take into account that trainings share them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.physics.arrays import Floats
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.presets import preset_values
from unjam.training.road_family import LONG_WARM_UP
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import read_part, write_part
from unjam_paper.study import NO_VALUE_TEXT, DriverComparison, Study, StudyFolder, evaluate_on_test_seeds, planned_runs
from unjam_paper.variants import ON_RAMP_JAM_AHEAD

SEEDS_PER_SIZE = 10
"""test seeds for each length or radius"""
PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL = "PI, tuned", "gap PI, tuned", "gap PI, tuned on the jammed ring"
GAP_PI_JAMMED_LONG_LABEL = f"{GAP_PI_JAMMED_LABEL}, double budget"
PI_LONG_TUNED = (
    "pi:window=13.31,catch_up_speed=1.193,gap_lower=5.997,gap_upper=58.76,"
    "safe_gap=1.037,safe_gap_rule=closing,time_constant=0.8318,first_command=own-speed"
)
"""result of `unjam tune ring --expert pi --steps 12000000`; that of `pi-from-gap` is `unjam:ring-gap-tuned`"""
GAP_PI_JAMMED_LONG_TUNED = (
    "pi-from-gap:window=23,catch_up_speed=2.916,gap_lower=6,gap_upper=80,safe_gap=2,"
    "time_constant=2.976,fade_time=26,history_factor=0"
)
"""result of `unjam tune ring-jammed --expert pi-from-gap --steps 12000000` within the ranges of
`unjam:ring-jammed-tuned`, which had half of these steps: results/tuned.json has both commands"""
PACER_LONG_TUNED = (
    "pacer:use_tuned=true,gathering_speed=1.96,gathering_gap=0.319,regathering_gap=0.1595,time_constant=0.0966"
)
"""result of `unjam tune figure-eight --expert pacer --reward eq16 --steps 4860000`, without parameters that have no
effect; with 600,000 steps it is `unjam:figure-eight-tuned`"""
CEILING_LABEL = "speed-limit leader"
"""a driver that leads all vehicles to the speed limit of the road, which no vehicle can know"""
OTHER_ROAD_LABEL = "residual trained on the other road"
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


@dataclass(frozen=True)
class EvaluationRoad:
    """A closed road and the drivers that are evaluated on it."""

    sizes: tuple[int, ...]
    """lengths or radii [m]"""
    make_scenario: Callable[[int], Scenario]
    driver_names: dict[str, str]
    """drivers by label"""
    baselines: tuple[str, ...]
    """labels of the tuned experts to which drivers are compared"""
    metric: str = "return"
    """the return that the trainings maximize"""
    make_ceiling: Callable[[int], Driver] | None = None

    def make_drivers(self, size: int, trained_drivers: dict[str, Driver]) -> dict[str, Driver]:
        """Return all drivers of a size by label."""
        step = self.make_scenario(size).control_step
        drivers = {label: make_driver(name, step) for label, name in self.driver_names.items()}
        return drivers | ({CEILING_LABEL: self.make_ceiling(size)} if self.make_ceiling else {}) | trained_drivers


def _make_ring(warmup: int, length: int) -> Ring:
    return Ring(length=(length, length), warmup=warmup)


def _limit_leader(length: int) -> Driver:
    return FollowerStopper(desired_speed=Ring().limit_speed(length), gaps=(0.5, 1.0, 1.5), time_constant=3.0)


RING_ROAD = EvaluationRoad(
    sizes=(220, 230, 240, 250, 260, 270),
    make_scenario=partial(_make_ring, 0),
    driver_names={
        **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0", PI_TUNED_LABEL: PI_LONG_TUNED},
        **{GAP_PI_LABEL: "unjam:ring-gap-tuned", GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned"},
    },
    baselines=(PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL),
    make_ceiling=_limit_leader,
)
FEASIBLE_ROADS = {
    "ring": RING_ROAD,
    "ring-jammed": replace(
        RING_ROAD,
        make_scenario=partial(_make_ring, LONG_WARM_UP),
        driver_names={**RING_ROAD.driver_names, GAP_PI_JAMMED_LONG_LABEL: GAP_PI_JAMMED_LONG_TUNED},
        baselines=(GAP_PI_LABEL, GAP_PI_JAMMED_LABEL, GAP_PI_JAMMED_LONG_LABEL),
    ),
    "figure-eight": EvaluationRoad(
        sizes=(32, 33, 34, 35),
        make_scenario=lambda radius: FigureEight(radius=(radius, radius)),
        driver_names={
            **{HUMAN_LABEL: "human", "pacer": "pacer", "varying pacer": "pacer:use_tuned=true"},
            **{PACER_TUNED_LABEL: "unjam:figure-eight-tuned", PACER_LONG_LABEL: PACER_LONG_TUNED},
            PACER_GENTLE_LABEL: preset_values("best", "figure-eight")["expert"],
        },
        baselines=(PACER_TUNED_LABEL, PACER_LONG_LABEL, PACER_GENTLE_LABEL),
        metric="return_eq16",
    ),
}


def _write_feasible(
    roads: Sequence[str], variant: str, study_folder: StudyFolder, seeds: int, folder: Path, workers: int
) -> None:
    trained = {
        road: [make_driver(str(study_folder.run_folder(run)), 0.1) for run in planned_runs([road], [variant], seeds)]
        for road in roads
    }
    with WorkerPool(workers) as pool:
        for name in roads:
            drivers = {f"training {seed}": driver for seed, driver in enumerate(trained[name])}
            for other in set(roads) - {name}:
                drivers[OTHER_ROAD_LABEL] = trained[other][0]
            road = FEASIBLE_ROADS[name]
            results = {}
            for size in road.sizes:
                evaluated = road.make_drivers(size, drivers)
                scenario, metrics = road.make_scenario(size), FEASIBILITY_STUDY_METRICS
                results[str(size)] = evaluate_on_test_seeds(scenario, evaluated, SEEDS_PER_SIZE, metrics, pool)
            write_part(folder, name, results)


def feasible_table(road: str, folder: Path) -> pd.DataFrame:
    """Return for each driver the metrics over all sizes, and the differences to the tuned experts."""
    comparison, about = DriverComparison([*read_part(folder, road).values()]), FEASIBLE_ROADS[road]
    labels = list(comparison.roads[0])
    rows = []
    for label, group in _group_trainings(labels, "training", "residual").items():
        dissolved = _dissolution_text(comparison.values(group, "time_to_dissolve"))
        differences = {
            f"difference to {baseline}": comparison.difference(group, baseline, about.metric, 0)
            for baseline in about.baselines
            if baseline in labels
        }
        row = {"driver": label, "return": comparison.mean(group, about.metric, 0), **differences}
        row["mean speed [m/s]"] = comparison.mean(group, "mean_speed", 2)
        row["difference to human baseline [m/s]"] = comparison.difference(group, HUMAN_LABEL, "mean_speed", 2)
        row["flow [veh/h]"] = comparison.mean(group, "outflow_veh_per_h", 0)
        row["fuel [ml/km]"] = comparison.mean(group, "fuel_ml_per_km", 0)
        row |= {"dissolved after [s]": dissolved, "min time gap [s]": comparison.min_time_gap(group)}
        rows.append({**row, "feasible": comparison.feasibility(group)})
    table = pd.DataFrame(rows)
    return table.loc[:, (table != NO_VALUE_TEXT).any()]


def _group_trainings(labels: Sequence[str], prefix: str, name: str) -> dict[str, list[str]]:
    """Return labels by row of a table: one row for each driver, and one for all trainings `PREFIX SEED`."""
    trainings = [label for label in labels if label.rpartition(" ")[0] == prefix]
    groups = {label: [label] for label in labels if label not in trainings}
    return groups | ({f"{name}, {len(trainings)} trainings": trainings} if trainings else {})


def _dissolution_text(times: Floats) -> str:
    """Return after how long waves dissolved, and in which share of the episodes if not in all."""
    share = np.isfinite(times).mean()
    return NO_VALUE_TEXT if not share else f"{np.nanmean(times):.1f}" + (f" ({share:.0%})" if share < 1.0 else "")


def _feasible_study(title: str, roads: Sequence[str], minutes: float, variant: str = "best") -> Study:
    return Study(
        title=title,
        write=partial(_write_feasible, roads, variant),
        make_runs=lambda seeds: planned_runs(roads, [variant], seeds),
        minutes=minutes,
        tables={road: partial(feasible_table, road) for road in roads},
    )


FEASIBLE_RING = _feasible_study(
    "feasible residual compared with the tuned expert, on the ring and the jammed ring", ("ring", "ring-jammed"), 20.0
)
FEASIBLE_FIGURE_EIGHT = _feasible_study(
    "feasible residual compared with the tuned expert, on the figure eight", ("figure-eight",), 5.0
)
FEASIBLE_RING_JAMMED = _feasible_study(
    "residual trained on the first half of jammed episodes compared with the tuned expert",
    *(("ring-jammed",), 20.0, "first-150-seconds"),
)


def on_ramp_study(variants: Mapping[str, str]) -> Study:
    """Return the study of variants that are trained on the on-ramp, with their labels in the table."""
    return Study(
        title="residual compared with tuned experts on the on-ramp, 5 % CAVs",
        write=partial(_write_on_ramp, tuple(variants)),
        make_runs=partial(planned_runs, ["on-ramp"], tuple(variants)),
        minutes=35.0,
        tables={"on-ramp": partial(_on_ramp_table, variants)},
    )


def _write_on_ramp(variants: Sequence[str], study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    names = ON_RAMP_DRIVERS | {
        f"{run.variant} {run.seed}": str(study_folder.controller_folder(run))
        for variant in variants
        for run in planned_runs(["on-ramp"], [variant], seeds)
    }
    drivers = {label: make_driver(name, ON_RAMP_ROAD.control_step) for label, name in names.items()}
    with WorkerPool(workers) as pool:
        results = evaluate_on_test_seeds(ON_RAMP_ROAD, drivers, ON_RAMP_SEEDS, ON_RAMP_METRICS, pool)
    write_part(folder, "on-ramp", results)


def _on_ramp_table(variants: Mapping[str, str], folder: Path) -> pd.DataFrame:
    """Return travel time and flow of each driver, and the differences to tuned experts and to the human baseline."""
    comparison = DriverComparison([read_part(folder, "on-ramp")])
    groups = {label: [label] for label in ON_RAMP_DRIVERS}
    for variant, label in variants.items():
        trainings = [each for each in comparison.roads[0] if each.rpartition(" ")[0] == variant]
        groups[f"{label}, {len(trainings)} trainings"] = trainings
    rows = []
    for label, group in groups.items():
        tuned = {
            f"difference to {baseline} [s]": comparison.difference(group, baseline, ON_RAMP_TIME, 1)
            for baseline in (ON_RAMP_TUNED_LABEL, LARGER_BUDGET_LABEL)
        }
        row = {"driver": label, "travel time [s]": comparison.mean(group, ON_RAMP_TIME, 1), **tuned}
        row["difference to human baseline [s]"] = comparison.difference(group, HUMAN_LABEL, ON_RAMP_TIME, 1)
        flow = comparison.difference(group, HUMAN_LABEL, ON_RAMP_FLOW, 0)
        row["flow, difference to human baseline [veh/h]"] = flow
        row["min time gap [s]"] = NO_VALUE_TEXT if label == HUMAN_LABEL else comparison.min_time_gap(group)
        verdicts = comparison.verdicts(group)
        several = f"{verdicts.count(FEASIBLE)} of {len(group)}"
        rows.append({**row, "feasible": comparison.feasibility(group) if len(group) == 1 else several})
    return pd.DataFrame(rows)
