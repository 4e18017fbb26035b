"""Fitting the virtual environment to actual data, and how wrong it is afterwards: eps_m of Eq. 15."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.errors import UnjamError
from unjam.scenarios.scenario import Scenario
from unjam.traffic.record import Floats
from unjam.traffic.reward import make_reward
from unjam.virtual.base import base_reward, base_step
from unjam.virtual.data import Transitions
from unjam.virtual.model import NOISE_ROWS, NUMBERS, TARGETS, EnvironmentModel
from unjam.virtual.settings import VirtualSettings

SMALLEST_CHANGE = 1e-4
"""what varies by less than this is as good as constant [m/s, m, reward]"""


class OneStep(NamedTuple):
    """Root mean squares on the holdout, one step ahead [m/s, m, reward]."""

    base: float
    """error of the base alone"""
    model: float
    """error of a member of the ensemble, the base where it is better"""
    change: float
    """of what there was to predict: the change in the step, or the reward, about its mean"""


@dataclass(frozen=True)
class Fit:
    """What came of a fit."""

    errors: dict[str, float]
    """the model error eps_m by estimator.

    `unexplained`: mean square of the holdout error over the variance of the change, mean of the five numbers
    of the state. `total_variation`: between the distributions of the next state of a random member and of
    the ensemble's mean, erf(d / (2 sqrt 2)), averaged over the holdout, where d is how far a member is from
    the mean over the standard deviation of the noise; NaN with a single member. `released`: mean square
    of the training error in the last pass, in units of the targets' standard deviation, as in the authors'
    code.
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
    inputs, targets = inputs_of(actual), targets_of(actual, model.base, scenario, reward)
    training = _some(~actual.held_out, settings.fit_rows, generator)
    holdout = _some(actual.held_out, max(1, round(settings.fit_rows * settings.holdout)), generator)
    seen, wanted = (torch.as_tensor(values[training]).to(device) for values in (inputs, targets))
    model.normalise(seen, wanted, SMALLEST_CHANGE)
    left = targets[:, -1]
    model.reward_range.copy_(torch.tensor([left.min(), left.max()]))

    drawn = generator.integers(len(training), size=(settings.members, len(training)))
    bootstrap = training[drawn]
    last_loss, epochs = _descend(
        model,
        _normalised(model, inputs, targets, bootstrap),
        _normalised(model, inputs, targets, holdout),
        settings,
        generator,
    )
    return _judge(model, actual, inputs, targets, holdout, generator, last_loss, len(training), epochs)


def inputs_of(actual: Transitions) -> Floats:
    """Return what the networks see of actual decisions, as `model_inputs` does of virtual ones."""
    numbers = [getattr(actual.states, name) for name in NUMBERS]
    return np.column_stack([*numbers, actual.applied, actual.drawn])


def targets_of(actual: Transitions, base: str, scenario: Scenario, reward: str) -> Floats:
    """Return by how much what happened differs from what the base says, shape (rows, 6), SI units."""
    known = base_step(base, scenario, actual.states, actual.applied)
    earned = make_reward(reward or scenario.reward)
    known_reward = base_reward(base, earned, actual.following, actual.applied, actual.crashed)
    left = [getattr(actual.following, name) - getattr(known, name) for name in NUMBERS]
    return np.column_stack([*left, actual.reward - known_reward])


def _some(chosen: NDArray[np.bool_], most: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of at most so many of the chosen rows."""
    rows = np.flatnonzero(chosen)
    return generator.permutation(rows)[:most]


def _normalised(
    model: EnvironmentModel, inputs: Floats, targets: Floats, rows: NDArray[np.int64]
) -> tuple[Tensor, Tensor]:
    device = model.input_mean.device
    seen, wanted = (torch.as_tensor(values[rows]).to(device) for values in (inputs, targets))
    seen = (seen - model.input_mean) / model.input_scale
    wanted = (wanted - model.target_mean) / model.target_scale
    return seen.float(), wanted.float()


def _descend(
    model: EnvironmentModel,
    training: tuple[Tensor, Tensor],
    holdout: tuple[Tensor, Tensor],
    settings: VirtualSettings,
    generator: np.random.Generator,
) -> tuple[float, int]:
    """Train until the holdout does not improve; return the last training loss and the passes made."""
    seen, wanted = training
    device, rows = seen.device, seen.shape[1]
    parameters = [*model.weights, *model.biases]
    optimizer = torch.optim.Adam(parameters, lr=settings.rate, fused=True)
    best = [parameter.detach().clone() for parameter in parameters]
    best_loss, waited, passes, last_loss = _losses(model, *holdout), 0, 0, float("nan")
    while passes < settings.epochs and waited < settings.patience:
        order = torch.as_tensor(generator.permutation(rows)).to(device)
        total = torch.zeros((), device=device)
        for batch in order.split(settings.batch):
            loss = (model(seen[:, batch]) - wanted[:, batch]).square().mean((1, 2)).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.detach() * len(batch)
        passes += 1
        last_loss = total.item() / (rows * model.members)
        found = _losses(model, *holdout)
        if not (np.isfinite(last_loss) and found.isfinite().all()):
            raise UnjamError(f"virtual environment: the loss in pass {passes} of its fit is not finite")
        better = found < best_loss
        best_loss = torch.where(better, found, best_loss)
        waited = 0 if better.any() else waited + 1
        for kept, parameter in zip(best, parameters, strict=True):
            kept.copy_(torch.where(better[:, None, None], parameter.detach(), kept))
    with torch.no_grad():
        for kept, parameter in zip(best, parameters, strict=True):
            parameter.copy_(kept)
    return last_loss, passes


@torch.no_grad()
def _losses(model: EnvironmentModel, seen: Tensor, wanted: Tensor) -> Tensor:
    """Return each member's mean squared error, shape (members,)."""
    return (_answers(model, seen) - wanted).square().mean((1, 2))


@torch.no_grad()
def _answers(model: EnvironmentModel, seen: Tensor) -> Tensor:
    """Return what every member answers to the same rows, shape (members, rows, 6)."""
    return model(seen.expand(model.members, -1, -1))


def _judge(
    model: EnvironmentModel,
    actual: Transitions,
    inputs: Floats,
    targets: Floats,
    holdout: NDArray[np.int64],
    generator: np.random.Generator,
    last_loss: float,
    rows: int,
    epochs: int,
) -> Fit:
    """Measure the errors on the holdout; fall back to the base, and keep the noise, by them."""
    seen, _ = _normalised(model, inputs, targets, holdout)
    answers = _answers(model, seen) * model.target_scale + model.target_mean
    predicted = answers.double().cpu().numpy()  # (members, rows, 6)
    wanted = targets[holdout]
    base = np.sqrt(np.square(wanted).mean(0))
    learned = np.sqrt(np.square(wanted - predicted).mean((0, 1))) < base
    predicted = predicted * learned
    error = np.sqrt(np.square(wanted - predicted).mean((0, 1)))

    left = wanted - predicted.mean(0)
    noise = left[generator.integers(len(left), size=NOISE_ROWS)] - left.mean(0)
    model.learned.copy_(torch.as_tensor(learned))
    model.noise.copy_(torch.as_tensor(noise))

    changes = [getattr(actual.following, name) - getattr(actual.states, name) for name in NUMBERS]
    change = np.array([values[holdout].std() for values in [*changes, actual.reward]])
    one_step = {
        name: OneStep(float(base[i]), float(error[i]), float(change[i])) for i, name in enumerate(TARGETS)
    }
    errors = {
        "unexplained": unexplained([one_step[name] for name in NUMBERS]),
        "total_variation": total_variation(predicted[:, :, :-1], left[:, :-1].std(0)),
        "released": last_loss,
    }
    names = tuple(name for name, is_learned in zip(TARGETS, learned, strict=True) if is_learned)
    return Fit(errors, one_step, names, rows, len(holdout), epochs)


def unexplained(numbers: Sequence[OneStep]) -> float:
    """Return the model's squared error over the variance of the change, mean of the numbers of a state.

    A number that never changes is not wrong.
    """
    shares = [
        (step.model / step.change) ** 2 if step.change > SMALLEST_CHANGE else 0.0 for step in numbers
    ]
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
