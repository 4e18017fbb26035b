"""Driving: the one loop in which a driver and a world meet."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from unjam.drivers.driver import Decision, Driver, Memory, Noise, carried, single_row
from unjam.drivers.residual import EXPERT
from unjam.tree import mapped
from unjam.worlds.world import Driven, OnProgress, Recorded, World

PROGRESS_STEPS = 10
"""decisions between two reports of progress"""


class Drive:
    """A driver in a world, decision by decision: iterate over it."""

    def __init__(
        self,
        world: World[Recorded],
        driver: Driver,
        explore: float = 0.0,
        memory: Memory | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Start the world; nothing is decided yet.

        What was learned adds its noise times `explore`. Without a `memory` the driver remembers nothing but
        what the world began with. `on_progress` is called now and then with the number of decisions made.
        """
        self.world, self.driver, self._on_progress = world, driver, on_progress
        self._noise = _noise_of(world, driver, explore)
        history = world.start(not driver.native, on_progress)
        self.memory = driver.initial_memory(world.rows) if memory is None else memory
        if history is not None:
            self.memory = driver.recall(self.memory, history)
        self.memories: list[Memory] = []
        """of each CAV by itself before its first decision, in order of entry"""
        self._note_newcomers()
        if world.single:
            self.memory = single_row(self.memory)

    def __iter__(self) -> Iterator[Decision | None]:
        """Yield each decision once it is carried out; None where the simulator itself drives."""
        world, driver, noise, made = self.world, self.driver, self._noise, 0
        perceive, decide, advance = world.perceive, driver.decide, world.advance
        while not world.ended:
            if driver.native:
                decision = None
                advance(None)
            else:
                decision = decide(perceive(), self.memory, noise)
                self.memory = decision.memory
                advance(decision.command)
            if world.kept is not None or world.entered > len(self.memories):
                self._carry()
            made += 1
            if self._on_progress is not None and made % PROGRESS_STEPS == 0:
                self._on_progress(made)
            yield decision

    def _carry(self) -> None:
        """Give each CAV that is on the road now a row of memory, newcomers at the end."""
        kept, entered = self.world.kept, self.world.entered
        if kept is not None:
            new = self.world.rows - len(kept)
            fresh = self.driver.initial_memory(entered) if new else {}
            self.memory = carried(self.memory, kept, fresh, new)
        if entered > len(self.memories):
            self._note_newcomers()

    def _note_newcomers(self) -> None:
        """Add the memory of each CAV that has just entered: the last rows."""
        rows = self.world.rows
        for row in range(rows - self.world.entered + len(self.memories), rows):
            self.memories.append(mapped(lambda values: np.array(values[row], np.float64), self.memory))  # noqa: B023


def _noise_of(world: World[Any], driver: Driver, explore: float) -> Noise | None:
    """Return what draws exploration noise, times `explore`, for each look of the driver's network."""
    lasting = driver.lasting_noise
    drawn = partial(world.noise, lasting) if lasting else world.noise
    if explore in (0.0, 1.0):
        return drawn if explore else None
    return lambda: explore * drawn()


def drive(
    world: World[Recorded],
    driver: Driver,
    explore: float = 0.0,
    memory: Memory | None = None,
    on_progress: OnProgress | None = None,
) -> Recorded:
    """Drive to the end, and return the world's record of it; arguments as `Drive` takes them."""
    return driven_to_the_end(Drive(world, driver, explore, memory, on_progress))


def driven_to_the_end(driving: Drive) -> Any:
    """Return the record of a world in which a driver has just begun."""
    world, driver = driving.world, driving.driver
    decisions = [
        decision[1:4] for decision in driving if decision is not None and decision.observation is not None
    ]
    last = driver.observation(world.perceive(), driving.memory)
    if last is None:
        return world.record(Driven())
    memories = [each[EXPERT] for each in driving.memories]
    return world.record(Driven(decisions, last, memories, driver.hold))
