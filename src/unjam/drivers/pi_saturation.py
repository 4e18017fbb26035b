"""PI with saturation (Stern et al. 2018): the paper's traffic expert, Eq. 9-11."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.drivers.speed_history import empty_window, fill_window, slide_window, window_mean_speed
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clamp_min, clip, namespace, stack_columns


@dataclass(frozen=True, config=STRICT)
class PISaturation(FormulaDriver):
    """Drives at the mean of its own speed, a little faster behind a large gap, and yields when close.

    The defaults are Table B2 of the paper, but for `time_constant`. The paper divides the wanted change of
    speed by the time step. Close behind a leader that makes the CAV its copy: it stops and starts with
    it, never opens a gap, and in a fully grown jam stays part of the wave. Spread over 3 s, the same
    controller dissolves the wave. `pi:time_constant=0` is the paper's.
    Source: Stern et al. 2018, Transp. Res. C 89:205-221; paper Eq. 9-11.
    """

    name: ClassVar[str] = "pi"
    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (
        ScaledInput("mean own speed", SPEED_SCALE, "m/s"),
        ScaledInput("commanded speed", SPEED_SCALE, "m/s"),
    )

    window: Positive = 38.0
    """time over which the own speed is averaged [s]"""
    catch_up_speed: NonNegative = 1.0
    """v_c: speed beyond the mean where the gap is large [m/s]"""
    gap_lower: NonNegative = 7.0
    """s_l: from this gap on it speeds up [m]"""
    gap_upper: Positive = 30.0
    """s_u: from this gap on it drives the whole `catch_up_speed` faster [m]"""
    safe_gap: NonNegative = 4.0
    """dx_s: below this gap it follows the leader's speed [m]"""
    safe_gap_rule: Literal["constant", "closing"] = "constant"
    """`constant` as the paper; `is_merging`: max(2 s (v_lead - v), safe_gap), as Stern et al. and Flow"""
    time_constant: NonNegative = 3.0
    """time over which the wanted speed is reached [s]; 0: one time step, as the paper"""
    first_command: Literal["own-speed", "zero"] = "own-speed"
    """commanded speed before the first step; Flow starts from zero"""
    time_step: Positive = 0.1
    """time between two decisions [s]; set by the road"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "PISaturation":
        if self.gap_upper <= self.gap_lower:
            raise ValueError(f"gap_upper: {self.gap_upper:g} is not allowed; allowed: > gap_lower, {self.gap_lower:g}")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return an empty window and no command (NaN), or the command zero."""
        first = np.nan if self.first_command == "own-speed" else 0.0
        return {**empty_window(n, self.window, self.time_step), "command": np.full(n, first)}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the own speeds of the warm-up in its window."""
        return {**memory, **fill_window(memory, history.speed)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed of Eq. 10, and the new memory."""
        window = slide_window(memory, state.speed)
        acceleration, command = self._acceleration_and_command(window_mean_speed(window), state, memory["command"])
        return acceleration, {**window, "command": command}

    def _acceleration_and_command(self, mean: Array, state: LocalState, last_command: Array) -> tuple[Array, Array]:
        """Return the acceleration and the commanded speed that a mean and the `last` command lead to."""
        xp = namespace(state.speed)
        command = xp.where(xp.isnan(last_command), state.speed, last_command)
        room = (state.leader_gap - self.gap_lower) / (self.gap_upper - self.gap_lower)
        target = mean + self.catch_up_speed * clip(room, 0.0, 1.0)
        safe_gap = self.safe_gap
        if self.safe_gap_rule == "closing":
            safe_gap = clamp_min(2.0 * (state.leader_speed - state.speed), self.safe_gap)
        alpha = clip((state.leader_gap - safe_gap) / 2.0, 0.0, 1.0)
        beta = 1.0 - 0.5 * alpha
        command = beta * (alpha * target + (1.0 - alpha) * state.leader_speed) + (1.0 - beta) * command

        return (command - state.speed) / max(self.time_constant, self.time_step), command

    def memory_features(self, memory: Memory) -> Array:
        """Return the mean own speed and the commanded speed, scaled, shape (n, 2)."""
        mean = window_mean_speed(memory)
        return stack_columns((mean / SPEED_SCALE, memory["command"] / SPEED_SCALE))


@dataclass(frozen=True, config=STRICT)
class PIFromGap(PISaturation):
    """PI with saturation whose mean begins with the speed at which people drive behind its first gap.

    The plain one starts slowly: its mean is that of a car which stood. Where people stand evenly spaced, the
    own gap says how fast all can drive alike. Where it takes over in traffic that it has watched, its mean
    begins with a share of what it watched: who is slower at first opens the gap that swallows a wave.
    """

    name: ClassVar[str] = "pi-from-gap"

    human_time_headway: Positive = 1.0
    """time headway that people keep [s]"""
    human_standstill_gap: NonNegative = 2.0
    """gap of people who stand [m]"""
    fade_time: Positive = 40.0
    """time in which the first speed fades from the mean [s]"""
    history_factor: NonNegative = 1.0
    """share of the mean speed that was watched before, with which it begins in traffic"""

    def initial_memory(self, n: int) -> Memory:
        """Return that of the plain one, that the first speed is not known (NaN), and that none faded."""
        return {**super().initial_memory(n), "initial_speed": np.full(n, np.nan), "steps": np.zeros(n)}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the own speeds of the warm-up in its window, and where it begins then."""
        recalled = super().recall(memory, history)
        return {**recalled, "initial_speed": self.history_factor * window_mean_speed(recalled)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed of Eq. 10, and the new memory."""
        xp = namespace(state.speed)
        allowed = clamp_min((state.leader_gap - self.human_standstill_gap) / self.human_time_headway, 0.0)
        first = xp.where(xp.isnan(memory["initial_speed"]), allowed, memory["initial_speed"])
        window = slide_window(memory, state.speed)
        left = clip(1.0 - memory["steps"] * (self.time_step / self.fade_time), 0.0, 1.0)
        mean = window_mean_speed(window)
        acceleration, command = self._acceleration_and_command(mean + left * (first - mean), state, memory["command"])
        begun = {"initial_speed": first, "steps": memory["steps"] + 1.0}
        return acceleration, {**window, "command": command, **begun}
