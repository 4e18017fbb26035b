"""Imagining on-ramps: the same people come once more, and misjudge and change lanes anew."""

from collections.abc import Callable, Sequence
from math import nan
from typing import Any, cast

import numpy as np

from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.learners.experience import Experience, join_experience
from unjam.learners.model_rollouts import (
    EXPLORATION_SEED,
    NOISE_SEED,
    STARTS_SEED,
    ExperienceFactory,
    WholeRoadRollouts,
    full_policy,
)
from unjam.learners.waves import Waves, road_trajectories
from unjam.models.ensemble import torch_generator
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
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

WAVE_INTERVAL = 10.0
"""from one moment of a road that is shown to the next [s]"""


class MotorwayRollouts(WholeRoadRollouts[MotorwaySamples]):
    """The virtual environment of a run on an on-ramp."""

    sample_type = MotorwaySamples

    def __init__(self, *args: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `ModelRollouts`.

        Raises:
            InputError: an on-ramp cannot be imagined with these settings.
        """
        super().__init__(*args)
        check_motorway_model(cast(OnRamp, self.scenario), self.settings)

    def _sample_episode(self, episode: Episode, number: int) -> MotorwaySamples:
        return motorway_samples(episode, number, cast(OnRamp, self.scenario), self.model.base)

    def _fit_samples(self, seed: Sequence[int]) -> ModelFit:
        return fit_motorway_model(self.model, self.samples, self.settings, seed, self._episodes_per_group)

    def roll_out(
        self, network: Network, iteration: int, part: int, parts: int, experience_factory: ExperienceFactory
    ) -> Experience | None:
        """Return what the policy `network` does where the people of actual episodes come once more.

        In all `parts` of an iteration together there are `model_ratio` times as many decisions as in the
        newest actual episodes; None where they are not trusted, or no CAV comes.
        """
        driver = full_policy(self._task, self._policy, network)
        decisions = min(self.k_star, self.scenario.horizon) // driver.action_repeat * driver.action_repeat
        if decisions == 0:
            return None
        starts, noise, exploration = (
            self._seed(iteration, each, part) for each in (STARTS_SEED, NOISE_SEED, EXPLORATION_SEED)
        )
        signs = self._policy.exploration_signs
        episodes = self.settings.model_ratio * self._new_episodes * self.scenario.horizon / decisions
        count = max(1, round(episodes / parts / len(signs)))
        chosen = np.random.default_rng(list(starts)).integers(len(self.samples), size=count).tolist()
        kept = [self.samples[each] for each in chosen for _ in signs]
        earned, crashed, found = list[float](), list[bool](), list[Experience]()
        for begin in range(0, len(kept), MAX_BATCH_MOTORWAYS):  # whole episodes take 40 MB each
            some = kept[begin : begin + MAX_BATCH_MOTORWAYS]
            numbers = [number // len(signs) for number in range(begin, begin + len(some))]
            seeds = [((*noise, number), (*exploration, number)) for number in numbers]
            explore = [signs[number % len(signs)] for number in range(begin, begin + len(some))]
            episodes = self.simulate(driver, some, decisions, seeds, explore)
            self.model_steps += sum(episode.control_steps for episode in episodes)
            earned += [float(episode.reward.sum()) for episode in episodes]
            crashed += [episode.status == "collision" for episode in episodes]
            if any(episode.trajectories for episode in episodes):
                found.append(experience_factory.from_episodes(episodes))
        if part == 0:
            self._note_sample_returns(kept, earned, decisions)
            self.facts["crash_share"] = float(np.mean(crashed))
        return join_experience(found) if found else None

    def waves(self, run_episode: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return an actual road that no network learned from, and those where its people come once more.

        On all of them the expert alone drives CAVs.
        """
        road, expert, seed = cast(OnRamp, self.scenario), self._task.expert, self._holdout_samples.seed
        learned, base = (self._learned_correction(model, (0,)) for model in (self.model, self._new_model()))
        again = ReplayOptions([((1,), (2,))], road.horizon, self.settings.add_noise, learned)
        actual, every = run_episode(EpisodeTask(road, expert, seed)), max(1, round(WAVE_INTERVAL / road.control_step))
        roads = {"recorded": road_trajectories(actual, every)}
        for label, otherwise in {"model": again, "base": again._replace(learned=base)}.items():
            world = MotorwayBatch(road, [seed], replay=otherwise)
            world.measured_fields = expert.measured_fields
            (episode,) = finish_drive(DriveLoop(world, expert))
            roads[label] = road_trajectories(episode, every)
        return Waves(every * road.control_step, nan, actual.lane_names, roads)

    def simulate(
        self,
        driver: Driver,
        samples: Sequence[MotorwaySamples],
        control_steps: int,
        seeds: Sequence[tuple[Sequence[int], Sequence[int]]],
        exploration_scales: Sequence[float],
    ) -> list[Episode]:
        """Return what happens in so many decisions where the people of actual episodes come once more.

        Args:
            driver: of all CAVs, with its exploration.
            kept: of whom.
            decisions: of each road.
            seeds: of what people misjudge, and of exploration, for each road.
            explore: by how much exploration counts on each.
        """
        road = cast(OnRamp, self.scenario)
        noise, *_ = seeds[0]
        again = ReplayOptions(
            seeds, control_steps, self.settings.add_noise, self._learned_correction(self.model, noise)
        )
        world = MotorwayBatch(road, [each.seed for each in samples], explore=exploration_scales, replay=again)
        world.measured_fields = driver.measured_fields
        found = finish_drive(DriveLoop(world, driver, 1.0))
        earned = make_reward(self._task.reward or road.reward)
        return [add_reward_terms(episode, earned) for episode in found]

    def _learned_correction(self, model: RoadModel, seed: Sequence[int]) -> LearnedCorrection | None:
        """Return what people do beside what the batch has them do, as a model has it."""
        generator, steps = torch_generator(seed, "cpu"), self.scenario.steps_per_control_step
        return learned_correction(model, generator, steps, self.settings.add_noise)

    @property
    def _new_episodes(self) -> int:
        """How many episodes the newest policy drove, whether all of them are kept or not."""
        return self.data.episode_count - self._first_new_episode

    def _note_sample_returns(
        self, samples: Sequence[MotorwaySamples], returns: Sequence[float], control_steps: int
    ) -> None:
        """Note what the policy that drove the newest actual episodes earned here and there."""
        newest = zip(returns, samples, strict=True)
        both = [(value, each.episode_return) for value, each in newest if each.episode >= self._first_new_episode]
        whole = control_steps >= self.scenario.horizon and both
        virtual, actual = np.mean(both, 0).tolist() if whole else (None, None)
        self.facts |= {"return_model": virtual, "return_environment": actual}
