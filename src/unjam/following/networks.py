"""Networks as driver models: alone (`vanilla`), or as a residual of an IDM (`knowledge`, Eq. 4 of the paper).

`fit_one_step` fits single accelerations: small errors can accumulate in a simulation. `fit_multi_step` fits gaps in a
simulation behind recorded leaders, with gradients through all steps.
"""

import itertools
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from unjam.adam import Adam
from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.following import leader_replay
from unjam.following.calibration import HiddenSizes, MultiStepSettings
from unjam.parameters import STRICT, Positive, PositiveInt, parameter_dataclass
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMArrays, IDMParameters, stack_idm_parameters
from unjam.recordings.trajectories import (
    SEGMENT_FIELDS,
    FollowingSamples,
    FollowingTrajectory,
    Segments,
    following_samples,
    make_segments,
)
from unjam.scenarios.population import RESIDUAL_INPUTS, residual_inputs

MEAN_SQUARE_OFFSET = 1e-2
"""constant in the root of a mean square [m2], which keeps the gradient finite for trajectories without error"""
MAX_GRADIENT_NORM = 1.0
"""norm to which gradients are clipped, because gradients through many simulated steps can be very large"""


@parameter_dataclass(frozen=True, config=STRICT)
class OneStepSettings:
    """Settings of a network that learns single accelerations (`fit_one_step`); the defaults are those of the paper."""

    hidden: HiddenSizes = (128, 128)
    """sizes of the hidden layers"""
    learning_rate: Positive = 1e-4
    """learning rate of Adam"""
    batch_size: PositiveInt = 1024
    """number of samples in a gradient step"""
    epochs: PositiveInt = 200
    patience: PositiveInt = 200
    """number of consecutive epochs without a smaller validation error after which the fit ends"""
    authority: Positive = 8.0
    """largest magnitude of the output [m/s2]"""


class FollowingNetwork(nn.Module):
    """A perceptron with ReLU layers and the output `authority * tanh(last layer / authority)`."""

    mean: Tensor
    scale: Tensor

    def __init__(
        self,
        settings: OneStepSettings | MultiStepSettings,
        samples: FollowingSamples,
        seed: int,
        zero_init: bool = False,
    ) -> None:
        """Initialize a network with inputs normalized by `samples`; with `zero_init` its initial output is zero."""
        super().__init__()
        sizes = [len(RESIDUAL_INPUTS), *settings.hidden, 1]
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.layers = [nn.Linear(*pair) for pair in itertools.pairwise(sizes)]
        if zero_init:
            nn.init.zeros_(self.layers[-1].weight)
            nn.init.zeros_(self.layers[-1].bias)
        self.module_list = nn.ModuleList(self.layers)  # registers the parameters; `layers` has types
        self.authority = settings.authority
        inputs = residual_inputs(*samples.inputs)
        self.register_buffer("mean", _to_tensor(inputs.mean(0)))
        self.register_buffer("scale", _to_tensor(inputs.std(0).clip(1e-3)))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the acceleration [m/s2], shape (n,), for inputs of `residual_inputs`, shape (n, 3)."""
        hidden = (inputs - self.mean) / self.scale
        for layer in self.layers[:-1]:
            hidden = layer(hidden).relu()
        return self.authority * (self.layers[-1](hidden).squeeze(-1) / self.authority).tanh()

    def to_numpy_network(self) -> Network:
        """Return the equivalent NumPy network, which the simulator uses."""
        layers: list[tuple[Floats, Floats]] = [
            (layer.weight.detach().double().numpy().T, layer.bias.detach().double().numpy()) for layer in self.layers
        ]
        mean, scale = self.mean.double().numpy(), self.scale.double().numpy()
        # The first layer includes the normalization, and the last layer the division by the authority.
        weight, bias = layers[0]
        layers[0] = (weight / scale[:, None], bias - (mean / scale) @ weight)
        layers[-1] = (layers[-1][0] / self.authority, layers[-1][1] / self.authority)
        return Network(tuple(layers), self.authority)


def _to_tensor(values: Floats) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)


def batched_network(network: Network) -> leader_replay.ResidualFunction:
    """Return a NumPy network as a function of inputs of the shape (..., 3)."""
    return lambda inputs: network(inputs.reshape(-1, len(RESIDUAL_INPUTS))).reshape(inputs.shape[:-1])


class LossHistory(NamedTuple):
    """Mean squared errors of the acceleration in each epoch of a fit [(m/s2)2]."""

    training: list[float]
    """errors on the training samples, each averaged over the gradient steps of an epoch"""
    validation: list[float]
    """errors on the validation samples, each at the end of an epoch"""


def fit_one_step(
    samples: FollowingSamples,
    validation: FollowingSamples,
    base: leader_replay.AccelerationFunction | None,
    settings: OneStepSettings,
    seed: int,
) -> tuple[FollowingNetwork, LossHistory]:
    """Fit a network to the accelerations of single samples, or to their differences to a base.

    The network has the weights of the epoch with the smallest error on `validation`. Raise `UnjamError` if a loss is
    not finite.
    """
    torch.set_num_threads(1)  # results must not depend on the number of cores
    network = FollowingNetwork(settings, samples, seed)

    def to_tensors(samples: FollowingSamples) -> tuple[Tensor, Tensor]:
        targets = samples.acceleration - (base(*samples.inputs) if base else 0.0)
        return _to_tensor(residual_inputs(*samples.inputs)), _to_tensor(targets)

    (inputs, targets), (validation_inputs, validation_targets) = to_tensors(samples), to_tensors(validation)
    optimizer = Adam(network.parameters(), lr=settings.learning_rate, fused=True)
    generator = torch.Generator().manual_seed(seed)
    losses, best_error, epochs_since_best = LossHistory([], []), float("inf"), 0
    best_weights = deepcopy(network.state_dict())
    while len(losses.training) < settings.epochs and epochs_since_best < settings.patience:
        loss_sum = torch.zeros(())
        for batch in torch.randperm(len(targets), generator=generator).split(settings.batch_size):
            loss = (network(inputs[batch]) - targets[batch]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            loss_sum += loss.detach() * len(batch)
        with torch.no_grad():
            error = (network(validation_inputs) - validation_targets).square().mean().item()
        losses.training.append(loss_sum.item() / len(targets))
        losses.validation.append(error)
        if not np.isfinite([losses.training[-1], error]).all():
            raise UnjamError(f"following network: the loss of epoch {len(losses.training)} is not finite")
        epochs_since_best += 1
        if error < best_error:
            best_error, epochs_since_best, best_weights = error, 0, deepcopy(network.state_dict())
    network.load_state_dict(best_weights)
    return network, losses


@dataclass(frozen=True)
class CalibratedTrajectories:
    """Trajectories with the calibrated IDMs of their drivers, to which a residual is added."""

    trajectories: Sequence[FollowingTrajectory]
    idm_parameters: Sequence[IDMParameters]
    """parameters of the driver of each trajectory"""

    def make_driver_model(
        self, trajectory_index: NDArray[np.int64], limits: leader_replay.AccelerationBounds, as_tensors: bool = False
    ) -> leader_replay.DriverModel:
        """Return the IDMs of the drivers of segments with accelerations within `limits` [m/s2].

        `trajectory_index` has the index of the trajectory of each segment. With `as_tensors` the model takes tensors.
        """
        parameters = stack_idm_parameters([self.idm_parameters[index] for index in trajectory_index])
        if as_tensors:
            parameters = IDMArrays(*map(_to_tensor, parameters))
        return leader_replay.as_driver_model(leader_replay.idm_function(parameters, limits))


def fit_multi_step(
    training: CalibratedTrajectories,
    validation: CalibratedTrajectories,
    limits: leader_replay.AccelerationBounds,
    settings: MultiStepSettings,
    seed: int,
) -> tuple[FollowingNetwork, list[float]]:
    """Fit a residual that reduces the difference between simulated and recorded gaps of calibrated drivers.

    The residual starts at zero. The returned network has the weights with the smallest error on whole trajectories of
    `validation`. Also return the mean RMS gap error at each validation [m]; the first one is that of the IDM alone.
    `limits` are the limits of the acceleration [m/s2]. Raise `UnjamError` if a loss is not finite.
    """
    torch.set_num_threads(1)  # results must not depend on the number of cores
    network = FollowingNetwork(settings, following_samples(training.trajectories), seed, zero_init=True)
    segments = make_segments(training.trajectories, settings.segment_seconds)
    validation_segments = make_segments(validation.trajectories)
    validation_base = validation.make_driver_model(validation_segments.trajectory_index, limits)

    def gap_error() -> float:
        model = leader_replay.add_residual(validation_base, batched_network(network.to_numpy_network()), limits)
        return float(np.sqrt(leader_replay.simulate_followers(model, validation_segments).gap_mse).mean())

    optimizer = Adam(network.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.gradient_steps)
    generator = np.random.default_rng(seed)
    errors, best_weights = [gap_error()], deepcopy(network.state_dict())
    for step in range(1, settings.gradient_steps + 1):
        batch = segments.select(generator.choice(segments.gap.shape[1], settings.batch_size))
        base_model = training.make_driver_model(batch.trajectory_index, limits, as_tensors=True)
        loss = _multi_step_loss(network, base_model, limits, batch, settings)
        if not torch.isfinite(loss):
            raise UnjamError(f"following network: the loss of step {step} is not finite")
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
        optimizer.step()
        schedule.step()
        if step % settings.validation_interval == 0:
            errors.append(gap_error())
            if errors[-1] <= min(errors):
                best_weights = deepcopy(network.state_dict())
    network.load_state_dict(best_weights)
    return network, errors


def _multi_step_loss(
    network: nn.Module,
    base: leader_replay.DriverModel,
    limits: leader_replay.AccelerationBounds,
    segments: Segments,
    settings: MultiStepSettings,
) -> Tensor:
    """Return the mean RMS error of gaps and weighted speeds over segments, plus a penalty for large residuals."""
    speeds, leader_speeds, gaps, leader_positions = (_to_tensor(getattr(segments, name)) for name in SEGMENT_FIELDS)
    is_present = torch.as_tensor(segments.is_present)[1:]  # the states after each step
    residuals: list[Tensor] = []

    def compute_residual(inputs: Tensor) -> Tensor:
        residuals.append(network(inputs))
        return residuals[-1]

    initial_state = speeds[0], gaps[0]
    acceleration_function = leader_replay.add_residual(base, compute_residual, limits)(*initial_state)
    leader = leader_speeds, leader_positions
    states = leader_replay.follow_leader(acceleration_function, initial_state, leader, segments.time_step)
    simulated_speeds, simulated_gaps = (torch.stack(values) for values in zip(*states, strict=True))
    squares = (simulated_gaps - gaps[1:]).square()
    squares = squares + (settings.speed_weight * (simulated_speeds - speeds[1:])).square()
    error = ((squares * is_present).sum(0) / is_present.sum(0) + MEAN_SQUARE_OFFSET).sqrt().mean()
    return error + settings.residual_weight * torch.stack(residuals).square()[is_present].mean()
