"""Who shall drive on a figure eight where no queue holds: laws beside each other among other people.

`python results/tried/gives_up.py` writes gives-up.json beside itself, in some ten minutes: for each road
the mean speed of all in the second half of the episode with people alone, with who leads a queue, and with
each law that follows when the queue did not hold; and in how many episodes it did not. Tuning seeds.
"""

from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.road_experts import BROKEN, GATHERED
from unjam.drivers.while_gathered import WhileGathered
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.studies.everywhere import GAP_ON_ALL, PI_ON_ALL, PI_ON_RINGS
from unjam.training.family import ASTAZERO, HURRIED, MEASURED
from unjam.training.seeds import tuning_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode

STEP = 0.1
SEEDS = tuning_seeds(6, 5100)
LEADING = "unjam:figure-eight-best"
LAWS = {
    "PI, tuned on all": PI_ON_ALL,
    "PI from its gap, tuned on all": GAP_ON_ALL,
    "PI, tuned on the rings": PI_ON_RINGS,
    "unjam:rings-tuned": "unjam:rings-tuned",
    "unjam:ring-tuned": "unjam:ring-tuned",
    "FollowerStopper": "follower-stopper",
}
ROADS: dict[str, dict[str, Any]] = {
    "paper's people": {},
    "twelve of them": {"vehicles": 12},
    "hurried": {"humans": HURRIED},
    "sixteen of the paper's": {"vehicles": 16},
    "headways of 1.3 s": {"humans": {"time_headway": 1.3}},
    "typical of NGSIM": {"humans": MEASURED},
    "AstaZero": ASTAZERO,
    "twelve of AstaZero": {"vehicles": 12, **ASTAZERO},
}


def broke(episode: Episode) -> bool:
    """Return whether the queue behind the CAV did not hold, or never was there."""
    free = episode.gaps[:, episode.vehicle_ids.index("cav_0")] / episode.loop_length
    gathered = int(np.argmax(free >= GATHERED))
    return free[gathered] < GATHERED or bool((free[gathered:] < BROKEN).any())


if __name__ == "__main__":
    leading = make_driver(LEADING, STEP)
    drivers: dict[str, Driver] = {"people alone": make_driver("human", STEP), LEADING: leading}
    drivers |= {name: WhileGathered(leading, make_driver(law, STEP), STEP) for name, law in LAWS.items()}
    found: dict[str, Any] = {"manifest": manifest(), "roads": {}}
    for road, changes in ROADS.items():
        eight = make_scenario("figure-eight", changes)
        row: dict[str, Any] = {"speeds": {}}
        for name, driver in drivers.items():
            episodes = [
                run_episode(eight.part(number, len(SEEDS)), driver, seed) for number, seed in enumerate(SEEDS)
            ]
            row["speeds"][name] = [measure(each)["mean_speed_second_half"] for each in episodes]
            if name == LEADING:
                row["broke"] = sum(map(broke, episodes))
        found["roads"][road] = row
        print(
            road, row["broke"], {name: round(float(np.mean(each)), 2) for name, each in row["speeds"].items()}
        )
    write_whole(Path(__file__).with_name("gives-up.json"), to_json(found))
