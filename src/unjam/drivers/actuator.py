"""How late a car does what it is told: a delay, and a lag of first order."""

from math import exp
from typing import NamedTuple

from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, NotNegative
from unjam.physics.arrays import Array, at_least


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
