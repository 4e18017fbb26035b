"""A world of pairs: each CAV follows a leader of its own, which accelerates as somebody has written down.

For what a certificate asks: what does a controller do behind a leader who brakes to standstill, sways, or
wants to be hit? Vehicles move as in the simulator; nobody but the driver's own filter keeps them apart.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, Limits
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead
from unjam.physics.kinematics import next_speed
from unjam.worlds.world import Driven, OnProgress

Floats = NDArray[np.float64]


class Pursued(NamedTuple):
    """What happened to n pairs; T steps."""

    speed: Floats
    """of the CAVs [m/s], shape (T + 1, n)"""
    leader_speed: Floats
    """[m/s], shape (T + 1, n)"""
    gap: Floats
    """[m], shape (T + 1, n)"""


class PursuitWorld:
    """n CAVs behind leaders; who follows a CAV is as far behind and as fast as it is."""

    single, kept = False, None

    def __init__(
        self,
        start: Ahead,
        leader_accelerations: Any,
        limits: Limits,
        step: float,
        loop_length: float = np.nan,
    ) -> None:
        """Take where the pairs begin, arrays of shape (n,), and what leaders do [m/s2], shape (T, n)."""
        self.limits, self._step = limits, step
        self._ahead = [Ahead(*(np.array(values, np.float64) for values in start))]
        self._leader = np.asarray(leader_accelerations, np.float64)
        self.rows = self.entered = len(start.speed)
        self._position, self._loop = np.zeros(self.rows), np.full(self.rows, loop_length)

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Begin; nothing was before."""

    @property
    def ended(self) -> bool:
        """Whether leaders have nothing more to do."""
        return len(self._ahead) > len(self._leader)

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now, arrays of shape (n,)."""
        speed, leader, gap = self._ahead[-1]
        place = self._position if np.isnan(self._loop).all() else self._position % self._loop
        return LocalState(speed, leader, gap, speed, gap, place, self._loop)

    def advance(self, command: Command | None) -> None:
        """Make one step of all pairs."""
        assert command is not None
        before, step = self._ahead[-1], self._step
        told = self.limits.keep(np.asarray(command.acceleration))
        speed = next_speed(before.speed, told, step)
        leader = next_speed(before.leader_speed, self._leader[len(self._ahead) - 1], step)
        self._position = self._position + speed * step
        self._ahead.append(Ahead(speed, leader, before.gap + (leader - speed) * step))

    def noise(self) -> Floats:
        """Return none: nobody explores here."""
        return np.zeros(self.rows)

    def record(self, driven: Driven) -> Pursued:
        """Return what happened."""
        return Pursued(*(np.array(values) for values in zip(*self._ahead, strict=True)))
