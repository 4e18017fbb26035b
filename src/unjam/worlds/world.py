"""What a world is: where a driver drives. Two are here: a recording, and pairs of a CAV and its leader."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, Limits, commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.physics.arrays import Array, Floats
from unjam.physics.kinematics import next_speed
from unjam.tree import Arrays

RecordT = TypeVar("RecordT", covariant=True)

ProgressCallback = Callable[[int], None]
"""called now and then with how many decisions have been made"""


@dataclass(frozen=True)
class DriverLog:
    """What a driver decided in a world, decision by decision."""

    decisions: list[tuple[Array, Array, Array]] = field(default_factory=list)
    """the expert's share, the residual, and what the network saw; nothing where there is no network"""
    last_observation: Array | None = None
    """what the network would have seen at the end"""
    initial_memories: list[Arrays] = field(default_factory=list)
    """what the expert remembered before the first decision of each CAV by itself, in order of entry"""
    action_repeat: int = 1
    """decisions for which one residual was held"""


class World(Protocol[RecordT]):
    """Moves n CAVs as they are told, and says what they perceive; `unjam.worlds.drive` alone calls it."""

    limits: Limits
    """within which accelerations are kept"""
    is_scalar: bool
    """whether its only CAV perceives and is driven in plain numbers instead of arrays of one row"""
    entered_count: int
    """CAVs that the driver was given so far"""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Begin, and hand the CAVs over, unless they stay human (`controlled` false).

        Returns:
            What the CAVs perceived before, for drivers that remember it: arrays of shape (CAVs, moments),
            oldest first; None where there is nothing to remember.
        """
        ...

    @property
    def cav_count(self) -> int:
        """CAVs on the road now: the rows of what drivers are given and answer."""
        ...

    @property
    def remaining_rows(self) -> Sequence[int] | None:
        """Rows before the last decision that are still there, newcomers being behind them; None: the same."""
        ...

    @property
    def has_ended(self) -> bool:
        """Whether there is nothing more to decide."""
        ...

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        ...

    def advance(self, command: Command | None) -> None:
        """Carry out one decision of every CAV; None: they stay human.

        Raises:
            InputError: a command cannot be carried out: it is not finite, or there are not as many as CAVs.
        """
        ...

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise for one look of a network: shape (CAVs,), or a plain number.

        With `episode_noise`, so many numbers for each CAV, shape (CAVs, lasting), that are the same for all CAVs
        of a road and in all looks.
        """
        ...

    def record(self, driver_log: DriverLog) -> RecordT:
        """Return what happened, with what the driver decided."""
        ...


class RecordedWorld:
    """States that were recorded go by, whatever a driver does: what would it do, what does it remember?"""

    is_scalar = False
    remaining_rows = None

    def __init__(self, states: LocalState, limits: Limits) -> None:
        """Take the states of n CAVs at T moments, arrays of shape (T, n)."""
        self.states, self.limits = states, limits
        self.cav_count = self.entered_count = states.speed.shape[1]
        self._row_names = [f"row {number}" for number in range(self.cav_count)]
        self._accelerations: list[list[float]] = []

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Begin at the first moment; nothing was before."""
        self._accelerations = []

    @property
    def has_ended(self) -> bool:
        """Whether all moments have gone by."""
        return len(self._accelerations) == len(self.states.speed)

    def local_state(self) -> LocalState:
        """Return what was perceived at this moment; after the last one, at the last."""
        moment = min(len(self._accelerations), len(self.states.speed) - 1)
        return self.states.select(moment)

    def advance(self, command: Command | None) -> None:
        """Note what was asked for, and go on to the next moment."""
        self._accelerations.append(
            commanded_accelerations(command, self.limits, self._row_names, len(self._accelerations))
        )

    def noise(self, episode_noise_size: int = 0) -> Any:
        """Return none: nobody explores here."""
        return np.zeros((self.cav_count, episode_noise_size) if episode_noise_size else self.cav_count)

    def record(self, driver_log: DriverLog) -> NDArray[np.float64]:
        """Return what was asked for, within the limits [m/s2], shape (T, n)."""
        return np.array(self._accelerations)


class CarFollowingRecord(NamedTuple):
    """What happened to n pairs; T steps."""

    speed: Floats
    """of the CAVs [m/s], shape (T + 1, n)"""
    leader_speed: Floats
    """[m/s], shape (T + 1, n)"""
    gap: Floats
    """[m], shape (T + 1, n)"""


class CarFollowingWorld:
    """n CAVs behind leaders; who follows a CAV is as far behind and as fast as it is."""

    is_scalar, remaining_rows = False, None

    def __init__(
        self,
        initial_state: FollowingState,
        leader_accelerations: Any,
        limits: Limits,
        step: float,
        loop_length: float = np.nan,
    ) -> None:
        """Take where the pairs begin, arrays of shape (n,), and what leaders do [m/s2], shape (T, n)."""
        self.limits, self._step = limits, step
        self._states = [FollowingState(*(np.array(values, np.float64) for values in initial_state))]
        self._leader_accelerations = np.asarray(leader_accelerations, np.float64)
        self.cav_count = self.entered_count = len(initial_state.speed)
        self._position, self._loop_length = np.zeros(self.cav_count), np.full(self.cav_count, loop_length)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Begin; nothing was before."""

    @property
    def has_ended(self) -> bool:
        """Whether leaders have nothing more to do."""
        return len(self._states) > len(self._leader_accelerations)

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now, arrays of shape (n,)."""
        speed, leader, gap = self._states[-1]
        place = self._position if np.isnan(self._loop_length).all() else self._position % self._loop_length
        return LocalState(speed, leader, gap, speed, gap, place, self._loop_length)

    def advance(self, command: Command | None) -> None:
        """Make one step of all pairs."""
        assert command is not None
        before, step = self._states[-1], self._step
        told = self.limits.clip(np.asarray(command.acceleration))
        speed = next_speed(before.speed, told, step)
        leader = next_speed(before.leader_speed, self._leader_accelerations[len(self._states) - 1], step)
        self._position = self._position + speed * step
        self._states.append(FollowingState(speed, leader, before.gap + (leader - speed) * step))

    def noise(self, episode_noise_size: int = 0) -> Floats:
        """Return none: nobody explores here."""
        return np.zeros((self.cav_count, episode_noise_size) if episode_noise_size else self.cav_count)

    def record(self, driver_log: DriverLog) -> CarFollowingRecord:
        """Return what happened."""
        return CarFollowingRecord(*(np.array(values) for values in zip(*self._states, strict=True)))
