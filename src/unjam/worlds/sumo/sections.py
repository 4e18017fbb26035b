"""Sections of the lanes of a user's network, and roadside information about the sections ahead of a CAV."""

from collections import defaultdict
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from itertools import accumulate, pairwise
from math import ceil, inf

import numpy as np

from unjam.drivers.local_state import ROAD_SECTION_LENGTH, SECTIONS_AHEAD
from unjam.drivers.roadside import CongestionMonitor, RoadsideMessages
from unjam.physics.arrays import Floats
from unjam.worlds.sumo.networks import NetworkLane
from unjam.worlds.sumo.simulation import Simulation

NO_SECTION = -1
"""index of a section beyond the end of a route"""
MAX_QUEUE_LENGTH = 1000.0
"""distance before a stop line within which slow vehicles may be a queue, so that no congestion is reported [m]"""
MIN_MONITORED_LENGTH = 50.0
"""minimum length of a section that has enough vehicles to detect congestion [m]"""


class LaneSections:
    """Sections of all lanes outside of junctions, of `ROAD_SECTION_LENGTH`; the last section of a lane is shorter."""

    def __init__(self, simulation: Simulation) -> None:
        self._lanes = {lane.name: lane for lane in simulation.lanes()}
        counts = [max(1, ceil(lane.length / ROAD_SECTION_LENGTH)) for lane in self._lanes.values()]
        self._section_ranges = dict(zip(self._lanes, pairwise([0, *accumulate(counts)]), strict=True))
        """indices of the first section of each lane and of the next lane"""
        lanes = zip(self._lanes.values(), counts, strict=True)
        sections = [(lane, index) for lane, count in lanes for index in range(count)]
        self.speed_limits: Floats = np.array([lane.speed_limit for lane, _ in sections])
        rows: dict[tuple[str, int], int] = {}
        cross_sections = [rows.setdefault((lane.edge, index), len(rows)) for lane, index in sections]
        self.cross_sections = np.array(cross_sections, np.intp)
        """index of the cross-section that each section forms with the sections of adjacent lanes"""
        distances = distances_to_stop_lines(self._lanes)
        remaining = np.array([lane.length - ROAD_SECTION_LENGTH * index for lane, index in sections])
        distance = np.array([distances.get(lane.name, inf) for lane, _ in sections])
        self.is_monitored = (remaining >= MIN_MONITORED_LENGTH) & (remaining + distance > MAX_QUEUE_LENGTH)
        """whether congestion is reported in each section"""

    def __contains__(self, lane: str) -> bool:
        return lane in self._lanes

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> tuple[Floats, Floats]:
        """Return the number of vehicles in each section, and the sum of their speeds [m/s].

        `lane_positions` has the lane of each vehicle and its position on the lane [m].
        """
        count = len(self.speed_limits)
        sections = [self._section_at(lane, position) if lane in self else count for lane, position in lane_positions]
        vehicles, total = (np.bincount(sections, weight, count + 1)[:count] for weight in (None, speeds))
        return vehicles.astype(np.float64), total.astype(np.float64)

    def sections_ahead(self, lane: str, position: float, route: Sequence[str]) -> list[int]:
        """Return the section of a vehicle and the sections in which the centers of the next 100 m ranges lie.

        `route` has the current edge and the following ones. If a lane does not lead to the next edge, an adjacent lane
        is used. Beyond the end of the route, the section is `NO_SECTION`.
        """
        sections, edges, length = [self._section_at(lane, position)], iter(route[1:]), self._lanes[lane].length
        end = min((position // ROAD_SECTION_LENGTH + 1) * ROAD_SECTION_LENGTH, length)
        center = end - ROAD_SECTION_LENGTH / 2
        for _ in range(1, SECTIONS_AHEAD):
            center += ROAD_SECTION_LENGTH
            while lane and center >= length:
                center -= length
                lane = self._next_lane(lane, next(edges, ""))
                length = self._lanes[lane].length if lane else inf
            sections.append(self._section_at(lane, center) if lane else NO_SECTION)
        return sections

    def _section_at(self, lane: str, position: float) -> int:
        first, end = self._section_ranges[lane]
        return min(first + int(position // ROAD_SECTION_LENGTH), end - 1)

    def _next_lane(self, lane: str, edge: str) -> str:
        """Return the lane of the next edge to which a lane leads; empty without a next edge."""
        if not edge:
            return ""
        successors = [name for name in self._lanes[lane].successors if name in self and self._lanes[name].edge == edge]
        adjacent = (f"{edge}_{number}" for number in range(int(lane.rpartition("_")[2]), -1, -1))
        return next((name for name in (*successors, *adjacent) if name in self), "")


class RoadsideService:
    """Roadside information for CAVs; within a junction, they keep the information of the lane before it."""

    def __init__(self, simulation: Simulation, messages: RoadsideMessages, step: float) -> None:
        self._simulation, self._messages, self._sections = simulation, messages, LaneSections(simulation)
        self._monitor = CongestionMonitor(1 + int(self._sections.cross_sections.max()), step)
        self._last_sections: defaultdict[str, list[int]] = defaultdict(lambda: [NO_SECTION] * SECTIONS_AHEAD)
        self._desired_speeds: dict[str, tuple[float, float]] = {}
        """speed factor (desired speed divided by speed limit) and maximum speed [m/s] of each CAV"""

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> None:
        """Measure all vehicles, given lanes, positions on lanes [m] and speeds [m/s], and send the results to CAVs."""
        sections = self._sections
        counts, totals = sections.measure(lane_positions, speeds)
        means = np.where(counts > 0, totals / counts.clip(1), sections.speed_limits)
        indices = sections.cross_sections
        density, flow = (np.bincount(indices, sums).astype(np.float64) for sums in (counts, totals))
        is_congested = self._monitor.update(density, flow)[indices] & sections.is_monitored
        self._messages.send(np.stack([means, is_congested.astype(np.float64)]))

    def local_state_fields(self, ids: Sequence[str], positions: Sequence[tuple[str, float]]) -> dict[str, Floats]:
        """Return the CAVs' roadside information as fields of `LocalState`; `positions` are on their lanes [m]."""
        sections, desired = self._sections, self._desired_speeds
        routes = self._simulation.remaining_routes(ids)
        for vehicle_id, (lane, position), route in zip(ids, positions, routes, strict=True):
            if lane in sections:
                self._last_sections[vehicle_id] = sections.sections_ahead(lane, position, route)
        ahead = np.array([self._last_sections[vehicle_id] for vehicle_id in ids], np.intp).reshape(-1, SECTIONS_AHEAD)
        new = [vehicle_id for vehicle_id in ids if vehicle_id not in desired]
        desired |= zip(new, self._simulation.desired_speeds(new), strict=True)  # before any set-speed cap
        factors, max_speeds = np.array([desired[vehicle_id] for vehicle_id in ids]).reshape(-1, 2).T
        limits = np.where(ahead[:, 0] == NO_SECTION, inf, sections.speed_limits[ahead[:, 0]])
        allowed = np.minimum(limits * factors, max_speeds)
        means, congestion = self._messages.latest[:, ahead]
        is_beyond_route = ahead == NO_SECTION
        speeds = np.where(is_beyond_route, allowed[:, None], means)
        return {
            "allowed_speed": allowed,
            "lane_speeds": speeds,
            "congestion": np.where(is_beyond_route, 0.0, congestion),
        }


def distances_to_stop_lines(lanes: dict[str, NetworkLane]) -> dict[str, float]:
    """Return the distances from the ends of lanes to the next stop line, if it is within `MAX_QUEUE_LENGTH` [m]."""
    predecessors = defaultdict[str, list[str]](list)
    for lane in lanes.values():
        for successor in lane.successors:
            predecessors[successor].append(lane.name)
    distances: dict[str, float] = {}
    heap = [(0.0, lane.name) for lane in lanes.values() if lane.has_stop_line]
    heapify(heap)
    while heap:
        distance, name = heappop(heap)
        if name not in distances and distance < MAX_QUEUE_LENGTH:
            distances[name] = distance
            for predecessor in predecessors[name]:
                heappush(heap, (distance + lanes[name].length, predecessor))
    return distances
