"""How wrong the model is: its errors one step ahead, and the estimators of eps_m in Eq. 15."""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch

from unjam.virtual.model import TARGETS
from unjam.worlds.record import Floats

SMALLEST_CHANGE = 1e-4
"""what varies by less than this is as good as constant [m/s, m, reward]"""


class OneStep(NamedTuple):
    """Root mean squares on the holdout, one step ahead [m/s, m, reward]."""

    base: float
    """error of the base alone"""
    model: float
    """error of a member of the ensemble, the base where it is better"""
    change: float
    """of what there was to predict, about its mean: the change in the step, or the reward"""


def one_step(wanted: Floats, predicted: Floats, changed: Floats) -> OneStep:
    """Return the errors of one number.

    Args:
        wanted: by how much it differs from what the base says, shape (rows,).
        predicted: by each member, shape (members, rows).
        changed: by how much it changed, shape (rows,).
    """
    return OneStep(root_mean_square(wanted), root_mean_square(wanted - predicted), float(changed.std()))


class OneStepErrors(NamedTuple):
    """By how much a decision was predicted wrongly [m/s, m, reward]; R rows, columns as TARGETS."""

    base: Floats
    """of the base alone, shape (R, 6)"""
    predicted: Floats
    """of these, by each member of the ensemble, shape (members, R, 6)"""
    change: Floats
    """what there was to predict: the change in the decision, and the reward, shape (R, 6)"""

    @property
    def model(self) -> Floats:
        """Of each member of the ensemble, shape (members, R, 6)."""
        return self.base - self.predicted

    def by_number(self) -> dict[str, OneStep]:
        """Return the root mean squares, by name of TARGETS."""
        columns = zip(TARGETS, self.base.T, np.moveaxis(self.predicted, -1, 0), self.change.T, strict=True)
        return {name: one_step(wanted, predicted, changed) for name, wanted, predicted, changed in columns}


def root_mean_square(values: Floats) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.square(values).mean()))


def unexplained(numbers: Sequence[OneStep]) -> float:
    """Return the model's squared error over the variance of the change, mean of the numbers of a state.

    A number that never changes is not wrong.
    """
    shares = [(step.model / step.change) ** 2 if step.change > SMALLEST_CHANGE else 0.0 for step in numbers]
    return sum(shares) / len(shares)


def total_variation(predicted: Floats, noise: Floats) -> float:
    """Return the mean total variation between Gaussians about a member's answer and about the mean of all.

    Source: TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s)).

    Args:
        predicted: by each member, shape (members, rows, numbers).
        noise: standard deviation of the noise that both have, shape (numbers,).

    Returns:
        In [0, 1]; NaN for a single member, of which nobody can tell how wrong it is.
    """
    if len(predicted) == 1:
        return float("nan")
    variance = predicted.var(0, ddof=1) / np.square(noise.clip(SMALLEST_CHANGE))
    distance = torch.as_tensor(np.sqrt(variance.sum(-1)))
    return float(torch.erf(distance / (2.0 * sqrt(2.0))).mean())
