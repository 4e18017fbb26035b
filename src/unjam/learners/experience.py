"""Experience of CAVs: the rows of observations, actions and rewards from which learners learn."""

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
    """Concatenated trajectories of CAVs, with one row per action of the network."""

    observations: Float32
    """inputs of the actor, then the additional inputs of the critic, shape (rows, inputs + critic inputs)"""
    actions: Float32
    """residuals [m/s2], shape (rows,)"""
    rewards: Floats
    """sum of the rewards of the control steps of each action, shape (rows,)"""
    starts: NDArray[np.intp]
    """index of the first row of each trajectory (of one CAV in one episode), shape (trajectories,)"""
    last_observations: Float32
    """observation at the end of each trajectory, shape (trajectories, inputs + critic inputs)"""
    terminated: NDArray[np.bool_]
    """whether nothing follows a trajectory, as after a collision, shape (trajectories,); else it is bootstrapped"""

    @property
    def last_rows(self) -> NDArray[np.intp]:
        """Index of the last row of each trajectory, shape (trajectories,)."""
        return np.append(self.starts[1:], len(self.rewards)) - 1

    @property
    def next_observations(self) -> Float32:
        """Observation after each row, of the shape of `observations`."""
        next_observations = np.empty_like(self.observations)
        next_observations[:-1] = self.observations[1:]
        next_observations[self.last_rows] = self.last_observations
        return next_observations


def make_experience(
    trajectories: Sequence[Trajectory],
    critic_inputs: Sequence[Sequence[float]] | Floats,
    returns_after_exit: Sequence[float | None] | None = None,
) -> Experience:
    """Return trajectories as experience, with the additional inputs `critic_inputs` of the critic.

    A return after the exit of a CAV is added to its last reward, and its trajectory is terminated.
    """
    residuals, rewards = zip(*(trajectory.actions_and_rewards for trajectory in trajectories), strict=True)
    terminated = [trajectory.terminated for trajectory in trajectories]
    for index, return_after in enumerate(returns_after_exit or ()):
        if return_after is not None:
            rewards[index][-1] += return_after
            terminated[index] = True
    observations = [
        np.column_stack([trajectory.observations, np.tile(inputs, (len(trajectory.observations), 1))])
        for trajectory, inputs in zip(trajectories, critic_inputs, strict=True)
    ]
    return Experience(
        observations=np.concatenate([rows[:-1] for rows in observations]).astype(np.float32),
        actions=np.concatenate(residuals).astype(np.float32),
        rewards=np.concatenate(rewards),
        starts=np.cumsum([0, *map(len, rewards[:-1])]).astype(np.intp),
        last_observations=np.concatenate([rows[-1:] for rows in observations]).astype(np.float32),
        terminated=np.array(terminated),
    )


def join_experience(parts: Sequence[Experience]) -> Experience:
    """Return the concatenated trajectories of all parts."""
    names = [array_field.name for array_field in fields(Experience)]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    offsets = np.cumsum([0, *(len(part.rewards) for part in parts[:-1])])
    joined["starts"] += np.repeat(offsets, [len(part.starts) for part in parts])
    return Experience(**joined)


def discounted_returns(rows: Experience, gamma: float) -> Floats:
    """Return the discounted return from each row on, shape (rows,).

    After the end of a truncated trajectory, each reward is assumed to be the mean reward of the trajectory.
    """
    returns = np.empty(len(rows.rewards))
    for first, last, terminated in zip(rows.starts, rows.last_rows, rows.terminated, strict=True):
        next_return = 0.0 if terminated else float(rows.rewards[first : last + 1].mean()) / (1.0 - gamma)
        for row in range(last, first - 1, -1):
            next_return = returns[row] = rows.rewards[row] + gamma * next_return
    return returns


def environment_experience(spec: AgentSpec, episodes: Sequence[Sequence[Episode]], iteration: int) -> Experience:
    """Return the experience of episodes, given by task; raise `UnjamError` for values that are not finite."""
    parts = [task_experience(spec, index, task_episodes) for index, task_episodes in enumerate(episodes)]
    rows = join_experience(parts)
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(rows, name)).all():
            raise UnjamError(f"learner: {name} of iteration {iteration} are not finite")
    return rows


def task_experience(spec: AgentSpec, task_index: int, episodes: Sequence[Episode]) -> Experience:
    """Return the experience of the episodes of a task; raise `InputError` if they have no CAV."""
    policy, scenario = spec.policy, spec.tasks[task_index].scenario
    pairs = [(episode, trajectory) for episode in episodes for trajectory in episode.trajectories]
    if not pairs:
        count = format_count(len(episodes), "episode")
        raise InputError(f"penetration_rate: no CAV was on the road in {count}; allowed: a higher penetration rate")
    drawn_values = np.array([scenario.scale_drawn_values(episode.drawn_values) for episode, _ in pairs])
    critic_inputs, returns_after_exit = spec.privileged_inputs(task_index, drawn_values), None
    if policy.reward_after_exit:
        entry_times = [trajectory.start_step / scenario.horizon for _, trajectory in pairs]
        critic_inputs = np.column_stack([critic_inputs, entry_times])
        returns_after_exit = [return_after_exit(*pair, spec.gamma, scenario.horizon) for pair in pairs]
    return make_experience([trajectory for _, trajectory in pairs], critic_inputs, returns_after_exit)


def return_after_exit(episode: Episode, trajectory: Trajectory, gamma: float, horizon: int) -> float | None:
    """Return the sum of the rewards after a CAV has left the road, discounted to its last action.

    Return None if the CAV has not left, or if the episode was truncated before `horizon` control steps.
    """
    exit_step, step_count = trajectory.step_slice.stop, episode.control_steps
    has_vehicles = episode.status != "collision" and not np.isnan(episode.speeds[-1]).all()
    if exit_step >= step_count or trajectory.terminated or (has_vehicles and step_count < horizon):
        return None
    action_steps = np.arange(0, step_count - exit_step, trajectory.action_repeat)
    rewards = np.add.reduceat(episode.reward[exit_step:], action_steps)
    return float(rewards @ gamma ** np.arange(1, len(rewards) + 1))
