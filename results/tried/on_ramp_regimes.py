"""Whether a CAV had better be held back otherwise where the road ahead is jammed than where it is not.

`python results/tried/on_ramp_regimes.py` writes on-ramp-regimes.json beside itself, in a quarter of an hour:
at 5 % CAVs the law that was tuned longer, with shifts of its cap by stretch of the way and by whether there
is a jam somewhere in the next 800 m of the own lane.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from on_ramp_survey import ShiftedJamAhead, Survey
from pydantic.dataclasses import dataclass

from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT

JAMMED, SECTIONS = 0.6, 8
"""share of the allowed speed below which a section is, and how many sections of 100 m are looked at"""
CHOSEN = (-1.0, 0.0, 0.0, 1.0, 0.5, 0.5, 1.0, 1.0)
"""from the ramp on upstream, where nothing is jammed ahead and then where something is [m/s]"""


@dataclass(frozen=True, config=STRICT)
class RegimeJamAhead(ShiftedJamAhead):
    """`jam-ahead` whose cap is shifted by where it is and by whether there is a jam ahead."""

    def case(self, state: LocalState) -> NDArray[np.bool_]:
        """Return whose lane is jammed ahead."""
        return state.lane_speeds[:, :SECTIONS].min(-1) < JAMMED * state.allowed_speed


SURVEY = Survey(RegimeJamAhead, 96, 9000, 9600, CHOSEN)

if __name__ == "__main__":
    SURVEY.write(Path(__file__).with_name("on-ramp-regimes.json"))
