"""The cars between what drivers ask for and the road: the safety filter, then the actuator."""

from unjam.drivers.actuator import Actuator, Underway
from unjam.drivers.safety import Ahead, SafetyFilter
from unjam.physics.arrays import Array


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
