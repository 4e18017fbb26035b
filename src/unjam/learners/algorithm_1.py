"""Algorithm 1 of the paper: knowledge-informed model-based residual reinforcement learning.

The names are the paper's: pi_theta is the network of residuals, pi_H the expert, T the virtual environment,
D_a actual experience and D_v virtual experience, k* the rollout length of Eq. 15.
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
from unjam.learners.motorway_rollouts import MotorwayRollouts
from unjam.learners.road_rollouts import RoadRollouts
from unjam.learners.settings import LearnerSettings, PolicySettings
from unjam.models.settings import ModelSettings
from unjam.scenarios.on_ramp import OnRamp
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats, Trajectory

MAX_COMPARED_ROWS = 2000
"""at most so many of the visited states tell how far an update has moved the policy"""

TaskEpisodes = Sequence[Sequence[Episode]]
"""the episodes of each task"""
ValidationReturns = Sequence[float] | None
"""return on the validation seeds of each task; None where it was not the time to validate"""


@dataclass
class Training:
    """What Algorithm 1 goes on from: networks, virtual environments with D_a, and how far it is."""

    tasks: Sequence[Task]
    policy: PolicySettings
    seed: int
    """of the whole run"""
    learner: Learner
    """pi_theta and its value network"""
    model_rollouts: Sequence[ModelRollouts[Any]] = ()
    """the virtual environment of each task, with its D_a; empty: model-free"""
    iteration: int = 0
    """iterations done"""
    environment_steps: int = 0

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return counters and tensors at the end of an iteration: all that is needed to go on."""
        counters, tensors = self.learner.state()
        counters |= {"iteration": self.iteration, "environment_steps": self.environment_steps}
        for imagination in self.model_rollouts:
            counters[imagination.name], kept = imagination.state()
            tensors |= {f"{imagination.name}/{name}": tensor for name, tensor in kept.items()}
        return counters, {name: tensor.detach().clone() for name, tensor in tensors.items()}

    def restore(self, counters: dict[str, Any], tensors: Tensors) -> None:
        """Go on, with the same configuration, from what `state` returned."""
        self.learner.restore(counters, tensors)
        self.iteration, self.environment_steps = counters["iteration"], counters["environment_steps"]
        for imagination in self.model_rollouts:
            imagination.restore(counters[imagination.name], tensors_with_prefix(f"{imagination.name}/", tensors))


@dataclass(frozen=True)
class Iteration:
    """What one iteration did: Algorithm 1, once around."""

    number: int
    """from 1"""
    episodes: TaskEpisodes
    environment_steps: int
    """of all iterations so far"""
    model_steps: int
    """of all iterations so far"""
    model: Sequence[dict[str, Any]]
    """what there is to say of the virtual environment of each task; empty without one"""
    log: dict[str, float]
    """what the learner says about its update"""
    seconds: dict[str, float]
    """wall time of each part"""


def start_training(
    tasks: Sequence[Task], policy: PolicySettings, learner: LearnerSettings, model: ModelSettings, seed: int
) -> Training:
    """Initialise pi_theta, the value network, T and an empty D_a (lines 1 and 2); pi_H is the tasks'."""
    imaginations = []
    if model.model_ratio > 0:
        imaginations = [
            model_rollouts_class(model, task)(model, task, policy, seed, index) for index, task in enumerate(tasks)
        ]
    inputs = observation_size(policy.inputs, tasks[0].expert)
    drawn = np.zeros((1, len(tasks[0].scenario.drawn_ranges)))
    critic_inputs = privileged_inputs(tasks, policy, 0, drawn).shape[1] + policy.reward_after_exit
    limit = min(task.scenario.action_limit for task in tasks)
    spec = AgentSpec(inputs, critic_inputs, limit, policy, seed)
    return Training(tasks, policy, seed, make_learner(learner, spec), imaginations)


def model_rollouts_class(model: ModelSettings, task: Task) -> type[ModelRollouts[Any]]:
    """Return what kind of virtual environment a task has with such settings."""
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
    """Learn until `budget` actual steps were made, or `write` says stop; an end loses at most an iteration.

    Args:
        training: where to begin; it goes on in place.
        budget: actual steps, those of the iterations before included.
        collect: (pi_theta, iteration) -> the episodes of an iteration, driven with exploration.
        validate: judges the policy as it is now, where it is time to, and keeps it if it is the best.
        write: writes progress and a checkpoint: what an iteration did, what `validate` says, and the state
            of `training`; what is true ends the training.

    Raises:
        UnjamError: an observation, a reward or a parameter is not finite; it names the first.
    """
    learner, imaginations = training.learner, training.model_rollouts
    while training.environment_steps < max_environment_steps:
        timed_parts = ("collect", "fit", "roll_out", "update") if imaginations else ("collect", "update")
        seconds: dict[str, float] = dict.fromkeys(timed_parts, 0.0)

        # Line 4: collect transitions from the actual environment using pi_theta and pi_H, ...
        with _measure_seconds(seconds, "collect"):
            network = learner.exploring_network(training.environment_steps)
            episodes = collect(network, training.iteration + 1)
        training.iteration += 1
        training.environment_steps += sum(episode.control_steps for driven in episodes for episode in driven)
        actual = environment_experience(training, episodes)
        if training.iteration == 1:
            learner.set_value_scale(actual)
        some = torch.as_tensor(actual.observations[:: -(-len(actual.rewards) // MAX_COMPARED_ROWS)])
        before = learner.residual_distribution(some)

        # ... and add them to D_a. Line 5: train T on D_a. Line 6: eps_m gives the rollout length k*.
        for imagination, driven in zip(imaginations, episodes, strict=False):  # none: model-free
            with _measure_seconds(seconds, "fit"):
                imagination.learn(driven, training.iteration)

        plan = plan_updates(training)
        for with_actual, part, parts in plan:
            # Line 7: collect virtual transitions using T, pi_theta as it is now, and pi_H: D_v.
            virtual = None
            if parts:
                with _measure_seconds(seconds, "roll_out"):
                    virtual = model_experience(training, part, parts)
                if virtual is None and not with_actual:
                    continue
            # Line 8: update pi_theta and its value network with D_a and D_v.
            seed_iteration(training.seed, training.iteration, part if parts and not with_actual else None)
            given = actual if with_actual else None
            with _measure_seconds(seconds, "update"):
                try:
                    learner.learn(Update(given, virtual, 1.0 / len(plan), training.environment_steps))
                finally:  # torch, too, complains of a distribution with such a parameter
                    learner.check_parameters(training.iteration)

        log = learner.log()
        eps_pi = policy_distance(before, learner.residual_distribution(some))
        log |= {"eps_pi_mean": float(eps_pi.mean()), "eps_pi_max": float(eps_pi.max())}
        for imagination in imaginations:
            imagination.facts["bound"] = imagination.bound(log["eps_pi_max"], learner.gamma)

        # Line 9: until the policy performs well in the actual environment; the best one is kept.
        facts = [imagination.facts for imagination in imaginations]
        virtual_steps = sum(imagination.model_steps for imagination in imaginations)
        done = Iteration(training.iteration, episodes, training.environment_steps, virtual_steps, facts, log, seconds)
        if write(done, validate(done)):
            return


def plan_updates(training: Training) -> list[tuple[bool, int, int]]:
    """Return the updates of this iteration: (with actual rows, which part of the virtual rows, of how many).

    All rows at once; or first the actual ones, then parts of virtual ones alone, each of the policy that the
    part before has made. Of no parts are those that learn from actual rows alone.
    """
    only_actual = (True, 0, 0)
    if not training.model_rollouts or not training.learner.is_learning(training.environment_steps):
        return [only_actual]
    settings = training.model_rollouts[0].settings
    if settings.update_mode == "union":
        return [(True, 0, 1)]
    return [only_actual, *((False, part, settings.model_updates) for part in range(settings.model_updates))]


def environment_experience(training: Training, episodes: TaskEpisodes) -> Experience:
    """Return what was driven as experience; raise `UnjamError` where some of it is not finite."""
    joined = join_experience([task_experience(training, index, driven) for index, driven in enumerate(episodes)])
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(joined, name)).all():
            raise UnjamError(f"learner: {name} of iteration {training.iteration} are not finite")
    return joined


def task_experience(training: Training, task_index: int, episodes: Sequence[Episode]) -> Experience:
    """Return the experience of episodes of task `index`."""
    policy, scenario = training.policy, training.tasks[task_index].scenario
    pairs = [(episode, trajectory) for episode in episodes for trajectory in episode.trajectories]
    if not pairs:
        raise InputError(f"no CAV was on the road in {len(episodes)} episodes: let more vehicles be CAVs")
    drawn = np.array([scenario.scale_drawn_values(episode.drawn_values) for episode, _ in pairs])
    extra, later = privileged_inputs(training.tasks, policy, task_index, drawn), None
    if policy.reward_after_exit:
        came = [trajectory.start_step / scenario.horizon for _, trajectory in pairs]
        extra = np.column_stack([extra, came])
        gamma, horizon = training.learner.gamma, scenario.horizon
        later = [return_after_exit(episode, trajectory, gamma, horizon) for episode, trajectory in pairs]
    return make_experience([trajectory for _, trajectory in pairs], extra, later)


def return_after_exit(episode: Episode, trajectory: Trajectory, gamma: float, horizon: int) -> float | None:
    """Return what was earned after a CAV had left, discounted to its last choice.

    None where it never left, or where the episode was broken off before its `horizon`, as one is that is
    imagined for a while: what would have been earned then nobody knows.
    """
    end = trajectory.step_slice.stop
    goes_on = episode.status != "collision" and not np.isnan(episode.speeds[-1]).all()
    if end >= episode.control_steps or trajectory.terminated or (goes_on and episode.control_steps < horizon):
        return None
    earned = np.add.reduceat(episode.reward[end:], np.arange(0, episode.control_steps - end, trajectory.action_repeat))
    return float(earned @ gamma ** np.arange(1, len(earned) + 1))


def model_experience(training: Training, part: int, parts: int) -> Experience | None:
    """Return one of `parts` of what the policy as it is now does in the virtual environments, if anything."""
    network, found = training.learner.network(), []
    for index, imagination in enumerate(training.model_rollouts):
        how = ExperienceFactory(
            partial(privileged_inputs, training.tasks, training.policy, index),
            partial(task_experience, training, index),
        )
        found.append(imagination.roll_out(network, training.iteration, part, parts, how))
    imagined = [each for each in found if each is not None]
    return join_experience(imagined) if imagined else None


def privileged_inputs(tasks: Sequence[Task], policy: PolicySettings, task_index: int, drawn_values: Floats) -> Floats:
    """Return what the critic alone sees in rows of task `index` whose episodes drew `drawn`, shape (rows, m).

    Of several tasks that is what each draws, zeros for the other tasks', and a number per task that says
    which it is.
    """
    if not policy.privileged_critic:
        return drawn_values[:, :0]
    if len(tasks) == 1:
        return drawn_values
    columns = [np.zeros((len(drawn_values), len(task.scenario.drawn_ranges))) for task in tasks]
    columns[task_index] = drawn_values
    return np.hstack([*columns, np.tile(np.eye(len(tasks))[task_index], (len(drawn_values), 1))])


def seed_iteration(run_seed: int, iteration: int, part: int | None = None) -> None:
    """Seed every generator that an update uses, from the run's seed and the iteration alone.

    So a run that goes on from a checkpoint draws what the uninterrupted one would have drawn. Where an
    iteration has several updates, each of a `part` of virtual rows draws its own.
    """
    which = (1,) if part is None else (1, 1 + part)  # a zero at the end changes nothing
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, *which]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))


@contextmanager
def _measure_seconds(seconds: dict[str, float], part: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[part] += time.perf_counter() - started
