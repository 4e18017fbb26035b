"""Whether a CAV gains from being told how crowded it is where the ramp joins, before speeds tell of a jam.

`python results/tried/on_ramp_crowding.py` writes on-ramp-crowding.json beside itself, in half an hour: at 5 %
CAVs the law that was tuned longer, its cap lower by so much for each vehicle that is on the main road around
the ramp beyond the mean of the last three minutes. The same people on roads of a batch, tuning seeds.
"""

from pathlib import Path

import numpy as np
from on_ramp_told import Told

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Floats
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.batch.vehicles import Vehicles

AROUND, LATELY = (-500.0, 300.0), 180.0
"""from where to where vehicles crowd the ramp [m], and the time constant of their mean [s]"""
SLOPES = (0.0, -0.06, -0.12, 0.06)
"""of the cap, for a vehicle more [m/s]"""


class Counted(MotorwayBatch):
    """On-ramps where it is counted, and told in the place of a loop's length."""

    mean: Floats | None = None

    def _state(self, vehicles: Vehicles) -> LocalState:
        """Return what exact sensors would read, and by how many vehicles more there are than lately."""
        place = vehicles.place - self.roads[0].merge
        there = (vehicles.way > 0) & (place > AROUND[0]) & (place < AROUND[1])
        count = np.bincount(vehicles.road[there], minlength=len(self.roads)).astype(np.float64)
        mean = count if self.mean is None else self.mean
        self.mean = mean + (count - mean) * self.scenario.decision_step / LATELY
        return super()._state(vehicles)._replace(loop_length=(count - self.mean)[self.of_road])


CROWDING = Told(Counted, SLOPES, roads=192, first=11_000)

if __name__ == "__main__":
    CROWDING.write(Path(__file__).with_name("on-ramp-crowding.json"))
