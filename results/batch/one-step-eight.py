"""How far one step of a batched figure eight is from SUMO's, from each moment of SUMO's own episodes."""

import json
from typing import Any

import numpy as np
from tests.worlds.batch.one_step import errors

from unjam.controller import make_driver
from unjam.manifest import manifest
from unjam.scenarios import FigureEight
from unjam.worlds.sumo.simulation import Simulation

SEEDS = range(5)
DRIVERS = (
    *("human", "idm", "acc", "pi", "follower-stopper", "pacer"),
    *("pacer:gathering_speed=3", "unjam:figure-eight-tuned", "unjam:figure-eight-best"),
)

road, rows = FigureEight(), list[dict[str, Any]]()
answer = {"manifest": manifest(), "drivers": rows}
with Simulation() as simulation:
    for name in DRIVERS:
        driver = make_driver(name, road.decision_step)
        found = np.abs([errors(road, driver, seed, simulation) for seed in SEEDS])
        rows.append({"driver": name, "speeds": found.size, "largest": float(found.max())})
        rows[-1] |= {f"beyond {least} m/s": int((found > float(least)).sum()) for least in ("1e-6", "1e-3")}
print(json.dumps(answer, indent=1))
