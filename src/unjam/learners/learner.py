"""What a learner is: an algorithm of Stable-Baselines3, held, whose `train()` learns from whole episodes.

Algorithm 1 asks a learner who drives, gives it actual and virtual experience, and keeps its state. The two
numbers that hang on the distribution of the residual (eps_pi of the paper's bound) are measured here.
"""

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
    """What a learner is made for: what its networks see, and how far the residual may go."""

    inputs: int
    """how many numbers the policy sees"""
    critic_inputs: int
    """how many more the critic sees"""
    action_limit: float
    """largest acceleration of a CAV [m/s2]"""
    policy: PolicySettings
    seed: int
    """of the whole run"""


class Update(NamedTuple):
    """What one update learns from."""

    environment_rows: Experience | None
    """of this iteration; None in the updates of an iteration after its first"""
    model_rows: Experience | None
    share: float
    """of all that the iteration's updates do"""
    environment_steps: int
    """of all iterations so far"""


class Learner:
    """An algorithm of SB3 for residuals; those that follow make it and fill its buffer."""

    gamma: float
    """discount from one choice of a residual to the next"""
    sb3: Any
    """SB3's algorithm: its `train()` needs a filled buffer, a logger, and an environment's spaces"""

    def __init__(
        self,
        spec: AgentSpec,
        algorithm: type[BaseAlgorithm],
        policy: type[BasePolicy],
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        """Make SB3's algorithm with its own `arguments`."""
        authority = spec.policy.authority * spec.action_limit
        env = gymnasium.Env[np.ndarray, np.ndarray]()  # SB3 asks for its spaces; nobody steps it
        env.observation_space, env.action_space = policy_spaces(spec.inputs, spec.critic_inputs, authority)
        self.spec = spec
        self.gamma = kwargs["gamma"]
        self.sb3 = algorithm(
            policy=policy,
            env=env,
            policy_kwargs={
                "settings": spec.policy,
                "inputs": spec.inputs,
                "action_limit": spec.action_limit,
                **(policy_kwargs or {}),
            },
            seed=spec.seed,
            device="cpu",
            **kwargs,
        )
        self.sb3.set_logger(Logger(None, []))

    def network(self) -> Network:
        """Return the policy's NumPy twin."""
        return self.sb3.policy.network()

    def exploring_network(self, environment_steps: int) -> Network:
        """Return the network that drives, exploring, after so many actual steps."""
        return self.network()

    def is_learning(self, environment_steps: int) -> bool:
        """Whether updates change the policy after so many actual steps; before, nothing is imagined."""
        return True

    def set_value_scale(self, environment_rows: Experience) -> None:
        """Take the units of returns from the first iteration's actual rows."""

    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual at n observations, before any squashing, shape (n,)."""
        raise NotImplementedError

    def learn(self, update: Update) -> None:
        """Fill SB3's buffer and call its `train()`."""
        raise NotImplementedError

    def log(self) -> dict[str, float]:
        """Return what SB3 says about its updates."""
        return {key.partition("/")[2]: float(value) for key, value in self.sb3.logger.name_to_value.items()}

    def check_parameters(self, iteration: int) -> None:
        """Raise `UnjamError` where a parameter is not finite, or so small that nothing is explored."""
        for name, parameter in self.sb3.policy.named_parameters():
            if not parameter.isfinite().all():
                raise UnjamError(f"learner: {name} is not finite in iteration {iteration}")
            if name == "log_std" and not parameter.exp().all():
                raise UnjamError(f"learner: exploration has ended in iteration {iteration}: a smaller step helps")

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all that it must keep to go on exactly where it stopped, as plain numbers and tensors.

        No random state is among them: each update seeds its generators anew.
        """
        tensors: Tensors = {}
        for part, state in self.sb3.get_parameters().items():
            if "param_groups" in state:  # an optimiser
                for index, entry in state["state"].items():
                    tensors |= {f"{part}/{index}/{name}": tensor for name, tensor in entry.items()}
            else:
                tensors |= {f"{part}/{name}": tensor for name, tensor in state.items()}
        return {"updates": self.sb3._n_updates}, tensors

    def restore(self, counters: dict[str, Any], tensors: Tensors) -> None:
        """Put a learner made from the same configuration into what `state` returned."""
        parts = self.sb3.get_parameters()
        self.sb3.set_parameters({part: _restored_state(part, state, tensors) for part, state in parts.items()})
        self.sb3._n_updates = counters["updates"]


def make_learner(settings: LearnerSettings, spec: AgentSpec) -> Learner:
    """Return a new learner of the kind that its settings name."""
    module, _, name = settings.learner_class.partition(":")
    return getattr(import_module(module), name)(spec, settings)


def _restored_state(part: str, initial_state: dict[str, Any], tensors: Tensors) -> dict[str, Any]:
    """Return the kept state of a part of a learner in the form of torch; `fresh` is that of a new one."""
    kept = tensors_with_prefix(f"{part}/", tensors)
    if "param_groups" not in initial_state:
        return kept
    entries: dict[int, Tensors] = {}
    for name, tensor in kept.items():
        index, _, key = name.partition("/")
        entries.setdefault(int(index), {})[key] = tensor
    return {"state": entries, "param_groups": initial_state["param_groups"]}


def tensors_with_prefix(prefix: str, tensors: Tensors) -> Tensors:
    """Return copies of those tensors whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): t.clone() for name, t in tensors.items() if name.startswith(prefix)}


def policy_spaces(inputs: int, critic_inputs: int, authority: float) -> tuple[spaces.Box, spaces.Box]:
    """Return the observation and action space of a residual policy; `authority` in m/s2.

    The bounds are those of the residual's mean. With its exploration noise it may lie beyond them: what is
    clipped is the full policy, expert plus residual.
    """
    return (
        spaces.Box(-np.inf, np.inf, (inputs + critic_inputs,), np.float32),
        spaces.Box(-authority, authority, (1,), np.float32),
    )


def network_layers(module: nn.Module) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return weight and bias of each linear layer as a `Network` takes them: float64 copies, inputs first."""

    def to_array(tensor: Tensor) -> np.ndarray:
        return tensor.detach().cpu().numpy().astype(np.float64)

    linear = [layer for layer in module.modules() if isinstance(layer, nn.Linear)]
    return tuple((to_array(layer.weight).T.copy(), to_array(layer.bias)) for layer in linear)


def policy_distance(p: Normal, q: Normal) -> Tensor:
    """Return the total variation between Gaussians, row by row, shape (n,), in [0, 1].

    Half the integral of |p - q|: between the places where the densities cross, the difference of the
    probabilities. It is the same after any squashing that keeps the order.
    """
    p, q = (Normal(each.mean.double(), each.stddev.double()) for each in (p, q))
    m, s, n, t = p.mean, p.stddev, q.mean, q.stddev
    # p = q where (x-m)^2/s^2 - (x-n)^2/t^2 + 2 log(s/t) = 0
    a = 1 / s**2 - 1 / t**2
    b = 2 * (n / t**2 - m / s**2)
    c = m**2 / s**2 - n**2 / t**2 + 2 * torch.log(s / t)
    same = a.abs() < 1e-9 / s**2
    root = square_root((b**2 - 4 * a * c).clip(0))
    # Of equal widths they cross once, half-way.
    low, high = ((-b + sign * root) / (2 * torch.where(same, torch.ones_like(a), a)) for sign in (-1, 1))
    between = ((p.cdf(high) - p.cdf(low)) - (q.cdf(high) - q.cdf(low))).abs()
    once = torch.erf((m - n).abs() / (2 * 2**0.5 * s))
    return torch.where(same, once, between)
