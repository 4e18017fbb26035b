"""How people drive, as far as it is seen: the IDM calibrated on those who drove behind the CAVs."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from unjam.following.calibration import CalibrationSettings, calibrate
from unjam.following.pairs import Pair
from unjam.physics.idm import IDMParameters
from unjam.scenarios.scenario import Scenario
from unjam.virtual.base import absent
from unjam.virtual.data import Recording

SHORTEST = 20.0
"""drives behind a CAV that are shorter tell too little [s]"""
LONGEST_JUMP = 0.5
"""change of the gap in a decision that speeds do not explain, beyond which another vehicle is behind [m]"""
SEARCH = CalibrationSettings(candidates=4, generations=40)


def people_behind(recordings: Sequence[Recording], scenario: Scenario) -> list[Pair]:
    """Return the drives of those who followed a CAV, each of the same vehicle throughout."""
    step, pairs = scenario.decision_step, []
    for number, recording in enumerate(recordings):
        states = recording.states
        _, nobody = absent(states)
        expected = states.follower_gap[:-1] + (states.speed[1:] - states.follower_speed[1:]) * step
        other = np.abs(states.follower_gap[1:] - expected) > LONGEST_JUMP
        ends = np.flatnonzero(np.r_[True, other | nobody[1:] | nobody[:-1], True])
        for first, last in pairwise(ends):
            if (last - first) * step >= SHORTEST:
                cut = slice(first, last)
                own, leader, gap = (
                    np.asarray(values[cut], np.float64)
                    for values in (states.follower_speed, states.speed, states.follower_gap)
                )
                name = f"{number}-{first}"
                pairs.append(Pair(name, name, step, own, leader, gap))
    return pairs


def calibrated_people(recordings: Sequence[Recording], scenario: Scenario) -> IDMParameters:
    """Return the IDM parameters that suit the people behind the CAVs best; the scenario's where nobody was.

    Desired speed and smallest gap stay the scenario's: in traffic that moves slowly nobody shows them.
    """
    pairs, known = people_behind(recordings, scenario), scenario.humans
    if not pairs:
        return known
    speed, gap = known.desired_speed, known.minimum_gap
    found = calibrate(pairs, replace(SEARCH, desired_speed=(speed, speed), minimum_gap=(gap, gap)))
    return replace(found.parameters, exponent=known.exponent)
