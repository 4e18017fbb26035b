"""Sensors of CAVs for gaps and speeds of neighbors, with bounded errors and missing readings."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.parameters import STRICT, NonNegative, Subclassable, parameter_dataclass
from unjam.physics.arrays import Array, Floats

MIN_SENSED_GAP = 0.1
"""smallest gap that a sensor reports [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class Sensors(Subclassable):
    """Errors of the sensed gaps and speeds of neighbors, independent in each reading; the own speed is exact."""

    gap_error: NonNegative = 0.0
    """largest error of a gap [m]; errors have a symmetric uniform distribution"""
    speed_error: NonNegative = 0.0
    """largest error of the speed of a neighbor [m/s], with the same distribution"""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """probability that a reading is missing"""

    @property
    def is_exact(self) -> bool:
        """Whether there are no errors."""
        return not (self.gap_error or self.speed_error or self.dropout)


class SensorReadings:
    """Draws sensor readings of CAVs, and stores the last reading of each CAV for missing ones."""

    def __init__(self, sensors: Sensors, leader_braking: float, step: float, seed: np.random.SeedSequence) -> None:
        """Set the maximum braking of leaders [m/s2] and the time between two readings, `step` [s], for all CAVs."""
        self._sensors, self._leader_speed_drop, self._step = sensors, leader_braking * step, step
        self._filter_generator, self._driver_generator = (
            np.random.default_rng(child_seed) for child_seed in seed.spawn(2)
        )
        self._filter_readings: dict[str, tuple[Array, Array]] = {}
        self._driver_readings: dict[str, Floats] = {}

    def read_for_filter(self, cav_id: str, state: FollowingState) -> FollowingState:
        """Return the readings of a CAV for its safety filter, once in each simulation step, from its true `state`.

        A missing reading assumes that the leader has braked at its maximum since the last reading. `state` has numbers
        for one CAV, or arrays for all CAVs of a common id.
        """
        sensors, generator, shape = self._sensors, self._filter_generator, np.shape(state.speed)
        leader = state.leader_speed + sensors.speed_error * generator.uniform(-1.0, 1.0, shape)
        gap = state.gap + sensors.gap_error * generator.uniform(-1.0, 1.0, shape)
        if cav_id in self._filter_readings:
            is_missing = generator.random(shape) < sensors.dropout
            last_leader, last_gap = self._filter_readings[cav_id]
            slowest_leader = last_leader - self._leader_speed_drop
            gap_change = self._step * (np.maximum(slowest_leader - sensors.speed_error, 0.0) - state.speed)
            leader = np.where(is_missing, slowest_leader, leader)
            gap = np.where(is_missing, last_gap + gap_change, gap)
        self._filter_readings[cav_id] = leader, gap
        return FollowingState(state.speed, *((leader, gap) if shape else (float(leader), float(gap))))

    def read_for_driver(self, cav_ids: Sequence[str], state: LocalState) -> LocalState:
        """Return the readings of CAVs for their drivers, from the true `state`; the last readings for missing ones."""
        sensors, generator = self._sensors, self._driver_generator
        true_values = np.array([state.leader_gap, state.follower_gap, state.leader_speed, state.follower_speed])
        true_values = true_values.reshape(4, len(cav_ids))
        largest_errors = np.repeat([sensors.gap_error, sensors.speed_error], 2)[:, None]
        minima = np.repeat([MIN_SENSED_GAP, 0.0], 2)[:, None]
        readings = np.maximum(true_values + largest_errors * generator.uniform(-1.0, 1.0, true_values.shape), minima)
        for column, is_missing in enumerate(generator.random(len(cav_ids)) < sensors.dropout):
            if is_missing:
                readings[:, column] = self._driver_readings.get(cav_ids[column], readings[:, column])
        self._driver_readings = dict(zip(cav_ids, readings.T, strict=True))
        ahead, behind, leader, follower = readings[:, 0].tolist() if isinstance(state.speed, float) else readings
        return state._replace(leader_gap=ahead, follower_gap=behind, leader_speed=leader, follower_speed=follower)
