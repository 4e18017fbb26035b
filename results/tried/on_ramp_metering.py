"""Whether CAVs on the ramp had better meter it: drive slower towards the road than the law asks, or freely.

`python results/tried/on_ramp_metering.py` writes on-ramp-metering.json beside itself, in ten minutes: at 5 %
CAVs the law that was tuned longer, its cap shifted on the ramp alone. The same people on roads of a batch,
tuning seeds.
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
from unjam.physics.arrays import Array
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.training.presets import ON_RAMP_LONG
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.batch.vehicles import Vehicles, rows_of
from unjam.worlds.drive import Drive, driven_to_the_end

ROAD = replace(ON_RAMP, cav_share=0.05)
SHIFTS = (0.0, 40.0, -4.0, -8.0, -12.0)
"""of the cap of those on the ramp [m/s]; with the second nobody is held back there"""
ROADS, FIRST, AT_ONCE = 96, 13_000, 32


class Known(MotorwayBatch):
    """On-ramps that tell who is on the ramp, in the place of what they have none of, a loop's length."""

    def _state(self, vehicles: Vehicles) -> LocalState:
        """Return what exact sensors would read, and who is on the ramp."""
        on_ramp = (vehicles.way == 0) & (vehicles.place < self.roads[0].merge)
        ramp = on_ramp[rows_of(self._cavs, vehicles)].astype(np.float64)
        return super()._state(vehicles)._replace(loop_length=ramp)


@settings(frozen=True, config=STRICT)
class Metering(JamAhead):
    """`jam-ahead` whose cap is shifted on the ramp."""

    shift: float = 0.0

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap."""
        shift = self.shift * state.loop_length
        return super().act(state._replace(lane_speeds=state.lane_speeds + shift[:, None]), memory)


def times_of(shift: float) -> NDArray[np.float64]:
    """Return the travel times of all roads [s]."""
    law = make_driver(ON_RAMP_LONG, ROAD.decision_step)
    assert isinstance(law, JamAhead)
    driver, found = Metering(**asdict(law), shift=shift), list[float]()
    for first in range(0, ROADS, AT_ONCE):
        world = Known(ROAD, tuning_seeds(AT_ONCE, FIRST + first))
        world.asked = driver.asks
        found += [measure(episode)["travel_time"] for episode in driven_to_the_end(Drive(world, driver))]
        print(shift, len(found), round(float(np.mean(found)), 2), flush=True)
    return np.array(found)


if __name__ == "__main__":
    about = manifest()
    plain, *others = map(times_of, SHIFTS)
    beyond = [asdict(estimate((each - plain).tolist())) for each in others]
    named = dict(zip(map(str, SHIFTS[1:]), beyond, strict=True))
    document = {"manifest": about, "plain": asdict(estimate(plain.tolist())), "beyond": named}
    write_whole(Path(__file__).with_name("on-ramp-metering.json"), to_json(document, indent=1))
