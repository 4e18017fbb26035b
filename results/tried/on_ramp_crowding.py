"""Whether a CAV gains from being told how crowded it is where the ramp joins, before speeds tell of a jam.

`python results/tried/on_ramp_crowding.py` writes on-ramp-crowding.json beside itself, in half an hour: at 5 %
CAVs the law that was tuned longer, its cap lower by so much for each vehicle that is on the main road around
the ramp beyond the mean of the last three minutes. The same people on roads of a batch, tuning seeds.
"""

from dataclasses import asdict, replace
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
from unjam.physics.arrays import Array, Floats
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.training.presets import ON_RAMP_LONG
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.batch.vehicles import Vehicles
from unjam.worlds.drive import Drive, driven_to_the_end

ROAD = replace(ON_RAMP, cav_share=0.05)
AROUND, LATELY = (-500.0, 300.0), 180.0
"""from where to where vehicles crowd the ramp [m], and the time constant of their mean [s]"""
SLOPES = (0.0, -0.06, -0.12, 0.06)
"""of the cap, for a vehicle more [m/s]"""
ROADS, FIRST, AT_ONCE = 192, 11_000, 32


class Counted(MotorwayBatch):
    """On-ramps where it is counted, and told in the place of what they have none of, a loop's length."""

    mean: Floats | None = None

    def _state(self, vehicles: Vehicles) -> LocalState:
        """Return what exact sensors would read, and by how many vehicles more there are than lately."""
        place = vehicles.place - self.roads[0].merge
        there = (vehicles.way > 0) & (place > AROUND[0]) & (place < AROUND[1])
        count = np.bincount(vehicles.road[there], minlength=len(self.roads)).astype(np.float64)
        mean = count if self.mean is None else self.mean
        self.mean = mean + (count - mean) * self.scenario.decision_step / LATELY
        return super()._state(vehicles)._replace(loop_length=(count - self.mean)[self.of_road])


@settings(frozen=True, config=STRICT)
class CrowdedJamAhead(JamAhead):
    """`jam-ahead` whose cap follows how crowded it is where the ramp joins."""

    slope: float = 0.0

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap."""
        shift = self.slope * state.loop_length
        return super().act(state._replace(lane_speeds=state.lane_speeds + shift[:, None]), memory)


def times_of(slope: float) -> NDArray[np.float64]:
    """Return the travel times of all roads [s]."""
    law = make_driver(ON_RAMP_LONG, ROAD.decision_step)
    assert isinstance(law, JamAhead)
    driver, found = CrowdedJamAhead(**asdict(law), slope=slope), list[float]()
    for first in range(0, ROADS, AT_ONCE):
        world = Counted(ROAD, tuning_seeds(AT_ONCE, FIRST + first))
        world.asked = driver.asks
        found += [measure(episode)["travel_time"] for episode in driven_to_the_end(Drive(world, driver))]
        print(slope, len(found), round(float(np.mean(found)), 2), flush=True)
    return np.array(found)


if __name__ == "__main__":
    about = manifest()
    plain, *others = map(times_of, SLOPES)
    beyond = [asdict(estimate((each - plain).tolist())) for each in others]
    named = dict(zip(map(str, SLOPES[1:]), beyond, strict=True))
    document = {"manifest": about, "plain": asdict(estimate(plain.tolist())), "beyond": named}
    write_whole(Path(__file__).with_name("on-ramp-crowding.json"), to_json(document, indent=1))
