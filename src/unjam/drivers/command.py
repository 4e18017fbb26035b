"""What a driver asks of its vehicles, and what of it may reach the road: the one place that clips.

Whatever stands between a driver's wish and the world belongs here: limits now, and whatever else keeps a
vehicle to what it can and should do.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.errors import InputError
from unjam.physics.arrays import Array, clip, namespace


class Command(NamedTuple):
    """What n CAVs shall do until the next decision; arrays of shape (n,), or plain numbers of one."""

    acceleration: Array
    """[m/s2]"""
    time_gap: Array | None = None
    """that their own ACCs shall keep to leaders, on roads that have such ACCs [s], shape (n,); NaN, or None
    for all: as long as they would by themselves"""


class Limits(NamedTuple):
    """Accelerations that a CAV may ask for on a road."""

    lowest: float
    """[m/s2]"""
    highest: float
    """[m/s2]"""

    def clip(self, acceleration: Array) -> Array:
        """Return accelerations within the limits, of the same shape; NaN stays NaN."""
        return clip(acceleration, self.lowest, self.highest)

    @classmethod
    def symmetric(cls, limit: float) -> "Limits":
        """Return the limits of so much in either direction [m/s2]."""
        return cls(-limit, limit)


def answer_as_array(answer: Any, rows: int, context: str, quantity: str = "acceleration") -> NDArray[np.float64]:
    """Return what a driver answered as an array; raise `InputError` unless it is `rows` numbers."""
    try:
        array = np.asarray(answer, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{context}: {quantity} is not numbers: {answer!r}") from None
    if array.shape != (rows,):
        allowed = f"({rows},), one for each CAV"
        raise InputError(f"{context}: {quantity} has shape {array.shape}; allowed: {allowed}")
    return array


def batch_commanded_accelerations(command: Command | None, limits: Limits, rows: int, step: int) -> Array:
    """Return what the vehicles of many roads are told, within the limits, shape (rows,) [m/s2].

    Raises:
        InputError: they are not finite numbers, one for each row.
    """
    found: Any = () if command is None else command.acceleration
    if np.shape(found) != (rows,) or not bool(namespace(found).isfinite(found).all()):
        raise InputError(f"driver: step {step}: not {rows} accelerations that are finite")
    return limits.clip(found)


def commanded_accelerations(command: Command | None, limits: Limits, names: Sequence[str], step: int) -> list[float]:
    """Return what the vehicles `names` are told, within the limits, as plain floats [m/s2].

    An acceleration is a number, or one for each vehicle; None is right for no vehicle. Messages name `step`.

    Raises:
        InputError: an acceleration is not finite, or there are not as many as vehicles.
    """
    found: Array = () if command is None else command.acceleration
    rows = len(names)
    one = type(found) is float and rows == 1
    if one and isfinite(found):  # in every step of a simulator: be quick
        return [limits.clip(found)]
    where = f"driver: step {step}"
    values = answer_as_array([found] if one else found, rows, where)
    if not all(map(isfinite, values.tolist())):  # quicker than NumPy where vehicles are few
        first = int(np.isfinite(values).argmin())
        raise InputError(f"{where}: acceleration of {names[first]} is {values[first]}; allowed: finite")
    return limits.clip(values).tolist()


def commanded_time_gaps(command: Command | None, min_time_gap: float, names: Sequence[str], step: int) -> list[float]:
    """Return the time headways that the vehicles `names` shall keep [s]: none below `least`, their ACCs' own.

    Raises:
        InputError: one is infinite, or there are not as many as vehicles.
    """
    wanted = None if command is None else command.time_gap
    if wanted is None:
        return [min_time_gap] * len(names)
    where = f"driver: step {step}"
    found = np.fmax(answer_as_array(wanted, len(names), where, "time headway"), min_time_gap)  # NaN gives way
    if not np.isfinite(found).all():
        first = int(np.isfinite(found).argmin())
        wrong = f"time headway of {names[first]} is {found[first]}"
        raise InputError(f"{where}: {wrong}; allowed: finite, or NaN")
    return found.tolist()
