"""Fitting the virtual environment to actual data, and how wrong it is afterwards: eps_m of Eq. 15."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch

from unjam.scenarios.scenario import Scenario
from unjam.virtual.data import Transitions
from unjam.virtual.ensemble import SMALLEST_CHANGE, Learned, teach
from unjam.virtual.model import (
    NOISE_ROWS,
    NUMBERS,
    TARGETS,
    EnvironmentModel,
    base_reward,
    base_step,
    model_inputs,
)
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.record import Floats
from unjam.worlds.reward import make_reward


class OneStep(NamedTuple):
    """Root mean squares on the holdout, one step ahead [m/s, m, reward]."""

    base: float
    """error of the base alone"""
    model: float
    """error of a member of the ensemble, the base where it is better"""
    change: float
    """of what there was to predict, about its mean: the change in the step, or the reward"""


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
        found = {}
        for column, name in enumerate(TARGETS):
            base, model, change = (each[..., column] for each in (self.base, self.model, self.change))
            found[name] = OneStep(root_mean_square(base), root_mean_square(model), float(change.std()))
        return found


@dataclass(frozen=True)
class Fit:
    """What came of a fit."""

    errors: dict[str, float]
    """the model error eps_m by estimator

    `unexplained`: mean square of the holdout error over the variance of the change, mean of the five numbers
    of the state. `transitions`: between the next speeds of leader and follower as a random member has them
    and as they were drawn, see `against_transitions`. `total_variation`: between the distributions of the
    next state of a random member and of the ensemble's mean, erf(d / (2 sqrt 2)), averaged over the holdout,
    where d is how far a member is from the mean over the standard deviation of the noise; NaN with a single
    member. `released`: mean square of the training error in the last pass, in units of the targets' standard
    deviation, as in the authors' code.
    """
    one_step: dict[str, OneStep]
    """by name of TARGETS"""
    learned: tuple[str, ...]
    """what the networks predict better than the base; of the rest the base is used alone"""
    rows: int
    """that each network learned from"""
    held_out: int
    """rows that none learned from"""
    epochs: int
    """passes over the rows"""


def fit(
    model: EnvironmentModel,
    actual: Transitions,
    settings: VirtualSettings,
    scenario: Scenario,
    reward: str,
    seed: Sequence[int],
) -> Fit:
    """Fit `model`, going on from what it is, to what the base leaves of the actual data.

    Every network learns from rows of its own, drawn with replacement once in a fit, and ends with the
    weights that were best on the holdout. The result depends on the arguments alone.

    Raises:
        UnjamError: a loss is not finite.
    """
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    device = model.input_mean.device
    inputs = torch.as_tensor(model_inputs(actual.states, actual.applied, actual.drawn)).to(device)
    targets = torch.as_tensor(targets_of(actual, model.base, scenario, reward)).to(device)
    model.reward_range.copy_(torch.stack([targets[:, -1].min(), targets[:, -1].max()]))
    found = teach(model, inputs, targets, actual.held_out, settings, generator)
    error = found.wanted - found.predicted.mean(0)
    noise = error[generator.integers(len(error), size=NOISE_ROWS)] - error.mean(0)
    model.noise.copy_(torch.as_tensor(noise))

    change = targets_of(actual.chosen(found.holdout), "none", scenario, reward)
    steps = OneStepErrors(found.wanted, found.predicted, change).by_number()
    errors = {
        "unexplained": unexplained([steps[name] for name in NUMBERS]),
        "transitions": _against_rows(found, actual.chosen(found.holdout), scenario),
        "total_variation": total_variation(found.predicted[:, :, :-1], error[:, :-1].std(0)),
        "released": found.loss,
    }
    names = tuple(itertools.compress(TARGETS, model.learned.tolist()))
    return Fit(errors, steps, names, found.rows, len(found.holdout), found.epochs)


def targets_of(actual: Transitions, base: str, scenario: Scenario, reward: str) -> Floats:
    """Return by how much what happened differs from what `base` says, shape (rows, 6), SI units.

    Of the base `none`, that is all there was to predict: by how much the state changed, and the reward.
    """
    known = base_step(base, scenario, actual.states, actual.applied)
    earned = make_reward(reward or scenario.reward)
    known_reward = base_reward(base, earned, actual.following, actual.applied, actual.crashed)
    residual = [getattr(actual.following, name) - getattr(known, name) for name in NUMBERS]
    return np.column_stack([*residual, actual.reward - known_reward])


def root_mean_square(values: Floats) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.square(values).mean()))


def unexplained(numbers: Sequence[OneStep]) -> float:
    """Return the model's squared error over the variance of the change, mean of the numbers of a state.

    A number that never changes is not wrong.
    """
    shares = [(step.model / step.change) ** 2 if step.change > SMALLEST_CHANGE else 0.0 for step in numbers]
    return sum(shares) / len(shares)


def against_transitions(wrong: Floats, noise: float) -> float:
    """Return the mean total variation between predicted and actual transitions, Gaussians as noisy.

    Source: eps_m of the paper's theorem A3; TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s)).

    Args:
        wrong: by how much the means of what is noisy were predicted wrongly, shape (..., numbers).
        noise: standard deviation of the noise that people have.
    """
    distance = torch.as_tensor(np.sqrt(np.square(wrong).sum(-1))) / max(noise, SMALLEST_CHANGE)
    return float(torch.erf(distance / (2.0 * sqrt(2.0))).mean())


def drawn_noise(actual: Transitions, scenario: Scenario) -> Floats | None:
    """Return what noise added to the speeds of leader and follower in each decision, shape (rows, 2).

    Where SUMO drives people it comes after they have moved, so that the way that they made says how fast they
    meant to drive. Where they are commanded it moves them too: nobody can tell, None.
    """
    if scenario.human_control != "native" or scenario.steps_per_decision > 1:
        return None
    state, then, step = actual.states, actual.following, scenario.simulation_step
    leader_moved = then.speed + (then.leader_gap - state.leader_gap) / step
    follower_moved = then.speed - (then.follower_gap - state.follower_gap) / step
    return np.column_stack([then.leader_speed - leader_moved, then.follower_speed - follower_moved])


def _against_rows(found: Learned, actual: Transitions, scenario: Scenario) -> float:
    """Return `against_transitions` of leader and follower on the holdout.

    Where the noise is not known it is the mean square of the errors beyond the noise's variance that counts.
    """
    columns = [TARGETS.index("leader_speed"), TARGETS.index("follower_speed")]
    wrong, noise = (found.wanted - found.predicted)[..., columns], drawn_noise(actual, scenario)
    sigma = scenario.noise_per_step * scenario.simulation_step
    if noise is None:
        beyond = np.square(wrong).mean((0, 1)) - sigma**2
        return against_transitions(np.sqrt(beyond.clip(0.0)), sigma)
    return against_transitions(wrong - noise, sigma)


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
