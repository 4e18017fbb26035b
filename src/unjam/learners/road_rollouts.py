"""Imagining whole roads: everybody drives on, from recorded moments, and waves come and go."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.network import Network
from unjam.drivers.residual import EXPERT_KEY, RESIDUAL_AGE_KEY, RESIDUAL_KEY
from unjam.learners.experience import Experience
from unjam.learners.model_rollouts import (
    EXPLORATION_SEED,
    NOISE_SEED,
    STARTS_SEED,
    ExperienceFactory,
    WholeRoadRollouts,
    full_policy,
)
from unjam.learners.waves import RoadTrajectories, Waves, road_trajectories
from unjam.models.comparison import ReplayDriver
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import reconstruct_memory
from unjam.models.fitting import ModelFit
from unjam.models.road_model import (
    RoadSamples,
    base_human_model,
    check_road_model,
    fit_road_model,
    learned_human_model,
    road_samples,
    with_size,
)
from unjam.scenarios.ring import LoopScenario
from unjam.tree import map_leaves
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory as Waits
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam.worlds.episode import add_reward_terms
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask


class RoadRollouts(WholeRoadRollouts[RoadSamples]):
    """The virtual environment of a run as whole closed roads."""

    sample_type = RoadSamples

    def __init__(self, *args: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `ModelRollouts`.

        Raises:
            InputError: whole roads cannot be imagined on the task's road.
        """
        super().__init__(*args)
        check_road_model(self.scenario)

    def _sample_episode(self, episode: Episode, number: int) -> RoadSamples:
        return road_samples(episode, number, cast(LoopScenario, self.scenario))

    def _fit_samples(self, seed: Sequence[int]) -> ModelFit:
        return fit_road_model(self.model, self.samples, self.settings, self.scenario, seed)

    def roll_out(
        self, network: Network, iteration: int, part: int, parts: int, experience_factory: ExperienceFactory
    ) -> Experience | None:
        """Return what the policy `network` does on imagined roads; None where they are not trusted."""
        driver = full_policy(self._task, self._policy, network)
        driven = self.k_star // driver.action_repeat * driver.action_repeat
        if driven == 0:
            return None
        starts, *others = (self._seed(iteration, each, part) for each in (STARTS_SEED, NOISE_SEED, EXPLORATION_SEED))
        cavs = len(self.scenario.possible_cav_ids())  # rows of each road
        choices = self._draw_starts(parts * cavs, starts, driven)
        if len(choices) == 0:
            return None
        memory: Memory = {EXPERT_KEY: self._expert_memory(choices, cavs)}
        if driver.action_repeat > 1:
            nothing = np.zeros(cavs * len(choices))
            memory |= {RESIDUAL_KEY: nothing, RESIDUAL_AGE_KEY: nothing}
        members, draws = others
        people = learned_human_model(self.model, self.scenario, torch_generator(members, "cpu"))
        episodes = self.simulate(driver, memory, choices, driven, people, draws)
        self.model_steps += sum(episode.control_steps for episode in episodes)
        if part == 0:
            earned = np.array([episode.reward.sum() for episode in episodes])
            crashed = [episode.status == "collision" for episode in episodes]
            self._note_returns(earned, choices, driven, float(np.mean(crashed)))
        return experience_factory.from_episodes(episodes)

    def simulate(
        self,
        driver: Driver,
        memory: Memory,
        start_indices: NDArray[np.int64],
        control_steps: int,
        human_model: HumanSpeedModel,
        seed: Sequence[int],
    ) -> list[Episode]:
        """Return what follows recorded moments in so many decisions.

        Args:
            driver: of all CAVs, with its exploration.
            memory: what it remembers there, all rows of the first CAV, then of the second.
            choices: the moments, rows (recording, decision).
            decisions: of each road.
            people: how they drive.
            seed: of all noise, and of what sensors misread.
        """
        road = cast(LoopScenario, self.scenario)
        by_episode = {kept.episode: kept for kept in self.samples}
        kept = [by_episode[self.data.recordings[place].episode] for place, _ in start_indices]
        here = [(each, at // each.interval) for each, (_, at) in zip(kept, start_indices, strict=True)]
        noise = float(self.model.noise) / road.simulation_step / replace(road, noise=1.0).noise_per_step
        noise = noise if self.settings.add_noise else 0.0
        common = replace(road, horizon=control_steps, noise=noise, population="")
        world = RingBatch(
            [with_size(common, each.size) for each in kept],
            [(*seed, number) for number in range(len(kept))],  # of sensors alone: all else is given
            reward=self._task.reward,
            draw=np.random.default_rng(list(seed)).standard_normal,
            human_model=human_model,
            allow_statistical=True,
        )
        waits = [
            each.crossing_memory and Waits(*(values[row] for values in each.crossing_memory)) for each, row in here
        ]
        world.place_vehicles(
            np.stack([each.speeds[row] for each, row in here], 1),
            np.stack([each.positions[row] for each, row in here], 1),
            waits,
        )
        found = finish_drive(start_batch_drive(world, driver, explore=True, memory=memory))
        earned = make_reward(self._task.reward or road.reward)
        return [add_reward_terms(episode, earned) for episode in found.episodes]

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return an actual road that no network learned from, and those imagined from its start on.

        It is one of the record's: nothing is driven anew. CAVs do what they did, and noise is drawn anew.
        """
        moments, recordings = self._holdout_samples, self.data.recordings
        rows = [place for place, each in enumerate(recordings) if each.episode == moments.episode]
        did = ReplayDriver(np.stack([recordings[row].applied_acceleration for row in rows], 1))
        begun = np.array([[rows[0], 0]])
        kinds = {
            "model": learned_human_model(self.model, self.scenario, torch_generator((0,), "cpu")),
            "base": base_human_model(self.settings.base, self.scenario),
        }
        cavs, memory = np.flatnonzero(moments.is_human == 0.0).tolist(), did.initial_memory(len(rows))
        roads = {"recorded": RoadTrajectories(moments.speeds, moments.positions, np.zeros((0, 0)), cavs)}
        for label, people in kinds.items():
            (episode,) = self.simulate(did, memory, begun, len(did.accelerations), people, (1,))
            roads[label] = road_trajectories(episode, moments.interval)
        return Waves(moments.interval * self.scenario.control_step, moments.length, (), roads)

    def _expert_memory(self, start_indices: NDArray[np.int64], cav_count: int) -> Memory:
        """Return what the expert remembered at `choices`: all rows of the first CAV, then of the second."""
        first: dict[int, int] = {}
        for place, recording in enumerate(self.data.recordings):
            first.setdefault(recording.episode, place)
        firsts = np.array([first[self.data.recordings[place].episode] for place, _ in start_indices])
        each = [
            reconstruct_memory(
                self._task.expert, self.data.recordings, np.column_stack([firsts + cav, start_indices[:, 1]])
            )
            for cav in range(cav_count)
        ]
        return map_leaves(lambda *values: np.concatenate(values), each[0], *each[1:])
