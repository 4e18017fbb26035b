"""TD3 (Fujimoto, van Hoof and Meger 2018, Addressing function approximation error in actor-critic methods)."""

from typing import cast

import stable_baselines3
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import Tensor, nn
from torch.distributions import Normal

from unjam.drivers.network import Network
from unjam.learners.learner import AgentSpec, network_layers, zero_layer
from unjam.learners.sac import ActorInputExtractor, OffPolicyLearner, OffPolicyResidualMixin
from unjam.learners.settings import TD3Settings


class DeterministicResidualPolicy(OffPolicyResidualMixin, TD3Policy):
    """SB3's policy of TD3 for a residual that starts at zero: with `zero_init`, the actor's last layer is zero."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Return the actor, which takes the first `inputs` inputs."""
        actor = super().make_actor(ActorInputExtractor(self.observation_space, self.inputs))
        if self.settings.zero_init:
            zero_layer(cast(nn.Linear, actor.mu[-2]))  # before the tanh
        return actor

    @property
    def exploration_std(self) -> float:
        """Standard deviation of the exploration noise [m/s2]."""
        return self.settings.exploration_std * self.authority / self.settings.authority

    def network(self) -> Network:
        """Return the policy as a NumPy network: the same residual to 1e-6, and the exploration noise."""
        return Network(network_layers(self.actor.mu), self.authority, self.exploration_std)


class TD3(OffPolicyLearner):
    """Twin delayed deep deterministic policy gradient on whole episodes."""

    def __init__(self, spec: AgentSpec, settings: TD3Settings) -> None:
        kwargs = {
            "policy_delay": settings.policy_delay,
            "target_policy_noise": settings.target_noise,
            "target_noise_clip": settings.target_noise_clip,
        }
        super().__init__(spec, settings, stable_baselines3.TD3, DeterministicResidualPolicy, **kwargs)

    @torch.no_grad()
    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the residual and the standard deviation of its exploration noise [m/s2]."""
        policy = self.sb3.policy
        mean = policy.authority * policy.actor(observations).squeeze(1)
        return Normal(mean, torch.full_like(mean, policy.exploration_std))
