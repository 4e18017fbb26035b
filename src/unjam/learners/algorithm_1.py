"""Algorithm 1 of the paper: knowledge-informed model-based residual reinforcement learning.

The symbols are the paper's: pi_theta is the network of residuals, pi_H the expert, T the learned model, D_a
environment experience and D_v model experience, k* the rollout length of Eq. 15.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.errors import InputError, UnjamError
from unjam.learners.experience import Experience, join_experience, make_experience
from unjam.learners.learner import (
    AgentSpec,
    Learner,
    Tensors,
    Update,
    make_learner,
    policy_distance,
    tensors_with_prefix,
)
from unjam.learners.model_rollouts import ExperienceFactory, ModelRollouts, RowRollouts
from unjam.learners.settings import LearnerSettings, PolicySettings
from unjam.learners.whole_road_rollouts import MotorwayRollouts, RoadRollouts
from unjam.models.settings import ModelSettings
from unjam.scenarios.on_ramp import OnRamp
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats, Trajectory

MAX_COMPARED_ROWS = 2000
"""maximum number of visited states at which the policy is compared before and after an update"""

TaskEpisodes = Sequence[Sequence[Episode]]
"""the episodes of each task"""
ValidationReturns = Sequence[float] | None
"""return on the validation seeds of each task; None without a validation"""


@dataclass
class Training:
    """The state of Algorithm 1."""

    tasks: Sequence[Task]
    policy: PolicySettings
    seed: int
    """seed of the whole run"""
    learner: Learner
    """pi_theta and its value network"""
    model_rollouts: Sequence[ModelRollouts[Any]] = ()
    """model rollouts of each task, with its model and D_a; empty: model-free"""
    iteration: int = 0
    """number of completed iterations"""
    environment_steps: int = 0

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all counters and tensors that are needed to resume after an iteration."""
        counters, tensors = self.learner.state()
        counters |= {"iteration": self.iteration, "environment_steps": self.environment_steps}
        for each in self.model_rollouts:
            counters[each.name], model_tensors = each.state()
            tensors |= {f"{each.name}/{name}": tensor for name, tensor in model_tensors.items()}
        return counters, {name: tensor.detach().clone() for name, tensor in tensors.items()}

    def restore(self, counters: dict[str, Any], tensors: Tensors) -> None:
        """Resume, with the same configuration, from what `state` returned."""
        self.learner.restore(counters, tensors)
        self.iteration, self.environment_steps = counters["iteration"], counters["environment_steps"]
        for each in self.model_rollouts:
            each.restore(counters[each.name], tensors_with_prefix(f"{each.name}/", tensors))


@dataclass(frozen=True)
class Iteration:
    """The result of one iteration of Algorithm 1, numbered from 1; steps are totals of all iterations so far."""

    number: int
    episodes: TaskEpisodes
    environment_steps: int
    model_steps: int
    model: Sequence[dict[str, Any]]
    """facts about the model of each task; empty if model-free"""
    log: dict[str, float]
    """log of the updates of the learner"""
    seconds: dict[str, float]
    """wall time of each part"""


def start_training(
    tasks: Sequence[Task], policy: PolicySettings, learner: LearnerSettings, model: ModelSettings, seed: int
) -> Training:
    """Initialize pi_theta, the value network, T and an empty D_a (lines 1 and 2); pi_H is the tasks'."""
    rollouts = [
        model_rollouts_class(model, task)(model, task, policy, seed, index)
        for index, task in enumerate(tasks if model.model_ratio > 0 else ())
    ]
    inputs = observation_size(policy.inputs, tasks[0].expert)
    drawn_values = np.zeros((1, len(tasks[0].scenario.drawn_ranges)))
    critic_inputs = privileged_inputs(tasks, policy, 0, drawn_values).shape[1] + policy.reward_after_exit
    limit = min(task.scenario.action_limit for task in tasks)
    spec = AgentSpec(inputs, critic_inputs, limit, policy, seed)
    return Training(tasks, policy, seed, make_learner(learner, spec), rollouts)


def model_rollouts_class(model: ModelSettings, task: Task) -> type[ModelRollouts[Any]]:
    """Return the kind of model rollouts for a task with these settings."""
    if model.kind == "row":
        return RowRollouts
    return MotorwayRollouts if isinstance(task.scenario, OnRamp) else RoadRollouts


def algorithm_1(
    training: Training,
    max_environment_steps: int,
    collect: Callable[[Network, int], TaskEpisodes],
    validate: Callable[[Iteration], ValidationReturns],
    write: Callable[[Iteration, ValidationReturns], object],
) -> None:
    """Continue `training` up to `max_environment_steps`, or until `write` returns true.

    Args:
        training: is changed; an abort loses at most one iteration.
        max_environment_steps: including those of earlier iterations.
        collect: (pi_theta, iteration) -> the episodes of an iteration, driven with exploration.
        validate: evaluates the present policy if a validation is due, and stores it if it is the best.
        write: writes progress and a checkpoint; a true result ends the training.

    Raises:
        UnjamError: an observation, a reward or a parameter is not finite; it names the first.
    """
    learner, model_rollouts = training.learner, training.model_rollouts
    while training.environment_steps < max_environment_steps:
        timed_parts = ("collect", "fit", "roll_out", "update") if model_rollouts else ("collect", "update")
        seconds: dict[str, float] = dict.fromkeys(timed_parts, 0.0)

        # Line 4: collect transitions from the environment using pi_theta and pi_H, ...
        with _measure_seconds(seconds, "collect"):
            network = learner.exploring_network(training.environment_steps)
            episodes = collect(network, training.iteration + 1)
        training.iteration += 1
        training.environment_steps += sum(episode.control_steps for each in episodes for episode in each)
        environment_rows = environment_experience(training, episodes)
        if training.iteration == 1:
            learner.set_value_scale(environment_rows)
        stride = -(-len(environment_rows.rewards) // MAX_COMPARED_ROWS)
        compared = torch.as_tensor(environment_rows.observations[::stride])
        before = learner.residual_distribution(compared)

        # ... and add them to D_a. Line 5: train T on D_a. Line 6: eps_m gives the rollout length k*.
        for each, task_episodes in zip(model_rollouts, episodes, strict=False):  # none: model-free
            with _measure_seconds(seconds, "fit"):
                each.learn(task_episodes, training.iteration)

        plan = plan_updates(training)
        for with_environment, part, parts in plan:
            # Line 7: collect model transitions using T, the present pi_theta, and pi_H: D_v.
            model_rows = None
            if parts:
                with _measure_seconds(seconds, "roll_out"):
                    model_rows = model_experience(training, part, parts)
                if model_rows is None and not with_environment:
                    continue
            # Line 8: update pi_theta and its value network with D_a and D_v.
            seed_iteration(training.seed, training.iteration, None if with_environment else part)
            rows = environment_rows if with_environment else None, model_rows
            with _measure_seconds(seconds, "update"):
                try:
                    learner.learn(Update(*rows, 1.0 / len(plan), training.environment_steps))
                finally:  # torch also raises an error for a distribution with such a parameter
                    learner.check_parameters(training.iteration)

        log = learner.log()
        eps_pi = policy_distance(before, learner.residual_distribution(compared))
        log |= {"eps_pi_mean": float(eps_pi.mean()), "eps_pi_max": float(eps_pi.max())}
        for each in model_rollouts:
            eps_m = each.facts["eps_m_by_estimator"]["transitions"]
            each.facts["bound"] = each.bound(each.k_star, log["eps_pi_max"], eps_m, learner.gamma)

        # Line 9: until the policy performs well in the environment; the best one is stored.
        facts = [each.facts for each in model_rollouts]
        steps = training.environment_steps, sum(each.model_steps for each in model_rollouts)
        iteration = Iteration(training.iteration, episodes, *steps, facts, log, seconds)
        if write(iteration, validate(iteration)):
            return


def plan_updates(training: Training) -> list[tuple[bool, int, int]]:
    """Return the updates of this iteration: (with environment rows, part of the model rows, number of parts).

    All rows at once; or the environment rows, then parts of the model rows, each by the policy of the previous update.
    Without parts there are no model rows.
    """
    without_model = (True, 0, 0)
    if not training.model_rollouts or not training.learner.is_learning(training.environment_steps):
        return [without_model]
    settings = training.model_rollouts[0].settings
    if settings.update_mode == "union":
        return [(True, 0, 1)]
    return [without_model, *((False, part, settings.model_updates) for part in range(settings.model_updates))]


def environment_experience(training: Training, episodes: TaskEpisodes) -> Experience:
    """Return the experience of the episodes of all tasks; raise `UnjamError` if some of it is not finite."""
    rows = join_experience([task_experience(training, index, each) for index, each in enumerate(episodes)])
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(rows, name)).all():
            raise UnjamError(f"learner: {name} of iteration {training.iteration} are not finite")
    return rows


def task_experience(training: Training, task_index: int, episodes: Sequence[Episode]) -> Experience:
    """Return the experience of episodes of a task."""
    policy, scenario, gamma = training.policy, training.tasks[task_index].scenario, training.learner.gamma
    pairs = [(episode, trajectory) for episode in episodes for trajectory in episode.trajectories]
    if not pairs:
        raise InputError(f"no CAV was on the road in {len(episodes)} episodes: increase the share of CAVs")
    drawn_values = np.array([scenario.scale_drawn_values(episode.drawn_values) for episode, _ in pairs])
    critic_inputs, later = privileged_inputs(training.tasks, policy, task_index, drawn_values), None
    if policy.reward_after_exit:
        entry_times = [trajectory.start_step / scenario.horizon for _, trajectory in pairs]
        critic_inputs = np.column_stack([critic_inputs, entry_times])
        later = [return_after_exit(*pair, gamma, scenario.horizon) for pair in pairs]
    return make_experience([trajectory for _, trajectory in pairs], critic_inputs, later)


def return_after_exit(episode: Episode, trajectory: Trajectory, gamma: float, horizon: int) -> float | None:
    """Return rewards after a CAV left, discounted to its last action; None if it stayed or the episode is truncated."""
    end = trajectory.step_slice.stop
    goes_on = episode.status != "collision" and not np.isnan(episode.speeds[-1]).all()
    if end >= episode.control_steps or trajectory.terminated or (goes_on and episode.control_steps < horizon):
        return None
    rewards = np.add.reduceat(episode.reward[end:], np.arange(0, episode.control_steps - end, trajectory.action_repeat))
    return float(rewards @ gamma ** np.arange(1, len(rewards) + 1))


def model_experience(training: Training, part: int, parts: int) -> Experience | None:
    """Return one of `parts` of the experience of the present policy in the models of all tasks, if there is any."""
    network, results = training.learner.network(), []
    for index, each in enumerate(training.model_rollouts):
        factory = ExperienceFactory(
            partial(privileged_inputs, training.tasks, training.policy, index),
            partial(task_experience, training, index),
        )
        results.append(each.roll_out(network, training.iteration, part, parts, factory))
    rows = [each for each in results if each is not None]
    return join_experience(rows) if rows else None


def privileged_inputs(tasks: Sequence[Task], policy: PolicySettings, task_index: int, drawn_values: Floats) -> Floats:
    """Return the inputs of the critic alone in rows of a task with `drawn_values`, shape (rows, m).

    With several tasks these are the values that each of them draws, zeros for the others, and a one-hot task index.
    """
    if not policy.privileged_critic:
        return drawn_values[:, :0]
    if len(tasks) == 1:
        return drawn_values
    columns = [np.zeros((len(drawn_values), len(task.scenario.drawn_ranges))) for task in tasks]
    columns[task_index] = drawn_values
    return np.hstack([*columns, np.tile(np.eye(len(tasks))[task_index], (len(drawn_values), 1))])


def seed_iteration(run_seed: int, iteration: int, part: int | None = None) -> None:
    """Seed all generators of an update by run, iteration and part: a resumed run draws the same random numbers."""
    key = (1,) if part is None else (1, 1 + part)  # a trailing zero would change nothing
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, *key]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))


@contextmanager
def _measure_seconds(seconds: dict[str, float], part: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[part] += time.perf_counter() - start
