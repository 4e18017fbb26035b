"""What knowledge is worth where on-ramps are imagined: people are known, taken for others, or not at all.

    python results/model/on_ramps.py FOLDER

writes FOLDER/on_ramps.json. Data are those with which a training begins: the tuned expert and a residual
network that has learned nothing, with its exploration. Judged on eight episodes of other seeds: how far a
step is wrong beyond what people misjudge, and how long everybody takes where their people come once more,
with the expert that drove when the data were made, and among people alone.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from knowledge import PASSES, settings_for, untrained
from whole_roads import ELSEWHERE, wrong_beyond

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.files import to_json, write_whole
from unjam.learners.motorway_imagination import MotorwayImagination
from unjam.learners.settings import PolicySettings
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.scenarios.on_ramp import ON_RAMP, OnRamp
from unjam.training.config import load_config
from unjam.virtual.motorways import MotorwayMoments, fit_motorways, moments_of_motorway
from unjam.virtual.roads import PeopleRows, RoadModel
from unjam.virtual.settings import BaseName, VirtualSettings
from unjam.worlds.batch.run import run_batches
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask

ROAD = replace(cast(OnRamp, ON_RAMP), cav_share=0.05)
EXPERT = "unjam:on-ramp-tuned"
SEEDS = range(3)
TEST_EPISODES, TEST_SEED = 8, 2_000_000
AT_ONCE = 8
"""episodes, of 40 MB each"""
METRICS = ("travel_time", "throughput_veh_per_h", "speed_std_fleet")
ALL_ALIKE = {
    "time_headways": (ELSEWHERE.time_headway,) * 2,
    "accelerations": (ELSEWHERE.max_acceleration,) * 2,
    "decelerations": (ELSEWHERE.comfortable_deceleration,) * 2,
    "gaps": (ELSEWHERE.minimum_gap,) * 2,
}
JUDGES = {"the expert of the data": ROAD, "people alone": replace(ROAD, cav_share=0.0)}


class Known(NamedTuple):
    """What is known of people."""

    base: BaseName
    people: dict[str, Any]


KNOWN = {
    "each as he drives": Known("idm", {}),
    "other people, all alike": Known("idm", ALL_ALIKE),
    "nothing": Known("none", {}),
}


def settings_of(known: str, passes: int = 1) -> VirtualSettings:
    """Return those of networks that add to what is known."""
    settings = settings_for(KNOWN[known].base, passes)
    return replace(settings, model="road", begin="first", k_max=ROAD.horizon, kappa=1e9)


def moments(episodes: Sequence[Episode], known: str, first: int = 0) -> list[MotorwayMoments]:
    """Return what is kept of episodes, numbered from `first` on, by who knows so much."""
    base, people = KNOWN[known]
    road = replace(ROAD, **people)
    return [moments_of_motorway(each, first + number, road, base) for number, each in enumerate(episodes)]


def numbers_of(episodes: Sequence[Episode]) -> dict[str, list[float]]:
    """Return some metrics of each episode."""
    found = [measure(episode) for episode in episodes]
    return {name: [each[name] for each in found] for name in METRICS}


def judged(model: RoadModel, known: str, test: list[Episode], noise: float, expert: Driver) -> dict[str, Any]:
    """Return what is wrong with a model on the test episodes, and what happens where it is imagined."""
    kept = moments(test, known)
    rows = PeopleRows(*map(np.concatenate, zip(*(one.people for one in kept), strict=True)))
    found: dict[str, Any] = {"ignorance": wrong_beyond(noise, model, rows)}
    for who, road in JUDGES.items():
        taken = replace(road, **KNOWN[known].people)
        imagination = MotorwayImagination(settings_of(known), Task(taken, expert), PolicySettings(), 0)
        imagination.model = model
        seeds = [((TEST_SEED, number), (TEST_SEED,)) for number in range(len(kept))]
        imagined = imagination.driven(expert, kept, road.horizon, seeds, [0.0] * len(kept))
        found[who] = numbers_of(imagined)
        found[who]["collisions"] = sum(episode.status == "collision" for episode in imagined)
    return found


def main(folder: Path) -> None:
    """Measure, and write the numbers."""
    torch.set_num_threads(1)
    about, expert = manifest(), make_driver(EXPERT, ROAD.decision_step)
    tests = {
        who: run_batches(
            [EpisodeTask(road, expert, (TEST_SEED, each)) for each in range(TEST_EPISODES)], statistical=True
        )
        for who, road in JUDGES.items()
    }
    (test, *_) = tests.values()
    noise = float(np.mean([each.noise for each in moments(test, "each as he drives")]))
    first = {"known": "", "steps": 0, "seed": None, "ignorance": 0.0}
    rows: list[dict[str, Any]] = [{**first, **{who: numbers_of(those) for who, those in tests.items()}}]
    for known in KNOWN:
        model = RoadModel(settings_of(known), (0,))
        model.noise.fill_(noise**0.5)
        rows.append({**first, "known": known, **judged(model, known, test, noise, expert)})
        print(known, rows[-1], flush=True)
    for seed in SEEDS:
        changes = {"scenario": "on-ramp", "expert": EXPERT, "virtual.virtual_ratio": 0.0, "seed": seed}
        driver = untrained(load_config(changes={**changes, "road.cav_share": ROAD.cav_share}))
        kept: dict[str, list[MotorwayMoments]] = {known: [] for known in KNOWN}
        for steps, passes in PASSES.items():
            missing = -(-steps // ROAD.horizon) - len(kept["nothing"])
            tasks = [EpisodeTask(ROAD, driver, (seed, steps, each), explore=1.0) for each in range(missing)]
            for begin in range(0, missing, AT_ONCE):
                episodes = run_batches(tasks[begin : begin + AT_ONCE], statistical=True)
                for known, those in kept.items():
                    those += moments(episodes, known, len(those))
            for known, those in kept.items():
                model = RoadModel(settings_of(known, passes), (seed, steps))
                found = fit_motorways(model, those, settings_of(known, passes), (seed, steps))
                row = {"known": known, "steps": steps, "seed": seed, "passes": found.epochs}
                row |= {"learned": bool(model.learned), **judged(model, known, test, noise, expert)}
                rows.append(row)
                print(row, flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "on_ramps.json", to_json({"manifest": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
