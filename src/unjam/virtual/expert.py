"""The expert in the virtual environment: on tensors, and with what it would remember at any actual row."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.check import check_acceleration
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.virtual.data import Recording


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
        numbers = LocalState(*(values.double().cpu().numpy() for values in state))
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
    return driver if getattr(driver, "tensors", False) else ThroughNumPy(driver, torch.device(device))


def memory_on(driver: Driver, memory: Memory, device: torch.device | str) -> Memory:
    """Return NumPy `memory` as a driver of `on_tensors` takes it, in single precision on `device`."""
    if isinstance(driver, ThroughNumPy):
        return memory
    return {
        key: torch.as_tensor(values, dtype=torch.float32, device=device) for key, values in memory.items()
    }


def remembered(expert: Driver, recordings: Sequence[Recording], looks: NDArray[np.int64]) -> Memory:
    """Return what the expert remembered before each of the decisions `looks`, rows (recording, decision).

    It is driven once more over the recorded states, from the memory with which the recording began: that is
    exact for every driver, since a driver's memory depends on what it has seen alone.

    Returns:
        NumPy arrays with a row for each look.
    """
    places, rows = np.unique(looks[:, 0], return_inverse=True)
    used = [recordings[place] for place in places]
    memory = {key: np.stack([recording.memory[key] for recording in used]) for key in used[0].memory}
    found = {key: np.empty((len(looks), *values.shape[1:])) for key, values in memory.items()}
    if not found:
        return found
    last = int(looks[:, 1].max())
    steps = [np.arange(last + 1).clip(0, len(recording.applied)) for recording in used]
    states = [
        LocalState(*(values[at] for values in recording.states))
        for recording, at in zip(used, steps, strict=True)
    ]
    all_states = LocalState(*(np.stack(values, 1) for values in zip(*states, strict=True)))
    order = np.argsort(looks[:, 1], kind="stable")
    bounds = np.searchsorted(looks[order, 1], np.arange(last + 2))
    for decision in range(last + 1):
        here = order[bounds[decision] : bounds[decision + 1]]
        for key, values in memory.items():
            found[key][here] = values[rows[here]]
        if decision < last:
            _, memory = expert.act(LocalState(*(values[decision] for values in all_states)), memory)
    return found
