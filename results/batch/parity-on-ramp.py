"""How far on-ramps of a batch are from SUMO's of the same demand and people, in distribution."""

import json
import sys
from dataclasses import replace
from time import perf_counter

import numpy as np
from comparing import compared

from unjam.controller import make_driver
from unjam.manifest import manifest
from unjam.measures.metrics import measure, travel_time
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.workers import EpisodeTask

EPISODES = 30
SLOW = 8.0
"""speed below which a vehicle counts as in the jam [m/s]"""
SECTION = 100.0
"""in which speeds are averaged [m]"""
UPSTREAM, DOWNSTREAM = -700.0, -300.0
"""places between which waves are timed, before the ramp joins [m]"""
LATEST = 200
"""in which a wave passes from one to the other [decisions]"""
DRIVERS = (
    *("human", "cruise", "jam-ahead", "jam-ahead:margin=0", "jam-ahead:all_lanes=true", "gap-maker"),
    *("adaptive-acc", "follower-stopper", "unjam:on-ramp-tuned", "unjam:best"),
)


def mean_speed_at(episode: Episode, place: float) -> np.ndarray:
    """Return the mean speed in a section after each decision, as before where nobody is [m/s]."""
    there = (episode.positions >= place) & (episode.positions < place + SECTION) & (episode.lanes < 2.0)
    count = there.sum(1)
    mean = np.where(there, episode.speeds, 0.0).sum(1) / np.maximum(count, 1)
    known = np.maximum.accumulate(np.where(count > 0, np.arange(len(count)), 0))
    return mean[known]


def wave_speed(episode: Episode) -> float:
    """Return how fast slowness spreads against the traffic: by when two places are most alike [m/s]."""
    first, last = (mean_speed_at(episode, place)[300:1800] for place in (DOWNSTREAM, UPSTREAM))
    lags = range(20, LATEST)
    alike = [np.corrcoef(first[:-lag], last[lag:])[0, 1] for lag in lags]
    return float((UPSTREAM - DOWNSTREAM) / lags[int(np.argmax(alike))])


def about(episode: Episode) -> dict[str, float]:
    """Return what is compared of an episode."""
    speeds, gaps, lanes = episode.speeds, episode.gaps, episode.lanes
    there = ~np.isnan(speeds)
    before, at, behind = (
        there & (episode.positions > low) & (episode.positions < high)
        for low, high in ((-2000.0, -1000.0), (-1000.0, 300.0), (300.0, 700.0))
    )
    moving = there & (speeds > 1.0) & ~np.isnan(gaps)
    headways = gaps[moving] / speeds[moving]
    together = there[1:] & there[:-1]
    measured = measure(episode)
    found = {
        "travel time": travel_time(episode),
        "flow": float(measured["throughput_veh_per_h"]),
        "speed": float(np.nanmean(speeds)),
        "std of speeds": float(np.nanstd(speeds)),
        "speed more than 1 km before the ramp": float(speeds[before].mean()),
        "speed from there to the end of its lane": float(speeds[at].mean()),
        "speed behind": float(speeds[behind].mean()),
        "share of time slower than 8 m/s": float((speeds[there] < SLOW).mean()),
        "share of vehicles on the right lane": float((lanes[there] == 1.0).mean()),
        "lane changes of a vehicle": float(
            ((np.diff(lanes, axis=0) != 0.0) & together).sum() / len(episode.vehicle_ids)
        ),
        "waiting to enter, most": float(episode.waiting.max()),
        "wave speed": wave_speed(episode),
        "people's hardest braking": float(measured["people_max_braking"]),
    }
    for share in (0.05, 0.5, 0.95):
        found[f"gap, quantile {share:g}"] = float(np.nanquantile(gaps, share))
        found[f"headway, quantile {share:g}"] = float(np.quantile(headways, share))
    return found


def main() -> None:
    """Print the answer as JSON."""
    started, rows, seconds = manifest(), [], np.zeros(2)
    road = replace(ON_RAMP, cav_share=0.1)
    with Simulation() as simulation:
        run_episode(
            replace(road, horizon=10), make_driver("human", road.decision_step), 0, simulation=simulation
        )
        for name in DRIVERS:
            driver = make_driver(name, road.decision_step)
            begun = perf_counter()
            tasks = [EpisodeTask(road, driver, (seed,)) for seed in range(EPISODES)]
            batch = run_batch(tasks, statistical=True)
            between = perf_counter()
            sumo = [
                run_episode(road, driver, seed, full=True, simulation=simulation) for seed in range(EPISODES)
            ]
            seconds += between - begun, perf_counter() - between
            collisions = [sum(each.status != "completed" for each in episodes) for episodes in (batch, sumo)]
            rows.append(
                {
                    "driver": name,
                    "collisions": collisions,
                    "compared": compared(*([about(each) for each in episodes] for episodes in (batch, sumo))),
                }
            )
            about_time = rows[-1]["compared"]["travel time"]
            print(name, collisions, about_time, seconds.round(), file=sys.stderr, flush=True)
    answer = {
        "episodes of each": EPISODES,
        f"seconds, batches of {EPISODES}, and SUMO": seconds.round(1).tolist(),
        "drivers": rows,
        "manifest": started,
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()
