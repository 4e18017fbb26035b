"""Fitting the row model to environment data, and measuring its error eps_m of Eq. 15."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
import torch

from unjam.models.ensemble import MIN_CHANGE, EnsembleFit, Seed, fit_ensemble
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
    """One-step root mean squared errors on the holdout [m/s, m, reward]."""

    base: float
    """of the base alone"""
    model: float
    """of a member of the ensemble; of the base where it is better"""
    change: float
    """standard deviation of what is predicted: the change in the step, or the reward"""


class OneStepErrors(NamedTuple):
    """One-step prediction errors [m/s, m, reward]; R rows, columns as `TARGET_NAMES`."""

    base: Floats
    """of the base alone, shape (R, 6)"""
    predictions: Floats
    """of these errors, by each member of the ensemble, shape (members, R, 6)"""
    change: Floats
    """what is predicted: the change in the step, and the reward, shape (R, 6)"""

    @property
    def model(self) -> Floats:
        """Errors of each member of the ensemble, shape (members, R, 6)."""
        return self.base - self.predictions

    def rmse_by_target(self) -> dict[str, OneStepRMSE]:
        """Return the root mean squared errors, by name of `TARGET_NAMES`."""
        parts = (np.moveaxis(each, -1, 0) for each in (self.base, self.model, self.change))
        return {
            name: OneStepRMSE(root_mean_square(base), root_mean_square(model), float(change.std()))
            for name, base, model, change in zip(TARGET_NAMES, *parts, strict=True)
        }


@dataclass(frozen=True)
class ModelFit:
    """The result of a fit."""

    errors: dict[str, float]
    """the model error eps_m by estimator

    `unexplained_variance`: holdout mean squared error divided by the variance of the change, mean over `STATE_FIELDS`.
    `transitions`: total variation between the next speeds of leader and follower as predicted by a member and as
    drawn, see `transition_variation`. `total_variation`: between the distributions of the next state predicted by a
    member and by the ensemble mean, averaged over the holdout; NaN for a single member. `training_loss`: mean squared
    training error of the last epoch, in units of the targets' variance, as in the authors' code.
    """
    one_step: dict[str, OneStepRMSE]
    """by name of `TARGET_NAMES`"""
    learned_targets: tuple[str, ...]
    """targets that the networks predict better than the base; the others are left to the base"""
    training_rows: int
    """per network"""
    holdout_rows: int
    epochs: int


def fit_row_model(
    model: RowModel, transitions: Transitions, settings: ModelSettings, scenario: Scenario, reward: str, seed: Seed
) -> ModelFit:
    """Fit `model` further, in place, see `fit_ensemble`; the result depends on the arguments alone."""
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    to_device: Any = {"device": model.input_mean.device}
    columns = model_inputs(transitions.states, transitions.acceleration, transitions.drawn_values)
    targets = torch.as_tensor(residual_targets(transitions, model.base, scenario, reward), **to_device)
    model.reward_range.copy_(torch.stack([targets[:, -1].min(), targets[:, -1].max()]))
    inputs = torch.as_tensor(columns, **to_device)
    fit = fit_ensemble(model, inputs, targets, transitions.is_holdout, settings, generator)
    error = fit.targets - fit.predictions.mean(0)
    noise = error[generator.integers(len(error), size=NOISE_SAMPLES)] - error.mean(0)
    model.noise.copy_(torch.as_tensor(noise))

    holdout = transitions.select(fit.holdout_indices)
    change = residual_targets(holdout, "none", scenario, reward)
    one_step = OneStepErrors(fit.targets, fit.predictions, change).rmse_by_target()
    errors = {
        "unexplained_variance": unexplained_variance([one_step[name] for name in STATE_FIELDS]),
        "transitions": _row_transition_variation(fit, holdout, scenario),
        "total_variation": total_variation(fit.predictions[:, :, :-1], error[:, :-1].std(0)),
        "training_loss": fit.loss,
    }
    learned = tuple(itertools.compress(TARGET_NAMES, model.output_mask.tolist()))
    return ModelFit(errors, one_step, learned, fit.training_rows, len(fit.holdout_indices), fit.epochs)


def residual_targets(transitions: Transitions, base: str, scenario: Scenario, reward: str) -> Floats:
    """Return the residuals of `base`, (rows, 6), SI units; of `none`, the change of the state, and the reward."""
    states, next_states, acceleration = transitions.states, transitions.next_states, transitions.acceleration
    predicted = base_step(base, scenario, states, acceleration)
    reward_function = make_reward(reward or scenario.reward)
    predicted_reward = base_reward(base, reward_function, next_states, acceleration, transitions.crashed)
    residual = [getattr(next_states, name) - getattr(predicted, name) for name in STATE_FIELDS]
    return np.column_stack([*residual, transitions.reward - predicted_reward])


def root_mean_square(values: Floats) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.square(values).mean()))


def unexplained_variance(one_step: Sequence[OneStepRMSE]) -> float:
    """Return the mean ratio of squared error to variance; a constant quantity counts as predicted."""
    ratios = [(step.model / step.change) ** 2 if step.change > MIN_CHANGE else 0.0 for step in one_step]
    return sum(ratios) / len(ratios)


def transition_variation(errors: Floats, noise: float) -> float:
    """Return eps_m of the paper's theorem A3: Gaussians of std `noise`, means with `errors`, (..., quantities)."""
    return _gaussian_variation(np.sqrt(np.square(errors).sum(-1)) / max(noise, MIN_CHANGE))


def total_variation(predictions: Floats, noise: Floats) -> float:
    """Return the mean total variation, in [0, 1], between Gaussians around a member's prediction and around the mean.

    `predictions` has shape (members, rows, quantities), `noise`, the standard deviation of both, (quantities,). It is
    NaN for a single member, since its error is unknown.
    """
    if len(predictions) == 1:
        return float("nan")
    variance = predictions.var(0, ddof=1) / np.square(noise.clip(MIN_CHANGE))
    return _gaussian_variation(np.sqrt(variance.sum(-1)))


def _gaussian_variation(distance: Floats) -> float:
    """Return the mean total variation of unit Gaussians: TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s))."""
    return float(torch.erf(torch.as_tensor(distance) / (2.0 * sqrt(2.0))).mean())


def recorded_noise(transitions: Transitions, scenario: Scenario) -> Floats | None:
    """Return what noise added to the speeds of leader and follower in each control step, shape (rows, 2).

    SUMO's drivers add it after they have moved, so that their distance gives the intended speed. Noise moves commanded
    drivers too: then it is unknown, None.
    """
    if scenario.human_control != "native" or scenario.steps_per_control_step > 1:
        return None
    state, following, step = transitions.states, transitions.next_states, scenario.simulation_step
    leader_intended = following.speed + (following.leader_gap - state.leader_gap) / step
    follower_intended = following.speed - (following.follower_gap - state.follower_gap) / step
    return np.column_stack([following.leader_speed - leader_intended, following.follower_speed - follower_intended])


def _row_transition_variation(fit: EnsembleFit, transitions: Transitions, scenario: Scenario) -> float:
    """Return `transition_variation` of leader and follower; unknown noise is subtracted from the errors' variance."""
    columns = [TARGET_NAMES.index("leader_speed"), TARGET_NAMES.index("follower_speed")]
    errors = (fit.targets - fit.predictions)[..., columns]
    noise, sigma = recorded_noise(transitions, scenario), scenario.noise_per_step * scenario.simulation_step
    if noise is not None:
        return transition_variation(errors - noise, sigma)
    excess = np.square(errors).mean((0, 1)) - sigma**2
    return transition_variation(np.sqrt(excess.clip(0.0)), sigma)
