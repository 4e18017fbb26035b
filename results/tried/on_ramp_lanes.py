"""Whether CAVs on the left lane had better be held back otherwise than those on the right one.

`python results/tried/on_ramp_lanes.py` writes on-ramp-lanes.json beside itself, in a quarter of an hour: at
5 % CAVs the law that was tuned longer, with shifts of its cap by stretch of the way and by lane.
"""

from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from on_ramp_survey import ShiftedJamAhead, Survey
from pydantic.dataclasses import dataclass

from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.road_experts import JamAhead
from unjam.parameters import STRICT

CHOSEN = (0.0, 0.0, 0.0, 0.0, 0.3, 0.6, 1.2, 1.9)
"""from the ramp on upstream, on the left lane and then on the right one [m/s]"""


@dataclass(frozen=True, config=STRICT)
class LaneJamAhead(ShiftedJamAhead):
    """`jam-ahead` whose cap is shifted by where it is and on which lane."""

    told: ClassVar[tuple[str, ...]] = (*JamAhead.told, "beside_gaps")

    def case(self, state: LocalState) -> NDArray[np.bool_]:
        """Return who is on the right lane: somebody is on a lane at its left."""
        return (state.beside_gaps[:, :2] < LARGEST_GAP).any(-1)


SURVEY = Survey(LaneJamAhead, 128, 12000, 12600, CHOSEN)

if __name__ == "__main__":
    SURVEY.write(Path(__file__).with_name("on-ramp-lanes.json"))
