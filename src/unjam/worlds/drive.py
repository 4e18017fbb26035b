"""Driving: the one loop in which a driver and a world meet."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler, carry_over_memory, scalar_memory
from unjam.drivers.residual import EXPERT_KEY
from unjam.tree import map_leaves
from unjam.worlds.world import DriverLog, ProgressCallback, RecordT, World

PROGRESS_CONTROL_STEPS = 10
"""decisions between two reports of progress"""


class DriveLoop:
    """A driver in a world, decision by decision: iterate over it."""

    def __init__(
        self,
        world: World[RecordT],
        driver: Driver,
        explore: float = 0.0,
        memory: Memory | None = None,
        on_progress: ProgressCallback | None = None,
    ) -> None:
        """Start the world; nothing is decided yet.

        What was learned adds its noise times `explore`. Without a `memory` the driver remembers nothing but
        what the world began with. `on_progress` is called now and then with the number of decisions made.
        """
        self.world, self.driver, self._on_progress = world, driver, on_progress
        self._draw_noise = _noise_function(world, driver, explore)
        history = world.start(not driver.is_native, on_progress)
        self.memory = driver.initial_memory(world.cav_count) if memory is None else memory
        if history is not None:
            self.memory = driver.recall(self.memory, history)
        self.initial_memories: list[Memory] = []
        """of each CAV by itself before its first decision, in order of entry"""
        self._store_initial_memories()
        if world.is_scalar:
            self.memory = scalar_memory(self.memory)

    def __iter__(self) -> Iterator[Decision | None]:
        """Yield each decision once it is carried out; None where the simulator itself drives."""
        world, driver, noise, made = self.world, self.driver, self._draw_noise, 0
        perceive, decide, advance = world.local_state, driver.decide, world.advance
        while not world.has_ended:
            if driver.is_native:
                decision = None
                advance(None)
            else:
                decision = decide(perceive(), self.memory, noise)
                self.memory = decision.memory
                advance(decision.command)
            if world.remaining_rows is not None or world.entered_count > len(self.initial_memories):
                self._update_memory()
            made += 1
            if self._on_progress is not None and made % PROGRESS_CONTROL_STEPS == 0:
                self._on_progress(made)
            yield decision

    def _update_memory(self) -> None:
        """Give each CAV that is on the road now a row of memory, newcomers at the end."""
        kept, entered = self.world.remaining_rows, self.world.entered_count
        if kept is not None:
            new = self.world.cav_count - len(kept)
            fresh = self.driver.initial_memory(entered) if new else {}
            self.memory = carry_over_memory(self.memory, kept, fresh, new)
        if entered > len(self.initial_memories):
            self._store_initial_memories()

    def _store_initial_memories(self) -> None:
        """Add the memory of each CAV that has just entered: the last rows."""
        rows = self.world.cav_count
        for row in range(rows - self.world.entered_count + len(self.initial_memories), rows):
            self.initial_memories.append(map_leaves(lambda values: np.array(values[row], np.float64), self.memory))  # noqa: B023


def _noise_function(world: World[Any], driver: Driver, explore: float) -> NoiseSampler | None:
    """Return what draws exploration noise, times `explore`, for each look of the driver's network."""
    lasting = driver.episode_noise_size
    drawn = partial(world.noise, lasting) if lasting else world.noise
    if explore in (0.0, 1.0):
        return drawn if explore else None
    return lambda: explore * drawn()


def drive_world(
    world: World[RecordT],
    driver: Driver,
    explore: float = 0.0,
    memory: Memory | None = None,
    on_progress: ProgressCallback | None = None,
) -> RecordT:
    """Drive to the end, and return the world's record of it; arguments as `Drive` takes them."""
    return finish_drive(DriveLoop(world, driver, explore, memory, on_progress))


def finish_drive(drive_loop: DriveLoop) -> Any:
    """Return the record of a world in which a driver has just begun."""
    world, driver = drive_loop.world, drive_loop.driver
    decisions = [decision[1:4] for decision in drive_loop if decision is not None and decision.observation is not None]
    last = driver.observation(world.local_state(), drive_loop.memory)
    if last is None:
        return world.record(DriverLog())
    memories = [each[EXPERT_KEY] for each in drive_loop.initial_memories]
    return world.record(DriverLog(decisions, last, memories, driver.action_repeat))
