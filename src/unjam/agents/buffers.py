"""From trajectories to the rows that Stable-Baselines3 learns from."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy

from unjam.traffic.record import Trajectory


def fill_rollout_buffer(
    buffer: RolloutBuffer,
    policy: ActorCriticPolicy,
    trajectories: Sequence[Trajectory],
    critic_inputs: Sequence[tuple[float, ...]],
) -> None:
    """Fill `buffer` with whole trajectories, one behind the other, and compute their advantages.

    Values and log-probabilities are computed here, in one batch, so that the ratio before the first update
    is exactly 1. A trajectory that was cut (by the horizon, or by leaving the road) is bootstrapped:
    gamma V of where it ended is folded into its last reward. One that ended in a collision is not.

    `critic_inputs` has, for each trajectory, what the value network alone sees.
    """
    looks = [trajectory.looks for trajectory in trajectories]
    seen = [
        np.column_stack([trajectory.observations, np.tile(extra, (len(trajectory.observations), 1))])
        for trajectory, extra in zip(trajectories, critic_inputs, strict=True)
    ]
    observations = _float32([rows[:-1] for rows in seen])
    actions = _float32([residual[:, None] for residual, _ in looks])
    rewards = _float32([earned for _, earned in looks])
    ends = np.cumsum([len(earned) for _, earned in looks])
    last_observations = _float32([rows[-1:] for rows in seen])
    with torch.no_grad():
        values, log_probs, _ = policy.evaluate_actions(_tensor(observations), _tensor(actions))
        last_values = policy.predict_values(_tensor(last_observations)).numpy().ravel()
    cut = np.array([not trajectory.terminated for trajectory in trajectories])
    rewards[ends - 1] += buffer.gamma * np.where(cut, last_values, 0.0).astype(np.float32)

    buffer.buffer_size = len(rewards)
    buffer.reset()
    buffer.observations[:, 0] = observations
    buffer.actions[:, 0] = actions
    buffer.rewards[:, 0] = rewards
    buffer.episode_starts[np.concatenate([[0], ends[:-1]]), 0] = 1.0
    buffer.values[:, 0] = values.numpy().ravel()
    buffer.log_probs[:, 0] = log_probs.numpy()
    buffer.pos, buffer.full = len(rewards), True
    buffer.compute_returns_and_advantage(torch.zeros(1), np.ones(1, bool))


def discounted_returns(trajectories: Sequence[Trajectory], gamma: float) -> NDArray[np.float64]:
    """Return the discounted sum of the rewards that follow each look, all trajectories behind each other.

    The end of a cut trajectory counts as if it went on at its mean reward.
    """
    returns = []
    for trajectory in trajectories:
        _, earned = trajectory.looks
        later = 0.0 if trajectory.terminated else float(earned.mean()) / (1.0 - gamma)
        found = np.empty(len(earned))
        for step in range(len(found) - 1, -1, -1):
            later = found[step] = earned[step] + gamma * later
        returns.append(found)
    return np.concatenate(returns)


def _float32(parts: list[NDArray[np.float64]]) -> NDArray[np.float32]:
    return np.concatenate(parts).astype(np.float32)


def _tensor(array: NDArray[np.float32]) -> torch.Tensor:
    return torch.as_tensor(array)
