"""Finds paces for the figure eight; prints the lap times and the paces that `drivers/road_experts.py` holds.

Lap times by grid, paces over the lap by the cross-entropy method: candidates are drawn from a normal
distribution, which then moves to the best of them. Each candidate drives 5,000 steps with seeds that are new
in each generation; its worth is the mean speed of all vehicles in the last 3,000, half of it the mean over
the seeds and half the worst of them, nothing at a collision. 3,000 steps are four laps: the mean of fewer
depends on where on the lap they begin.
Usage: tune_pacer.py [GENERATIONS [RADIUS ...]]; a generation takes half a minute on two cores.
"""

import sys
from collections.abc import Sequence

import numpy as np

from unjam.drivers.road_experts import TUNED, Pacer
from unjam.scenarios.figure_eight import FigureEight, loop_length
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

STEPS, JUDGED, SEEDS = 5000, 3000, 2
CANDIDATES, BEST = 24, 5
WIDTH = np.array([0.15, 0.3, 0.3, 0.25, 0.25, 0.15, 0.15, 0.01, 0.015])
"""of the first distribution: harmonics [m/s], gain [1/s], wanted gap"""


def pacer_of(values: np.ndarray) -> Pacer:
    *harmonics, gain, wanted_gap = np.round(values, 3).tolist()
    return Pacer(
        harmonics=tuple(harmonics),
        gain=max(0.0, gain),
        wanted_gap=wanted_gap,
        gathering_gap=0.5,
        regathering_gap=0.45,
    )


def values_of(lap: float) -> np.ndarray:
    """Return where the search begins: what is known for the nearest lap."""
    known = TUNED[min(TUNED, key=lambda each: abs(each - lap))]
    return np.array([*known["harmonics"], known["gain"], known["wanted_gap"]])


def speed(episode: Episode) -> float:
    if episode.status != "completed":
        return 0.0
    return float(episode.speeds[-JUDGED:].mean())


def worths(radius: int, drivers: Sequence[Pacer], seeds: Sequence[int], workers: Workers) -> np.ndarray:
    road = FigureEight(radius=(radius, radius), horizon=STEPS)
    tasks = [EpisodeTask(road, driver, (seed,)) for driver in drivers for seed in seeds]
    found = np.array([speed(episode) for episode in workers.run(tasks)]).reshape(-1, len(seeds))
    return 0.5 * found.mean(1) + 0.5 * found.min(1)


def best_lap_time(radius: int, workers: Workers) -> tuple[float, float]:
    times = [float(value) for value in np.arange(64, 76.1, 0.5)]
    found = worths(radius, [Pacer(lap_time=each) for each in times], range(6), workers)
    return max(zip(found.tolist(), times, strict=True))


def best_pace(radius: int, generations: int, workers: Workers) -> tuple[float, np.ndarray]:
    generator = np.random.default_rng(radius)
    mean, width = values_of(loop_length(radius)), WIDTH
    for generation in range(generations):
        values = mean + width * generator.normal(size=(CANDIDATES, len(mean)))
        values[0] = mean
        seeds = [1000 * generation + 7 * radius + index for index in range(SEEDS)]
        found = worths(radius, [pacer_of(each) for each in values], seeds, workers)
        best = values[np.argsort(-found)[:BEST]]
        mean = 0.3 * mean + 0.7 * best.mean(0)
        width = 0.4 * width + 0.6 * np.maximum(best.std(0), 0.35 * width)
    return float(worths(radius, [pacer_of(mean)], range(50_000, 50_010), workers)[0]), mean


def main() -> None:
    generations = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    radii = [int(word) for word in sys.argv[2:]] or [30, 32, 33, 34, 35]
    with Workers(2) as workers:
        for radius in radii:
            steady, lap_time = best_lap_time(radius, workers)
            print(f"radius {radius} m: a lap in {lap_time} s, {steady:.2f} m/s", flush=True)
            varying, values = best_pace(radius, generations, workers)
            print(f"    {loop_length(radius):.1f}: {pacer_of(values)},  # {varying:.2f} m/s", flush=True)


if __name__ == "__main__":
    main()
