"""Car-following drivers of a CAV: human-like models and cruise controls."""

from math import pi
from typing import ClassVar

import numpy as np
from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import LocalState
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clamp_min, clip, namespace
from unjam.physics.idm import IDMParameters, idm_acceleration

MIN_IDM_GAP = 0.01
"""smallest gap in the Intelligent Driver Model, which divides by it [m]"""


@dataclass(frozen=True, config=STRICT)
class IDM(IDMParameters, FormulaDriver):
    """A CAV that drives like an ideal human driver, without noise and within the action limit.

    Source: Treiber, Hennecke, Helbing 2000; paper Eq. 5-6 with the parameters of Table B1.
    """

    name: ClassVar[str] = "idm"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the IDM acceleration."""
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        return idm_acceleration(state.speed, state.leader_speed, gap, self), memory


@dataclass(frozen=True, config=STRICT)
class Human(FormulaDriver):
    """The human baseline: the simulator drives the vehicle as one of its human drivers, with their noise."""

    name: ClassVar[str] = "human"
    is_native: ClassVar[bool] = True

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the paper's IDM; the simulator does not use it."""
        return IDM().act(state, memory)


@dataclass(frozen=True, config=STRICT)
class OVM(FormulaDriver):
    """Relaxes to an optimal speed that depends on the gap, and to the leader's speed.

    Source: Bando et al. 1995, Phys. Rev. E 51:1035, with relative speed; defaults as Flow's `OVMController`.
    """

    name: ClassVar[str] = "ovm"

    gap_gain: NonNegative = 1.0
    """alpha [1/s]"""
    speed_gain: NonNegative = 1.0
    """beta [1/s]"""
    stop_gap: NonNegative = 2.0
    """h_st: gap below which the optimal speed is zero [m]"""
    go_gap: Positive = 15.0
    """h_go: gap above which the optimal speed is `max_speed` [m]"""
    max_speed: Positive = 30.0
    """v_max [m/s]"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "OVM":
        if self.go_gap <= self.stop_gap:
            raise ValueError(f"go_gap: {self.go_gap:g} is not allowed; allowed: > stop_gap, {self.stop_gap:g}")
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the optimal speed."""
        share = clip((state.leader_gap - self.stop_gap) / (self.go_gap - self.stop_gap), 0.0, 1.0)
        optimal = self.max_speed / 2.0 * (1.0 - namespace(share).cos(pi * share))
        acceleration = self.gap_gain * (optimal - state.speed)
        return acceleration + self.speed_gain * (state.leader_speed - state.speed), memory


@dataclass(frozen=True, config=STRICT)
class BCM(FormulaDriver):
    """Controls towards equal gaps and equal relative speeds ahead and behind, and towards a desired speed.

    If all vehicles use it, waves cannot grow; this does not hold for one CAV among human drivers.
    Source: Horn and Wang 2017, IEEE Trans. Intell. Transp. Syst. 19(10); defaults as Flow's `BCMController`.
    """

    name: ClassVar[str] = "bcm"

    gap_gain: NonNegative = 1.0
    """k_d [1/s2]"""
    speed_gain: NonNegative = 1.0
    """k_v [1/s]"""
    desired_speed_gain: NonNegative = 1.0
    """k_c [1/s]"""
    desired_speed: NonNegative = 8.0
    """[m/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the bilateral acceleration."""
        speed = state.speed
        between = (state.leader_speed - speed) - (speed - state.follower_speed)
        acceleration = (
            self.gap_gain * (state.leader_gap - state.follower_gap)
            + self.speed_gain * between
            + self.desired_speed_gain * (self.desired_speed - speed)
        )
        return acceleration, memory


@dataclass(frozen=True, config=STRICT)
class ACC(FormulaDriver):
    """Keeps a constant time gap to the leader, and never drives faster than its set speed.

    The defaults were fitted to production cars. Source: Milanés and Shladover 2014, Transp. Res. C 48:285-300,
    Eq. 4 and 5.
    """

    name: ClassVar[str] = "acc"

    time_gap: Positive = 1.1
    """desired time gap [s]"""
    standstill_gap: NonNegative = 2.0
    """desired gap at standstill [m]"""
    set_speed: Positive = 30.0
    """speed on a free road [m/s]"""
    gap_gain: NonNegative = 0.23
    """acceleration per meter of excess gap [1/s2]"""
    speed_gain: NonNegative = 0.07
    """acceleration per m/s of relative speed of the leader [1/s]"""
    set_speed_gain: NonNegative = 0.4
    """acceleration per m/s below the set speed [1/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the smaller of the accelerations for following and for free driving."""
        excess = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        following = self.gap_gain * excess + self.speed_gain * (state.leader_speed - state.speed)
        free = self.set_speed_gain * (self.set_speed - state.speed)
        return namespace(state.speed).minimum(following, free), memory


@dataclass(frozen=True, config=STRICT)
class LACC(FormulaDriver):
    """Linear adaptive cruise control whose acceleration follows its command with a lag.

    Source: Rajamani 2012, Vehicle Dynamics and Control, chapter 6; the defaults are those of Flow's
    `LACController`, which also subtracts a vehicle length from the gap (here `standstill_gap`).
    """

    name: ClassVar[str] = "lacc"

    gap_gain: NonNegative = 0.3
    """k_1 [1/s2]"""
    speed_gain: NonNegative = 0.4
    """k_2 [1/s]"""
    time_gap: NonNegative = 1.0
    """h [s]"""
    standstill_gap: NonNegative = 5.0
    """desired gap at standstill [m]"""
    lag: Positive = 0.1
    """tau: time constant with which the acceleration follows the command [s]"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return zero accelerations."""
        return {"acceleration": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the lagged acceleration, which is also the memory."""
        excess = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        command = self.gap_gain * excess + self.speed_gain * (state.leader_speed - state.speed)
        share = min(1.0, self.time_step / self.lag)  # a step longer than the lag reaches the command
        acceleration = memory["acceleration"] + share * (command - memory["acceleration"])
        return acceleration, {"acceleration": acceleration}


@dataclass(frozen=True, config=STRICT)
class Constant(FormulaDriver):
    """Commands the same acceleration in every step; only SUMO's own safety check prevents a collision."""

    name: ClassVar[str] = "constant"

    acceleration: float = 0.0
    """[m/s2]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the constant."""
        return state.speed * 0.0 + self.acceleration, memory
