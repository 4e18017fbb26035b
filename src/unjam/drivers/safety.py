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

from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, at_least, at_most
from unjam.physics.kinematics import speed_to_stop_within, stopping_distance


class Underway(NamedTuple):
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

    delay: NotNegative = 0.0
    """time after which a command arrives, rounded to whole simulation steps [s]"""
    lag: NotNegative = 0.0
    """time constant with which the acceleration follows [s]"""

    @property
    def instant(self) -> bool:
        """Whether it does at once what it is told."""
        return self.delay == 0.0 == self.lag

    def start(self, like: Array, step: float) -> Underway:
        """Return that nothing is done and nothing on its way, for cars like those of `like`."""
        return Underway(0.0 * like, (0.0 * like,) * round(self.delay / step))

    def obey(self, told: Array, speed: Array, underway: Underway, step: float) -> Underway:
        """Return what is under way once a car was told something: its acceleration holds for this step.

        Brakes do not push backwards: a car that stands has no acceleration.
        """
        arriving, *pending = *underway.pending, told
        left = self._left(step)
        acceleration = underway.acceleration * left + arriving * (1.0 - left)
        return Underway(at_least(acceleration, -speed / step), tuple(pending))

    def equivalent_speed(self, speed: Array, underway: Underway, braking: float, step: float) -> Array:
        """Return the speed z of a car without lag that drives at least as far under any commands [m/s].

        z = v + T (a + `braking`) with T = h r / (1 - r), where r is what one step of length h leaves of the
        difference to a command. Whatever is commanded, a step makes z + h u of it: as if there was no lag.
        """
        left = self._left(step)
        return speed + step * left / (1.0 - left) * (underway.acceleration + braking)

    def _left(self, step: float) -> float:
        """Return which share of the difference to a command one step leaves."""
        return exp(-step / self.lag) if self.lag else 0.0


class Ahead(NamedTuple):
    """What a car knows of itself and of the vehicle ahead: arrays of shape (n,), or plain numbers."""

    speed: Array
    """[m/s]"""
    leader_speed: Array
    """[m/s]"""
    gap: Array
    """own front bumper to the leader's rear bumper; infinite where nobody is ahead [m]"""


FAR = 1e6
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
    standstill_gap: NotNegative = 1.0
    """gap that is left where both stand [m]"""
    time_headway: NotNegative = 1.0
    """the floor, beside the standstill gap: smallest time headway behind who brakes with at most
    `headway_braking` [s]; 0: none"""
    headway_braking: Positive = 4.5
    """braking with which the floor is kept, at most `braking` [m/s2]"""
    gap_error: NotNegative = 0.0
    """largest error of the sensed gap [m]"""
    speed_error: NotNegative = 0.0
    """largest error of the leader's sensed speed [m/s]"""

    @model_validator(mode="after")
    def _brakes_fit(self) -> "SafetyFilter":
        own = self.braking
        if self.leader_braking < own:  # else the gap may be smallest before both stand
            raise ValueError(
                f"leader_braking: {self.leader_braking:g} is not allowed; allowed: >= braking, {own:g}"
            )
        if self.headway_braking > own:
            raise ValueError(
                f"headway_braking: {self.headway_braking:g} is not allowed; allowed: <= braking, {own:g}"
            )
        return self

    def keep(
        self,
        wanted: Array,
        ahead: Ahead,
        step: float,
        actuator: Actuator | None = None,
        underway: Underway | None = None,
    ) -> Array:
        """Return what may be commanded of the acceleration that is wanted [m/s2], of its shape.

        The command holds for one `step` of simulation [s]. Without an `actuator` the car obeys at once; with
        one, `underway` is what it does already.
        """
        if not self.active:
            return wanted
        if type(wanted) is float and underway is None and self._is_free(wanted, ahead, step):
            return wanted
        return at_most(wanted, self.highest(ahead, step, actuator, underway))

    def highest(
        self, ahead: Ahead, step: float, actuator: Actuator | None = None, underway: Underway | None = None
    ) -> Array:
        """Return the highest acceleration that may be commanded; where none may, the hardest braking."""
        leader = at_least(ahead.leader_speed - self.speed_error, 0.0)
        room = at_most(ahead.gap, FAR) - (self.gap_error + self.standstill_gap)
        speed, arrives = ahead.speed, 0
        if actuator is not None and underway is not None:
            standing = actuator.equivalent_speed(0.0 * speed, Underway(0.0 * speed), self.braking, step)
            speed = actuator.equivalent_speed(speed, underway, self.braking, step)
            for command in underway.pending:
                speed = at_least(speed + command * step, standing)
                room = room - speed * step
            arrives = len(underway.pending)
        end = room + stopping_distance(leader, self.leader_braking, step)
        allowed = speed_to_stop_within(end, self.braking, step)
        if self.time_headway:
            allowed = at_most(allowed, self._highest_on_floor(leader, room, arrives, step))
        return at_least((allowed - speed) / step, -self.braking)

    def _highest_on_floor(self, leader: Array, room: Array, arrives: int, step: float) -> Array:
        """Return the highest speed at which the floor is kept while both brake with `headway_braking`.

        A command takes `arrives` steps to arrive; `room` is the gap less what the car drives meanwhile and
        less what is left where both stand.
        """
        braking, headway = self.headway_braking, self.time_headway
        later = at_least(leader - braking * step * (arrives + 1.0), 0.0)
        end = room + stopping_distance(leader, braking, step)
        near = (end - stopping_distance(later, braking, step)) / (headway + step)
        # Closing in faster than this, the headway is smallest at some later speed.
        matters = later + headway * braking
        far = speed_to_stop_within(end - braking * (headway + step / 2.0) ** 2 / 2.0, braking, step)
        return at_most(near, at_least(far, matters))

    def _is_free(self, wanted: float, ahead: Ahead, step: float) -> bool:
        """Return whether `wanted` surely may pass: bounds that cost a float a third of the formulas."""
        speed, leader, gap = ahead
        braking, headway = self.headway_braking, self.time_headway
        leader, speed = leader - self.speed_error, speed + wanted * step
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


class Cars:
    """CAVs by name; what each is told passes its filter, and is then obeyed as late as its actuator is."""

    def __init__(self, safety: SafetyFilter, actuator: Actuator, step: float) -> None:
        """Take what all cars have; `step` is that of simulation [s]."""
        self._keep, self._actuator, self._step = safety.keep, actuator, step
        self._late = not actuator.instant
        self._underway: dict[str, Underway] = {}

    def carry_out(self, name: str, wanted: Array, ahead: Ahead) -> tuple[Array, Array]:
        """Return what a car is told of the acceleration that is wanted, and what it does in this step [m/s2].

        Once in each simulation step; all numbers are plain, or arrays of cars that share the name.
        """
        if not self._late:
            told = self._keep(wanted, ahead, self._step)
            return told, told
        underway = self._underway.get(name) or self._actuator.start(ahead.speed, self._step)
        told = self._keep(wanted, ahead, self._step, self._actuator, underway)
        underway = self._actuator.obey(told, ahead.speed, underway, self._step)
        self._underway[name] = underway
        return told, underway.acceleration
