"""Finds paces for the figure eight; prints the lap times and harmonics that `drivers/pacer.py` holds.

Lap times by grid, paces over the lap by random search. Each candidate drives 5,000 steps on the actual
simulator; its worth is the mean speed of all vehicles in steps 2,000 to 3,000 or in the last 2,000, whichever
is less, the worst of six seeds, nothing at a collision.
Usage: tune_pacer.py [SECONDS FOR EACH RADIUS [RADIUS ...]]
"""

import sys
import time
from collections.abc import Sequence

import numpy as np

from unjam.drivers.pacer import TUNED, Harmonics, Pacer
from unjam.scenarios.figure_eight import FigureEight, loop_length
from unjam.traffic.record import Episode
from unjam.traffic.workers import EpisodeTask, Workers

STEPS, SEEDS, BATCH = 5000, 6, 4


def worth(episode: Episode) -> float:
    if episode.status != "completed":
        return 0.0
    speeds = episode.speeds.mean(1)
    return float(min(speeds[2000:3000].mean(), speeds[-2000:].mean()))


def worths(radius: int, drivers: Sequence[Pacer], workers: Workers) -> list[float]:
    road = FigureEight(radius=(radius, radius), horizon=STEPS)
    tasks = [EpisodeTask(road, driver, (seed,)) for driver in drivers for seed in range(SEEDS)]
    found = np.array([worth(episode) for episode in workers.run(tasks)])
    return found.reshape(-1, SEEDS).min(1).tolist()


def best_lap_time(radius: int, workers: Workers) -> tuple[float, float]:
    times = [float(value) for value in np.arange(64, 76.1, 0.5)]
    return max(zip(worths(radius, [Pacer(lap_time=each) for each in times], workers), times, strict=True))


def best_harmonics(radius: int, seconds: float, workers: Workers) -> tuple[float, Harmonics]:
    generator = np.random.default_rng(radius)
    candidates = list(TUNED.values())  # the search begins with the best known
    best: list[tuple[float, Harmonics]] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = worths(radius, [Pacer(harmonics=candidate) for candidate in candidates], workers)
        best = sorted([*best, *zip(found, candidates, strict=True)], reverse=True)[:4]
        width = 1.0 if time.monotonic() < end - seconds / 2 else 0.3
        candidates = []
        for _ in range(BATCH):
            _, parent = best[generator.integers(len(best))]
            change = generator.normal(size=5) * [0.3, 0.6, 0.6, 0.4, 0.4] * width
            candidates.append(tuple(round(float(value), 2) for value in np.add(parent, change)))
    return best[0]


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 240.0
    radii = [int(word) for word in sys.argv[2:]] or [30, 32, 33, 34, 35]
    with Workers(2) as workers:
        for radius in radii:
            steady, lap_time = best_lap_time(radius, workers)
            print(f"radius {radius} m: a lap in {lap_time} s, {steady:.2f} m/s", flush=True)
            varying, harmonics = best_harmonics(radius, seconds, workers)
            print(f"    {loop_length(radius):.1f}: {harmonics},  # {varying:.2f} m/s", flush=True)


if __name__ == "__main__":
    main()
