"""Bilateral control: keep the middle between the vehicle ahead and the one behind."""

from typing import ClassVar

from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT, NotNegative
from unjam.physics.arrays import Array


@dataclass(frozen=True, config=STRICT)
class BCM(Driver):
    """Steers towards equal gaps and equal relative speeds ahead and behind, and towards a desired speed.

    Where all drive so, waves cannot grow; one among people is another matter.
    Source: Horn and Wang 2017, IEEE Trans. Intell. Transp. Syst. 19(10); defaults as Flow's `BCMController`.
    """

    name: ClassVar[str] = "bcm"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    gap_gain: NotNegative = 1.0
    """k_d [1/s2]"""
    speed_gain: NotNegative = 1.0
    """k_v [1/s]"""
    desired_speed_gain: NotNegative = 1.0
    """k_c [1/s]"""
    desired_speed: NotNegative = 8.0
    """[m/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the bilateral acceleration; nothing is remembered."""
        speed = state.speed
        between = (state.leader_speed - speed) - (speed - state.follower_speed)
        acceleration = (
            self.gap_gain * (state.leader_gap - state.follower_gap)
            + self.speed_gain * between
            + self.desired_speed_gain * (self.desired_speed - speed)
        )
        return acceleration, memory
