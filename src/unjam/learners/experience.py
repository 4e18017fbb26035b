"""Experience: trajectories in the form in which learners take them, and how SB3's buffers are filled with it."""

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
    """Trajectories one after the other, with one row per action of the network."""

    observations: Float32
    """inputs of the actor, then those of the critic alone, shape (rows, inputs + critic inputs)"""
    actions: Float32
    """residuals [m/s2], shape (rows,)"""
    rewards: Float64
    """sums while each residual was held, shape (rows,)"""
    starts: NDArray[np.intp]
    """first row of each trajectory, shape (trajectories,)"""
    last_observations: Float32
    """observation at the end of each trajectory, shape (trajectories, inputs + critic inputs)"""
    terminated: NDArray[np.bool_]
    """whether it ended in a collision, shape (trajectories,); otherwise it was truncated and is bootstrapped"""

    @property
    def last_rows(self) -> NDArray[np.intp]:
        """Last row of each trajectory, shape (trajectories,)."""
        return np.append(self.starts[1:], len(self.rewards)) - 1

    @property
    def next_observations(self) -> Float32:
        """Observation after each row, of the shape of `observations`."""
        after = np.empty_like(self.observations)
        after[:-1] = self.observations[1:]
        after[self.last_rows] = self.last_observations
        return after


def make_experience(
    trajectories: Sequence[Trajectory],
    critic_inputs: Sequence[Sequence[float]] | Float64,
    returns_after_exit: Sequence[float | None] | None = None,
) -> Experience:
    """Return the experience of trajectories, each with the `critic_inputs` of the critic alone.

    One with a return after its exit, discounted to its last action, counts as terminated; others are bootstrapped.
    """
    residuals, rewards = zip(*(trajectory.actions_and_rewards for trajectory in trajectories), strict=True)
    terminated = [trajectory.terminated for trajectory in trajectories]
    for number, later in enumerate(returns_after_exit or ()):
        if later is not None:
            rewards[number][-1] += later
            terminated[number] = True
    observations = [
        np.column_stack([trajectory.observations, np.tile(extra, (len(trajectory.observations), 1))])
        for trajectory, extra in zip(trajectories, critic_inputs, strict=True)
    ]
    return Experience(
        observations=np.concatenate([rows[:-1] for rows in observations]).astype(np.float32),
        actions=np.concatenate(residuals).astype(np.float32),
        rewards=np.concatenate(rewards),
        starts=np.cumsum([0, *(len(each) for each in rewards[:-1])]).astype(np.intp),
        last_observations=np.concatenate([rows[-1:] for rows in observations]).astype(np.float32),
        terminated=np.array(terminated),
    )


def join_experience(parts: Sequence[Experience]) -> Experience:
    """Return the experience of all parts, one after the other."""
    joined = {each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Experience)}
    offsets = np.cumsum([0, *(len(part.rewards) for part in parts[:-1])])
    joined["starts"] += np.repeat(offsets, [len(part.starts) for part in parts])
    return Experience(**joined)


@torch.no_grad()
def fill_rollout_buffer(buffer: RolloutBuffer, policy: ActorCriticPolicy, rows: Experience) -> None:
    """Fill `buffer` with rows and compute their advantages; to truncated trajectories gamma V of their end is added.

    Values and log-probabilities are computed in one batch, so that the ratio before the first update is exactly 1.
    """
    actions, observations = rows.actions[:, None], torch.as_tensor(rows.observations)
    values, log_probs, _ = policy.evaluate_actions(observations, torch.as_tensor(actions))
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
    """Add rows to the buffer, in place of the oldest ones if it is full; only collisions set `dones`.

    SB3 stores actions as shares of their bounds, here of the `authority` [m/s2].
    """
    done = np.zeros(len(rewards), np.float32)
    done[rows.last_rows] = rows.terminated
    indices = (buffer.pos + np.arange(len(rewards))) % buffer.buffer_size
    buffer.observations[indices, 0] = rows.observations
    buffer.next_observations[indices, 0] = rows.next_observations
    buffer.actions[indices, 0, 0] = rows.actions / np.float32(authority)
    buffer.rewards[indices, 0] = rewards
    buffer.dones[indices, 0] = done
    end = buffer.pos + len(rewards)
    buffer.full = buffer.full or end >= buffer.buffer_size
    buffer.pos = end % buffer.buffer_size


class MixedReplayBuffer(ReplayBuffer):
    """SB3's replay buffer of environment rows; while it has model rows too, batches are mixed."""

    model_buffer: ReplayBuffer | None = None
    real_ratio = 1.0
    """share of environment rows in a batch"""

    def new_model_buffer(self, rows: int) -> ReplayBuffer:
        """Return an empty buffer for a number of model rows, which replaces the previous one."""
        spaces = self.observation_space, self.action_space
        self.model_buffer = ReplayBuffer(rows, *spaces, self.device, handle_timeout_termination=False)
        return self.model_buffer

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Return a random batch."""
        if self.model_buffer is None:
            return super().sample(batch_size, env)
        real = round(self.real_ratio * batch_size)
        parts = [super().sample(real)] if real else []
        if real < batch_size:
            parts.append(self.model_buffer.sample(batch_size - real))
        return ReplayBufferSamples(*(torch.cat(part) for part in zip(*(each[:5] for each in parts), strict=True)))


def shift_rewards(rows: Experience, offset: float, gamma: float) -> Float64:
    """Return the rewards minus `offset`, shape (rows,), so that all values decrease by offset / (1 - gamma).

    At a collision, which no reward follows, the last reward decreases by the missing part.
    """
    rewards = rows.rewards - offset
    rewards[rows.last_rows] -= np.where(rows.terminated, offset * gamma / (1.0 - gamma), 0.0)
    return rewards


def discounted_returns(rows: Experience, gamma: float) -> Float64:
    """Return discounted rewards from each row on, (rows,); truncated trajectories continue with their mean reward."""
    returns = np.empty(len(rows.rewards))
    for first, last, terminated in zip(rows.starts, rows.last_rows, rows.terminated, strict=True):
        later = 0.0 if terminated else float(rows.rewards[first : last + 1].mean()) / (1.0 - gamma)
        for row in range(last, first - 1, -1):
            later = returns[row] = rows.rewards[row] + gamma * later
    return returns
