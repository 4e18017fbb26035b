"""The limit on the string gain of CAVs on closed roads, for tuning and training."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import nan

import numpy as np

from unjam.controller.string_stability import GAIN_TOLERANCE, operating_speeds, string_gains
from unjam.drivers.car_following import Human
from unjam.drivers.driver import Driver
from unjam.errors import raise_failure
from unjam.measures.metrics import measure
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.seeds import tuning_seeds
from unjam.training.export import driver_with_filter, remove_filter
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

MAX_STRING_GAIN = 1.0 + GAIN_TOLERANCE
"""maximum gain of a controller that is called string stable"""
HUMAN_EPISODES = 2
"""episodes of human traffic that determine the operating speeds of a road"""


@dataclass(frozen=True)
class OperatingPoint:
    """A closed road and the speeds at which the string gain of CAVs is measured."""

    road: Scenario
    loop_length: float
    """length of the closed road [m]; NaN if unknown"""
    speeds: tuple[float, ...]
    """speeds of the leader [m/s]"""

    def string_gain(self, driver: Driver) -> float:
        """Return the largest gain over speeds and frequencies, with the filter and the actuator of the road.

        The gain of a driver that falls behind its leader is infinite.
        """
        filtered = driver_with_filter(remove_filter(driver), self.road)  # a file may have the filter of another car
        gains = string_gains(filtered, self.speeds, self.road.humans, self.loop_length)
        return float(np.nan_to_num(gains, nan=np.inf).max(initial=0.0))


def find_operating_points(roads: Mapping[str, Scenario], workers: WorkerPool) -> dict[str, OperatingPoint]:
    """Return the operating points of closed roads by name, around the mean speed of human-only traffic."""
    closed_roads = {name: road for name, road in roads.items() if road.is_closed}
    roads_and_seeds = product(closed_roads.values(), tuning_seeds(HUMAN_EPISODES))
    tasks = [EpisodeTask(road, Human(), seed) for road, seed in roads_and_seeds]
    rows = workers.run_and_map(tasks, lambda index, episode: measure(episode))
    raise_failure(rows)
    points: dict[str, OperatingPoint] = {}
    for index, (name, road) in enumerate(closed_roads.items()):
        road_rows = rows[index * HUMAN_EPISODES : (index + 1) * HUMAN_EPISODES]
        mean_speed = float(np.mean([row["mean_speed"] for row in road_rows]))
        drawn_road, _ = road.draw_from_seed(tuning_seeds(1)[0])
        loop_length = drawn_road.loop_length if isinstance(drawn_road, ClosedRoad) else nan
        points[name] = OperatingPoint(road, loop_length, tuple(operating_speeds(mean_speed, road.humans)))
    return points
