"""What all learners share: an iteration is made of whole episodes, and learned from at once.

Learners of Stable-Baselines3 are extended at the two methods that are meant for it: `collect_rollouts` gets
episodes from the workers, `train` learns from their rows.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import RolloutReturn

from unjam.agents.buffers import Rows, rows_of
from unjam.agents.policy import policy_spaces
from unjam.agents.settings import PolicySettings
from unjam.drivers.network import Network
from unjam.scenarios.scenario import Scenario
from unjam.traffic.record import Episode

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


@dataclass(frozen=True)
class Training:
    """What a learner learns on, whichever it is."""

    inputs: int
    """how many numbers the policy sees"""
    scenario: Scenario
    policy: PolicySettings
    seed: int
    """of the whole run"""
    collect: Collect
    after_iteration: Callable[[Iteration], None]


class SpacesOnly(gymnasium.Env[np.ndarray, np.ndarray]):
    """The environment that Stable-Baselines3 asks for its spaces; nobody steps it."""

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self._nothing = np.zeros(observation_space.low.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return zeros: Stable-Baselines3 resets before it learns."""
        return self._nothing, {}


class Episodic(BaseAlgorithm):
    """A learner whose rollouts are whole episodes from worker processes; stands before one of SB3's."""

    def __init__(
        self,
        training: Training,
        policy: type[BasePolicy],
        policy_arguments: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        """Make SB3's learner with its own `arguments`."""
        settings, scenario = training.policy, training.scenario
        critic_inputs = len(scenario.drawn_ranges) if settings.critic_sees_road else 0
        super().__init__(
            policy=policy,
            env=SpacesOnly(
                *policy_spaces(training.inputs, critic_inputs, settings.authority * scenario.action_limit)
            ),
            policy_kwargs={
                "settings": settings,
                "inputs": training.inputs,
                "action_limit": scenario.action_limit,
                **(policy_arguments or {}),
            },
            seed=training.seed,
            device="cpu",
            **arguments,
        )
        self.set_logger(Logger(None, []))
        self.training = training
        self.iteration = 0
        """iterations done"""
        self._episodes: Sequence[Episode] = ()
        self._seconds: dict[str, float] = {}

    def run(self, actual_steps: int) -> None:
        """Learn until this many actual steps were made in all, earlier runs of this learner included."""
        self.learn(actual_steps - self.num_timesteps, log_interval=NEVER, reset_num_timesteps=False)

    def network(self) -> Network:
        """Return the policy's NumPy twin."""
        return self.policy.network()  # pyright: ignore[reportCallIssue]

    def exploring_network(self) -> Network:
        """Return the network that drives, exploring, the next episodes of this learner."""
        return self.network()

    def collect_rollouts(self, *arguments: Any, **named: Any) -> Any:
        """Collect the episodes of one iteration; count their actual steps, whatever the learner counts."""
        started = time.perf_counter()
        self.iteration += 1
        self._episodes = self.training.collect(self.exploring_network(), self.iteration)
        steps = sum(episode.steps for episode in self._episodes)
        self.num_timesteps += steps
        self._seconds = {"actual": time.perf_counter() - started}
        # What off-policy learners of SB3 ask for; the others ask only whether it is true.
        return RolloutReturn(steps, len(self._episodes), continue_training=True)

    @contextmanager
    def learning(self) -> Iterator[Rows]:
        """Give the actual rows of this iteration to whoever learns from them, then tell of the iteration."""
        started = time.perf_counter()
        seed_iteration(self.training.seed, self.iteration)
        yield self._rows()
        self._seconds["update"] = time.perf_counter() - started
        log = {key.partition("/")[2]: float(value) for key, value in self.logger.name_to_value.items()}
        self.training.after_iteration(
            Iteration(self.iteration, self._episodes, self.num_timesteps, 0, log, self._seconds)
        )

    def _rows(self) -> Rows:
        scenario, sees_road = self.training.scenario, self.training.policy.critic_sees_road
        pairs = [
            (trajectory, scenario.drawn_scaled(episode.drawn) if sees_road else ())
            for episode in self._episodes
            for trajectory in episode.trajectories
        ]
        return rows_of([trajectory for trajectory, _ in pairs], [extra for _, extra in pairs])


def seed_iteration(run_seed: int, iteration: int) -> None:
    """Seed every generator that an update uses, from the run's seed and the iteration alone.

    So a run that goes on from a checkpoint draws what the uninterrupted one would have drawn.
    """
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, 1]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))
