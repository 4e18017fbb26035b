"""Episodes of many roads at once, instead of one after the other in SUMO."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import AGE
from unjam.drivers.wrappers import KIND, Mixed
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import Loop
from unjam.tree import mapped
from unjam.worlds.batch.begun import Begun, BegunRings
from unjam.worlds.batch.motorway_world import MotorwayBatch
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.possible import alike, check_together, statistical_why_not, why_not
from unjam.worlds.batch.record import Rings
from unjam.worlds.batch.world import RingBatch
from unjam.worlds.drive import Drive, driven_to_the_end
from unjam.worlds.episode import check_can_drive, check_cavs_drove, rewarded
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.workers import EpisodeTask

_Ring = tuple[Loop, tuple[int, ...], frozenset[str]]
"""a ring, an episode's seed, and what of all that is told drivers ask for"""
BEGUN = BegunRings[_Ring]()
MOST = 128
"""rings that are stepped at once at most, where whole episodes are kept: some 130 MB for 22 vehicles each"""
MOST_MOTORWAYS = 64
"""motorways, likewise: some 40 MB each"""


def begin(
    world: RingBatch,
    driver: Driver,
    numbers: Numbers = np.asarray,
    explore: float = 0.0,
    memory: Memory | None = None,
) -> Drive:
    """Return a driver who has just begun in a batch, and remembers in its arrays.

    Args:
        world: where.
        driver: of every CAV; where arrays are tensors, one who takes them.
        numbers: makes the world's arrays.
        explore: by how much exploration noise of what was learned counts.
        memory: what the driver remembers already; None: nothing but what the world began with.
    """
    world.asked = driver.asks
    if memory is None:  # who drives which CAV of a ring does not depend on the other rings
        rings = len(world.roads)
        each_ring = driver.initial_memory(world.rows // rings)
        memory = mapped(lambda values: np.repeat(values, rings, axis=0), each_ring)
    driving = Drive(world, driver, explore, memory)
    driving.memory = mapped(numbers, driving.memory)
    if driver.hold > 1 and AGE in driving.memory:
        driving.memory[AGE] = 0.0  # all rows began together: no network is asked while residuals are held
    return driving


def run_batch(
    tasks: Sequence[EpisodeTask],
    numbers: Numbers = np.asarray,
    coming: Sequence[EpisodeTask] = (),
    statistical: bool = False,
) -> list[Episode]:
    """Return the episodes of tasks, as `run_episode` does in SUMO, but for rounding; all are stepped at once.

    Args:
        tasks: roads that differ in length, seed and driver alone; motorways also in exploration.
        numbers: makes the arrays that are stepped.
        coming: tasks that will follow, alike; they are warmed up beforehand where these have to be.
        statistical: whether roads are allowed whose episodes are SUMO's in distribution alone.

    Raises:
        InputError: the tasks differ in more, or `batch.possible.why_not` says why they cannot be run so.
    """
    first = tasks[0]
    if any(_driven(each) != _driven(first) for each in tasks):
        raise InputError("batch: the tasks differ in driver, reward or exploration")
    earned = make_reward(first.reward or first.scenario.reward)
    return [rewarded(episode, earned) for episode in _driven_at_once(tasks, numbers, coming, statistical)]


def _driven_at_once(
    tasks: Sequence[EpisodeTask], numbers: Numbers, coming: Sequence[EpisodeTask], statistical: bool
) -> Sequence[Episode]:
    """Return the episodes of tasks, without what was earned; arguments as of `run_batch`."""
    first = tasks[0]
    for task in tasks:
        check_can_drive(task.driver, task.scenario)
    if isinstance(first.scenario, OnRamp):
        check_together([task.scenario for task in tasks], statistical)
        if len(tasks) > 1 and any(_counts_cavs(task.driver) for task in tasks):  # those of its own road
            return [each for task in tasks for each in _driven_at_once([task], numbers, (), statistical)]
        explore = [task.explore for task in tasks]
        motorways = MotorwayBatch(first.scenario, [task.seed for task in tasks], explore=explore)
        driver = _of_all(tasks, lambda owner: owner[motorways.of_road])
        motorways.asked = driver.asks
        episodes = driven_to_the_end(Drive(motorways, driver, float(any(explore))))
        for episode in episodes:
            check_cavs_drove(episode, driver)
        return episodes
    scenarios, seeds = [cast(Loop, each.scenario) for each in tasks], [each.seed for each in tasks]
    world = RingBatch(scenarios, seeds, numbers, first.reward, statistical=statistical)
    if world.scenario.warmup > 0:
        world.begun = BEGUN.of([_ring(task) for task in tasks], [_ring(task) for task in coming], _warm_up)
    driver = _of_all(tasks, lambda owner: numbers(np.tile(owner, world.rows // len(owner))))
    rings: Rings = driven_to_the_end(begin(world, driver, numbers, first.explore))
    return rings.episodes


@dataclass(frozen=True)
class PerRoad(Mixed):
    """Drives each road of a batch by its own of several drivers."""

    owner: Callable[[], Array]
    """returns which driver each CAV's road has, of all CAVs that are there now"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration that each CAV's driver wants, and the new memory."""
        return super().act(state, memory | {KIND: self.owner()})

    def time_headways(self, state: LocalState, memory: Memory) -> Array | None:
        """Return for each CAV that of its driver."""
        return super().time_headways(state, memory | {KIND: self.owner()})


def _counts_cavs(driver: Driver) -> bool:
    """Return whether who drives a CAV depends on how many entered before it."""
    return isinstance(driver, Mixed) or any(map(_counts_cavs, driver.inner.values()))


def _of_all(tasks: Sequence[EpisodeTask], of_cavs: Callable[[Array], Array]) -> Driver:
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
    return PerRoad(tuple(drivers), lambda: of_cavs(owner))


def _ring(task: EpisodeTask) -> _Ring:
    return cast(Loop, task.scenario), task.seed, frozenset(task.driver.asks)


def _warm_up(rings: Sequence[_Ring]) -> dict[_Ring, Begun]:
    """Return rings after their warm-up, `MOST` at once."""
    found: dict[_Ring, Begun] = {}
    for some in (rings[first : first + MOST] for first in range(0, len(rings), MOST)):
        scenarios, seeds, (asked, *_) = zip(*some, strict=True)
        world = RingBatch(scenarios, seeds, keep=False, statistical=True)
        world.asked = asked
        found |= zip(some, world.warmed_up(), strict=True)
    return found


def run_batches(
    tasks: Sequence[EpisodeTask], coming: Sequence[EpisodeTask] = (), statistical: bool = False
) -> list[Episode]:
    """Return the episodes of tasks on roads of any kinds, in their order; those that are alike at once.

    `coming` are tasks that will follow, of any kinds; see `run_batch`, of `statistical` too.
    """
    batches: list[dict[int, EpisodeTask]] = []
    for index, task in enumerate(tasks):
        most = MOST_MOTORWAYS if isinstance(task.scenario, OnRamp) else MOST
        fits = (batch for batch in batches if len(batch) < most and _alike(task, next(iter(batch.values()))))
        batch = next(fits, None)
        if batch is None:
            batches.append(batch := {})
        batch[index] = task
    found: dict[int, Episode] = {}
    for batch in batches:
        first = next(iter(batch.values()))
        later = [task for task in coming if _alike(task, first)]
        found |= zip(
            batch, run_batch(list(batch.values()), coming=later, statistical=statistical), strict=True
        )
    return [found[index] for index in range(len(tasks))]


def run_where_possible(
    tasks: Sequence[EpisodeTask],
    run: Callable[[Sequence[EpisodeTask]], list[Episode]],
    coming: Sequence[EpisodeTask] = (),
    statistical: bool = False,
) -> list[Episode]:
    """Return the episodes of tasks, in their order: in batches where that can be, else what `run` answers.

    `coming` are tasks that will follow: see `run_batch`, of `statistical` too.
    """
    why_none = statistical_why_not if statistical else why_not
    batched = [not why_none(task.scenario) for task in tasks]
    at_once = [task for task, possible in zip(tasks, batched, strict=True) if possible]
    quick = iter(run_batches(at_once, coming, statistical))
    others = [task for task, possible in zip(tasks, batched, strict=True) if not possible]
    slow = iter(run(others) if others else ())
    return [next(quick if possible else slow) for possible in batched]


def _driven(task: EpisodeTask) -> tuple[object, ...]:
    """Return in what tasks may not differ that are driven at once."""
    alone = task.driver if task.driver.native or task.driver.shown is not None else None
    return alone, task.reward, task.explore != 0.0 if isinstance(task.scenario, OnRamp) else task.explore


def _alike(one: EpisodeTask, other: EpisodeTask) -> bool:
    together = isinstance(one.scenario, OnRamp) or one.driver == other.driver
    return together and _driven(one) == _driven(other) and alike(one.scenario, other.scenario)
