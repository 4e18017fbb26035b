"""The optimal velocity model at the wheel of a CAV."""

from math import pi
from typing import ClassVar

from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, clip, namespace


@dataclass(frozen=True, config=STRICT)
class OVM(Driver):
    """Relaxes to an optimal speed that depends on the gap, and to the leader's speed.

    Source: Bando et al. 1995, Phys. Rev. E 51:1035, with relative speed; defaults as Flow's `OVMController`.
    """

    name: ClassVar[str] = "ovm"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    gap_gain: NotNegative = 1.0
    """alpha [1/s]"""
    speed_gain: NotNegative = 1.0
    """beta [1/s]"""
    stop_gap: NotNegative = 2.0
    """h_st: gap below which the optimal speed is zero [m]"""
    go_gap: Positive = 15.0
    """h_go: gap from which on it is the largest [m]"""
    largest_speed: Positive = 30.0
    """v_max [m/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the optimal speed; nothing is remembered."""
        share = clip((state.leader_gap - self.stop_gap) / (self.go_gap - self.stop_gap), 0.0, 1.0)
        optimal = self.largest_speed / 2.0 * (1.0 - namespace(share).cos(pi * share))
        acceleration = self.gap_gain * (optimal - state.speed)
        return acceleration + self.speed_gain * (state.leader_speed - state.speed), memory
