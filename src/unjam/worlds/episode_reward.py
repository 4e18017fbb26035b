"""What a whole episode earned: a reward sees its decisions one by one, and need not hold hours of them."""

from collections.abc import Sequence

import numpy as np

from unjam.errors import InputError
from unjam.physics.arrays import Floats
from unjam.worlds.record import Trajectory
from unjam.worlds.reward import Outcome, Reward, time_gap

MAX_REWARD_CELLS = 4_000_000
"""decisions times vehicles that are asked about at once"""


def episode_reward_terms(
    reward: Reward, speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats
) -> dict[str, Floats]:
    """Return the terms of a reward in a whole episode, each of shape (T,).

    Speeds are of all vehicles, shape (T + 1, N), trajectories of CAVs. `crashed` says whether the last one
    ended so, `waiting` how many wanted to enter and could not, shape (T + 1,), or (0,) where nobody did.

    Raises:
        InputError: a term is not finite, or has not a value for each decision.
    """
    steps, rows = len(speeds) - 1, max(1, MAX_REWARD_CELLS // max(1, speeds.shape[1]))
    parts = [slice(start, min(start + rows, steps)) for start in range(0, max(steps, 1), rows)]
    found = [
        validate_reward_terms(
            reward(_step_outcomes(speeds, trajectories, has_crashed and part.stop == steps, backlog, part)), part
        )
        for part in parts
    ]
    return {name: np.concatenate([terms[name] for terms in found]) for name in found[0]}


def _step_outcomes(
    speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats, step_range: slice
) -> Outcome:
    """Return what a reward function sees of some decisions; `crashed` where the last of them ended so."""
    size = step_range.stop - step_range.start
    there = [
        each
        for each in trajectories
        if each.step_slice.start < step_range.stop and step_range.start < each.step_slice.stop
    ]
    accelerations, headways = (np.full((size, len(there)), np.nan) for _ in range(2))
    for column, each in enumerate(there):
        first, last = max(each.step_slice.start, step_range.start), min(each.step_slice.stop, step_range.stop)
        to, of = (
            slice(first - step_range.start, last - step_range.start),
            slice(first - each.start_step, last - each.start_step),
        )
        accelerations[to, column] = each.applied_acceleration[of]
        after = slice(of.start + 1, of.stop + 1)
        headways[to, column] = time_gap(each.states.leader_gap[after], each.states.speed[after])
    collided = np.zeros(size, bool)
    collided[-1:] = has_crashed
    kept_out = backlog[1:][step_range] if len(backlog) else np.zeros(size)
    # Columns one behind the other: sums over vehicles are rounded in the order of memory.
    return Outcome(np.asfortranarray(speeds[1:][step_range]), accelerations, headways, collided, kept_out)


def validate_reward_terms(terms: dict[str, Floats], step_range: slice) -> dict[str, Floats]:
    """Return the reward's terms; raise `InputError` unless each is finite and has a value per decision."""
    rows = step_range.stop - step_range.start
    for name, values in terms.items():
        if np.shape(values) != (rows,):
            raise InputError(f"reward: term {name!r} has shape {np.shape(values)}; allowed: ({rows},)")
        if not np.isfinite(values).all():
            row = int(np.argmax(~np.isfinite(values)))
            step = step_range.start + row
            raise InputError(f"reward: step {step}: term {name!r} is {values[row]}; allowed: finite")
    return {name: np.asarray(values, np.float64) for name, values in terms.items()}
