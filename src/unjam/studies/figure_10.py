"""Figure 10: 5, 11 and 22 vehicles, trained for each as in the paper; and carried over without training."""

from pathlib import Path
from typing import Any

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.measures.statistics import estimate
from unjam.studies.plan import ROADS, PlannedRun, planned
from unjam.studies.pool import Pool
from unjam.studies.study import Study
from unjam.studies.table import HONEST, entries, table_rows, write_table
from unjam.training.config import load_config
from unjam.training.evaluate import evaluate, held_out_seeds
from unjam.worlds.workers import Workers

VOLUMES = ("ring-5", "ring-11", "ring")
LEARNERS = ("trpo", "ppo", "sac", "without-model", "proposed", "ours")
CARRIED = ("proposed", "ours")
TRAINED_ON = "ring"
OTHER_ROADS: dict[str, dict[str, Any]] = {
    "5 vehicles": ROADS["ring-5"],
    "11 vehicles": ROADS["ring-11"],
    "22 vehicles": ROADS["ring"],
    "44 vehicles on 520 m": {"scenario": "ring", "road.vehicles": 44, "road.length": [520, 520]},
}
EPISODES = 20


def carried_over(pool: Pool, seeds: int, processes: int = 2) -> list[dict[str, Any]]:
    """Return what controllers that were trained among 22 vehicles do among others, without training."""
    rows = []
    with Workers(processes) as workers:
        for road, changes in OTHER_ROADS.items():
            scenario = load_config(changes=changes).make_scenario()
            drivers = {name: make_driver(name, scenario.decision_step) for name in ("human", "pi")}
            for variant in CARRIED:
                for seed in range(seeds):
                    folder = pool.folder_of(PlannedRun(TRAINED_ON, variant, seed))
                    drivers[f"{variant} {seed}"] = make_driver(str(folder), scenario.decision_step)
            found = evaluate(scenario, drivers, held_out_seeds(EPISODES), workers)
            for label, episodes in found.rows.items():
                row: dict[str, Any] = {"road": road, "driver": label}
                row |= {name: entries(estimate([episode[name] for episode in episodes])) for name in HONEST}
                rows.append(row)
    return rows


def _write(pool: Pool, seeds: int, folder: Path, workers: int) -> None:
    write_table([row for road in VOLUMES for row in table_rows(pool, road, LEARNERS, seeds)], folder)
    write_whole(folder / "carried-over.json", to_json(carried_over(pool, seeds, workers), indent=1))


FIGURE_10 = Study(
    "5, 11 and 22 vehicles, trained for each, and carried over",
    lambda seeds: planned(VOLUMES, LEARNERS, seeds),
    _write,
    VOLUMES,
    minutes=3.0,
)
