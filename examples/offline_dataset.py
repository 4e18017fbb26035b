"""Export episodes of human drivers, an expert and a learned policy as a data set for offline RL, and load it.

Run: python examples/offline_dataset.py [episodes] [horizon]. It writes traffic.parquet, a row per CAV and step.
"""

import sys
from typing import Any

import numpy as np
import pandas as pd

import unjam
from unjam.drivers.observation import local_observation
from unjam.worlds.record import Episode

EPISODES, HORIZON = (int(text) for text in (*sys.argv[1:], "10", "3000")[:2])
DRIVERS = "human", "pi", "unjam:ring-best"
FILE = "traffic.parquet"


def transitions(driver: str, episode: Episode) -> pd.DataFrame:
    """Return the transitions of all CAVs of an episode."""
    tables = []
    for trip in episode.trajectories:
        observations, steps = local_observation(trip.states).astype(np.float32), len(trip.reward)
        is_last = np.arange(steps) == steps - 1
        columns = {
            "driver": driver,
            "seed": episode.seed[0],
            "agent": trip.vehicle,
            "step": np.arange(trip.start_step, trip.start_step + steps),
            "observation": [*observations[:-1]],
            "action": trip.applied_acceleration.astype(np.float32),  # after the safety filter [m/s2]
            "reward": trip.reward,
            "next_observation": [*observations[1:]],  # truncated episodes are bootstrapped with the last one
            "terminated": is_last & trip.terminated,
            "truncated": is_last & (not trip.terminated),
        }
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables)


scenario = unjam.make_scenario("ring", {"cavs": 2, "horizon": HORIZON})
episodes = [
    (name, unjam.run_episode(scenario, unjam.make_driver(name, scenario.control_step), seed))
    for name in DRIVERS
    for seed in range(EPISODES)
]
pd.concat([transitions(*each) for each in episodes]).to_parquet(FILE, index=False)

data: Any = pd.read_parquet(FILE)
arrays = {name: np.stack(data[name]) for name in ("observation", "next_observation")}  # as learners take them
print(f"unjam {unjam.__version__}: {len(data):,} transitions, observations {arrays['observation'].shape}")
returns = data.groupby(["driver", "seed", "agent"], sort=False)["reward"].sum()
np.testing.assert_allclose(returns, [trip.reward.sum() for _, episode in episodes for trip in episode.trajectories])
print(returns.groupby("driver", sort=False).mean().round(1).to_string())
