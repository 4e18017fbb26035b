"""The interface between drivers and worlds, and two worlds without a simulator: recordings and car-following pairs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from unjam.drivers.command import Command, Limits, commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, FollowingState
from unjam.physics.arrays import Array, Floats
from unjam.physics.kinematics import next_speed
from unjam.tree import Arrays

RecordT = TypeVar("RecordT", covariant=True)

ProgressCallback = Callable[[int], None]
"""called regularly with the number of control steps so far"""


@dataclass(frozen=True)
class DriverLog:
    """The decisions of a driver in a world, one per control step."""

    decisions: list[tuple[Array, Array, Array]] = field(default_factory=list)
    """the expert's acceleration, the residual and the network's observation; empty without a network"""
    last_observation: Array | None = None
    initial_memories: list[Arrays] = field(default_factory=list)
    """the expert's memory before the first control step of each CAV, in order of entry"""
    action_repeat: int = 1


class World(Protocol[RecordT]):
    """Moves n CAVs as commanded, and provides their observations; `unjam.worlds.drive` calls it."""

    limits: Limits
    """limits of commanded accelerations"""
    is_scalar: bool
    """whether states and commands of its single CAV are floats instead of arrays with one row"""
    entered_count: int
    """number of CAVs handed to the driver so far"""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Start, and hand the CAVs to the driver; they stay human unless `is_controlled`.

        Return earlier states of the CAVs for drivers with a memory, shape (CAVs, steps), oldest first, or None.
        """
        ...

    @property
    def cav_count(self) -> int:
        """Number of CAVs on the road, which is the number of rows of states and commands."""
        ...

    @property
    def remaining_rows(self) -> Sequence[int] | None:
        """Previous rows of the remaining CAVs, behind which new CAVs follow; None if no CAV has entered or left."""
        ...

    @property
    def has_ended(self) -> bool:
        """Whether no further control step follows."""
        ...

    def local_state(self) -> LocalState:
        """Return the state that the CAVs observe: arrays of shape (CAVs,), or floats of a single CAV."""
        ...

    def advance(self, command: Command | None) -> None:
        """Simulate one control step; CAVs without a command stay human. Raise `InputError` for invalid commands."""
        ...

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise for one action of a network: shape (CAVs,), or a float.

        With `episode_noise_size`, return shape (CAVs, size), equal for all CAVs of a road and all steps of an episode.
        """
        ...

    def record(self, driver_log: DriverLog) -> RecordT:
        """Return the record of the episode with the driver's decisions."""
        ...


class _OfflineWorld:
    """The common part of the worlds without a simulator: constant rows, no history and no exploration."""

    is_scalar, remaining_rows = False, None
    cav_count: int

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Start without a history."""

    def noise(self, episode_noise_size: int = 0) -> Floats:
        """Return zeros, because there is no exploration."""
        return np.zeros((self.cav_count, episode_noise_size) if episode_noise_size else self.cav_count)


class RecordedWorld(_OfflineWorld):
    """Recorded states, which do not depend on the driver, to compute its commands and memories."""

    def __init__(self, states: LocalState, limits: Limits) -> None:
        """Take the states of n CAVs in T control steps, arrays of shape (T, n)."""
        self.states, self.limits = states, limits
        self.cav_count = self.entered_count = states.speed.shape[1]
        self._row_names = [f"row {index}" for index in range(self.cav_count)]
        self._accelerations: list[list[float]] = []

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Start with the first recorded step, without a history."""
        self._accelerations = []

    @property
    def has_ended(self) -> bool:
        """Whether all recorded steps have passed."""
        return len(self._accelerations) == len(self.states.speed)

    def local_state(self) -> LocalState:
        """Return the state of the current step, or of the last step after the end; its arrays are read-only."""
        step = min(len(self._accelerations), len(self.states.speed) - 1)
        return self.states.select(step).as_read_only()

    def advance(self, command: Command | None) -> None:
        """Record the commands, and advance to the next recorded step."""
        step = len(self._accelerations)
        self._accelerations.append(commanded_accelerations(command, self.limits, self._row_names, step))

    def record(self, driver_log: DriverLog) -> Floats:
        """Return the commanded accelerations within the limits [m/s2], shape (T, n)."""
        return np.array(self._accelerations)


class CarFollowingWorld(_OfflineWorld):
    """n CAVs behind leaders with given accelerations; each follower has the speed and gap of its CAV."""

    def __init__(
        self,
        initial_state: FollowingState,
        leader_accelerations: Any,
        limits: Limits,
        step: float,
        loop_length: float = np.nan,
        actuator: Actuator = INSTANT_ACTUATOR,
    ) -> None:
        """Take the initial state of the pairs, arrays (n,), and the accelerations of the leaders [m/s2], (T, n)."""
        self.limits, self._step = limits, step
        self._states = [FollowingState(*(np.array(values, np.float64) for values in initial_state))]
        self._actuator, self._actuator_state = actuator, actuator.initial_state(self._states[0].speed, step)
        self._leader_accelerations = np.asarray(leader_accelerations, np.float64)
        self.cav_count = self.entered_count = len(initial_state.speed)
        self._position, self._loop_length = np.zeros(self.cav_count), np.full(self.cav_count, loop_length)

    @property
    def has_ended(self) -> bool:
        """Whether the leaders have no further accelerations."""
        return len(self._states) > len(self._leader_accelerations)

    def local_state(self) -> LocalState:
        """Return the state that the CAVs observe, read-only arrays of shape (n,)."""
        speed, leader_speed, gap = self._states[-1]
        position = self._position if np.isnan(self._loop_length).all() else self._position % self._loop_length
        return LocalState(speed, leader_speed, gap, speed, gap, position, self._loop_length).as_read_only()

    def advance(self, command: Command | None) -> None:
        """Make one step of all pairs."""
        assert command is not None
        previous, step = self._states[-1], self._step
        acceleration = self.limits.clip(np.asarray(command.acceleration))
        self._actuator_state = self._actuator.apply_command(acceleration, previous.speed, self._actuator_state, step)
        speed = next_speed(previous.speed, self._actuator_state.acceleration, step)
        leader_speed = next_speed(previous.leader_speed, self._leader_accelerations[len(self._states) - 1], step)
        self._position = self._position + speed * step
        self._states.append(FollowingState(speed, leader_speed, previous.gap + (leader_speed - speed) * step))

    def record(self, driver_log: DriverLog) -> FollowingState:
        """Return the states of all pairs in T steps, arrays of shape (T + 1, n)."""
        return FollowingState(*(np.array(values) for values in zip(*self._states, strict=True)))
