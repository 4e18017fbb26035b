"""Sensors of a vehicle for its neighbors: bounded errors and missing readings."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.parameters import STRICT, NonNegative, Subclassable, parameter_dataclass
from unjam.physics.arrays import Array, Floats

MIN_SENSED_GAP = 0.1
"""smallest gap that a sensor reports, whatever its error [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class Sensors(Subclassable):
    """Errors of the sensed gaps and speeds of neighbors; the own speed is exact."""

    gap_error: NonNegative = 0.0
    """largest error of a gap [m]; errors are independent for each reading, with a symmetric uniform distribution"""
    speed_error: NonNegative = 0.0
    """largest error of the speed of a neighbor [m/s], with the same distribution"""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of missing readings, independent for each reading"""

    @property
    def is_exact(self) -> bool:
        """Whether there are no errors."""
        return not (self.gap_error or self.speed_error or self.dropout)


class SensorReadings:
    """The sensor readings of CAVs by their names, over time."""

    def __init__(self, sensors: Sensors, leader_braking: float, step: float, seed: np.random.SeedSequence) -> None:
        """Take the settings of all CAVs: maximum braking of leaders [m/s2], and time between readings [s]."""
        self._sensors, self._leader_speed_drop, self._step = sensors, leader_braking * step, step
        self._filter_generator, self._driver_generator = (
            np.random.default_rng(child_seed) for child_seed in seed.spawn(2)
        )
        self._bounds: dict[str, tuple[Array, Array]] = {}
        self._last_readings: dict[str, Floats] = {}

    def read_for_filter(self, name: str, state: FollowingState) -> FollowingState:
        """Return the readings for a safety filter, once per simulation step; `state` has numbers, or arrays.

        If a reading is missing, it is assumed that the leader has braked at its maximum since the last one.
        """
        sensors, generator, shape = self._sensors, self._filter_generator, np.shape(state.speed)
        leader = state.leader_speed + sensors.speed_error * generator.uniform(-1.0, 1.0, shape)
        gap = state.gap + sensors.gap_error * generator.uniform(-1.0, 1.0, shape)
        if name in self._bounds:
            is_missing = generator.random(shape) < sensors.dropout
            last_leader, last_gap = self._bounds[name]
            slowest = last_leader - self._leader_speed_drop
            gap_change = self._step * (np.maximum(slowest - sensors.speed_error, 0.0) - state.speed)
            leader = np.where(is_missing, slowest, leader)
            gap = np.where(is_missing, last_gap + gap_change, gap)
        self._bounds[name] = leader, gap
        return FollowingState(state.speed, *((leader, gap) if shape else (float(leader), float(gap))))

    def read_for_driver(self, names: Sequence[str], state: LocalState) -> LocalState:
        """Return the true `state` of CAVs (numbers for one) as read; missing readings keep the last value."""
        sensors, generator = self._sensors, self._driver_generator
        true = np.array([state.leader_gap, state.follower_gap, state.leader_speed, state.follower_speed])
        errors = np.repeat([sensors.gap_error, sensors.speed_error], 2)[:, None]
        least = np.repeat([MIN_SENSED_GAP, 0.0], 2)[:, None]
        true = true.reshape(4, len(names))
        read = np.maximum(true + errors * generator.uniform(-1.0, 1.0, true.shape), least)
        for column, is_missing in enumerate(generator.random(len(names)) < sensors.dropout):
            if is_missing:
                read[:, column] = self._last_readings.get(names[column], read[:, column])
        self._last_readings = dict(zip(names, read.T, strict=True))
        ahead, behind, leader, follower = read[:, 0].tolist() if isinstance(state.speed, float) else read
        return state._replace(leader_gap=ahead, follower_gap=behind, leader_speed=leader, follower_speed=follower)
