"""Fuel on closed roads by two emission models, and the part of it that idling would burn.

In a model with a large idle rate, faster vehicles need less fuel per kilometer, even without smoother driving.
"""

from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.measures.effect import FUEL_METRIC
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import GASOLINE_DENSITY
from unjam.measures.statistics import metric_estimate, paired_difference
from unjam.road_family import NO_LATENCY
from unjam.scenarios import make_scenario
from unjam.seeds import held_out_seeds
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, Table, estimate_text, measure_tasks

EMISSION_CLASSES = {"HBEFA4": "HBEFA4/PC_petrol_Euro-6ab", "PHEMlight": "PHEMlight/PC_G_EU4"}
"""emission classes of SUMO, by model"""
FUEL_DRIVERS: dict[str, tuple[str, ...]] = {
    "ring": (HUMAN_LABEL, "pi", "unjam:best", "unjam:ring-best-ideal"),
    "ring-jammed": (HUMAN_LABEL, "pi", "unjam:best", "unjam:ring-jammed-best-ideal"),
    "figure-eight": (HUMAN_LABEL, "pi", "unjam:best", "unjam:figure-eight-best-ideal"),
}
FUEL_SEEDS, SECONDS_PER_HOUR = 20, 3600.0
IDLE_SPEED = 0.001
"""speed below which an engine is idle [m/s]"""


def idle_rate(episode: Episode) -> float:
    """Return the median fuel rate of standing vehicles [l/h]; NaN if no vehicle stands."""
    speeds = episode.speeds[1 : len(episode.fuel) + 1]
    standing = episode.fuel[speeds < IDLE_SPEED]
    return float(np.median(standing)) / GASOLINE_DENSITY * SECONDS_PER_HOUR / 1000.0 if standing.size else np.nan


def measure_fuel(road: str, emission_class: str, drivers: Sequence[str], workers: int) -> Table:
    """Return the fuel [ml/km], the idle rate [l/h] and the mean speed [m/s] of drivers, one row for each episode."""
    scenario = make_scenario(road, {"emission_class": emission_class, "actuator": NO_LATENCY})
    pairs = product([make_driver(name, scenario.control_step) for name in drivers], held_out_seeds(FUEL_SEEDS))
    tasks = [EpisodeTask(scenario, driver, seed, record_details=True) for driver, seed in pairs]

    def make_row(index: int, episode: Episode, metrics: dict[str, Any]) -> dict[str, Any]:
        entries = {name: metrics[name] for name in ("seed", "mean_speed", FUEL_METRIC)}
        return {"driver": drivers[index // FUEL_SEEDS], **entries, "idle_rate": idle_rate(episode)}

    return measure_tasks(tasks, workers, make_row)


def fuel_table(road: str, folder: Path) -> pd.DataFrame:
    """Return the fuel of drivers by model, its difference to the human baseline, and the fuel of idling alone."""
    table: dict[str, dict[str, str]] = {}
    for model in EMISSION_CLASSES:
        rows = read_part(folder, f"{road}, {model}")
        rate = float(np.nanmedian([np.nan if row["idle_rate"] is None else row["idle_rate"] for row in rows]))
        by_driver = {name: [row for row in rows if row["driver"] == name] for name in FUEL_DRIVERS[road]}
        human = by_driver[HUMAN_LABEL]
        for name, episodes in by_driver.items():
            speed = metric_estimate(episodes, "mean_speed").mean
            difference = None if episodes is human else paired_difference(episodes, human, FUEL_METRIC)
            cells = table.setdefault(name, {"": name, "mean speed [m/s]": f"{speed:.2f}"})
            cells[f"{model} [ml/km]"] = f"{metric_estimate(episodes, FUEL_METRIC).mean:.0f}"
            cells[f"{model}, difference"] = estimate_text(difference, 0, "+")
            cells[f"{model}, idling at {rate:.1f} l/h"] = f"{rate * 1e6 / SECONDS_PER_HOUR / speed:.0f}"
    return pd.DataFrame(table.values())


FUEL = Study(
    title="fuel on closed roads by two emission models, and the share of idling",
    make_parts=lambda study_folder, seeds: {
        f"{road}, {model}": (measure_fuel, (road, emission_class, drivers))
        for road, drivers in FUEL_DRIVERS.items()
        for model, emission_class in EMISSION_CLASSES.items()
    },
    minutes=10.0,
    tables={road: partial(fuel_table, road) for road in FUEL_DRIVERS},
)
