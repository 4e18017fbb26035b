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
from unjam.learners.experience import Experience, experience_of, join
from unjam.learners.imagination import AsExperience, Imagination, RowImagination
from unjam.learners.learner import AgentSpec, Learner, Tensors, Update, make_learner, policy_distance, under
from unjam.learners.motorway_imagination import MotorwayImagination
from unjam.learners.road_imagination import RoadImagination
from unjam.learners.settings import LearnerSettings, PolicySettings
from unjam.scenarios.on_ramp import OnRamp
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats, Trajectory

COMPARED_ROWS = 2000
"""at most so many of the visited states tell how far an update has moved the policy"""

Collected = Sequence[Sequence[Episode]]
"""the episodes of each task"""
Validated = Sequence[float] | None
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
    imaginations: Sequence[Imagination[Any]] = ()
    """the virtual environment of each task, with its D_a; empty: model-free"""
    iteration: int = 0
    """iterations done"""
    actual_steps: int = 0

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return counters and tensors at the end of an iteration: all that is needed to go on."""
        counters, tensors = self.learner.state()
        counters |= {"iteration": self.iteration, "actual_steps": self.actual_steps}
        for imagination in self.imaginations:
            counters[imagination.name], kept = imagination.state()
            tensors |= {f"{imagination.name}/{name}": tensor for name, tensor in kept.items()}
        return counters, {name: tensor.detach().clone() for name, tensor in tensors.items()}

    def restore(self, counters: dict[str, Any], tensors: Tensors) -> None:
        """Go on, with the same configuration, from what `state` returned."""
        self.learner.restore(counters, tensors)
        self.iteration, self.actual_steps = counters["iteration"], counters["actual_steps"]
        for imagination in self.imaginations:
            imagination.restore(counters[imagination.name], under(f"{imagination.name}/", tensors))


@dataclass(frozen=True)
class Iteration:
    """What one iteration did: Algorithm 1, once around."""

    number: int
    """from 1"""
    episodes: Collected
    actual_steps: int
    """of all iterations so far"""
    virtual_steps: int
    """of all iterations so far"""
    virtual: Sequence[dict[str, Any]]
    """what there is to say of the virtual environment of each task; empty without one"""
    log: dict[str, float]
    """what the learner says about its update"""
    seconds: dict[str, float]
    """wall time of each part"""


def begin_training(
    tasks: Sequence[Task],
    policy: PolicySettings,
    learner: LearnerSettings,
    virtual: VirtualSettings,
    seed: int,
) -> Training:
    """Initialise pi_theta, the value network, T and an empty D_a (lines 1 and 2); pi_H is the tasks'."""
    imaginations = []
    if virtual.virtual_ratio > 0:
        imaginations = [
            kind_of_imagination(virtual, task)(virtual, task, policy, seed, index)
            for index, task in enumerate(tasks)
        ]
    inputs = observation_size(policy.observe, tasks[0].expert)
    drawn = np.zeros((1, len(tasks[0].scenario.drawn_ranges)))
    critic_inputs = seen_by_critic(tasks, policy, 0, drawn).shape[1] + policy.afterwards
    limit = min(task.scenario.action_limit for task in tasks)
    spec = AgentSpec(inputs, critic_inputs, limit, policy, seed)
    return Training(tasks, policy, seed, make_learner(learner, spec), imaginations)


def kind_of_imagination(virtual: VirtualSettings, task: Task) -> type[Imagination[Any]]:
    """Return what kind of virtual environment a task has with such settings."""
    if virtual.model == "row":
        return RowImagination
    return MotorwayImagination if isinstance(task.scenario, OnRamp) else RoadImagination


def algorithm_1(
    training: Training,
    budget: int,
    collect: Callable[[Network, int], Collected],
    validate: Callable[[Iteration], Validated],
    write: Callable[[Iteration, Validated], object],
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
    learner, imaginations = training.learner, training.imaginations
    while training.actual_steps < budget:
        timed_parts = ("actual", "fit", "imagine", "update") if imaginations else ("actual", "update")
        seconds: dict[str, float] = dict.fromkeys(timed_parts, 0.0)

        # Line 4: collect transitions from the actual environment using pi_theta and pi_H, ...
        with _timed(seconds, "actual"):
            network = learner.exploring_network(training.actual_steps)
            episodes = collect(network, training.iteration + 1)
        training.iteration += 1
        training.actual_steps += sum(episode.steps for driven in episodes for episode in driven)
        actual = actual_experience(training, episodes)
        if training.iteration == 1:
            learner.measure_units(actual)
        some = torch.as_tensor(actual.observations[:: -(-len(actual.rewards) // COMPARED_ROWS)])
        before = learner.gaussians(some)

        # ... and add them to D_a. Line 5: train T on D_a. Line 6: eps_m gives the rollout length k*.
        for imagination, driven in zip(imaginations, episodes, strict=False):  # none: model-free
            with _timed(seconds, "fit"):
                imagination.learn(driven, training.iteration)

        plan = plan_updates(training)
        for with_actual, part, parts in plan:
            # Line 7: collect virtual transitions using T, pi_theta as it is now, and pi_H: D_v.
            virtual = None
            if parts:
                with _timed(seconds, "imagine"):
                    virtual = virtual_experience(training, part, parts)
                if virtual is None and not with_actual:
                    continue
            # Line 8: update pi_theta and its value network with D_a and D_v.
            seed_iteration(training.seed, training.iteration, part if parts and not with_actual else None)
            given = actual if with_actual else None
            with _timed(seconds, "update"):
                try:
                    learner.learn(Update(given, virtual, 1.0 / len(plan), training.actual_steps))
                finally:  # torch, too, complains of a distribution with such a parameter
                    learner.check_parameters(training.iteration)

        log = learner.log()
        eps_pi = policy_distance(before, learner.gaussians(some))
        log |= {"eps_pi_mean": float(eps_pi.mean()), "eps_pi_max": float(eps_pi.max())}
        for imagination in imaginations:
            imagination.facts["bound"] = imagination.bound(log["eps_pi_max"], learner.gamma)

        # Line 9: until the policy performs well in the actual environment; the best one is kept.
        facts = [imagination.facts for imagination in imaginations]
        virtual_steps = sum(imagination.steps for imagination in imaginations)
        done = Iteration(
            training.iteration, episodes, training.actual_steps, virtual_steps, facts, log, seconds
        )
        if write(done, validate(done)):
            return


def plan_updates(training: Training) -> list[tuple[bool, int, int]]:
    """Return the updates of this iteration: (with actual rows, which part of the virtual rows, of how many).

    All rows at once; or first the actual ones, then parts of virtual ones alone, each of the policy that the
    part before has made. Of no parts are those that learn from actual rows alone.
    """
    only_actual = (True, 0, 0)
    if not training.imaginations or not training.learner.learns(training.actual_steps):
        return [only_actual]
    settings = training.imaginations[0].settings
    if settings.update == "union":
        return [(True, 0, 1)]
    return [only_actual, *((False, part, settings.updates) for part in range(settings.updates))]


def actual_experience(training: Training, episodes: Collected) -> Experience:
    """Return what was driven as experience; raise `UnjamError` where some of it is not finite."""
    joined = join([experience_on(training, index, driven) for index, driven in enumerate(episodes)])
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(joined, name)).all():
            raise UnjamError(f"learner: {name} of iteration {training.iteration} are not finite")
    return joined


def experience_on(training: Training, index: int, episodes: Sequence[Episode]) -> Experience:
    """Return the experience of episodes of task `index`."""
    policy, scenario = training.policy, training.tasks[index].scenario
    pairs = [(episode, trajectory) for episode in episodes for trajectory in episode.trajectories]
    if not pairs:
        raise InputError(f"no CAV was on the road in {len(episodes)} episodes: let more vehicles be CAVs")
    drawn = np.array([scenario.drawn_scaled(episode.drawn) for episode, _ in pairs])
    extra, later = seen_by_critic(training.tasks, policy, index, drawn), None
    if policy.afterwards:
        came = [trajectory.start / scenario.horizon for _, trajectory in pairs]
        extra = np.column_stack([extra, came])
        gamma, horizon = training.learner.gamma, scenario.horizon
        later = [afterwards(episode, trajectory, gamma, horizon) for episode, trajectory in pairs]
    return experience_of([trajectory for _, trajectory in pairs], extra, later)


def afterwards(episode: Episode, trajectory: Trajectory, gamma: float, horizon: int) -> float | None:
    """Return what was earned after a CAV had left, discounted to its last choice.

    None where it never left, or where the episode was broken off before its `horizon`, as one is that is
    imagined for a while: what would have been earned then nobody knows.
    """
    end = trajectory.during.stop
    goes_on = episode.status != "collision" and not np.isnan(episode.speeds[-1]).all()
    if end >= episode.steps or trajectory.terminated or (goes_on and episode.steps < horizon):
        return None
    earned = np.add.reduceat(episode.reward[end:], np.arange(0, episode.steps - end, trajectory.hold))
    return float(earned @ gamma ** np.arange(1, len(earned) + 1))


def virtual_experience(training: Training, part: int, parts: int) -> Experience | None:
    """Return one of `parts` of what the policy as it is now does in the virtual environments, if anything."""
    network, found = training.learner.network(), []
    for index, imagination in enumerate(training.imaginations):
        how = AsExperience(
            partial(seen_by_critic, training.tasks, training.policy, index),
            partial(experience_on, training, index),
        )
        found.append(imagination.imagine(network, training.iteration, part, parts, how))
    imagined = [each for each in found if each is not None]
    return join(imagined) if imagined else None


def seen_by_critic(tasks: Sequence[Task], policy: PolicySettings, index: int, drawn: Floats) -> Floats:
    """Return what the critic alone sees in rows of task `index` whose episodes drew `drawn`, shape (rows, m).

    Of several tasks that is what each draws, zeros for the other tasks', and a number per task that says
    which it is.
    """
    if not policy.critic_sees_road:
        return drawn[:, :0]
    if len(tasks) == 1:
        return drawn
    columns = [np.zeros((len(drawn), len(task.scenario.drawn_ranges))) for task in tasks]
    columns[index] = drawn
    return np.hstack([*columns, np.tile(np.eye(len(tasks))[index], (len(drawn), 1))])


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
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[part] += time.perf_counter() - started
