"""The small network that drives: in workers while learning, and in a shipped controller. NumPy alone."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.errors import InputError
from unjam.physics.arrays import Array, namespace

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Network:
    """A perceptron with ReLU layers and a bounded output: `authority * tanh(last layer)`.

    Weights are float64, so that n rows at once equal n single rows to 1e-12 and the trained float32
    network to 1e-6.
    """

    layers: tuple[tuple[Floats, Floats], ...] = field(repr=False)
    """(weight of shape (inputs, outputs), bias of shape (outputs,)) of each layer; one output at the end"""
    authority: float
    """largest residual acceleration [m/s2]"""
    exploration_std: float = 0.0
    """standard deviation of the exploration noise [m/s2]"""
    _folded: tuple[Floats, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_folded", _fold_biases(self.layers))

    def __call__(self, observation: Any) -> Any:
        """Return the residual acceleration [m/s2]: shape (n,) for (n, inputs), a float for a tuple.

        Torch tensors are answered with tensors, in their own precision and on their own device.
        """
        single = isinstance(observation, tuple)
        if not single and not isinstance(observation, np.ndarray):
            return self._on_tensors(observation)
        if single:
            hidden = np.array((*observation, 1.0))
        else:
            hidden = np.hstack([observation, np.ones((len(observation), 1))])
        hidden = hidden.dot(self._folded[0])
        for weight in self._folded[1:]:
            hidden = np.maximum(hidden, 0.0, out=hidden).dot(weight)
        return self.authority * (math.tanh(hidden) if single else np.tanh(hidden))

    def _on_tensors(self, observation: Array) -> Array:
        xp, hidden = namespace(observation), observation
        for index, layer in enumerate(self.layers):
            weight, bias = (xp.as_tensor(part, dtype=hidden.dtype, device=hidden.device) for part in layer)
            hidden = xp.addmm(bias, hidden.relu_() if index else hidden, weight)
        return self.authority * hidden[:, 0].tanh()

    def explore(self, observation: Any, noise: Any) -> Any:
        """Return the residual with exploration; `noise` is standard normal, shaped like the residual."""
        return self(observation) + self.exploration_std * noise

    @property
    def inputs(self) -> int:
        """How many numbers the network sees."""
        return self.layers[0][0].shape[0]


def _fold_biases(layers: tuple[tuple[Floats, Floats], ...]) -> tuple[Floats, ...]:
    """Return the layers with their biases inside the weights, the last one as a vector.

    The input and each hidden layer get one unit more, which is always 1. It saves a NumPy call a layer.
    """
    folded = []
    for weight, bias in layers:
        with_bias = np.vstack([weight, bias])
        keep_one = np.zeros((len(with_bias), 1))
        keep_one[-1] = 1.0
        folded.append(np.hstack([with_bias, keep_one]))
    return (*folded[:-1], np.ascontiguousarray(folded[-1][:, 0]))


def network_arrays(network: Network) -> dict[str, Floats]:
    """Return the weights of a network under the names that `network_from_arrays` reads."""
    arrays = {}
    for index, (weight, bias) in enumerate(network.layers):
        arrays[f"{index}.weight"] = weight
        arrays[f"{index}.bias"] = bias
    return arrays


def network_from_arrays(arrays: dict[str, Floats], authority: float, exploration_std: float) -> Network:
    """Return the network whose weights `network_arrays` wrote; raise `InputError` where they do not fit."""
    layers: list[tuple[Floats, Floats]] = []
    for index in range(sum(name.endswith(".weight") for name in arrays)):
        weight, bias = arrays.get(f"{index}.weight"), arrays.get(f"{index}.bias")
        if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[1:]:
            raise InputError(f"network layer {index}: weight and bias do not fit together")
        if layers and layers[-1][0].shape[1] != weight.shape[0]:
            raise InputError(
                f"network layer {index}: {weight.shape[0]} inputs are not allowed; "
                f"allowed: {layers[-1][0].shape[1]}, the outputs of the layer before"
            )
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise InputError(f"network layer {index}: a weight is not finite")
        layers.append((np.asarray(weight, np.float64), np.asarray(bias, np.float64)))
    if not layers or layers[-1][0].shape[1] != 1:
        raise InputError("network: the last layer must have one output")
    return Network(tuple(layers), authority, exploration_std)
