"""The expert in the virtual environment: on tensors, and with what it would remember at any actual row."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.check import check_acceleration
from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.tree import mapped
from unjam.virtual.data import Recording
from unjam.worlds.drive import Drive
from unjam.worlds.world import RecordedWorld


@dataclass(frozen=True)
class ThroughNumPy(Driver):
    """A driver that knows nothing of tensors, asked through NumPy; its memory stays NumPy's."""

    tensors: ClassVar[bool] = True

    driver: Driver
    device: torch.device
    """where the world is"""

    def initial_memory(self, n: int) -> Memory:
        """Return the driver's."""
        return self.driver.initial_memory(n)

    def act(self, state: LocalState, memory: Memory) -> tuple[Tensor, Memory]:
        """Return the driver's acceleration as a tensor, and its memory.

        Raises:
            InputError: the acceleration is not finite or of a wrong shape.
        """
        numbers = state.each(lambda values: values.double().cpu().numpy())
        answer, memory = self.driver.act(numbers, memory)
        acceleration = check_acceleration(answer, len(state.speed), "virtual environment")
        return self._tensor(acceleration), memory

    def memory_features(self, memory: Memory) -> Tensor | None:
        """Return the driver's features as a tensor."""
        features = self.driver.memory_features(memory)
        return None if features is None else self._tensor(np.asarray(features))

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)


def on_tensors(driver: Driver, device: torch.device | str) -> Driver:
    """Return a driver that takes tensors on `device`: the same, or the same through NumPy."""
    return driver if driver.tensors else ThroughNumPy(driver, torch.device(device))


def memory_on(driver: Driver, memory: Memory, device: torch.device | str) -> Memory:
    """Return NumPy `memory` as a driver of `on_tensors` takes it, in single precision on `device`."""
    if isinstance(driver, ThroughNumPy):
        return memory
    return mapped(lambda values: torch.as_tensor(values, dtype=torch.float32, device=device), memory)


def remembered(expert: Driver, recordings: Sequence[Recording], looks: NDArray[np.int64]) -> Memory:
    """Return what the expert remembered before each of the decisions `looks`, rows (recording, decision).

    It is driven once more over the recorded states, from the memory with which the recording began: that is
    exact for every driver, since a driver's memory depends on what it has seen alone.

    Returns:
        NumPy arrays with a row for each look.
    """
    places, rows = np.unique(looks[:, 0], return_inverse=True)
    used = [recordings[place] for place in places]
    memory = mapped(lambda *each: np.stack(each), *(recording.memory for recording in used))
    found = mapped(lambda values: np.empty((len(looks), *values.shape[1:])), memory)
    if not found:
        return found
    last = int(looks[:, 1].max())
    steps = [np.arange(last).clip(0, len(recording.applied)) for recording in used]
    states = [kept.states.each(lambda values: values[at]) for kept, at in zip(used, steps, strict=True)]  # noqa: B023
    order = np.argsort(looks[:, 1], kind="stable")
    bounds = np.searchsorted(looks[order, 1], np.arange(last + 2))

    def note(decision: int, memory: Memory) -> None:
        here = order[bounds[decision] : bounds[decision + 1]]
        if len(here):
            mapped(lambda into, values: into.__setitem__(here, values[rows[here]]), found, memory)

    note(0, memory)
    world = RecordedWorld(states[0].each(lambda *each: np.stack(each, 1), *states[1:]), Limits(-inf, inf))
    for decision, done in enumerate(Drive(world, expert, memory=memory), start=1):
        note(decision, done.memory if done else memory)
    return found
