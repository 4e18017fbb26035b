"""World models: what is learned of a task's road, and the worlds in which a policy is rolled out."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from math import ceil, inf, nan
from types import MappingProxyType
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from unjam.drivers.residual import ResidualDriver
from unjam.following.calibration import calibrate_human_drivers
from unjam.models.ensemble import Ensemble, ModelFit, Seed
from unjam.models.environment_data import EnvironmentData
from unjam.models.rollouts import RolloutBatch, check_device, draw_starts
from unjam.models.settings import ModelSettings
from unjam.physics.idm import IDMParameters
from unjam.scenarios.scenario import Scenario
from unjam.tree import pack, select_prefix, unpack
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats

EnsembleT = TypeVar("EnsembleT", bound=Ensemble)
EpisodeSamplesT = TypeVar("EpisodeSamplesT", bound=Any)


class RolloutPlan(NamedTuple):
    """Model rollouts of a driver from starts that the world model has drawn."""

    driver: ResidualDriver
    starts: Any
    control_steps: int
    noise_seed: Seed
    exploration_seed: Seed


class Rollouts(NamedTuple):
    """Model rollouts, either rows or whole episodes."""

    control_steps: int
    returns: Floats
    crashed: Sequence[bool]
    rows: RolloutBatch | None = None
    episodes: Sequence[Episode] = ()
    facts: Mapping[str, Any] = MappingProxyType({})


class WorldModel(Generic[EnsembleT, EpisodeSamplesT]):
    """An ensemble that is fitted to the environment data D_a of a task, and worlds made of it; subclasses are kinds."""

    samples_type: ClassVar[Any] = None
    """type of the samples of each episode to which the ensemble is fitted; None: it is fitted to D_a itself"""

    def __init__(self, settings: ModelSettings, task: Task, exploration_signs: Sequence[float], seed: Seed) -> None:
        """Start with the base alone and without data; `InputError` if scenario or settings are not supported."""
        check_device(settings.device, "model.device")
        self.check(task.scenario, settings)
        self.settings, self.task, self.exploration_signs, self.seed = settings, task, exploration_signs, seed
        self.scenario = replace(task.scenario, humans=replace(task.scenario.humans, **settings.humans))
        """the road with the IDM parameters of the base, which are calibrated if the settings ask for it"""
        self.data = EnvironmentData(settings.buffer_size, task.scenario.actuator, task.scenario.control_step)
        self.samples: list[EpisodeSamplesT] = []
        """samples of the episodes in D_a, oldest first"""
        self.first_new_episode, self.new_steps = 0, 0
        """number of the first of the newest episodes, and control steps of all CAVs in them"""
        self.ensemble = self.new_ensemble()

    @classmethod
    def check(cls, scenario: Scenario, settings: ModelSettings) -> None:
        """Raise `InputError` if a scenario or a setting is not supported."""

    @property
    def max_control_steps(self) -> float:
        """Largest number of control steps of a rollout."""
        return inf

    @property
    def cavs_per_start(self) -> int:
        """Number of CAVs of a rollout."""
        return 1

    def new_ensemble(self) -> EnsembleT:
        """Return the ensemble before any fit: the base alone."""
        raise NotImplementedError

    def sample_episode(self, episode: Episode, number: int) -> EpisodeSamplesT:
        """Return the samples of an episode with this number."""
        raise NotImplementedError

    def fit(self, seed: Seed) -> ModelFit:
        """Fit the ensemble further to the present data."""
        raise NotImplementedError

    def roll_out(self, plan: RolloutPlan) -> Iterator[Rollouts]:
        """Yield the rollouts of a plan, batch by batch."""
        raise NotImplementedError

    def add(self, episodes: Sequence[Episode]) -> None:
        """Add environment episodes to D_a; the first ones calibrate the IDM of the base if the settings ask for it."""
        self.first_new_episode = first = self.data.episode_count
        self.new_steps = sum(len(trajectory.reward) for episode in episodes for trajectory in episode.trajectories)
        if self.samples_type:
            self.samples += [self.sample_episode(episode, first + index) for index, episode in enumerate(episodes)]
        self.data.add(episodes, self.scenario)
        self.samples = [sample for sample in self.samples if sample.episode >= self.data.recordings[0].episode]
        if self.settings.calibrate_base and first == 0:
            states = (recording.states for recording in self.data.recordings)
            self.scenario = replace(self.scenario, humans=calibrate_human_drivers(states, self.scenario))

    def draw_starts(self, control_steps: int, parts: int, seed: Seed) -> Any:
        """Return random recorded states for one of several parts of the rollouts, by `model_ratio` in all."""
        kind = self.settings.rollout_starts
        count = ceil(self.settings.model_ratio * self.new_steps / (parts * self.cavs_per_start) / control_steps)
        first_episode = self.first_new_episode if kind == "newest" else 0
        return draw_starts(self.data, count, 1, seed, first_episode, episode_starts_only=kind == "first")

    def recorded_returns(self, plan: RolloutPlan) -> Floats:
        """Return the returns of D_a from the starts on, NaN for older than the newest episodes or with too few steps.

        They are undiscounted, up to the last step or a crash; rollouts must have the same policy and exploration.
        """
        rewards = [self.data.recordings[index].reward[at : at + plan.control_steps] for index, at in plan.starts]
        is_new = [self.data.recordings[index].episode >= self.first_new_episode for index in plan.starts[:, 0]]
        is_known = [new and len(row) == plan.control_steps for new, row in zip(is_new, rewards, strict=True)]
        return np.array([row.sum() if known else nan for known, row in zip(is_known, rewards, strict=True)])

    @property
    def max_reward(self) -> float:
        """R_max: the largest |reward| of a control step in D_a."""
        return max(float(np.abs(recording.reward).max()) for recording in self.data.recordings)

    def _stored_parts(self) -> dict[str, Any]:
        samples = {"samples": list[self.samples_type]} if self.samples_type else {}
        return {"data": EnvironmentData} | samples

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return data and weights, as JSON and tensors."""
        values: dict[str, Any] = {"humans": asdict(self.scenario.humans)}
        tensors = {name: tensor.cpu() for name, tensor in self.ensemble.state_dict().items()}
        for name in self._stored_parts():
            values[name], arrays = pack(getattr(self, name))
            tensors |= {f"{name}/{path}": torch.from_numpy(np.array(array)) for path, array in arrays.items()}
        return values, tensors

    def restore(self, values: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Continue from what `state` returned."""
        for name, kind in self._stored_parts().items():
            arrays = {path: tensor.numpy().copy() for path, tensor in select_prefix(f"{name}/", tensors).items()}
            setattr(self, name, unpack(kind, values[name], arrays))
        self.scenario = replace(self.scenario, humans=IDMParameters(**values["humans"]))
        self.ensemble.load_state_dict({name: tensor for name, tensor in tensors.items() if "/" not in name})
