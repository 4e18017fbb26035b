"""What drivers gain on every road of the family, seen and held out: one controller beside experts.

On each road 0 is people alone, and 1 the best tuned expert that is known there; which that is, other seeds
decide than those that judge.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from unjam.controller import SHIPPED, make_driver
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.gain import MOST, WORST, Rows, gain, gain_by_seed, nothing_to_gain, worth
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate, signed
from unjam.measures.table import PEOPLE
from unjam.physics.arrays import Floats
from unjam.reports.figures import INK, new_figure
from unjam.scenarios.scenario import Scenario
from unjam.studies.parts import file_of
from unjam.studies.results_file import read_parts
from unjam.studies.study import Study, StudyFolder
from unjam.training.family import FAMILY, KINDS
from unjam.training.seeds import held_out_seeds, tuning_seeds
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

EPISODES = 10
"""of each driver on each road"""
CHOOSING, JUDGING = tuning_seeds(EPISODES, 1000), held_out_seeds(EPISODES)
"""seeds that choose the best tuned expert of a road, and those that judge"""
Run = Callable[[list[EpisodeTask]], Rows]
"""drives tasks, and returns what `kept_of` makes of their episodes, in their order"""
PI_ON_RINGS = "pi:window=23,catch_up_speed=0.5994,gap_lower=3,gap_upper=50,time_constant=0.9775,safe_gap=4"
"""what `unjam tune rings --expert pi` finds"""
PI_ON_ALL = (
    "pi:window=24.09,catch_up_speed=0.9343,gap_lower=2.263,gap_upper=88.15,safe_gap=4.505,"
    "safe_gap_rule=closing,time_constant=1.18,first_command=zero"
)
GAP_ON_ALL = (
    "pi-from-gap:window=70.13,catch_up_speed=0.5547,gap_lower=5.578,gap_upper=14.74,safe_gap=1.398,"
    "safe_gap_rule=closing,time_constant=1.159,first_command=zero,people_headway=1.933,"
    "people_gap=0.5038,fading=12.94,watched_share=1.242"
)
JAM_ON_ALL = (
    "jam-ahead:first=2,last=3,margin=-2.086,margin_by_share=19.15,lowest=3.369,slowing=0.5985,"
    "all_lanes=False,time_constant=1.678,jam=0.652"
)
"""what `unjam tune everywhere` finds for three experts, results/tuned.json"""
TUNED: dict[str, tuple[str, ...]] = {
    "rings": (
        *("pi", "unjam:ring-tuned", "unjam:ring-gap-tuned", "unjam:ring-jammed-tuned", "unjam:rings-tuned"),
        *("unjam:shared-rings-tuned", "follower-stopper", PI_ON_ALL, GAP_ON_ALL),
    ),
    "figure-eights": ("unjam:figure-eight-tuned", "pacer:varying=true", PI_ON_ALL),
    "motorways": ("jam-ahead", "unjam:on-ramp-tuned", "cruise", "adaptive-acc", JAM_ON_ALL),
}
"""experts of which the best on a road is its 1"""
HELD_OUT = ("combination", "axis")
"""parts of the family that nobody has trained or tuned on"""
LAWS: dict[str, str] = {
    "unjam:best": "unjam:best",
    "PI, tuned on all": PI_ON_ALL,
    "PI from its gap, tuned on all": GAP_ON_ALL,
    "jam-ahead, tuned on all": JAM_ON_ALL,
    "PI, tuned on the rings": PI_ON_RINGS,
}
"""one law for every road, or one file that has several: each has a column of its own"""
JUDGED: dict[str, str] = {
    **LAWS,
    "jam-ahead": "jam-ahead",
    "FollowerStopper": "follower-stopper",
    "unjam:ring-best": "unjam:ring-best",
    "unjam:ring-jammed-best": "unjam:ring-jammed-best",
    "unjam:figure-eight-best": "unjam:figure-eight-best",
    "unjam:on-ramp-tuned": "unjam:on-ramp-tuned",
}
"""who is judged on every road, by label"""
TWO_LAWS = "the two best tuned on all: PI, on motorways jam-ahead"
"""what a choice by the kind of road makes of two single laws: their own rows"""
KEPT = (
    *("seed", "status", "travel_time", "delay", "mean_speed", "mean_speed_second_half", "speed_limit_ratio"),
    *("throughput_veh_per_h", "fuel_ml_per_km", "floor", "lanes", "collisions", "min_headway", "cav_min_ttc"),
    *("cav_max_braking", "cut_in_max_braking", "share_short_headway", "overridden", "people_beyond_4_5"),
)
"""of each episode"""


def driven(
    scenario: Scenario, drivers: dict[str, str], seeds: list[tuple[int, ...]], run: Run
) -> dict[str, Rows]:
    """Return what is kept of each driver's episodes, by label; `drivers` are names of drivers by label."""
    made = [make_driver(name, scenario.decision_step) for name in drivers.values()]  # one each: networks
    tasks = [
        EpisodeTask(scenario.part(index, len(seeds)), driver, seed)
        for driver in made
        for index, seed in enumerate(seeds)
    ]
    rows, count = run(tasks), len(seeds)
    return {label: rows[n * count : (n + 1) * count] for n, label in enumerate(drivers)}


def kept_of(index: int, episode: Episode) -> dict[str, Any]:
    """Return what is kept of an episode, for `Workers.run_each`: a motorway's whole one takes 80 MB."""
    measured = measure(episode)
    return {key: measured[key] for key in KEPT}


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    made = [(number, name, road, road.make()) for number, (name, road) in enumerate(FAMILY.items())]
    with Workers(workers) as pool:
        for number, name, road, scenario in sorted(made, key=lambda each: not each[3].closed):  # quick first
            file = folder / f"{number:02d}.json"
            found: dict[str, Any] = {"road": name, "part": road.part, "best": PEOPLE}
            found |= {"tried": {}, "drove": {}, "rows": {}}
            if file.is_file():
                found |= json.loads(file.read_text())
            _go_on(scenario, TUNED[KINDS[road.scenario]], found, partial(pool.run_each, keep=kept_of))
            write_whole(file, to_json(found))


def _go_on(scenario: Scenario, tuned: Sequence[str], found: dict[str, Any], run: Run) -> None:
    """Drive what is not known yet of a road, and add it to what was found.

    Experts and drivers that came later, or whose shipped file is another one now, are not known.
    """
    new = [driver for driver in tuned if found["tried"].get(driver) != file_of(driver)]
    if new:
        others = tuned if found["best"] in new else (found["best"], *new)
        candidates = dict.fromkeys((PEOPLE, *others))
        rows = driven(scenario, {driver: driver for driver in candidates}, CHOOSING, run)
        found["best"] = best_of(rows)
        found["tried"] |= {driver: file_of(driver) for driver in new}
    asked = {PEOPLE: PEOPLE, found["best"]: found["best"], **JUDGED}
    missing = {
        label: driver
        for label, driver in asked.items()
        if label not in found["rows"] or found["drove"].get(label) != named(driver)
    }
    if missing:
        found["rows"] |= driven(scenario, missing, JUDGING, run)
        found["drove"] |= {label: named(driver) for label, driver in missing.items()}


def named(driver: str) -> str:
    """Return what tells a driver from others under its label: its file, or its name with all parameters."""
    return file_of(driver) or driver


def best_of(rows: dict[str, Rows]) -> str:
    """Return who is best of those who could have driven so in every episode: people alone, if nobody."""
    people = rows[PEOPLE]
    could = [who for who, of in rows.items() if who == PEOPLE or drivable_in_all(of, people) == DRIVABLE]
    return max(could, key=lambda who: float(np.mean([worth(row) for row in rows[who]])))


def gains_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Return of each road its part, its best expert, and each driver's gain, speeds and verdict, by label.

    `counts` is whether there is something to gain there.

    Speeds are means of the whole episode, start and waves included, seed by seed [m/s].
    """
    roads: dict[str, dict[str, Any]] = {}
    for number, found in read_parts(folder).items():
        if not number.isdecimal():
            continue
        rows: dict[str, Rows] = {
            label: [{key: np.nan if value is None else value for key, value in row.items()} for row in of]
            for label, of in found["rows"].items()
        }
        best = [worth(row) for row in rows[found["best"]]]
        people = rows.pop(PEOPLE)
        roads[found["road"]] = {
            **{key: found[key] for key in ("part", "best")},
            "people": float(np.mean([worth(row) for row in people])),
            "counts": not nothing_to_gain(people, best),
            "gains": {label: gain(of, people, best) for label, of in rows.items()},
            "by_seed": {label: gain_by_seed(of, people, best) for label, of in rows.items()},
            "speeds": {label: np.array([row["mean_speed"] for row in of]) for label, of in rows.items()},
            "verdicts": {label: drivable_in_all(of, people) for label, of in rows.items()},
        }
    return roads


def table(parts: tuple[str, ...], folder: Path) -> pd.DataFrame:
    """Return what each law gains on each road of some parts of the family, with the mean and the worst."""
    roads = _of_parts(gains_of(folder), parts)
    rows = [{"road": name, **_cells(road)} for name, road in roads.items()]
    mean, worst = {"road": "mean"}, {"road": "worst"}
    gainful = {"road": "mean, where there is something to gain"}
    for label in LAWS:
        mean[label] = _mean([road["by_seed"][label] for road in roads.values()])
        gainful[label] = _mean([road["by_seed"][label] for road in roads.values() if road["counts"]])
        worst[label] = _worst(roads, label)
    rows += [mean, gainful, worst]
    return pd.DataFrame(rows).fillna("")


def drivers(folder: Path) -> pd.DataFrame:
    """Return what each driver gains over the roads of each part, and what the first gains more than it."""
    (first, *others), every = JUDGED, gains_of(folder)
    for name, road in every.items():
        motorway = KINDS[FAMILY[name].scenario] == "motorways"
        for found in (road["gains"], road["by_seed"]):
            found[TWO_LAWS] = found["jam-ahead, tuned on all" if motorway else "PI, tuned on all"]
    rows = {label: {"": label} for label in (first, TWO_LAWS, *others)}
    for heading, parts in {"seen": ("seen",), "held out": HELD_OUT}.items():
        roads = _of_parts(every, parts)
        for label, row in rows.items():
            more = [road["by_seed"][first] - road["by_seed"][label] for road in roads.values()]
            row[heading] = _mean([road["by_seed"][label] for road in roads.values()])
            row[f"worst, {heading}"] = _worst(roads, label)
            row[f"{first} beyond it, {heading}"] = "" if label == first else _mean(more)
    return pd.DataFrame([*rows.values()])


def _of_parts(roads: Mapping[str, dict[str, Any]], parts: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    return {name: road for name, road in roads.items() if road["part"] in parts}


def _worst(roads: Mapping[str, dict[str, Any]], label: str) -> str:
    return f"{min(road['gains'][label].mean for road in roads.values()):+.2f}"


def _mean(by_road: list[Floats]) -> str:
    return signed(estimate(np.mean(by_road, 0)), 2)


def _cells(road: dict[str, Any]) -> dict[str, str]:
    cells = {label: signed(road["gains"][label], 2) for label in LAWS}
    best: str = road["best"]
    best = {driver: label for label, driver in JUDGED.items()}.get(best, best)
    return {"best expert there": best.removeprefix(SHIPPED), **cells}


def picture(folder: Path) -> Figure:
    """Return roads by drivers: what each gains, people alone being 0 and the best tuned expert 1."""
    roads = gains_of(folder)
    values = np.array([[road["gains"][label].mean for label in JUDGED] for road in roads.values()])
    figure = new_figure(0.3 * len(roads) + 1.0)
    axes = figure.subplots()
    # Within half of the colours, which are pale: numbers stay legible on them.
    shown = axes.imshow(values, cmap="RdYlGn", vmin=-2 * MOST, vmax=2 * MOST, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, f"{value:+.2f}", ha="center", va="center", color=INK, fontsize=8)
    axes.set_xticks(range(len(JUDGED)), list(JUDGED), rotation=40, ha="right", rotation_mode="anchor")
    marks = {"seen": "", "combination": " (new combination)", "axis": " (new)"}
    axes.set_yticks(range(len(roads)), [f"{name}{marks[road['part']]}" for name, road in roads.items()])
    axes.grid(visible=False)
    figure.colorbar(shown, ax=axes, label=f"gain, kept within {WORST:g} and {MOST:g}", shrink=0.5)
    return figure


EVERYWHERE_STUDY = Study(
    title="what one controller gains on every road of the family, seen and held out",
    runs=lambda seeds: [],
    write=_write,
    minutes=60.0,
    goes_on=True,
    tables={
        "seen": partial(table, ("seen",)),
        "held out": partial(table, HELD_OUT),
        "drivers": drivers,
    },
)
