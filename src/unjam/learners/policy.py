"""The residual policy that learns, in torch, and its NumPy twin that drives in the workers."""

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from unjam.drivers.network import Network
from unjam.learners.settings import PolicySettings


class BoundedTanh(nn.Module):
    """`authority * tanh(x)`: keeps the mean of the residual within its bounds (paper, section 3.3.2)."""

    def __init__(self, authority: float) -> None:
        super().__init__()
        self.authority = authority

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the bounded mean, of the shape of `features`."""
        return self.authority * torch.tanh(features)


class ScaledValue(nn.Module):
    """A value head in the units of the returns: `mean + std * linear(x)`, with fixed mean and std."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, 1)
        self.scale: torch.Tensor
        self.register_buffer("scale", torch.tensor([0.0, 1.0]))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the value, shape (n, 1)."""
        return self.scale[0] + self.scale[1] * self.linear(features)


class ActorAndCritic(nn.Module):
    """Hidden layers of both networks; the critic may see more than the actor.

    SB3 hands both the same vector: what the actor sees, then what the critic alone sees.
    """

    def __init__(self, inputs: int, critic_inputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.inputs = inputs
        self.policy_net = _layers(inputs, hidden)
        self.value_net = _layers(
            inputs + critic_inputs, hidden
        )  # TRPO tells the critic by `value` in its name
        self.latent_dim_pi = self.latent_dim_vf = hidden[-1]

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last hidden layers of actor and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return the actor's last hidden layer."""
        return self.policy_net(features[:, : self.inputs])

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Return the critic's last hidden layer."""
        return self.value_net(features)


def _layers(inputs: int, hidden: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for size in hidden:
        layers += [nn.Linear(inputs, size), nn.ReLU()]
        inputs = size
    return nn.Sequential(*layers)


class ResidualPolicy(ActorCriticPolicy):
    """SB3's actor-critic policy with a bounded mean that is zero at the start.

    The last layer of the actor starts at zero, so that the full policy starts as exactly the expert.
    """

    def __init__(
        self, *arguments: Any, settings: PolicySettings, inputs: int, action_limit: float, **named: Any
    ) -> None:
        self.settings = settings
        self.inputs = inputs
        self.authority = settings.authority * action_limit
        super().__init__(*arguments, log_std_init=math.log(settings.exploration_std * action_limit), **named)

    def _build_mlp_extractor(self) -> None:
        critic_inputs = self.features_dim - self.inputs
        self.mlp_extractor = ActorAndCritic(self.inputs, critic_inputs, self.settings.hidden)  # pyright: ignore[reportAttributeAccessIssue]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        last = nn.Linear(self.mlp_extractor.latent_dim_pi, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.action_net = nn.Sequential(last, BoundedTanh(self.authority))
        self.value_net = ScaledValue(self.mlp_extractor.latent_dim_vf)  # pyright: ignore[reportAttributeAccessIssue]
        nn.init.orthogonal_(self.value_net.linear.weight)
        nn.init.zeros_(self.value_net.linear.bias)
        if not self.settings.learn_exploration:
            log_std = self.log_std.detach()
            del self.log_std
            self.register_buffer("log_std", log_std)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # pyright: ignore[reportCallIssue]

    def set_rates(self, actor: float, critic: float) -> None:
        """Give actor and critic learning rates of their own, in a new optimiser."""
        groups: dict[bool, list[nn.Parameter]] = {False: [], True: []}
        for name, parameter in self.named_parameters():
            groups["value" in name].append(parameter)
        self.optimizer = torch.optim.Adam(
            [{"params": groups[False], "lr": actor}, {"params": groups[True], "lr": critic}],
            eps=1e-5,
            fused=True,  # see `unjam.kernels`
        )

    def scale_value(self, mean: float, std: float) -> None:
        """Fix the units of the value head."""
        self.value_net.scale.copy_(torch.tensor([mean, std]))  # pyright: ignore[reportCallIssue]

    def network(self) -> Network:
        """Return the NumPy twin: the same residual to 1e-6, and the same exploration noise."""
        layers = network_layers(nn.Sequential(self.mlp_extractor.policy_net, self.action_net))  # pyright: ignore[reportArgumentType]
        return Network(layers, self.authority, float(torch.exp(self.log_std.detach()).item()))


def network_layers(module: nn.Module) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return weight and bias of each linear layer as a `Network` takes them: float64 copies, inputs first."""
    return tuple(
        (_array(layer.weight).T.copy(), _array(layer.bias))
        for layer in module.modules()
        if isinstance(layer, nn.Linear)
    )


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)


def policy_spaces(inputs: int, critic_inputs: int, authority: float) -> tuple[spaces.Box, spaces.Box]:
    """Return the observation and action space of a residual policy; `authority` in m/s2.

    The bounds are those of the residual's mean. With its exploration noise it may lie beyond them: what is
    clipped is the full policy, expert plus residual.
    """
    return (
        spaces.Box(-np.inf, np.inf, (inputs + critic_inputs,), np.float32),
        spaces.Box(-authority, authority, (1,), np.float32),
    )
