"""Learners: algorithms of Stable-Baselines3 with a `train()` that learns from the whole episodes of Algorithm 1."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn
from torch.distributions import Normal

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.learners.experience import Experience
from unjam.learners.settings import LearnerSettings, PolicySettings
from unjam.physics.arrays import square_root

Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class AgentSpec:
    """What a learner is made for: the inputs of its networks, and the bounds of the residual."""

    inputs: int
    """number of inputs of the policy"""
    critic_inputs: int
    """number of additional inputs of the critic"""
    action_limit: float
    """largest acceleration of a CAV [m/s2]"""
    policy: PolicySettings
    seed: int


class Update(NamedTuple):
    """The data of one update."""

    environment_rows: Experience | None
    """environment rows of this iteration; None after its first update"""
    model_rows: Experience | None
    share: float
    """share of the gradient steps of the iteration that this update makes"""
    environment_steps: int
    """number of environment steps of all iterations"""


class Learner:
    """An algorithm of SB3 for residuals; subclasses make it and fill its buffer."""

    gamma: float
    """discount from one action of the network to the next"""
    sb3: Any
    """SB3's algorithm: its `train()` needs a filled buffer, a logger, and the spaces of an environment"""

    def __init__(
        self, spec: AgentSpec, algorithm: type[BaseAlgorithm], policy: type[BasePolicy], **kwargs: Any
    ) -> None:
        """Make SB3's algorithm; `kwargs` are its own."""
        authority = spec.policy.authority * spec.action_limit
        env = gymnasium.Env[np.ndarray, np.ndarray]()  # SB3 reads its spaces; it is never stepped
        env.observation_space, env.action_space = policy_spaces(spec.inputs, spec.critic_inputs, authority)
        self.spec, self.gamma = spec, kwargs["gamma"]
        residual = {"settings": spec.policy, "inputs": spec.inputs, "action_limit": spec.action_limit}
        kwargs["policy_kwargs"] = residual | kwargs.get("policy_kwargs", {})
        self.sb3 = algorithm(policy=policy, env=env, seed=spec.seed, device="cpu", **kwargs)
        self.sb3.set_logger(Logger(None, []))

    def network(self) -> Network:
        """Return the policy as a NumPy network."""
        return self.sb3.policy.network()

    def exploring_network(self, environment_steps: int) -> Network:
        """Return the network that explores in the environment after this number of steps."""
        return self.network()

    def is_learning(self, environment_steps: int) -> bool:
        """Whether updates change the policy after this number of environment steps; before, there are no rollouts."""
        return True

    def set_value_scale(self, environment_rows: Experience) -> None:
        """Set the scale of the values from the rows of the first iteration."""

    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual at n observations, before any squashing, shape (n,)."""
        raise NotImplementedError

    def learn(self, update: Update) -> None:
        """Fill SB3's buffer and call its `train()`."""
        raise NotImplementedError

    def log(self) -> dict[str, float]:
        """Return what SB3 logs about its updates."""
        return {key.partition("/")[2]: float(value) for key, value in self.sb3.logger.name_to_value.items()}

    def check_parameters(self, iteration: int) -> None:
        """Raise `UnjamError` if a parameter is not finite, or the exploration noise has vanished."""
        for name, parameter in self.sb3.policy.named_parameters():
            if not parameter.isfinite().all():
                raise UnjamError(f"learner: {name} is not finite in iteration {iteration}")
            if name == "log_std" and not parameter.exp().all():
                raise UnjamError(f"learner: exploration has ended in iteration {iteration}: a smaller step helps")

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return counters and tensors to resume exactly; there is no random state, since each update is seeded."""
        tensors: Tensors = {}
        for part, state in self.sb3.get_parameters().items():
            if "param_groups" in state:  # an optimizer
                for index, entry in state["state"].items():
                    tensors |= {f"{part}/{index}/{name}": tensor for name, tensor in entry.items()}
            else:
                tensors |= {f"{part}/{name}": tensor for name, tensor in state.items()}
        return {"updates": self.sb3._n_updates}, tensors

    def restore(self, counters: dict[str, Any], tensors: Tensors) -> None:
        """Resume from what `state` of a learner with the same configuration returned."""
        parts = self.sb3.get_parameters()
        self.sb3.set_parameters({part: _restored_state(part, state, tensors) for part, state in parts.items()})
        self.sb3._n_updates = counters["updates"]


def make_learner(settings: LearnerSettings, spec: AgentSpec) -> Learner:
    """Return a new learner of the class that its settings name."""
    module, _, name = settings.learner_class.partition(":")
    return getattr(import_module(module), name)(spec, settings)


def _restored_state(part: str, initial_state: dict[str, Any], tensors: Tensors) -> dict[str, Any]:
    """Return the stored state of a part of a learner in torch's form; `initial_state` is that of a new one."""
    stored = tensors_with_prefix(f"{part}/", tensors)
    if "param_groups" not in initial_state:
        return stored
    entries: dict[int, Tensors] = {}
    for name, tensor in stored.items():
        index, _, key = name.partition("/")
        entries.setdefault(int(index), {})[key] = tensor
    return {"state": entries, "param_groups": initial_state["param_groups"]}


def tensors_with_prefix(prefix: str, tensors: Tensors) -> Tensors:
    """Return copies of the tensors with names that begin with `prefix`, without it."""
    return {name.removeprefix(prefix): t.clone() for name, t in tensors.items() if name.startswith(prefix)}


def policy_spaces(inputs: int, critic_inputs: int, authority: float) -> tuple[spaces.Box, spaces.Box]:
    """Return observation and action space; `authority` [m/s2] bounds the mean, and noise may exceed it."""
    actions = spaces.Box(-authority, authority, (1,), np.float32)
    return spaces.Box(-np.inf, np.inf, (inputs + critic_inputs,), np.float32), actions


def network_layers(module: nn.Module) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return weight and bias of each linear layer as a `Network` takes them: float64 copies, inputs first."""
    linear = [(layer.weight, layer.bias) for layer in module.modules() if isinstance(layer, nn.Linear)]
    arrays = [[tensor.detach().cpu().numpy().astype(np.float64) for tensor in pair] for pair in linear]
    return tuple((weight.T.copy(), bias) for weight, bias in arrays)


def zero_layer(layer: nn.Linear) -> None:
    """Set weights and bias of a layer to zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)


def policy_distance(p: Normal, q: Normal) -> Tensor:
    """Return the total variation between Gaussians, eps_pi of the paper's bound, row by row, shape (n,), in [0, 1].

    It is the difference of the probabilities between the crossings of the densities, and invariant under squashing.
    """
    p, q = (Normal(each.mean.double(), each.stddev.double()) for each in (p, q))
    m, s, n, t = p.mean, p.stddev, q.mean, q.stddev
    # p = q where (x-m)^2/s^2 - (x-n)^2/t^2 + 2 log(s/t) = 0
    a = 1 / s**2 - 1 / t**2
    b = 2 * (n / t**2 - m / s**2)
    c = m**2 / s**2 - n**2 / t**2 + 2 * torch.log(s / t)
    is_equal_width = a.abs() < 1e-9 / s**2  # then they cross once, half-way
    root = square_root((b**2 - 4 * a * c).clip(0))
    denominator = 2 * torch.where(is_equal_width, torch.ones_like(a), a)
    low, high = ((-b + sign * root) / denominator for sign in (-1, 1))
    between = ((p.cdf(high) - p.cdf(low)) - (q.cdf(high) - q.cdf(low))).abs()
    return torch.where(is_equal_width, torch.erf((m - n).abs() / (2 * 2**0.5 * s)), between)
