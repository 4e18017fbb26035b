"""From trajectories to experience, the form in which learners take it, and into SB3's buffers."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from unjam.worlds.record import Trajectory

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Experience:
    """What a learner learns from: one row per choice of the network, trajectories one behind the other."""

    observations: Float32
    """what the actor sees, then what the critic alone sees, shape (rows, inputs + critic inputs)"""
    actions: Float32
    """residuals that the network chose [m/s2], shape (rows,)"""
    rewards: Float64
    """what was earned while each residual was held, shape (rows,)"""
    starts: NDArray[np.intp]
    """first row of each trajectory, shape (trajectories,)"""
    last_observations: Float32
    """where each trajectory ended, shape (trajectories, inputs + critic inputs)"""
    terminated: NDArray[np.bool_]
    """whether a collision ended it, shape (trajectories,); otherwise it was cut and is bootstrapped"""

    @property
    def last_rows(self) -> NDArray[np.intp]:
        """Last row of each trajectory, shape (trajectories,)."""
        return np.append(self.starts[1:], len(self.rewards)) - 1

    @property
    def next_observations(self) -> Float32:
        """What was seen after each row, of the shape of `observations`."""
        after = np.empty_like(self.observations)
        after[:-1] = self.observations[1:]
        after[self.last_rows] = self.last_observations
        return after


def make_experience(
    trajectories: Sequence[Trajectory],
    critic_inputs: Sequence[Sequence[float]] | Float64,
    returns_after_exit: Sequence[float | None] | None = None,
) -> Experience:
    """Return the experience of trajectories.

    `critic_inputs` has, for each, what the critic alone sees; `afterwards` what was earned after its end,
    discounted to its last choice: it then is no cut. None: the value of where it ended stands for that.
    """
    choices = [trajectory.actions_and_rewards for trajectory in trajectories]
    ended = [trajectory.terminated for trajectory in trajectories]
    for number, more in enumerate(returns_after_exit or ()):
        if more is not None:
            choices[number][1][-1] += more
            ended[number] = True
    seen = [
        np.column_stack([trajectory.observations, np.tile(extra, (len(trajectory.observations), 1))])
        for trajectory, extra in zip(trajectories, critic_inputs, strict=True)
    ]
    counts = [len(earned) for _, earned in choices]
    return Experience(
        observations=np.concatenate([rows[:-1] for rows in seen]).astype(np.float32),
        actions=np.concatenate([residual for residual, _ in choices]).astype(np.float32),
        rewards=np.concatenate([earned for _, earned in choices]),
        starts=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp),
        last_observations=np.concatenate([rows[-1:] for rows in seen]).astype(np.float32),
        terminated=np.array(ended),
    )


def join_experience(parts: Sequence[Experience]) -> Experience:
    """Return the experience of all parts, one behind the other: actual and virtual ones, say."""
    joined = {each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Experience)}
    before = np.cumsum([0, *(len(part.rewards) for part in parts[:-1])])
    joined["starts"] += np.repeat(before, [len(part.starts) for part in parts])
    return Experience(**joined)


@torch.no_grad()
def fill_rollout_buffer(buffer: RolloutBuffer, policy: ActorCriticPolicy, rows: Experience) -> None:
    """Fill `buffer` with rows and compute their advantages.

    Values and log-probabilities are computed here, in one batch, so that the ratio before the first update
    is exactly 1. A trajectory that was cut (by the horizon, by leaving the road, at the end of a virtual
    rollout) is bootstrapped: gamma V of where it ended is folded into its last reward. One that ended in a
    collision is not.
    """
    actions, seen = rows.actions[:, None], torch.as_tensor(rows.observations)
    values, log_probs, _ = policy.evaluate_actions(seen, torch.as_tensor(actions))
    last_values = policy.predict_values(torch.as_tensor(rows.last_observations)).numpy().ravel()
    rewards = rows.rewards.astype(np.float32)
    rewards[rows.last_rows] += buffer.gamma * np.where(rows.terminated, 0.0, last_values).astype(np.float32)

    buffer.buffer_size = len(rewards)
    buffer.reset()
    buffer.observations[:, 0] = rows.observations
    buffer.actions[:, 0] = actions
    buffer.rewards[:, 0] = rewards
    buffer.episode_starts[rows.starts, 0] = 1.0
    buffer.values[:, 0] = values.numpy().ravel()
    buffer.log_probs[:, 0] = log_probs.numpy()
    buffer.pos, buffer.full = len(rewards), True
    buffer.compute_returns_and_advantage(torch.zeros(1), np.ones(1, bool))


def add_to_replay_buffer(buffer: ReplayBuffer, rows: Experience, authority: float, rewards: Float64) -> None:
    """Add rows to those of earlier iterations, in place of the oldest where the buffer is full.

    Only a collision ends what is to be earned: a trajectory that was cut goes on with the value of where it
    ended. SB3 keeps actions as shares of their bounds, here of the `authority` [m/s2].
    """
    done = np.zeros(len(rewards), np.float32)
    done[rows.last_rows] = rows.terminated
    places = (buffer.pos + np.arange(len(rewards))) % buffer.buffer_size
    buffer.observations[places, 0] = rows.observations
    buffer.next_observations[places, 0] = rows.next_observations
    buffer.actions[places, 0, 0] = rows.actions / np.float32(authority)
    buffer.rewards[places, 0] = rewards
    buffer.dones[places, 0] = done
    end = buffer.pos + len(rewards)
    buffer.full = buffer.full or end >= buffer.buffer_size
    buffer.pos = end % buffer.buffer_size


class MixedReplayBuffer(ReplayBuffer):
    """SB3's replay buffer of actual rows; while it has virtual ones too, a batch is made of both."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._model_buffer: ReplayBuffer | None = None
        self.real_ratio = 1.0
        """share of actual rows in a batch"""

    def new_model_buffer(self, rows: int) -> ReplayBuffer:
        """Return an empty buffer for so many virtual rows, in place of the one before."""
        spaces = self.observation_space, self.action_space
        self._model_buffer = ReplayBuffer(rows, *spaces, self.device, handle_timeout_termination=False)
        return self._model_buffer

    def drop_model_buffer(self) -> None:
        """Sample actual rows alone from now on."""
        self._model_buffer = None

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Return a random batch."""
        if self._model_buffer is None:
            return super().sample(batch_size, env)
        real = round(self.real_ratio * batch_size)
        parts = [super().sample(real)] if real else []
        if real < batch_size:
            parts.append(self._model_buffer.sample(batch_size - real))
        joined = [torch.cat(part) for part in zip(*(each[:5] for each in parts), strict=True)]
        return ReplayBufferSamples(*joined)


def shift_rewards(rows: Experience, offset: float, gamma: float) -> Float64:
    """Return the rewards less `offset`, shape (rows,), so that the same policies are the best ones.

    What follows a row is then worth less by offset / (1 - gamma), wherever it is; after a collision, where
    nothing follows, the last reward is less by what is missing.
    """
    rewards = rows.rewards - offset
    rewards[rows.last_rows] -= np.where(rows.terminated, offset * gamma / (1.0 - gamma), 0.0)
    return rewards


def discounted_returns(rows: Experience, gamma: float) -> Float64:
    """Return the discounted sum of the rewards that follow each row, shape (rows,).

    The end of a cut trajectory counts as if it went on at its mean reward.
    """
    returns = np.empty(len(rows.rewards))
    for first, last, terminated in zip(rows.starts, rows.last_rows, rows.terminated, strict=True):
        earned = rows.rewards[first : last + 1]
        later = 0.0 if terminated else float(earned.mean()) / (1.0 - gamma)
        for row in range(last, first - 1, -1):
            later = returns[row] = rows.rewards[row] + gamma * later
    return returns
