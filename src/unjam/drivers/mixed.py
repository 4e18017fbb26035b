"""Several drivers side by side: different experts in different CAVs of the same road."""

from dataclasses import dataclass

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.physics.arrays import Array, namespace

KIND = "kind"
"""name in the memory of which driver a CAV has"""


@dataclass(frozen=True)
class Mixed(Driver):
    """Gives the CAVs different drivers: the first CAV has the first driver, the next the next, and so on.

    After the last driver it begins anew; where CAVs come and go, they are counted as they enter.
    """

    drivers: tuple[Driver, ...]

    def __post_init__(self) -> None:
        """Raise `InputError` where one of them is the simulator itself."""
        for driver in self.drivers:
            if driver.native:
                raise InputError("driver: 'human' is not allowed among several; idm drives like people")

    @property
    def tensors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all of them take tensors."""
        return all(getattr(driver, "tensors", False) for driver in self.drivers)

    @property
    def needs_loop(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether one of them must know its place on a closed road."""
        return any(driver.needs_loop for driver in self.drivers)

    def initial_memory(self, n: int) -> Memory:
        """Return which driver each CAV has, and what all drivers would remember of it."""
        memory: Memory = {KIND: np.arange(n, dtype=np.float64) % len(self.drivers)}
        for number, driver in enumerate(self.drivers):
            memory |= _named(number, driver.initial_memory(n))
        return memory

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what all drivers make of the warm-up."""
        recalled = {KIND: memory[KIND]}
        for number, driver in enumerate(self.drivers):
            recalled |= _named(number, driver.recall(_of(number, memory), history))
        return recalled

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration that each CAV's own driver wants, and the new memory."""
        after = {KIND: memory[KIND]}
        chosen = None
        for number, driver in enumerate(self.drivers):
            wanted, remembered = driver.act(state, _of(number, memory))
            after |= _named(number, remembered)
            mine = memory[KIND] == number
            chosen = wanted if chosen is None else namespace(wanted).where(mine, wanted, chosen)
        return chosen, after


def _named(number: int, memory: Memory) -> Memory:
    return {f"{number}.{name}": rows for name, rows in memory.items()}


def _of(number: int, memory: Memory) -> Memory:
    prefix = f"{number}."
    return {name.removeprefix(prefix): rows for name, rows in memory.items() if name.startswith(prefix)}
