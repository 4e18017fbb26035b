"""An ACC that follows the mean speed of its leader: the linear expert that can be string stable."""

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, clamp_max, clamp_min, clip, namespace, stack_columns

MIN_AVERAGING = 1e-9
"""averaging time that stands for none [s]"""
FREE_TIME_GAP, MIN_ROOM = 1.0, 1.0
"""time gap [s] that is kept free when a braking beyond the limit is computed, and smallest room for it [m]"""
GAP_LIMIT_TIME, MAX_CATCH_UP = 3.0, 1.5
"""time constant of the critically damped approach to the largest gap [s], and acceleration that keeps it [m/s2]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SmoothACC(FormulaDriver):
    """Drives at the mean speed of its leader, slightly faster or slower to keep a time gap in the long run.

    The gap absorbs what the leader oscillates. How much a linear controller can attenuate without amplifying any
    other frequency is limited by its time gap (Bode's integral, see `docs/controller.md`): `pi`, whose gap does not
    grow with speed, always amplifies some frequency. The defaults are string stable with an actuator lag of 0.3 s and
    a delay of 0.2 s.
    """

    name: ClassVar[str] = "smooth-acc"
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("mean leader speed", SPEED_SCALE, "m/s"),)

    averaging_time: NonNegative = 8.0
    """time constant of the exponential mean of the leader's speed [s]"""
    leader_weight: Annotated[float, Field(ge=0, le=1)] = 0.2
    """weight of the leader's present speed; the mean has the rest"""
    time_gap: NonNegative = 6.0
    """time gap in the long run [s]"""
    standstill_gap: NonNegative = 2.0
    """gap in the long run at standstill [m]"""
    gap_gain: NonNegative = 0.2
    """speed above the mean per meter of excess gap [1/s]"""
    catch_up_speed: Positive = 3.0
    """largest difference to the mean speed because of the gap [m/s]"""
    time_constant: NonNegative = 1.5
    """time constant of the approach to the commanded speed [s]; 0: one time step"""
    acceleration_limit: Positive | None = None
    """largest acceleration, except to keep the largest gap [m/s2]; None: that of the road"""
    braking_limit: Positive | None = None
    """hardest braking, unless it must be harder to reach the leader's speed at a time gap of 1 s [m/s2];
    None: that of the road"""
    largest_gap: Positive | None = None
    """gap that it does not exceed, if the leader's acceleration allows it [m]; None: any"""
    history_factor: NonNegative = 1.0
    """share of the mean in the warm-up that is the first mean: with a smaller one it first opens a gap"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return an unknown mean (NaN)."""
        return {"mean_leader_speed": np.full(n, np.nan)}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with a share of the mean of the leader's speeds in the warm-up."""
        mean = memory["mean_leader_speed"]
        for step in range(history.leader_speed.shape[1]):
            mean = update_mean(mean, history.leader_speed[:, step], self.averaging_time, self.time_step)
        return {"mean_leader_speed": self.history_factor * mean}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed, and the new memory."""
        mean = update_mean(memory["mean_leader_speed"], state.leader_speed, self.averaging_time, self.time_step)
        return self.acceleration_from_mean(mean, state), {"mean_leader_speed": mean}

    def acceleration_from_mean(self, mean: Array, state: LocalState) -> Array:
        """Return the acceleration [m/s2] with a mean speed of the leader [m/s], shapes (n,)."""
        excess_gap = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        catch_up = clip(self.gap_gain * excess_gap, -self.catch_up_speed, self.catch_up_speed)
        command = mean + self.leader_weight * (state.leader_speed - mean) + catch_up
        acceleration = (command - state.speed) / clamp_min(self.time_constant, self.time_step)
        return self._within_limits(acceleration, state)

    def _within_limits(self, acceleration: Array, state: LocalState) -> Array:
        """Return accelerations within the own limits, beyond which only the gaps matter."""
        xp, (speed, leader_speed, gap, *_) = namespace(state.speed), state
        if self.acceleration_limit is not None:
            acceleration = clamp_max(acceleration, self.acceleration_limit)
        if self.braking_limit is not None:
            room = clamp_min(gap - self.standstill_gap - FREE_TIME_GAP * speed, MIN_ROOM)
            braking = clamp_min(speed - leader_speed, 0.0) ** 2 / (2.0 * room)
            acceleration = xp.maximum(acceleration, -clamp_min(braking, self.braking_limit))
        if self.largest_gap is not None:
            catch_up = (2.0 * (leader_speed - speed) + (gap - self.largest_gap) / GAP_LIMIT_TIME) / GAP_LIMIT_TIME
            acceleration = xp.maximum(acceleration, clamp_max(catch_up, MAX_CATCH_UP))
        return acceleration

    def memory_features(self, memory: Memory) -> Array:
        """Return the mean leader speed, scaled, shape (n, 1)."""
        return stack_columns((memory["mean_leader_speed"] / SPEED_SCALE,))


def update_mean(mean: Array, value: Array, averaging_time: Array, time_step: float) -> Array:
    """Return the exponential mean after a step [s]; an unknown mean (NaN) becomes the value."""
    xp = namespace(value)
    mean = xp.where(xp.isnan(mean), value, mean)
    time = clamp_min(averaging_time, MIN_AVERAGING)
    return mean + (1.0 - namespace(time).exp(-time_step / time)) * (value - mean)
