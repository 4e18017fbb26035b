"""How far figures eight of a batch are from SUMO's of the same seeds: in distribution, and step by step."""

import json
import sys
from time import perf_counter

import numpy as np
from comparing import compared

from unjam.controller import make_driver
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.scenarios import FigureEight
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.workers import EpisodeTask

EPISODES = 20
APART = 0.01
"""difference of speeds from which on episodes count as apart [m/s]"""
STANDS = 0.1
"""speed below which a vehicle stands [m/s]"""
DRIVERS = (
    *("human", "idm", "acc", "pi", "pi:time_constant=0", "follower-stopper", "pacer"),
    *("pacer:gathering_speed=3", "unjam:figure-eight-tuned", "unjam:figure-eight-best", "unjam:best"),
)


def about(episode: Episode) -> dict[str, float]:
    """Return what is compared of an episode."""
    speeds, gaps = episode.speeds[1:], episode.gaps[1:]
    moving = speeds > 1.0
    headways = gaps[moving] / speeds[moving]
    found = {
        "return": float(measure(episode)["return"]),
        "mean speed": float(speeds.mean()),
        "speed of the second half": float(speeds[len(speeds) // 2 :].mean()),
        "std of speeds across vehicles": float(speeds.std(1).mean()),
        "share of time standing": float((speeds < STANDS).mean()),
        "slowest, second half": float(speeds[len(speeds) // 2 :].min(1).mean()),
    }
    for share in (0.05, 0.5, 0.95):
        found[f"gap, quantile {share:g}"] = float(np.quantile(gaps, share))
        found[f"headway, quantile {share:g}"] = float(np.quantile(headways, share))
    return found


def when_apart(one: Episode, other: Episode) -> int | None:
    """Return the decision from which on speeds differ; None where they never do."""
    count = min(len(one.speeds), len(other.speeds))
    differ = np.flatnonzero(np.abs(one.speeds[:count] - other.speeds[:count]).max(1) > APART)
    return int(differ[0]) if len(differ) else None


started, rows, seconds = manifest(), [], np.zeros(2)
road = FigureEight()
with Simulation() as simulation:
    run_episode(road, make_driver("idm", road.decision_step), 0, simulation=simulation)  # SUMO starts
    for name in DRIVERS:
        driver = make_driver(name, road.decision_step)
        begun = perf_counter()
        batch = run_batch([EpisodeTask(road, driver, (seed,)) for seed in range(EPISODES)], statistical=True)
        between = perf_counter()
        sumo = [run_episode(road, driver, seed, simulation=simulation) for seed in range(EPISODES)]
        seconds += between - begun, perf_counter() - between
        apart = [when_apart(one, other) for one, other in zip(batch, sumo, strict=True)]
        rows.append(
            {
                "driver": name,
                "collisions": [sum(not each.ok for each in episodes) for episodes in (batch, sumo)],
                "episodes apart": sum(when is not None for when in apart),
                "earliest apart": min((when for when in apart if when is not None), default=None),
                "compared": compared(*([about(each) for each in episodes] for episodes in (batch, sumo))),
            }
        )
        print(name, rows[-1]["episodes apart"], file=sys.stderr)
answer = {
    "episodes of each": EPISODES,
    f"seconds, batches of {EPISODES}, and SUMO": seconds.round(1).tolist(),
    "drivers": rows,
    "manifest": started,
}
print(json.dumps(answer, indent=1))
