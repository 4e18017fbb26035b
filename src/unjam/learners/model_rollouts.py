"""Model rollouts of Algorithm 1: a world model is fitted to environment episodes, and the policy drives in it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.network import Network
from unjam.drivers.residual import ResidualDriver
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Tensors
from unjam.learners.experience import Experience, join_experience, task_experience
from unjam.learners.settings import PolicySettings
from unjam.models.ensemble import Seed
from unjam.models.registry import world_model_class
from unjam.models.rollouts import RolloutBatch, return_bound, rollout_length
from unjam.models.world_model import RolloutPlan, Rollouts
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats

FIT_SEED, STARTS_SEED, NOISE_SEED, EXPLORATION_SEED = 2, 3, 4, 5
"""last elements of seeds, which separate the random numbers of an iteration by purpose"""


def full_policy(task: Task, policy: PolicySettings, network: Network) -> ResidualDriver:
    """Return the full policy on a task: its expert plus the residual of `network`."""
    action_repeat = policy.action_repeat(task.scenario.control_step)
    return ResidualDriver(task.expert, network, task.scenario.action_limit, policy.inputs, action_repeat)


class ModelRollouts:
    """The world model of a task in a training, its rollout length, and the experience of the policy in it."""

    def __init__(self, spec: AgentSpec, task_index: int = 0) -> None:
        """Make an untrained model without data; raise `InputError` if scenario or settings are not supported."""
        self.spec, self.task, self._task_index = spec, spec.tasks[task_index], task_index
        self.name = f"model-{task_index}" if task_index else "model"
        """name of the model in checkpoints"""
        model_class = world_model_class(self.task.scenario, spec.model)
        self.world_model = model_class(spec.model, self.task, spec.policy.exploration_signs, self._seed(FIT_SEED))
        self.model_steps = 0
        """control steps in the model so far"""
        self.k_star = 0
        """rollout length [control steps]; 0: the model must not be used"""
        self.facts: dict[str, Any] = {}
        """results of the newest fit and rollouts, for the rows of progress"""

    def _seed(self, *key: int) -> Seed:
        return (self.spec.seed, *key, *([self._task_index] if self._task_index else []))

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add environment episodes to D_a, fit the model to it, and set the rollout length of Eq. 15."""
        self.world_model.add(episodes)
        fit = self.world_model.fit(self._seed(iteration, FIT_SEED))
        eps_m = fit.errors[self.spec.model.error_estimator]
        self.k_star = rollout_length(eps_m, self.spec.model)
        self.facts = {
            "k_star": self.k_star,
            "eps_m": eps_m,
            "eps_m_by_estimator": fit.errors,
            "one_step": {name: error._asdict() for name, error in fit.one_step.items()},
            "learned_targets": list(fit.learned_targets),
            "epochs": fit.epochs,
        }

    def roll_out(self, network: Network, iteration: int, part: int = 0, parts: int = 1) -> Experience | None:
        """Return the part with index `part` of the experience of `network` in the model; None if k* is too short."""
        model, driver = self.world_model, full_policy(self.task, self.spec.policy, network)
        control_steps = int(min(self.k_star, model.max_control_steps)) // driver.action_repeat * driver.action_repeat
        seed, *seeds = (self._seed(iteration, purpose, part) for purpose in (STARTS_SEED, NOISE_SEED, EXPLORATION_SEED))
        starts = model.draw_starts(control_steps, parts, seed) if control_steps else ()
        if len(starts) == 0:
            return None
        plan = RolloutPlan(driver, starts, control_steps, *seeds)
        returns, crashed, experience = list[Floats](), list[bool](), list[Experience]()
        facts: Mapping[str, Any] = {}
        for batch in model.roll_out(plan):
            self.model_steps += batch.control_steps
            returns.append(batch.returns)
            crashed += batch.crashed
            facts = batch.facts
            experience += self._batch_experience(batch)
        if part == 0:
            recorded = model.recorded_returns(plan)
            is_known = ~np.isnan(recorded)
            pair = (np.concatenate(returns)[is_known], recorded[is_known]) if is_known.any() else (None, None)
            model_return, environment_return = (None if values is None else float(values.mean()) for values in pair)
            self.facts |= {"return_model": model_return, "return_environment": environment_return}
            self.facts |= {"crash_share": float(np.mean(crashed)), **facts}
        return join_experience(experience) if experience else None

    def _batch_experience(self, batch: Rollouts) -> list[Experience]:
        if batch.rows is not None:
            inputs = self.spec.privileged_inputs(self._task_index, batch.rows.drawn_values.cpu().numpy())
            return [rollout_experience(batch.rows, inputs)]
        has_cavs = any(episode.trajectories for episode in batch.episodes)
        return [task_experience(self.spec, self._task_index, batch.episodes)] if has_cavs else []

    def bound(self, k: int, eps_pi: float, eps_m: float) -> float:
        """Return the paper's bound C for rollouts of `k` control steps."""
        return return_bound(eps_pi, eps_m, k, self.step_discount, self.world_model.max_reward)

    @property
    def step_discount(self) -> float:
        """Discount factor per control step."""
        return self.spec.gamma ** (1 / self.spec.policy.action_repeat(self.task.scenario.control_step))

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return values for JSON and tensors, with which a run resumes."""
        values, tensors = self.world_model.state()
        return values | {"model_steps": self.model_steps}, tensors

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from the values and tensors that `state` returned."""
        self.world_model.restore(values, tensors)
        self.model_steps = values["model_steps"]


def rollout_experience(rollouts: RolloutBatch, critic_inputs: NDArray[np.floating]) -> Experience:
    """Return rollouts of rows as experience, with additional inputs of the critic, shape (n, m)."""
    lengths = rollouts.lengths.cpu().numpy()
    observations = rollouts.observations.cpu().numpy()
    repeated_inputs = np.broadcast_to(critic_inputs[:, None], (*observations.shape[:2], critic_inputs.shape[1]))
    observations = np.concatenate([observations, repeated_inputs], axis=2)
    is_valid = np.arange(observations.shape[1] - 1) < lengths[:, None]
    return Experience(
        observations=observations[:, :-1][is_valid].astype(np.float32),
        actions=rollouts.actions.cpu().numpy()[is_valid].astype(np.float32),
        rewards=rollouts.rewards.cpu().numpy()[is_valid].astype(np.float64),
        starts=np.concatenate([[0], lengths.cumsum()[:-1]]).astype(np.intp),
        last_observations=observations[np.arange(len(lengths)), lengths].astype(np.float32),
        terminated=rollouts.terminated.cpu().numpy(),
    )
