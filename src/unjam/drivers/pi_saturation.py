"""PI with saturation (Stern et al. 2018): the traffic expert of the paper, Eq. 9-11."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import model_validator

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.drivers.speed_history import empty_window, fill_window, slide_window, window_mean_speed
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, clamp_min, clip, namespace, stack_columns


@parameter_dataclass(frozen=True, config=STRICT)
class PISaturation(FormulaDriver):
    """Drives at the mean of its own speed, slightly faster behind a large gap, and at the leader's speed when close.

    The defaults are Table B2 of the paper, except `time_constant`. The paper divides the desired change of speed by
    the time step (`pi:time_constant=0`). Close behind a leader, the CAV then stops and starts with its leader, never
    opens a gap, and remains part of the wave in a fully developed jam. With a time constant of 3 s, the same controller
    dissolves most waves.
    Source: Stern et al. 2018, Transp. Res. C 89:205-221; paper Eq. 9-11.
    """

    name: ClassVar[str] = "pi"
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (
        ScaledInput("mean own speed", SPEED_SCALE, "m/s"),
        ScaledInput("commanded speed", SPEED_SCALE, "m/s"),
    )

    window: Positive = 38.0
    """time over which the own speed is averaged [s]"""
    catch_up_speed: NonNegative = 1.0
    """v_c: speed above the mean behind a large gap [m/s]"""
    gap_lower: NonNegative = 7.0
    """s_l: gap above which it drives faster than the mean [m]"""
    gap_upper: Positive = 30.0
    """s_u: gap above which it drives faster than the mean by `catch_up_speed` [m]"""
    safe_gap: NonNegative = 4.0
    """dx_s: gap below which it drives at the leader's speed [m]"""
    safe_gap_rule: Literal["constant", "closing"] = "constant"
    """`constant` as in the paper; `closing`: max(2 s (v_lead - v), safe_gap), as in Stern et al. and Flow"""
    time_constant: NonNegative = 3.0
    """time constant of the approach to the command [s]; 0: one time step, as in the paper"""
    first_command: Literal["own-speed", "zero"] = "own-speed"
    """commanded speed before the first step; Flow starts with zero"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "PISaturation":
        if self.gap_upper <= self.gap_lower:
            raise ValueError(f"gap_upper: {self.gap_upper:g} is not allowed; allowed: > gap_lower, {self.gap_lower:g}")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return an empty window, and an unknown commanded speed (NaN) or the commanded speed zero."""
        first_command = np.nan if self.first_command == "own-speed" else 0.0
        return {**empty_window(n, self.window, self.time_step), "command": np.full(n, first_command)}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the own speeds from the warm-up in its window."""
        return {**memory, **fill_window(memory, history.speed)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed of Eq. 10, and the new memory."""
        xp, window = namespace(state.speed), slide_window(memory, state.speed)
        mean, initial_speed_memory = self._target_mean(window_mean_speed(window), state, memory)
        command = xp.where(xp.isnan(memory["command"]), state.speed, memory["command"])
        gap_share = (state.leader_gap - self.gap_lower) / (self.gap_upper - self.gap_lower)
        target = mean + self.catch_up_speed * clip(gap_share, 0.0, 1.0)
        safe_gap = self.safe_gap
        if self.safe_gap_rule == "closing":
            safe_gap = clamp_min(2.0 * (state.leader_speed - state.speed), self.safe_gap)
        alpha = clip((state.leader_gap - safe_gap) / 2.0, 0.0, 1.0)
        beta = 1.0 - 0.5 * alpha
        command = beta * (alpha * target + (1.0 - alpha) * state.leader_speed) + (1.0 - beta) * command
        acceleration = (command - state.speed) / max(self.time_constant, self.time_step)
        return acceleration, {**window, "command": command, **initial_speed_memory}

    def _target_mean(self, mean: Array, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the mean speed in Eq. 9, given the mean of the window; and the memory of the initial speed."""
        return mean, {}

    def memory_features(self, memory: Memory) -> Array:
        """Return the scaled mean own speed, and the scaled commanded speed, shape (n, 2)."""
        mean = window_mean_speed(memory)
        return stack_columns((mean / SPEED_SCALE, memory["command"] / SPEED_SCALE))


@parameter_dataclass(frozen=True, config=STRICT)
class PIFromGap(PISaturation):
    """PI with saturation; its mean speed starts with the speed of human drivers at its first gap.

    `pi` starts slowly, because its mean starts with the speed zero of a stopped vehicle. If human drivers stand at
    equal gaps, the own gap determines the speed at which all vehicles can drive. After a warm-up the mean starts with a
    share of the observed mean speed: a CAV that is slower at first opens a gap that absorbs a wave.
    """

    name: ClassVar[str] = "pi-from-gap"

    human_time_headway: Positive = 1.0
    """time headway T of human drivers [s]"""
    human_standstill_gap: NonNegative = 2.0
    """gap of human drivers at standstill [m]"""
    fade_time: Positive = 40.0
    """time in which the weight of the initial speed in the mean decreases from 1 to 0 [s]"""
    history_factor: NonNegative = 1.0
    """initial speed after a warm-up, as a share of the mean speed in the warm-up"""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `pi`, with an unknown initial speed (NaN)."""
        return {**super().initial_memory(n), "initial_speed": np.full(n, np.nan), "steps": np.zeros(n)}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the own speeds from the warm-up in its window, and the initial speed after a warm-up."""
        memory = super().recall(memory, history)
        return {**memory, "initial_speed": self.history_factor * window_mean_speed(memory)}

    def _target_mean(self, mean: Array, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the weighted mean of initial speed and mean of the window, and the new entries of the memory."""
        xp = namespace(state.speed)
        human_speed = clamp_min((state.leader_gap - self.human_standstill_gap) / self.human_time_headway, 0.0)
        initial_speed = xp.where(xp.isnan(memory["initial_speed"]), human_speed, memory["initial_speed"])
        weight = clip(1.0 - memory["steps"] * (self.time_step / self.fade_time), 0.0, 1.0)
        mean = mean + weight * (initial_speed - mean)
        return mean, {"initial_speed": initial_speed, "steps": memory["steps"] + 1.0}
