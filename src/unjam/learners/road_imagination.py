"""Imagining whole roads: everybody drives on, from recorded moments, and waves come and go."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.network import Network
from unjam.drivers.residual import AGE, EXPERT, RESIDUAL
from unjam.learners.experience import Experience
from unjam.learners.imagination import (
    EXPLORATION,
    NOISE,
    STARTS,
    AsExperience,
    WholeRoads,
    full_policy,
)
from unjam.learners.waves import Everybody, Waves, everybody
from unjam.scenarios.ring import Loop
from unjam.tree import mapped
from unjam.virtual.comparison import Replayed
from unjam.virtual.data import remembered
from unjam.virtual.ensemble import torch_generator
from unjam.virtual.fitting import Fit
from unjam.virtual.roads import (
    Moments,
    check_roads,
    fit_roads,
    known_speed,
    moments_of,
    of_size,
    people_of,
)
from unjam.worlds.batch.crossing import Memory as Waits
from unjam.worlds.batch.people import People
from unjam.worlds.batch.run import begin
from unjam.worlds.batch.world import RingBatch
from unjam.worlds.drive import driven_to_the_end
from unjam.worlds.episode import rewarded
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.workers import EpisodeTask


class RoadImagination(WholeRoads[Moments]):
    """The virtual environment of a run as whole closed roads."""

    kind = Moments

    def __init__(self, *arguments: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `Imagination`.

        Raises:
            InputError: whole roads cannot be imagined on the task's road.
        """
        super().__init__(*arguments)
        check_roads(self.scenario)

    def _kept_of(self, episode: Episode, number: int) -> Moments:
        return moments_of(episode, number, cast(Loop, self.scenario))

    def _fit_moments(self, seed: Sequence[int]) -> Fit:
        return fit_roads(self.model, self.moments, self.settings, self.scenario, seed)

    def imagine(
        self, network: Network, iteration: int, part: int, parts: int, how: AsExperience
    ) -> Experience | None:
        """Return what the policy `network` does on imagined roads; None where they are not trusted."""
        driver = full_policy(self._task, self._policy, network)
        driven = self.k_star // driver.hold * driver.hold
        if driven == 0:
            return None
        starts, *others = (self._seed(iteration, each, part) for each in (STARTS, NOISE, EXPLORATION))
        cavs = len(self.scenario.possible_cavs())  # rows of each road
        choices = self._starts(parts * cavs, starts, driven)
        if len(choices) == 0:
            return None
        memory: Memory = {EXPERT: self._memory(choices, cavs)}
        if driver.hold > 1:
            nothing = np.zeros(cavs * len(choices))
            memory |= {RESIDUAL: nothing, AGE: nothing}
        members, draws = others
        people = people_of(self.model, self.scenario, torch_generator(members, "cpu"))
        episodes = self.driven(driver, memory, choices, driven, people, draws)
        self.steps += sum(episode.steps for episode in episodes)
        if part == 0:
            earned = np.array([episode.reward.sum() for episode in episodes])
            crashed = [episode.status == "collision" for episode in episodes]
            self._compare(earned, choices, driven, float(np.mean(crashed)))
        return how.of_episodes(episodes)

    def driven(
        self,
        driver: Driver,
        memory: Memory,
        choices: NDArray[np.int64],
        decisions: int,
        people: People,
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
        road = cast(Loop, self.scenario)
        by_episode = {kept.episode: kept for kept in self.moments}
        kept = [by_episode[self.data.recordings[place].episode] for place, _ in choices]
        here = [(each, at // each.every) for each, (_, at) in zip(kept, choices, strict=True)]
        noise = float(self.model.noise) / road.simulation_step / replace(road, noise=1.0).noise_per_step
        noise = noise if self.settings.noise else 0.0
        common = replace(road, horizon=decisions, noise=noise, population="")
        world = RingBatch(
            [of_size(common, each.size) for each in kept],
            [(*seed, number) for number in range(len(kept))],  # of sensors alone: all else is given
            reward=self._task.reward,
            draw=np.random.default_rng(list(seed)).standard_normal,
            people=people,
            statistical=True,
        )
        waits = [each.waits and Waits(*(values[row] for values in each.waits)) for each, row in here]
        world.place(
            np.stack([each.speeds[row] for each, row in here], 1),
            np.stack([each.positions[row] for each, row in here], 1),
            waits,
        )
        found = driven_to_the_end(begin(world, driver, explore=True, memory=memory))
        earned = make_reward(self._task.reward or road.reward)
        return [rewarded(episode, earned) for episode in found.episodes]

    def waves(self, drive: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return an actual road that no network learned from, and those imagined from its start on.

        It is one of the record's: nothing is driven anew. CAVs do what they did, and noise is drawn anew.
        """
        moments, recordings = self._unseen, self.data.recordings
        rows = [place for place, each in enumerate(recordings) if each.episode == moments.episode]
        did = Replayed(np.stack([recordings[row].applied for row in rows], 1))
        begun = np.array([[rows[0], 0]])
        kinds = {
            "imagined": people_of(self.model, self.scenario, torch_generator((0,), "cpu")),
            "base": known_speed(self.settings.base, self.scenario),
        }
        cavs, memory = np.flatnonzero(moments.people == 0.0).tolist(), did.initial_memory(len(rows))
        roads = {"recorded": Everybody(moments.speeds, moments.positions, np.zeros((0, 0)), cavs)}
        for label, people in kinds.items():
            (episode,) = self.driven(did, memory, begun, len(did.accelerations), people, (1,))
            roads[label] = everybody(episode, moments.every)
        return Waves(moments.every * self.scenario.decision_step, moments.length, (), roads)

    def _memory(self, choices: NDArray[np.int64], cavs: int) -> Memory:
        """Return what the expert remembered at `choices`: all rows of the first CAV, then of the second."""
        first: dict[int, int] = {}
        for place, recording in enumerate(self.data.recordings):
            first.setdefault(recording.episode, place)
        firsts = np.array([first[self.data.recordings[place].episode] for place, _ in choices])
        each = [
            remembered(
                self._task.expert, self.data.recordings, np.column_stack([firsts + cav, choices[:, 1]])
            )
            for cav in range(cavs)
        ]
        return mapped(lambda *values: np.concatenate(values), each[0], *each[1:])

    def restore(self, facts: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `state` returned."""
        # Earlier versions imagined rings alone, where size is length and nobody waits.
        kept = [{"size": round(each["length"]), "waits": None, **each} for each in facts["moments"]]
        super().restore({**facts, "moments": kept}, tensors)
