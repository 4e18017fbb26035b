"""The small policy network of workers and exported controllers, which needs only NumPy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unjam.errors import InputError, invalid_value
from unjam.physics.arrays import Array, Floats, namespace

LOG_STD_RANGE = (-20.0, 2.0)
"""bounds of a log standard deviation that is an output of the network, as in Stable-Baselines3's SAC"""


@dataclass(frozen=True, eq=False)
class Network:
    """A perceptron with ReLU layers and a bounded output: `authority * tanh(last layer)`.

    Exploration adds noise with standard deviation `exploration_std`. If the last layer has a second output, this is
    the log of the standard deviation of noise that is added before the tanh (soft actor-critic). Weights are float64,
    so that n rows at once equal n single rows to 1e-12.
    """

    layers: tuple[tuple[Floats, Floats], ...] = field(repr=False)
    """weight, shape (inputs, outputs), and bias, shape (outputs,), of each layer; the last has one output or two"""
    authority: float
    """largest residual acceleration [m/s2]"""
    exploration_std: float = 0.0
    """standard deviation of the exploration noise [m/s2], unless it is an output of the network"""
    episode_noise: bool = False
    """whether noise is added to the weights and bias of the last layer, with standard deviation `exploration_std`"""
    squashes_noise: bool = field(init=False)
    """whether the log standard deviation is an output of the network, and noise is added before the tanh"""
    _hidden_weights: tuple[Floats, ...] = field(init=False, repr=False, compare=False)
    _last_weights: Floats = field(init=False, repr=False, compare=False)
    _residual_weights: Floats = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "layers", _check_layers(self.layers))
        if not 0.0 < self.authority < math.inf:
            raise invalid_value("network: authority", self.authority, "> 0")
        if not 0.0 <= self.exploration_std < math.inf:
            raise invalid_value("network: exploration_std", self.exploration_std, ">= 0")
        # Each layer has an additional unit that is always 1, and its weights are the biases of the next layer: this
        # saves one NumPy call in each layer.
        weights_and_biases = (np.vstack([weight, bias]) for weight, bias in self.layers)
        *hidden, last = (np.hstack([weights, np.eye(len(weights))[:, -1:]]) for weights in weights_and_biases)
        object.__setattr__(self, "squashes_noise", self.layers[-1][1].shape == (2,))
        object.__setattr__(self, "_hidden_weights", tuple(hidden))
        object.__setattr__(self, "_last_weights", last)
        object.__setattr__(self, "_residual_weights", np.ascontiguousarray(last[:, 0]))

    def __call__(self, observation: Any) -> Any:
        """Return residual accelerations [m/s2], shape (n,), for inputs of shape (n, inputs); a float for a tuple."""
        if not isinstance(observation, (tuple, np.ndarray)):
            return self.authority * self._outputs_on_tensors(observation)[:, 0].tanh()
        tanh = math.tanh if isinstance(observation, tuple) else np.tanh
        return self.authority * tanh(self._hidden_units_of_arrays(observation).dot(self._residual_weights))

    def explore(self, observation: Any, noise: Any) -> Any:
        """Return the residual with exploration; `noise` is standard normal and has the shape of the residual.

        With `episode_noise`, `noise` has a number for each unit of the last hidden layer and for the bias, shape
        (n, units + 1). Source: generalized state-dependent exploration, Raffin et al. 2022, CoRL, without the bias.
        """
        if self.episode_noise:
            if isinstance(observation, (tuple, np.ndarray)):
                units = self._hidden_units_of_arrays(observation)
            else:
                units = append_ones(self._hidden_units_of_tensors(observation))
            shift = self.exploration_std * (units * noise).sum(-1)
            return self(observation) + (float(shift) if isinstance(observation, tuple) else shift)
        if not self.squashes_noise:
            return self(observation) + self.exploration_std * noise
        if isinstance(observation, (tuple, np.ndarray)):
            mean, log_std = self._hidden_units_of_arrays(observation).dot(self._last_weights[:, :2]).T
        else:
            mean, log_std = self._outputs_on_tensors(observation).T
        xp = np if isinstance(observation, tuple) else namespace(observation)
        residual = self.authority * xp.tanh(mean + xp.exp(log_std.clip(*LOG_STD_RANGE)) * noise)
        return float(residual) if isinstance(observation, tuple) else residual

    def _outputs_on_tensors(self, observation: Array) -> Array:
        hidden = self._hidden_units_of_tensors(observation)
        weight, bias = _as_tensors_like(hidden, self.layers[-1])
        return namespace(hidden).addmm(bias, hidden, weight)

    def _hidden_units_of_tensors(self, observation: Array) -> Array:
        hidden = observation
        for layer in self.layers[:-1]:
            weight, bias = _as_tensors_like(hidden, layer)
            hidden = namespace(hidden).addmm(bias, hidden, weight).relu_()
        return hidden

    def _hidden_units_of_arrays(self, observation: Any) -> Floats:
        """Return the last hidden layer, with an additional unit that is always 1."""
        if isinstance(observation, tuple):
            hidden = np.array((*observation, 1.0))
        else:
            hidden = np.hstack([observation, np.ones((len(observation), 1))])
        for weight in self._hidden_weights:
            hidden = hidden.dot(weight)
            np.maximum(hidden, 0.0, out=hidden)
        return hidden

    @property
    def input_size(self) -> int:
        """Number of inputs."""
        return self.layers[0][0].shape[0]

    @property
    def episode_noise_size(self) -> int:
        """Number of exploration noise values that are constant in an episode; 0: new noise in each control step."""
        return self.layers[-1][0].shape[0] + 1 if self.episode_noise else 0


def append_ones(units: Array) -> Array:
    """Return a layer of tensors with an additional unit that is always 1."""
    return namespace(units).cat([units, units.new_ones((len(units), 1))], -1)


def _as_tensors_like(tensor: Any, layer: tuple[Floats, Floats]) -> Any:
    return (namespace(tensor).as_tensor(weights, dtype=tensor.dtype, device=tensor.device) for weights in layer)


def network_weights(network: Network) -> dict[str, Floats]:
    """Return the weights of a network as arrays by name: `0.weight`, `0.bias`, ..."""
    weights = {f"{index}.weight": weight for index, (weight, _) in enumerate(network.layers)}
    return weights | {f"{index}.bias": bias for index, (_, bias) in enumerate(network.layers)}


def _check_layers(layers: Sequence[tuple[Floats, Floats]]) -> tuple[tuple[Floats, Floats], ...]:
    """Return layers in double precision; raise `InputError` if shapes do not match, or weights are not finite."""
    previous_outputs = None
    for index, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[1:]:
            raise InputError(f"network layer {index}: weight and bias do not fit together")
        if previous_outputs not in (None, weight.shape[0]):
            allowed = f"{previous_outputs}, the outputs of the previous layer"
            raise InputError(f"network layer {index}: {weight.shape[0]} inputs are not allowed; allowed: {allowed}")
        if not (np.issubdtype(weight.dtype, np.floating) and np.issubdtype(bias.dtype, np.floating)):
            raise InputError(f"network layer {index}: weights are {weight.dtype}, {bias.dtype}; allowed: floats")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise InputError(f"network layer {index}: a weight is not finite")
        previous_outputs = weight.shape[1]
    if previous_outputs not in (1, 2):
        raise InputError("network: the last layer must have one output, or two with the log std of its noise")
    return tuple((np.asarray(weight, np.float64), np.asarray(bias, np.float64)) for weight, bias in layers)
