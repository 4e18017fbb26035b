"""Episodes of many roads at once, instead of one after the other in SUMO."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import RESIDUAL_AGE_KEY
from unjam.drivers.wrappers import DRIVER_INDEX_KEY, MixedDriver
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import LoopScenario
from unjam.tree import map_leaves
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.batch.on_ramp.world import MotorwayBatch
from unjam.worlds.batch.ring.record import RingResults
from unjam.worlds.batch.ring.warm_up import WarmUpCache, WarmUpState
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.support import (
    check_batch_scenarios,
    differ_only_in_size,
    statistically_unsupported_reason,
    unsupported_reason,
)
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import add_reward_terms, check_can_drive, check_has_cavs
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

_WarmUpKey = tuple[LoopScenario, tuple[int, ...], frozenset[str]]
"""a ring, an episode's seed, and what of all that is told drivers ask for"""
WARM_UP_CACHE = WarmUpCache[_WarmUpKey]()
MAX_BATCH_ROADS = 128
"""rings that are stepped at once at most, where whole episodes are kept: some 130 MB for 22 vehicles each"""
MAX_BATCH_MOTORWAYS = 64
"""motorways, likewise: some 40 MB each"""


def start_batch_drive(
    world: RingBatch,
    driver: Driver,
    to_array: ArrayFactory = np.asarray,
    explore: float = 0.0,
    memory: Memory | None = None,
) -> DriveLoop:
    """Return a driver who has just begun in a batch, and remembers in its arrays.

    Args:
        world: where.
        driver: of every CAV; where arrays are tensors, one who takes them.
        numbers: makes the world's arrays.
        explore: by how much exploration noise of what was learned counts.
        memory: what the driver remembers already; None: nothing but what the world began with.
    """
    world.measured_fields = driver.measured_fields
    if memory is None:  # who drives which CAV of a ring does not depend on the other rings
        rings = len(world.roads)
        each_ring = driver.initial_memory(world.cav_count // rings)
        memory = map_leaves(lambda values: np.repeat(values, rings, axis=0), each_ring)
    driving = DriveLoop(world, driver, explore, memory)
    driving.memory = map_leaves(to_array, driving.memory)
    if driver.action_repeat > 1 and RESIDUAL_AGE_KEY in driving.memory:
        driving.memory[RESIDUAL_AGE_KEY] = 0.0  # all rows began together: no network is asked while residuals are held
    return driving


def run_batch(
    tasks: Sequence[EpisodeTask],
    to_array: ArrayFactory = np.asarray,
    upcoming: Sequence[EpisodeTask] = (),
    allow_statistical: bool = False,
) -> list[Episode]:
    """Return the episodes of tasks, as `run_episode` does in SUMO, but for rounding; all are stepped at once.

    Args:
        tasks: roads that differ in length, seed and driver alone; motorways also in exploration.
        numbers: makes the arrays that are stepped.
        coming: tasks that will follow, alike; they are warmed up beforehand where these have to be.
        statistical: whether roads are allowed whose episodes are SUMO's in distribution alone.

    Raises:
        InputError: the tasks differ in more, or `batch.possible.unsupported_reason` says why they cannot be run so.
    """
    first = tasks[0]
    if any(_shared_settings(each) != _shared_settings(first) for each in tasks):
        raise InputError("batch: the tasks differ in driver, reward or exploration")
    earned = make_reward(first.reward or first.scenario.reward)
    return [add_reward_terms(episode, earned) for episode in _run_at_once(tasks, to_array, upcoming, allow_statistical)]


def _run_at_once(
    tasks: Sequence[EpisodeTask], to_array: ArrayFactory, upcoming: Sequence[EpisodeTask], allow_statistical: bool
) -> Sequence[Episode]:
    """Return the episodes of tasks, without what was earned; arguments as of `run_batch`."""
    first = tasks[0]
    for task in tasks:
        check_can_drive(task.driver, task.scenario)
    if isinstance(first.scenario, OnRamp):
        check_batch_scenarios([task.scenario for task in tasks], allow_statistical)
        if len(tasks) > 1 and any(_depends_on_entry_order(task.driver) for task in tasks):  # those of its own road
            return [each for task in tasks for each in _run_at_once([task], to_array, (), allow_statistical)]
        explore = [task.explore for task in tasks]
        motorways = MotorwayBatch(first.scenario, [task.seed for task in tasks], explore=explore)
        driver = _combined_driver(tasks, lambda owner: owner[motorways.cav_roads])
        motorways.measured_fields = driver.measured_fields
        episodes = finish_drive(DriveLoop(motorways, driver, float(any(explore))))
        for episode in episodes:
            check_has_cavs(episode, driver)
        return episodes
    scenarios, seeds = [cast(LoopScenario, each.scenario) for each in tasks], [each.seed for each in tasks]
    world = RingBatch(scenarios, seeds, to_array, first.reward, allow_statistical=allow_statistical)
    if world.scenario.warmup > 0:
        world.warm_up_states = WARM_UP_CACHE.get_states(
            [_warm_up_key(task) for task in tasks], [_warm_up_key(task) for task in upcoming], _warm_up
        )
    driver = _combined_driver(tasks, lambda owner: to_array(np.tile(owner, world.cav_count // len(owner))))
    rings: RingResults = finish_drive(start_batch_drive(world, driver, to_array, first.explore))
    return rings.episodes


@dataclass(frozen=True)
class DriverPerRoad(MixedDriver):
    """Drives each road of a batch by its own of several drivers."""

    driver_indices: Callable[[], Array]
    """returns which driver each CAV's road has, of all CAVs that are there now"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration that each CAV's driver wants, and the new memory."""
        return super().act(state, memory | {DRIVER_INDEX_KEY: self.driver_indices()})

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return for each CAV that of its driver."""
        return super().time_gaps(state, memory | {DRIVER_INDEX_KEY: self.driver_indices()})


def _depends_on_entry_order(driver: Driver) -> bool:
    """Return whether who drives a CAV depends on how many entered before it."""
    return isinstance(driver, MixedDriver) or any(map(_depends_on_entry_order, driver.inner_drivers.values()))


def _combined_driver(tasks: Sequence[EpisodeTask], to_cavs: Callable[[Array], Array]) -> Driver:
    """Return the driver of all tasks, or who drives each road by its own.

    `of_cavs` returns what it is given of each road, shape (W,), of each CAV that is there.
    """
    drivers = list[Driver]()
    for task in tasks:
        if task.driver not in drivers:
            drivers.append(task.driver)
    if len(drivers) == 1:
        return drivers[0]
    owner = np.array([drivers.index(task.driver) for task in tasks])
    return DriverPerRoad(tuple(drivers), lambda: to_cavs(owner))


def _warm_up_key(task: EpisodeTask) -> _WarmUpKey:
    return cast(LoopScenario, task.scenario), task.seed, frozenset(task.driver.measured_fields)


def _warm_up(keys: Sequence[_WarmUpKey]) -> dict[_WarmUpKey, WarmUpState]:
    """Return rings after their warm-up, `MOST` at once."""
    found: dict[_WarmUpKey, WarmUpState] = {}
    for some in (keys[first : first + MAX_BATCH_ROADS] for first in range(0, len(keys), MAX_BATCH_ROADS)):
        scenarios, seeds, (asked, *_) = zip(*some, strict=True)
        world = RingBatch(scenarios, seeds, keep_record=False, allow_statistical=True)
        world.measured_fields = asked
        found |= zip(some, world.run_warm_up(), strict=True)
    return found


def run_batches(
    tasks: Sequence[EpisodeTask], upcoming: Sequence[EpisodeTask] = (), allow_statistical: bool = False
) -> list[Episode]:
    """Return the episodes of tasks on roads of any kinds, in their order; those that are alike at once.

    `is_approaching` are tasks that will follow, of any kinds; see `run_batch`, of `statistical` too.
    """
    batches: list[dict[int, EpisodeTask]] = []
    for index, task in enumerate(tasks):
        most = MAX_BATCH_MOTORWAYS if isinstance(task.scenario, OnRamp) else MAX_BATCH_ROADS
        fits = (batch for batch in batches if len(batch) < most and _can_share_batch(task, next(iter(batch.values()))))
        batch = next(fits, None)
        if batch is None:
            batches.append(batch := {})
        batch[index] = task
    found: dict[int, Episode] = {}
    for batch in batches:
        first = next(iter(batch.values()))
        later = [task for task in upcoming if _can_share_batch(task, first)]
        found |= zip(
            batch, run_batch(list(batch.values()), upcoming=later, allow_statistical=allow_statistical), strict=True
        )
    return [found[index] for index in range(len(tasks))]


def run_batched_if_supported(
    tasks: Sequence[EpisodeTask],
    run_unsupported: Callable[[Sequence[EpisodeTask]], list[Episode]],
    upcoming: Sequence[EpisodeTask] = (),
    allow_statistical: bool = False,
) -> list[Episode]:
    """Return the episodes of tasks, in their order: in batches where that can be, else what `run` answers.

    `is_approaching` are tasks that will follow: see `run_batch`, of `statistical` too.
    """
    why_none = statistically_unsupported_reason if allow_statistical else unsupported_reason
    batched = [not why_none(task.scenario) for task in tasks]
    at_once = [task for task, possible in zip(tasks, batched, strict=True) if possible]
    quick = iter(run_batches(at_once, upcoming, allow_statistical))
    others = [task for task, possible in zip(tasks, batched, strict=True) if not possible]
    slow = iter(run_unsupported(others) if others else ())
    return [next(quick if possible else slow) for possible in batched]


def _shared_settings(task: EpisodeTask) -> tuple[object, ...]:
    """Return in what tasks may not differ that are driven at once."""
    alone = task.driver if task.driver.is_native or task.driver.network_inputs is not None else None
    return alone, task.reward, task.explore != 0.0 if isinstance(task.scenario, OnRamp) else task.explore


def _can_share_batch(first: EpisodeTask, second: EpisodeTask) -> bool:
    together = isinstance(first.scenario, OnRamp) or first.driver == second.driver
    return (
        together
        and _shared_settings(first) == _shared_settings(second)
        and differ_only_in_size(first.scenario, second.scenario)
    )
