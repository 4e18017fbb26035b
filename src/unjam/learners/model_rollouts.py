"""What Algorithm 1 does between environment episodes: fit a model to them, and roll the policy out in it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from math import ceil
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.network import Network
from unjam.drivers.residual import ResidualDriver
from unjam.following.calibration import calibrate_human_drivers
from unjam.learners.algorithm import Tensors, tensors_with_prefix
from unjam.learners.experience import Experience
from unjam.learners.settings import PolicySettings
from unjam.models.comparison import mean_returns
from unjam.models.ensemble import Ensemble, ModelFit, Seed, torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.rollouts import (
    ModelDynamics,
    RolloutBatch,
    check_device,
    draw_starts,
    prepare_starts,
    return_bound,
    roll_out,
    rollout_length,
)
from unjam.models.row_model import RowModel, fit_row_model
from unjam.models.settings import ModelSettings
from unjam.physics.idm import IDMParameters
from unjam.tree import pack, unpack
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats

FIT_SEED, STARTS_SEED, NOISE_SEED, EXPLORATION_SEED = 2, 3, 4, 5
"""purposes of the random numbers of an iteration, in their seeds"""
EnsembleT = TypeVar("EnsembleT", bound=Ensemble)


class ExperienceFactory(NamedTuple):
    """Converts model rollouts to the experience of learners."""

    privileged_inputs: Callable[[Floats], Floats]
    """returns the inputs of the critic alone, for the scaled values that episodes drew, shape (rows, m)"""
    from_episodes: Callable[[Sequence[Episode]], Experience]
    """returns the experience of whole episodes of the model, as for episodes of the environment"""


class RolloutPlan(NamedTuple):
    """Model rollouts from recorded states, `StartIndices`, or with the vehicles of episodes, a list of samples."""

    driver: ResidualDriver
    starts: Any
    control_steps: int
    noise_seed: Seed
    exploration_seed: Seed


class RolloutResult(NamedTuple):
    """Experience, if a CAV was on the road; total of control steps; return of each rollout; facts, as `crash_share`."""

    experience: Experience | None
    control_steps: int
    returns: Floats
    facts: dict[str, Any]


def full_policy(task: Task, policy: PolicySettings, network: Network) -> ResidualDriver:
    """Return the full policy on a task: its expert plus the residual of `network`."""
    repeat = policy.action_repeat(task.scenario.control_step)
    return ResidualDriver(task.expert, network, task.scenario.action_limit, policy.inputs, repeat)


class ModelRollouts(Generic[EnsembleT]):
    """The learned model of a task, the environment data D_a that it is fitted to, and the rollouts in it."""

    model: EnsembleT
    stored_types: ClassVar[dict[str, Any]] = {"data": EnvironmentData}
    """types of the attributes that checkpoints store"""

    def __init__(
        self, settings: ModelSettings, task: Task, policy: PolicySettings, run_seed: int, task_index: int = 0
    ) -> None:
        """Start with the base alone and without data; `InputError` if scenario or settings are not supported."""
        check_device(settings.device, "model.device")
        self.settings = settings
        self.name = f"model-{task_index}" if task_index else "model"
        """name in checkpoints"""
        self.data = EnvironmentData(settings.buffer_size)
        self.scenario = task.scenario
        """the road, with calibrated IDM parameters if the settings ask for them"""
        self._task, self._policy, self._run_seed = task, policy, run_seed
        self._task_index = (task_index,) if task_index else ()
        self.model = self._new_model()
        self.model_steps = 0
        """number of model steps of all iterations"""
        self.facts: dict[str, Any] = {}
        """about the model in this iteration"""

    def _new_model(self) -> EnsembleT:
        raise NotImplementedError

    def _store_episodes(self, episodes: Sequence[Episode]) -> None:
        self.data.add(episodes, self.scenario)

    def _fit_model(self, seed: Seed) -> ModelFit:
        raise NotImplementedError

    def _run(self, plan: RolloutPlan, experience_factory: ExperienceFactory) -> RolloutResult:
        raise NotImplementedError

    def roll_out(
        self, network: Network, iteration: int, part: int, parts: int, experience_factory: ExperienceFactory
    ) -> Experience | None:
        """Return experience of the policy `network` in the model; None if k* is too short, or there is none.

        All `parts` of an iteration together have `model_ratio` times as many control steps as its environment episodes.
        """
        driver = full_policy(self._task, self._policy, network)
        control_steps = self._max_control_steps // driver.action_repeat * driver.action_repeat
        seed, *seeds = (self._seed(iteration, purpose, part) for purpose in (STARTS_SEED, NOISE_SEED, EXPLORATION_SEED))
        starts = self._draw_starts(parts, seed, control_steps) if control_steps else ()
        if len(starts) == 0:
            return None
        plan = RolloutPlan(driver, starts, control_steps, *seeds)
        result = self._run(plan, experience_factory)
        self.model_steps += result.control_steps
        if part == 0:
            model, environment = self._compare_returns(plan, result.returns)
            self.facts |= {"return_model": model, "return_environment": environment, **result.facts}
        return result.experience

    @property
    def _max_control_steps(self) -> int:
        return self.k_star

    def _seed(self, *key: int) -> Seed:
        return (self._run_seed, *key, *self._task_index)

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add environment episodes to D_a, fit the model to it, and set the rollout length of Eq. 15."""
        first = self._first_new_episode = self.data.episode_count
        self._store_episodes(episodes)
        self._new_steps = sum(len(each.reward) for episode in episodes for each in episode.trajectories)
        if self.settings.calibrate_base and first == 0:
            states = (recording.states for recording in self.data.recordings)
            self.scenario = replace(self.scenario, humans=calibrate_human_drivers(states, self.scenario))
        fit = self._fit_model(self._seed(iteration, FIT_SEED))
        eps_m = fit.errors[self.settings.error_estimator]
        self.k_star = rollout_length(eps_m, self.settings)
        self.facts = {
            "k_star": self.k_star,
            "eps_m": eps_m,
            "eps_m_by_estimator": fit.errors,
            "one_step": {name: error._asdict() for name, error in fit.one_step.items()},
            "learned_targets": list(fit.learned_targets),
            "epochs": fit.epochs,
        }

    def _draw_starts(self, parts: int, seed: Seed, control_steps: int) -> Any:
        """Return the starts of a part of an iteration's rollouts of `control_steps`, as `draw_starts`."""
        count = ceil(self.settings.model_ratio * self._new_steps / parts / control_steps)
        starts = self.settings.rollout_starts
        first_episode = self._first_new_episode if starts == "newest" else 0
        return draw_starts(self.data, count, 1, seed, first_episode, episode_starts_only=starts == "first")

    def _compare_returns(self, plan: RolloutPlan, returns: Floats) -> tuple[float | None, float | None]:
        """Return the mean returns of model and environment from starts in episodes of the newest policy."""
        is_new = [self.data.recordings[index].episode >= self._first_new_episode for index in plan.starts[:, 0]]
        return mean_returns(returns[is_new], plan.starts[is_new], self.data, plan.control_steps)

    def bound(self, k: int, eps_pi: float, eps_m: float, gamma: float) -> float:
        """Return the bound C for rollouts of `k` control steps; `gamma` is the discount from action to action."""
        return return_bound(eps_pi, eps_m, k, self.step_discount(gamma), self.max_reward)

    @property
    def max_reward(self) -> float:
        """R_max: the largest |reward| of a control step in D_a."""
        return max(float(np.abs(recording.reward).max()) for recording in self.data.recordings)

    def step_discount(self, gamma: float) -> float:
        """Return the discount per control step; `gamma` is that from action to action."""
        return gamma ** (1 / self._policy.action_repeat(self.scenario.control_step))

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all that a run needs to resume, as JSON and tensors."""
        facts: dict[str, Any] = {"model_steps": self.model_steps, "humans": asdict(self.scenario.humans)}
        tensors = {name: tensor.cpu() for name, tensor in self.model.state_dict().items()}
        for name in self.stored_types:
            facts[name], arrays = pack(getattr(self, name))
            tensors |= {f"{name}/{path}": torch.from_numpy(np.array(array)) for path, array in arrays.items()}
        return facts, tensors

    def restore(self, facts: dict[str, Any], tensors: Tensors) -> None:
        """Resume from what `state` returned."""
        for name, kind in self.stored_types.items():
            arrays = {path: tensor.numpy() for path, tensor in tensors_with_prefix(f"{name}/", tensors).items()}
            setattr(self, name, unpack(kind, facts[name], arrays))
        self.model_steps = facts["model_steps"]
        self.scenario = replace(self.scenario, humans=IDMParameters(**facts["humans"]))
        self.model.load_state_dict({name: tensor for name, tensor in tensors.items() if "/" not in name})


class RowRollouts(ModelRollouts[RowModel]):
    """The paper's virtual environment: a row is a CAV with its leader and its follower."""

    def _new_model(self) -> RowModel:
        drawn_count = len(self._task.scenario.drawn_ranges)
        return RowModel(self.settings, drawn_count, self._seed(FIT_SEED), self.settings.device)

    def _fit_model(self, seed: Seed) -> ModelFit:
        transitions = self.data.transitions(self.settings.holdout)
        return fit_row_model(self.model, transitions, self.settings, self.scenario, self._task.reward, seed)

    def simulate(self, plan: RolloutPlan) -> RolloutBatch:
        """Return the rollouts of rows from `StartIndices`."""
        device = self.settings.device
        noise, exploration = (torch_generator(seed, device) for seed in (plan.noise_seed, plan.exploration_seed))
        dynamics = ModelDynamics(self.model, self.scenario, self._task.reward, noise, self.settings.add_noise)
        starts = prepare_starts(self.data, plan.starts, self._task.expert, device)
        return roll_out(plan.driver, dynamics, starts, plan.control_steps, exploration)

    def _run(self, plan: RolloutPlan, experience_factory: ExperienceFactory) -> RolloutResult:
        rollouts = self.simulate(plan)
        inputs = experience_factory.privileged_inputs(rollouts.drawn_values.cpu().numpy())
        returns = rollouts.rewards.sum(1).double().cpu().numpy()
        crash_share = float(rollouts.terminated.double().mean())
        facts = {"crash_share": crash_share, "clipped_share": rollouts.clipped_share}
        return RolloutResult(rollout_experience(rollouts, inputs), rollouts.control_steps, returns, facts)


def rollout_experience(rollouts: RolloutBatch, critic_inputs: NDArray[np.floating]) -> Experience:
    """Return rollouts of rows as experience, with `critic_inputs`, (n, m); the truncation at k* is no termination."""
    lengths = rollouts.lengths.cpu().numpy()
    observations = rollouts.observations.cpu().numpy()
    extra = np.broadcast_to(critic_inputs[:, None], (*observations.shape[:2], critic_inputs.shape[1]))
    observations = np.concatenate([observations, extra], axis=2)
    is_valid = np.arange(observations.shape[1] - 1) < lengths[:, None]
    return Experience(
        observations=observations[:, :-1][is_valid].astype(np.float32),
        actions=rollouts.actions.cpu().numpy()[is_valid].astype(np.float32),
        rewards=rollouts.rewards.cpu().numpy()[is_valid].astype(np.float64),
        starts=np.concatenate([[0], lengths.cumsum()[:-1]]).astype(np.intp),
        last_observations=observations[np.arange(len(lengths)), lengths].astype(np.float32),
        terminated=rollouts.terminated.cpu().numpy(),
    )
