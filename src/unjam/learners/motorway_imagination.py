"""Imagining on-ramps: the same people come once more, and misjudge and change lanes anew."""

from collections.abc import Callable, Sequence
from math import nan
from typing import Any, cast

import numpy as np

from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.learners.experience import Experience, join
from unjam.learners.imagination import (
    EXPLORATION,
    NOISE,
    STARTS,
    AsExperience,
    WholeRoads,
    full_policy,
)
from unjam.learners.waves import Waves, everybody
from unjam.scenarios.on_ramp import OnRamp
from unjam.virtual.ensemble import torch_generator
from unjam.virtual.fitting import Fit
from unjam.virtual.motorways import (
    MotorwayMoments,
    beside_known,
    check_motorways,
    fit_motorways,
    moments_of_motorway,
)
from unjam.virtual.roads import RoadModel
from unjam.worlds.batch.motorway import Learned
from unjam.worlds.batch.motorway_world import Again, MotorwayBatch
from unjam.worlds.batch.run import MOST_MOTORWAYS
from unjam.worlds.drive import Drive, driven_to_the_end
from unjam.worlds.episode import rewarded
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.workers import EpisodeTask

MOMENT = 10.0
"""from one moment of a road that is shown to the next [s]"""


class MotorwayImagination(WholeRoads[MotorwayMoments]):
    """The virtual environment of a run on an on-ramp."""

    kind = MotorwayMoments

    def __init__(self, *arguments: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `Imagination`.

        Raises:
            InputError: an on-ramp cannot be imagined with these settings.
        """
        super().__init__(*arguments)
        check_motorways(cast(OnRamp, self.scenario), self.settings)

    def _kept_of(self, episode: Episode, number: int) -> MotorwayMoments:
        return moments_of_motorway(episode, number, cast(OnRamp, self.scenario), self.model.base)

    def _fit_moments(self, seed: Sequence[int]) -> Fit:
        return fit_motorways(self.model, self.moments, self.settings, seed, self._twins)

    def imagine(
        self, network: Network, iteration: int, part: int, parts: int, how: AsExperience
    ) -> Experience | None:
        """Return what the policy `network` does where the people of actual episodes come once more.

        In all `parts` of an iteration together there are `virtual_ratio` times as many decisions as in the
        newest actual episodes; None where they are not trusted, or no CAV comes.
        """
        driver = full_policy(self._task, self._policy, network)
        decisions = min(self.k_star, self.scenario.horizon) // driver.hold * driver.hold
        if decisions == 0:
            return None
        starts, noise, exploration = (
            self._seed(iteration, each, part) for each in (STARTS, NOISE, EXPLORATION)
        )
        signs = self._policy.explores
        episodes = self.settings.virtual_ratio * self._driven * self.scenario.horizon / decisions
        count = max(1, round(episodes / parts / len(signs)))
        chosen = np.random.default_rng(list(starts)).integers(len(self.moments), size=count).tolist()
        kept = [self.moments[each] for each in chosen for _ in signs]
        earned, crashed, found = list[float](), list[bool](), list[Experience]()
        for begin in range(0, len(kept), MOST_MOTORWAYS):  # whole episodes take 40 MB each
            some = kept[begin : begin + MOST_MOTORWAYS]
            numbers = [number // len(signs) for number in range(begin, begin + len(some))]
            seeds = [((*noise, number), (*exploration, number)) for number in numbers]
            explore = [signs[number % len(signs)] for number in range(begin, begin + len(some))]
            episodes = self.driven(driver, some, decisions, seeds, explore)
            self.steps += sum(episode.steps for episode in episodes)
            earned += [float(episode.reward.sum()) for episode in episodes]
            crashed += [episode.status == "collision" for episode in episodes]
            if any(episode.trajectories for episode in episodes):
                found.append(how.of_episodes(episodes))
        if part == 0:
            self._note(kept, earned, decisions)
            self.facts["crash_share"] = float(np.mean(crashed))
        return join(found) if found else None

    def waves(self, drive: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return an actual road that no network learned from, and those where its people come once more.

        On all of them the expert alone drives CAVs.
        """
        road, expert, seed = cast(OnRamp, self.scenario), self._task.expert, self._unseen.seed
        learned, base = (self._beside_known(model, (0,)) for model in (self.model, self._new_model()))
        again = Again([((1,), (2,))], road.horizon, self.settings.noise, learned)
        actual, every = drive(EpisodeTask(road, expert, seed)), max(1, round(MOMENT / road.decision_step))
        roads = {"recorded": everybody(actual, every)}
        for label, otherwise in {"imagined": again, "base": again._replace(learned=base)}.items():
            world = MotorwayBatch(road, [seed], again=otherwise)
            world.asked = expert.asks
            (episode,) = driven_to_the_end(Drive(world, expert))
            roads[label] = everybody(episode, every)
        return Waves(every * road.decision_step, nan, actual.lane_names, roads)

    def driven(
        self,
        driver: Driver,
        kept: Sequence[MotorwayMoments],
        decisions: int,
        seeds: Sequence[tuple[Sequence[int], Sequence[int]]],
        explore: Sequence[float],
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
        again = Again(seeds, decisions, self.settings.noise, self._beside_known(self.model, noise))
        world = MotorwayBatch(road, [each.seed for each in kept], explore=explore, again=again)
        world.asked = driver.asks
        found = driven_to_the_end(Drive(world, driver, 1.0))
        earned = make_reward(self._task.reward or road.reward)
        return [rewarded(episode, earned) for episode in found]

    def _beside_known(self, model: RoadModel, seed: Sequence[int]) -> Learned | None:
        """Return what people do beside what the batch has them do, as a model has it."""
        generator, steps = torch_generator(seed, "cpu"), self.scenario.steps_per_decision
        return beside_known(model, generator, steps, self.settings.noise)

    @property
    def _driven(self) -> int:
        """How many episodes the newest policy drove, whether all of them are kept or not."""
        return self.data.episodes - self._first

    def _note(self, kept: Sequence[MotorwayMoments], earned: Sequence[float], decisions: int) -> None:
        """Note what the policy that drove the newest actual episodes earned here and there."""
        newest = zip(earned, kept, strict=True)
        both = [(value, each.earned) for value, each in newest if each.episode >= self._first]
        whole = decisions >= self.scenario.horizon and both
        virtual, actual = np.mean(both, 0).tolist() if whole else (None, None)
        self.facts |= {"return_virtual": virtual, "return_actual": actual}
