"""A constant acceleration: the simplest driver, and a baseline that some learned ones do not reach."""

from typing import ClassVar

from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT
from unjam.physics.arrays import Array


@dataclass(frozen=True, config=STRICT)
class Constant(Driver):
    """Asks for the same acceleration in every step; only the shield keeps it from the car ahead."""

    name: ClassVar[str] = "constant"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    acceleration: float = 0.0
    """[m/s2]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the constant; nothing is remembered."""
        return state.speed * 0.0 + self.acceleration, memory
