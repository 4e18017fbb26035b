"""What a car senses of its neighbours: errors within bounds, and readings that are missing."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.parameters import STRICT, NonNegative
from unjam.physics.arrays import Array, Floats

MIN_SENSED_GAP = 0.1
"""[m], however wrong a sensor is"""


@dataclass(frozen=True, config=STRICT)
class Sensors:
    """How wrong what a car senses of its neighbours is; its own speed it knows."""

    gap_error: NonNegative = 0.0
    """largest error of a gap; each reading has one of its own, evenly distributed on both sides [m]"""
    speed_error: NonNegative = 0.0
    """largest error of a neighbour's speed, likewise [m/s]"""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of the readings that are missing, each by chance"""

    @property
    def is_exact(self) -> bool:
        """Whether there is nothing wrong."""
        return not (self.gap_error or self.speed_error or self.dropout)


class SensorReadings:
    """What the sensors of CAVs read, by their names; one moment after the other."""

    def __init__(self, sensors: Sensors, leader_braking: float, step: float, seed: np.random.SeedSequence) -> None:
        """Take what all cars have: hardest braking of leaders [m/s2], and the time between readings [s]."""
        self._sensors, self._leader_speed_drop, self._step = sensors, leader_braking * step, step
        self._filter_generator, self._driver_generator = (np.random.default_rng(each) for each in seed.spawn(2))
        self._bounds: dict[str, tuple[Array, Array]] = {}
        self._last_readings: dict[str, Floats] = {}

    def read_for_filter(self, name: str, state: FollowingState) -> FollowingState:
        """Return what a filter may rely on that takes the largest errors off, once in each simulation step.

        Where a reading is missing, the leader has braked as hard as anybody can since the last one. Plain
        numbers, or arrays of cars that share the name.
        """
        sensors, generator, shape = self._sensors, self._filter_generator, np.shape(state.speed)
        leader = state.leader_speed + sensors.speed_error * generator.uniform(-1.0, 1.0, shape)
        gap = state.gap + sensors.gap_error * generator.uniform(-1.0, 1.0, shape)
        if name in self._bounds:
            missing = generator.random(shape) < sensors.dropout
            before, room = self._bounds[name]
            slowest = before - self._leader_speed_drop
            moved = np.maximum(slowest - sensors.speed_error, 0.0) - state.speed
            leader = np.where(missing, slowest, leader)
            gap = np.where(missing, room + self._step * moved, gap)
        self._bounds[name] = leader, gap
        return (
            FollowingState(state.speed, leader, gap)
            if shape
            else FollowingState(state.speed, float(leader), float(gap))
        )

    def read_for_driver(self, names: Sequence[str], state: LocalState) -> LocalState:
        """Return what drivers perceive where `state` is true; what is missing is what was read last.

        Arrays of one row for each of the `names`, or plain numbers of a single CAV.
        """
        sensors, generator = self._sensors, self._driver_generator
        single = isinstance(state.speed, float)
        true = np.array([state.leader_gap, state.follower_gap, state.leader_speed, state.follower_speed])
        errors = np.repeat([sensors.gap_error, sensors.speed_error], 2)[:, None]
        least = np.repeat([MIN_SENSED_GAP, 0.0], 2)[:, None]
        true = true.reshape(4, len(names))
        read = np.maximum(true + errors * generator.uniform(-1.0, 1.0, true.shape), least)
        for column, missing in enumerate(generator.random(len(names)) < sensors.dropout):
            if missing:
                read[:, column] = self._last_readings.get(names[column], read[:, column])
        self._last_readings = dict(zip(names, read.T, strict=True))
        ahead, behind, leader, follower = read[:, 0].tolist() if single else read
        return state._replace(leader_gap=ahead, follower_gap=behind, leader_speed=leader, follower_speed=follower)
