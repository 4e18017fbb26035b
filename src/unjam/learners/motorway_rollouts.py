"""Model rollouts on on-ramps: the vehicles of recorded episodes enter again, with new errors and lane changes."""

from collections.abc import Callable, Iterator, Sequence
from math import nan
from typing import Any, cast

import numpy as np

from unjam.drivers.driver import Driver
from unjam.learners.model_rollouts import RolloutPlan, WholeRoadRollouts
from unjam.models.comparison import Waves, road_trajectories
from unjam.models.ensemble import Seed, torch_generator
from unjam.models.fitting import ModelFit
from unjam.models.motorway_model import (
    MotorwaySamples,
    check_motorway_model,
    fit_motorway_model,
    learned_correction,
    motorway_samples,
)
from unjam.models.road_model import RoadModel
from unjam.scenarios.on_ramp import OnRamp
from unjam.worlds.batch.on_ramp.traffic import LearnedCorrection
from unjam.worlds.batch.on_ramp.world import MotorwayBatch, ReplayOptions
from unjam.worlds.batch.run import MAX_BATCH_MOTORWAYS
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import add_reward_terms
from unjam.worlds.record import Episode, Floats
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

WAVE_INTERVAL = 10.0
"""time between the states of `Waves` [s]"""


class MotorwayRollouts(WholeRoadRollouts[MotorwaySamples]):
    """The learned model of an on-ramp."""

    sample_type = MotorwaySamples

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        check_motorway_model(cast(OnRamp, self.scenario), self.settings)

    def _sample_episode(self, episode: Episode, number: int) -> MotorwaySamples:
        return motorway_samples(episode, number, cast(OnRamp, self.scenario), self.model.base)

    def _fit_samples(self, seed: Seed) -> ModelFit:
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
        for first in range(0, len(plan.starts), MAX_BATCH_MOTORWAYS):
            samples = plan.starts[first : first + MAX_BATCH_MOTORWAYS]
            numbers = range(first, first + len(samples))
            groups = [number // len(signs) for number in numbers]
            seeds = [((*plan.noise_seed, group), (*plan.exploration_seed, group)) for group in groups]
            scales = [signs[number % len(signs)] for number in numbers]
            yield self.simulate(plan.driver, samples, plan.control_steps, seeds, scales)

    def _compare_returns(self, plan: RolloutPlan, returns: Floats) -> tuple[float | None, float | None]:
        is_new = [samples.episode >= self._first_new_episode for samples in plan.starts]
        if plan.control_steps < self.scenario.horizon or not any(is_new):
            return None, None
        recorded = np.array([samples.episode_return for samples in plan.starts])
        return float(returns[is_new].mean()), float(recorded[is_new].mean())

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return a holdout episode, run again, and what model and base make of its vehicles; the expert drives CAVs."""
        road, expert, seed = cast(OnRamp, self.scenario), self._task.expert, self._holdout_samples.seed
        recorded = run_episode(EpisodeTask(road, expert, seed))
        interval = max(1, round(WAVE_INTERVAL / road.control_step))
        roads = {"recorded": road_trajectories(recorded, interval)}
        corrections = {
            label: self._correction(model, (0,))
            for label, model in (("model", self.model), ("base", self._new_model()))
        }
        for label, correction in corrections.items():
            replay = ReplayOptions([((1,), (2,))], road.horizon, self.settings.add_noise, correction)
            world = MotorwayBatch(road, [seed], replay=replay)
            world.measured_fields = expert.measured_fields
            (episode,) = finish_drive(DriveLoop(world, expert))
            roads[label] = road_trajectories(episode, interval)
        return Waves(interval * road.control_step, nan, recorded.lane_names, roads)

    def simulate(
        self,
        driver: Driver,
        samples: Sequence[MotorwaySamples],
        control_steps: int,
        seeds: Sequence[tuple[Seed, Seed]],
        exploration_scales: Sequence[float],
    ) -> list[Episode]:
        """Return recorded episodes with the same vehicles, and seeds of human drivers' errors and of exploration."""
        road = cast(OnRamp, self.scenario)
        correction = self._correction(self.model, seeds[0][0])
        replay = ReplayOptions(seeds, control_steps, self.settings.add_noise, correction)
        world = MotorwayBatch(road, [each.seed for each in samples], explore=exploration_scales, replay=replay)
        world.measured_fields = driver.measured_fields
        reward = make_reward(self._task.reward or road.reward)
        return [add_reward_terms(episode, reward) for episode in finish_drive(DriveLoop(world, driver, 1.0))]

    def _correction(self, model: RoadModel, seed: Sequence[int]) -> LearnedCorrection | None:
        generator, steps = torch_generator(seed, "cpu"), self.scenario.steps_per_control_step
        return learned_correction(model, generator, steps, self.settings.add_noise)
