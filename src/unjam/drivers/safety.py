"""The safety filter, and the actuator of a vehicle with its delay and lag.

The filter allows an acceleration if the vehicle can afterwards still stop behind a leader that brakes with its assumed
maximum, and keep its time gap behind a leader that brakes hard. `docs/safety.md` has the assumptions and the proof.
"""

import sys
from collections.abc import Callable
from math import exp
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from unjam.parameters import STRICT, NonNegative, Positive, Subclassable, parameter_dataclass
from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, replace_columns
from unjam.physics.kinematics import max_speed_to_stop, next_speed, stopping_distance


class ActuatorState(NamedTuple):
    """Current acceleration and pending commands of a vehicle [m/s2]; arrays of shape (n,), or plain numbers."""

    acceleration: Array
    pending: tuple[Array, ...] = ()
    """commands that have not arrived yet, ordered by arrival"""

    def map(self, function: Callable[[Array], Array]) -> "ActuatorState":
        """Return a state with the results of a function for each array."""
        return ActuatorState(function(self.acceleration), tuple(map(function, self.pending)))


Latency = Annotated[float, Field(ge=0, le=60)]
"""delay or time constant of an actuator [s]"""
MAX_RESPONSE_STEPS = 1000
"""largest delay, and largest time constant of a lag, in simulation steps, because each step of a delay needs memory"""
MIN_TIME_GAP_BRAKING = 0.5
"""smallest braking with which a filter can keep a time gap [m/s2]: the filter computes each step to standstill"""
MAX_LEADER_BRAKING = 100.0
"""largest braking of a leader [m/s2], ten times the braking of a car on a dry road; far larger squares overflow"""


@parameter_dataclass(frozen=True, config=STRICT)
class Actuator(Subclassable):
    """Delay and lag of a vehicle's response to commands: da/dt = (u(t - delay) - a) / lag, exact over each step.

    Vehicles with driver assistance systems have lags of 0.2 to 0.5 s, and delays of 0.05 to 0.5 s.
    """

    delay: Latency = 0.0
    """time until a command arrives, rounded to whole simulation steps [s]"""
    lag: Latency = 0.0
    """time constant with which the acceleration follows the commands [s]"""

    @property
    def is_instant(self) -> bool:
        """Whether there is neither delay nor lag."""
        return self.delay == 0.0 == self.lag

    def describe(self) -> str:
        """Return a description of the vehicle for certificates."""
        if self.is_instant:
            return "in a vehicle that obeys at once"
        return f"in a vehicle with {self.delay:g} s delay and {self.lag:g} s lag"

    def initial_state(self, like: Array, step: float) -> ActuatorState:
        """Return the state without acceleration and pending commands, with arrays of the type and shape of `like`."""
        return ActuatorState(0.0 * like, (0.0 * like,) * self.delay_steps(step))

    def check_step(self, step: float) -> None:
        """Raise `ValueError` if delay or lag is longer than `MAX_RESPONSE_STEPS` simulation steps."""
        for name, value in (("delay", self.delay), ("lag", self.lag)):
            if value > MAX_RESPONSE_STEPS * step:
                allowed = f"at most {MAX_RESPONSE_STEPS:,} steps of {step:g} s"
                raise ValueError(f"actuator.{name}: {value:g} is not allowed; allowed: {allowed}")

    def delay_steps(self, step: float) -> int:
        """Return the delay in simulation steps."""
        return round(self.delay / step)

    def apply_command(self, command: Array, speed: Array, state: ActuatorState, step: float) -> ActuatorState:
        """Return the state after a command, with the acceleration of this step; brakes cannot reverse a vehicle."""
        arriving, *pending = *state.pending, command
        decay = self.decay(step)
        acceleration = state.acceleration * decay + arriving * (1.0 - decay)
        return ActuatorState(clamp_min(acceleration, -speed / step), tuple(pending))

    def equivalent_speed(self, speed: Array, state: ActuatorState, braking: float, step: float) -> Array:
        """Return the speed z of a vehicle without lag that drives at least as far after the same commands [m/s].

        z = v + T (a + `braking`) with T = h r / (1 - r), where r is the share of the difference to a command that
        remains after one step of length h. For any command u, one step turns z into z + h u, as without lag.
        """
        return speed + self.response_time(step) * (state.acceleration + braking)

    def response_time(self, step: float) -> float:
        """Return T of `equivalent_speed` [s]."""
        decay = self.decay(step)
        return step * decay / (1.0 - decay)

    def decay(self, step: float) -> float:
        """Return the share of the difference to a command that remains after one step."""
        return exp(-step / self.lag) if self.lag else 0.0


INSTANT_ACTUATOR = Actuator()
"""an ideal vehicle, which responds to commands at once"""
STANDARD_ACTUATOR = Actuator(delay=0.2, lag=0.3)
"""assumed vehicle: a usual car, see `docs/string-stability.md`"""


class FollowingState(NamedTuple):
    """State of a vehicle behind its leader [m/s, m]: arrays of shape (n,), or plain numbers."""

    speed: Array
    leader_speed: Array
    gap: Array
    """own front bumper to the leader's rear bumper; infinite without a leader"""


MAX_COMMAND, MAX_TRACED_SPEED = 20.0, 50.0
"""for a vehicle with delay or lag: largest allowed acceleration [m/s2], and highest speed for which its exported graph
keeps time gaps [m/s]"""
MAX_LEADER_GAP = 1e6
"""finite gap that replaces larger gaps in formulas that count steps [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SafetyFilter(Subclassable):
    """Upper bound of the acceleration behind a leader: RSS with a response time of one step, and a minimum time gap.

    Sources: Shalev-Shwartz et al. 2017 (arXiv:1708.06374), Definition 1; equal brakes of 6 m/s2 as in the
    JRC's fuzzy safety model (Mattas et al. 2020); minimum time gap as in ISO 15622.
    """

    active: bool = True
    """whether the filter limits accelerations"""
    braking: Positive = 6.0
    """maximum braking of the own vehicle, b_min [m/s2]"""
    leader_braking: Positive = 6.0
    """maximum braking of any leader, b_max, at least `braking` [m/s2]"""
    standstill_gap: NonNegative = 1.0
    """gap that remains when both vehicles stand [m]"""
    time_gap: NonNegative = 1.0
    """minimum time gap, in addition to the standstill gap, behind a leader that brakes with at most `time_gap_braking`
    [s]; 0: no time gap"""
    time_gap_braking: Positive = 4.5
    """braking with which the minimum time gap is kept, from 0.5 to `braking` [m/s2]"""
    gap_error: NonNegative = 0.0
    """largest error of the sensed gap [m]"""
    speed_error: NonNegative = 0.0
    """largest error of the leader's sensed speed [m/s]"""

    @model_validator(mode="after")
    def _check_braking(self) -> "SafetyFilter":
        braking, leader_braking, time_gap_braking = self.braking, self.leader_braking, self.time_gap_braking
        if leader_braking < braking:  # otherwise the gap may be smallest before both vehicles stand
            raise ValueError(f"leader_braking: {leader_braking:g} is not allowed; allowed: >= braking, {braking:g}")
        if leader_braking > MAX_LEADER_BRAKING:
            raise ValueError(f"leader_braking: {leader_braking:g} is not allowed; allowed: <= {MAX_LEADER_BRAKING:g}")
        if not MIN_TIME_GAP_BRAKING <= time_gap_braking <= braking:
            allowed = f"{MIN_TIME_GAP_BRAKING:g} to braking, {braking:g}"
            raise ValueError(f"time_gap_braking: {time_gap_braking:g} is not allowed; allowed: {allowed}")
        return self

    def limit(
        self,
        acceleration: Array,
        state: FollowingState,
        step: float,
        actuation: tuple[Actuator, ActuatorState] | None = None,
    ) -> Array:
        """Return the desired acceleration, reduced to the highest allowed one for one simulation step of `step` [s].

        `actuation` is an actuator and its current state; if it is None, the vehicle responds at once.
        """
        if not self.active:
            return acceleration
        # With a time gap shorter than a step, the formulas of `max_acceleration` allow less than these simple bounds.
        if type(acceleration) is float and actuation is None and not 0.0 < self.time_gap < step:
            speed = next_speed(state.speed, acceleration, step)
            leader = clamp_min(state.leader_speed - self.speed_error, 0.0)
            gap = state.gap - (self.gap_error + self.standstill_gap) - step * speed
            if self._is_clearly_safe(speed, leader, gap, step):
                return acceleration
        if actuation is not None and (type(acceleration) is float or namespace(acceleration) is np):
            return self._limit_if_unclear(acceleration, state, step, *actuation)
        return clamp_max(acceleration, self.max_acceleration(state, step, actuation))

    def max_acceleration(
        self, state: FollowingState, step: float, actuation: tuple[Actuator, ActuatorState] | None = None
    ) -> Array:
        """Return the highest allowed command [m/s2]; maximum braking if no command is allowed."""
        leader = clamp_min(state.leader_speed - self.speed_error, 0.0)
        gap = clamp_max(state.gap, MAX_LEADER_GAP) - (self.gap_error + self.standstill_gap)
        bounded_state = FollowingState(state.speed, leader, gap)
        speed = state.speed
        if actuation is not None:
            actuator, actuator_state = actuation
            speed_at_rest = actuator.equivalent_speed(0.0 * speed, ActuatorState(0.0 * speed), self.braking, step)
            speed = actuator.equivalent_speed(speed, actuator_state, self.braking, step)
            for command in actuator_state.pending:
                speed = clamp_min(speed + command * step, speed_at_rest)
                gap = gap - speed * step
        distance = gap + stopping_distance(leader, self.leader_braking, step)
        allowed = (max_speed_to_stop(distance, self.braking, step) - speed) / step
        if self.time_gap and actuation is not None:
            allowed = clamp_max(allowed, self._max_command_for_time_gap(bounded_state, step, *actuation))
        elif self.time_gap:
            allowed = clamp_max(allowed, (self._max_speed_for_time_gap(leader, gap, step) - speed) / step)
        return clamp_min(allowed, -self.braking)

    def _max_command_for_time_gap(
        self, state: FollowingState, step: float, actuator: Actuator, actuator_state: ActuatorState
    ) -> Array:
        # The vehicle receives the pending commands, the command, and then n commands to brake with `time_gap_braking`.
        # As long as the vehicle moves, its speed and gap are linear in the command: each n gives an upper bound of the
        # command. `state.gap` is reduced by the standstill gap.
        braking, time_gap, decay = self.time_gap_braking, self.time_gap, actuator.decay(step)
        speed, leader, gap = state
        for _ in actuator_state.pending:
            actuator_state = actuator.apply_command(-braking, speed, actuator_state, step)
            speed, leader = next_speed(speed, actuator_state.acceleration, step), next_speed(leader, -braking, step)
            gap = gap + (leader - speed) * step
        equivalent_speed = actuator.equivalent_speed(speed, actuator_state, braking, step)
        lag_speed, max_allowed = equivalent_speed - speed, MAX_COMMAND + braking
        allowed = 0.0 * speed + max_allowed  # commands relative to -braking
        remaining, distance_per_command = 1.0, 0.0
        for n in range(1, _steps_to_standstill(equivalent_speed + max_allowed * step, braking * step) + 1):
            remaining *= decay
            speed = equivalent_speed - braking * step * n - lag_speed * remaining
            leader = next_speed(leader, -braking, step)
            gap = gap + (leader - speed) * step
            speed_per_command = step * (1.0 - remaining)
            distance_per_command += step * speed_per_command
            bound = (gap - time_gap * speed) / (distance_per_command + time_gap * speed_per_command)
            allowed = clamp_max(allowed, bound)
        return allowed - braking

    def _max_speed_for_time_gap(self, leader_speed: Array, gap: Array, step: float) -> Array:
        """Return the highest speed that keeps the time gap while both brake; `gap` is reduced by the standstill gap."""
        braking, time_gap = self.time_gap_braking, self.time_gap
        next_leader_speed = clamp_min(leader_speed - braking * step, 0.0)
        distance = gap + stopping_distance(leader_speed, braking, step)
        first_step_bound = (distance - stopping_distance(next_leader_speed, braking, step)) / (time_gap + step)
        # Above this speed, the time gap has its minimum in a later step.
        max_first_step_speed = next_leader_speed + time_gap * braking
        later_bound = max_speed_to_stop(distance - braking * (time_gap + step / 2.0) ** 2 / 2.0, braking, step)
        return clamp_max(first_step_bound, clamp_min(later_bound, max_first_step_speed))

    def _limit_if_unclear(
        self, acceleration: Array, state: FollowingState, step: float, actuator: Actuator, actuator_state: ActuatorState
    ) -> Array:
        # `max_acceleration`, which computes each step of braking, is called only if simple bounds do not prove that the
        # acceleration is safe. Until the vehicle stands, it is never faster than `top_speed`. It drives at most as far
        # as a vehicle that keeps this speed until the command arrives, and then brakes without lag. The gap to a leader
        # that brakes equally hard is smallest now or at the end. Therefore the bounds below are sufficient.
        speed, leader, gap = state
        gap = gap - (self.gap_error + self.standstill_gap)
        leader, commands = clamp_min(leader - self.speed_error, 0.0), clamp_min(acceleration, 0.0)
        for pending in actuator_state.pending:
            commands = commands + clamp_min(pending, 0.0)
        response_time = actuator.response_time(step)
        top_speed = speed + clamp_min(response_time * (actuator_state.acceleration + self.braking), 0.0)
        top_speed = clamp_min(top_speed, response_time * self.braking) + step * commands
        delay_distance = step * (len(actuator_state.pending) + 1) * top_speed
        if type(acceleration) is float and self._is_clearly_safe(top_speed, leader, gap - delay_distance, step):
            return acceleration

        def min_gap_change(braking: float, leader_braking: float) -> Array:
            leader_distance = stopping_distance(leader, leader_braking, step)
            return leader_distance - delay_distance - stopping_distance(top_speed, braking, step)

        braking = self.time_gap_braking
        final_gap = gap + min_gap_change(self.braking, self.leader_braking)
        time_gap_margin = gap + clamp_max(min_gap_change(braking, braking), 0.0) - self.time_gap * top_speed
        is_unclear = (final_gap < 0.0) | (time_gap_margin < 0.0)
        if type(acceleration) is float:
            if not is_unclear:
                return acceleration
            return clamp_max(acceleration, self.max_acceleration(state, step, (actuator, actuator_state)))
        rows = np.flatnonzero(is_unclear)
        if len(rows) == 0:
            return acceleration
        limited = np.array(acceleration)
        unclear_state = FollowingState(*(array[rows] for array in state))
        unclear_actuation = actuator, actuator_state.map(lambda array: array[rows])
        limited[rows] = np.minimum(limited[rows], self.max_acceleration(unclear_state, step, unclear_actuation))
        return limited

    def _is_clearly_safe(self, speed: float, leader: float, gap: float, step: float) -> bool:
        """Return whether simple bounds prove that braking from a speed keeps standstill gap and time gap."""
        # Stopping distances with braking b and step h are at least v (v / b - h) / 2, and at most b h h / 8 longer.
        half, square, leader_square = (leader - speed) * step / 2.0, speed * speed / 2.0, leader * leader / 2.0
        braking, own_braking, error = self.time_gap_braking, self.braking, step * step / 8.0
        final_change = leader_square / self.leader_braking - square / own_braking - half - own_braking * error
        time_gap_change = min((leader_square - square) / braking - half - braking * error, 0.0)
        return gap + final_change >= 0.0 and gap + time_gap_change >= self.time_gap * speed


def _steps_to_standstill(speed: Array, speed_change: float) -> int:
    """Return the number of steps to standstill of the fastest vehicle, if each step reduces speed by `speed_change`."""
    if type(speed) is not float:
        torch = sys.modules.get("torch")
        is_traced = torch is not None and torch.compiler.is_compiling()
        speed = MAX_TRACED_SPEED if is_traced else speed.max().item() if len(speed) else 0.0
    return int(speed / speed_change) + 1


def actuate(
    safety: SafetyFilter,
    actuator: Actuator,
    acceleration: Array,
    state: FollowingState,
    actuator_state: ActuatorState,
    step: float,
) -> tuple[Array, ActuatorState]:
    """Return the filtered command for a desired acceleration, and the new state of the actuator."""
    if actuator.is_instant:
        command = safety.limit(acceleration, state, step)
        return command, ActuatorState(command)
    command = safety.limit(acceleration, state, step, (actuator, actuator_state))
    return command, actuator.apply_command(command, state.speed, actuator_state, step)


class CAVActuation:
    """Filters desired accelerations of CAVs, and applies them with delay and lag; stores actuator states by CAV id."""

    def __init__(self, safety: SafetyFilter, actuator: Actuator, step: float) -> None:
        """Set filter and actuator of all CAVs; `step` is the simulation step [s]."""
        self._safety, self._actuator, self._step = safety, actuator, step
        self._has_lag = not actuator.is_instant
        self._states: dict[str, ActuatorState] = {}

    def set_state(self, cav_id: str, state: ActuatorState) -> None:
        """Set accelerations and pending commands."""
        self._states[cav_id] = state

    def reset_rows(self, rows: Any) -> None:
        """Remove accelerations and pending commands of some rows."""
        for cav_id, state in self._states.items():
            initial_state = self._actuator.initial_state(state.acceleration, self._step)
            self._states[cav_id] = replace_columns(state, rows, initial_state, rows)

    def detach(self) -> None:
        """Stop gradients of torch at the current states."""
        for cav_id, state in self._states.items():
            self._states[cav_id] = state.map(lambda tensor: tensor.detach())

    def apply(self, cav_id: str, acceleration: Array, state: FollowingState) -> tuple[Array, Array]:
        """Return the filtered command for a desired acceleration, and the acceleration in this simulation step."""
        actuator, step = self._actuator, self._step
        actuator_state = self._states.get(cav_id) or actuator.initial_state(state.speed, step)
        command, new_state = actuate(self._safety, actuator, acceleration, state, actuator_state, step)
        if self._has_lag:
            self._states[cav_id] = new_state
        return command, new_state.acceleration
