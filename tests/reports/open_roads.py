"""Episodes on open roads for figures."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.worlds.sumo.user_networks import game
from unjam.controller import make_driver
from unjam.drivers import Human, PISaturation
from unjam.reports.results import PLOT_ARRAYS, PlotEpisode, to_plot_episode
from unjam.scenarios import Merge, make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode


def plot_episode_of(episode: Episode, driver: str) -> PlotEpisode:
    """Return an episode as a folder of results contains it."""
    arrays = {name: getattr(episode, name).astype(np.float32) for name in PLOT_ARRAYS}
    return replace(to_plot_episode(driver, episode), **arrays)


@cache
def merge_episode(seconds: int = 100, driver: str = "pi") -> Episode:
    drivers = {"pi": PISaturation(time_step=1.0), "human": Human()}
    return run_episode(Merge(penetration_rate=0.2, horizon=seconds), drivers[driver], (1,), record_details=True)


@cache
def ramp_episode(driver: str = "jam-ahead") -> Episode:
    """A motorway of two lanes with 50 % CAVs."""
    changes = {"peak": (0.0, 90.0), "penetration_rate": 0.5, "horizon": 90}
    return run_episode(make_scenario("on-ramp", changes), make_driver(driver, 1.0), (1,), record_details=True)


def user_episode(folder: Path, seconds: int = 60) -> Episode:
    """Traffic on the network `ramp` of a SUMO game."""
    scenario = make_scenario(str(game(folder, "ramp")), {"penetration_rate": 0.3, "horizon": seconds * 5})
    return run_episode(scenario, PISaturation(time_step=scenario.control_step), (1,), record_details=True)
