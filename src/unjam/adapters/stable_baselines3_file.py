"""The policy of a file of Stable-Baselines3 from its JSON and its weights alone: unpickling can run any code."""

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
"""maximum size of an archive, decompressed"""
MAX_PICKLE_BYTES = 2**20
"""maximum size of a pickle, decompressed; that of the usual weights has some kilobytes, and each byte takes 2 us"""
SAFE_TORCH = (2, 6)
"""version of torch from which on reading weights cannot run code (CVE-2025-32434)"""
ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {"Tanh": np.tanh, "ReLU": lambda units: np.maximum(units, 0.0)}
POLICY_PACKAGES = ("stable_baselines3.", "sb3_contrib.")
_HARMLESS_OPTIONS = """
net_arch log_std_init ortho_init optimizer_class optimizer_kwargs share_features_extractor n_critics n_quantiles
clip_mean full_std use_expln use_sde normalize_images :type: :serialized:
"""
HARMLESS_POLICY_OPTIONS = set(_HARMLESS_OPTIONS.split())
"""options of policies that do not change their deterministic actions, or that the shapes of the weights show"""


@dataclass(frozen=True)
class _Actor:
    """Names of the weights of an actor network; numbered layers come first."""

    hidden: str
    output: str
    """empty if the last numbered layer is the output"""
    others: tuple[str, ...]
    """beginnings of the names of other weights, without which actions are the same"""
    activation: str
    """default activation"""
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
    """The deterministic policy of a file, float64."""

    observation_space: Box
    action_space: Box
    layers: list[tuple[Floats, Floats]]
    """weight, shape (outputs, inputs), and bias of each"""
    activation: Callable[[Floats], Floats]
    is_squashed: bool
    unjam: dict[str, Any]
    """what `unjam export --sb3` writes: expert, features, action repeat; empty for other models"""

    def predict(self, observation: Floats, *, deterministic: bool = True) -> tuple[Floats, None]:
        """Return actions, shape (n, 1), and no state."""
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
        observed, acted = (_read_box(data[f"{name}_space"]) for name in ("observation", "action"))
        actor = _find_actor(weights)
        activation, is_squashed = _read_options(data, actor)
        layers = _read_layers(weights, actor)
        exported = dict(data.get("unjam", {}))
        if acted.shape != (1,) or layers[-1][1].shape != (1,):
            raise ValueError("its actions are not one number")
        if observed.shape != (layers[0][0].shape[1],):
            raise ValueError("its observations are not the inputs of its network")
    except (InputError, MissingPartError):
        raise
    except Exception as error:  # damaged files cause any error, also in torch
        hint = "allowed: an MlpPolicy of Stable-Baselines3 with a Box of one action; others as Python objects"
        raise InputError(f"driver {path.name}: {type(error).__name__}: {to_one_line(error)}; {hint}") from None
    return SavedPolicy(observed, acted, layers, activation, is_squashed, exported)


def _read_parts(content: bytes, names: Sequence[str] | None = None) -> dict[str, bytes]:
    """Return parts of an archive, None: all; raise `ValueError` if it is too large, whatever sizes it states."""
    parts, total = dict[str, bytes](), 0
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for part in archive.infolist() if names is None else map(archive.getinfo, names):
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{part.filename!r:.60} is compressed by another method than deflate")
            with archive.open(part) as file:
                parts[part.filename] = file.read(MAX_ARCHIVE_BYTES - total + 1)
            if (total := total + len(parts[part.filename])) > MAX_ARCHIVE_BYTES:
                raise ValueError(f"larger than {MAX_ARCHIVE_BYTES} bytes")
    return parts


def _check_pickles(parts: dict[str, bytes]) -> None:
    # Tuples of tuples of the same one are as small in a file as they are large to hash: torch would never end. The
    # shapes of weights are tuples that occur once.
    for content in (part for name, part in parts.items() if name.endswith(PICKLE_SUFFIX)):
        if len(content) > MAX_PICKLE_BYTES:
            raise ValueError(f"a pickle larger than {MAX_PICKLE_BYTES:,} bytes")
        tuples, previous, count = set[str](), "", 0
        for code, argument, _ in pickletools.genops(content):
            if code.name in ("BINPUT", "LONG_BINPUT", "PUT", "MEMOIZE"):
                key = str(count if code.name == "MEMOIZE" else argument)
                count += 1
                if "TUPLE" in previous:
                    tuples.add(key)
            elif code.name in ("BINGET", "LONG_BINGET", "GET") and str(argument) in tuples:
                raise ValueError("a tuple occurs more than once among its weights")
            previous = code.name


def _read_weights(content: bytes) -> dict[str, Floats]:
    torch = import_optional("torch")  # imported late: other parts of the package need no torch
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


def _read_box(space: dict[str, Any]) -> Box:
    if not space[":type:"].endswith(".Box'>"):
        raise ValueError(f"{space[':type:']} is not a Box")
    low, high = (np.array(space[name].strip("[]").split(), np.float64) for name in ("low", "high"))
    if not [*low.shape] == [*high.shape] == space["_shape"]:
        raise ValueError("a space does not have one axis")
    return Box(low, high, dtype=np.float64)


def _find_actor(weights: dict[str, Floats]) -> _Actor:
    for actor in ACTORS:
        others = [name for name in weights if not name.startswith((actor.hidden, actor.output or actor.hidden))]
        if len(others) < len(weights) and all(name.startswith(actor.others) for name in others):
            return actor
    raise ValueError("its weights are not those of an MlpPolicy with continuous actions")


def _read_options(data: dict[str, Any], actor: _Actor) -> tuple[Callable[[Floats], Floats], bool]:
    """Return the activation of the hidden layers, and whether the output is a tanh."""
    options = dict(data["policy_kwargs"])
    name = re.sub(r".*\.|'>", "", options.pop("activation_fn", actor.activation))
    if not data["policy_class"]["__module__"].startswith(POLICY_PACKAGES):
        raise ValueError("its policy class is not one of Stable-Baselines3")
    if not isinstance(is_squashed := options.pop("squash_output", False), bool):
        raise ValueError("squash_output is neither true nor false")
    if unknown := options.keys() - HARMLESS_POLICY_OPTIONS:
        raise ValueError(f"policy_kwargs {min(unknown)}")
    if name not in ACTIVATIONS:
        raise ValueError(f"activation {name}; known: {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS[name], is_squashed or actor.is_squashed


def _read_layers(weights: dict[str, Floats], actor: _Actor) -> list[tuple[Floats, Floats]]:
    inner = [name.removeprefix(actor.hidden) for name in weights if name.startswith(actor.hidden)]
    numbers = sorted({int(name.partition(".")[0]) for name in inner})
    names = [*(f"{actor.hidden}{number}." for number in numbers), *filter(None, (actor.output,))]
    if len(inner) != 2 * len(numbers):
        raise ValueError("layers that are not linear")
    layers = [(weights[f"{name}weight"], weights[f"{name}bias"]) for name in names]
    sizes = [weight.shape[1] for weight, _ in layers[1:]]
    if [len(bias) for _, bias in layers[:-1]] != sizes or any(w.shape[:1] != b.shape for w, b in layers):
        raise ValueError("layers that do not fit together")
    return layers
