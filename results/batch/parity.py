"""The largest differences between rings of a batch and SUMO's of the same seeds, over 3,000 decisions."""

import json

import numpy as np

from unjam import __version__
from unjam.drivers.registry import named_driver
from unjam.scenarios import Ring
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.workers import EpisodeTask

SEEDS = range(12)
RINGS = {
    "people alone": (Ring(), "human"),
    "one CAV": (Ring(), "pi"),
    "one CAV after 5 min of people": (Ring(warmup=3000), "pi"),
    "the paper's PI": (Ring(), "pi:time_constant=0"),
    "four CAVs": (Ring(cavs=4), "pi"),
    "50 vehicles, 5 CAVs, 500-560 m": (Ring(length=(500, 560), vehicles=50, cavs=5), "pi"),
    "8 vehicles, 60-80 m": (Ring(length=(60, 80), vehicles=8), "follower-stopper"),
    "22 vehicles, 400-800 m": (Ring(length=(400, 800)), "pi"),
    "noise 1 m/s2": (Ring(noise=1.0), "pi"),
}

found = []
with Simulation() as simulation:
    for name, (ring, expert) in RINGS.items():
        driver = named_driver(expert, ring.decision_step)
        batch = run_batch([EpisodeTask(ring, driver, (seed,)) for seed in SEEDS])
        episodes = [run_episode(ring, driver, seed, simulation=simulation) for seed in SEEDS]
        pairs = list(zip(batch, episodes, strict=True))
        found.append(
            {
                "ring": name,
                "driver": expert,
                "episodes": len(pairs),
                "steps": sum(episode.steps for episode in episodes),
                "speed": max(float(np.abs(one.speeds - other.speeds).max()) for one, other in pairs),
                "position": max(float(np.abs(one.positions - other.positions).max()) for one, other in pairs),
            }
        )
print(json.dumps({"unjam": __version__, "largest differences, m/s and m": found}, indent=1))
