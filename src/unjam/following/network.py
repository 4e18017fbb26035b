"""Networks that drive: alone (`vanilla`), or as the residual on a base (`knowledge`, Eq. 4 of the paper)."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from torch import Tensor, nn

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.following.open_loop import Follow, Residual
from unjam.following.pairs import Floats, Rows
from unjam.parameters import STRICT, Count, Positive
from unjam.scenarios.population import RESIDUAL_INPUTS, residual_inputs


@checked_dataclass(frozen=True, config=STRICT)
class NetworkSettings:
    """A network and how it learns single accelerations; the defaults are the paper's."""

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (128, 128)
    """units of the hidden layers"""
    rate: Positive = 1e-4
    """learning rate of Adam"""
    batch: Count = 1024
    """rows in a gradient step"""
    epochs: Count = 200
    """most passes over the rows"""
    patience: Count = 200
    """passes without progress on the validation rows after which learning ends; as many as `epochs`: never"""
    authority: Positive = 8.0
    """largest acceleration that it may answer [m/s2]: no network answers what no car can do"""


class FollowingNetwork(nn.Module):
    """A perceptron with ReLU layers, `authority * tanh(last layer / authority)`: near zero it is linear."""

    mean: Tensor
    scale: Tensor

    def __init__(self, settings: NetworkSettings, rows: Rows, seed: int, zero: bool = False) -> None:
        """Make a network whose inputs are normalised by `rows`; with `zero` it answers zero at first."""
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            sizes = [len(RESIDUAL_INPUTS), *settings.hidden, 1]
            self.layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(sizes))
        if zero:
            last = self.layers[-1]
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        self.authority = settings.authority
        seen = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
        self.register_buffer("mean", torch.as_tensor(seen.mean(0), dtype=torch.float32))
        self.register_buffer("scale", torch.as_tensor(seen.std(0).clip(1e-3), dtype=torch.float32))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the acceleration [m/s2], shape (n,), for what `residual_inputs` answers."""
        hidden = (inputs - self.mean) / self.scale
        *first, last = self.layers
        for layer in first:
            hidden = layer(hidden).relu()
        return self.authority * (last(hidden).squeeze(-1) / self.authority).tanh()

    def as_driver(self) -> Network:
        """Return its NumPy twin: the network that drives in the simulator."""
        layers: list[tuple[Floats, Floats]] = []
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            layers.append((layer.weight.detach().double().numpy().T, layer.bias.detach().double().numpy()))
        mean, scale = self.mean.double().numpy(), self.scale.double().numpy()
        weight, bias = layers[0]
        layers[0] = (weight / scale[:, None], bias - (mean / scale) @ weight)
        weight, bias = layers[-1]
        layers[-1] = (weight / self.authority, bias / self.authority)
        return Network(tuple(layers), self.authority)


def on_rows(network: Network) -> Residual:
    """Return a network that drives as one that takes inputs of any shape (..., 3)."""

    def answer(inputs: Floats) -> Floats:
        return network(inputs.reshape(-1, len(RESIDUAL_INPUTS))).reshape(inputs.shape[:-1])

    return answer


@dataclass(frozen=True)
class Losses:
    """Mean squared errors over the passes of a fit [(m/s2)2]."""

    training: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)


def fit_one_step(
    rows: Rows,
    validation: Rows,
    base: Follow | None,
    settings: NetworkSettings,
    seed: int,
    told: Callable[[int], None] | None = None,
) -> tuple[FollowingNetwork, Losses]:
    """Return a network that has learned the accelerations of single rows, less what the base says of them.

    It ends with the weights of the pass that was best on `validation`.

    Args:
        rows: to learn from.
        validation: that judge each pass.
        base: what is known; None: the network learns all of it.
        settings: of network and learning.
        seed: of the first weights and the order of the rows.
        told: told the number of each pass.

    Raises:
        UnjamError: a loss is not finite.
    """
    torch.set_num_threads(1)
    network = FollowingNetwork(settings, rows, seed)
    inputs, wanted = _tensors(rows, base)
    judged, judged_wanted = _tensors(validation, base)
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.rate, fused=True)
    generator = torch.Generator().manual_seed(seed)
    losses, best, waited, kept = Losses(), float("inf"), 0, network.state_dict()
    while len(losses.training) < settings.epochs and waited < settings.patience:
        total = torch.zeros(())
        for batch in torch.randperm(len(wanted), generator=generator).split(settings.batch):
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
        waited = waited + 1 if found >= best else 0
        if found < best:
            best = found
            kept = {name: value.clone() for name, value in network.state_dict().items()}
        if told is not None:
            told(len(losses.training))
    network.load_state_dict(kept)
    return network, losses


def _tensors(rows: Rows, base: Follow | None) -> tuple[Tensor, Tensor]:
    """Return what the network sees of rows, and what it is to answer."""
    known = 0.0 if base is None else base(rows.speed, rows.leader_speed, rows.gap)
    inputs = residual_inputs(rows.speed, rows.leader_speed, rows.gap)
    wanted = torch.as_tensor(rows.acceleration - known, dtype=torch.float32)
    return torch.as_tensor(np.ascontiguousarray(inputs), dtype=torch.float32), wanted
