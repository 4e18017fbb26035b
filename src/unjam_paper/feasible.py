"""What a drivable residual is worth on closed roads: beside tuned experts, people alone, and a ceiling.

Every driver on every length or radius on the same seeds; the seeds are shared by all trainings, which the
intervals know. The ring's ceiling leads all to the limit of the length, which no car can know.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isinf
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.files import atomic_write, to_json
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.physics.arrays import Floats
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.training.presets import BEST_BY_SCENARIO
from unjam.training.road_family import LONG_WARM_UP
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, StudyFolder, evaluate_on_test_seeds, planned_runs

SEEDS_PER_SIZE = 10
"""of each length or radius"""
PI_TUNED_LABEL = "PI, tuned"
GAP_PI_LABEL, GAP_PI_JAMMED_LABEL = "PI from its gap, tuned", "PI from its gap, tuned in a jam"
GAP_PI_JAMMED_LONG_LABEL = f"{GAP_PI_JAMMED_LABEL}, twice as long"
PI_LONG_TUNED = (
    "pi:window=13.31,catch_up_speed=1.193,gap_lower=5.997,gap_upper=58.76,"
    "safe_gap=1.037,safe_gap_rule=closing,time_constant=0.8318,first_command=own-speed"
)
"""what `unjam tune ring --expert pi --steps 12000000` finds; of the other it is `unjam:ring-gap-tuned`"""
GAP_PI_JAMMED_LONG_TUNED = (
    "pi-from-gap:window=23,catch_up_speed=2.916,gap_lower=6,gap_upper=80,safe_gap=2,"
    "time_constant=2.976,fading=26,watched_share=0"
)
"""what `unjam tune ring-jammed --expert pi-from-gap --steps 12000000` finds within the bounds that were given
for `unjam:ring-jammed-tuned`, which had half of these steps: results/tuned.json has both commands"""
PACER_LONG_TUNED = (
    "pacer:use_tuned=true,gathering_speed=1.96,gathering_gap=0.319,regathering_gap=0.1595,time_constant=0.0966"
)
"""what `unjam tune figure-eight --expert pacer --reward eq16 --steps 4860000` finds, without what it does not
use; with 600,000 steps it is `unjam:figure-eight-tuned`"""
CEILING_LABEL = "leads all to the limit"
OTHER_ROAD_LABEL = "residual of the other road"
NO_VALUE_TEXT = "–"
PACER_TUNED_LABEL, PACER_GENTLE_LABEL = "pacer, tuned", "pacer, tuned, with room"
PACER_LONG_LABEL = "pacer, tuned with as many steps"
FEASIBILITY_STUDY_METRICS = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "outflow_veh_per_h", "fuel_ml_per_km"),
    *("drivable", "min_time_gap", "cav_max_braking", "filter_override_share", "speed_std_fleet_steady"),
    "time_to_dissolve",
)
"""of each episode"""


@dataclass(frozen=True)
class EvaluationRoad:
    """A road, and who is judged on it."""

    sizes: tuple[int, ...]
    """lengths or radii [m]"""
    make_scenario: Callable[[int], Scenario]
    driver_names: dict[str, str]
    """drivers by label"""
    baselines: tuple[str, ...]
    """the tuned experts among them"""
    metric: str = "return"
    """what the trainings maximised"""
    make_ceiling: Callable[[int], Driver] | None = None

    def make_drivers(self, size: int, trained_drivers: dict[str, Driver]) -> dict[str, Driver]:
        """Return all drivers of one size, by label."""
        road = self.make_scenario(size)
        made = {label: make_driver(name, road.control_step) for label, name in self.driver_names.items()}
        return {**made, **({CEILING_LABEL: self.make_ceiling(size)} if self.make_ceiling else {}), **trained_drivers}


def _make_ring(warmup: int, length: int) -> Ring:
    return Ring(length=(length, length), warmup=warmup)


def _limit_leader(length: int) -> Driver:
    return FollowerStopper(desired_speed=Ring().limit_speed(length), gaps=(0.5, 1.0, 1.5), time_constant=3.0)


RING_ROAD = EvaluationRoad(
    sizes=(220, 230, 240, 250, 260, 270),
    make_scenario=partial(_make_ring, 0),
    driver_names={
        **{HUMAN_LABEL: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0"},
        **{PI_TUNED_LABEL: PI_LONG_TUNED, GAP_PI_LABEL: "unjam:ring-gap-tuned"},
        GAP_PI_JAMMED_LABEL: "unjam:ring-jammed-tuned",
    },
    baselines=(PI_TUNED_LABEL, GAP_PI_LABEL, GAP_PI_JAMMED_LABEL),
    make_ceiling=_limit_leader,
)
FEASIBLE_ROADS = {
    "ring": RING_ROAD,
    "ring-jammed": replace(
        RING_ROAD,
        of_size=partial(_make_ring, LONG_WARM_UP),
        named={**RING_ROAD.driver_names, GAP_PI_JAMMED_LONG_LABEL: GAP_PI_JAMMED_LONG_TUNED},
        baselines=(GAP_PI_LABEL, GAP_PI_JAMMED_LABEL, GAP_PI_JAMMED_LONG_LABEL),
    ),
    "figure-eight": EvaluationRoad(
        sizes=(32, 33, 34, 35),
        make_scenario=lambda radius: FigureEight(radius=(radius, radius)),
        driver_names={
            **{HUMAN_LABEL: "human", "pacer": "pacer", "varying pacer": "pacer:use_tuned=true"},
            **{PACER_TUNED_LABEL: "unjam:figure-eight-tuned", PACER_LONG_LABEL: PACER_LONG_TUNED},
            PACER_GENTLE_LABEL: cast(str, BEST_BY_SCENARIO["figure-eight"]["expert"]),
        },
        baselines=(PACER_TUNED_LABEL, PACER_LONG_LABEL, PACER_GENTLE_LABEL),
        metric="return_eq16",
    ),
}


def _write_feasible(
    roads: Sequence[str], variant: str, study_folder: StudyFolder, seeds: int, folder: Path, workers: int
) -> None:
    made = {
        road: [make_driver(str(study_folder.run_folder(run)), 0.1) for run in planned_runs([road], [variant], seeds)]
        for road in roads
    }
    with WorkerPool(workers) as pool:
        for name in roads:
            trained = {f"training {seed}": driver for seed, driver in enumerate(made[name])}
            for other in set(roads) - {name}:
                trained[OTHER_ROAD_LABEL] = made[other][0]
            road = FEASIBLE_ROADS[name]
            found = {
                str(size): evaluate_on_test_seeds(
                    road.make_scenario(size),
                    road.make_drivers(size, trained),
                    SEEDS_PER_SIZE,
                    FEASIBILITY_STUDY_METRICS,
                    pool,
                )
                for size in road.sizes
            }
            atomic_write(folder / f"{name}.json", to_json(found))


def feasible_table(road: str, folder: Path) -> pd.DataFrame:
    """Return who earns what on a road, over all lengths, and what each is beyond the tuned experts."""
    rows = [
        {"driver": label, "seed": seed, "verdict": found["drivable"], **row}
        for of_length in read_part(folder, road).values()
        for label, found in of_length.items()
        for seed, row in enumerate(found["episodes"])
    ]
    episodes = pd.DataFrame(rows)
    labels = list(episodes["driver"].unique())
    trainings = [label for label in labels if label.startswith("training")]
    groups = {label: [label] for label in labels if label not in trainings}
    if trainings:
        groups[f"residual, {len(trainings)} trainings"] = trainings
    found = pd.DataFrame(
        [_driver_row(FEASIBLE_ROADS[road], episodes, label, members) for label, members in groups.items()]
    )
    return found.loc[:, (found != NO_VALUE_TEXT).any()]


def _driver_row(road: EvaluationRoad, episodes: pd.DataFrame, label: str, members: list[str]) -> dict[str, Any]:
    """Return what a driver, or several trainings together, are worth on a road."""
    own = episodes[episodes["driver"].isin(members)]
    mean, closest = (own.mean(numeric_only=True), np.nanmin(np.asarray(own["min_time_gap"], np.float64), initial=inf))

    def difference(baseline: str, name: str, digits: int) -> str:
        """Return what they are beyond another driver, on each seed over all sizes."""
        by_seed = episodes.pivot_table(name, "driver", "seed")
        values = (by_seed.loc[members] - by_seed.loc[baseline]).to_numpy()
        return str(estimate_cell(estimate_on_shared_seeds(values), digits, sign="+"))

    return {
        "driver": label,
        "return": f"{mean[road.metric]:.0f}",
        **{
            f"beyond {baseline}": difference(baseline, road.metric, 0)
            for baseline in road.baselines
            if baseline in set(episodes["driver"])
        },
        "mean speed [m/s]": f"{mean['mean_speed']:.2f}",
        "beyond people [m/s]": difference(HUMAN_LABEL, "mean_speed", 2),
        "flow [veh/h]": f"{mean['outflow_veh_per_h']:.0f}",
        "fuel [ml/km]": f"{mean['fuel_ml_per_km']:.0f}",
        "dissolved after [s]": _dissolution_text(np.asarray(own["time_to_dissolve"], np.float64)),
        "smallest headway [s]": NO_VALUE_TEXT if isinf(closest) else f"{closest:.2f}",
        "drivable": verdict_text(own["verdict"]),
    }


def verdict_text(verdicts: Iterable[str]) -> str:
    """Return `yes` where all are drivable, else the first reason why not."""
    return next((verdict or NO_VALUE_TEXT for verdict in verdicts if verdict != FEASIBLE), "yes")


def _dissolution_text(times: Floats) -> str:
    """Return after how long waves were dissolved, and how many of them."""
    share = np.isfinite(times).mean()
    return NO_VALUE_TEXT if not share else f"{np.nanmean(times):.1f}" + (f" ({share:.0%})" if share < 1.0 else "")


def _feasible_study(title: str, roads: Sequence[str], minutes: float, variant: str = "best") -> Study:
    return Study(
        title=title,
        make_runs=lambda seeds: planned_runs(roads, [variant], seeds),
        write=partial(_write_feasible, roads, variant),
        minutes=minutes,
        tables={road: partial(feasible_table, road) for road in roads},
    )


FEASIBLE_RING = _feasible_study(
    "what a drivable residual is worth beside the tuned expert, on the ring and the jammed ring",
    ("ring", "ring-jammed"),
    20.0,
)
FEASIBLE_FIGURE_EIGHT = _feasible_study(
    "what a drivable residual is worth beside the tuned expert, on the figure eight", ("figure-eight",), 5.0
)
FEASIBLE_RING_JAMMED = _feasible_study(
    "what a residual is worth beside the tuned expert that was trained on the first half of jammed episodes",
    ("ring-jammed",),
    20.0,
    "by-150-seconds",
)
