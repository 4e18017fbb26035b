"""Model rollouts on closed roads: all vehicles drive on from recorded states."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.residual import EXPERT_KEY, RESIDUAL_AGE_KEY, RESIDUAL_KEY
from unjam.learners.model_rollouts import RolloutPlan, WholeRoadRollouts
from unjam.models.comparison import ReplayDriver, RoadTrajectories, Waves, road_trajectories
from unjam.models.ensemble import Seed, torch_generator
from unjam.models.environment_data import StartIndices, reconstruct_memory
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
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam.worlds.episode import add_reward_terms
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask


class RoadRollouts(WholeRoadRollouts[RoadSamples]):
    """The learned model of whole closed roads."""

    sample_type = RoadSamples

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        check_road_model(self.scenario)

    def _sample_episode(self, episode: Episode, number: int) -> RoadSamples:
        return road_samples(episode, number, cast(LoopScenario, self.scenario))

    def _fit_samples(self, seed: Seed) -> ModelFit:
        return fit_road_model(self.model, self.samples, self.settings, self.scenario, seed)

    def _draw_starts(self, parts: int, seed: Seed, control_steps: int) -> StartIndices:
        cavs_per_road = len(self.scenario.possible_cav_ids())
        return super()._draw_starts(parts * cavs_per_road, seed, control_steps)

    def _simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        memory: Memory = {EXPERT_KEY: self._expert_memory(plan.starts)}
        if plan.driver.action_repeat > 1:
            zeros = np.zeros(len(self.scenario.possible_cav_ids()) * len(plan.starts))
            memory |= {RESIDUAL_KEY: zeros, RESIDUAL_AGE_KEY: zeros}
        human_model = learned_human_model(self.model, self.scenario, torch_generator(plan.noise_seed, "cpu"))
        yield self.simulate(plan.driver, memory, plan.starts, plan.control_steps, human_model, plan.exploration_seed)

    def simulate(
        self,
        driver: Driver,
        memory: Memory,
        start_indices: StartIndices,
        control_steps: int,
        human_model: HumanSpeedModel,
        seed: Seed,
    ) -> list[Episode]:
        """Return the episodes that follow recorded states; `seed` is that of all noise, and of sensor errors.

        `driver` controls all CAVs and explores; its `memory` has all rows of the first CAV, then of the second.
        """
        road = cast(LoopScenario, self.scenario)
        by_episode = {each.episode: each for each in self.samples}
        samples = [by_episode[self.data.recordings[index].episode] for index, _ in start_indices]
        pairs = [(each, at // each.interval) for each, (_, at) in zip(samples, start_indices, strict=True)]
        noise = float(self.model.noise) / road.simulation_step / replace(road, noise=1.0).noise_per_step
        common = replace(road, horizon=control_steps, noise=noise if self.settings.add_noise else 0.0, population="")
        world = RingBatch(
            [with_size(common, each.size) for each in samples],
            [(*seed, number) for number in range(len(samples))],  # of sensors alone: everything else is given
            reward=self._task.reward,
            draw=np.random.default_rng(list(seed)).standard_normal,
            human_model=human_model,
            allow_statistical=True,
        )
        world.place_vehicles(
            np.stack([each.speeds[row] for each, row in pairs], 1),
            np.stack([each.positions[row] for each, row in pairs], 1),
            [
                each.crossing_memory and CrossingMemory(*(values[row] for values in each.crossing_memory))
                for each, row in pairs
            ],
        )
        results = finish_drive(start_batch_drive(world, driver, explore=True, memory=memory))
        reward = make_reward(self._task.reward or road.reward)
        return [add_reward_terms(episode, reward) for episode in results.episodes]

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return a recorded holdout episode, and its CAVs' accelerations replayed in model and base with new noise."""
        samples, recordings = self._holdout_samples, self.data.recordings
        rows = [index for index, each in enumerate(recordings) if each.episode == samples.episode]
        driver = ReplayDriver(np.stack([recordings[row].applied_acceleration for row in rows], 1))
        human_models = {
            "model": learned_human_model(self.model, self.scenario, torch_generator((0,), "cpu")),
            "base": base_human_model(self.settings.base, self.scenario),
        }
        cav_columns = np.flatnonzero(samples.is_human == 0.0).tolist()
        roads = {"recorded": RoadTrajectories(samples.speeds, samples.positions, np.zeros((0, 0)), cav_columns)}
        start, memory = np.array([[rows[0], 0]]), driver.initial_memory(len(rows))
        for label, human_model in human_models.items():
            (episode,) = self.simulate(driver, memory, start, len(driver.accelerations), human_model, (1,))
            roads[label] = road_trajectories(episode, samples.interval)
        return Waves(samples.interval * self.scenario.control_step, samples.length, (), roads)

    def _expert_memory(self, start_indices: StartIndices) -> Memory:
        """Return the expert's memory: all rows of the first CAV, then of the second."""
        cavs = len(self.scenario.possible_cav_ids())  # each episode has as many recordings
        first = start_indices[:, 0] // cavs * cavs
        starts = [np.column_stack([first + cav, start_indices[:, 1]]) for cav in range(cavs)]
        memories = [reconstruct_memory(self._task.expert, self.data.recordings, each) for each in starts]
        return map_leaves(lambda *values: np.concatenate(values), *memories)
