"""Averages over CAVs, vehicles and steps, from which metrics are computed."""

from collections.abc import Callable, Iterator
from math import nan, prod
from typing import Any

import numpy as np

from unjam.physics.arrays import Floats
from unjam.worlds.record import Episode, Trajectory
from unjam.worlds.reward import MAX_REWARD_CELLS


def mean_over_cavs(episode: Episode, function: Callable[[Trajectory], Any]) -> float:
    """Return the mean over all CAVs of a function of their trajectories; NaN without CAVs."""
    values = [function(trajectory) for trajectory in episode.trajectories]
    return float(np.mean(values)) if values else nan


def row_chunks(speeds: Floats) -> Iterator[Floats]:
    """Return the rows in chunks, so that a step with hours of traffic needs little memory."""
    size = max(1, MAX_REWARD_CELLS // max(1, prod(speeds.shape[1:])))
    return (speeds[start : start + size] for start in range(0, len(speeds), size))


def mean_over_vehicle_steps(speeds: Floats, transform: Callable[[Floats], Any] = np.asarray) -> float:
    """Return the mean of `transform` over all vehicles on the road in all steps; NaN without vehicles."""
    total, count = 0.0, 0
    for chunk in row_chunks(speeds):
        present = chunk[~np.isnan(chunk)]
        total, count = total + float(transform(present).sum()), count + present.size
    return total / count if count else nan


def reduce_steps(function: Callable[..., Floats], speeds: Floats) -> Floats:
    """Return a statistic of each step, such as `np.nanmean`, shape (steps,); NaN for steps without vehicles."""
    statistics = []
    for chunk in row_chunks(speeds):
        occupied = ~np.isnan(chunk).all(axis=1)
        statistics.append(np.full(len(chunk), np.nan))
        statistics[-1][occupied] = function(chunk[occupied], axis=1)
    return np.concatenate([np.zeros(0), *statistics])
