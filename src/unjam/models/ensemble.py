"""An ensemble of small networks as one batched network: what is learned of the virtual environment."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

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
"""what varies by less than this is as good as constant [SI units]"""
ROWS_PER_MEMBER = 64
"""rows that ask the same member of the ensemble at once"""

Layers = list[tuple[Tensor, Tensor]]
"""(weight of shape (members, inputs, outputs), bias of shape (members, 1, outputs)) of each layer"""


def torch_generator(seed: Sequence[int], device: torch.device | str) -> torch.Generator:
    """Return a generator of random numbers on `device` that depends on `seed` alone."""
    state = np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))


def predict(layers: Layers, inputs: Tensor, members: Tensor) -> Tensor:
    """Return the residual of the base, SI units, shape (n, outputs).

    Args:
        layers: of `Ensemble.layers`.
        inputs: SI units, shape (n, inputs).
        members: the member that answers each block of rows; the blocks are equally long but for the end.
    """
    n, blocks = len(inputs), len(members)
    size = -(-n // blocks)
    blocked = pad(inputs, (0, 0, 0, blocks * size - n)).view(blocks, size, -1)
    chosen = [(weight[members], bias[members]) for weight, bias in layers]
    return _apply_layers(chosen, blocked).view(blocks * size, -1)[:n]


def random_members(members: int, rows: int, generator: torch.Generator) -> Tensor:
    """Return a random member for each block of `rows` rows."""
    return torch.randint(members, (-(-rows // ROWS_PER_MEMBER),), generator=generator, device=generator.device)


def _apply_layers(layers: Layers, inputs: Tensor) -> Tensor:
    *hidden_layers, (weight, bias) = layers
    for hidden_weight, hidden_bias in hidden_layers:
        inputs = torch.baddbmm(hidden_bias, inputs, hidden_weight).relu_()
    return torch.baddbmm(bias, inputs, weight)


class Ensemble(nn.Module):
    """Networks that answer what some base leaves to be answered, each on its own.

    Unless the settings say otherwise their last layers start at zero, so that at first nothing is added to
    the base. What it remembers of its fits is in its buffers: `state_dict` is all of it.
    """

    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    output_mask: Tensor

    def __init__(
        self,
        settings: ModelSettings,
        inputs: int,
        outputs: int,
        seed: Sequence[int],
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        self.members = settings.members
        generator = torch_generator(seed, "cpu")
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for before, after in itertools.pairwise([inputs, *settings.hidden, outputs]):
            # as torch.nn.Linear begins
            draws = torch.rand((self.members, before + 1, after), generator=generator) * 2.0 - 1.0
            draws /= sqrt(before)
            self.weights.append(nn.Parameter(draws[:, :-1].contiguous()))
            self.biases.append(nn.Parameter(draws[:, -1:].contiguous()))
        if settings.fallback_to_base:
            nn.init.zeros_(self.weights[-1])
            nn.init.zeros_(self.biases[-1])
        self.register_buffer("input_mean", torch.zeros(inputs))
        self.register_buffer("input_scale", torch.ones(inputs))
        self.register_buffer("target_mean", torch.zeros(outputs))
        self.register_buffer("target_scale", torch.ones(outputs))
        self.register_buffer("output_mask", torch.zeros(outputs))  # 1 where the networks beat the base
        self.to(device)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return each member's answers, (members, n, outputs), to inputs of its own, (members, n, inputs).

        Or to the same, (n, inputs). Both are normalised: in units of their scale, from their mean.
        """
        layers = list(zip(self.weights, self.biases, strict=True))
        return _apply_layers(layers, inputs.expand(self.members, -1, -1))

    def normalize_inputs(self, inputs: Tensor) -> Tensor:
        """Return inputs in SI units as the networks take them."""
        return (inputs.float() - self.input_mean) / self.input_scale

    @torch.no_grad()
    def set_normalization(self, inputs: Tensor, targets: Tensor, min_std: float) -> None:
        """Take mean and standard deviation of `inputs` and `targets` as the new units, (rows, ...) in SI.

        First and last layers are written in the new units, so that the networks answer what they did. A
        standard deviation of a target below `smallest` counts as that. An input that varies by less, as the
        length of the ring does in a single episode, counts as constant: its normalised value is zero, for
        Adam would make long steps of rounding errors, and another value on the holdout would be far away.
        """
        varies = inputs.std(0) >= min_std
        mean = torch.where(varies, inputs.mean(0), inputs[0]).float()
        scale = torch.where(varies, inputs.std(0), 1.0).float()
        first, bias = self.weights[0], self.biases[0]
        bias += ((mean - self.input_mean) / self.input_scale)[None] @ first
        first *= (scale / self.input_scale)[:, None]
        self.input_mean.copy_(mean)
        self.input_scale.copy_(scale)

        mean, scale = targets.mean(0).float(), targets.std(0).clip(min_std).float()
        last, bias = self.weights[-1], self.biases[-1]
        last *= self.target_scale / scale
        bias.copy_((self.target_mean + self.target_scale * bias - mean) / scale)
        self.target_mean.copy_(mean)
        self.target_scale.copy_(scale)

    @torch.no_grad()
    def layers(self) -> Layers:
        """Return the layers in SI units, zero where the base is better: for `predict`."""
        weights = [weight.detach() for weight in self.weights]
        biases = [bias.detach() for bias in self.biases]
        biases[0] = biases[0] - (self.input_mean / self.input_scale)[None] @ weights[0]
        weights[0] = weights[0] / self.input_scale[:, None]
        weights[-1] = weights[-1] * (self.target_scale * self.output_mask)
        biases[-1] = (biases[-1] * self.target_scale + self.target_mean) * self.output_mask
        return list(zip(weights, biases, strict=True))

    @torch.no_grad()
    def member_predictions(self, inputs: Tensor) -> Floats:
        """Return what each member answers to the same rows, SI units, shape (members, rows, outputs).

        Also where the base is better.
        """
        answers = self(self.normalize_inputs(inputs)) * self.target_scale + self.target_mean
        return answers.double().cpu().numpy()


@dataclass(frozen=True)
class EnsembleFit:
    """What came of teaching an ensemble."""

    targets: Floats
    """what was to be answered on the holdout, SI units, shape (rows, outputs)"""
    predictions: Floats
    """of it, by each member; zero where the base alone is better, shape (members, rows, outputs)"""
    holdout_indices: NDArray[np.int64]
    """which rows these are"""
    loss: float
    """mean square of the training error in the last pass, in units of the targets' standard deviation"""
    epochs: int
    """passes over the rows"""
    training_rows: int
    """that each network learned from"""


def fit_ensemble(
    ensemble: Ensemble,
    inputs: Tensor,
    targets: Tensor,
    is_holdout: NDArray[np.bool_],
    settings: ModelSettings,
    generator: np.random.Generator,
) -> EnsembleFit:
    """Teach an ensemble, which goes on from what it is.

    Every network learns from rows of its own, drawn with replacement once, and ends with the weights that
    were best on the holdout. What is not answered better than by nothing there is left to the base, unless
    the settings do not let the networks fall back on it.

    Args:
        ensemble: is changed.
        inputs: SI units, shape (rows, inputs).
        targets: what the base leaves, SI units, shape (rows, outputs).
        held_out: rows that no network learns from, shape (rows,).
        settings: how.
        generator: of all that is drawn.

    Raises:
        UnjamError: a loss is not finite.
    """
    training = _sample_rows(~is_holdout, settings.max_fit_rows, generator)
    holdout = _sample_rows(is_holdout, max(1, round(settings.max_fit_rows * settings.holdout)), generator)
    ensemble.set_normalization(inputs[training], targets[training], MIN_CHANGE)
    bootstrap = training[generator.integers(len(training), size=(ensemble.members, len(training)))]
    seen, wanted = ensemble.normalize_inputs(inputs), ((targets - ensemble.target_mean) / ensemble.target_scale).float()
    learned_from, judged_by = ((seen[rows], wanted[rows]) for rows in (bootstrap, holdout))
    loss, epochs = _train(ensemble, learned_from, judged_by, settings, generator)
    asked, predicted = targets[holdout].cpu().numpy(), ensemble.member_predictions(inputs[holdout])
    learned = np.square(asked - predicted).mean((0, 1)) < np.square(asked).mean(0)
    learned |= not settings.fallback_to_base
    ensemble.output_mask.copy_(torch.as_tensor(learned))
    return EnsembleFit(asked, predicted * learned, holdout, loss, epochs, len(training))


def _sample_rows(mask: NDArray[np.bool_], max_rows: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of at most so many of the chosen rows."""
    rows = np.flatnonzero(mask)
    return generator.permutation(rows)[:max_rows]


def _train(
    ensemble: Ensemble,
    training: tuple[Tensor, Tensor],
    holdout: tuple[Tensor, Tensor],
    settings: ModelSettings,
    generator: np.random.Generator,
) -> tuple[float, int]:
    """Train until the holdout does not improve; return the last training loss and the passes made."""
    seen, wanted = training
    device, rows = seen.device, seen.shape[1]
    parameters = [*ensemble.weights, *ensemble.biases]
    optimizer = Adam(parameters, lr=settings.learning_rate, fused=True)
    best = [parameter.detach().clone() for parameter in parameters]
    best_loss, waited, passes, last_loss = _member_losses(ensemble, *holdout), 0, 0, float("nan")
    while passes < settings.epochs and waited < settings.patience:
        order = torch.as_tensor(generator.permutation(rows)).to(device)
        total = torch.zeros((), device=device)
        for batch in order.split(settings.batch_size):
            loss = (ensemble(seen[:, batch]) - wanted[:, batch]).square().mean((1, 2)).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.detach() * len(batch)
        passes += 1
        last_loss = total.item() / (rows * ensemble.members)
        found = _member_losses(ensemble, *holdout)
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
def _member_losses(ensemble: Ensemble, inputs: Tensor, targets: Tensor) -> Tensor:
    """Return each member's mean squared error, shape (members,)."""
    return (ensemble(inputs) - targets).square().mean((1, 2))
