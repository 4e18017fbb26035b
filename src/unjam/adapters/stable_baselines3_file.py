"""Policies in files of Stable-Baselines3, read from JSON and weights without unpickling, which could run any code."""

import io
import json
import os
import pickletools
import re
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from unjam.errors import InputError, MissingPartError, import_optional
from unjam.physics.arrays import Floats
from unjam.text import to_one_line

DATA_PART, POLICY_PART, PICKLE_SUFFIX = "data", "policy.pth", ".pkl"
MAX_ARCHIVE_BYTES = 64 * 2**20
"""largest decompressed size of an archive"""
MAX_PICKLE_BYTES = 2**20
"""largest decompressed size of a pickle, which is usually some kilobytes; the check of a byte takes 2 us"""
SAFE_TORCH = (2, 6)
"""first version of torch in which reading weights cannot run code (CVE-2025-32434)"""
ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {"Tanh": np.tanh, "ReLU": lambda units: np.maximum(units, 0.0)}
POLICY_PACKAGES = ("stable_baselines3.", "sb3_contrib.")
"""beginnings of the module names of allowed policy classes"""
_HARMLESS_OPTIONS = """
net_arch log_std_init ortho_init optimizer_class optimizer_kwargs share_features_extractor n_critics n_quantiles
clip_mean full_std use_expln use_sde normalize_images :type: :serialized:
"""
HARMLESS_POLICY_OPTIONS = set(_HARMLESS_OPTIONS.split())
"""options of policies that do not change their deterministic actions, or that the shapes of the weights show"""


@dataclass(frozen=True)
class _Actor:
    """Names of the weights of an actor network in a file."""

    hidden: str
    """beginning of the names of the numbered layers"""
    output: str
    """beginning of the names of the output layer; empty if the last numbered layer is the output layer"""
    others: tuple[str, ...]
    """beginnings of the names of weights that do not change actions"""
    activation: str
    """name of the default activation"""
    is_squashed: bool
    """whether the output is the tanh of the last layer, scaled to the action space"""


ACTORS = (
    _Actor(
        *("mlp_extractor.policy_net.", "action_net.", ("log_std", "mlp_extractor.value_net.", "value_net."), "Tanh"),
        is_squashed=False,
    ),
    _Actor("actor.latent_pi.", "actor.mu.", ("actor.log_std.", "critic.", "critic_target."), "ReLU", is_squashed=True),
    _Actor("actor.mu.", "", ("actor_target.", "critic.", "critic_target."), "ReLU", is_squashed=True),
)
"""actors of PPO, A2C and TRPO; of SAC and TQC; of TD3 and DDPG"""


@dataclass(frozen=True)
class SavedPolicy:
    """The deterministic policy of a file, in float64."""

    observation_space: Box
    action_space: Box
    layers: list[tuple[Floats, Floats]]
    """weight, shape (outputs, inputs), and bias of each layer"""
    activation: Callable[[Floats], Floats]
    is_squashed: bool
    unjam: dict[str, Any]
    """entries that `unjam export --sb3` writes: expert, features, action, action repeat; empty for other models"""

    def predict(self, observation: Floats, *, deterministic: bool = True) -> tuple[Floats, None]:
        """Return actions, shape (n, 1), and None as recurrent state, as models of Stable-Baselines3 do."""
        units, low, high = observation, self.action_space.low, self.action_space.high
        for weight, bias in self.layers[:-1]:
            units = self.activation(units @ weight.T + bias)
        units = units @ self.layers[-1][0].T + self.layers[-1][1]
        return low + 0.5 * (np.tanh(units) + 1.0) * (high - low) if self.is_squashed else units.clip(low, high), None


def read_policy(path: Path) -> SavedPolicy:
    """Return the policy of a .zip file; raise errors as `policy_driver`."""
    if not os.path.isfile(path):
        raise InputError(f"driver: {str(path)!r} does not exist")
    try:
        parts = _read_parts(path.read_bytes(), (DATA_PART, POLICY_PART))
        data = json.loads(parts[DATA_PART])
        weights = _read_weights(parts[POLICY_PART])
        observation_space, action_space = (_parse_box(data[f"{name}_space"]) for name in ("observation", "action"))
        actor = _find_actor(weights)
        activation, is_squashed = _parse_options(data, actor)
        layers = _select_layers(weights, actor)
        metadata = dict(data.get("unjam", {}))
        if action_space.shape != (1,) or layers[-1][1].shape != (1,):
            raise ValueError("its actions are not one number")
        if observation_space.shape != (layers[0][0].shape[1],):
            raise ValueError("its observations are not the inputs of its network")
    except (InputError, MissingPartError):
        raise
    except Exception as error:  # damaged files cause any error, also in torch
        hint = "allowed: an MlpPolicy of Stable-Baselines3 with a Box of one action; others as Python objects"
        raise InputError(f"driver {path.name}: {type(error).__name__}: {to_one_line(error)}; {hint}") from None
    return SavedPolicy(observation_space, action_space, layers, activation, is_squashed, metadata)


def _read_parts(content: bytes, names: Sequence[str] | None = None) -> dict[str, bytes]:
    """Return the parts `names` (None: all parts) of an archive; raise `ValueError` if they are too large.

    Sizes that the archive states may be wrong.
    """
    parts, total_size = dict[str, bytes](), 0
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist() if names is None else map(archive.getinfo, names):
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{entry.filename!r:.60} is compressed by another method than deflate")
            with archive.open(entry) as file:
                parts[entry.filename] = file.read(MAX_ARCHIVE_BYTES - total_size + 1)
            if (total_size := total_size + len(parts[entry.filename])) > MAX_ARCHIVE_BYTES:
                raise ValueError(f"larger than {MAX_ARCHIVE_BYTES} bytes")
    return parts


def _check_pickles(parts: dict[str, bytes]) -> None:
    # Nested tuples that contain one tuple several times need little space in a file, but torch would hash them almost
    # without end. The shapes of weights are tuples that occur once.
    for content in (part for name, part in parts.items() if name.endswith(PICKLE_SUFFIX)):
        if len(content) > MAX_PICKLE_BYTES:
            raise ValueError(f"a pickle larger than {MAX_PICKLE_BYTES:,} bytes")
        tuple_keys, previous_name, stored_count = set[str](), "", 0
        for opcode, argument, _ in pickletools.genops(content):
            if opcode.name in ("BINPUT", "LONG_BINPUT", "PUT", "MEMOIZE"):
                key = str(stored_count if opcode.name == "MEMOIZE" else argument)
                stored_count += 1
                if "TUPLE" in previous_name:
                    tuple_keys.add(key)
            elif opcode.name in ("BINGET", "LONG_BINGET", "GET") and str(argument) in tuple_keys:
                raise ValueError("a tuple occurs more than once among its weights")
            previous_name = opcode.name


def _read_weights(content: bytes) -> dict[str, Floats]:
    """Return the weights in a part by name; raise `ValueError` if they are too large, or not finite."""
    torch = import_optional("torch")  # imported here, because other functions of this module do not need torch
    if tuple(map(int, torch.__version__.split(".")[:2])) < SAFE_TORCH:
        needed = ".".join(map(str, SAFE_TORCH))
        raise MissingPartError(f"torch {torch.__version__} cannot read weights safely: pip install 'torch>={needed}'")
    _check_pickles(_read_parts(content))
    tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    weights: dict[str, Floats] = {}
    for name, tensor in tensors.items():
        if tensor.numel() * tensor.element_size() > len(content):
            raise ValueError(f"weights {name} are larger than their file")
        weights[name] = tensor.double().numpy()
        if not np.isfinite(weights[name]).all():
            raise ValueError(f"weights {name} are not finite")
    return weights


def _parse_box(space: dict[str, Any]) -> Box:
    if not space[":type:"].endswith(".Box'>"):
        raise ValueError(f"{space[':type:']} is not a Box")
    low, high = (np.array(space[name].strip("[]").split(), np.float64) for name in ("low", "high"))
    if not [*low.shape] == [*high.shape] == space["_shape"]:
        raise ValueError("a space does not have one axis")
    return Box(low, high, dtype=np.float64)


def _find_actor(weights: dict[str, Floats]) -> _Actor:
    for actor in ACTORS:
        other_names = [name for name in weights if not name.startswith((actor.hidden, actor.output or actor.hidden))]
        if len(other_names) < len(weights) and all(name.startswith(actor.others) for name in other_names):
            return actor
    raise ValueError("its weights are not those of an MlpPolicy with continuous actions")


def _parse_options(data: dict[str, Any], actor: _Actor) -> tuple[Callable[[Floats], Floats], bool]:
    """Return the activation of the hidden layers, and whether the output is a tanh."""
    options = dict(data["policy_kwargs"])
    name = re.sub(r".*\.|'>", "", options.pop("activation_fn", actor.activation))
    if not data["policy_class"]["__module__"].startswith(POLICY_PACKAGES):
        raise ValueError("its policy class is not one of Stable-Baselines3")
    if not isinstance(is_squashed := options.pop("squash_output", False), bool):
        raise ValueError("squash_output is neither true nor false")
    if unknown_options := options.keys() - HARMLESS_POLICY_OPTIONS:
        raise ValueError(f"policy_kwargs {min(unknown_options)}")
    if name not in ACTIVATIONS:
        raise ValueError(f"activation {name}; known: {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS[name], is_squashed or actor.is_squashed


def _select_layers(weights: dict[str, Floats], actor: _Actor) -> list[tuple[Floats, Floats]]:
    """Return weight and bias of each layer of an actor, in order; raise `ValueError` if layers are not linear."""
    hidden_names = [name.removeprefix(actor.hidden) for name in weights if name.startswith(actor.hidden)]
    numbers = sorted({int(name.partition(".")[0]) for name in hidden_names})
    prefixes = [*(f"{actor.hidden}{number}." for number in numbers), *filter(None, (actor.output,))]
    if len(hidden_names) != 2 * len(numbers):
        raise ValueError("layers that are not linear")
    layers = [(weights[f"{prefix}weight"], weights[f"{prefix}bias"]) for prefix in prefixes]
    next_input_sizes = [weight.shape[1] for weight, _ in layers[1:]]
    is_mismatch = any(weight.shape[:1] != bias.shape for weight, bias in layers)
    if [len(bias) for _, bias in layers[:-1]] != next_input_sizes or is_mismatch:
        raise ValueError("layers that do not fit together")
    return layers
