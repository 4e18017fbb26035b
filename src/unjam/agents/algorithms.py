"""Learners of Stable-Baselines3, fed with whole episodes.

They are extended at the two methods that are meant for it: `collect_rollouts` gets episodes from the
workers, `train` is where the virtual environment has its place, before the update.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import TRPO
from stable_baselines3.common.logger import Logger

from unjam.agents.buffers import discounted_returns, fill_rollout_buffer
from unjam.agents.policy import ResidualPolicy, policy_spaces
from unjam.agents.settings import PolicySettings, TRPOSettings
from unjam.drivers.network import Network
from unjam.scenarios.scenario import Scenario
from unjam.traffic.record import Episode, Trajectory

Collect = Callable[[Network, int], Sequence[Episode]]
"""(policy, iteration) -> the episodes of this iteration, driven with exploration"""

NEVER = 2**31


@dataclass(frozen=True)
class Iteration:
    """What one iteration did: Algorithm 1, once around."""

    number: int
    """from 1"""
    episodes: Sequence[Episode]
    actual_steps: int
    """of all iterations so far"""
    virtual_steps: int
    """of all iterations so far"""
    log: dict[str, float]
    """what the learner says about its update"""
    seconds: dict[str, float]
    """wall time of each part"""


class SpacesOnly(gymnasium.Env[np.ndarray, np.ndarray]):
    """The environment that Stable-Baselines3 asks for its spaces; nobody steps it."""

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self._nothing = np.zeros(observation_space.low.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return zeros: Stable-Baselines3 resets before it learns."""
        return self._nothing, {}


class EpisodicTRPO(TRPO):
    """TRPO whose rollouts are whole episodes from worker processes."""

    policy: ResidualPolicy  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        inputs: int,
        scenario: Scenario,
        policy: PolicySettings,
        settings: TRPOSettings,
        seed: int,
        collect: Collect,
        after_iteration: Callable[[Iteration], None],
    ) -> None:
        """Make the learner; `inputs` is how many numbers the policy sees."""
        critic_inputs = len(scenario.drawn_ranges) if policy.critic_sees_road else 0
        super().__init__(
            ResidualPolicy,
            SpacesOnly(*policy_spaces(inputs, critic_inputs, policy.authority * scenario.action_limit)),
            learning_rate=settings.critic_rate,
            n_steps=settings.critic_batch,  # the buffer takes the size of the episodes, see buffers.py
            batch_size=settings.critic_batch,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            target_kl=settings.target_kl,
            cg_damping=settings.cg_damping,
            cg_max_steps=settings.cg_steps,
            n_critic_updates=settings.critic_epochs,
            policy_kwargs={
                "settings": policy,
                "inputs": inputs,
                "action_limit": scenario.action_limit,
                # SB3 drops its own eps when given arguments for the optimiser.
                "optimizer_kwargs": {"eps": 1e-5, "weight_decay": settings.value_l2},
            },
            seed=seed,
            device="cpu",
        )
        self.set_logger(Logger(None, []))
        self.iteration = 0
        """iterations done"""
        self.run_seed = seed
        self._scenario = scenario
        self._critic_sees_road = policy.critic_sees_road
        self._normalise_value = policy.normalise_value
        self._collect = collect
        self._after_iteration = after_iteration

    def run(self, actual_steps: int) -> None:
        """Learn until this many actual steps were made in all, earlier runs of this learner included."""
        self.learn(actual_steps - self.num_timesteps, log_interval=NEVER, reset_num_timesteps=False)

    def collect_rollouts(self, *arguments: Any, **named: Any) -> bool:
        """Fill the rollout buffer with the episodes of one iteration."""
        started = time.perf_counter()
        self.iteration += 1
        self._episodes = self._collect(self.policy.network(), self.iteration)
        self.num_timesteps += sum(episode.steps for episode in self._episodes)
        self._seconds = {"actual": time.perf_counter() - started}
        return True

    def train(self) -> None:
        """Update policy and value network with the rows of this iteration."""
        started = time.perf_counter()
        seed_iteration(self.run_seed, self.iteration)
        trajectories = [trajectory for episode in self._episodes for trajectory in episode.trajectories]
        if self._normalise_value and self.iteration == 1:
            self._scale_value(trajectories)
        # Here the virtual environment will fit its model, imagine rollouts, and add their rows.
        fill_rollout_buffer(self.rollout_buffer, self.policy, trajectories, self._critic_inputs())
        super().train()
        self._seconds["update"] = time.perf_counter() - started
        log = {key.partition("/")[2]: float(value) for key, value in self.logger.name_to_value.items()}
        self._after_iteration(
            Iteration(self.iteration, self._episodes, self.num_timesteps, 0, log, self._seconds)
        )

    def _critic_inputs(self) -> list[tuple[float, ...]]:
        """Return, for each trajectory of the iteration, what the value network alone sees."""
        return [
            self._scenario.drawn_scaled(episode.drawn) if self._critic_sees_road else ()
            for episode in self._episodes
            for _ in episode.trajectories
        ]

    def _scale_value(self, trajectories: Sequence[Trajectory]) -> None:
        returns = discounted_returns(trajectories, self.gamma)
        self.policy.scale_value(float(returns.mean()), float(max(returns.std(), 1e-3)))


def seed_iteration(run_seed: int, iteration: int) -> None:
    """Seed every generator that an update uses, from the run's seed and the iteration alone.

    So a run that goes on from a checkpoint draws what the uninterrupted one would have drawn.
    """
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, 1]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))
