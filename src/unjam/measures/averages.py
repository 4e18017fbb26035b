"""Averages over vehicles, steps and distance, from which metrics are made."""

from collections.abc import Callable, Iterator
from math import nan, prod
from typing import Any

import numpy as np

from unjam.physics.arrays import Floats
from unjam.worlds.record import Episode, Trajectory
from unjam.worlds.reward import MAX_REWARD_CELLS


def mean_over_cavs(episode: Episode, function: Callable[[Trajectory], Any]) -> float:
    """Return the mean of a function of the trips of all CAVs; NaN without any."""
    values = [function(trajectory) for trajectory in episode.trajectories]
    return float(np.mean(values)) if values else nan


def row_chunks(speeds: Floats) -> Iterator[Floats]:
    """Return the rows in chunks, so that hours of traffic are not copied as a whole."""
    rows = max(1, MAX_REWARD_CELLS // max(1, prod(speeds.shape[1:])))
    return (speeds[start : start + rows] for start in range(0, len(speeds), rows))


def mean_of_present(speeds: Floats, transform: Callable[[Floats], Any] = np.asarray) -> float:
    """Return the mean of `transform` over all vehicle-steps on the road; NaN without any."""
    total, count = 0.0, 0
    for chunk in row_chunks(speeds):
        present = chunk[~np.isnan(chunk)]
        total, count = total + float(transform(present).sum()), count + present.size
    return total / count if count else nan


def per_step(function: Callable[..., Floats], speeds: Floats) -> Floats:
    """Return `np.nanmean` or the like of each step; NaN for steps without vehicles."""
    results = []
    for chunk in row_chunks(speeds):
        occupied = ~np.isnan(chunk).all(axis=1)
        results.append(np.full(len(chunk), np.nan))
        results[-1][occupied] = function(chunk[occupied], axis=1)
    return np.concatenate([np.zeros(0), *results])
