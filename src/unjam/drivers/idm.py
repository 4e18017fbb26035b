"""The Intelligent Driver Model at the wheel: of a CAV, and of the people around it."""

from typing import ClassVar

from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT
from unjam.physics.arrays import Array, at_least
from unjam.physics.idm import IDMParameters, idm_acceleration

SMALLEST_GAP = 0.01
"""[m]; the model divides by the gap"""


@dataclass(frozen=True, config=STRICT)
class IDM(IDMParameters, Driver):
    """A CAV that follows like an ideal human driver, without noise and within the action limit.

    Source: Treiber, Hennecke, Helbing 2000; paper Eq. 5-6 with the parameters of Table B1.
    """

    name: ClassVar[str] = "idm"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the IDM acceleration; nothing is remembered."""
        gap = at_least(state.leader_gap, SMALLEST_GAP)
        return idm_acceleration(state.speed, state.leader_speed, gap, self), memory


@dataclass(frozen=True, config=STRICT)
class Human(Driver):
    """Nobody automated: the vehicle stays one of the road's human drivers, with their noise.

    With this driver the traffic is all-human. It is the simulator that drives.
    """

    name: ClassVar[str] = "human"
    native: ClassVar[bool] = True
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what the paper's IDM would do; the simulator does not ask."""
        return IDM().act(state, memory)
