"""Variable speed limits and ramp meters of a motorway in SUMO."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import RampGeometry
from unjam.scenarios.road_control import MEASURED_DOWNSTREAM
from unjam.worlds.sumo.simulation import Simulation

QUEUE_SPACING = 8.0
"""length of the ramp that a queuing vehicle needs [m]"""
BRAKING_DISTANCE = 80.0
"""length of the ramp that stays free for vehicles that enter it at speed [m]"""


class RampControl:
    """The speed limit and the meter at one ramp."""

    def __init__(self, simulation: Simulation, scenario: Motorway, ramp: RampGeometry, ramp_edge: str) -> None:
        """Start with an unlimited speed and no metering."""
        self._simulation, self._ramp, self._edge = simulation, ramp, ramp_edge
        self._limits, self._meter = scenario.speed_limit_control, scenario.ramp_meter
        self._lanes, self._speed_limit, self._step = scenario.lanes, scenario.speed_limit, scenario.simulation_step
        self._share, self._rate, self._limit = 1.0, self._meter.rates[1], scenario.speed_limit
        self._max_speeds: dict[str, float] = {}
        """maximum speeds of the vehicles that have a limit, without it [m/s]"""
        self._held: list[str] = []
        """vehicles that must stop at the meter, from the first one on"""
        self._known = set[str]()
        """vehicles of the ramp"""
        self._time, self._wait = 0.0, 0.0

    def act(self, names: Sequence[str], lanes: NDArray[np.intp], positions: Floats) -> None:
        """Measure and control in this simulation step; the arrays have lane and position [m] of each vehicle."""
        self._time += self._step
        end = self._ramp.merge_end + MEASURED_DOWNSTREAM
        is_measured = (lanes > 0) & (positions >= self._ramp.merge_start) & (positions < end)
        density = 1000.0 * float(is_measured.sum()) / (end - self._ramp.merge_start) / self._lanes
        if self._limits.active:
            if self._is_due(self._limits.interval):
                self._share = self._limits.next_share(self._share, density, self._speed_limit)
                self._limit = self._limits.limit(self._share, self._speed_limit)
            self._limit_speeds(names, lanes, positions)
        if self._meter.active:
            if self._is_due(self._meter.interval):
                self._rate = self._meter.next_rate(self._rate, density)
            self._meter_ramp(names, lanes, positions)

    def _is_due(self, interval: float) -> bool:
        return self._time % interval < self._step - 1e-9

    def _limit_speeds(self, names: Sequence[str], lanes: NDArray[np.intp], positions: Floats) -> None:
        """Limit the speeds of vehicles where the limit holds, and free those that have left."""
        limit_end = self._ramp.merge_start - self._limits.acceleration_length
        is_limited = (lanes > 0) & (positions < limit_end) & (positions >= limit_end - self._limits.length)
        is_limited &= self._limit < self._speed_limit
        limited = {names[row] for row in np.flatnonzero(is_limited).tolist()}
        present = set(names)
        for name in [name for name in self._max_speeds if name not in limited]:
            max_speed = self._max_speeds.pop(name)
            if name in present:
                self._simulation.set_max_speed(name, max_speed)
        for name in sorted(limited):
            if name not in self._max_speeds:
                self._max_speeds[name] = self._simulation.max_speed(name)
            self._simulation.set_max_speed(name, min(self._limit, self._max_speeds[name]))

    def _meter_ramp(self, names: Sequence[str], lanes: NDArray[np.intp], positions: Floats) -> None:
        """Let vehicles stop at the meter, and release one after the other."""
        line = self._ramp.merge_start - self._meter.distance_to_merge
        upstream = (lanes == 0) & (positions < line) & (positions >= self._ramp.start)
        queue = [names[row] for row in np.flatnonzero(upstream).tolist()]
        room = (line - self._ramp.start - BRAKING_DISTANCE) / QUEUE_SPACING
        is_off = self._rate >= self._meter.rates[1] or len(queue) >= room
        for name in queue:
            if name not in self._known:
                self._known.add(name)
                if not is_off:
                    self._simulation.stop_at(name, self._edge, line - self._ramp.start)
                    self._held.append(name)
        self._wait = max(0.0, self._wait - self._step)
        released = len(self._held) if is_off else int(self._wait <= 0.0 and bool(self._held))
        for name in self._held[:released]:
            self._simulation.end_stop(name, self._edge, line - self._ramp.start)
            self._wait = 3600.0 / self._rate
        del self._held[:released]
