"""Measures the varying pacer over four laps: the last 3,000 of 6,000 steps, 10 seeds. Writes pacer-long.json.

Usage: pacer_long.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from unjam.drivers.road_experts import Pacer
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.scenarios.figure_eight import FigureEight
from unjam.worlds.workers import EpisodeTask, Workers

RADII, SEEDS, STEPS, JUDGED = (32, 33, 34, 35), 10, 6000, 3000


def main(folder: Path) -> None:
    about, rows = manifest(), []
    with Workers(2) as workers:
        for radius in RADII:
            road = FigureEight(radius=(radius, radius), horizon=STEPS)
            episodes = workers.run([EpisodeTask(road, Pacer(varying=True), (seed,)) for seed in range(SEEDS)])
            speeds = np.array([episode.speeds[-JUDGED:].mean() for episode in episodes])
            collisions = sum(episode.collisions for episode in episodes)
            row = {"radius": radius, "mean": speeds.mean(), "worst": speeds.min(), "best": speeds.max()}
            rows.append({**row, "collisions": collisions, "seeds": SEEDS})
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "pacer-long.json", to_json({"manifest": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
