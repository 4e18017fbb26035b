"""Whether CAVs on the ramp had better meter it: drive slower towards the road than the law asks, or freely.

`python results/tried/on_ramp_metering.py` writes on-ramp-metering.json beside itself, in ten minutes: at 5 %
CAVs the law that was tuned longer, its cap shifted on the ramp alone. The same people on roads of a batch,
tuning seeds.
"""

from pathlib import Path

import numpy as np
from on_ramp_told import Told

from unjam.drivers.local_state import LocalState
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.batch.vehicles import Vehicles, rows_of

SHIFTS = (0.0, 40.0, -4.0, -8.0, -12.0)
"""of the cap of those on the ramp [m/s]; with the second nobody is held back there"""


class Known(MotorwayBatch):
    """On-ramps that tell who is on the ramp, in the place of a loop's length."""

    def _state(self, vehicles: Vehicles) -> LocalState:
        """Return what exact sensors would read, and who is on the ramp."""
        on_ramp = (vehicles.way == 0) & (vehicles.place < self.roads[0].merge)
        ramp = on_ramp[rows_of(self._cavs, vehicles)].astype(np.float64)
        return super()._state(vehicles)._replace(loop_length=ramp)


METERING = Told(Known, SHIFTS, roads=96, first=13_000)

if __name__ == "__main__":
    METERING.write(Path(__file__).with_name("on-ramp-metering.json"))
