"""Adaptive cruise control with a constant time gap, as sold in cars, and its lagged linear form."""

from typing import ClassVar

import numpy as np
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, namespace


@dataclass(frozen=True, config=STRICT)
class ACC(Driver):
    """Keeps a constant time gap to the leader, and never drives faster than its set speed.

    The defaults are those fitted to production cars. Source: Milanés and Shladover 2014, Transp. Res. C
    48:285-300, Eq. 4 and 5.
    """

    name: ClassVar[str] = "acc"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    time_gap: Positive = 1.1
    """wanted gap over own speed [s]"""
    standstill_gap: NotNegative = 2.0
    """wanted gap of a standing vehicle [m]"""
    set_speed: Positive = 30.0
    """speed on a free road [m/s]"""
    gap_gain: NotNegative = 0.23
    """acceleration for each metre of gap too much [1/s2]"""
    speed_gain: NotNegative = 0.07
    """acceleration for each m/s that the leader is faster [1/s]"""
    free_gain: NotNegative = 0.4
    """acceleration for each m/s below the set speed [1/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the smaller of following and free driving; nothing is remembered."""
        excess = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        following = self.gap_gain * excess + self.speed_gain * (state.leader_speed - state.speed)
        free = self.free_gain * (self.set_speed - state.speed)
        return namespace(state.speed).minimum(following, free), memory


@dataclass(frozen=True, config=STRICT)
class LACC(Driver):
    """Linear adaptive cruise control whose acceleration follows its command with a lag.

    Source: Rajamani 2012, Vehicle Dynamics and Control, chapter 6; the defaults are those of Flow's
    `LACController`, which also subtracts a vehicle length from the gap (here `standstill_gap`).
    """

    name: ClassVar[str] = "lacc"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True

    gap_gain: NotNegative = 0.3
    """k_1 [1/s2]"""
    speed_gain: NotNegative = 0.4
    """k_2 [1/s]"""
    time_gap: NotNegative = 1.0
    """h [s]"""
    standstill_gap: NotNegative = 5.0
    """wanted gap of a standing vehicle [m]"""
    lag: Positive = 0.1
    """tau: time after which the acceleration has come near the command [s]"""
    time_step: Positive = 0.1
    """time between two decisions [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return zero accelerations."""
        return {"acceleration": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the lagged acceleration, and remember it."""
        excess = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        command = self.gap_gain * excess + self.speed_gain * (state.leader_speed - state.speed)
        share = min(1.0, self.time_step / self.lag)  # a step longer than the lag reaches the command
        acceleration = memory["acceleration"] + share * (command - memory["acceleration"])
        return acceleration, {"acceleration": acceleration}
