"""Where may the paper's level on the merge come from? What nobody learned earns there, by what SUMO keeps.

    python results/tried/merge-level.py FOLDER

writes FOLDER/merge-level.json: return of the released code's reward and the paper's convention of speed (the
CAVs' own, mean and standard deviation over time), by the gap that SUMO keeps beneath the commands (its
`minGap`) and the number of people who stand on the road at the start. Twenty held-out seeds each.
"""

import itertools
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unjam.drivers.registry import named_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.scenarios import Merge
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation

GAPS, STANDING = (2.5, 2.0, 1.0, 0.0), (5, 0)
DRIVERS = {"people alone": "human", "IDM": "idm", "PI (paper)": "pi:time_constant=0", "zero": "constant"}
KEPT = ("return", "mean_speed", "cav_mean_speed", "speed_std_cav", "throughput_veh_per_h", "collisions")


def main(folder: Path) -> None:
    """Measure, and write the numbers."""
    about, rows = manifest(), list[dict[str, Any]]()
    with Simulation() as simulation:
        for gap, standing, (label, name) in itertools.product(GAPS, STANDING, DRIVERS.items()):
            Merge.people_gap = gap
            road = Merge(standing=standing)
            driver = named_driver(name, road.decision_step)
            found = [
                measure(run_episode(road, driver, seed, simulation=simulation)) for seed in held_out_seeds(20)
            ]
            row: dict[str, Any] = {"gap": gap, "standing": standing, "driver": label}
            row |= {key: asdict(estimate([each[key] for each in found])) for key in KEPT}
            rows.append(row)
            print(gap, standing, label, {key: round(row[key]["mean"], 2) for key in KEPT}, flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "merge-level.json", to_json({"manifest": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
