"""Where on its way to the ramp a CAV had better be slower, or faster, than `unjam:on-ramp-tuned` lets it be.

`python results/tried/on_ramp_shifts.py` writes on-ramp-shifts.json beside itself, in some half an hour: at
5 % CAVs 512 roads of a batch, each with shifts of the cap that were drawn for it, one for each 250 m of the
way; and in SUMO what one set of shifts, read off these, is worth. Tuning seeds.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from pydantic.dataclasses import dataclass as settings

from unjam.controller import make_driver
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.road_experts import JamAhead
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.parameters import STRICT
from unjam.physics.arrays import Array
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.run import MOST_MOTORWAYS, run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.workers import EpisodeTask

ROAD = replace(ON_RAMP, cav_share=0.05)
STRETCH, STRETCHES = 250.0, 8
SPREAD = 1.5
"""standard deviation of the shifts [m/s]"""
SURVEYED, FIRST = 512, 7000
CHOSEN = (-1.5, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
"""[m/s], from the ramp on upstream"""
JUDGED, FIRST_JUDGED = 60, 6000


@dataclass(frozen=True)
class Shifted:
    """What a stretch's shift is worth [s for each m/s]."""

    slope: float
    half_width: float
    """of its 95 % interval"""


@settings(frozen=True, config=STRICT)
class ShiftedJamAhead(JamAhead):
    """`jam-ahead` whose cap is shifted by where it is."""

    shifts: tuple[float, ...] = (0.0,) * STRETCHES

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the shifted cap."""
        shift = np.array(self.shifts)[(state.to_merge // STRETCH).astype(int).clip(0, STRETCHES - 1)]
        moved = state._replace(lane_speeds=state.lane_speeds + shift[:, None])
        return super().act(moved, memory)


def driver(shifts: tuple[float, ...]) -> JamAhead:
    """Return the shipped expert with shifts of its cap."""
    tuned = make_driver("unjam:on-ramp-tuned", ROAD.decision_step)
    assert isinstance(tuned, JamAhead)
    return ShiftedJamAhead(**asdict(tuned), shifts=shifts)


def surveyed() -> list[Shifted]:
    """Return what each stretch's shift is worth, by least squares with a square for each, in a batch."""
    drawn = np.random.default_rng(1).normal(0.0, SPREAD, (SURVEYED, STRETCHES)).round(4)
    tasks = [
        EpisodeTask(ROAD, driver(tuple(shifts)), seed)
        for shifts, seed in zip(drawn.tolist(), tuning_seeds(SURVEYED, FIRST), strict=True)
    ]
    times = [
        measure(episode)["travel_time"]
        for first in range(0, SURVEYED, MOST_MOTORWAYS)
        for episode in run_batch(tasks[first : first + MOST_MOTORWAYS], statistical=True)
    ]
    columns = np.hstack([np.ones((SURVEYED, 1)), drawn, drawn**2])
    found, *_ = np.linalg.lstsq(columns, np.array(times))
    left = np.array(times) - columns @ found
    variance = left @ left / (SURVEYED - columns.shape[1]) * np.linalg.inv(columns.T @ columns).diagonal()
    rows = zip(found[1 : 1 + STRETCHES], np.sqrt(variance[1 : 1 + STRETCHES]), strict=True)
    return [Shifted(float(slope), 1.96 * float(error)) for slope, error in rows]


def judged() -> dict[str, list[float]]:
    """Return the travel times of both in SUMO, seed by seed [s]."""
    drivers = {"unjam:on-ramp-tuned": driver((0.0,) * STRETCHES), "shifted": driver(CHOSEN)}
    with Simulation() as simulation:
        return {
            name: [
                measure(run_episode(ROAD, each, seed, simulation=simulation))["travel_time"]
                for seed in tuning_seeds(JUDGED, FIRST_JUDGED)
            ]
            for name, each in drivers.items()
        }


if __name__ == "__main__":
    stretches, times = surveyed(), judged()
    saved = estimate([shifted - tuned for tuned, shifted in zip(*times.values(), strict=True)])
    facts = {"manifest": manifest(), "stretches": [asdict(each) for each in stretches], "shifts": CHOSEN}
    facts |= {"shifted_beyond_tuned": asdict(saved), "travel_times": times}
    write_whole(Path(__file__).with_name("on-ramp-shifts.json"), to_json(facts, indent=1))
