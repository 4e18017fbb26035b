"""What knowledge is worth where whole roads are imagined: people are known, roughly known, or not at all.

    python results/model/whole_roads.py FOLDER

writes FOLDER/whole_roads.json. Data are those with which a training begins: PI and a residual network that
has learned nothing, with the exploration of the defaults. Judged on twelve episodes of other seeds: how far
a step is wrong beyond people's noise, and how fast everybody drives in whole episodes that are imagined from
their beginning on, by PI and by a CAV that follows as people do, behind whom waves stay.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from knowledge import PASSES, TEST_EPISODES, TEST_SEED, settings_for, untrained

from unjam.drivers.driver import Driver
from unjam.drivers.registry import named_driver
from unjam.files import to_json, write_whole
from unjam.learners.road_imagination import RoadImagination
from unjam.learners.settings import PolicySettings
from unjam.manifest import manifest
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios.ring import Loop
from unjam.training.config import load_config
from unjam.virtual.ensemble import torch_generator
from unjam.virtual.roads import PeopleRows, RoadModel, moments_of, people_in, people_of
from unjam.virtual.settings import BaseName
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask

ROADS = ("ring", "ring-jammed", "figure-eight")
SEEDS = range(3)
ELSEWHERE = IDMParameters(
    time_headway=1.6, max_acceleration=0.73, comfortable_deceleration=1.67, minimum_gap=2.0
)
"""Treiber, Hennecke, Helbing 2000, table I, for a motorway in Germany; but they wish to be as fast as here"""
KNOWN: dict[str, tuple[BaseName, IDMParameters]] = {
    "people's own IDM": ("idm", PAPER_IDM),
    "other people's IDM": ("idm", ELSEWHERE),
    "nothing": ("none", PAPER_IDM),
}
"""what is known of people: base and parameters"""
JUDGES = {"PI": "pi", "a CAV that follows as people do": "idm"}
"""who drives in the whole episodes"""


def imagination_of(road: Loop, driver: Driver, known: str, seed: int, passes: int = 1) -> RoadImagination:
    """Return a virtual environment that knows so much, and has no data."""
    base, humans = KNOWN[known]
    settings = replace(settings_for(base, passes), model="road")
    found = RoadImagination(settings, Task(road, driver), PolicySettings(), seed)
    found.scenario = replace(road, humans=humans)
    return found


def driven(road: Loop, driver: Driver, count: int, seed: tuple[int, ...]) -> list[Episode]:
    """Return episodes with exploration that cover the range of what the road draws."""
    tasks = [
        EpisodeTask(road.part(index, count), driver, (*seed, index), explore=True) for index in range(count)
    ]
    return run_batch(tasks, statistical=True)


def ignorance(model: RoadModel, episodes: list[Episode], road: Loop) -> float:
    """Return how far a step is wrong, people's noise left out, root mean square [m/s]."""
    kept = [moments_of(episode, number, road) for number, episode in enumerate(episodes)]
    commanded = road.human_control == "commanded"
    noise = (road.noise_per_step * road.simulation_step) ** 2 if commanded else 0.0
    return wrong_beyond(noise, model, people_in(kept, model.base, road))


def wrong_beyond(noise: float, model: RoadModel, rows: PeopleRows) -> float:
    """Return how far steps are wrong beyond noise of a mean square [m2/s2], root mean square [m/s]."""
    wrong = (rows.moved - rows.base) - model.answers(rows.inputs)[..., 0] * float(model.learned)
    return float(np.sqrt(max(0.0, float(np.square(wrong).mean()) - noise)))


def numbers_of(episodes: list[Episode]) -> dict[str, list[float]]:
    """Return the mean speed of each episode, and how unlike speeds are in its second half [m/s]."""
    halves = [episode.speeds[len(episode.speeds) // 2 :] for episode in episodes]
    return {
        "speed": [float(episode.speeds.mean()) for episode in episodes],
        "wave": [float(speeds.std(1).mean()) for speeds in halves],
    }


def judged(model: RoadModel, known: str, road: Loop, actual: dict[str, list[Episode]]) -> dict[str, Any]:
    """Return what is wrong with a model on the test episodes, `actual` by who drives."""
    wise = replace(road, humans=KNOWN[known][1])
    found: dict[str, Any] = {"ignorance": ignorance(model, actual["PI"], wise)}
    for who, episodes in actual.items():
        driver = named_driver(JUDGES[who], road.decision_step)
        test = imagination_of(road, driver, known, 0)
        test.data.add(episodes, road)
        test.moments = [moments_of(episode, number, road) for number, episode in enumerate(episodes)]
        test.model = model
        people = people_of(model, wise, torch_generator((TEST_SEED,), "cpu"))
        starts = np.array([[number, 0] for number in range(len(episodes))])
        memory = driver.initial_memory(len(episodes))
        imagined = test.driven(driver, memory, starts, road.horizon, people, (TEST_SEED,))
        found[who] = numbers_of(imagined)
        found[who]["collisions"] = sum(episode.status == "collision" for episode in imagined)
    return found


def measured(name: str) -> list[dict[str, Any]]:
    """Return the rows of a road: one for each model, number of steps and seed."""
    road = cast(Loop, load_config(changes={"scenario": name}).make_scenario())
    actual = {
        who: driven(road, named_driver(driver, road.decision_step), TEST_EPISODES, (TEST_SEED,))
        for who, driver in JUDGES.items()
    }
    about = {"road": name, "known": "", "steps": 0, "seed": None, "ignorance": 0.0}
    rows: list[dict[str, Any]] = [{**about, **{who: numbers_of(found) for who, found in actual.items()}}]
    for known in KNOWN:
        model = imagination_of(road, named_driver("pi", road.decision_step), known, 0).model
        model.noise.fill_(road.noise_per_step * road.simulation_step)  # as networks would measure it
        rows.append({**about, "known": known, **judged(model, known, road, actual)})
    for seed in SEEDS:
        driver = untrained(load_config(changes={"scenario": name, "seed": seed}))
        episodes: list[Episode] = []
        for steps, passes in PASSES.items():
            missing = -(-steps // road.horizon) - len(episodes)
            episodes += driven(road, driver, missing, (seed, steps))
            for known in KNOWN:
                imagination = imagination_of(road, driver, known, seed, passes)
                imagination.learn(episodes, steps)
                row = {**about, "known": known, "steps": steps, "seed": seed}
                row |= {"learned": bool(imagination.model.learned), "passes": imagination.facts["epochs"]}
                rows.append({**row, **judged(imagination.model, known, road, actual)})
                print(name, known, steps, seed, f"{rows[-1]['ignorance']:.5f}", row["passes"], flush=True)
    return rows


def main(folder: Path) -> None:
    """Measure, and write the numbers."""
    torch.set_num_threads(1)
    about = manifest()
    rows = [row for road in ROADS for row in measured(road)]
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "whole_roads.json", to_json({"manifest": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
