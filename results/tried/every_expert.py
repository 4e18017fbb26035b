"""Which expert is worth tuning for all roads at once? Each as it is, on the roads that are seen.

    python results/tried/every_expert.py FILE.json

Mean gain as `unjam tune everywhere` has it, of which 1 is a road without waves or delay, on the two tuning
seeds of each road that its settings meet there. Who needs a closed road is left out.
"""

import sys
from pathlib import Path

import numpy as np

from unjam.drivers.registry import DRIVERS, named_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.gain import Rows, ceiling, gain
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate
from unjam.scenarios.scenario import Scenario
from unjam.training.family import roads_of
from unjam.training.seeds import tuning_seeds
from unjam.training.tune import OF_EACH
from unjam.worlds.workers import EpisodeTask, Workers

PEOPLE, SEEDS = "human", tuning_seeds(OF_EACH)


def rows_of(workers: Workers, name: str, road: Scenario) -> Rows:
    """Return what a driver's episodes on a road are measured as."""
    driver = named_driver(name, road.decision_step)
    tasks = [EpisodeTask(road.part(part, len(SEEDS)), driver, seed) for part, seed in enumerate(SEEDS)]
    return workers.run_each(tasks, lambda index, episode: measure(episode))


def main() -> None:
    """Drive them, and write what each gains, road by road."""
    roads = roads_of("everywhere", "seen")
    experts = [name for name, kind in DRIVERS.items() if not (kind.native or kind.needs_loop)]
    found: dict[str, dict[str, Estimate]] = {name: {} for name in experts}
    with Workers(1) as workers:
        for road, scenario in roads.items():
            people = rows_of(workers, PEOPLE, scenario)
            best = float(np.mean([ceiling(row) for row in people]))
            for name in experts:
                found[name][road] = gain(rows_of(workers, name, scenario), people, best)
                print(road, name, f"{found[name][road].mean:+.2f}", flush=True)
    mean = {name: float(np.mean([each.mean for each in gains.values()])) for name, gains in found.items()}
    gains = {name: {road: each.mean for road, each in of.items()} for name, of in found.items()}
    write_whole(Path(sys.argv[1]), to_json({"manifest": manifest(), "mean": mean, "gains": gains}, indent=1))


if __name__ == "__main__":
    main()
