"""What the on-ramp's longer tuned law gains where its cap follows something more that a CAV is told.

Surveys of what that might be share this: each has roads that tell it in the place of what on-ramps have none
of, a loop's length. The same people on roads of a batch at 5 % CAVs, tuning seeds.
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
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.drive import Drive, driven_to_the_end

ROAD = replace(ON_RAMP, cav_share=0.05)
AT_ONCE = 32


@settings(frozen=True, config=STRICT)
class ToldJamAhead(JamAhead):
    """`jam-ahead` whose cap follows what else it is told."""

    slope: float = 0.0
    """of the cap [m/s], for one more of it"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap."""
        shift = self.slope * state.loop_length
        return super().act(state._replace(lane_speeds=state.lane_speeds + shift[:, None]), memory)


@dataclass(frozen=True)
class Told:
    """Which roads tell what, and what of it is tried."""

    world: type[MotorwayBatch]
    slopes: Sequence[float]
    """the first is nothing"""
    roads: int
    first: int
    """of their tuning seeds"""

    def times_of(self, slope: float) -> NDArray[np.float64]:
        """Return the travel times of all roads [s]."""
        law = make_driver(ON_RAMP_LONG, ROAD.decision_step)
        assert isinstance(law, JamAhead)
        driver, found = ToldJamAhead(**asdict(law), slope=slope), list[float]()
        for first in range(0, self.roads, AT_ONCE):
            world = self.world(ROAD, tuning_seeds(AT_ONCE, self.first + first))
            world.asked = driver.asks
            found += [measure(episode)["travel_time"] for episode in driven_to_the_end(Drive(world, driver))]
            print(slope, len(found), round(float(np.mean(found)), 2), flush=True)
        return np.array(found)

    def write(self, path: Path) -> None:
        """Drive them, and write what each slope gains as JSON."""
        about = manifest()
        plain, *others = map(self.times_of, self.slopes)
        beyond = [asdict(estimate((each - plain).tolist())) for each in others]
        named = dict(zip(map(str, self.slopes[1:]), beyond, strict=True))
        document = {"manifest": about, "plain": asdict(estimate(plain.tolist())), "beyond": named}
        write_whole(path, to_json(document, indent=1))
