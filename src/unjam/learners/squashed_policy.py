"""The residual policy of soft actor-critic: its noise depends on what it sees, and comes before the tanh."""

import math
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from unjam.drivers.network import Network
from unjam.learners.policy import network_layers
from unjam.learners.settings import PolicySettings

UNIFORM_STD = 0.85
"""standard deviation of normal noise whose tanh is uniform in [-1, 1] to one per cent"""


class ActorView(BaseFeaturesExtractor):
    """What the actor sees: the first numbers of an observation; the critic alone sees the others."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the first columns, shape (n, inputs)."""
        return observations[:, : self.features_dim]


class NormalisedReLU(nn.Module):
    """Layer normalisation, then ReLU: keeps critics from promising much where there is no data.

    Source: Ball et al. 2023, Efficient online reinforcement learning with offline data.
    """

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the normalised units, of the shape of `features`."""
        return torch.relu(nn.functional.layer_norm(features, features.shape[-1:]))


class SquashedResidualPolicy(SACPolicy):
    """SB3's policy of soft actor-critic with a residual that is zero at the start, with a little noise.

    The last layer of the actor starts at zero but for the size of the noise, `exploration_std`.
    """

    def __init__(
        self, *arguments: Any, settings: PolicySettings, inputs: int, action_limit: float, **named: Any
    ) -> None:
        self.inputs = inputs
        self.authority = settings.authority * action_limit
        self._first_std = settings.exploration_std / settings.authority
        super().__init__(
            *arguments, net_arch=list(settings.hidden), optimizer_kwargs={"fused": True}, **named
        )
        self.reward_offset: torch.Tensor
        self.register_buffer("reward_offset", torch.zeros((), dtype=torch.float64))

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Return the actor, which sees the first `inputs` numbers."""
        actor = super().make_actor(ActorView(self.observation_space, self.inputs))
        for layer, bias in ((actor.mu, 0.0), (actor.log_std, math.log(self._first_std))):
            linear = cast(nn.Linear, layer)
            nn.init.zeros_(linear.weight)
            nn.init.constant_(linear.bias, bias)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Return a pair of critics, which see all and normalise their hidden layers."""
        self.critic_kwargs["activation_fn"] = NormalisedReLU
        return super().make_critic(features_extractor)

    def network(self) -> Network:
        """Return the NumPy twin: the same residual to 1e-6, the same exploration noise."""
        layers = network_layers(nn.Sequential(self.actor.latent_pi, self.actor.mu, self.actor.log_std))  # pyright: ignore[reportArgumentType]
        *hidden, (mean, mean_bias), (log_std, log_std_bias) = layers
        last = np.hstack([mean, log_std]), np.hstack([mean_bias, log_std_bias])
        return Network((*hidden, last), self.authority)


def uniform_network(inputs: int, authority: float) -> Network:
    """Return a network whose residuals, exploring, are uniform over its authority [m/s2]."""
    return Network(((np.zeros((inputs, 2)), np.array([0.0, math.log(UNIFORM_STD)])),), authority)
