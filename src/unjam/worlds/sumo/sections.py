"""Road sections of a user's network, and the roadside information about those ahead of a CAV."""

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
MAX_QUEUE_LENGTH = 1000.0
"""distance before a stop line within which slow vehicles may be its queue: no congestion is reported there [m]"""
MIN_MONITORED_LENGTH = 50.0
"""minimum length of a section in which enough vehicles are measured to detect congestion [m]"""


class LaneSections:
    """All lanes, divided into sections of `ROAD_SECTION_LENGTH`, the last of each shorter; without junctions."""

    def __init__(self, simulation: Simulation) -> None:
        self._lanes = {lane.name: lane for lane in simulation.lanes()}
        counts = [max(1, ceil(lane.length / ROAD_SECTION_LENGTH)) for lane in self._lanes.values()]
        self._section_ranges = dict(zip(self._lanes, pairwise([0, *accumulate(counts)]), strict=True))
        """number of each lane's first section, and of the next lane's"""
        lanes = zip(self._lanes.values(), counts, strict=True)
        sections = [(lane, number) for lane, count in lanes for number in range(count)]
        self.speed_limits: Floats = np.array([lane.speed_limit for lane, _ in sections])
        rows: dict[tuple[str, int], int] = {}
        cross_sections = [rows.setdefault((lane.edge, number), len(rows)) for lane, number in sections]
        self.cross_sections = np.array(cross_sections, np.intp)
        """number that each section shares with those of the adjacent lanes"""
        distances = distances_to_stop_lines(self._lanes)
        remaining = np.array([lane.length - ROAD_SECTION_LENGTH * number for lane, number in sections])
        distance = np.array([distances.get(lane.name, inf) for lane, _ in sections])
        self.is_monitored = (remaining >= MIN_MONITORED_LENGTH) & (remaining + distance > MAX_QUEUE_LENGTH)

    def __contains__(self, lane: str) -> bool:
        return lane in self._lanes

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> tuple[Floats, Floats]:
        """Return the number of vehicles in each section, and the sum of their speeds [m/s]; positions in [m]."""
        count = len(self.speed_limits)
        cells = [self._section_at(*each) if each[0] in self else count for each in lane_positions]
        vehicles, total = (np.bincount(cells, weight, count + 1)[:count] for weight in (None, speeds))
        return vehicles.astype(np.float64), total.astype(np.float64)

    def sections_ahead(self, lane: str, position: float, route: Sequence[str]) -> list[int]:
        """Return a vehicle's own section and those ahead, which contain the centers of the next 100 m ranges.

        `route` has its edge and the following ones. Where a lane does not follow it, an adjacent lane does; beyond its
        end is `NO_SECTION`.
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
        """Return the lane of the next edge to which a lane leads; empty beyond the end of the route."""
        if not edge:
            return ""
        successors = [name for name in self._lanes[lane].successors if name in self and self._lanes[name].edge == edge]
        adjacent = (f"{edge}_{number}" for number in range(int(lane.rpartition("_")[2]), -1, -1))
        return next((name for name in (*successors, *adjacent) if name in self), "")


class RoadsideService:
    """Roadside information for CAVs; in a junction, that of the last lane before it."""

    def __init__(self, simulation: Simulation, messages: RoadsideMessages, step: float) -> None:
        self._simulation, self._messages, self._sections = simulation, messages, LaneSections(simulation)
        self._monitor = CongestionMonitor(1 + int(self._sections.cross_sections.max()), step)
        self._last_sections: defaultdict[str, list[int]] = defaultdict(lambda: [NO_SECTION] * SECTIONS_AHEAD)
        self._desired_speeds: dict[str, tuple[float, float]] = {}
        """desired speed over the speed limit, and maximum speed [m/s], of each CAV"""

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> None:
        """Measure all vehicles, with their lanes, positions along them [m] and speeds [m/s], and send the results."""
        sections = self._sections
        counts, totals = sections.measure(lane_positions, speeds)
        means = np.where(counts > 0, totals / counts.clip(1), sections.speed_limits)
        across = sections.cross_sections
        density, flow = (np.bincount(across, each).astype(np.float64) for each in (counts, totals))
        is_congested = self._monitor.update(density, flow)[across] & sections.is_monitored
        self._messages.send(np.stack([means, is_congested.astype(np.float64)]))

    def local_state_fields(self, names: Sequence[str], positions: Sequence[tuple[str, float]]) -> dict[str, Floats]:
        """Return the fields of a `LocalState` with the CAVs' roadside information."""
        sections, desired = self._sections, self._desired_speeds
        for name, place, route in zip(names, positions, self._simulation.remaining_routes(names), strict=True):
            if place[0] in sections:
                self._last_sections[name] = sections.sections_ahead(*place, route)
        ahead = np.array([self._last_sections[name] for name in names], np.intp).reshape(-1, SECTIONS_AHEAD)
        new = [name for name in names if name not in desired]
        desired |= zip(new, self._simulation.desired_speeds(new), strict=True)  # before any set-speed cap
        factors, max_speeds = np.array([desired[name] for name in names]).reshape(-1, 2).T
        limits = np.where(ahead[:, 0] == NO_SECTION, inf, sections.speed_limits[ahead[:, 0]])
        allowed = np.minimum(limits * factors, max_speeds)
        means, congestion = self._messages.latest[:, ahead]
        is_beyond = ahead == NO_SECTION
        speeds = np.where(is_beyond, allowed[:, None], means)
        return {"allowed_speed": allowed, "lane_speeds": speeds, "congestion": np.where(is_beyond, 0.0, congestion)}


def distances_to_stop_lines(lanes: dict[str, NetworkLane]) -> dict[str, float]:
    """Return the distance from the end of each lane to the nearest stop line that it leads to [m]."""
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
            for other in predecessors[name]:
                heappush(heap, (distance + lanes[name].length, other))
    return distances
