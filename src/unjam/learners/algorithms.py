"""The learners: Algorithm 1 over those of Stable-Baselines3. Each learns from the rows of an iteration."""

import math
from collections.abc import Callable
from typing import Any, cast

import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from torch.distributions import Normal

from unjam.drivers.network import Network
from unjam.learners.divergence import Gaussians
from unjam.learners.episodic import Episodic, Training
from unjam.learners.policy import ResidualPolicy
from unjam.learners.rows import (
    MixedReplayBuffer,
    Rows,
    add_to_replay_buffer,
    discounted_returns,
    fill_rollout_buffer,
    shifted_rewards,
)
from unjam.learners.settings import PPOSettings, SACSettings, TRPOSettings
from unjam.learners.squashed_policy import SquashedResidualPolicy, uniform_network

SIZED_LATER = 2
"""stands for the size of rollout buffer and batch until an iteration says how many rows it has"""


class OnPolicy(Episodic):
    """What learners share that learn from the rows of the current policy alone."""

    rollout_buffer: RolloutBuffer
    gamma: float

    def measure_units(self, rows: Rows) -> None:
        """Scale the value head by the returns of actual rows."""
        if self.training.policy.normalise_value:
            returns = discounted_returns(rows, self.gamma)
            policy = cast(ResidualPolicy, self.policy)
            policy.scale_value(float(returns.mean()), float(max(returns.std(), 1e-3)))

    def gaussians(self, observations: torch.Tensor) -> Gaussians:
        """Return mean and standard deviation of the residual."""
        with torch.no_grad():
            distribution = cast(ResidualPolicy, self.policy).get_distribution(observations).distribution
        normal = cast(Normal, distribution)
        return Gaussians(normal.mean.squeeze(1), normal.stddev.squeeze(1))

    def fill(self, rows: Rows) -> None:
        """Put rows into the rollout buffer, in place of those before."""
        fill_rollout_buffer(self.rollout_buffer, cast(ResidualPolicy, self.policy), rows)


class TRPO(OnPolicy, sb3_contrib.TRPO):
    """Trust region policy optimisation from whole episodes."""

    def __init__(self, training: Training, settings: TRPOSettings) -> None:
        super().__init__(
            training,
            ResidualPolicy,
            # SB3 drops its own eps when given arguments for the optimiser. Fused: see `unjam.kernels`.
            {"optimizer_kwargs": {"eps": 1e-5, "weight_decay": settings.value_l2, "fused": True}},
            learning_rate=settings.critic_rate,
            n_steps=settings.critic_batch,  # the buffer takes the size of the episodes, see buffers.py
            batch_size=settings.critic_batch,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            target_kl=settings.target_kl,
            cg_damping=settings.cg_damping,
            cg_max_steps=settings.cg_steps,
            n_critic_updates=settings.critic_epochs,
        )

    def train(self) -> None:
        """Update policy and value network with the rows of this iteration."""
        for update in self.updates():
            self.fill(update.rows)
            super().train()


class PPO(OnPolicy, stable_baselines3.PPO):
    """Proximal policy optimisation from whole episodes."""

    def __init__(self, training: Training, settings: PPOSettings) -> None:
        super().__init__(
            training,
            ResidualPolicy,
            n_steps=SIZED_LATER,
            batch_size=SIZED_LATER,
            n_epochs=settings.epochs,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            clip_range=settings.clip,
            # SB3 clips the gradients of actor and critic together; they share no weight, and the critic's
            # gradient, in the units of returns, would leave nothing of the actor's.
            max_grad_norm=math.inf,
        )
        self._minibatches = settings.minibatches
        cast(ResidualPolicy, self.policy).set_rates(settings.actor_rate, settings.critic_rate)

    def train(self) -> None:
        """Update policy and value network with the rows of this iteration."""
        for update in self.updates():
            rows = update.rows
            self.fill(rows)
            self.batch_size = math.ceil(len(rows.rewards) / self._minibatches)
            super().train()

    def _update_learning_rate(self, optimizers: Any) -> None:
        """Leave the rates as they are: SB3 would set one for actor and critic."""


class SAC(Episodic, stable_baselines3.SAC):
    """Soft actor-critic from whole episodes, and from those of earlier iterations."""

    def __init__(self, training: Training, settings: SACSettings) -> None:
        temperature = settings.temperature
        super().__init__(
            training,
            SquashedResidualPolicy,
            learning_rate=settings.rate,
            replay_buffer_class=MixedReplayBuffer,
            buffer_size=settings.buffer_rows,
            learning_starts=0,  # see train
            batch_size=settings.batch,
            tau=settings.tau,
            gamma=settings.gamma,
            replay_buffer_kwargs={"handle_timeout_termination": False},  # a cut is no end in our rows
            ent_coef=f"auto_{temperature}" if settings.learn_temperature else temperature,
            target_entropy=settings.target_entropy,
        )
        self._settings = settings

    @property
    def _starting(self) -> bool:
        return self.num_timesteps < self._settings.start_steps

    def exploring_network(self) -> Network:
        """Return the policy's twin; before the first update, what the settings say."""
        if self._starting and self._settings.start == "uniform":
            return uniform_network(self.training.inputs, cast(SquashedResidualPolicy, self.policy).authority)
        return self.network()

    def train(self, *arguments: Any, **named: Any) -> None:
        """Add the rows of this iteration to the replay buffer, and update actor and critics from it."""
        # Those of the start are made up for at its end: before it drives, the policy has seen them.
        owed = round(self.num_timesteps * self._settings.updates_per_step) - self._n_updates
        buffer = cast(MixedReplayBuffer, self.replay_buffer)
        for update in self.updates():
            if update.actual is not None:
                self.fill(buffer, update.actual)
            buffer.forget_virtual()
            if update.virtual is not None:
                self.fill(buffer.begin_virtual(len(update.virtual.rewards)), update.virtual)
                buffer.real_ratio = 0.0 if update.actual is None else self._settings.real_ratio
            if not self._starting:
                steps = max(1, round(owed * update.share))
                super().train(gradient_steps=steps, batch_size=self.batch_size)
        buffer.forget_virtual()

    @property
    def wants_virtual(self) -> bool:
        """Whether the start is over: before it, nothing is learned."""
        return not self._starting

    def measure_units(self, rows: Rows) -> None:
        """Shift rewards by the mean of actual rows."""
        if self.training.policy.normalise_value:
            cast(SquashedResidualPolicy, self.policy).reward_offset.fill_(rows.rewards.mean())

    def gaussians(self, observations: torch.Tensor) -> Gaussians:
        """Return mean and standard deviation of the residual before the tanh."""
        with torch.no_grad():
            mean, log_std, _ = self.actor.get_action_dist_params(observations)
        return Gaussians(mean.squeeze(1), log_std.squeeze(1).exp())

    def fill(self, buffer: ReplayBuffer, rows: Rows) -> None:
        """Add rows to a replay buffer, their rewards shifted and scaled."""
        policy = cast(SquashedResidualPolicy, self.policy)
        rewards = shifted_rewards(rows, policy.reward_offset.item(), self.gamma)
        add_to_replay_buffer(buffer, rows, policy.authority, rewards * self._settings.reward_scale)


LEARNERS: dict[str, Callable[[Training, Any], Episodic]] = {"trpo": TRPO, "ppo": PPO, "sac": SAC}
"""every learner by name: made of what it learns on and its own settings"""
