"""The reward of a whole episode, computed in parts: hours of traffic need not be in memory at once."""

from collections.abc import Sequence

import numpy as np

from unjam.errors import InputError
from unjam.physics.arrays import Floats
from unjam.worlds.record import Trajectory
from unjam.worlds.reward import Outcome, Reward, time_gap

MAX_REWARD_CELLS = 4_000_000
"""control steps times vehicles in one call of a reward function"""


def episode_reward_terms(
    reward: Reward, speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats
) -> dict[str, Floats]:
    """Return the terms of a reward in a whole episode, each of shape (T,); raise `InputError` if one is invalid.

    Speeds are those of all vehicles, shape (T + 1, N), trajectories those of CAVs. `has_crashed`: a collision ended the
    last control step. The insertion backlog has shape (T + 1,), or (0,) if there is none.
    """
    steps, rows = len(speeds) - 1, max(1, MAX_REWARD_CELLS // max(1, speeds.shape[1]))
    parts = [slice(start, min(start + rows, steps)) for start in range(0, max(steps, 1), rows)]
    terms = [
        validate_reward_terms(
            reward(_step_outcomes(speeds, trajectories, has_crashed and part.stop == steps, backlog, part)), part
        )
        for part in parts
    ]
    return {name: np.concatenate([each[name] for each in terms]) for name in terms[0]}


def _step_outcomes(
    speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats, step_range: slice
) -> Outcome:
    first, end = step_range.start, step_range.stop
    size = end - first
    cavs = [each for each in trajectories if each.step_slice.start < end and first < each.step_slice.stop]
    accelerations, time_gaps = (np.full((size, len(cavs)), np.nan) for _ in range(2))
    for column, cav in enumerate(cavs):
        start, stop = max(cav.start_step, first), min(cav.step_slice.stop, end)
        rows, steps = slice(start - first, stop - first), slice(start - cav.start_step, stop - cav.start_step)
        accelerations[rows, column] = cav.applied_acceleration[steps]
        after = slice(steps.start + 1, steps.stop + 1)
        time_gaps[rows, column] = time_gap(cav.states.leader_gap[after], cav.states.speed[after])
    crashed = np.zeros(size, bool)
    crashed[-1:] = has_crashed
    waiting = backlog[1:][step_range] if len(backlog) else np.zeros(size)
    # Column-major: the rounding of sums over vehicles depends on the order in memory.
    return Outcome(np.asfortranarray(speeds[1:][step_range]), accelerations, time_gaps, crashed, waiting)


def validate_reward_terms(terms: dict[str, Floats], step_range: slice) -> dict[str, Floats]:
    """Return a reward's terms; raise `InputError` unless each is finite and has one value per control step."""
    rows = step_range.stop - step_range.start
    for name, values in terms.items():
        if np.shape(values) != (rows,):
            raise InputError(f"reward: term {name!r} has shape {np.shape(values)}; allowed: ({rows},)")
        if not np.isfinite(values).all():
            row = int(np.argmax(~np.isfinite(values)))
            raise InputError(f"reward: step {step_range.start + row}: term {name!r} is {values[row]}; allowed: finite")
    return {name: np.asarray(values, np.float64) for name, values in terms.items()}
