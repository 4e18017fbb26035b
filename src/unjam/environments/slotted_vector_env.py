"""Many motorways of a batch as a Gymnasium vector environment with fixed slots for their CAVs."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from unjam.drivers.driver import carry_over_memory
from unjam.drivers.observation import FeatureLike
from unjam.drivers.user_driver import DriverLike
from unjam.environments.external_driver import ExternalDriver
from unjam.environments.gymnasium_env import episode_seed, no_cav_error
from unjam.environments.vector_env import Episodes, RoadVectorEnv, with_masks
from unjam.errors import InputError
from unjam.measures.step_metrics import open_road_metrics, open_road_sums
from unjam.parameters import check_integer
from unjam.physics.arrays import Array, Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.batch.support import required_batch_kind
from unjam.worlds.reward import Outcome, RewardLike

NO_SLOT = -1  # slot of a CAV that got no free slot


class SlottedEpisodes(Episodes):
    """Running episodes on W motorways, with the driver of their CAVs and S slots for CAVs on each road."""

    def __init__(self, world: MotorwayBatch, driver: ExternalDriver, slots: int) -> None:
        self._shape = len(world.roads), slots
        self._slots = np.zeros(0, np.intp)  # slot of each CAV, or `NO_SLOT`
        self._departed: tuple[NDArray[Any], ...] = *np.zeros((2, 0), np.intp), np.zeros((0, 1))
        """road, slot and last observation of the CAVs that left their slots in the last control step"""
        super().__init__(world, driver, np.asarray)

    def advance(self, actions: Array) -> Outcome:
        """Simulate one control step with actions of shape (W, S), and return its outcome."""
        roads, slots = self.world.cav_roads, self._slots
        outcome = super().advance(np.where(slots == NO_SLOT, 0.0, actions[roads, slots]))
        remaining = self.world.remaining_rows
        rows = np.arange(len(slots)) if remaining is None else np.array(remaining, np.intp)
        left_rows = np.setdiff1d(np.flatnonzero(slots != NO_SLOT), rows)
        self._departed = roads[left_rows], slots[left_rows], self._row_observations[left_rows]
        self._update_rows(rows)
        return outcome

    def _update_rows(self, rows: NDArray[np.intp]) -> None:
        """Keep `rows` of the CAVs, and give the first free slots to the CAVs that have entered."""
        new_roads, is_free = self.world.cav_roads[len(rows) :].tolist(), ~self.is_occupied
        slots = self._slots[rows].tolist()
        for road in new_roads:
            free = np.flatnonzero(is_free[road])[:1]
            is_free[road, free] = False
            slots += free.tolist() or [NO_SLOT]
        self._slots, new_count = np.array(slots, np.intp), len(new_roads)
        initial_memory = self._driver.initial_memory(new_count)
        self._memory = carry_over_memory(self._memory, rows, initial_memory, new_count)

    def observe(self) -> None:
        """Compute the observations of the current state; call it once in each control step."""
        super().observe()
        has_slot = self._slots != NO_SLOT
        occupied, departed = (self.world.cav_roads[has_slot], self._slots[has_slot]), self._departed[:2]
        row_observations: Floats = self.observations
        self._row_observations = row_observations
        self.is_occupied, self.has_left = np.zeros((2, *self._shape), bool)
        self.is_occupied[occupied], self.has_left[departed] = True, True
        self.observations = np.zeros((*self._shape, row_observations.shape[1]))
        self.observations[occupied], self.observations[departed] = row_observations[has_slot], self._departed[2]

    def replace(self, rows: list[int], source: Any, source_rows: list[int]) -> None:
        """Continue in `rows` with `source_rows` of episodes that have just been started."""
        remaining = np.flatnonzero(~np.isin(self.world.cav_roads, rows))
        self._slots, self._memory = self._slots[remaining], carry_over_memory(self._memory, remaining, {}, 0)
        is_remaining = ~np.isin(self._departed[0], rows)
        self._departed = tuple(values[is_remaining] for values in self._departed)
        self.world.replace_roads(rows, source.world, source_rows)
        self.observe()


class SlottedRoadVectorEnv(RoadVectorEnv):
    """W motorways with S slots each for CAVs that enter and leave, simulated together without SUMO.

    ``gymnasium.make_vec("unjam/OnRamp-v0", num_envs=64, slots=8)``. Slots are those of `SlottedRoadEnv`, seeds and
    restarts those of `RoadVectorEnv`. Episodes have the same distribution as SUMO's. With ``exact=False`` the errors of
    all human drivers come from one generator, and vehicles have single precision.

    ============  ==================================================================================================
    Roads         motorways with 1 or 2 lanes and any number of on-ramps; their CAVs are a share of the cars
    Observations  (W, S, n); zeros in empty slots
    Actions       (W, S, 1); those of empty slots are ignored
    Rewards       (W,): the reward of each road, which its CAVs share. ``info["slot_rewards"]``, (W, S), is this reward
                  for the CAVs that acted in the step, and 0 in the other slots
    Steps         each is one control step, also without CAVs: an episode begins with an empty road. `SlottedRoadEnv`
                  skips control steps without CAVs
    Ends          terminated at a collision; truncated at the horizon, or when no CAV will be on the road again
    ``info``      ``is_occupied`` and ``has_left``, (W, S), ``slot_rewards``, ``reward_terms``; at the end of an episode
                  ``episode_metrics``: ``return``, ``steps``, ``mean_speed``, ``travel_time``, ``insertion_backlog_veh``
    ============  ==================================================================================================
    """

    _alternative = "allowed: motorways, or unjam.parallel_env with slots, which simulates in SUMO"
    _step_sums = staticmethod(open_road_sums)

    def __init__(
        self,
        num_envs: int = 1,
        slots: int = 8,
        scenario: str = "on-ramp",
        reward: RewardLike = "",
        expert: str | DriverLike = "",
        features: Sequence[FeatureLike] = ("local",),
        **changes: Any,
    ) -> None:
        """Prepare the environments with `slots` on each road; other arguments are those of `RoadVectorEnv`."""
        slots = check_integer("slots", slots, 1)
        if "device" in changes:
            raise InputError("device: is not an option of motorways; they are NumPy's")
        self._slots = slots
        super().__init__(num_envs, scenario, reward, expert, features, **changes)

    def _unsupported_reason(self, scenario: Scenario) -> str:
        if not issubclass(required_batch_kind(scenario).world, MotorwayBatch):
            return "its vehicles stay: slots are only allowed on motorways"
        if (source := cast(Motorway, scenario).roadside.source) == "detectors":
            return f"roadside.source: {source} is not allowed with slots; allowed: vehicles, cavs, none"
        return ""

    def _space_of_environment(self, space: spaces.Box) -> spaces.Box:
        return cast(spaces.Box, batch_space(space, self._slots))

    def _make_world(self, kind: type[MotorwayBatch], seeds: list[tuple[int, ...]]) -> MotorwayBatch:
        return kind(cast(Motorway, self._road.scenario), seeds, keep_record=False, draw=self._kind.draw)

    def _start_episodes(self, rows: list[int]) -> SlottedEpisodes:
        world: MotorwayBatch = self.make_batch(rows)
        for row, road in zip(rows, world.roads, strict=True):
            if not road.cav_ids:
                seed = episode_seed(self._seeds[row] or 0, self._episode_counts[row] - 1)
                episode = f"environment {row}: {world.scenario.title} of seed {', '.join(map(str, seed))}: "
                raise no_cav_error(world.scenario, episode)
        return SlottedEpisodes(world, self._road.copy_driver(), self._slots)

    def _clear_ignored_actions(self, actions: Array) -> Array:
        is_occupied = cast(SlottedEpisodes, self._running_episodes).is_occupied
        return np.where(is_occupied, super()._clear_ignored_actions(actions), 0.0)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start episodes as `RoadVectorEnv.reset` does."""
        observations, info = super().reset(seed=seed, options=options)
        return observations, info | self._slot_info()

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Simulate one control step with actions of shape (W, S, 1) [m/s2]; restart episodes that ended before."""
        has_acted = cast(SlottedEpisodes, self._running_episodes).is_occupied
        *values, rewards, terminated, truncated, info = super().step(actions)
        slot_rewards = np.where(has_acted, rewards[:, None], 0.0)
        return *values, rewards, terminated, truncated, info | self._slot_info(slot_rewards=slot_rewards)

    def _slot_info(self, **values: Array) -> dict[str, Any]:
        episodes = cast(SlottedEpisodes, self._running_episodes)
        masks = {"is_occupied": episodes.is_occupied, "has_left": episodes.has_left}
        return with_masks(masks | values, np.ones(self.num_envs, bool))

    def _episode_metrics(self, sums: dict[str, Array], outcome: Outcome, steps: Array) -> dict[str, Array]:
        world, scenario = self._running_episodes.world, self._road.scenario
        return open_road_metrics(sums, outcome, world.entry_counts, scenario.horizon - steps, scenario.control_step)


def make_vector_env(num_envs: int = 1, slots: int | None = None, **arguments: Any) -> RoadVectorEnv:
    """Return the vector environment of a scenario; with `slots`, a `SlottedRoadVectorEnv`."""
    if slots is None:
        return RoadVectorEnv(num_envs, **arguments)
    return SlottedRoadVectorEnv(num_envs, slots, **arguments)
