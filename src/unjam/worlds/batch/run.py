"""Episodes of many roads at once in batches."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress
from operator import not_
from typing import cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import RESIDUAL_AGE_KEY
from unjam.drivers.wrappers import DRIVER_INDEX_KEY, MixedDriver
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.ring import LoopScenario
from unjam.tree import map_leaves
from unjam.worlds.batch import support
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.batch.ring.world import RingBatch, WarmUpState
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import add_reward_terms, check_can_drive, check_has_cavs
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.worker_pool import EpisodeTask

_WarmUpKey = tuple[LoopScenario, tuple[int, ...], frozenset[str]]
"""a scenario, the seed of an episode, and the fields that the driver measures"""
WARM_UP_CACHE: dict[_WarmUpKey, WarmUpState] = {}
"""the newest states of rings after their all-human warm-up, which does not depend on the driver of the CAVs"""
MAX_CACHED_CAVS = 2048
"""maximum number of CAVs on cached rings; each takes about 60 kB, mostly for the states of its last minute"""


def start_batch_drive(
    world: RingBatch | MotorwayBatch,
    driver: Driver,
    to_array: ArrayFactory = np.asarray,
    explore: float = 0.0,
    memory: Memory | None = None,
) -> DriveLoop:
    """Return a new loop in which a driver drives all CAVs of a batch.

    The driver must accept arrays of `to_array`. Without `memory`, it starts with its initial memory and the warm-up.
    """
    world.measured_fields = driver.requirements().measured_fields
    has_fixed_rows = world.cav_count > 0  # otherwise CAVs enter later
    if memory is None and has_fixed_rows:  # drivers on a ring do not depend on other rings
        memory = initial_batch_memory(driver, len(world.roads), world.cav_count)
    loop = DriveLoop(world, driver, explore, memory)
    loop.memory = map_leaves(to_array, loop.memory)
    if has_fixed_rows and driver.action_repeat > 1 and RESIDUAL_AGE_KEY in loop.memory:
        loop.memory[RESIDUAL_AGE_KEY] = 0.0  # one age for all rows: the network is not called while residuals are held
    return loop


def initial_batch_memory(driver: Driver, road_count: int, cav_count: int) -> Memory:
    """Return the initial memory of a driver of all CAVs of a batch of roads with equal numbers of CAVs."""
    memory = driver.initial_memory(cav_count // road_count)
    return map_leaves(lambda values: np.repeat(values, road_count, axis=0), memory)


def run_batch(
    tasks: Sequence[EpisodeTask],
    to_array: ArrayFactory = np.asarray,
    upcoming: Sequence[EpisodeTask] = (),
    allow_statistical: bool = False,
) -> list[Episode]:
    """Simulate tasks at once and return their episodes, which equal those of `run_episode` except for rounding.

    Tasks may differ in road length, seed and driver, and on motorways in exploration. Otherwise, or if they are not
    supported, raise `InputError`. The warm-ups of `upcoming` tasks are simulated, too. `allow_statistical` also allows
    scenarios with episodes that equal SUMO's only in distribution.
    """
    first = tasks[0]
    if any(_common_settings(task) != _common_settings(first) for task in tasks):
        raise InputError("batch: the tasks differ in driver, reward or exploration")
    reward = make_reward(first.reward or first.scenario.reward)
    return [add_reward_terms(episode, reward) for episode in _run_at_once(tasks, to_array, upcoming, allow_statistical)]


def _run_at_once(
    tasks: Sequence[EpisodeTask], to_array: ArrayFactory, upcoming: Sequence[EpisodeTask], allow_statistical: bool
) -> Sequence[Episode]:
    first, scenarios = tasks[0], [task.scenario for task in tasks]
    for task in tasks:
        check_can_drive(task.driver, task.scenario)
    support.check_batch_scenarios(scenarios, allow_statistical)
    kind = support.required_batch_kind(first.scenario)
    if kind.has_own_drivers and len(tasks) > 1 and any(_depends_on_entry_order(task.driver) for task in tasks):
        # Drivers are assigned in order of entry, which must be the order on one road.
        return [episode for task in tasks for episode in _run_at_once([task], to_array, (), allow_statistical)]
    world = kind.world.from_tasks(tasks, to_array)
    if first.scenario.warmup > 0:

        def warm_up_key(task: EpisodeTask) -> _WarmUpKey:
            return cast(LoopScenario, task.scenario), task.seed, task.driver.requirements().measured_fields

        states = warm_up_states([*map(warm_up_key, tasks)], [*map(warm_up_key, upcoming)])
        cast(RingBatch, world).warm_up_states = states
    driver = _combine_drivers(tasks, world.values_of_cavs)
    explore = float(any(task.explore for task in tasks)) if kind.has_own_drivers else first.explore
    episodes = finish_drive(start_batch_drive(world, driver, to_array, explore))
    for episode in episodes:
        check_has_cavs(episode, driver)
    return episodes


@dataclass(frozen=True)
class DriverPerRoad(MixedDriver):
    """Drives each road of a batch with one of several drivers."""

    driver_indices: Callable[[], Array]
    """returns the index of the driver of each CAV on the roads"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of each CAV by its driver, and the new memory."""
        return super().act(state, memory | {DRIVER_INDEX_KEY: self.driver_indices()})

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gap of each CAV by its driver."""
        return super().time_gaps(state, memory | {DRIVER_INDEX_KEY: self.driver_indices()})


def _depends_on_entry_order(driver: Driver) -> bool:
    """Return whether the driver of a CAV depends on the number of CAVs that entered before it."""
    return isinstance(driver, MixedDriver) or any(map(_depends_on_entry_order, driver.inner_drivers.values()))


def _combine_drivers(tasks: Sequence[EpisodeTask], values_of_cavs: Callable[[Array], Array]) -> Driver:
    """Return a driver for all tasks; `values_of_cavs` maps values of roads, shape (W,), to values of their CAVs."""
    drivers = list[Driver]()
    for task in tasks:
        if task.driver not in drivers:
            drivers.append(task.driver)
    if len(drivers) == 1:
        return drivers[0]
    indices = np.array([drivers.index(task.driver) for task in tasks])
    return DriverPerRoad(tuple(drivers), lambda: values_of_cavs(indices))


def warm_up_states(keys: Sequence[_WarmUpKey], upcoming: Sequence[_WarmUpKey]) -> list[WarmUpState]:
    """Return the state after the warm-up for each key; missing states are simulated together with `upcoming` keys."""
    cache = WARM_UP_CACHE
    if all(key in cache for key in keys):
        return [cache[key] for key in keys]
    warm_ups = {**cache, **_simulate_warm_ups([key for key in dict.fromkeys([*keys, *upcoming]) if key not in cache])}
    counts = [1 if state.history is None else len(state.history.speed) for state in warm_ups.values()]
    remaining_cavs = sum(counts)
    cache.clear()
    for (key, state), count in zip(warm_ups.items(), counts, strict=True):
        if remaining_cavs <= MAX_CACHED_CAVS:
            cache[key] = state
        remaining_cavs -= count
    return [warm_ups[key] for key in keys]


def _simulate_warm_ups(keys: Sequence[_WarmUpKey]) -> dict[_WarmUpKey, WarmUpState]:
    states, max_roads = dict[_WarmUpKey, WarmUpState](), support.required_batch_kind(keys[0][0]).max_roads
    for start in range(0, len(keys), max_roads):
        batch_keys = keys[start : start + max_roads]
        scenarios, seeds, (measured_fields, *_) = zip(*batch_keys, strict=True)
        world = RingBatch(scenarios, seeds, keep_record=False)
        world.measured_fields = measured_fields
        states |= zip(batch_keys, world.run_warm_up(), strict=True)
    return states


def run_batches(
    tasks: Sequence[EpisodeTask], upcoming: Sequence[EpisodeTask] = (), allow_statistical: bool = False
) -> list[Episode]:
    """Return the episodes of any tasks in their order; similar tasks share a batch, see `run_batch`."""
    batches: list[dict[int, EpisodeTask]] = []
    for index, task in enumerate(tasks):
        max_roads = support.required_batch_kind(task.scenario).max_roads
        for batch in batches:
            if len(batch) < max_roads and _tasks_can_share_batch(task, next(iter(batch.values()))):
                batch[index] = task
                break
        else:
            batches.append({index: task})
    episodes: dict[int, Episode] = {}
    for batch in batches:
        batch_tasks = list(batch.values())
        similar = [task for task in upcoming if _tasks_can_share_batch(task, batch_tasks[0])]
        batch_episodes = run_batch(batch_tasks, upcoming=similar, allow_statistical=allow_statistical)
        episodes |= zip(batch, batch_episodes, strict=True)
    return [episodes[index] for index in range(len(tasks))]


def run_batched_if_supported(
    tasks: Sequence[EpisodeTask],
    run_unsupported: Callable[[Sequence[EpisodeTask]], list[Episode]],
    upcoming: Sequence[EpisodeTask] = (),
    allow_statistical: bool = False,
) -> list[Episode]:
    """Return the episodes of tasks in their order, from `run_batches` if supported, else from `run_unsupported`."""
    find_reason = support.statistically_unsupported_reason if allow_statistical else support.unsupported_reason
    is_supported = [not find_reason(task.scenario) for task in tasks]
    supported, others = list(compress(tasks, is_supported)), list(compress(tasks, map(not_, is_supported)))
    batched = iter(run_batches(supported, upcoming, allow_statistical))
    unbatched = iter(run_unsupported(others) if others else ())
    return [next(batched if is_batched else unbatched) for is_batched in is_supported]


def _common_settings(task: EpisodeTask) -> tuple[object, ...]:
    """Return the settings that all tasks of a batch must have in common."""
    is_indivisible = task.driver.is_driven_by_simulator or task.driver.network_inputs is not None
    kind = support.batch_kind(task.scenario)
    explore = task.explore != 0.0 if kind and kind.has_own_drivers else task.explore
    return task.driver if is_indivisible else None, task.reward, explore


def _tasks_can_share_batch(first: EpisodeTask, second: EpisodeTask) -> bool:
    has_equal_drivers = support.required_batch_kind(first.scenario).has_own_drivers or first.driver == second.driver
    has_equal_settings = _common_settings(first) == _common_settings(second)
    return has_equal_drivers and has_equal_settings and support.can_share_batch(first.scenario, second.scenario)
