"""FollowerStopper (Stern et al. 2018): drives at a desired speed and yields smoothly when close."""

from typing import ClassVar

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.speed_history import empty_window, fill_window, slide_window, window_mean_speed
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clip, namespace


@dataclass(frozen=True, config=STRICT)
class FollowerStopper(FormulaDriver):
    """Drives at the desired speed while the gap allows it, and below it in three regions of the gap.

    In the field experiment the desired speed was an external estimate of the speed of traffic. By default it is the
    mean speed of the leader over the last `window` seconds: with the own mean, a stopped vehicle would never start.
    Source: Stern et al. 2018, Transp. Res. C 89:205-221, section 3.1.
    """

    name: ClassVar[str] = "follower-stopper"

    desired_speed: NonNegative | None = None
    """U [m/s]; None: mean speed of the leader over the window"""
    window: Positive = 38.0
    """time over which the leader's speed is averaged [s]"""
    gaps: tuple[Positive, Positive, Positive] = (4.5, 5.25, 6.0)
    """boundaries of the three regions at equal speeds [m]"""
    decelerations: tuple[Positive, Positive, Positive] = (1.5, 1.0, 0.5)
    """decelerations by which the boundaries grow with the closing speed [m/s2]"""
    time_constant: NonNegative = 0.0
    """time constant of the approach to the command [s]; 0: one time step"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "FollowerStopper":
        stop, follow, free = self.gaps
        if not stop < follow < free:
            raise ValueError(f"gaps: {list(self.gaps)} is not allowed; allowed: each larger than the previous one")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return an empty window."""
        return empty_window(n, self.window, self.time_step)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the leader's speeds from the warm-up in its window."""
        return fill_window(memory, history.leader_speed)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed, and the new memory."""
        xp = namespace(state.speed)
        window = slide_window(memory, state.leader_speed)
        mean = window_mean_speed(window)
        desired = mean if self.desired_speed is None else mean * 0.0 + self.desired_speed

        closing = xp.minimum(state.leader_speed - state.speed, state.speed * 0.0)
        stop, follow, free = (
            gap + closing**2 / (2.0 * deceleration)
            for gap, deceleration in zip(self.gaps, self.decelerations, strict=True)
        )
        gap = state.leader_gap
        leading = xp.minimum(state.leader_speed, desired)
        slowing = leading * clip((gap - stop) / (follow - stop), 0.0, 1.0)
        command = slowing + (desired - leading) * clip((gap - follow) / (free - follow), 0.0, 1.0)
        return (command - state.speed) / max(self.time_constant, self.time_step), window
