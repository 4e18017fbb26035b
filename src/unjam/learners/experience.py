"""Experience: trajectories in the form in which learners take them, and how it is made of episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from unjam.errors import InputError, UnjamError
from unjam.learners.agent import AgentSpec
from unjam.physics.arrays import Floats
from unjam.text import format_count
from unjam.worlds.record import Episode, Trajectory

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Experience:
    """Trajectories one after the other, with one row per action of the network."""

    observations: Float32
    """inputs of the actor, then those of the critic alone, shape (rows, inputs + critic inputs)"""
    actions: Float32
    """residuals [m/s2], shape (rows,)"""
    rewards: Floats
    """sums while each residual was held, shape (rows,)"""
    starts: NDArray[np.intp]
    """index of the first row of each trajectory, of one CAV in one episode, shape (trajectories,)"""
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
    critic_inputs: Sequence[Sequence[float]] | Floats,
    returns_after_exit: Sequence[float | None] | None = None,
) -> Experience:
    """Return trajectories, with `critic_inputs`, as experience; those with a return after their exit are terminated."""
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


def discounted_returns(rows: Experience, gamma: float) -> Floats:
    """Return discounted rewards from each row on, (rows,); truncated trajectories continue with their mean reward."""
    returns = np.empty(len(rows.rewards))
    for first, last, terminated in zip(rows.starts, rows.last_rows, rows.terminated, strict=True):
        later = 0.0 if terminated else float(rows.rewards[first : last + 1].mean()) / (1.0 - gamma)
        for row in range(last, first - 1, -1):
            later = returns[row] = rows.rewards[row] + gamma * later
    return returns


def environment_experience(spec: AgentSpec, episodes: Sequence[Sequence[Episode]], iteration: int) -> Experience:
    """Return the experience of the episodes of all tasks; raise `UnjamError` if some of it is not finite."""
    rows = join_experience([task_experience(spec, index, each) for index, each in enumerate(episodes)])
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(rows, name)).all():
            raise UnjamError(f"learner: {name} of iteration {iteration} are not finite")
    return rows


def task_experience(spec: AgentSpec, task_index: int, episodes: Sequence[Episode]) -> Experience:
    """Return the experience of episodes of a task; raise `InputError` if no CAV was on the road."""
    policy, scenario = spec.policy, spec.tasks[task_index].scenario
    pairs = [(episode, trajectory) for episode in episodes for trajectory in episode.trajectories]
    if not pairs:
        count = format_count(len(episodes), "episode")
        raise InputError(f"penetration_rate: no CAV was on the road in {count}; allowed: a higher penetration rate")
    drawn_values = np.array([scenario.scale_drawn_values(episode.drawn_values) for episode, _ in pairs])
    critic_inputs, later = spec.privileged_inputs(task_index, drawn_values), None
    if policy.reward_after_exit:
        entry_times = [trajectory.start_step / scenario.horizon for _, trajectory in pairs]
        critic_inputs = np.column_stack([critic_inputs, entry_times])
        later = [return_after_exit(*pair, spec.gamma, scenario.horizon) for pair in pairs]
    return make_experience([trajectory for _, trajectory in pairs], critic_inputs, later)


def return_after_exit(episode: Episode, trajectory: Trajectory, gamma: float, horizon: int) -> float | None:
    """Return rewards after a CAV left, discounted to its last action; None if it stayed or the episode is truncated."""
    end = trajectory.step_slice.stop
    goes_on = episode.status != "collision" and not np.isnan(episode.speeds[-1]).all()
    if end >= episode.control_steps or trajectory.terminated or (goes_on and episode.control_steps < horizon):
        return None
    rewards = np.add.reduceat(episode.reward[end:], np.arange(0, episode.control_steps - end, trajectory.action_repeat))
    return float(rewards @ gamma ** np.arange(1, len(rewards) + 1))
