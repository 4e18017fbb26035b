"""Commands of a driver to its vehicles, and the limits that are applied before a command reaches the road."""

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from unjam.errors import InputError
from unjam.physics.arrays import Array, Floats, clip, namespace
from unjam.text import to_one_line


class Command(NamedTuple):
    """Commands for n CAVs until the next control step [m/s2, s]; arrays of shape (n,), or plain numbers for one."""

    acceleration: Array
    time_gap: Array | None = None
    """time gap for the CAVs' own ACCs, on roads with ACCs; NaN, or None for all: that of the ACC"""


class Limits(NamedTuple):
    """Accelerations that a CAV may command on a road [m/s2]."""

    lowest: float
    highest: float

    def clip(self, acceleration: Array) -> Array:
        """Return accelerations within the limits, of the same shape; NaN stays NaN."""
        return clip(acceleration, self.lowest, self.highest)

    @classmethod
    def symmetric(cls, limit: float) -> "Limits":
        """Return limits of the same size in both directions [m/s2]."""
        return cls(-limit, limit)


def _as_doubles(answer: Any) -> Floats:
    array = np.asarray(answer)
    if array.dtype.kind in "cSUmM" or isinstance(answer, np.ma.MaskedArray):  # part of it would be dropped
        raise TypeError(f"{array.dtype} is no real number")
    return array.astype(np.float64, copy=False)


def as_numbers(
    answer: Any, label: str, allowed: str = "real numbers", to_array: Callable[[Any], Array] = _as_doubles
) -> Floats:
    """Return the answer of a user's code as an array, made by `to_array`; raise `InputError` unless it is numbers."""
    try:
        return to_array(answer)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last for tensors with a gradient
        raise InputError(f"{label} is not numbers: {to_one_line(repr(answer), 60)}; allowed: {allowed}") from None


def to_answer_array(
    answer: Any, rows: int, context: str, quantity: str = "acceleration", row_name: str = "CAV"
) -> Floats:
    """Return the answer of a driver or a reward as an array; raise `InputError` unless its shape is (rows,)."""
    array = as_numbers(answer, f"{context}: {quantity}")
    if array.shape != (rows,):
        allowed = f"allowed: ({rows},), one for each {row_name}"
        raise InputError(f"{context}: {quantity} has shape {array.shape}; {allowed}")
    return array


def batch_commanded_accelerations(command: Command | None, limits: Limits, rows: int, step: int) -> Array:
    """Return the commands within the limits, shape (rows,) [m/s2]; `InputError` unless they are finite, one a row."""
    values: Any = () if command is None else command.acceleration
    if np.shape(values) != (rows,) or not bool(namespace(values).isfinite(values).all()):
        allowed = f"{rows} finite numbers, one for each CAV"
        raise InputError(f"driver: step {step}: acceleration is not allowed; allowed: {allowed}")
    return limits.clip(values)


def commanded_accelerations(command: Command | None, limits: Limits, names: Sequence[str], step: int) -> list[float]:
    """Return the commands of the vehicles `names`, within the limits, as plain floats [m/s2].

    Raise `InputError` with `step` in its message unless they are finite, one for each vehicle.
    """
    found: Array = () if command is None else command.acceleration
    rows = len(names)
    is_float = isinstance(found, float) and rows == 1
    if is_float and isfinite(found):  # the fast path, in every step of a simulator
        return [limits.clip(found)]
    context = f"driver: step {step}"
    values = to_answer_array([found] if is_float else found, rows, context)
    if not all(map(isfinite, values.tolist())):  # faster than NumPy for few vehicles
        _raise_not_finite(values, names, f"{context}: acceleration", "finite")
    return limits.clip(values).tolist()


def commanded_time_gaps(command: Command | None, min_time_gap: float, names: Sequence[str], step: int) -> list[float]:
    """Return the time gaps that the vehicles `names` must keep [s], at least `min_time_gap`, that of their ACCs.

    Raise `InputError` if one is infinite, or their number is not that of the vehicles.
    """
    if command is None or command.time_gap is None:
        return [min_time_gap] * len(names)
    context = f"driver: step {step}"
    time_gaps = np.fmax(to_answer_array(command.time_gap, len(names), context, "time gap"), min_time_gap)  # drops NaN
    if not np.isfinite(time_gaps).all():
        _raise_not_finite(time_gaps, names, f"{context}: time gap", "finite, or NaN")
    return time_gaps.tolist()


def _raise_not_finite(values: Floats, names: Sequence[str], quantity: str, allowed: str) -> None:
    row = int(np.isfinite(values).argmin())
    raise InputError(f"{quantity} of {names[row]} is {values[row]}; allowed: {allowed}")
