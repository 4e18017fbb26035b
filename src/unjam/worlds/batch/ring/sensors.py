"""Sensor readings of the CAVs of many rings, with the same errors as in SUMO's episodes of the same seeds."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.drivers.sensors import SensorReadings
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.noise import ArrayFactory, WorldSeeds
from unjam.worlds.batch.ring.record import as_numpy


class RingReadings:
    """Readings of W rings; each ring has its own generators and calls them in the same order as SUMO's worlds."""

    def __init__(self, scenario: Scenario, cav_ids: Sequence[str], seeds: WorldSeeds, to_array: ArrayFactory) -> None:
        sensors, braking = scenario.sensors, scenario.safety.leader_braking
        self._ring_readings = [
            SensorReadings(sensors, braking, scenario.simulation_step, seed)
            for *_, seed in (() if sensors.is_exact else seeds)
        ]
        self._cav_ids, self._to_array, self._shape = cav_ids, to_array, (len(cav_ids), len(seeds))
        self._cached_readings: tuple[int, LocalState] | None = None

    def read_for_drivers(self, step_index: int, true_state: LocalState) -> LocalState:
        """Return the drivers' readings of the true state, the same for all calls in a control step."""
        if not self._ring_readings:
            return true_state
        if self._cached_readings is None or self._cached_readings[0] != step_index:
            true = true_state.map(lambda values: as_numpy(values).reshape(self._shape))
            first, *others = (
                readings.read_for_driver(self._cav_ids, true.select(np.s_[:, ring]))
                for ring, readings in enumerate(self._ring_readings)
            )
            read = first.map(lambda *values: self._to_array(np.stack(values, 1).reshape(-1)), *others)
            self._cached_readings = step_index, read
        return self._cached_readings[1]

    def read_for_filters(self, true_state: FollowingState) -> FollowingState:
        """Return the safety filters' readings of the true state, for one call in each simulation step."""
        if not self._ring_readings:
            return true_state
        cavs = product(self._cav_ids, self._ring_readings)
        rows = np.stack([as_numpy(values) for values in true_state], 1).tolist()
        read = [ring.read_for_filter(name, FollowingState(*row)) for (name, ring), row in zip(cavs, rows, strict=True)]
        return FollowingState(*self._to_array(np.array(read).T))
