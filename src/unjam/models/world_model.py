"""World models: learned models of the road of a task, in which a policy is rolled out."""

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
    """The plan of model rollouts of a driver."""

    driver: ResidualDriver
    starts: Any
    """starts that the world model has drawn, of a type that depends on its kind"""
    control_steps: int
    noise_seed: Seed
    exploration_seed: Seed


class Rollouts(NamedTuple):
    """Model rollouts, either of rows or of whole episodes."""

    control_steps: int
    returns: Floats
    crashed: Sequence[bool]
    rows: RolloutBatch | None = None
    episodes: Sequence[Episode] = ()
    facts: Mapping[str, Any] = MappingProxyType({})
    """further results for the log"""


class WorldModel(Generic[EnsembleT, EpisodeSamplesT]):
    """An ensemble that is fitted to the environment data D_a of a task, and rollouts in it; base class of all kinds."""

    samples_type: ClassVar[Any] = None
    """type of the samples of episodes to which the ensemble is fitted; None: the ensemble is fitted to D_a"""

    def __init__(self, settings: ModelSettings, task: Task, exploration_signs: Sequence[float], seed: Seed) -> None:
        """Start with no data and an unfitted ensemble; raise `InputError` if an argument is not supported."""
        check_device(settings.device, "model.device")
        self.check(task.scenario, settings)
        self.settings, self.task, self.exploration_signs, self.seed = settings, task, exploration_signs, seed
        self.scenario = replace(task.scenario, humans=replace(task.scenario.humans, **settings.humans))
        """the scenario with the IDM parameters of the base, which are calibrated if `calibrate_base` is set"""
        self.data = EnvironmentData(settings.buffer_size, task.scenario.actuator, task.scenario.control_step)
        self.samples: list[EpisodeSamplesT] = []
        """samples of the episodes in D_a, oldest first"""
        self.first_new_episode, self.new_steps = 0, 0
        """index of the first of the newest episodes, and number of control steps of all CAVs in these episodes"""
        self.ensemble = self.new_ensemble()

    @classmethod
    def check(cls, scenario: Scenario, settings: ModelSettings) -> None:
        """Raise `InputError` if a scenario or a setting is not supported."""

    @property
    def max_control_steps(self) -> float:
        """Maximum number of control steps of a rollout."""
        return inf

    @property
    def cavs_per_start(self) -> int:
        """Number of CAVs of a rollout."""
        return 1

    def new_ensemble(self) -> EnsembleT:
        """Return an unfitted ensemble, with which the model is the base."""
        raise NotImplementedError

    def sample_episode(self, episode: Episode, index: int) -> EpisodeSamplesT:
        """Return the samples of the environment episode `index`."""
        raise NotImplementedError

    def fit(self, seed: Seed) -> ModelFit:
        """Continue to fit the ensemble to the current data."""
        raise NotImplementedError

    def roll_out(self, plan: RolloutPlan) -> Iterator[Rollouts]:
        """Yield the rollouts of a plan, batch by batch."""
        raise NotImplementedError

    def add(self, episodes: Sequence[Episode]) -> None:
        """Add environment episodes to D_a; the first call calibrates the IDM of the base if `calibrate_base` is set."""
        self.first_new_episode = self.data.episode_count
        self.new_steps = sum(len(trajectory.reward) for episode in episodes for trajectory in episode.trajectories)
        if self.samples_type:
            indexed_episodes = enumerate(episodes, start=self.first_new_episode)
            self.samples += [self.sample_episode(episode, index) for index, episode in indexed_episodes]
        self.data.add(episodes, self.scenario)
        self.samples = [sample for sample in self.samples if sample.episode >= self.data.recordings[0].episode]
        if self.settings.calibrate_base and self.first_new_episode == 0:
            states = (recording.states for recording in self.data.recordings)
            self.scenario = replace(self.scenario, humans=calibrate_human_drivers(states, self.scenario))

    def draw_starts(self, control_steps: int, part_count: int, seed: Seed) -> Any:
        """Return random recorded states for one of `part_count` parts of the rollouts that `model_ratio` requires."""
        kind = self.settings.rollout_starts
        count = ceil(self.settings.model_ratio * self.new_steps / (part_count * self.cavs_per_start) / control_steps)
        first_episode = self.first_new_episode if kind == "newest" else 0
        return draw_starts(self.data, count, 1, seed, first_episode, episode_starts_only=kind == "first")

    def recorded_returns(self, plan: RolloutPlan) -> Floats:
        """Return the undiscounted returns in D_a from the starts on, with which returns of rollouts are compared.

        They are NaN for episodes that are not among the newest, and for recordings that end before the rollouts.
        """
        rewards = [self.data.recordings[index].reward[step : step + plan.control_steps] for index, step in plan.starts]
        is_new = [self.data.recordings[index].episode >= self.first_new_episode for index in plan.starts[:, 0]]
        pairs = zip(is_new, rewards, strict=True)
        return np.array([row.sum() if new and len(row) == plan.control_steps else nan for new, row in pairs])

    @property
    def max_reward(self) -> float:
        """The largest absolute reward of a control step in D_a, R_max."""
        return max(float(np.abs(recording.reward).max()) for recording in self.data.recordings)

    def _stored_attributes(self) -> dict[str, Any]:
        """Return the types of the attributes with data, by name."""
        samples = {"samples": list[self.samples_type]} if self.samples_type else {}
        return {"data": EnvironmentData} | samples

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return data and weights as JSON and tensors."""
        values: dict[str, Any] = {"humans": asdict(self.scenario.humans)}
        tensors = {name: tensor.cpu() for name, tensor in self.ensemble.state_dict().items()}
        for name in self._stored_attributes():
            values[name], arrays = pack(getattr(self, name))
            tensors |= {f"{name}/{path}": torch.from_numpy(np.array(array)) for path, array in arrays.items()}
        return values, tensors

    def restore(self, values: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Restore data and weights from the values that `state` returned."""
        for name, kind in self._stored_attributes().items():
            arrays = {path: tensor.numpy().copy() for path, tensor in select_prefix(f"{name}/", tensors).items()}
            setattr(self, name, unpack(kind, values[name], arrays))
        self.scenario = replace(self.scenario, humans=IDMParameters(**values["humans"]))
        self.ensemble.load_state_dict({name: tensor for name, tensor in tensors.items() if "/" not in name})
