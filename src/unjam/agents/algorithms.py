"""The learners: Algorithm 1 over those of Stable-Baselines3. Each learns from the rows of an iteration."""

from collections.abc import Callable
from typing import Any, cast

import sb3_contrib
from stable_baselines3.common.buffers import RolloutBuffer

from unjam.agents.buffers import Rows, discounted_returns, fill_rollout_buffer
from unjam.agents.episodic import Episodic, Training
from unjam.agents.policy import ResidualPolicy
from unjam.agents.settings import TRPOSettings


class OnPolicy(Episodic):
    """What learners share that learn from the rows of the current policy alone."""

    rollout_buffer: RolloutBuffer
    gamma: float

    def fill(self, rows: Rows) -> None:
        """Put the rows of an iteration into the rollout buffer, in place of those of the one before."""
        policy = cast(ResidualPolicy, self.policy)
        if self.training.policy.normalise_value and self.iteration == 1:
            returns = discounted_returns(rows, self.gamma)
            policy.scale_value(float(returns.mean()), float(max(returns.std(), 1e-3)))
        fill_rollout_buffer(self.rollout_buffer, policy, rows)


class TRPO(OnPolicy, sb3_contrib.TRPO):
    """Trust region policy optimisation from whole episodes."""

    def __init__(self, training: Training, settings: TRPOSettings) -> None:
        super().__init__(
            training,
            ResidualPolicy,
            # SB3 drops its own eps when given arguments for the optimiser.
            {"optimizer_kwargs": {"eps": 1e-5, "weight_decay": settings.value_l2}},
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
        with self.learning() as rows:  # virtual rows will join the actual ones here
            self.fill(rows)
            super().train()


LEARNERS: dict[str, Callable[[Training, Any], Episodic]] = {"trpo": TRPO}
"""every learner by name: made of what it learns on and its own settings"""
