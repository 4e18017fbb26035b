"""SAC and TD3, which learn from a replay buffer with two critics, and the residual policies for them."""

import math
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import Tensor, nn
from torch.distributions import Normal

from unjam.adam import Adam
from unjam.drivers.network import Network
from unjam.learners import sb3_learner
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Tensors
from unjam.learners.experience import Experience
from unjam.learners.learner import Update
from unjam.learners.settings import OffPolicySettings, PolicySettings, SACSettings, TD3Settings

UNIFORM_STD = 0.85
"""standard deviation of normal noise, the tanh of which is uniform in [-1, 1] to one percent"""
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones")
REPLAY_POSITION = ("pos", "full")
"""attributes of a replay buffer: index of the next row, and whether the buffer is full"""


def uniform_network(inputs: int, authority: float) -> Network:
    """Return a network that explores with residuals that are uniform over its authority [m/s2]."""
    return Network(((np.zeros((inputs, 2)), np.array([0.0, math.log(UNIFORM_STD)])),), authority)


class ActorInputExtractor(BaseFeaturesExtractor):
    """Layer that takes the inputs of the actor, the first columns of an observation; the critic gets all columns."""

    def forward(self, observations: Tensor) -> Tensor:
        """Return the inputs of the actor, shape (n, inputs)."""
        return observations[:, : self.features_dim]


class NormalizedReLU(nn.Module):
    """Layer normalization and ReLU, which bound critics far from data (Ball et al. 2023, Efficient online RL)."""

    def forward(self, features: Tensor) -> Tensor:
        """Return the normalized features, of the same shape."""
        return torch.relu(nn.functional.layer_norm(features, features.shape[-1:]))


class OffPolicyResidualMixin(BasePolicy):
    """Base class of SB3's policies with two critics for a residual, which is zero at the start with `zero_init`."""

    critic_kwargs: dict[str, Any]
    reward_offset: Tensor
    """mean reward, which is subtracted from all rewards"""

    def __init__(self, *args: Any, settings: PolicySettings, inputs: int, action_limit: float, **kwargs: Any) -> None:
        self.settings, self.inputs, self.authority = settings, inputs, settings.authority * action_limit
        kwargs |= {"optimizer_class": Adam, "optimizer_kwargs": {"fused": True}}
        super().__init__(*args, net_arch=list(settings.hidden), **kwargs)
        self.register_buffer("reward_offset", torch.zeros((), dtype=torch.float64))

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Return the actor, which uses the first `inputs` columns of observations."""
        actor = super().make_actor(ActorInputExtractor(self.observation_space, self.inputs))  # pyright: ignore[reportAttributeAccessIssue]
        if self.settings.zero_init:
            sb3_learner.zero_layer([layer for layer in actor.mu.modules() if isinstance(layer, nn.Linear)][-1])
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Return both critics, which use all columns of observations and normalize their hidden layers."""
        self.critic_kwargs["activation_fn"] = NormalizedReLU
        return super().make_critic(features_extractor)  # pyright: ignore[reportAttributeAccessIssue]


class SquashedResidualPolicy(OffPolicyResidualMixin, SACPolicy):
    """SB3's policy of SAC for a residual with the initial standard deviation `exploration_std` of its noise."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Return the actor, which uses the first `inputs` columns of observations."""
        actor = super().make_actor(features_extractor)
        nn.init.zeros_(actor.log_std.weight)
        nn.init.constant_(actor.log_std.bias, math.log(self.settings.exploration_std / self.settings.authority))
        return actor

    def network(self) -> Network:
        """Return the policy as a NumPy network with the same residual (to 1e-6) and the same exploration noise."""
        layers = sb3_learner.network_layers(nn.Sequential(self.actor.latent_pi, self.actor.mu, self.actor.log_std))  # pyright: ignore[reportArgumentType]
        *hidden, (mean_weight, mean_bias), (log_std_weight, log_std_bias) = layers
        output = np.hstack([mean_weight, log_std_weight]), np.hstack([mean_bias, log_std_bias])
        return Network((*hidden, output), self.authority)


class DeterministicResidualPolicy(OffPolicyResidualMixin, TD3Policy):
    """SB3's policy of TD3 for a residual."""

    @property
    def exploration_std(self) -> float:
        """Standard deviation of the exploration noise [m/s2]."""
        return self.settings.exploration_std * self.authority / self.settings.authority

    def network(self) -> Network:
        """Return the policy as a NumPy network with the same residual (to 1e-6) and exploration noise."""
        return Network(sb3_learner.network_layers(self.actor.mu), self.authority, self.exploration_std)


class OffPolicyLearner(sb3_learner.SB3Learner):
    """Base class of learners that also use the rows of earlier iterations, from a replay buffer."""

    def __init__(
        self, spec: AgentSpec, settings: OffPolicySettings, algorithm: type, policy: type[BasePolicy], **kwargs: Any
    ) -> None:
        super().__init__(
            spec,
            algorithm,
            policy,
            learning_rate=settings.learning_rate,
            replay_buffer_class=sb3_learner.MixedReplayBuffer,
            buffer_size=settings.buffer_size,
            learning_starts=0,  # `learn` waits for the steps of the settings
            batch_size=settings.batch_size,
            tau=settings.tau,
            gamma=settings.gamma,
            replay_buffer_kwargs={"handle_timeout_termination": False},  # truncated rows have no `dones`
            **kwargs,
        )
        self.settings = settings
        self.buffer: sb3_learner.MixedReplayBuffer = self.sb3.replay_buffer
        self._due_gradient_steps = 0

    def policy_parameters(self) -> list[Tensor]:
        """Return the parameters of the policy."""
        return list(self.sb3.policy.actor.parameters())

    def exploring_network(self, environment_steps: int) -> Network:
        """Return the policy as a NumPy network, or the start policy of the settings before learning starts."""
        if not self.is_learning(environment_steps) and self.settings.start_policy == "uniform":
            return uniform_network(self.spec.inputs, self.sb3.policy.authority)
        return self.network()

    def is_learning(self, environment_steps: int) -> bool:
        """Return whether learning has started."""
        return environment_steps >= self.settings.learning_starts

    def set_value_scale(self, environment_rows: Experience) -> None:
        """Set the mean reward of these rows as the offset of all rewards."""
        if self.spec.policy.normalize_value:
            self.sb3.policy.reward_offset.fill_(environment_rows.rewards.mean())

    def learn(self, update: Update) -> None:
        """Add environment rows to the replay buffer, and update actor and critics with the buffer and model rows."""
        if update.environment_rows is not None:
            # When learning starts, this includes the gradient steps for all environment steps before.
            total_gradient_steps = round(update.environment_steps * self.settings.gradient_steps_per_step)
            self._due_gradient_steps = total_gradient_steps - self.sb3._n_updates
            self.add_rows(self.buffer, update.environment_rows)
        if update.model_rows is not None:
            self.add_rows(self.buffer.new_model_buffer(len(update.model_rows.rewards)), update.model_rows)
            self.buffer.real_ratio = 0.0 if update.environment_rows is None else self.settings.real_ratio
        if self.is_learning(update.environment_steps):
            gradient_steps = max(1, round(self._due_gradient_steps * update.share))
            self.sb3.train(gradient_steps=gradient_steps, batch_size=self.settings.batch_size)
        self.buffer.model_buffer = None

    def add_rows(self, buffer: ReplayBuffer, rows: Experience) -> None:
        """Add rows to a replay buffer, with shifted and scaled rewards."""
        policy = self.sb3.policy
        rewards = sb3_learner.shift_rewards(rows, policy.reward_offset.item(), self.gamma)
        sb3_learner.add_to_replay_buffer(buffer, rows, policy.authority, rewards * self.settings.reward_scale)

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return values and tensors with which a learner resumes, including the replay buffer."""
        values, tensors = super().state()
        values |= {name: getattr(self.buffer, name) for name in REPLAY_POSITION}
        return values, tensors | self._shared_tensors()

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from the values and tensors that `state` returned with the same configuration."""
        super().restore(values, tensors)
        self.buffer.pos, self.buffer.full = range(self.buffer.buffer_size)[values["pos"]], bool(values["full"])
        for name, tensor in self._shared_tensors().items():
            sb3_learner.check_shape(name, tensors[name], tensor.shape)
            tensor.detach().copy_(tensors[name])

    def _shared_tensors(self) -> Tensors:
        """Return the state that is not in SB3's parameters, as tensors that share memory with the learner."""
        row_count = self.buffer.size()
        return {f"replay/{name}": torch.from_numpy(getattr(self.buffer, name)[:row_count]) for name in REPLAY_ARRAYS}


class SAC(OffPolicyLearner):
    """Soft actor-critic on whole episodes."""

    def __init__(self, spec: AgentSpec, settings: SACSettings) -> None:
        coefficient = f"auto_{settings.temperature}" if settings.learn_temperature else settings.temperature
        entropy = {"ent_coef": coefficient, "target_entropy": settings.target_entropy}
        super().__init__(spec, settings, stable_baselines3.SAC, SquashedResidualPolicy, **entropy)

    @torch.no_grad()
    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual before the tanh, shape (n,)."""
        mean, log_std, _ = self.sb3.actor.get_action_dist_params(observations)
        return Normal(mean.squeeze(1), log_std.squeeze(1).exp())

    def _shared_tensors(self) -> Tensors:
        temperature = {} if self.sb3.log_ent_coef is None else {"log_ent_coef": self.sb3.log_ent_coef}
        return super()._shared_tensors() | temperature


class TD3(OffPolicyLearner):
    """Twin delayed deep deterministic policy gradient (Fujimoto, van Hoof and Meger 2018) on whole episodes."""

    def __init__(self, spec: AgentSpec, settings: TD3Settings) -> None:
        noise = {"target_policy_noise": settings.target_noise, "target_noise_clip": settings.target_noise_clip}
        kwargs = {"policy_delay": settings.policy_delay, **noise}
        super().__init__(spec, settings, stable_baselines3.TD3, DeterministicResidualPolicy, **kwargs)

    @torch.no_grad()
    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual with its exploration noise [m/s2], shape (n,)."""
        policy = self.sb3.policy
        mean = policy.authority * policy.actor(observations).squeeze(1)
        return Normal(mean, torch.full_like(mean, policy.exploration_std))
