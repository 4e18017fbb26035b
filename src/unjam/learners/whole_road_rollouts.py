"""Model rollouts on whole roads: closed roads continue from recorded states, on-ramps are replayed from the start."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import nan
from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.residual import EXPERT_KEY
from unjam.learners.experience import Experience, join_experience
from unjam.learners.model_rollouts import FIT_SEED, ExperienceFactory, ModelRollouts, RolloutPlan, RolloutResult
from unjam.models.comparison import ReplayDriver
from unjam.models.ensemble import ModelFit, Seed, torch_generator
from unjam.models.environment_data import EnvironmentData, StartIndices, is_holdout_episode, reconstruct_memory
from unjam.models.motorway_model import MotorwaySamples, fit_motorway_model, learned_correction, motorway_samples
from unjam.models.road_model import (
    RoadModel,
    RoadSamples,
    base_human_model,
    check_road_model,
    fit_road_model,
    learned_human_model,
    road_samples,
    with_size,
)
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.ring import LoopScenario
from unjam.tree import map_leaves
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.motorway.traffic import LearnedCorrection
from unjam.worlds.batch.motorway.world import MotorwayBatch, ReplayOptions
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.batch.support import BATCH_KINDS
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import add_reward_terms
from unjam.worlds.record import Episode, Floats
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

WAVE_INTERVAL = 10.0
"""time between the stored states of waves on an on-ramp [s]"""
Facts = dict[str, Any]
SamplesT = TypeVar("SamplesT", RoadSamples, MotorwaySamples)


class WholeRoadRollouts(ModelRollouts[RoadModel], Generic[SamplesT]):
    """The learned model of whole roads, which is fitted to samples of all vehicles in the episodes of D_a."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        check_road_model(self.scenario, self.settings)
        self.samples: list[SamplesT] = []
        """samples of the episodes in D_a, the oldest first"""

    def _new_model(self) -> RoadModel:
        return RoadModel(self.settings, self._seed(FIT_SEED))

    def _sample_episode(self, episode: Episode, number: int) -> SamplesT:
        raise NotImplementedError

    def _simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        raise NotImplementedError

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Facts:
        """Return a holdout episode as recorded, in the model, and in its base alone, as facts for `model.json`.

        `run_episode` runs an episode where environment episodes run.
        """
        raise NotImplementedError

    def _run(self, plan: RolloutPlan, experience_factory: ExperienceFactory) -> RolloutResult:
        steps, returns, crashed, parts = 0, list[float](), list[bool](), list[Experience]()
        reward = make_reward(self._task.reward or self.scenario.reward)
        for batch in self._simulate_batches(plan):
            episodes = [add_reward_terms(episode, reward) for episode in batch]
            steps += sum(episode.control_steps for episode in episodes)
            returns += [float(episode.reward.sum()) for episode in episodes]
            crashed += [episode.status == "collision" for episode in episodes]
            if any(episode.trajectories for episode in episodes):
                parts.append(experience_factory.from_episodes(episodes))
        experience = join_experience(parts) if parts else None
        return RolloutResult(experience, steps, np.array(returns), {"crash_share": float(np.mean(crashed))})

    @property
    def _holdout_samples(self) -> SamplesT:
        """The newest holdout episode, or the newest one if there is none."""
        holdout, group_size = self.settings.holdout, len(self._policy.exploration_signs)
        held_out = [each for each in self.samples if is_holdout_episode(each.episode // group_size, holdout)]
        return (held_out or self.samples)[-1]

    def _store_episodes(self, episodes: Sequence[Episode]) -> None:
        first = self.data.episode_count
        new = [self._sample_episode(episode, first + index) for index, episode in enumerate(episodes)]
        super()._store_episodes(episodes)
        oldest = self.data.recordings[0].episode
        self.samples = [each for each in (*self.samples, *new) if each.episode >= oldest]


class RoadRollouts(WholeRoadRollouts[RoadSamples]):
    """The learned model of whole closed roads."""

    stored_types: ClassVar = {"data": EnvironmentData, "samples": list[RoadSamples]}

    def _sample_episode(self, episode: Episode, number: int) -> RoadSamples:
        return road_samples(episode, number, cast(LoopScenario, self.scenario))

    def _fit_model(self, seed: Seed) -> ModelFit:
        return fit_road_model(self.model, self.samples, self.settings, self.scenario, seed)

    def _draw_starts(self, parts: int, seed: Seed, control_steps: int) -> StartIndices:
        cavs_per_road = len(self.scenario.possible_cav_ids())
        return super()._draw_starts(parts * cavs_per_road, seed, control_steps)

    def _simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        rows = len(self.scenario.possible_cav_ids()) * len(plan.starts)
        memory = plan.driver.initial_memory(rows) | {EXPERT_KEY: self._expert_memory(plan.starts)}
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
            draw=np.random.default_rng(list(seed)).standard_normal,
            human_model=human_model,
        )
        world.place_vehicles(
            np.stack([each.speeds[row] for each, row in pairs], 1),
            np.stack([each.positions[row] for each, row in pairs], 1),
            [
                each.crossing_memory and CrossingMemory(*(values[row] for values in each.crossing_memory))
                for each, row in pairs
            ],
        )
        return finish_drive(start_batch_drive(world, driver, explore=True, memory=memory))

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Facts:
        """Return a recorded holdout episode, and its CAVs' accelerations replayed in model and base with new noise."""
        samples, recordings = self._holdout_samples, self.data.recordings
        rows = [index for index, each in enumerate(recordings) if each.episode == samples.episode]
        driver = ReplayDriver(np.stack([recordings[row].applied_acceleration for row in rows], 1))
        human_models = {
            "model": learned_human_model(self.model, self.scenario, torch_generator((0,), "cpu")),
            "base": base_human_model(self.settings.base, self.scenario),
        }
        lanes, cav_columns = np.zeros((0, 0)), np.flatnonzero(samples.is_human == 0.0).tolist()
        roads = {"recorded": _road_facts(samples.speeds, samples.positions, lanes, cav_columns)}
        start, memory = np.array([[rows[0], 0]]), driver.initial_memory(len(rows))
        for label, human_model in human_models.items():
            (episode,) = self.simulate(driver, memory, start, len(driver.accelerations), human_model, (1,))
            roads[label] = _episode_facts(episode, samples.interval)
        return _wave_facts(samples.interval * self.scenario.control_step, samples.length, (), roads)

    def _expert_memory(self, start_indices: StartIndices) -> Memory:
        """Return the expert's memory: all rows of the first CAV, then of the second."""
        cavs = len(self.scenario.possible_cav_ids())  # each episode has as many recordings
        first = start_indices[:, 0] // cavs * cavs
        starts = [np.column_stack([first + cav, start_indices[:, 1]]) for cav in range(cavs)]
        memories = [reconstruct_memory(self._task.expert, self.data.recordings, each) for each in starts]
        return map_leaves(lambda *values: np.concatenate(values), *memories)


class MotorwayRollouts(WholeRoadRollouts[MotorwaySamples]):
    """The learned model of an on-ramp."""

    stored_types: ClassVar = {"data": EnvironmentData, "samples": list[MotorwaySamples]}

    def _sample_episode(self, episode: Episode, number: int) -> MotorwaySamples:
        return motorway_samples(episode, number, cast(Motorway, self.scenario), self.model.base)

    def _fit_model(self, seed: Seed) -> ModelFit:
        group_size = len(self._policy.exploration_signs)
        return fit_motorway_model(self.model, self.samples, self.settings, seed, group_size)

    @property
    def _max_control_steps(self) -> int:
        return min(self.k_star, self.scenario.horizon)

    def _draw_starts(self, parts: int, seed: Seed, control_steps: int) -> list[MotorwaySamples]:
        """Return random samples, each of them once for each sign of the exploration."""
        new_episodes, signs = self.data.episode_count - self._first_new_episode, self._policy.exploration_signs
        episodes = self.settings.model_ratio * new_episodes * self.scenario.horizon / control_steps
        count = max(1, round(episodes / parts / len(signs)))
        indices = np.random.default_rng(list(seed)).integers(len(self.samples), size=count).tolist()
        return [self.samples[index] for index in indices for _ in signs]

    def _simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        signs = self._policy.exploration_signs
        size = BATCH_KINDS[type(self.scenario)].max_roads
        for first in range(0, len(plan.starts), size):
            samples = plan.starts[first : first + size]
            numbers = range(first, first + len(samples))
            groups = [number // len(signs) for number in numbers]
            seeds = [((*plan.noise_seed, group), (*plan.exploration_seed, group)) for group in groups]
            scales = [signs[number % len(signs)] for number in numbers]
            correction = self._correction(self.model, seeds[0][0])
            yield self.simulate(plan.driver, samples, plan.control_steps, correction, seeds, scales)

    def _compare_returns(self, plan: RolloutPlan, returns: Floats) -> tuple[float | None, float | None]:
        is_new = [samples.episode >= self._first_new_episode for samples in plan.starts]
        if plan.control_steps < self.scenario.horizon or not any(is_new):
            return None, None
        recorded = np.array([samples.episode_return for samples in plan.starts])
        return float(returns[is_new].mean()), float(recorded[is_new].mean())

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Facts:
        """Return a holdout episode, run again, and what model and base make of its vehicles; the expert drives CAVs."""
        road, expert, samples = self.scenario, self._task.expert, self._holdout_samples
        recorded = run_episode(EpisodeTask(road, expert, samples.seed))
        interval = max(1, round(WAVE_INTERVAL / road.control_step))
        roads = {"recorded": _episode_facts(recorded, interval)}
        for label, model in (("model", self.model), ("base", self._new_model())):
            correction = self._correction(model, (0,))
            (episode,) = self.simulate(expert, [samples], road.horizon, correction, [((1,), (2,))])
            roads[label] = _episode_facts(episode, interval)
        return _wave_facts(interval * road.control_step, nan, recorded.lane_names, roads)

    def simulate(
        self,
        driver: Driver,
        samples: Sequence[MotorwaySamples],
        control_steps: int,
        correction: LearnedCorrection | None,
        seeds: Sequence[tuple[Seed, Seed]],
        exploration_scales: Sequence[float] | None = None,
    ) -> list[Episode]:
        """Return recorded episodes with the same vehicles, and seeds of human drivers' errors and of exploration."""
        replay = ReplayOptions(seeds, control_steps, self.settings.add_noise, correction)
        road, vehicle_seeds = cast(Motorway, self.scenario), [each.seed for each in samples]
        world = MotorwayBatch(road, vehicle_seeds, explore=exploration_scales, replay=replay)
        world.measured_fields = driver.measured_fields
        return finish_drive(DriveLoop(world, driver, 0.0 if exploration_scales is None else 1.0))

    def _correction(self, model: RoadModel, seed: Sequence[int]) -> LearnedCorrection | None:
        generator, steps = torch_generator(seed, "cpu"), self.scenario.steps_per_control_step
        return learned_correction(model, generator, steps, self.settings.add_noise)


def _wave_facts(control_step: float, loop_length: float, lane_names: Sequence[str], roads: Facts) -> Facts:
    return {"control_step": control_step, "loop_length": loop_length, "lane_names": lane_names, "waves": roads}


def _episode_facts(episode: Episode, interval: int) -> Facts:
    speeds, positions, lanes = (each[::interval] for each in (episode.speeds, episode.positions, episode.lane_indices))
    return _road_facts(speeds, positions, lanes, episode.cav_columns)


def _road_facts(speeds: Floats, positions: Floats, lanes: Floats, cav_columns: list[int]) -> Facts:
    """Return all vehicles on a road at M times, in N columns: tables (M, N), SI units, NaN without a vehicle."""
    return {"speeds": speeds, "positions": positions, "lanes": lanes, "cav_columns": cav_columns}
