"""What drivers of a batch command, once it is checked."""

from typing import Any

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.errors import InputError
from unjam.physics.arrays import Array, namespace


def checked(command: Command | None, rows: int, decision: int, limits: Limits) -> Array:
    """Return what is wanted, within the limits; raise `InputError` where it is not finite numbers."""
    found: Any = () if command is None else command.acceleration
    if np.shape(found) != (rows,) or not bool(namespace(found).isfinite(found).all()):
        raise InputError(f"driver: step {decision}: not {rows} accelerations that are finite")
    return limits.keep(found)
