"""Which constant acceleration reaches the paper's level on ring and figure eight?

    python results/tried/constant-level.py FOLDER

writes FOLDER/constant-level.json: return of the released code's reward, and the paper's convention of speed
(the CAV's own, mean and standard deviation over time). Twenty held-out seeds each.
"""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unjam.drivers import Constant
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.scenarios import make_scenario
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation

CONSTANTS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.05, 0.07, 0.1, 0.2, 0.3, 0.5)
"""[m/s2]"""
KEPT = ("return", "mean_speed", "cav_mean_speed", "speed_std_cav", "mean_abs_accel")


def main(folder: Path) -> None:
    """Measure, and write the numbers."""
    about, rows = manifest(), list[dict[str, Any]]()
    with Simulation() as simulation:
        for name in ("ring", "figure-eight"):
            road = make_scenario(name)
            for constant in CONSTANTS:
                found = [
                    measure(run_episode(road, Constant(constant), seed, simulation=simulation))
                    for seed in held_out_seeds(20)
                ]
                row: dict[str, Any] = {"road": name, "acceleration": constant}
                row |= {key: asdict(estimate([each[key] for each in found])) for key in KEPT}
                rows.append(row)
                print(name, constant, {key: round(row[key]["mean"], 3) for key in KEPT}, flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "constant-level.json", to_json({"manifest": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
