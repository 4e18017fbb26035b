"""Fitting the virtual environment to actual data, and how wrong it is afterwards: eps_m of Eq. 15."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch

from unjam.models.ensemble import MIN_CHANGE, EnsembleFit, fit_ensemble
from unjam.models.environment_data import Transitions
from unjam.models.row_model import (
    NOISE_SAMPLES,
    STATE_FIELDS,
    TARGET_NAMES,
    RowModel,
    base_reward,
    base_step,
    model_inputs,
)
from unjam.models.settings import ModelSettings
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Floats
from unjam.worlds.reward import make_reward


class OneStepRMSE(NamedTuple):
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
    predictions: Floats
    """of these, by each member of the ensemble, shape (members, R, 6)"""
    change: Floats
    """what there was to predict: the change in the decision, and the reward, shape (R, 6)"""

    @property
    def model(self) -> Floats:
        """Of each member of the ensemble, shape (members, R, 6)."""
        return self.base - self.predictions

    def rmse_by_target(self) -> dict[str, OneStepRMSE]:
        """Return the root mean squares, by name of TARGETS."""
        found = {}
        for column, name in enumerate(TARGET_NAMES):
            base, model, change = (each[..., column] for each in (self.base, self.model, self.change))
            found[name] = OneStepRMSE(root_mean_square(base), root_mean_square(model), float(change.std()))
        return found


@dataclass(frozen=True)
class ModelFit:
    """What came of a fit."""

    errors: dict[str, float]
    """the model error eps_m by estimator

    `unexplained_variance`: mean square of the holdout error over the variance of the change, mean of the five numbers
    of the state. `transitions`: between the next speeds of leader and follower as a random member has them
    and as they were drawn, see `transition_variation`. `total_variation`: between the distributions of the
    next state of a random member and of the ensemble's mean, erf(d / (2 sqrt 2)), averaged over the holdout,
    where d is how far a member is from the mean over the standard deviation of the noise; NaN with a single
    member. `released_reward`: mean square of the training error in the last pass, in units of the targets' standard
    deviation, as in the authors' code.
    """
    one_step: dict[str, OneStepRMSE]
    """by name of TARGETS"""
    learned_targets: tuple[str, ...]
    """what the networks predict better than the base; of the rest the base is used alone"""
    training_rows: int
    """that each network learned from"""
    holdout_rows: int
    """rows that none learned from"""
    epochs: int
    """passes over the rows"""


def fit_row_model(
    model: RowModel,
    transitions: Transitions,
    settings: ModelSettings,
    scenario: Scenario,
    reward: str,
    seed: Sequence[int],
) -> ModelFit:
    """Fit `model`, going on from what it is, to what the base leaves of the actual data.

    Every network learns from rows of its own, drawn with replacement once in a fit, and ends with the
    weights that were best on the holdout. The result depends on the arguments alone.

    Raises:
        UnjamError: a loss is not finite.
    """
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    device = model.input_mean.device
    inputs = torch.as_tensor(model_inputs(transitions.states, transitions.acceleration, transitions.drawn_values)).to(
        device
    )
    targets = torch.as_tensor(residual_targets(transitions, model.base, scenario, reward)).to(device)
    model.reward_range.copy_(torch.stack([targets[:, -1].min(), targets[:, -1].max()]))
    found = fit_ensemble(model, inputs, targets, transitions.is_holdout, settings, generator)
    error = found.targets - found.predictions.mean(0)
    noise = error[generator.integers(len(error), size=NOISE_SAMPLES)] - error.mean(0)
    model.noise.copy_(torch.as_tensor(noise))

    change = residual_targets(transitions.select(found.holdout_indices), "none", scenario, reward)
    steps = OneStepErrors(found.targets, found.predictions, change).rmse_by_target()
    errors = {
        "unexplained_variance": unexplained_variance([steps[name] for name in STATE_FIELDS]),
        "transitions": _row_transition_variation(found, transitions.select(found.holdout_indices), scenario),
        "total_variation": total_variation(found.predictions[:, :, :-1], error[:, :-1].std(0)),
        "training_loss": found.loss,
    }
    names = tuple(itertools.compress(TARGET_NAMES, model.output_mask.tolist()))
    return ModelFit(errors, steps, names, found.training_rows, len(found.holdout_indices), found.epochs)


def residual_targets(transitions: Transitions, base: str, scenario: Scenario, reward: str) -> Floats:
    """Return by how much what happened differs from what `base` says, shape (rows, 6), SI units.

    Of the base `none`, that is all there was to predict: by how much the state changed, and the reward.
    """
    known = base_step(base, scenario, transitions.states, transitions.acceleration)
    earned = make_reward(reward or scenario.reward)
    known_reward = base_reward(base, earned, transitions.next_states, transitions.acceleration, transitions.crashed)
    residual = [getattr(transitions.next_states, name) - getattr(known, name) for name in STATE_FIELDS]
    return np.column_stack([*residual, transitions.reward - known_reward])


def root_mean_square(values: Floats) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.square(values).mean()))


def unexplained_variance(one_step: Sequence[OneStepRMSE]) -> float:
    """Return the model's squared error over the variance of the change, mean of the numbers of a state.

    A number that never changes is not wrong.
    """
    shares = [(step.model / step.change) ** 2 if step.change > MIN_CHANGE else 0.0 for step in one_step]
    return sum(shares) / len(shares)


def transition_variation(errors: Floats, noise: float) -> float:
    """Return the mean total variation between predicted and actual transitions, Gaussians as noisy.

    Source: eps_m of the paper's theorem A3; TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s)).

    Args:
        wrong: by how much the means of what is noisy were predicted wrongly, shape (..., numbers).
        noise: standard deviation of the noise that people have.
    """
    distance = torch.as_tensor(np.sqrt(np.square(errors).sum(-1))) / max(noise, MIN_CHANGE)
    return float(torch.erf(distance / (2.0 * sqrt(2.0))).mean())


def recorded_noise(transitions: Transitions, scenario: Scenario) -> Floats | None:
    """Return what noise added to the speeds of leader and follower in each decision, shape (rows, 2).

    Where SUMO drives people it comes after they have moved, so that the way that they made says how fast they
    meant to drive. Where they are commanded it moves them too: nobody can tell, None.
    """
    if scenario.human_control != "native" or scenario.steps_per_control_step > 1:
        return None
    state, then, step = transitions.states, transitions.next_states, scenario.simulation_step
    leader_moved = then.speed + (then.leader_gap - state.leader_gap) / step
    follower_moved = then.speed - (then.follower_gap - state.follower_gap) / step
    return np.column_stack([then.leader_speed - leader_moved, then.follower_speed - follower_moved])


def _row_transition_variation(ensemble_fit: EnsembleFit, transitions: Transitions, scenario: Scenario) -> float:
    """Return `transition_variation` of leader and follower on the holdout.

    Where the noise is not known it is the mean square of the errors beyond the noise's variance that counts.
    """
    columns = [TARGET_NAMES.index("leader_speed"), TARGET_NAMES.index("follower_speed")]
    wrong, noise = (
        (ensemble_fit.targets - ensemble_fit.predictions)[..., columns],
        recorded_noise(transitions, scenario),
    )
    sigma = scenario.noise_per_step * scenario.simulation_step
    if noise is None:
        beyond = np.square(wrong).mean((0, 1)) - sigma**2
        return transition_variation(np.sqrt(beyond.clip(0.0)), sigma)
    return transition_variation(wrong - noise, sigma)


def total_variation(predictions: Floats, noise: Floats) -> float:
    """Return the mean total variation between Gaussians about a member's answer and about the mean of all.

    Source: TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s)).

    Args:
        predicted: by each member, shape (members, rows, numbers).
        noise: standard deviation of the noise that both have, shape (numbers,).

    Returns:
        In [0, 1]; NaN for a single member, of which nobody can tell how wrong it is.
    """
    if len(predictions) == 1:
        return float("nan")
    variance = predictions.var(0, ddof=1) / np.square(noise.clip(MIN_CHANGE))
    distance = torch.as_tensor(np.sqrt(variance.sum(-1)))
    return float(torch.erf(distance / (2.0 * sqrt(2.0))).mean())
