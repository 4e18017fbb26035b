"""Variable speed limits and ramp meters of a motorway in SUMO, and caps of vehicles' speeds from several sources."""

from collections.abc import Hashable
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import RampGeometry
from unjam.scenarios.road_control import MEASURED_DOWNSTREAM
from unjam.worlds.sumo.simulation import Simulation

QUEUE_GAP = 3.0
"""length of the ramp that a queuing vehicle needs in front of it [m]"""
BRAKING_DISTANCE = 150.0
"""length of the ramp that stays free for vehicles that enter it at speed [m]"""
LIMIT_DECELERATION = 1.0
"""braking of vehicles towards a lower speed limit [m/s2]"""


class SpeedCaps:
    """The caps of all vehicles; a vehicle without one has its own maximum speed."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._caps: dict[str, dict[Hashable, float]] = {}
        self.own_max_speeds: dict[str, float] = {}
        """maximum speeds of the vehicles that have a cap, without it [m/s]"""

    def vehicles_with_cap(self, source: Hashable) -> list[str]:
        """Return the vehicles that have a cap from a source; some of them may have left the road."""
        return [name for name, caps in self._caps.items() if source in caps]

    def set_cap(self, name: str, source: Hashable, cap: float) -> None:
        """Set the cap of a vehicle on the road from one source [m/s]; infinite: none."""
        caps = self._caps.get(name)
        if caps is None:
            if cap == inf:
                return
            caps = self._caps[name] = {}
            self.own_max_speeds[name] = self._simulation.max_speed(name)
        if cap < inf:
            caps[source] = cap
        elif caps.pop(source, None) is None:
            return
        self._simulation.set_max_speed(name, min(self.own_max_speeds[name], *caps.values(), inf))
        if not caps:
            self.remove(name)

    def remove(self, name: str) -> None:
        """Forget a vehicle that has no cap, or has left the road."""
        self._caps.pop(name, None)
        self.own_max_speeds.pop(name, None)


class ControlledVehicles(NamedTuple):
    """The vehicles on the road; arrays have shape (vehicles,)."""

    names: list[str]
    lanes: NDArray[np.intp]
    """lane index; 0 is that of the ramps"""
    positions: Floats
    """of front bumpers along the road [m]"""
    speeds: Floats
    """[m/s]"""
    lengths: Floats


class RampControl:
    """The speed limit and the meter at one ramp."""

    def __init__(
        self, simulation: Simulation, speed_caps: SpeedCaps, scenario: Motorway, ramp: RampGeometry, ramp_edge: str
    ) -> None:
        self._simulation, self._speed_caps, self._ramp, self._edge = simulation, speed_caps, ramp, ramp_edge
        self._limits, self._meter = scenario.speed_limit_control, scenario.ramp_meter
        self._lanes, self._speed_limit, self._step = scenario.lanes, scenario.speed_limit, scenario.simulation_step
        self._share, self._rate, self._limit = 1.0, self._meter.rates[1], scenario.speed_limit
        self._held: list[str] = []
        """vehicles that must stop at the meter, from the first one on"""
        self._known = set[str]()
        self._time, self._wait = 0.0, 0.0

    def control(self, vehicles: ControlledVehicles) -> None:
        """Measure and control in this simulation step."""
        self._time += self._step
        end = self._ramp.merge_end + MEASURED_DOWNSTREAM
        positions = vehicles.positions
        is_measured = (vehicles.lanes > 0) & (positions >= self._ramp.merge_start) & (positions < end)
        density = 1000.0 * float(is_measured.sum()) / (end - self._ramp.merge_start) / self._lanes
        if self._limits.active:
            if self._is_due(self._limits.interval):
                self._share = self._limits.next_share(self._share, density, self._speed_limit)
                self._limit = self._limits.limit(self._share, self._speed_limit)
            self._limit_speeds(vehicles)
        if self._meter.active:
            if self._is_due(self._meter.interval):
                self._rate = self._meter.next_rate(self._rate, density)
            self._meter_ramp(vehicles)

    def _is_due(self, interval: float) -> bool:
        return self._time % interval < self._step - 1e-9

    def _limit_speeds(self, vehicles: ControlledVehicles) -> None:
        """Limit the speeds of vehicles where the limit holds, and free those that have left."""
        names, positions = vehicles.names, vehicles.positions
        limit_end = self._ramp.merge_start - self._limits.acceleration_length
        is_limited = (vehicles.lanes > 0) & (positions < limit_end) & (positions >= limit_end - self._limits.length)
        is_limited &= self._limit < self._speed_limit
        # Drivers do not brake hard for a sign.
        caps = np.maximum(self._limit, vehicles.speeds - LIMIT_DECELERATION * self._step)
        limited = {names[row]: float(caps[row]) for row in np.flatnonzero(is_limited).tolist()}
        present = set(names)
        for name in self._speed_caps.vehicles_with_cap(self):
            if name not in present:
                self._speed_caps.remove(name)
            elif name not in limited:
                self._speed_caps.set_cap(name, self, inf)
        for name, cap in limited.items():
            self._speed_caps.set_cap(name, self, cap)

    def _meter_ramp(self, vehicles: ControlledVehicles) -> None:
        """Let vehicles stop at the meter, and release one after the other; faster if the queue is long."""
        line, highest = self._ramp.merge_start - self._meter.distance_to_merge, self._meter.rates[1]
        is_upstream = (vehicles.lanes == 0) & (vehicles.positions < line) & (vehicles.positions >= self._ramp.start)
        queue_length = float((vehicles.lengths[is_upstream] + QUEUE_GAP).sum())
        rate = highest if queue_length > line - self._ramp.start - BRAKING_DISTANCE else self._rate
        is_off = self._rate >= highest and not self._held
        for row in np.flatnonzero(is_upstream).tolist():
            if (name := vehicles.names[row]) not in self._known:
                self._known.add(name)
                if not is_off:
                    self._simulation.stop_at(name, self._edge, line - self._ramp.start)
                    self._held.append(name)
        self._wait = max(0.0, self._wait - self._step)
        if self._held and self._wait <= 0.0:
            self._simulation.end_stop(self._held.pop(0), self._edge, line - self._ramp.start)
            self._wait = 3600.0 / rate
