"""Algorithm 1 of the paper: knowledge-informed model-based residual reinforcement learning.

The symbols are the paper's: pi_theta is the network of residuals, pi_H the expert, T the learned model, D_a
environment experience and D_v model experience, k* the rollout length of Eq. 15.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

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
"""maximum number of visited states at which the policy is compared before and after an update"""


class Algorithm1:
    """Algorithm 1 with any learner; line 3, repeat, and line 9, until it performs well, are `run_iterations`."""

    def __init__(self, spec: AgentSpec, learner: Learner) -> None:
        """Line 1: pi_theta and its value network, in `learner`; pi_H is the tasks'. Line 2: T and an empty D_a."""
        self.spec, self.learner = spec, learner
        tasks = range(len(spec.tasks) if spec.model.model_ratio > 0 else 0)
        self.model_rollouts = [ModelRollouts(spec, index) for index in tasks]
        """of each task, with its model and D_a; empty: model-free"""
        if spec.string_gain is not None:
            self._check_limit(spec.string_gain)

    def network(self) -> Network:
        """Return pi_theta."""
        return self.learner.network()

    def iterate(self, collect: Collector) -> IterationLog:
        """Make an iteration, lines 4 to 8 of the paper; raise `UnjamError` if a number is not finite."""
        learner, model_rollouts = self.learner, self.model_rollouts
        timed_parts = ("fit", "roll_out", "update") if model_rollouts else ("update",)
        timed_parts += ("string_gain",) if self.spec.string_gain is not None else ()
        seconds: dict[str, float] = dict.fromkeys(timed_parts, 0.0)

        # Line 4: collect transitions from the environment using pi_theta and pi_H, ...
        episodes = collect(learner.exploring_network(collect.environment_steps))
        environment_rows = environment_experience(self.spec, episodes, collect.iteration)
        if collect.iteration == 1:
            learner.set_value_scale(environment_rows)
        stride = -(-len(environment_rows.rewards) // MAX_COMPARED_ROWS)
        compared = torch.as_tensor(environment_rows.observations[::stride])
        before = learner.residual_distribution(compared)
        parameters = [each.detach().clone() for each in learner.policy_parameters()]

        # ... and add them to D_a. Line 5: train T on D_a. Line 6: eps_m gives the rollout length k*.
        for each, task_episodes in zip(model_rollouts, episodes, strict=False):  # none: model-free
            with _measure_seconds(seconds, "fit"):
                each.learn(task_episodes, collect.iteration)

        plan = self._plan_updates(collect.environment_steps)
        for with_environment, part, parts in plan:
            # Line 7: collect model transitions using T, the present pi_theta, and pi_H: D_v.
            model_rows = None
            if parts:
                with _measure_seconds(seconds, "roll_out"):
                    model_rows = self._model_experience(collect.iteration, part, parts)
                if model_rows is None and not with_environment:
                    continue
            # Line 8: update pi_theta and its value network with D_a and D_v.
            seed_iteration(self.spec.seed, collect.iteration, None if with_environment else part)
            rows = environment_rows if with_environment else None, model_rows
            with _measure_seconds(seconds, "update"):
                try:
                    learner.learn(Update(*rows, 1.0 / len(plan), collect.environment_steps))
                finally:  # torch also raises an error for a distribution with such a parameter
                    learner.check_parameters(collect.iteration)

        log = learner.log()
        if self.spec.string_gain is not None:
            with _measure_seconds(seconds, "string_gain"):
                log |= {"kept_update": limit_update(learner, parameters, self._is_allowed)}
        eps_pi = policy_distance(before, learner.residual_distribution(compared))
        log |= {"eps_pi_mean": float(eps_pi.mean()), "eps_pi_max": float(eps_pi.max())}
        for each in model_rollouts:
            eps_m = each.facts["eps_m_by_estimator"]["transitions"]
            each.facts["bound"] = each.bound(each.k_star, log["eps_pi_max"], eps_m)
        model_steps = sum(each.model_steps for each in model_rollouts)
        return IterationLog(log, model_steps, [each.facts for each in model_rollouts], seconds)

    def _check_limit(self, string_gain: Callable[[Network], float]) -> None:
        """Raise `InputError` if the string gain of the first policy is too large, or updates cannot be taken back."""
        if not self.learner.policy_parameters():
            name = type(self.learner).__name__
            raise InputError(f"policy.max_string_gain: {name} has no policy_parameters(), as such a limit needs")
        limit, gain = self.spec.policy.max_string_gain, string_gain(self.network())
        if gain > limit:
            allowed = f"at least {gain:.3f}, the gain of its first policy, or another expert"
            raise invalid_value("policy.max_string_gain", limit, allowed)

    def _is_allowed(self, network: Network) -> bool:
        string_gain = self.spec.string_gain
        return string_gain is None or string_gain(network) <= self.spec.policy.max_string_gain

    def _plan_updates(self, environment_steps: int) -> list[tuple[bool, int, int]]:
        """Return the updates of this iteration: (with environment rows, part of the model rows, number of parts)."""
        without_model = (True, 0, 0)
        if not self.model_rollouts or not self.learner.is_learning(environment_steps):
            return [without_model]
        settings = self.spec.model
        if settings.update_mode == "union":
            return [(True, 0, 1)]
        return [without_model, *((False, part, settings.model_updates) for part in range(settings.model_updates))]

    def _model_experience(self, iteration: int, part: int, parts: int) -> Experience | None:
        """Return one of `parts` of the experience of the present policy in all models, if there is any."""
        network = self.network()
        results = [each.roll_out(network, iteration, part, parts) for each in self.model_rollouts]
        rows = [each for each in results if each is not None]
        return join_experience(rows) if rows else None

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all values and tensors that are needed to resume after an iteration."""
        values, tensors = check_state(type(self.learner).__name__, self.learner.state())
        for each in self.model_rollouts:
            values[each.name], model_tensors = each.state()
            tensors |= {f"{each.name}/{name}": tensor.detach().clone() for name, tensor in model_tensors.items()}
        return values, tensors

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume, with the same configuration, from what `state` returned."""
        self.learner.restore(values, tensors)
        for each in self.model_rollouts:
            each.restore(values[each.name], tensors_with_prefix(f"{each.name}/", tensors))


def make_algorithm(agent: str, settings: LearnerSettings, spec: AgentSpec) -> Algorithm:
    """Return the algorithm of an agent: the user's own, or Algorithm 1 with the learner."""
    made = make_agent(agent, settings, spec)
    if not is_algorithm(made):
        return Algorithm1(spec, made)
    if spec.string_gain is not None:
        raise invalid_value("policy.max_string_gain", spec.policy.max_string_gain, f"none with {agent}, an algorithm")
    return made


@contextmanager
def _measure_seconds(seconds: dict[str, float], part: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[part] += time.perf_counter() - start
