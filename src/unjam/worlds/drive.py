"""The loop in which a driver drives the CAVs of a world."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler, carry_over_memory, scalar_memory
from unjam.drivers.residual import EXPERT_KEY
from unjam.errors import InputError, RowError
from unjam.processes import ForkGuard
from unjam.tree import map_leaves
from unjam.worlds.world import DriverLog, ProgressCallback, RecordT, World

PROGRESS_CONTROL_STEPS = 10


class DriveLoop:
    """An iterator over the control steps of a driver in a world."""

    def __init__(
        self,
        world: World[RecordT],
        driver: Driver,
        explore: float = 0.0,
        memory: Memory | None = None,
        on_progress: ProgressCallback | None = None,
    ) -> None:
        """Start the world; `explore` scales the noise, and `memory` replaces the initial memory of the driver."""
        self.world, self.driver, self._on_progress = world, driver, on_progress
        noise_size = driver.episode_noise_size
        draw = partial(world.noise, noise_size) if noise_size else world.noise
        draw_scaled = draw if explore == 1.0 else lambda: explore * draw()
        self._draw_noise: NoiseSampler | None = draw_scaled if explore else None
        history = world.start(not driver.is_driven_by_simulator, on_progress)
        self.memory = driver.initial_memory(world.cav_count) if memory is None else memory
        if history is not None:
            self.memory = driver.recall(self.memory, history)
        self.initial_memories: list[Memory] = []
        """memory of each CAV before its first control step, in order of entry"""
        self._store_initial_memories()
        if world.is_scalar:
            self.memory = scalar_memory(self.memory)

    def __iter__(self) -> Iterator[Decision | None]:
        """Yield the decision of each control step after it was carried out; None if the simulator drives."""
        world, driver, draw_noise, control_steps = self.world, self.driver, self._draw_noise, 0
        local_state, decide, advance = world.local_state, driver.decide, world.advance
        try:
            while not world.has_ended:
                if driver.is_driven_by_simulator:
                    decision = None
                    advance(None)
                else:
                    state = local_state()
                    with ForkGuard():
                        decision = decide(state, self.memory, draw_noise)
                    self.memory = decision.memory
                    advance(decision.command)
                if world.remaining_rows is not None or world.entered_count > len(self.initial_memories):
                    self._update_memory()
                control_steps += 1
                if self._on_progress is not None and control_steps % PROGRESS_CONTROL_STEPS == 0:
                    self._on_progress(control_steps)
                yield decision
        except RowError as error:
            raise _error_of_cav(error, world) from None

    def observe(self) -> Any:
        """Return the observation of the driver in the current state; see `Driver.observation`."""
        try:
            return self.driver.observation(self.world.local_state(), self.memory)
        except RowError as error:
            raise _error_of_cav(error, self.world) from None

    def _update_memory(self) -> None:
        """Keep the rows of memory of the remaining CAVs, and append a row for each new CAV."""
        rows, entered = self.world.remaining_rows, self.world.entered_count
        if rows is not None:
            new_count = self.world.cav_count - len(rows)
            initial_memory = self.driver.initial_memory(entered) if new_count else {}
            self.memory = carry_over_memory(self.memory, rows, initial_memory, new_count)
        if entered > len(self.initial_memories):
            self._store_initial_memories()

    def _store_initial_memories(self) -> None:
        """Store the memory of each CAV that has just entered; these CAVs have the last rows."""
        count = self.world.cav_count
        for row in range(count - self.world.entered_count + len(self.initial_memories), count):
            self.initial_memories.append(map_leaves(lambda values: np.array(values[row], np.float64), self.memory))  # noqa: B023


def _error_of_cav(error: RowError, world: Any) -> InputError:
    """Return the error of a row with the id of its CAV and the control step, if the world has ids of CAVs."""
    if not hasattr(world, "cav_ids"):
        return error
    return InputError(f"{error} ({world.cav_ids[error.row]}, step {world.control_steps})")


def drive_world(
    world: World[RecordT],
    driver: Driver,
    explore: float = 0.0,
    memory: Memory | None = None,
    on_progress: ProgressCallback | None = None,
) -> RecordT:
    """Drive until the world ends, and return its record; the arguments are those of `DriveLoop`."""
    return finish_drive(DriveLoop(world, driver, explore, memory, on_progress))


def finish_drive(drive_loop: DriveLoop) -> Any:
    """Drive a new loop until its world ends, and return the record of the world."""
    world, driver = drive_loop.world, drive_loop.driver
    decisions = [decision[1:4] for decision in drive_loop if decision is not None and decision.observation is not None]
    last_observation = drive_loop.observe()
    if last_observation is None:
        return world.record(DriverLog())
    memories = [initial_memory[EXPERT_KEY] for initial_memory in drive_loop.initial_memories]
    return world.record(DriverLog(decisions, last_observation, memories, driver.action_repeat))
