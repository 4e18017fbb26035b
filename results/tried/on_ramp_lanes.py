"""Whether CAVs on the left lane had better be held back otherwise than those on the right one.

`python results/tried/on_ramp_lanes.py` writes on-ramp-lanes.json beside itself, in a quarter of an hour: at
5 % CAVs the law that was tuned longer, with shifts of its cap by stretch of the way and by lane. Pairs of
roads of a batch with the same people and opposite shifts, and then one set of shifts in three strengths, read
off these. Tuning seeds.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass as settings

from unjam.controller import make_driver
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.road_experts import JamAhead
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.parameters import STRICT
from unjam.physics.arrays import Array
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.training.presets import ON_RAMP_LONG
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.run import run_batches
from unjam.worlds.workers import EpisodeTask

ROAD = replace(ON_RAMP, cav_share=0.05)
ENDS = np.array([250.0, 500.0, 1000.0])
"""of the stretches, the last of which goes on [m before the ramp]"""
SPREAD = 1.5
"""standard deviation of the shifts [m/s]"""
PAIRS, FIRST = 128, 12000
CHOSEN = (0.0, 0.0, 0.0, 0.0, 0.3, 0.6, 1.2, 1.9)
"""from the ramp on upstream, on the left lane and then on the right one [m/s]"""
STRENGTHS, JUDGED, FIRST_JUDGED = (0.0, 0.6, 1.2, 2.0), 96, 12600


@settings(frozen=True, config=STRICT)
class LaneJamAhead(JamAhead):
    """`jam-ahead` whose cap is shifted by where it is and on which lane."""

    told: ClassVar[tuple[str, ...]] = (*JamAhead.told, "beside_gaps")

    shifts: tuple[float, ...] = (0.0,) * len(CHOSEN)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the shifted cap."""
        right = (state.beside_gaps[:, :2] < LARGEST_GAP).any(-1)  # somebody is on a lane at its left
        stretch = np.searchsorted(ENDS, state.to_merge) + (len(ENDS) + 1) * right
        moved = state._replace(lane_speeds=state.lane_speeds + np.array(self.shifts)[stretch][:, None])
        return super().act(moved, memory)


def times_of(shifts: NDArray[np.float64], seeds: list[tuple[int, ...]]) -> NDArray[np.float64]:
    """Return the travel times with sets of shifts, shape (seeds, sets, 8), as (seeds, sets) [s]."""
    law = make_driver(ON_RAMP_LONG, ROAD.decision_step)
    assert isinstance(law, JamAhead)
    tasks = [
        EpisodeTask(ROAD, LaneJamAhead(**asdict(law), shifts=tuple(each)), seed)
        for sets, seed in zip(shifts.round(4).tolist(), seeds, strict=True)
        for each in sets
    ]
    found = [measure(episode)["travel_time"] for episode in run_batches(tasks, statistical=True)]
    return np.reshape(found, shifts.shape[:2])


if __name__ == "__main__":
    drawn = np.random.default_rng(5).normal(0.0, SPREAD, (PAIRS, len(CHOSEN)))
    up, down = times_of(np.stack([drawn, -drawn], 1), tuning_seeds(PAIRS, FIRST)).T
    half = (up - down) / 2.0
    slopes, *_ = np.linalg.lstsq(drawn, half)
    left = half - drawn @ slopes
    errors = np.sqrt(left @ left / (PAIRS - len(CHOSEN)) * np.linalg.inv(drawn.T @ drawn).diagonal())
    strengths = np.outer(STRENGTHS, CHOSEN)
    times = times_of(np.stack([strengths] * JUDGED), tuning_seeds(JUDGED, FIRST_JUDGED))
    facts = {
        "manifest": manifest(),
        "slopes": [
            {"slope": float(slope), "half_width": 1.96 * float(error)}
            for slope, error in zip(slopes, errors, strict=True)
        ],
        "shifts": CHOSEN,
        "travel_times": {
            f"{strength:g}": column.tolist() for strength, column in zip(STRENGTHS, times.T, strict=True)
        },
        "beyond_none": {
            f"{strength:g}": asdict(estimate((column - times[:, 0]).tolist()))
            for strength, column in list(zip(STRENGTHS, times.T, strict=True))[1:]
        },
    }
    write_whole(Path(__file__).with_name("on-ramp-lanes.json"), to_json(facts, indent=1))
