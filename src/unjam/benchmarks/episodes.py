"""Episodes of several drivers on one road of the family, on the same test seeds, measured."""

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.measures.gain import EpisodeRows
from unjam.measures.metrics import measure
from unjam.scenarios.scenario import Scenario
from unjam.seeds import held_out_seeds
from unjam.worlds.backend import BackendLike
from unjam.worlds.batch.run import run_batches
from unjam.worlds.batch.support import unsupported_reason
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

EPISODES_PER_ROAD = 10
"""number of episodes of each driver on each road"""
FAMILY_TEST_SEEDS = held_out_seeds(EPISODES_PER_ROAD)
Seeds = Sequence[tuple[int, ...]]
EpisodeRunner = Callable[[list[EpisodeTask]], EpisodeRows]
"""runs tasks and returns the result of `family_metrics` for each of them, in their order"""
FAMILY_METRICS = (
    *("seed", "status", "travel_time", "delay", "mean_speed", "mean_speed_second_half", "speed_limit_ratio"),
    *("outflow_veh_per_h", "fuel_ml_per_km", "required_time_gap", "has_lanes", "collisions", "min_time_gap"),
    *("cav_min_ttc", "cav_max_braking", "cut_in_max_braking", "share_short_time_gap", "override_share"),
    "human_braking_beyond_4_5",
)


def make_tasks(scenario: Scenario, driver: Driver, seeds: Seeds, backend: BackendLike = "sumo") -> list[EpisodeTask]:
    """Return the episodes of a driver; together they cover the range of sizes of the road evenly."""
    strata = (scenario.stratum(index, len(seeds)) for index in range(len(seeds)))
    return [EpisodeTask(road, driver, seed, backend=backend) for road, seed in zip(strata, seeds, strict=True)]


def drive_by_label(
    scenario: Scenario, drivers: Mapping[str, str], seeds: Seeds, run_episodes: EpisodeRunner
) -> dict[str, EpisodeRows]:
    """Return the metrics of each driver's episodes by label; `drivers` are names of drivers by label."""
    made = [make_driver(name, scenario.control_step) for name in drivers.values()]  # one each: networks have memory
    rows, count = run_episodes([task for driver in made for task in make_tasks(scenario, driver, seeds)]), len(seeds)
    return {label: rows[number * count : (number + 1) * count] for number, label in enumerate(drivers)}


def family_metrics(index: int, episode: Episode) -> dict[str, Any]:
    """Return the metrics of an episode, for `WorkerPool.run_and_map`: a whole motorway episode takes 80 MB."""
    measured = measure(episode)
    return {key: measured[key] for key in FAMILY_METRICS}


def run_in_batches(workers: WorkerPool, tasks: list[EpisodeTask]) -> EpisodeRows:
    """Return the metrics of episodes of one road and several drivers, in batches where they are supported."""
    if unsupported_reason(tasks[0].scenario):
        return workers.run_and_map(tasks, family_metrics)
    by_driver = groupby(tasks, key=lambda task: id(task.driver))
    return [family_metrics(*each) for _, own in by_driver for each in enumerate(run_batches(list(own)))]
