"""World models of whole roads: closed roads from recorded states, motorways from the start of an episode."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import nan
from typing import Any, ClassVar, TypeVar, cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.residual import EXPERT_KEY
from unjam.errors import InputError
from unjam.models import road_model
from unjam.models.comparison import ReplayDriver
from unjam.models.ensemble import ModelFit, Seed, torch_generator
from unjam.models.environment_data import StartIndices, is_holdout_episode, reconstruct_memory
from unjam.models.motorway_model import MotorwaySamples, fit_motorway_model, learned_correction, motorway_samples
from unjam.models.settings import ModelSettings
from unjam.models.world_model import RolloutPlan, Rollouts, WorldModel
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.scenario import Scenario
from unjam.tree import map_leaves
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.motorway.traffic import LearnedCorrection
from unjam.worlds.batch.motorway.world import MotorwayBatch, ReplayOptions
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.batch.support import required_batch_kind, statistically_unsupported_reason
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import add_reward_terms
from unjam.worlds.record import Episode, Floats
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

WAVE_INTERVAL = 10.0
"""time between the stored states of a motorway [s]"""
WaveRecord = dict[str, Any]
"""positions and speeds of vehicles over time, for `model.json`"""
SamplesT = TypeVar("SamplesT", road_model.RoadSamples, MotorwaySamples)


class WholeRoadModel(WorldModel[road_model.RoadEnsemble, SamplesT]):
    """A world model of whole roads, fitted to samples of all vehicles in the episodes of D_a."""

    @classmethod
    def check(cls, scenario: Scenario, settings: ModelSettings) -> None:
        """Raise `InputError` if the batch simulator does not support the scenario."""
        reason = statistically_unsupported_reason(scenario)
        if not scenario.road_model:
            reason = reason or f"{scenario.title}, which has no road model"
        if scenario.is_closed and scenario.steps_per_control_step > 1:
            reason = f"{scenario.title}: steps_per_control_step is {scenario.steps_per_control_step}"
        if reason:
            raise InputError(f"model.kind: road is not allowed; allowed: row, for {reason}")

    def new_ensemble(self) -> road_model.RoadEnsemble:
        """Return an unfitted ensemble, with which the model is the base."""
        return road_model.RoadEnsemble(self.settings, self.seed)

    def simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        """Yield the episodes of a plan, without rewards, batch by batch."""
        raise NotImplementedError

    def compare_waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> WaveRecord:
        """Return a holdout episode as recorded, in the model, and in the base of the model."""
        raise NotImplementedError

    def roll_out(self, plan: RolloutPlan) -> Iterator[Rollouts]:
        """Yield the rollouts of a plan, batch by batch."""
        reward = make_reward(self.task.reward or self.scenario.reward)
        for batch in self.simulate_batches(plan):
            episodes = [add_reward_terms(episode, reward) for episode in batch]
            returns = np.array([float(episode.reward.sum()) for episode in episodes])
            crashed = [episode.status == "collision" for episode in episodes]
            yield Rollouts(sum(episode.control_steps for episode in episodes), returns, crashed, episodes=episodes)

    @property
    def holdout_samples(self) -> SamplesT:
        """The samples of the newest holdout episode, or of the newest episode if there is no holdout episode."""
        holdout, group_size = self.settings.holdout, len(self.exploration_signs)
        held_out = [sample for sample in self.samples if is_holdout_episode(sample.episode // group_size, holdout)]
        return (held_out or self.samples)[-1]


class ClosedRoadModel(WholeRoadModel[road_model.RoadSamples]):
    """The world model of closed roads."""

    samples_type: ClassVar = road_model.RoadSamples

    @property
    def cavs_per_start(self) -> int:
        """Number of CAVs of a rollout: all CAVs of the road."""
        return len(self.scenario.possible_cav_ids())

    def sample_episode(self, episode: Episode, index: int) -> road_model.RoadSamples:
        """Return the samples of the environment episode `index`."""
        return road_model.road_samples(episode, index, cast(LoopScenario, self.scenario))

    def fit(self, seed: Seed) -> ModelFit:
        """Continue to fit the ensemble to all samples."""
        return road_model.fit_road_model(self.ensemble, self.samples, self.settings, self.scenario, seed)

    def simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        """Yield all episodes of a plan, the starts of which are `StartIndices`, in one batch."""
        rows = self.cavs_per_start * len(plan.starts)
        memory = plan.driver.initial_memory(rows) | {EXPERT_KEY: self._expert_memory(plan.starts)}
        generator = torch_generator(plan.noise_seed, "cpu")
        human_model = road_model.learned_human_model(self.ensemble, self.scenario, generator)
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
        """Return episodes that start from recorded states; `memory` has all rows of the first CAV, then the next."""
        road = cast(LoopScenario, self.scenario)
        samples_by_episode = {sample.episode: sample for sample in self.samples}
        samples = [samples_by_episode[self.data.recordings[index].episode] for index, _ in start_indices]
        pairs = [(sample, step // sample.interval) for sample, (_, step) in zip(samples, start_indices, strict=True)]
        memories = [(sample.crossing_memory, row) for sample, row in pairs]
        noise = float(self.ensemble.noise) / road.simulation_step / replace(road, noise=1.0).noise_per_step
        start_road = replace(
            road, horizon=control_steps, noise=noise if self.settings.add_noise else 0.0, population=""
        )
        world = RingBatch(
            [road_model.with_size(start_road, sample.size) for sample in samples],
            [(*seed, index) for index in range(len(samples))],  # seeds of the sensors only
            draw=np.random.default_rng(list(seed)).standard_normal,
            human_model=human_model,
        )
        world.place_vehicles(
            np.stack([sample.speeds[row] for sample, row in pairs], 1),
            np.stack([sample.positions[row] for sample, row in pairs], 1),
            [memory and CrossingMemory(*(values[row] for values in memory)) for memory, row in memories],
        )
        if road.steps_per_control_step == 1 and not road.actuator.is_instant:
            world.set_actuators(self.data.actuator_states_at(np.concatenate(self._starts_by_cav(start_indices))))
        return finish_drive(start_batch_drive(world, driver, explore=True, memory=memory))

    def compare_waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> WaveRecord:
        """Return a recorded holdout episode, and replays of its accelerations in model and base with new noise."""
        samples, recordings = self.holdout_samples, self.data.recordings
        rows = [index for index, recording in enumerate(recordings) if recording.episode == samples.episode]
        driver = ReplayDriver(np.stack([recordings[row].applied_acceleration for row in rows], 1))
        human_models = {
            "model": road_model.learned_human_model(self.ensemble, self.scenario, torch_generator((0,), "cpu")),
            "base": road_model.base_human_model(self.settings.base, self.scenario),
        }
        lanes, cav_columns = np.zeros((0, 0)), np.flatnonzero(samples.is_human == 0.0).tolist()
        roads = {"recorded": _road_record(samples.speeds, samples.positions, lanes, cav_columns)}
        start, memory = np.array([[rows[0], 0]]), driver.initial_memory(len(rows))
        for label, human_model in human_models.items():
            (episode,) = self.simulate(driver, memory, start, len(driver.accelerations), human_model, (1,))
            roads[label] = _episode_record(episode, samples.interval)
        return _wave_record(samples.interval * self.scenario.control_step, samples.length, (), roads)

    def _expert_memory(self, start_indices: StartIndices) -> Memory:
        """Return the expert's memory: the rows of the first CAV, then of the second, and so on."""
        starts = self._starts_by_cav(start_indices)
        memories = [reconstruct_memory(self.task.expert, self.data.recordings, start) for start in starts]
        return map_leaves(lambda *values: np.concatenate(values), *memories)

    def _starts_by_cav(self, start_indices: StartIndices) -> list[StartIndices]:
        """Return the start indices of the first CAV of all episodes, of the second CAV, and so on."""
        cavs = self.cavs_per_start  # number of recordings of each episode
        first_recordings = start_indices[:, 0] // cavs * cavs
        return [np.column_stack([first_recordings + cav, start_indices[:, 1]]) for cav in range(cavs)]


class MotorwayModel(WholeRoadModel[MotorwaySamples]):
    """The world model of motorways."""

    samples_type: ClassVar = MotorwaySamples

    @classmethod
    def check(cls, scenario: Scenario, settings: ModelSettings) -> None:
        """Raise `InputError` if the scenario or a setting is not supported."""
        super().check(scenario, settings)
        base, starts = settings.base, settings.rollout_starts
        for setting, is_allowed, allowed in (
            (f"rollout_starts: {starts}", starts == "first", "first"),
            (f"base: {base}", base in ("idm", "none"), "idm, each vehicle's own driver model, or none"),
            ("calibrate_base: true", not settings.calibrate_base, "false"),
            (f"humans: {settings.humans}", not settings.humans, "none"),
        ):
            if not is_allowed:
                raise InputError(f"model.{setting} is not allowed; allowed: {allowed}, on on-ramps")

    @property
    def max_control_steps(self) -> int:
        """Maximum number of control steps of a rollout: those of an episode."""
        return self.scenario.horizon

    def sample_episode(self, episode: Episode, index: int) -> MotorwaySamples:
        """Return the samples of the environment episode `index`."""
        return motorway_samples(episode, index, cast(Motorway, self.scenario), self.ensemble.base)

    def fit(self, seed: Seed) -> ModelFit:
        """Continue to fit the ensemble to all samples."""
        return fit_motorway_model(self.ensemble, self.samples, self.settings, seed, len(self.exploration_signs))

    def draw_starts(self, control_steps: int, part_count: int, seed: Seed) -> list[MotorwaySamples]:
        """Return random samples, repeated for each sign of the exploration."""
        new_episodes, signs = self.data.episode_count - self.first_new_episode, self.exploration_signs
        episodes = self.settings.model_ratio * new_episodes * self.scenario.horizon / control_steps
        count = max(1, round(episodes / part_count / len(signs)))
        indices = np.random.default_rng(list(seed)).integers(len(self.samples), size=count).tolist()
        return [self.samples[index] for index in indices for _ in signs]

    def simulate_batches(self, plan: RolloutPlan) -> Iterator[list[Episode]]:
        """Yield the episodes of a plan, the starts of which are samples, batch by batch."""
        signs = self.exploration_signs
        size = required_batch_kind(self.scenario).max_roads
        for first in range(0, len(plan.starts), size):
            samples = plan.starts[first : first + size]
            indices = range(first, first + len(samples))
            groups = [index // len(signs) for index in indices]
            seeds = [((*plan.noise_seed, group), (*plan.exploration_seed, group)) for group in groups]
            scales = [signs[index % len(signs)] for index in indices]
            correction = self._correction(self.ensemble, seeds[0][0])
            yield self.simulate(plan.driver, samples, plan.control_steps, correction, seeds, scales)

    def recorded_returns(self, plan: RolloutPlan) -> Floats:
        """Return the returns of the recorded episodes; NaN for older episodes, and if rollouts are shorter."""
        is_complete = plan.control_steps == self.scenario.horizon
        is_known = [is_complete and samples.episode >= self.first_new_episode for samples in plan.starts]
        return np.where(is_known, [samples.episode_return for samples in plan.starts], nan)

    def compare_waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> WaveRecord:
        """Return a holdout episode, run again with the expert, and episodes of its vehicles in model and base."""
        road, expert, samples = self.scenario, self.task.expert, self.holdout_samples
        recorded = run_episode(EpisodeTask(road, expert, samples.seed))
        interval = max(1, round(WAVE_INTERVAL / road.control_step))
        roads = {"recorded": _episode_record(recorded, interval)}
        for label, model in (("model", self.ensemble), ("base", self.new_ensemble())):
            correction = self._correction(model, (0,))
            (episode,) = self.simulate(expert, [samples], road.horizon, correction, [((1,), (2,))])
            roads[label] = _episode_record(episode, interval)
        return _wave_record(interval * road.control_step, nan, recorded.lane_names, roads)

    def simulate(
        self,
        driver: Driver,
        samples: Sequence[MotorwaySamples],
        control_steps: int,
        correction: LearnedCorrection | None,
        seeds: Sequence[tuple[Seed, Seed]],
        exploration_scales: Sequence[float] | None = None,
    ) -> list[Episode]:
        """Return episodes with recorded vehicles; `seeds` are those of human drivers' errors and of exploration."""
        replay = ReplayOptions(seeds, control_steps, self.settings.add_noise, correction)
        road, vehicle_seeds = cast(Motorway, self.scenario), [sample.seed for sample in samples]
        world = MotorwayBatch(road, vehicle_seeds, explore=exploration_scales, replay=replay)
        world.measured_fields = driver.requirements().measured_fields
        return finish_drive(DriveLoop(world, driver, 0.0 if exploration_scales is None else 1.0))

    def _correction(self, model: road_model.RoadEnsemble, seed: Sequence[int]) -> LearnedCorrection | None:
        generator, steps = torch_generator(seed, "cpu"), self.scenario.steps_per_control_step
        return learned_correction(model, generator, steps, self.settings.add_noise)


def _wave_record(control_step: float, loop_length: float, lane_names: Sequence[str], roads: WaveRecord) -> WaveRecord:
    return {"control_step": control_step, "loop_length": loop_length, "lane_names": lane_names, "waves": roads}


def _episode_record(episode: Episode, interval: int) -> WaveRecord:
    speeds, positions, lanes = (
        values[::interval] for values in (episode.speeds, episode.positions, episode.lane_indices)
    )
    return _road_record(speeds, positions, lanes, episode.cav_columns)


def _road_record(speeds: Floats, positions: Floats, lanes: Floats, cav_columns: list[int]) -> WaveRecord:
    """Return tables of shape (M, N) of the vehicles at M times in N columns, SI units; NaN without a vehicle."""
    return {"speeds": speeds, "positions": positions, "lanes": lanes, "cav_columns": cav_columns}
