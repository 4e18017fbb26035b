"""An ACC that drives at the mean speed of its leader: a linear expert that can be string stable."""

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, clamp_max, clamp_min, clip, namespace, stack_columns

MIN_AVERAGING_TIME = 1e-9
"""smallest averaging time, in place of zero [s]"""
BRAKING_TIME_GAP, MIN_BRAKING_DISTANCE = 1.0, 1.0
"""when braking harder than the limit: time gap [s] that remains, and smallest distance for braking [m]"""
GAP_LIMIT_TIME, MAX_CATCH_UP = 3.0, 1.5
"""at the largest gap: time constant of the critically damped approach [s], and largest acceleration [m/s2]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SmoothACC(FormulaDriver):
    """Drives at the mean speed of its leader, slightly faster or slower to keep a time gap in the long run.

    The gap absorbs the leader's oscillations. The time gap limits how much a linear controller can attenuate without
    amplifying any other frequency (Bode's integral, see `docs/controller.md`). The gap of `pi` does not grow with
    speed: therefore `pi` always amplifies some frequency. The defaults are string stable with an actuator lag of 0.3 s
    and a delay of 0.2 s.
    """

    name: ClassVar[str] = "smooth-acc"
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("mean leader speed", SPEED_SCALE, "m/s"),)

    averaging_time: NonNegative = 8.0
    """time constant of the exponential mean of the leader's speed [s]"""
    leader_weight: Annotated[float, Field(ge=0, le=1)] = 0.2
    """weight of the leader's current speed; the weight of its mean speed is 1 minus this weight"""
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
    """largest acceleration, except to keep the largest gap [m/s2]; None: the limit of the road"""
    braking_limit: Positive | None = None
    """hardest braking, unless harder braking is necessary to reach the leader's speed at a time gap of 1 s [m/s2];
    None: the limit of the road"""
    largest_gap: Positive | None = None
    """gap that the CAV does not exceed, if the leader's acceleration allows it [m]; None: no largest gap"""
    history_factor: NonNegative = 1.0
    """first mean after a warm-up, as a share of the mean in the warm-up; with a small share a gap opens first"""
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
        """Return the acceleration [m/s2] for a mean speed of the leader [m/s], both of shape (n,)."""
        excess_gap = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        catch_up = clip(self.gap_gain * excess_gap, -self.catch_up_speed, self.catch_up_speed)
        command = mean + self.leader_weight * (state.leader_speed - mean) + catch_up
        acceleration = (command - state.speed) / clamp_min(self.time_constant, self.time_step)
        return self._apply_limits(acceleration, state)

    def _apply_limits(self, acceleration: Array, state: LocalState) -> Array:
        """Return accelerations within the limits of this driver, except where a small or large gap needs more."""
        xp, (speed, leader_speed, gap, *_) = namespace(state.speed), state
        if self.acceleration_limit is not None:
            acceleration = clamp_max(acceleration, self.acceleration_limit)
        if self.braking_limit is not None:
            distance = clamp_min(gap - self.standstill_gap - BRAKING_TIME_GAP * speed, MIN_BRAKING_DISTANCE)
            braking = clamp_min(speed - leader_speed, 0.0) ** 2 / (2.0 * distance)
            acceleration = xp.maximum(acceleration, -clamp_min(braking, self.braking_limit))
        if self.largest_gap is not None:
            catch_up = (2.0 * (leader_speed - speed) + (gap - self.largest_gap) / GAP_LIMIT_TIME) / GAP_LIMIT_TIME
            acceleration = xp.maximum(acceleration, clamp_max(catch_up, MAX_CATCH_UP))
        return acceleration

    def memory_features(self, memory: Memory) -> Array:
        """Return the scaled mean leader speed, shape (n, 1)."""
        return stack_columns((memory["mean_leader_speed"] / SPEED_SCALE,))


def update_mean(mean: Array, value: Array, averaging_time: Array, time_step: float) -> Array:
    """Return the exponential mean after a step of `time_step` [s]; an unknown mean (NaN) becomes `value`."""
    xp = namespace(value)
    mean = xp.where(xp.isnan(mean), value, mean)
    averaging_time = clamp_min(averaging_time, MIN_AVERAGING_TIME)
    return mean + (1.0 - namespace(averaging_time).exp(-time_step / averaging_time)) * (value - mean)
