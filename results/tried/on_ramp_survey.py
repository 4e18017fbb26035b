"""What shifts of the on-ramp's longer tuned law are worth: pairs of roads with opposite ones, then a choice.

Surveys of what else the cap might depend on share this; each says by which of its shifts a CAV is held back.
Roads of a batch at 5 % CAVs, tuning seeds.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
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
from unjam.training.presets import ON_RAMP_LONG
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.run import run_batches
from unjam.worlds.workers import EpisodeTask

ROAD = replace(ON_RAMP, cav_share=0.05)
ENDS = np.array([250.0, 500.0, 1000.0])
"""of the stretches, the last of which goes on [m before the ramp]"""
SPREAD = 1.5
"""standard deviation of the shifts [m/s]"""
STRENGTHS, JUDGED = (0.0, 0.6, 1.2, 2.0), 96


@settings(frozen=True, config=STRICT)
class ShiftedJamAhead(JamAhead):
    """`jam-ahead` whose cap is shifted by where it is and in which of two cases."""

    shifts: tuple[float, ...] = (0.0,) * 2 * (len(ENDS) + 1)
    """of the stretches from the ramp on upstream, first those of the other case [m/s]"""

    def case(self, state: LocalState) -> NDArray[np.bool_]:
        """Return for each CAV whether it is in the case whose shifts come second, shape (n,)."""
        raise NotImplementedError

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the shifted cap."""
        stretch = np.searchsorted(ENDS, state.to_merge) + (len(ENDS) + 1) * self.case(state)
        moved = state._replace(lane_speeds=state.lane_speeds + np.array(self.shifts)[stretch][:, None])
        return super().act(moved, memory)


@dataclass(frozen=True)
class Survey:
    """Which law is surveyed, by how many pairs, and what is chosen of what they say."""

    law: type[ShiftedJamAhead]
    pairs: int
    first: int
    """of the pairs' tuning seeds"""
    first_judged: int
    """of those on which the choice is judged"""
    chosen: Sequence[float]
    """shifts, read off the slopes [m/s]"""

    def times_of(self, shifts: NDArray[np.float64], seeds: list[tuple[int, ...]]) -> NDArray[np.float64]:
        """Return the travel times with sets of shifts, shape (seeds, sets, 8), as (seeds, sets) [s]."""
        tuned = make_driver(ON_RAMP_LONG, ROAD.decision_step)
        assert isinstance(tuned, JamAhead)
        tasks = [
            EpisodeTask(ROAD, self.law(**asdict(tuned), shifts=tuple(each)), seed)
            for sets, seed in zip(shifts.round(4).tolist(), seeds, strict=True)
            for each in sets
        ]
        found = [measure(episode)["travel_time"] for episode in run_batches(tasks, statistical=True)]
        return np.reshape(found, shifts.shape[:2])

    def write(self, path: Path) -> None:
        """Make the survey, and write what it says as JSON."""
        drawn = np.random.default_rng(5).normal(0.0, SPREAD, (self.pairs, len(self.chosen)))
        up, down = self.times_of(np.stack([drawn, -drawn], 1), tuning_seeds(self.pairs, self.first)).T
        half = (up - down) / 2.0
        slopes, *_ = np.linalg.lstsq(drawn, half)
        left = half - drawn @ slopes
        variance = left @ left / (self.pairs - len(self.chosen))
        errors = np.sqrt(variance * np.linalg.inv(drawn.T @ drawn).diagonal())
        strengths = np.outer(STRENGTHS, self.chosen)
        times = self.times_of(np.stack([strengths] * JUDGED), tuning_seeds(JUDGED, self.first_judged))
        facts = {
            "manifest": manifest(),
            "slopes": [
                {"slope": float(slope), "half_width": 1.96 * float(error)}
                for slope, error in zip(slopes, errors, strict=True)
            ],
            "shifts": self.chosen,
            "travel_times": {
                f"{strength:g}": column.tolist() for strength, column in zip(STRENGTHS, times.T, strict=True)
            },
            "beyond_none": {
                f"{strength:g}": asdict(estimate((column - times[:, 0]).tolist()))
                for strength, column in list(zip(STRENGTHS, times.T, strict=True))[1:]
            },
        }
        write_whole(path, to_json(facts, indent=1))
