"""TRPO and PPO, which learn only from rows of the current policy, and the residual policy for them."""

import math
from typing import Any, cast

import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import create_mlp
from torch import Tensor, nn
from torch.distributions import Normal

from unjam.adam import Adam
from unjam.drivers.network import Network, append_ones
from unjam.learners.agent import AgentSpec
from unjam.learners.experience import Experience, discounted_returns
from unjam.learners.learner import Update
from unjam.learners.sb3_learner import SB3Learner, fill_rollout_buffer, network_layers, zero_layer
from unjam.learners.settings import PolicySettings, PPOSettings, TRPOSettings


class BoundedTanh(nn.Module):
    """Layer `authority * tanh(x)`, which bounds the mean of the residual (paper, section 3.3.2)."""

    def __init__(self, authority: float) -> None:
        super().__init__()
        self.authority = authority

    def forward(self, features: Tensor) -> Tensor:
        """Return the bounded mean, of the shape of `features`."""
        return self.authority * torch.tanh(features)


class ScaledValue(nn.Module):
    """A value head `mean + std * linear(x)` with the fixed mean and standard deviation of the returns."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, 1)
        self.scale: Tensor
        """mean and standard deviation"""
        self.register_buffer("scale", torch.tensor([0.0, 1.0]))

    def forward(self, features: Tensor) -> Tensor:
        """Return the value, shape (n, 1)."""
        return self.scale[0] + self.scale[1] * self.linear(features)


class ActorCriticExtractor(nn.Module):
    """Hidden layers of actor and critic; the actor uses the first `inputs` columns of observations, the critic all."""

    def __init__(self, inputs: int, critic_inputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.inputs = inputs
        self.policy_net = nn.Sequential(*create_mlp(inputs, -1, list(hidden)))  # -1: no output layer
        # TRPO recognizes the parameters of the critic by `value` in their names.
        self.value_net = nn.Sequential(*create_mlp(inputs + critic_inputs, -1, list(hidden)))
        self.latent_dim_pi = self.latent_dim_vf = hidden[-1]

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs of the last hidden layers of actor and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the output of the actor's last hidden layer."""
        return self.policy_net(features[:, : self.inputs])

    def forward_critic(self, features: Tensor) -> Tensor:
        """Return the output of the critic's last hidden layer."""
        return self.value_net(features)


class ResidualPolicy(ActorCriticPolicy):
    """SB3's actor-critic policy for a residual with a bounded mean, which is zero at the start with `zero_init`."""

    def __init__(self, *args: Any, settings: PolicySettings, inputs: int, action_limit: float, **kwargs: Any) -> None:
        self.settings, self.inputs, self.authority = settings, inputs, settings.authority * action_limit
        kwargs |= {"log_std_init": math.log(settings.exploration_std * action_limit), "use_sde": settings.episode_noise}
        super().__init__(*args, optimizer_class=Adam, **kwargs)

    def _build_mlp_extractor(self) -> None:
        critic_inputs = self.features_dim - self.inputs
        self.mlp_extractor = ActorCriticExtractor(self.inputs, critic_inputs, self.settings.hidden)  # pyright: ignore[reportAttributeAccessIssue]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        last_layer = nn.Linear(self.mlp_extractor.latent_dim_pi, 1)
        if self.settings.zero_init:
            zero_layer(last_layer)
        self.action_net = nn.Sequential(last_layer, BoundedTanh(self.authority))
        self.value_net = ScaledValue(self.mlp_extractor.latent_dim_vf)  # pyright: ignore[reportAttributeAccessIssue]
        nn.init.orthogonal_(self.value_net.linear.weight)
        nn.init.zeros_(self.value_net.linear.bias)
        if self.settings.episode_noise or not self.settings.learn_exploration_std:
            log_std = self.log_std.detach()
            if self.settings.episode_noise:
                log_std = torch.cat([log_std, log_std[:1]])  # one more for the bias
            del self.log_std
            self.register_buffer("log_std", log_std)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # pyright: ignore[reportCallIssue]

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        """Return SB3's distribution; per-episode noise also perturbs the bias, so that dead units explore."""
        if not self.settings.episode_noise:
            return super()._get_action_dist_from_latent(latent_pi)
        mean = self.action_net(latent_pi)
        return self.action_dist.proba_distribution(mean, self.log_std, append_ones(latent_pi))  # pyright: ignore[reportCallIssue]

    def set_learning_rates(self, actor: float, critic: float) -> None:
        """Make a new optimizer with separate learning rates of actor and critic."""
        parameters = list(self.named_parameters())
        groups = [
            {"params": [parameter for name, parameter in parameters if ("value" in name) is is_critic], "lr": rate}
            for is_critic, rate in ((False, actor), (True, critic))
        ]
        self.optimizer = Adam(groups, eps=1e-5, fused=True)  # fused: see `unjam.kernels`

    def scale_value(self, mean: float, std: float) -> None:
        """Set mean and standard deviation of the value head."""
        self.value_net.scale.copy_(torch.tensor([mean, std]))  # pyright: ignore[reportCallIssue]

    def network(self) -> Network:
        """Return the policy as a NumPy network with the same residual (to 1e-6) and the same exploration noise."""
        layers = network_layers(nn.Sequential(self.mlp_extractor.policy_net, self.action_net))  # pyright: ignore[reportArgumentType]
        std = float(torch.exp(self.log_std.detach()).flatten()[0].item())
        return Network(layers, self.authority, std, self.settings.episode_noise)


class OnPolicyLearner(SB3Learner):
    """Base class of learners that learn only from rows of the current policy."""

    def set_value_scale(self, environment_rows: Experience) -> None:
        """Scale the value head by the returns of these rows."""
        if self.spec.policy.normalize_value:
            returns = discounted_returns(environment_rows, self.gamma)
            self.sb3.policy.scale_value(float(returns.mean()), float(max(returns.std(), 1e-3)))

    def policy_parameters(self) -> list[Tensor]:
        """Return the parameters of the policy."""
        return [parameter for name, parameter in self.sb3.policy.named_parameters() if "value" not in name]

    @torch.no_grad()
    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual [m/s2], shape (n,)."""
        normal = cast(Normal, self.sb3.policy.get_distribution(observations).distribution)
        return Normal(normal.mean.squeeze(1), normal.stddev.squeeze(1))

    def learn(self, update: Update) -> None:
        """Update policy and value network with environment and model rows together."""
        self.fill_buffer(update.rows)
        self.sb3.train()

    def fill_buffer(self, rows: Experience) -> None:
        """Fill the rollout buffer with rows."""
        fill_rollout_buffer(self.sb3.rollout_buffer, self.sb3.policy, rows)


class TRPO(OnPolicyLearner):
    """Trust region policy optimization on whole episodes."""

    def __init__(self, spec: AgentSpec, settings: TRPOSettings) -> None:
        decay = settings.critic_weight_decay
        super().__init__(
            spec,
            sb3_contrib.TRPO,
            ResidualPolicy,
            # With optimizer arguments, SB3 does not add its default eps. Fused: see `unjam.kernels`.
            policy_kwargs={"optimizer_kwargs": {"eps": 1e-5, "weight_decay": decay, "fused": True}},
            learning_rate=settings.critic_learning_rate,
            n_steps=settings.critic_batch_size,  # the buffer is resized to the episodes
            batch_size=settings.critic_batch_size,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            target_kl=settings.target_kl,
            cg_damping=settings.cg_damping,
            cg_max_steps=settings.cg_max_steps,
            n_critic_updates=settings.critic_epochs,
        )


class PPO(OnPolicyLearner):
    """Proximal policy optimization on whole episodes."""

    def __init__(self, spec: AgentSpec, settings: PPOSettings) -> None:
        super().__init__(
            spec,
            SeparateRatesPPO,
            ResidualPolicy,
            n_epochs=settings.epochs,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            clip_range=settings.clip_range,
            # SB3 clips the gradients of actor and critic together, although those of the critic are much larger.
            max_grad_norm=math.inf,
        )
        self._minibatches = settings.minibatches
        self.sb3.policy.set_learning_rates(settings.actor_learning_rate, settings.critic_learning_rate)

    def fill_buffer(self, rows: Experience) -> None:
        """Fill the rollout buffer with rows, and set the batch size."""
        super().fill_buffer(rows)
        self.sb3.batch_size = math.ceil(len(rows.rewards) / self._minibatches)


class SeparateRatesPPO(stable_baselines3.PPO):
    """SB3's PPO for an optimizer with separate learning rates of actor and critic."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        """Do nothing, because SB3 would set the same rate for actor and critic."""
