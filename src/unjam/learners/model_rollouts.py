"""What Algorithm 1 does between actual episodes: fit the virtual environment, and imagine in it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from math import ceil
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.network import Network
from unjam.drivers.residual import ResidualDriver
from unjam.following.calibration import calibrate_human_drivers
from unjam.learners.experience import Experience
from unjam.learners.learner import tensors_with_prefix
from unjam.learners.settings import PolicySettings
from unjam.learners.waves import Waves
from unjam.models.comparison import return_gap
from unjam.models.dynamics import ModelDynamics, check_device
from unjam.models.ensemble import Ensemble, torch_generator
from unjam.models.environment_data import EnvironmentData, is_holdout_episode, pack_data, unpack_data
from unjam.models.fitting import ModelFit, fit_row_model
from unjam.models.road_model import RoadModel
from unjam.models.rollouts import RolloutBatch, draw_starts, prepare_starts, return_bound, roll_out, rollout_length
from unjam.models.row_model import RowModel
from unjam.models.settings import ModelSettings
from unjam.physics.idm import IDMParameters
from unjam.tree import pack, unpack
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats
from unjam.worlds.worker_pool import EpisodeTask

FIT_SEED, STARTS_SEED, NOISE_SEED, EXPLORATION_SEED = 2, 3, 4, 5
"""what the random numbers of an iteration are for, in their seeds"""
_DATA_PREFIX, _SAMPLES_PREFIX = "data/", "samples/"
"""prefixes of tensors in checkpoints"""


class ExperienceFactory(NamedTuple):
    """How what was imagined becomes what a learner takes."""

    privileged_inputs: Callable[[Floats], Floats]
    """from what episodes drew, shape (rows, m), to what the critic alone sees of it"""
    from_episodes: Callable[[Sequence[Episode]], Experience]
    """of whole episodes, as of actual ones"""


def full_policy(task: Task, policy: PolicySettings, network: Network) -> ResidualDriver:
    """Return the full policy on a task: its expert plus the residual of `network`."""
    hold = policy.action_repeat(task.scenario.control_step)
    return ResidualDriver(task.expert, network, task.scenario.action_limit, policy.inputs, hold)


EnsembleT = TypeVar("EnsembleT", bound=Ensemble)


class ModelRollouts(Generic[EnsembleT]):
    """The virtual environment of a run, and the actual data that it learns from.

    What kind of environment it is, its heirs say: what is learned, and how one drives in it.
    """

    def __init__(
        self, settings: ModelSettings, task: Task, policy: PolicySettings, run_seed: int, task_index: int = 0
    ) -> None:
        """Begin with physics alone, and without data; `index` is the task's place in its training.

        Raises:
            MissingPartError: the device that the settings name is not there.
        """
        check_device(settings.device, "model.device")
        self.settings = settings
        self.name = f"model-{task_index}" if task_index else "model"
        """in checkpoints"""
        self.data = EnvironmentData(settings.buffer_size)
        self.scenario = task.scenario
        """the road as far as it is known: with calibrated people where the settings ask for them"""
        self._task = task
        self._policy = policy
        self._run_seed = run_seed
        self._task_index = (task_index,) if task_index else ()
        self.model = self._new_model()
        self.model_steps = 0
        """virtual decisions of all iterations so far"""
        self.facts: dict[str, Any] = {}
        """what there is to say of the virtual environment in this iteration"""

    def _new_model(self) -> EnsembleT:
        """Return a model that has learned nothing."""
        raise NotImplementedError

    def _fit_model(self, seed: Sequence[int]) -> ModelFit:
        """Fit the model to D_a as it is now."""
        raise NotImplementedError

    def roll_out(
        self, network: Network, iteration: int, part: int, parts: int, experience_factory: ExperienceFactory
    ) -> Experience | None:
        """Return what the policy `network` does in the virtual environment; None where it is not trusted.

        Rollouts begin at random decisions at which a residual was due, `begin` says of which episodes. In all
        `parts` of an iteration together they make `model_ratio` times as many decisions as the newest
        actual episodes have.
        """
        raise NotImplementedError

    def _seed(self, *key: int) -> tuple[int, ...]:
        """Return a seed of the run's, the task's own."""
        return (self._run_seed, *key, *self._task_index)

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add actual episodes to D_a, fit the model to it, and find the rollout length of Eq. 15."""
        first = self.data.episode_count
        self.data.add(episodes, self.scenario)
        driven = (len(each.reward) for episode in episodes for each in episode.trajectories)
        self._first_new_episode, self._new_steps = first, sum(driven)
        settings = self.settings
        if settings.calibrate_base and first == 0:
            states = (kept.states for kept in self.data.recordings)
            self.scenario = replace(self.scenario, humans=calibrate_human_drivers(states, self.scenario))
        found = self._fit_model(self._seed(iteration, FIT_SEED))
        eps_m = found.errors[settings.error_estimator]
        self.k_star = rollout_length(eps_m, settings)
        self.facts = {
            "k_star": self.k_star,
            "eps_m": eps_m,
            "eps_m_by_estimator": found.errors,
            "one_step": {name: error._asdict() for name, error in found.one_step.items()},
            "learned_targets": list(found.learned_targets),
            "epochs": found.epochs,
        }

    def _draw_starts(self, parts: int, seed: tuple[int, ...], control_steps: int) -> NDArray[np.int64]:
        """Return where a part of an iteration's rollouts of so many decisions begin, as `draw_starts`."""
        count = ceil(self.settings.model_ratio * self._new_steps / parts / control_steps)
        begin = self.settings.rollout_starts
        since = self._first_new_episode if begin == "newest" else 0
        return draw_starts(self.data, count, 1, seed, since, episode_starts_only=begin == "first")

    def _note_returns(
        self, returns: Floats, start_indices: NDArray[np.int64], control_steps: int, crash_share: float
    ) -> None:
        """Note what the policy that drove the actual episodes earned here and there, and its crashes."""
        newest = [self.data.recordings[place].episode >= self._first_new_episode for place in start_indices[:, 0]]
        gap = return_gap(returns[newest], start_indices[newest], self.data, control_steps)
        self.facts |= {
            "return_model": gap and gap.model_return,
            "return_environment": gap and gap.environment_return,
            "crash_share": crash_share,
        }

    def bound(self, eps_pi: float, gamma: float) -> float:
        """Return the bound C for this iteration; `gamma` is that from choice to choice."""
        return self.bound_at(self.k_star, eps_pi, self.facts["eps_m_by_estimator"]["transitions"], gamma)

    def bound_at(self, k: int, eps_pi: float, eps_m: float, gamma: float) -> float:
        """Return the bound C with rollouts of `k` decisions; `gamma` is that from choice to choice."""
        return return_bound(eps_pi, eps_m, k, self.step_discount(gamma), self.max_reward)

    @property
    def max_reward(self) -> float:
        """R_max: the largest |reward| of a decision in the actual data."""
        return max(float(np.abs(kept.reward).max()) for kept in self.data.recordings)

    def step_discount(self, gamma: float) -> float:
        """Return the discount from decision to decision; `gamma` is that from choice to choice."""
        return gamma ** (1 / self._policy.action_repeat(self.scenario.control_step))

    def state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        """Return all that a run must keep of it to go on, as JSON and tensors."""
        facts, arrays = pack_data(self.data)
        tensors = {f"{_DATA_PREFIX}{name}": torch.from_numpy(np.array(array)) for name, array in arrays.items()}
        tensors |= {name: tensor.cpu() for name, tensor in self.model.state_dict().items()}
        return {"model_steps": self.model_steps, "data": facts, "humans": asdict(self.scenario.humans)}, tensors

    def restore(self, facts: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `state` returned."""
        arrays = {name: tensor.numpy() for name, tensor in tensors_with_prefix(_DATA_PREFIX, tensors).items()}
        self.data = unpack_data(facts["data"], arrays)
        self.model_steps = facts["model_steps"]
        self.scenario = replace(self.scenario, humans=IDMParameters(**facts["humans"]))
        self.model.load_state_dict({n: t for n, t in tensors.items() if not n.startswith(_DATA_PREFIX)})


class EpisodeSummary(Protocol):
    """What is kept of an actual episode."""

    @property
    def episode(self) -> int:
        """Number of the episode."""
        ...


SamplesT = TypeVar("SamplesT", bound=EpisodeSummary)


class WholeRoadRollouts(ModelRollouts[RoadModel], Generic[SamplesT]):
    """The virtual environment of a run as whole roads, of which more is kept than what CAVs perceived."""

    sample_type: type[SamplesT]
    """of what is kept of each episode"""

    def __init__(self, *args: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `ModelRollouts`."""
        super().__init__(*args)
        self.samples: list[SamplesT] = []
        """of the episodes in D_a, oldest first"""

    def _new_model(self) -> RoadModel:
        return RoadModel(self.settings, self._seed(FIT_SEED))

    def _sample_episode(self, episode: Episode, number: int) -> SamplesT:
        """Return what is kept of an actual episode, the so many-th."""
        raise NotImplementedError

    def _fit_samples(self, seed: Sequence[int]) -> ModelFit:
        """Fit the model to what is kept of D_a as it is now."""
        raise NotImplementedError

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return a road as it was and as it is imagined; `drive` runs an episode where actual ones run."""
        raise NotImplementedError

    @property
    def _holdout_samples(self) -> SamplesT:
        """The newest episode that no network learned from, if there is one."""
        share, twins = self.settings.holdout, self._episodes_per_group
        unseen = [each for each in self.samples if is_holdout_episode(each.episode // twins, share)]
        return (unseen or self.samples)[-1]

    @property
    def _episodes_per_group(self) -> int:
        """How many episodes in a row meet the same people: they are held out together."""
        return len(self._policy.exploration_signs)

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add actual episodes to D_a, fit the model to it, and find the rollout length of Eq. 15."""
        first = self.data.episode_count
        self.samples += [self._sample_episode(episode, first + place) for place, episode in enumerate(episodes)]
        super().learn(episodes, iteration)

    def _fit_model(self, seed: Sequence[int]) -> ModelFit:
        oldest = self.data.recordings[0].episode
        self.samples = [kept for kept in self.samples if kept.episode >= oldest]
        return self._fit_samples(seed)

    def state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        """Return all that a run must keep of it to go on, as JSON and tensors."""
        facts, tensors = super().state()
        kept, arrays = pack(self.samples)
        tensors |= {f"{_SAMPLES_PREFIX}{name}": torch.from_numpy(np.array(array)) for name, array in arrays.items()}
        return {**facts, "samples": kept}, tensors

    def restore(self, facts: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `state` returned."""
        arrays = {name: tensor.numpy() for name, tensor in tensors_with_prefix(_SAMPLES_PREFIX, tensors).items()}
        self.samples = unpack(list[self.sample_type], facts["samples"], arrays)
        super().restore(facts, {n: t for n, t in tensors.items() if not n.startswith(_SAMPLES_PREFIX)})


class RowRollouts(ModelRollouts[RowModel]):
    """The paper's: a row is a CAV with its leader and its follower."""

    def _new_model(self) -> RowModel:
        drawn = len(self._task.scenario.drawn_ranges)
        return RowModel(self.settings, drawn, self._seed(FIT_SEED), self.settings.device)

    def _fit_model(self, seed: Sequence[int]) -> ModelFit:
        actual = self.data.transitions(self.settings.holdout)
        return fit_row_model(self.model, actual, self.settings, self.scenario, self._task.reward, seed)

    def roll_out(
        self, network: Network, iteration: int, part: int, parts: int, experience_factory: ExperienceFactory
    ) -> Experience | None:
        """Return what the policy `network` does with rows; None where there are none."""
        rollouts = self.roll_out_rows(network, iteration, part, parts)
        if rollouts is None:
            return None
        return rollout_experience(rollouts, experience_factory.privileged_inputs(rollouts.drawn_values.cpu().numpy()))

    def roll_out_rows(self, network: Network, iteration: int, part: int = 0, parts: int = 1) -> RolloutBatch | None:
        """Return the virtual rollouts of rows; None where there are none."""
        driver = full_policy(self._task, self._policy, network)
        driven = self.k_star // driver.action_repeat * driver.action_repeat
        if driven == 0:
            return None
        seeds = [self._seed(iteration, purpose, part) for purpose in (STARTS_SEED, NOISE_SEED, EXPLORATION_SEED)]
        choices = self._draw_starts(parts, seeds[0], driven)
        if len(choices) == 0:
            return None
        noise, exploration = (torch_generator(seed, self.settings.device) for seed in seeds[1:])
        world = ModelDynamics(self.model, self.scenario, self._task.reward, noise, self.settings.add_noise)
        starts = prepare_starts(self.data, choices, self._task.expert, self.settings.device)
        rollouts = roll_out(driver, world, starts, driven, exploration)
        self.model_steps += rollouts.control_steps
        if part == 0:
            earned = rollouts.rewards.sum(1).double().cpu().numpy()
            self._note_returns(earned, rollouts.start_indices, driven, float(rollouts.terminated.double().mean()))
            self.facts["clipped_share"] = rollouts.clipped_share
        return rollouts


def rollout_experience(rollouts: RolloutBatch, critic_inputs: NDArray[np.floating]) -> Experience:
    """Return virtual rollouts in the form in which learners take them; the cut at k* is no termination.

    `critic_inputs`, shape (n, m), is what the critic alone sees in each row.
    """
    made = rollouts.lengths.cpu().numpy()
    seen = rollouts.observations.cpu().numpy()
    extra = np.broadcast_to(critic_inputs[:, None], (*seen.shape[:2], critic_inputs.shape[1]))
    seen = np.concatenate([seen, extra], axis=2)
    counted = np.arange(seen.shape[1] - 1) < made[:, None]
    return Experience(
        observations=seen[:, :-1][counted].astype(np.float32),
        actions=rollouts.actions.cpu().numpy()[counted].astype(np.float32),
        rewards=rollouts.rewards.cpu().numpy()[counted].astype(np.float64),
        starts=np.concatenate([[0], made.cumsum()[:-1]]).astype(np.intp),
        last_observations=seen[np.arange(len(made)), made].astype(np.float32),
        terminated=rollouts.terminated.cpu().numpy(),
    )
