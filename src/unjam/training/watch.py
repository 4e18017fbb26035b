"""An episode in SUMO's own window."""

import os
import sys
from collections.abc import Sequence

from unjam.drivers.driver import Driver
from unjam.errors import MissingPartError
from unjam.scenarios.scenario import Scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.simulation import Simulation


def watch_in_window(scenario: Scenario, driver: Driver, seed: Sequence[int], pace: float) -> Episode:
    """Run an episode in SUMO's window, `pace` times as fast as life; return it.

    Raises:
        MissingPartError: there is no display.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        raise MissingPartError(
            "watch: no display; write a film: --video FILE, or use xvfb-run unjam watch ..."
        )
    delay = 1000.0 / pace  # [ms] for a second of simulation, however many steps it has
    with Simulation(
        "gui", gui_options=("--start", "true", "--quit-on-end", "true", "--delay", str(delay))
    ) as window:
        return run_episode(scenario, driver, seed, simulation=window)
