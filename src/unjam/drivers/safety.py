"""The safety filter, and the actuator of a vehicle with its delay and lag.

The filter passes an acceleration if the vehicle can afterwards still stop behind a leader that brakes at the assumed
maximum, and keep its time gap behind one that brakes hard. `docs/safety.md` has the assumptions and the proof.
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
    """commands that have not arrived yet, the next one first"""

    def map(self, function: Callable[[Array], Array]) -> "ActuatorState":
        """Return the state with a function applied to each array."""
        return ActuatorState(function(self.acceleration), tuple(map(function, self.pending)))


Latency = Annotated[float, Field(ge=0, le=60)]
"""delay or time constant of an actuator; a pending command needs memory in each step [s]"""
MAX_RESPONSE_STEPS = 1000
"""most steps that a command can take to arrive, or that the time constant of a lag can last"""
MIN_TIME_GAP_BRAKING = 0.5
"""smallest braking with which a filter can keep a time gap: it follows the plan to standstill step by step [m/s2]"""
MAX_LEADER_BRAKING = 100.0
"""largest braking of a leader, ten times that of a car on a dry road [m/s2]; squares of far larger ones overflow"""


@parameter_dataclass(frozen=True, config=STRICT)
class Actuator(Subclassable):
    """Delay and lag of a vehicle's response to commands: da/dt = (u(t - delay) - a) / lag, exact over each step.

    Vehicles with driver assistance systems: lag 0.2 to 0.5 s, delay 0.05 to 0.5 s.
    """

    delay: Latency = 0.0
    """time until a command arrives, rounded to whole simulation steps [s]"""
    lag: Latency = 0.0
    """time constant with which the acceleration follows [s]"""

    @property
    def is_instant(self) -> bool:
        """Whether there is neither delay nor lag."""
        return self.delay == 0.0 == self.lag

    def describe(self) -> str:
        """Return the vehicle in words."""
        if self.is_instant:
            return "in a vehicle that obeys at once"
        return f"in a vehicle with {self.delay:g} s delay and {self.lag:g} s lag"

    def initial_state(self, like: Array, step: float) -> ActuatorState:
        """Return the state without acceleration and commands, for vehicles in the shape of `like`."""
        return ActuatorState(0.0 * like, (0.0 * like,) * self.delay_steps(step))

    def check_step(self, step: float) -> None:
        """Raise `ValueError` if the response takes more than `MAX_RESPONSE_STEPS`, each of which takes time."""
        for name, value in (("delay", self.delay), ("lag", self.lag)):
            if value > MAX_RESPONSE_STEPS * step:
                allowed = f"at most {MAX_RESPONSE_STEPS:,} steps of {step:g} s"
                raise ValueError(f"actuator.{name}: {value:g} is not allowed; allowed: {allowed}")

    def delay_steps(self, step: float) -> int:
        """Return the number of simulation steps until a command arrives."""
        return round(self.delay / step)

    def apply_command(self, command: Array, speed: Array, state: ActuatorState, step: float) -> ActuatorState:
        """Return the state after a command, with the acceleration for this step; brakes cannot reverse a vehicle."""
        arriving, *pending = *state.pending, command
        decay = self.decay(step)
        acceleration = state.acceleration * decay + arriving * (1.0 - decay)
        return ActuatorState(clamp_min(acceleration, -speed / step), tuple(pending))

    def equivalent_speed(self, speed: Array, state: ActuatorState, braking: float, step: float) -> Array:
        """Return the speed z of a vehicle without lag that drives at least as far under any commands [m/s].

        z = v + T (a + `braking`) with T = h r / (1 - r), where r is the share of the difference to a command that
        remains after one step of length h. For any command u, one step turns z into z + h u: as without lag.
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
"""a usual car: an assumption, see `docs/string-stability.md`"""


class FollowingState(NamedTuple):
    """State of a vehicle behind its leader [m/s, m]: arrays of shape (n,), or plain numbers."""

    speed: Array
    leader_speed: Array
    gap: Array
    """own front bumper to the leader's rear bumper; infinite without a leader"""


MAX_COMMAND, MAX_TRACED_SPEED = 20.0, 50.0
"""largest acceleration that a vehicle with delay or lag can be allowed [m/s2], and highest speed for which its exported
graph keeps time gaps [m/s]"""
MAX_LEADER_GAP = 1e6
"""finite gap that replaces larger ones in formulas that count steps [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SafetyFilter(Subclassable):
    """Upper bound of the acceleration behind a leader: RSS with a response time of one step, and a minimum time gap.

    Sources: Shalev-Shwartz et al. 2017 (arXiv:1708.06374), Definition 1; equal brakes of 6 m/s2 as in the
    JRC's fuzzy safety model (Mattas et al. 2020); minimum time gap as in ISO 15622.
    """

    active: bool = True
    """whether it acts at all"""
    braking: Positive = 6.0
    """maximum braking of the own vehicle, b_min [m/s2]"""
    leader_braking: Positive = 6.0
    """maximum braking of any leader, b_max, at least `braking` [m/s2]"""
    standstill_gap: NonNegative = 1.0
    """remaining gap when both vehicles stand [m]"""
    time_gap: NonNegative = 1.0
    """minimum time gap, beyond the standstill gap, behind a leader that brakes with at most `time_gap_braking` [s];
    0: none"""
    time_gap_braking: Positive = 4.5
    """braking with which the minimum time gap is kept, from 0.5 to `braking` [m/s2]"""
    gap_error: NonNegative = 0.0
    """largest error of the sensed gap [m]"""
    speed_error: NonNegative = 0.0
    """largest error of the leader's sensed speed [m/s]"""

    @model_validator(mode="after")
    def _check_braking(self) -> "SafetyFilter":
        own_braking, leader, time_gap = self.braking, self.leader_braking, self.time_gap_braking
        if leader < own_braking:  # else the gap may be smallest before both stand
            raise ValueError(f"leader_braking: {leader:g} is not allowed; allowed: >= braking, {own_braking:g}")
        if leader > MAX_LEADER_BRAKING:
            raise ValueError(f"leader_braking: {leader:g} is not allowed; allowed: <= {MAX_LEADER_BRAKING:g}")
        if not MIN_TIME_GAP_BRAKING <= time_gap <= own_braking:
            allowed = f"{MIN_TIME_GAP_BRAKING:g} to braking, {own_braking:g}"
            raise ValueError(f"time_gap_braking: {time_gap:g} is not allowed; allowed: {allowed}")
        return self

    def limit(
        self,
        acceleration: Array,
        state: FollowingState,
        step: float,
        actuation: tuple[Actuator, ActuatorState] | None = None,
    ) -> Array:
        """Return the allowed part of a desired acceleration [m/s2] that holds for one `step` of simulation [s].

        Without `actuation`, an actuator and its current state, the vehicle responds at once.
        """
        if not self.active:
            return acceleration
        # With a time gap shorter than a step, the formulas below allow less than these bounds.
        if type(acceleration) is float and actuation is None and not 0.0 < self.time_gap < step:
            speed = next_speed(state.speed, acceleration, step)
            leader = clamp_min(state.leader_speed - self.speed_error, 0.0)
            gap = state.gap - (self.gap_error + self.standstill_gap) - step * speed
            if self._is_clearly_safe(speed, leader, gap, step):
                return acceleration
        if actuation is not None and (type(acceleration) is float or namespace(acceleration) is np):
            return self._limit_by_plan_if_needed(acceleration, state, step, *actuation)
        return clamp_max(acceleration, self.max_acceleration(state, step, actuation))

    def max_acceleration(
        self, state: FollowingState, step: float, actuation: tuple[Actuator, ActuatorState] | None = None
    ) -> Array:
        """Return the highest acceleration that may be commanded; maximum braking if none may."""
        leader = clamp_min(state.leader_speed - self.speed_error, 0.0)
        gap = clamp_max(state.gap, MAX_LEADER_GAP) - (self.gap_error + self.standstill_gap)
        bounded = FollowingState(state.speed, leader, gap)
        speed = state.speed
        if actuation is not None:
            actuator, actuator_state = actuation
            standing = actuator.equivalent_speed(0.0 * speed, ActuatorState(0.0 * speed), self.braking, step)
            speed = actuator.equivalent_speed(speed, actuator_state, self.braking, step)
            for command in actuator_state.pending:
                speed = clamp_min(speed + command * step, standing)
                gap = gap - speed * step
        end = gap + stopping_distance(leader, self.leader_braking, step)
        allowed = (max_speed_to_stop(end, self.braking, step) - speed) / step
        if self.time_gap and actuation is not None:
            allowed = clamp_max(allowed, self._max_command_for_time_gap(bounded, step, *actuation))
        elif self.time_gap:
            allowed = clamp_max(allowed, (self._max_speed_for_time_gap(leader, gap, step) - speed) / step)
        return clamp_min(allowed, -self.braking)

    def _max_command_for_time_gap(
        self, state: FollowingState, step: float, actuator: Actuator, actuator_state: ActuatorState
    ) -> Array:
        # After the pending commands, and n further ones of `time_gap_braking`, own speed and gap are linear in the
        # command as long as the vehicle moves; each n gives a bound. `state.gap` is reduced by the standstill gap.
        braking, time_gap, decay = self.time_gap_braking, self.time_gap, actuator.decay(step)
        speed, leader, gap = state
        for _ in actuator_state.pending:
            actuator_state = actuator.apply_command(-braking, speed, actuator_state, step)
            speed, leader = next_speed(speed, actuator_state.acceleration, step), next_speed(leader, -braking, step)
            gap = gap + (leader - speed) * step
        equivalent = actuator.equivalent_speed(speed, actuator_state, braking, step)
        fading, remaining, distance, above = equivalent - speed, 1.0, 0.0, MAX_COMMAND + braking
        allowed = 0.0 * speed + above
        for number in range(1, _steps_to_standstill(equivalent + above * step, braking * step) + 1):
            remaining *= decay
            speed = equivalent - braking * step * number - fading * remaining
            leader = next_speed(leader, -braking, step)
            gap = gap + (leader - speed) * step
            gained = step * (1.0 - remaining)  # speed and distance by each m/s2 of the command above the braking
            distance += step * gained
            allowed = clamp_max(allowed, (gap - time_gap * speed) / (distance + time_gap * gained))
        return allowed - braking

    def _max_speed_for_time_gap(self, leader_speed: Array, gap: Array, step: float) -> Array:
        """Return the highest speed that keeps the time gap while both brake; `gap` is reduced by the standstill gap."""
        braking, time_gap = self.time_gap_braking, self.time_gap
        later = clamp_min(leader_speed - braking * step, 0.0)
        end = gap + stopping_distance(leader_speed, braking, step)
        near = (end - stopping_distance(later, braking, step)) / (time_gap + step)
        # At closing speeds above this one, the time gap has its minimum at some later speed.
        matters = later + time_gap * braking
        far = max_speed_to_stop(end - braking * (time_gap + step / 2.0) ** 2 / 2.0, braking, step)
        return clamp_max(near, clamp_min(far, matters))

    def _limit_by_plan_if_needed(
        self, acceleration: Array, state: FollowingState, step: float, actuator: Actuator, actuator_state: ActuatorState
    ) -> Array:
        # Plans of braking are only made where they matter. Until it stands, the vehicle is never faster than `top`, and
        # drives at most as far as one that keeps this speed until the command arrives, and then brakes without lag. The
        # gap to a leader that brakes equally hard is smallest now or at the end: the bounds below suffice for any plan.
        speed, leader, gap = state
        gap = gap - (self.gap_error + self.standstill_gap)
        leader, commands = clamp_min(leader - self.speed_error, 0.0), clamp_min(acceleration, 0.0)
        for pending in actuator_state.pending:
            commands = commands + clamp_min(pending, 0.0)
        response_time = actuator.response_time(step)
        top = speed + clamp_min(response_time * (actuator_state.acceleration + self.braking), 0.0)
        top = clamp_min(top, response_time * self.braking) + step * commands
        first = step * (len(actuator_state.pending) + 1) * top
        if type(acceleration) is float and self._is_clearly_safe(top, leader, gap - first, step):
            return acceleration

        def margin(braking: float, leader_braking: float) -> Array:
            return stopping_distance(leader, leader_braking, step) - first - stopping_distance(top, braking, step)

        braking = self.time_gap_braking
        at_end = gap + margin(self.braking, self.leader_braking)
        with_time_gap = gap + clamp_max(margin(braking, braking), 0.0) - self.time_gap * top
        is_unclear = (at_end < 0.0) | (with_time_gap < 0.0)
        if type(acceleration) is float:
            if not is_unclear:
                return acceleration
            return clamp_max(acceleration, self.max_acceleration(state, step, (actuator, actuator_state)))
        rows = np.flatnonzero(is_unclear)
        if len(rows) == 0:
            return acceleration
        limited = np.array(acceleration)
        pending = tuple(command[rows] for command in actuator_state.pending)
        selected = actuator, ActuatorState(actuator_state.acceleration[rows], pending)
        near = FollowingState(*(values[rows] for values in state))
        limited[rows] = np.minimum(limited[rows], self.max_acceleration(near, step, selected))
        return limited

    def _is_clearly_safe(self, speed: float, leader: float, gap: float, step: float) -> bool:
        """Return whether simple bounds prove that braking from a speed keeps both gaps."""
        # Stopping distances are at least v (v / b - h) / 2, and at most b h h / 8 more.
        half, square, leader_square = (leader - speed) * step / 2.0, speed * speed / 2.0, leader * leader / 2.0
        braking, own_braking, error = self.time_gap_braking, self.braking, step * step / 8.0
        at_end = leader_square / self.leader_braking - square / own_braking - half - own_braking * error
        with_time_gap = min((leader_square - square) / braking - half - braking * error, 0.0)
        return gap + at_end >= 0.0 and gap + with_time_gap >= self.time_gap * speed


def _steps_to_standstill(speed: Array, change: float) -> int:
    """Return after how many steps the fastest vehicle stands that slows by `change` in each [m/s]."""
    if type(speed) is not float:
        torch = sys.modules.get("torch")
        is_traced = torch is not None and torch.compiler.is_compiling()
        speed = MAX_TRACED_SPEED if is_traced else speed.max().item() if len(speed) else 0.0
    return int(speed / change) + 1


def actuate(
    safety: SafetyFilter,
    actuator: Actuator,
    acceleration: Array,
    state: FollowingState,
    before: ActuatorState,
    step: float,
) -> tuple[Array, ActuatorState]:
    """Return the filtered command for a desired acceleration, and the actuator's state in this step."""
    if actuator.is_instant:
        command = safety.limit(acceleration, state, step)
        return command, ActuatorState(command)
    command = safety.limit(acceleration, state, step, (actuator, before))
    return command, actuator.apply_command(command, state.speed, before, step)


class CAVActuation:
    """Filter and actuator of CAVs by name: a desired acceleration is filtered, then applied with delay and lag."""

    def __init__(self, safety: SafetyFilter, actuator: Actuator, step: float) -> None:
        """Take the settings of all CAVs; `step` is the simulation step [s]."""
        self._safety, self._actuator, self._step = safety, actuator, step
        self._has_lag = not actuator.is_instant
        self._states: dict[str, ActuatorState] = {}

    def set_state(self, name: str, state: ActuatorState) -> None:
        """Let the vehicles of this name continue with accelerations and pending commands."""
        self._states[name] = state

    def reset_rows(self, rows: Any) -> None:
        """Let some of the vehicles with a common name start again, without acceleration and commands."""
        for name, state in self._states.items():
            initial = self._actuator.initial_state(state.acceleration, self._step)
            self._states[name] = replace_columns(state, rows, initial, rows)

    def detach(self) -> None:
        """Let no gradients of torch flow through the states so far."""
        for name, (acceleration, pending) in self._states.items():
            self._states[name] = ActuatorState(acceleration.detach(), tuple(command.detach() for command in pending))

    def apply(self, name: str, acceleration: Array, state: FollowingState) -> tuple[Array, Array]:
        """Return the filtered command for a desired acceleration, and the acceleration in this simulation step."""
        actuator, step = self._actuator, self._step
        previous_state = self._states.get(name) or actuator.initial_state(state.speed, step)
        command, new_state = actuate(self._safety, actuator, acceleration, state, previous_state, step)
        if self._has_lag:
            self._states[name] = new_state
        return command, new_state.acceleration
