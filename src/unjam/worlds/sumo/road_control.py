"""Variable speed limits and ramp meters of a motorway in SUMO, and set-speed caps of vehicles."""

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
"""gap in front of a vehicle in the queue at the meter [m]"""
BRAKING_DISTANCE = 150.0
"""length of the ramp that the queue leaves free, for vehicles that arrive fast [m]"""
LIMIT_DECELERATION = 1.0
"""deceleration of vehicles towards a lower speed limit [m/s2]"""


class SpeedCaps:
    """Caps of the maximum speeds of vehicles, from several sources: the lowest one applies."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._caps: dict[str, dict[Hashable, float]] = {}
        self.own_max_speeds: dict[str, float] = {}
        """maximum speed without caps of each vehicle that has a cap [m/s]"""

    def vehicles_with_cap(self, source: Hashable) -> list[str]:
        """Return the vehicles with a cap from a source, including vehicles that have left the road."""
        return [vehicle_id for vehicle_id, caps in self._caps.items() if source in caps]

    def set_cap(self, vehicle_id: str, source: Hashable, cap: float) -> None:
        """Set the cap of a vehicle on the road from one source [m/s]; an infinite cap is removed."""
        caps = self._caps.get(vehicle_id)
        if caps is None:
            if cap == inf:
                return
            caps = self._caps[vehicle_id] = {}
            self.own_max_speeds[vehicle_id] = self._simulation.max_speed(vehicle_id)
        if cap < inf:
            caps[source] = cap
        elif caps.pop(source, None) is None:
            return
        self._simulation.set_max_speed(vehicle_id, min(self.own_max_speeds[vehicle_id], *caps.values(), inf))
        if not caps:
            self.remove(vehicle_id)

    def remove(self, vehicle_id: str) -> None:
        """Remove a vehicle that has no cap, or has left the road."""
        self._caps.pop(vehicle_id, None)
        self.own_max_speeds.pop(vehicle_id, None)


class ControlledVehicles(NamedTuple):
    """The vehicles on the road; arrays have shape (vehicles,)."""

    vehicle_ids: list[str]
    lanes: NDArray[np.intp]
    """lane indices; 0 is the lane of the ramps"""
    positions: Floats
    """positions of front bumpers along the road [m]"""
    speeds: Floats
    """[m/s]"""
    lengths: Floats


class RampControl:
    """Controller of the variable speed limit and the ramp meter at one ramp."""

    def __init__(
        self, simulation: Simulation, speed_caps: SpeedCaps, scenario: Motorway, ramp: RampGeometry, ramp_edge: str
    ) -> None:
        self._simulation, self._speed_caps, self._ramp, self._edge = simulation, speed_caps, ramp, ramp_edge
        self._limits, self._meter = scenario.speed_limit_control, scenario.ramp_meter
        self._lanes, self._speed_limit, self._step = scenario.lanes, scenario.speed_limit, scenario.simulation_step
        self._share, self._rate, self._limit = 1.0, self._meter.rates[1], scenario.speed_limit
        """current share of the unlimited speed, rate of the meter [veh/h] and speed limit [m/s]"""
        self._queue: list[str] = []
        """vehicles that must stop at the meter, in order of their arrival"""
        self._seen_on_ramp = set[str]()
        """vehicles that have been on the ramp: the meter stops each at most once"""
        self._time, self._wait = 0.0, 0.0
        """time since the start, and until the meter may release the next vehicle [s]"""

    def control(self, vehicles: ControlledVehicles) -> None:
        """Measure the density, and set the speed limit and the meter for this simulation step."""
        self._time += self._step
        end = self._ramp.merge_end + MEASURED_DOWNSTREAM
        positions = vehicles.positions
        is_measured = (vehicles.lanes > 0) & (positions >= self._ramp.merge_start) & (positions < end)
        density = 1000.0 * float(is_measured.sum()) / (end - self._ramp.merge_start) / self._lanes
        if self._limits.active:
            if self._is_due(self._limits.interval):
                self._share = self._limits.next_share(self._share, density, self._speed_limit)
                self._limit = self._limits.posted_limit(self._share, self._speed_limit)
            self._limit_speeds(vehicles)
        if self._meter.active:
            if self._is_due(self._meter.interval):
                self._rate = self._meter.next_rate(self._rate, density)
            self._meter_ramp(vehicles)

    def _is_due(self, interval: float) -> bool:
        """Return whether an interval [s] has just ended."""
        return self._time % interval < self._step - 1e-9

    def _limit_speeds(self, vehicles: ControlledVehicles) -> None:
        """Cap the speeds of vehicles where the speed limit applies, and end the caps of those that have passed."""
        ids, positions = vehicles.vehicle_ids, vehicles.positions
        limit_end = self._ramp.merge_start - self._limits.acceleration_length
        is_limited = (vehicles.lanes > 0) & (positions < limit_end) & (positions >= limit_end - self._limits.length)
        is_limited &= self._limit < self._speed_limit
        # Drivers do not brake hard for a speed sign.
        caps = np.maximum(self._limit, vehicles.speeds - LIMIT_DECELERATION * self._step)
        new_caps = {ids[row]: float(caps[row]) for row in np.flatnonzero(is_limited).tolist()}
        present = set(ids)
        for vehicle_id in self._speed_caps.vehicles_with_cap(self):
            if vehicle_id not in present:
                self._speed_caps.remove(vehicle_id)
            elif vehicle_id not in new_caps:
                self._speed_caps.set_cap(vehicle_id, self, inf)
        for vehicle_id, cap in new_caps.items():
            self._speed_caps.set_cap(vehicle_id, self, cap)

    def _meter_ramp(self, vehicles: ControlledVehicles) -> None:
        """Let vehicles stop at the meter, and release them one by one, at the highest rate if the queue is long."""
        stop_line, max_rate = self._ramp.merge_start - self._meter.distance_to_merge, self._meter.rates[1]
        is_upstream = (
            (vehicles.lanes == 0) & (vehicles.positions < stop_line) & (vehicles.positions >= self._ramp.start)
        )
        queue_length = float((vehicles.lengths[is_upstream] + QUEUE_GAP).sum())
        rate = max_rate if queue_length > stop_line - self._ramp.start - BRAKING_DISTANCE else self._rate
        is_off = self._rate >= max_rate and not self._queue
        for row in np.flatnonzero(is_upstream).tolist():
            if (vehicle_id := vehicles.vehicle_ids[row]) not in self._seen_on_ramp:
                self._seen_on_ramp.add(vehicle_id)
                if not is_off:
                    self._simulation.stop_at(vehicle_id, self._edge, stop_line - self._ramp.start)
                    self._queue.append(vehicle_id)
        self._wait = max(0.0, self._wait - self._step)
        if self._queue and self._wait <= 0.0:
            self._simulation.end_stop(self._queue.pop(0), self._edge, stop_line - self._ramp.start)
            self._wait = 3600.0 / rate
