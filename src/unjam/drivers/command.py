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
    """time gap for the CAVs' own ACCs, on roads with ACCs; NaN, or None for all CAVs: the ACC keeps its time gap"""


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
    if array.dtype.kind in "cSUmM" or isinstance(answer, np.ma.MaskedArray):  # the conversion would lose information
        raise TypeError(f"{array.dtype} is not a type of real numbers")
    return array.astype(np.float64, copy=False)


def as_numbers(
    answer: Any, label: str, allowed: str = "real numbers", to_array: Callable[[Any], Array] = _as_doubles
) -> Floats:
    """Return an answer of the user's code, converted by `to_array`; raise `InputError` unless it is numbers."""
    try:
        return to_array(answer)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: tensors with a gradient
        raise InputError(f"{label} is not numbers: {to_one_line(repr(answer), 60)}; allowed: {allowed}") from None


def to_answer_array(
    answer: Any, rows: int, context: str, quantity: str = "acceleration", row_name: str = "CAV"
) -> Floats:
    """Return an answer of a driver or a reward as an array; raise `InputError` unless its shape is (rows,)."""
    array = as_numbers(answer, f"{context}: {quantity}")
    if array.shape != (rows,):
        allowed = f"allowed: ({rows},), one for each {row_name}"
        raise InputError(f"{context}: {quantity} has shape {array.shape}; {allowed}")
    return array


def batch_commanded_accelerations(command: Command | None, limits: Limits, rows: int, step: int) -> Array:
    """Return commanded accelerations within the limits [m/s2]; `InputError` unless each row has a finite one."""
    accelerations: Any = () if command is None else command.acceleration
    if np.shape(accelerations) != (rows,) or not bool(namespace(accelerations).isfinite(accelerations).all()):
        allowed = f"{rows} finite numbers, one for each CAV"
        raise InputError(f"driver: step {step}: acceleration is not allowed; allowed: {allowed}")
    return limits.clip(accelerations)


def commanded_accelerations(command: Command | None, limits: Limits, cav_ids: Sequence[str], step: int) -> list[float]:
    """Return commanded accelerations within the limits as plain floats [m/s2], one for each of `cav_ids`.

    Raise `InputError` with `step` in its message unless there is one finite acceleration for each CAV.
    """
    answer: Array = () if command is None else command.acceleration
    is_float = isinstance(answer, float) and len(cav_ids) == 1
    if is_float and isfinite(answer):  # the fast path, in every step of a simulator
        return [limits.clip(answer)]
    context = f"driver: step {step}"
    accelerations = to_answer_array([answer] if is_float else answer, len(cav_ids), context)
    if not all(map(isfinite, accelerations.tolist())):  # faster than NumPy for few vehicles
        _raise_not_finite(accelerations, cav_ids, f"{context}: acceleration", "finite")
    return limits.clip(accelerations).tolist()


def commanded_time_gaps(command: Command | None, min_time_gap: float, cav_ids: Sequence[str], step: int) -> list[float]:
    """Return the time gaps that the ACCs of `cav_ids` must keep [s]: the commanded ones, at least `min_time_gap`.

    Raise `InputError` with `step` in its message if one is infinite, or unless there is one for each CAV.
    """
    if command is None or command.time_gap is None:
        return [min_time_gap] * len(cav_ids)
    context = f"driver: step {step}"
    answer = to_answer_array(command.time_gap, len(cav_ids), context, "time gap")
    time_gaps = np.fmax(answer, min_time_gap)  # the minimum in place of NaN
    if not np.isfinite(time_gaps).all():
        _raise_not_finite(time_gaps, cav_ids, f"{context}: time gap", "finite, or NaN")
    return time_gaps.tolist()


def _raise_not_finite(values: Floats, cav_ids: Sequence[str], quantity: str, allowed: str) -> None:
    row = int(np.isfinite(values).argmin())
    raise InputError(f"{quantity} of {cav_ids[row]} is {values[row]}; allowed: {allowed}")
