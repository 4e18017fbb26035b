"""The recorded sample of a controller: what a CAV perceived in an episode, and what is answered to it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import BY_SECTION, EVERYWHERE, SECTIONS_AHEAD, LocalState
from unjam.errors import InputError
from unjam.worlds.drive import drive
from unjam.worlds.world import RecordedWorld

Floats = NDArray[np.float64]

ANSWER = "acceleration"
"""the answer's name in a sample and in a graph"""


def sample_bytes(driver: Driver, states: LocalState, limit: float) -> bytes:
    """Return the part of an archive with `states`, arrays of shape (T,), and the answers of `driver`."""
    seen = {name: values for name, values in states._asdict().items() if values is not None}
    arrays = {name: np.array(values, np.float64) for name, values in seen.items()}
    return save({**arrays, ANSWER: replay(driver, states, limit)})


def read_sample(part: bytes) -> tuple[LocalState, Floats]:
    """Return the states of a sample and the recorded accelerations [m/s2], all of shape (T,).

    Raises:
        InputError: an array is missing, unknown, of another shape or type, or an acceleration is not finite.
    """
    arrays: dict[str, Any] = load(part)
    needed, known = {*EVERYWHERE, ANSWER}, {*LocalState._fields, ANSWER}
    wrong = (needed - arrays.keys()) | (arrays.keys() - known)
    if wrong:
        first = min(wrong)
        raise InputError(f"sample: {first!r} is {'missing' if first in needed else 'unknown'}")
    answers = arrays.pop(ANSWER)
    for name, values in {**arrays, ANSWER: answers}.items():
        shape = (len(values), SECTIONS_AHEAD) if name in BY_SECTION else answers.shape
        if values.ndim != len(shape) or values.shape != shape or values.dtype != np.float64:
            raise InputError(f"sample: {name!r} has shape {values.shape} of {values.dtype}; allowed: numbers")
    if not np.isfinite(answers).all():
        raise InputError("sample: a recorded acceleration is not finite")
    return LocalState(**arrays), answers


def replay(driver: Driver, states: LocalState, limit: float) -> Floats:
    """Return what a driver answers when it perceives `states` one after the other, from its first memory.

    Args:
        driver: of one CAV.
        states: arrays of shape (T,).
        limit: the acceleration is clipped to it [m/s2].

    Returns:
        Accelerations [m/s2], shape (T,).
    """
    world = RecordedWorld(states.at(np.s_[:, None]), Limits.symmetric(limit))
    return drive(world, driver).ravel()
