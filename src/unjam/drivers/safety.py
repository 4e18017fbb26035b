"""What lies between a driver and the road: the safety filter, and how late a car does what it is told.

The filter keeps a car from contact, and its time headway above a floor. It lets each acceleration pass that
leaves the car able to stop behind a leader who brakes as hard as anybody can, and able to keep its time
headway behind one who brakes hard; otherwise it brakes, as hard as it must.
`docs/safety.md` states the assumptions, and proves both for the discrete steps of the simulator.
"""

from math import exp
from typing import NamedTuple

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clamp_max, clamp_min
from unjam.physics.kinematics import max_speed_to_stop, stopping_distance


class ActuatorState(NamedTuple):
    """What a car is doing and what it has been told already; arrays of shape (n,), or plain numbers."""

    acceleration: Array
    """that it has now [m/s2]"""
    pending: tuple[Array, ...] = ()
    """commands on their way, the next to arrive first [m/s2]"""


@dataclass(frozen=True, config=STRICT)
class Actuator:
    """How late a car does what it is told: da/dt = (u(t - delay) - a) / lag, exactly over each step.

    Cars that drivers' aids steer: lag 0.2 to 0.5 s, delay 0.05 to 0.5 s.
    """

    delay: NonNegative = 0.0
    """time after which a command arrives, rounded to whole simulation steps [s]"""
    lag: NonNegative = 0.0
    """time constant with which the acceleration follows [s]"""

    @property
    def is_instant(self) -> bool:
        """Whether it does at once what it is told."""
        return self.delay == 0.0 == self.lag

    def initial_state(self, like: Array, step: float) -> ActuatorState:
        """Return that nothing is done and nothing on its way, for cars like those of `like`."""
        return ActuatorState(0.0 * like, (0.0 * like,) * round(self.delay / step))

    def apply_command(self, command: Array, speed: Array, state: ActuatorState, step: float) -> ActuatorState:
        """Return what is under way once a car was told something: its acceleration holds for this step.

        Brakes do not push backwards: a car that stands has no acceleration.
        """
        arriving, *pending = *state.pending, command
        left = self._lag_decay(step)
        acceleration = state.acceleration * left + arriving * (1.0 - left)
        return ActuatorState(clamp_min(acceleration, -speed / step), tuple(pending))

    def equivalent_speed(self, speed: Array, state: ActuatorState, braking: float, step: float) -> Array:
        """Return the speed z of a car without lag that drives at least as far under any commands [m/s].

        z = v + T (a + `braking`) with T = h r / (1 - r), where r is what one step of length h leaves of the
        difference to a command. Whatever is commanded, a step makes z + h u of it: as if there was no lag.
        """
        left = self._lag_decay(step)
        return speed + step * left / (1.0 - left) * (state.acceleration + braking)

    def _lag_decay(self, step: float) -> float:
        """Return which share of the difference to a command one step leaves."""
        return exp(-step / self.lag) if self.lag else 0.0


class FollowingState(NamedTuple):
    """What a car knows of itself and of the vehicle ahead: arrays of shape (n,), or plain numbers."""

    speed: Array
    """[m/s]"""
    leader_speed: Array
    """[m/s]"""
    gap: Array
    """own front bumper to the leader's rear bumper; infinite where nobody is ahead [m]"""


MAX_LEADER_GAP = 1e6
"""so far ahead nobody matters; formulas that count steps need a number that is finite [m]"""


@dataclass(frozen=True, config=STRICT)
class SafetyFilter:
    """What a car may do behind another: RSS with a response of one simulation step, and a headway floor.

    Sources: Shalev-Shwartz et al. 2017 (arXiv:1708.06374), Definition 1; equal brakes of 6 m/s2 as in the
    JRC's fuzzy safety model (Mattas et al. 2020); a floor of time headway as in ISO 15622.
    """

    active: bool = True
    """whether it acts at all"""
    braking: Positive = 6.0
    """the car's own brakes, b_min [m/s2]"""
    leader_braking: Positive = 6.0
    """hardest braking of anybody ahead, b_max, at least `braking` [m/s2]"""
    standstill_gap: NonNegative = 1.0
    """gap that is left where both stand [m]"""
    time_gap: NonNegative = 1.0
    """the floor, beside the standstill gap: smallest time headway behind who brakes with at most
    `time_gap_braking` [s]; 0: none"""
    time_gap_braking: Positive = 4.5
    """braking with which the floor is kept, at most `braking` [m/s2]"""
    gap_error: NonNegative = 0.0
    """largest error of the sensed gap [m]"""
    speed_error: NonNegative = 0.0
    """largest error of the leader's sensed speed [m/s]"""

    @model_validator(mode="after")
    def _check_braking(self) -> "SafetyFilter":
        own = self.braking
        if self.leader_braking < own:  # else the gap may be smallest before both stand
            raise ValueError(f"leader_braking: {self.leader_braking:g} is not allowed; allowed: >= braking, {own:g}")
        if self.time_gap_braking > own:
            raise ValueError(
                f"time_gap_braking: {self.time_gap_braking:g} is not allowed; allowed: <= braking, {own:g}"
            )
        return self

    def limit(
        self,
        acceleration: Array,
        state: FollowingState,
        step: float,
        actuator: Actuator | None = None,
        actuator_state: ActuatorState | None = None,
    ) -> Array:
        """Return what may be commanded of the acceleration that is wanted [m/s2], of its shape.

        The command holds for one `step` of simulation [s]. Without an `actuator` the car obeys at once; with
        one, `underway` is what it does already.
        """
        if not self.active:
            return acceleration
        if type(acceleration) is float and actuator_state is None and self._is_clearly_safe(acceleration, state, step):
            return acceleration
        return clamp_max(acceleration, self.max_acceleration(state, step, actuator, actuator_state))

    def max_acceleration(
        self,
        state: FollowingState,
        step: float,
        actuator: Actuator | None = None,
        actuator_state: ActuatorState | None = None,
    ) -> Array:
        """Return the highest acceleration that may be commanded; where none may, the hardest braking."""
        leader = clamp_min(state.leader_speed - self.speed_error, 0.0)
        room = clamp_max(state.gap, MAX_LEADER_GAP) - (self.gap_error + self.standstill_gap)
        speed, arrives = state.speed, 0
        if actuator is not None and actuator_state is not None:
            standing = actuator.equivalent_speed(0.0 * speed, ActuatorState(0.0 * speed), self.braking, step)
            speed = actuator.equivalent_speed(speed, actuator_state, self.braking, step)
            for command in actuator_state.pending:
                speed = clamp_min(speed + command * step, standing)
                room = room - speed * step
            arrives = len(actuator_state.pending)
        end = room + stopping_distance(leader, self.leader_braking, step)
        allowed = max_speed_to_stop(end, self.braking, step)
        if self.time_gap:
            allowed = clamp_max(allowed, self._max_speed_for_time_gap(leader, room, arrives, step))
        return clamp_min((allowed - speed) / step, -self.braking)

    def _max_speed_for_time_gap(self, leader_speed: Array, gap: Array, delay_steps: int, step: float) -> Array:
        """Return the highest speed at which the floor is kept while both brake with `time_gap_braking`.

        A command takes `arrives` steps to arrive; `room` is the gap less what the car drives meanwhile and
        less what is left where both stand.
        """
        braking, headway = self.time_gap_braking, self.time_gap
        later = clamp_min(leader_speed - braking * step * (delay_steps + 1.0), 0.0)
        end = gap + stopping_distance(leader_speed, braking, step)
        near = (end - stopping_distance(later, braking, step)) / (headway + step)
        # Closing in faster than this, the headway is smallest at some later speed.
        matters = later + headway * braking
        far = max_speed_to_stop(end - braking * (headway + step / 2.0) ** 2 / 2.0, braking, step)
        return clamp_max(near, clamp_min(far, matters))

    def _is_clearly_safe(self, acceleration: float, state: FollowingState, step: float) -> bool:
        """Return whether `wanted` surely may pass: bounds that cost a float a third of the formulas."""
        speed, leader, gap = state
        braking, headway = self.time_gap_braking, self.time_gap
        leader, speed = leader - self.speed_error, speed + acceleration * step
        room = gap - (self.gap_error + self.standstill_gap)
        later = leader - braking * step
        if later < 0.0 or speed < 0.0 or speed - later > headway * braking:
            return False
        own, others = self.braking, self.leader_braking
        return (
            speed * (headway + step) <= room + later * step
            and speed * (speed / own + step) / 2.0 + own * step * step / 8.0
            <= room + leader * (leader / others - step) / 2.0
        )


class CAVActuation:
    """CAVs by name; what each is told passes its filter, and is then obeyed as late as its actuator is."""

    def __init__(self, safety: SafetyFilter, actuator: Actuator, step: float) -> None:
        """Take what all cars have; `step` is that of simulation [s]."""
        self._limit, self._actuator, self._step = safety.limit, actuator, step
        self._has_lag = not actuator.is_instant
        self._states: dict[str, ActuatorState] = {}

    def apply(self, name: str, acceleration: Array, state: FollowingState) -> tuple[Array, Array]:
        """Return what a car is told of the acceleration that is wanted, and what it does in this step [m/s2].

        Once in each simulation step; all numbers are plain, or arrays of cars that share the name.
        """
        if not self._has_lag:
            told = self._limit(acceleration, state, self._step)
            return told, told
        underway = self._states.get(name) or self._actuator.initial_state(state.speed, self._step)
        told = self._limit(acceleration, state, self._step, self._actuator, underway)
        underway = self._actuator.apply_command(told, state.speed, underway, self._step)
        self._states[name] = underway
        return told, underway.acceleration
