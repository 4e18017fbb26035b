"""An ensemble of small networks, the learned part of a model: its computation, its fit, and its error eps_m."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pad

from unjam.adam import Adam
from unjam.errors import UnjamError
from unjam.models.settings import ModelSettings
from unjam.worlds.record import Floats

MIN_CHANGE = 1e-4
"""standard deviation below which a quantity counts as constant [SI units]"""
ROWS_PER_MEMBER = 64
"""consecutive rows that the same member of the ensemble predicts"""

Seed = Sequence[int]
Layers = list[tuple[Tensor, Tensor]]
"""weight, shape (members, inputs, outputs), and bias, shape (members, 1, outputs), of each layer"""


def torch_generator(seed: Seed, device: torch.device | str) -> torch.Generator:
    """Return a random number generator on `device` with a state that depends only on `seed`."""
    state = np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))


def predict(layers: Layers, inputs: Tensor, members: Tensor) -> Tensor:
    """Return the residuals of n rows of inputs, shape (n, outputs), SI units; each of `members` predicts a block."""
    n, block_count = len(inputs), len(members)
    size = -(-n // block_count)
    blocks = pad(inputs, (0, 0, 0, block_count * size - n)).view(block_count, size, -1)
    member_layers = [(weight[members], bias[members]) for weight, bias in layers]
    return _apply_layers(member_layers, blocks).view(block_count * size, -1)[:n]


def random_members(members: int, rows: int, generator: torch.Generator) -> Tensor:
    """Return a random member of the ensemble for each block of `ROWS_PER_MEMBER` rows."""
    return torch.randint(members, (-(-rows // ROWS_PER_MEMBER),), generator=generator, device=generator.device)


def _apply_layers(layers: Layers, inputs: Tensor) -> Tensor:
    *hidden_layers, (weight, bias) = layers
    for hidden_weight, hidden_bias in hidden_layers:
        inputs = torch.baddbmm(hidden_bias, inputs, hidden_weight).relu_()
    return torch.baddbmm(bias, inputs, weight)


class Ensemble(nn.Module):
    """Networks, each of which predicts the residual of a base; the residual starts at zero with `fallback_to_base`."""

    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    output_mask: Tensor
    """1 where the networks predict better than the base, shape (outputs,)"""

    def __init__(self, settings: ModelSettings, inputs: int, outputs: int, seed: Seed) -> None:
        super().__init__()
        self.members = settings.members
        generator = torch_generator(seed, "cpu")
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise([inputs, *settings.hidden, outputs]):
            draws = torch.rand((self.members, fan_in + 1, fan_out), generator=generator) * 2.0 - 1.0
            draws /= sqrt(fan_in)  # the initialization of torch.nn.Linear
            self.weights.append(nn.Parameter(draws[:, :-1].contiguous()))
            self.biases.append(nn.Parameter(draws[:, -1:].contiguous()))
        if settings.fallback_to_base:
            nn.init.zeros_(self.weights[-1])
            nn.init.zeros_(self.biases[-1])
        for name, size in {"input": inputs, "target": outputs}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("output_mask", torch.zeros(outputs))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return normalized predictions, (members, n, outputs), for normalized inputs, ([members,] n, inputs)."""
        layers = list(zip(self.weights, self.biases, strict=True))
        return _apply_layers(layers, inputs.expand(self.members, -1, -1))

    def normalize_inputs(self, inputs: Tensor) -> Tensor:
        """Return inputs in SI units as normalized inputs of the networks."""
        return (inputs.float() - self.input_mean) / self.input_scale

    @torch.no_grad()
    def set_normalization(self, inputs: Tensor, targets: Tensor) -> None:
        """Normalize by mean and standard deviation of `inputs` and `targets`, (rows, ...), with the same predictions.

        Inputs that vary by less than `MIN_CHANGE` become zero; otherwise rounding errors would cause large steps.
        """
        varies = inputs.std(0) >= MIN_CHANGE
        mean = torch.where(varies, inputs.mean(0), inputs[0]).float()
        scale = torch.where(varies, inputs.std(0), 1.0).float()
        first, bias = self.weights[0], self.biases[0]
        bias += ((mean - self.input_mean) / self.input_scale)[None] @ first
        first *= (scale / self.input_scale)[:, None]
        self.input_mean.copy_(mean)
        self.input_scale.copy_(scale)

        mean, scale = targets.mean(0).float(), targets.std(0).clip(MIN_CHANGE).float()
        last, bias = self.weights[-1], self.biases[-1]
        last *= self.target_scale / scale
        bias.copy_((self.target_mean + self.target_scale * bias - mean) / scale)
        self.target_mean.copy_(mean)
        self.target_scale.copy_(scale)

    @torch.no_grad()
    def layers(self) -> Layers:
        """Return the layers for `predict` in SI units; outputs that the base predicts better are zero."""
        weights = [weight.detach() for weight in self.weights]
        biases = [bias.detach() for bias in self.biases]
        biases[0] = biases[0] - (self.input_mean / self.input_scale)[None] @ weights[0]
        weights[0] = weights[0] / self.input_scale[:, None]
        weights[-1] = weights[-1] * (self.target_scale * self.output_mask)
        biases[-1] = (biases[-1] * self.target_scale + self.target_mean) * self.output_mask
        return list(zip(weights, biases, strict=True))

    @torch.no_grad()
    def member_predictions(self, inputs: Tensor) -> Floats:
        """Return unmasked predictions of all members for the same rows, SI units, shape (members, rows, outputs)."""
        predictions = self(self.normalize_inputs(inputs)) * self.target_scale + self.target_mean
        return predictions.double().cpu().numpy()


class EnsembleFit(NamedTuple):
    """The result of fitting an ensemble; SI units."""

    targets: Floats
    """residuals of the base on the holdout, shape (rows, outputs)"""
    predictions: Floats
    """predictions of the targets, zero for outputs with a better base, shape (members, rows, outputs)"""
    holdout_indices: NDArray[np.int64]
    loss: float
    """mean squared training error of the last epoch, in units of the targets' variance"""
    epochs: int
    training_rows: int


def fit_ensemble(
    ensemble: Ensemble,
    inputs: Tensor,
    targets: Tensor,
    is_holdout: NDArray[np.bool_],
    settings: ModelSettings,
    generator: np.random.Generator,
) -> EnsembleFit:
    """Continue to train `ensemble` on `inputs`, (rows, inputs), and residuals `targets`, (rows, outputs), in SI units.

    Each network is trained on a bootstrap sample of the rows that are not `is_holdout`, and keeps the weights that were
    best on the holdout. With `fallback_to_base`, outputs are masked if zero predicts the holdout as well. Raise
    `UnjamError` if a loss is not finite.
    """
    training = generator.permutation(np.flatnonzero(~is_holdout))[: settings.max_fit_rows]
    max_holdout_rows = max(1, round(settings.max_fit_rows * settings.holdout))
    holdout = generator.permutation(np.flatnonzero(is_holdout))[:max_holdout_rows]
    ensemble.set_normalization(inputs[training], targets[training])
    bootstrap = training[generator.integers(len(training), size=(ensemble.members, len(training)))]
    normalized = ensemble.normalize_inputs(inputs), ((targets - ensemble.target_mean) / ensemble.target_scale).float()
    training_set, holdout_set = ((normalized[0][rows], normalized[1][rows]) for rows in (bootstrap, holdout))
    loss, epochs = _train(ensemble, training_set, holdout_set, settings, generator)
    holdout_targets = targets[holdout].cpu().numpy()
    predictions = ensemble.member_predictions(inputs[holdout])
    is_better = np.square(holdout_targets - predictions).mean((0, 1)) < np.square(holdout_targets).mean(0)
    is_better |= not settings.fallback_to_base
    ensemble.output_mask.copy_(torch.as_tensor(is_better))
    return EnsembleFit(holdout_targets, predictions * is_better, holdout, loss, epochs, len(training))


def _train(
    ensemble: Ensemble,
    training_set: tuple[Tensor, Tensor],
    holdout_set: tuple[Tensor, Tensor],
    settings: ModelSettings,
    generator: np.random.Generator,
) -> tuple[float, int]:
    """Train the ensemble until the holdout loss stops improving; return the last training loss and number of epochs."""
    inputs, targets = training_set
    device, rows = inputs.device, inputs.shape[1]
    parameters = [*ensemble.weights, *ensemble.biases]
    optimizer = Adam(parameters, lr=settings.learning_rate, fused=True)
    best = [parameter.detach().clone() for parameter in parameters]
    best_loss, epochs_without_gain, epochs, last_loss = _member_losses(ensemble, *holdout_set), 0, 0, float("nan")
    while epochs < settings.epochs and epochs_without_gain < settings.patience:
        order = torch.as_tensor(generator.permutation(rows)).to(device)
        total = torch.zeros((), device=device)
        for batch in order.split(settings.batch_size):
            loss = (ensemble(inputs[:, batch]) - targets[:, batch]).square().mean((1, 2)).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.detach() * len(batch)
        epochs += 1
        last_loss = total.item() / (rows * ensemble.members)
        losses = _member_losses(ensemble, *holdout_set)
        if not (np.isfinite(last_loss) and losses.isfinite().all()):
            raise UnjamError(f"model: the loss of its fit is not finite in epoch {epochs}")
        is_better = losses < best_loss
        best_loss = torch.where(is_better, losses, best_loss)
        epochs_without_gain = 0 if is_better.any() else epochs_without_gain + 1
        for best_parameter, parameter in zip(best, parameters, strict=True):
            best_parameter.copy_(torch.where(is_better[:, None, None], parameter.detach(), best_parameter))
    with torch.no_grad():
        for best_parameter, parameter in zip(best, parameters, strict=True):
            parameter.copy_(best_parameter)
    return last_loss, epochs


@torch.no_grad()
def _member_losses(ensemble: Ensemble, inputs: Tensor, targets: Tensor) -> Tensor:
    return (ensemble(inputs) - targets).square().mean((1, 2))


class OneStepRMSE(NamedTuple):
    """One-step root mean squared errors on the holdout [m/s, m, reward]."""

    base: float
    model: float
    """error of the members of the ensemble; that of the base if it is better"""
    change: float
    """standard deviation of the predicted quantity: the change in the step, or the reward"""


@dataclass(frozen=True)
class ModelFit:
    """The result of fitting a model."""

    errors: dict[str, float]
    """the model error eps_m by estimator

    `unexplained_variance`: holdout mean squared error divided by the variance of the change, mean over `STATE_FIELDS`.
    `transitions`: total variation between the next speeds of leader and follower as predicted by a member and as drawn
    in the environment, see `transition_variation`. `total_variation`: mean over the holdout of the total variation
    between the next states as predicted by a member and by the ensemble mean; NaN for a single member. `training_loss`:
    mean squared training error of the last epoch, in units of the targets' variance, as in the authors' code.
    """
    one_step: dict[str, OneStepRMSE]
    """one-step errors by name of `TARGET_NAMES`"""
    learned_targets: tuple[str, ...]
    """targets that the networks predict better than the base; the base predicts the others"""
    training_rows: int
    """number of training rows of each network"""
    holdout_rows: int
    epochs: int


def root_mean_square(values: Floats) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.square(values).mean()))


def transition_variation(errors: Floats, noise: float) -> float:
    """Return eps_m of the paper's theorem A3 for Gaussians of std `noise` with mean `errors`, (..., quantities)."""
    return _gaussian_variation(np.sqrt(np.square(errors).sum(-1)) / max(noise, MIN_CHANGE))


def total_variation(predictions: Floats, noise: Floats) -> float:
    """Return the mean total variation, in [0, 1], between Gaussians around the predictions of a member and their mean.

    `predictions` have the shape (members, rows, quantities); `noise` is the standard deviation of all Gaussians,
    shape (quantities,). The result is NaN for one member.
    """
    if len(predictions) == 1:
        return float("nan")
    variance = predictions.var(0, ddof=1) / np.square(noise.clip(MIN_CHANGE))
    return _gaussian_variation(np.sqrt(variance.sum(-1)))


def _gaussian_variation(distance: Floats) -> float:
    """Return the mean total variation of unit Gaussians: TV(N(m1, s), N(m2, s)) = erf(|m1 - m2| / (2 sqrt 2 s))."""
    return float(torch.erf(torch.as_tensor(distance) / (2.0 * sqrt(2.0))).mean())
