"""Where may the paper's levels come from? What drivers earn on its roads that never learned.

    python results/tried/levels.py FOLDER

writes FOLDER/constant-level.json, a CAV that accelerates evenly on ring and figure eight, and
FOLDER/merge-level.json, the merge by the gap that SUMO keeps beneath the commands (its `minGap`) and the
number of people who stand on the road at the start. Return of the released code's reward, and the paper's
convention of speed: the CAVs' own, mean and standard deviation over time. Twenty held-out seeds each.
"""

import itertools
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unjam.drivers import Constant
from unjam.drivers.driver import Driver
from unjam.drivers.registry import named_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.scenarios import Merge, make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation

CONSTANTS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.05, 0.07, 0.1, 0.2, 0.3, 0.5)
"""[m/s2]"""
GAPS, STANDING = (2.5, 2.0, 1.0, 0.0), (5, 0)
DRIVERS = {"people alone": "human", "IDM": "idm", "PI (paper)": "pi:time_constant=0", "zero": "constant"}
KEPT = (
    *("return", "mean_speed", "cav_mean_speed", "speed_std_cav", "mean_abs_accel"),
    *("throughput_veh_per_h", "collisions"),
)


def earned(road: Scenario, driver: Driver, simulation: Simulation) -> dict[str, Any]:
    """Return what a driver does on the held-out seeds, as estimates by metric."""
    found = [measure(run_episode(road, driver, seed, simulation=simulation)) for seed in held_out_seeds(20)]
    return {key: asdict(estimate([each[key] for each in found])) for key in KEPT}


def constants(simulation: Simulation) -> Iterator[dict[str, Any]]:
    """Yield a row for each road and acceleration."""
    for name, constant in itertools.product(("ring", "figure-eight"), CONSTANTS):
        found = earned(make_scenario(name), Constant(constant), simulation)
        yield {"road": name, "acceleration": constant, **found}


def merges(simulation: Simulation) -> Iterator[dict[str, Any]]:
    """Yield a row for each gap, start and driver."""
    for gap, standing, (label, name) in itertools.product(GAPS, STANDING, DRIVERS.items()):
        Merge.people_gap, road = gap, Merge(standing=standing)
        found = earned(road, named_driver(name, road.decision_step), simulation)
        yield {"gap": gap, "standing": standing, "driver": label, **found}


def main(folder: Path) -> None:
    """Measure, and write the numbers."""
    about = manifest()
    folder.mkdir(parents=True, exist_ok=True)
    with Simulation() as simulation:
        for name, rows in (("constant-level", constants(simulation)), ("merge-level", merges(simulation))):
            content = {"manifest": about, "rows": list(rows)}
            write_whole(folder / f"{name}.json", to_json(content, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
