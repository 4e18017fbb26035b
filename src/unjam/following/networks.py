"""Networks that drive: alone (`vanilla`), or as the residual on a base (`knowledge`, Eq. 4 of the paper).

A network that learned single accelerations (`fit_one_step`) has never seen where its own small errors lead.
In `fit_multi_step` the loss is the error of the simulated gap, and its gradient runs back through every step
behind a recorded leader.
"""

import itertools
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from unjam.adam import Adam
from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.following.open_loop import (
    AccelerationBounds,
    AccelerationFunction,
    DriverModel,
    ResidualFunction,
    add_residual,
    follow_leader,
    individual_idm,
    simulate_open_loop,
)
from unjam.following.pairs import (
    SEGMENT_FIELDS,
    Floats,
    FollowingSamples,
    Pair,
    Segments,
    following_samples,
    make_segments,
)
from unjam.following.settings import MultiStepSettings, NetworkSettings
from unjam.physics.idm import IDMArrays, IDMParameters, stack_idm_parameters
from unjam.scenarios.population import RESIDUAL_INPUTS, residual_inputs

MEAN_SQUARE_OFFSET = 1e-2
"""what is added to a mean square before its root [m2]: a perfect trajectory has no infinite slope"""
MAX_GRADIENT_NORM = 1.0
"""norm to which gradients are cut: those through many steps can be very long"""


class FollowingNetwork(nn.Module):
    """A perceptron with ReLU layers, `authority * tanh(last layer / authority)`: near zero it is linear."""

    mean: Tensor
    scale: Tensor

    def __init__(
        self,
        settings: NetworkSettings | MultiStepSettings,
        samples: FollowingSamples,
        seed: int,
        zero_init: bool = False,
    ) -> None:
        """Make a network whose inputs are normalised by `moments`; with `zero` it answers zero at first."""
        super().__init__()
        sizes = [len(RESIDUAL_INPUTS), *settings.hidden, 1]
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.layers = [nn.Linear(*pair) for pair in itertools.pairwise(sizes)]
        if zero_init:
            nn.init.zeros_(self.layers[-1].weight)
            nn.init.zeros_(self.layers[-1].bias)
        self.layer_list = nn.ModuleList(self.layers)
        self.authority = settings.authority
        seen = residual_inputs(*samples.inputs)
        self.register_buffer("mean", _to_tensor(seen.mean(0)))
        self.register_buffer("scale", _to_tensor(seen.std(0).clip(1e-3)))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the acceleration [m/s2], shape (n,), for what `residual_inputs` answers."""
        hidden = (inputs - self.mean) / self.scale
        for layer in self.layers[:-1]:
            hidden = layer(hidden).relu()
        return self.authority * (self.layers[-1](hidden).squeeze(-1) / self.authority).tanh()

    def to_numpy_network(self) -> Network:
        """Return its NumPy twin: the network that drives in the simulator."""
        layers: list[tuple[Floats, Floats]] = [
            (layer.weight.detach().double().numpy().T, layer.bias.detach().double().numpy()) for layer in self.layers
        ]
        mean, scale = self.mean.double().numpy(), self.scale.double().numpy()
        weight, bias = layers[0]
        layers[0] = (weight / scale[:, None], bias - (mean / scale) @ weight)
        weight, bias = layers[-1]
        layers[-1] = (weight / self.authority, bias / self.authority)
        return Network(tuple(layers), self.authority)


def _to_tensor(values: Floats) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)


def batched_network(network: Network) -> ResidualFunction:
    """Return a network that drives as one that takes inputs of any shape (..., 3)."""

    def predict(inputs: Floats) -> Floats:
        return network(inputs.reshape(-1, len(RESIDUAL_INPUTS))).reshape(inputs.shape[:-1])

    return predict


@dataclass(frozen=True)
class LossHistory:
    """Mean squared errors over the passes of a fit [(m/s2)2]."""

    training: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)


def fit_one_step(
    samples: FollowingSamples,
    validation: FollowingSamples,
    base: AccelerationFunction | None,
    settings: NetworkSettings,
    seed: int,
) -> tuple[FollowingNetwork, LossHistory]:
    """Return a network that has learned the accelerations of single moments, less what the base says of them.

    It ends with the weights of the pass that was best on `validation`. Without a base it learns all of it.
    `seed` draws the first weights and the order of the moments.

    Raises:
        UnjamError: a loss is not finite.
    """
    torch.set_num_threads(1)
    network = FollowingNetwork(settings, samples, seed)
    (inputs, wanted), (judged, judged_wanted) = (
        (
            _to_tensor(residual_inputs(*each.inputs)),
            _to_tensor(each.acceleration - (base(*each.inputs) if base else 0.0)),
        )
        for each in (samples, validation)
    )
    optimizer = Adam(network.parameters(), lr=settings.learning_rate, fused=True)
    generator = torch.Generator().manual_seed(seed)
    losses, best, waited, kept = LossHistory(), float("inf"), 0, deepcopy(network.state_dict())
    while len(losses.training) < settings.epochs and waited < settings.patience:
        total = torch.zeros(())
        for batch in torch.randperm(len(wanted), generator=generator).split(settings.batch_size):
            loss = (network(inputs[batch]) - wanted[batch]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.detach() * len(batch)
        with torch.no_grad():
            found = (network(judged) - judged_wanted).square().mean().item()
        losses.training.append(total.item() / len(wanted))
        losses.validation.append(found)
        if not np.isfinite([losses.training[-1], found]).all():
            raise UnjamError(f"following network: the loss of pass {len(losses.training)} is not finite")
        waited += 1
        if found < best:
            best, waited, kept = found, 0, deepcopy(network.state_dict())
    network.load_state_dict(kept)
    return network, losses


@dataclass(frozen=True)
class CalibratedPairs:
    """Trajectories, and what is known of who drove them before a residual is learned."""

    pairs: Sequence[Pair]
    drivers: Sequence[IDMParameters]
    """of each trajectory"""
    initial_headway_weight: float = 0.0
    """of `individual_idm`"""

    def model(self, pair_index: NDArray[np.int64], limits: AccelerationBounds, as_tensors: bool = False) -> DriverModel:
        """Return the base of stretches that are of the trajectories `owner`; for NumPy or for torch."""
        rows = stack_idm_parameters([self.drivers[number] for number in pair_index])
        return individual_idm(
            IDMArrays(*map(_to_tensor, rows)) if as_tensors else rows, self.initial_headway_weight, limits
        )


@dataclass(frozen=True)
class MultiStepFit:
    """A residual, and how it came to be."""

    network: FollowingNetwork
    validation_errors: list[float]
    """mean over the validation trajectories of the root mean squared error of the gap [m], by
    judgement; the first is the base's"""


def fit_multi_step(
    training: CalibratedPairs,
    validation: CalibratedPairs,
    limits: AccelerationBounds,
    settings: MultiStepSettings,
    seed: int,
) -> MultiStepFit:
    """Return a residual on what is known that makes the simulated gaps those of the trajectories.

    It starts at zero, so that what drives at first is the base alone, and ends with the weights that were
    best on whole trajectories of other drivers, `validation`; these may be the first. `limits` are those of
    the acceleration [m/s2]; `seed` draws the first weights and the order of the stretches.

    Raises:
        UnjamError: a loss is not finite.
    """
    torch.set_num_threads(1)
    network = FollowingNetwork(settings, following_samples(training.pairs), seed, zero_init=True)
    stretches, judged = make_segments(training.pairs, settings.segment_seconds), make_segments(validation.pairs)
    base = validation.model(judged.pair_index, limits)

    def gap_error() -> float:
        drove = simulate_open_loop(add_residual(base, batched_network(network.to_numpy_network()), limits), judged)
        return float(np.sqrt(drove.gap_mse).mean())

    optimizer = Adam(network.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.gradient_steps)
    generator = np.random.default_rng(seed)
    found, kept = [gap_error()], deepcopy(network.state_dict())
    for step in range(1, settings.gradient_steps + 1):
        part = stretches.select(generator.choice(stretches.gap.shape[1], settings.batch_size))
        loss = _loss(network, training.model(part.pair_index, limits, as_tensors=True), limits, part, settings)
        if not torch.isfinite(loss):
            raise UnjamError(f"following network: the loss of step {step} is not finite")
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
        optimizer.step()
        schedule.step()
        if step % settings.validation_interval == 0:
            found.append(gap_error())
            if found[-1] <= min(found):
                kept = deepcopy(network.state_dict())
    network.load_state_dict(kept)
    return MultiStepFit(network, found)


def _loss(
    network: FollowingNetwork,
    base: DriverModel,
    limits: AccelerationBounds,
    segments: Segments,
    settings: MultiStepSettings,
) -> Tensor:
    """Return the loss of driving behind the leaders of some stretches."""
    speeds, leader_speeds, gaps, paths = (_to_tensor(getattr(segments, name)) for name in SEGMENT_FIELDS)
    present = torch.as_tensor(segments.is_present)[1:]
    residuals: list[Tensor] = []

    def recorded_network(inputs: Tensor) -> Tensor:
        residuals.append(network(inputs))
        return residuals[-1]

    follow = add_residual(base, recorded_network, limits)(speeds[0], gaps[0])
    driven = list(follow_leader(follow, (speeds[0], gaps[0]), (leader_speeds, paths), segments.step))
    speed, gap = (torch.stack(each) for each in zip(*driven, strict=True))
    squares = (gap - gaps[1:]).square() + (settings.speed_weight * (speed - speeds[1:])).square()
    gap_part = ((squares * present).sum(0) / present.sum(0) + MEAN_SQUARE_OFFSET).sqrt().mean()
    residual_part = torch.stack(residuals).square()[present].mean()
    return gap_part + settings.residual_weight * residual_part
