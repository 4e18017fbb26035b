"""Algorithm 1 of the paper: knowledge-informed model-based residual reinforcement learning.

The symbols are the paper's: pi_theta is the network of residuals, pi_H the expert, T the learned model, D_a
environment experience and D_v model experience, k* the rollout length of Eq. 15.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch

from unjam.drivers.network import Network
from unjam.errors import InputError, invalid_value
from unjam.learners.agent import AgentSpec, check_state, is_algorithm, make_agent
from unjam.learners.algorithm import Algorithm, Collector, IterationLog, Tensors, seed_iteration, tensors_with_prefix
from unjam.learners.experience import Experience, environment_experience, join_experience
from unjam.learners.learner import Learner, Update, limit_update, policy_distance
from unjam.learners.model_rollouts import ModelRollouts
from unjam.learners.settings import LearnerSettings

MAX_COMPARED_ROWS = 2000
"""maximum number of visited states at which the policies before and after an iteration are compared"""


class PlannedUpdate(NamedTuple):
    """Data of an update of an iteration: environment rows, or a part of the model rows, or both."""

    uses_environment: bool
    part: int
    """index of the part of the model rows"""
    part_count: int
    """number of parts of the model rows; 0: the update uses no model rows"""


class Algorithm1:
    """Algorithm 1 with any learner; the loop of its lines 3 and 9 is in `run_iterations`."""

    def __init__(self, spec: AgentSpec, learner: Learner) -> None:
        """Make T and an empty D_a (line 2); `learner` has pi_theta and its value network, the tasks have pi_H (line 1).

        Raise `InputError` if the first policy or the learner does not fit the limit on the string gain.
        """
        self.spec, self.learner = spec, learner
        task_indices = range(len(spec.tasks) if spec.model.model_ratio > 0 else 0)
        self.model_rollouts = [ModelRollouts(spec, index) for index in task_indices]
        """model and D_a of each task; empty for model-free learning"""
        if spec.string_gain is not None:
            self._check_string_gain_limit(spec.string_gain)

    def network(self) -> Network:
        """Return pi_theta."""
        return self.learner.network()

    def iterate(self, collect: Collector) -> IterationLog:
        """Run lines 4 to 8 of the paper's algorithm; raise `UnjamError` if a number is not finite."""
        learner, model_rollouts = self.learner, self.model_rollouts
        stages = ("fit", "roll_out", "update") if model_rollouts else ("update",)
        stages += ("string_gain",) if self.spec.string_gain is not None else ()
        seconds: dict[str, float] = dict.fromkeys(stages, 0.0)

        # Line 4: collect transitions from the environment using pi_theta and pi_H, ...
        episodes = collect(learner.exploring_network(collect.environment_steps))
        environment_rows = environment_experience(self.spec, episodes, collect.iteration)
        if collect.iteration == 1:
            learner.set_value_scale(environment_rows)
        stride = -(-len(environment_rows.rewards) // MAX_COMPARED_ROWS)
        compared_observations = torch.as_tensor(environment_rows.observations[::stride])
        old_distribution = learner.residual_distribution(compared_observations)
        old_parameters = [parameter.detach().clone() for parameter in learner.policy_parameters()]

        # ... and add them to D_a. Line 5: train T on D_a. Line 6: eps_m gives the rollout length k*.
        for rollouts, task_episodes in zip(model_rollouts, episodes, strict=False):  # model-free: no model_rollouts
            with _measure_seconds(seconds, "fit"):
                rollouts.learn(task_episodes, collect.iteration)

        plan = self._plan_updates(collect.environment_steps)
        for uses_environment, part, part_count in plan:
            # Line 7: collect model transitions using T, the current pi_theta, and pi_H: D_v.
            model_rows = None
            if part_count:
                with _measure_seconds(seconds, "roll_out"):
                    model_rows = self._model_experience(collect.iteration, part, part_count)
                if model_rows is None and not uses_environment:
                    continue
            # Line 8: update pi_theta and its value network with D_a and D_v.
            seed_iteration(self.spec.seed, collect.iteration, None if uses_environment else part)
            rows = environment_rows if uses_environment else None, model_rows
            with _measure_seconds(seconds, "update"):
                try:
                    learner.learn(Update(*rows, 1.0 / len(plan), collect.environment_steps))
                finally:  # replaces the error of torch for a parameter that is not finite
                    learner.check_parameters(collect.iteration)

        log = learner.log()
        if self.spec.string_gain is not None:
            with _measure_seconds(seconds, "string_gain"):
                log |= {"kept_update": limit_update(learner, old_parameters, self._has_allowed_string_gain)}
        eps_pi = policy_distance(old_distribution, learner.residual_distribution(compared_observations))
        log |= {"eps_pi_mean": float(eps_pi.mean()), "eps_pi_max": float(eps_pi.max())}
        for rollouts in model_rollouts:
            eps_m = rollouts.facts["eps_m_by_estimator"]["transitions"]
            rollouts.facts["bound"] = rollouts.bound(rollouts.k_star, log["eps_pi_max"], eps_m)
        model_steps = sum(rollouts.model_steps for rollouts in model_rollouts)
        return IterationLog(log, model_steps, [rollouts.facts for rollouts in model_rollouts], seconds)

    def _check_string_gain_limit(self, string_gain: Callable[[Network], float]) -> None:
        """Raise `InputError` if the first policy has a larger string gain, or the learner has no policy parameters."""
        if not self.learner.policy_parameters():
            name = type(self.learner).__name__
            raise InputError(f"policy.max_string_gain: {name} has no policy_parameters(), which this limit needs")
        limit, gain = self.spec.policy.max_string_gain, string_gain(self.network())
        if gain > limit:
            allowed = f"at least {gain:.3f}, the gain of the first policy, or another expert"
            raise invalid_value("policy.max_string_gain", limit, allowed)

    def _has_allowed_string_gain(self, network: Network) -> bool:
        string_gain = self.spec.string_gain
        return string_gain is None or string_gain(network) <= self.spec.policy.max_string_gain

    def _plan_updates(self, environment_steps: int) -> list[PlannedUpdate]:
        """Return the updates of this iteration."""
        without_model = PlannedUpdate(True, 0, 0)
        if not self.model_rollouts or not self.learner.is_learning(environment_steps):
            return [without_model]
        settings = self.spec.model
        if settings.update_mode == "union":
            return [PlannedUpdate(True, 0, 1)]
        part_count = settings.model_updates
        return [without_model, *(PlannedUpdate(False, part, part_count) for part in range(part_count))]

    def _model_experience(self, iteration: int, part: int, part_count: int) -> Experience | None:
        """Return part `part` of the current policy's experience in all models; None if there is none."""
        network = self.network()
        results = [rollouts.roll_out(network, iteration, part, part_count) for rollouts in self.model_rollouts]
        rows = [experience for experience in results if experience is not None]
        return join_experience(rows) if rows else None

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all values and tensors that are needed to resume after an iteration."""
        values, tensors = check_state(type(self.learner).__name__, self.learner.state())
        for rollouts in self.model_rollouts:
            values[rollouts.name], model_tensors = rollouts.state()
            tensors |= {f"{rollouts.name}/{name}": tensor.detach().clone() for name, tensor in model_tensors.items()}
        return values, tensors

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from the values and tensors that `state` returned with the same configuration."""
        self.learner.restore(values, tensors)
        for rollouts in self.model_rollouts:
            rollouts.restore(values[rollouts.name], tensors_with_prefix(f"{rollouts.name}/", tensors))


def make_algorithm(agent: str, settings: LearnerSettings, spec: AgentSpec) -> Algorithm:
    """Return the agent itself if it is an algorithm, else Algorithm 1 with the agent as its learner."""
    algorithm_or_learner = make_agent(agent, settings, spec)
    if not is_algorithm(algorithm_or_learner):
        return Algorithm1(spec, algorithm_or_learner)
    if spec.string_gain is not None:
        raise invalid_value("policy.max_string_gain", spec.policy.max_string_gain, f"none with {agent}, an algorithm")
    return algorithm_or_learner


@contextmanager
def _measure_seconds(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the wall time of the block to that of a stage in `seconds`."""
    start_time = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - start_time
