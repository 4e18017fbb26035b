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
        """Start the world; noise is multiplied by `explore`, and `memory` replaces the driver's initial one."""
        self.world, self.driver, self._on_progress = world, driver, on_progress
        size = driver.episode_noise_size
        draw = partial(world.noise, size) if size else world.noise
        scaled = draw if explore == 1.0 else lambda: explore * draw()
        self._draw_noise: NoiseSampler | None = scaled if explore else None
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
        """Yield each decision after it was carried out; None where the simulator itself drives."""
        world, driver, noise, steps = self.world, self.driver, self._draw_noise, 0
        local_state, decide, advance = world.local_state, driver.decide, world.advance
        try:
            while not world.has_ended:
                if driver.is_driven_by_simulator:
                    decision = None
                    advance(None)
                else:
                    state = local_state()
                    with ForkGuard():
                        decision = decide(state, self.memory, noise)
                    self.memory = decision.memory
                    advance(decision.command)
                if world.remaining_rows is not None or world.entered_count > len(self.initial_memories):
                    self._update_memory()
                steps += 1
                if self._on_progress is not None and steps % PROGRESS_CONTROL_STEPS == 0:
                    self._on_progress(steps)
                yield decision
        except RowError as error:
            raise _naming_cav(error, world) from None

    def observe(self) -> Any:
        """Return the driver's current network input, as `Driver.observation`."""
        try:
            return self.driver.observation(self.world.local_state(), self.memory)
        except RowError as error:
            raise _naming_cav(error, self.world) from None

    def _update_memory(self) -> None:
        """Give each CAV on the road a row of memory, new CAVs at the end."""
        rows, entered = self.world.remaining_rows, self.world.entered_count
        if rows is not None:
            new = self.world.cav_count - len(rows)
            fresh = self.driver.initial_memory(entered) if new else {}
            self.memory = carry_over_memory(self.memory, rows, fresh, new)
        if entered > len(self.initial_memories):
            self._store_initial_memories()

    def _store_initial_memories(self) -> None:
        """Store the memory of each CAV that has just entered: the last rows."""
        rows = self.world.cav_count
        for row in range(rows - self.world.entered_count + len(self.initial_memories), rows):
            self.initial_memories.append(map_leaves(lambda values: np.array(values[row], np.float64), self.memory))  # noqa: B023


def _naming_cav(error: RowError, world: Any) -> InputError:
    """Return an error that also names the CAV and the step, if the world has names of CAVs."""
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
    """Drive to the end, and return the world's record; arguments as in `DriveLoop`."""
    return finish_drive(DriveLoop(world, driver, explore, memory, on_progress))


def finish_drive(drive_loop: DriveLoop) -> Any:
    """Drive to the end of a loop that has just been created, and return the world's record."""
    world, driver = drive_loop.world, drive_loop.driver
    decisions = [decision[1:4] for decision in drive_loop if decision is not None and decision.observation is not None]
    last = drive_loop.observe()
    if last is None:
        return world.record(DriverLog())
    memories = [initial_memory[EXPERT_KEY] for initial_memory in drive_loop.initial_memories]
    return world.record(DriverLog(decisions, last, memories, driver.action_repeat))
