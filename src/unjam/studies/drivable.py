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
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.measures.table import PEOPLE, cell_of
from unjam.physics.arrays import Floats
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.studies.results_file import read_part
from unjam.studies.study import Study, StudyFolder, judged, planned
from unjam.training.family import GROWN
from unjam.training.presets import BEST
from unjam.worlds.workers import Workers

SEEDS = 10
"""of each length or radius"""
PI_TUNED = "PI, tuned"
FROM_GAP, FROM_GAP_JAMMED = "PI from its gap, tuned", "PI from its gap, tuned in a jam"
FROM_GAP_JAMMED_LONG = f"{FROM_GAP_JAMMED}, twice as long"
PI_LONG = (
    "pi:window=13.31,catch_up_speed=1.193,gap_lower=5.997,gap_upper=58.76,"
    "safe_gap=1.037,safe_gap_rule=closing,time_constant=0.8318,first_command=own-speed"
)
"""what `unjam tune ring --expert pi --steps 12000000` finds; of the other it is `unjam:ring-gap-tuned`"""
JAMMED_LONG = (
    "pi-from-gap:window=23,catch_up_speed=2.916,gap_lower=6,gap_upper=80,safe_gap=2,"
    "time_constant=2.976,fading=26,watched_share=0"
)
"""what `unjam tune ring-jammed --expert pi-from-gap --steps 12000000` finds within the bounds that were given
for `unjam:ring-jammed-tuned`, which had half of these steps: results/tuned.json has both commands"""
PACER_LONG = (
    "pacer:varying=true,gathering_speed=1.96,gathering_gap=0.319,regathering_gap=0.1595,time_constant=0.0966"
)
"""what `unjam tune figure-eight --expert pacer --reward eq16 --steps 4860000` finds, without what it does not
use; with 600,000 steps it is `unjam:figure-eight-tuned`"""
CEILING = "leads all to the limit"
OTHER = "residual of the other road"
NOTHING = "–"
PACER_TUNED, PACER_GENTLE = "pacer, tuned", "pacer, tuned, with room"
PACER_TUNED_LONG = "pacer, tuned with as many steps"
KEPT = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "throughput_veh_per_h", "fuel_ml_per_km"),
    *("drivable", "min_headway", "cav_max_braking", "filter_share", "speed_std_fleet_steady"),
    "time_to_dissolve",
)
"""of each episode"""


@dataclass(frozen=True)
class JudgedRoad:
    """A road, and who is judged on it."""

    sizes: tuple[int, ...]
    """lengths or radii [m]"""
    of_size: Callable[[int], Scenario]
    named: dict[str, str]
    """drivers by label"""
    baselines: tuple[str, ...]
    """the tuned experts among them"""
    metric: str = "return"
    """what the trainings maximised"""
    ceiling: Callable[[int], Driver] | None = None

    def drivers(self, size: int, trained: dict[str, Driver]) -> dict[str, Driver]:
        """Return all drivers of one size, by label."""
        road = self.of_size(size)
        made = {label: make_driver(name, road.decision_step) for label, name in self.named.items()}
        return {**made, **({CEILING: self.ceiling(size)} if self.ceiling else {}), **trained}


def _ring(warmup: int, length: int) -> Ring:
    return Ring(length=(length, length), warmup=warmup)


def _lead(length: int) -> Driver:
    return FollowerStopper(desired_speed=Ring().limit(length), gaps=(0.5, 1.0, 1.5), time_constant=3.0)


OF_RINGS = JudgedRoad(
    sizes=(220, 230, 240, 250, 260, 270),
    of_size=partial(_ring, 0),
    named={
        **{PEOPLE: "human", "PI": "pi", "PI (paper)": "pi:time_constant=0"},
        **{PI_TUNED: PI_LONG, FROM_GAP: "unjam:ring-gap-tuned"},
        FROM_GAP_JAMMED: "unjam:ring-jammed-tuned",
    },
    baselines=(PI_TUNED, FROM_GAP, FROM_GAP_JAMMED),
    ceiling=_lead,
)
ROADS = {
    "ring": OF_RINGS,
    "ring-jammed": replace(
        OF_RINGS,
        of_size=partial(_ring, GROWN),
        named={**OF_RINGS.named, FROM_GAP_JAMMED_LONG: JAMMED_LONG},
        baselines=(FROM_GAP, FROM_GAP_JAMMED, FROM_GAP_JAMMED_LONG),
    ),
    "figure-eight": JudgedRoad(
        sizes=(32, 33, 34, 35),
        of_size=lambda radius: FigureEight(radius=(radius, radius)),
        named={
            **{PEOPLE: "human", "pacer": "pacer", "varying pacer": "pacer:varying=true"},
            **{PACER_TUNED: "unjam:figure-eight-tuned", PACER_TUNED_LONG: PACER_LONG},
            PACER_GENTLE: cast(str, BEST["figure-eight"]["expert"]),
        },
        baselines=(PACER_TUNED, PACER_TUNED_LONG, PACER_GENTLE),
        metric="return_eq16",
    ),
}


def _write(
    roads: Sequence[str], variant: str, studies: StudyFolder, seeds: int, folder: Path, workers: int
) -> None:
    made = {
        road: [make_driver(str(studies.folder_of(run)), 0.1) for run in planned([road], [variant], seeds)]
        for road in roads
    }
    with Workers(workers) as pool:
        for name in roads:
            trained = {f"training {seed}": driver for seed, driver in enumerate(made[name])}
            for other in set(roads) - {name}:
                trained[OTHER] = made[other][0]
            road = ROADS[name]
            found = {
                str(size): judged(road.of_size(size), road.drivers(size, trained), SEEDS, KEPT, pool)
                for size in road.sizes
            }
            write_whole(folder / f"{name}.json", to_json(found))


def table(road: str, folder: Path) -> pd.DataFrame:
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
    found = pd.DataFrame([_row(ROADS[road], episodes, label, members) for label, members in groups.items()])
    return found.loc[:, (found != NOTHING).any()]


def _row(road: JudgedRoad, episodes: pd.DataFrame, label: str, members: list[str]) -> dict[str, Any]:
    """Return what a driver, or several trainings together, are worth on a road."""
    own = episodes[episodes["driver"].isin(members)]
    mean, closest = (
        own.mean(numeric_only=True),
        np.nanmin(np.asarray(own["min_headway"], np.float64), initial=inf),
    )

    def beyond(baseline: str, name: str, digits: int) -> str:
        """Return what they are beyond another driver, on each seed over all sizes."""
        by_seed = episodes.pivot_table(name, "driver", "seed")
        values = (by_seed.loc[members] - by_seed.loc[baseline]).to_numpy()
        return str(cell_of(estimate_on_shared_seeds(values), digits, sign="+"))

    return {
        "driver": label,
        "return": f"{mean[road.metric]:.0f}",
        **{
            f"beyond {baseline}": beyond(baseline, road.metric, 0)
            for baseline in road.baselines
            if baseline in set(episodes["driver"])
        },
        "mean speed [m/s]": f"{mean['mean_speed']:.2f}",
        "beyond people [m/s]": beyond(PEOPLE, "mean_speed", 2),
        "flow [veh/h]": f"{mean['throughput_veh_per_h']:.0f}",
        "fuel [ml/km]": f"{mean['fuel_ml_per_km']:.0f}",
        "dissolved after [s]": _dissolved(np.asarray(own["time_to_dissolve"], np.float64)),
        "smallest headway [s]": NOTHING if isinf(closest) else f"{closest:.2f}",
        "drivable": in_a_word(own["verdict"]),
    }


def in_a_word(verdicts: Iterable[str]) -> str:
    """Return `yes` where all are drivable, else the first reason why not."""
    return next((verdict or NOTHING for verdict in verdicts if verdict != DRIVABLE), "yes")


def _dissolved(times: Floats) -> str:
    """Return after how long waves were dissolved, and how many of them."""
    share = np.isfinite(times).mean()
    return NOTHING if not share else f"{np.nanmean(times):.1f}" + (f" ({share:.0%})" if share < 1.0 else "")


def _study(title: str, roads: Sequence[str], minutes: float, variant: str = "best") -> Study:
    return Study(
        title=title,
        runs=lambda seeds: planned(roads, [variant], seeds),
        write=partial(_write, roads, variant),
        minutes=minutes,
        tables={road: partial(table, road) for road in roads},
    )


DRIVABLE_STUDY = _study(
    "what a drivable residual is worth beside the tuned expert, on the ring and the jammed ring",
    ("ring", "ring-jammed"),
    20.0,
)
DRIVABLE_EIGHT = _study(
    "what a drivable residual is worth beside the tuned expert, on the figure eight", ("figure-eight",), 5.0
)
DRIVABLE_JAMMED = _study(
    "what a residual is worth beside the tuned expert that was trained on the first half of jammed episodes",
    ("ring-jammed",),
    20.0,
    "by-150-seconds",
)
