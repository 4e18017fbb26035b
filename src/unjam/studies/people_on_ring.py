"""Calibrated people on the ring: are their waves like real ones, and does a CAV still calm them?

In the experiment of Sugiyama et al. (2008), 22 cars on 230 m, a jam arose by itself and travelled against the
traffic at about 20 km/h, 5.6 m/s; on motorways it is 15 to 20 km/h.
"""

from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import make_driver
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure, wave_speed
from unjam.reports.figures import png_bytes, space_time
from unjam.reports.results import read_results
from unjam.scenarios import make_scenario
from unjam.studies.study import OnProgress
from unjam.training.evaluate import Evaluation, raise_failure, save_evaluation
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

SCENARIO_CHANGES: dict[str, Any] = {"length": (230, 230)}
"""changes to `ring-jammed`: as long as in the experiment [m]"""
EPISODES = 10
PAPERS = "paper's IDM"
TRAINED = "trained"
"""label of the controller that learned among the paper's people"""
TITLES = {"human": "no CAV", "pi": "PI", TRAINED: "PI + residual"}


def run(
    folder: Path,
    populations: dict[str, Path],
    controller: Path,
    workers: int = 2,
    on_progress: OnProgress = lambda name: None,
) -> None:
    """Write `ring.json` and `ring.png` into `folder`: people alone, with PI, and with a trained controller.

    Args:
        folder: for the results.
        populations: files of `unjam fit-drivers`, by the label that they get.
        controller: run folder or .unjam file of a controller for the ring.
        workers: processes.
        on_progress: told the name of each finished group of episodes.
    """
    make_folder(folder)
    about, rows = manifest(), []
    roads: dict[str, dict[str, Any]] = {PAPERS: {}}
    roads |= {label: {"population": str(file.absolute())} for label, file in populations.items()}
    shown: dict[str, Episode] = {}
    largest = 0
    with Workers(workers) as pool:
        for people, changes in roads.items():
            scenario = make_scenario("ring-jammed", {**SCENARIO_CHANGES, **changes})
            drivers = {name: make_driver(name, scenario.decision_step) for name in ("human", "pi")}
            drivers[TRAINED] = make_driver(str(controller), scenario.decision_step)
            for label, driver in drivers.items():
                tasks = [EpisodeTask(scenario, driver, (seed,), full=True) for seed in range(EPISODES)]
                episodes = pool.run(tasks)
                found = [measure(episode) for episode in episodes]
                raise_failure(found)
                for episode, row in zip(episodes, found, strict=True):
                    rows.append({"people": people, "driver": label, **row, "wave_speed": wave_speed(episode)})
                if label == "human":  # shown is where people alone make the largest wave
                    largest = int(np.argmax([row["speed_std_fleet_steady"] for row in found]))
                shown[f"{people}: {TITLES[label]}"] = episodes[largest]
                on_progress(f"{people}, {label}")
    write_whole(folder / "ring.json", to_json({"manifest": about, "rows": rows}, indent=1))
    save_evaluation(folder / "shown", Evaluation({}, shown), {})
    pictured = list(read_results(folder / "shown").shown.values())
    write_whole(folder / "ring.png", png_bytes(space_time(pictured), dpi=90))
