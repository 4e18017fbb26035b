"""The lanes of a user's network in sections, and what a service tells CAVs of those ahead on their routes."""

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
"""the section behind the end of a route"""
MAX_QUEUE_LENGTH = 1000.0
"""before a stop line, slow vehicles may be its queue: no congestion is reported there [m]"""
MIN_MONITORED_LENGTH = 50.0
"""of a shorter section too few vehicles are measured to tell congestion from free flow [m]"""


class LaneSections:
    """All lanes cut into sections of `ROAD_SECTION_LENGTH` metres, the last of each shorter; junctions are none."""

    def __init__(self, simulation: Simulation) -> None:
        """Ask the simulator which lanes there are."""
        self._lanes = {lane.name: lane for lane in simulation.lanes()}
        counts = [max(1, ceil(lane.length / ROAD_SECTION_LENGTH)) for lane in self._lanes.values()]
        firsts = [0, *accumulate(counts)]
        self._section_ranges = dict(zip(self._lanes, pairwise(firsts), strict=True))
        """of each lane the number of its first section, and of the next lane's"""
        pieces = [
            (lane, number) for lane, count in zip(self._lanes.values(), counts, strict=True) for number in range(count)
        ]
        self.speed_limits: Floats = np.array([lane.speed_limit for lane, _ in pieces])
        """what each section allows [m/s]"""
        rows: dict[tuple[str, int], int] = {}
        self.cross_sections = np.array(
            [rows.setdefault((lane.edge, number), len(rows)) for lane, number in pieces], np.intp
        )
        """of each section a number that it shares with those of the adjacent lanes"""
        to_stop_line = distances_to_stop_lines(self._lanes)
        rest = np.array([lane.length - ROAD_SECTION_LENGTH * number for lane, number in pieces])
        way = np.array([to_stop_line.get(lane.name, inf) for lane, _ in pieces])
        self.is_monitored = (rest >= MIN_MONITORED_LENGTH) & (rest + way > MAX_QUEUE_LENGTH)
        """whether congestion is reported of a section"""

    def __contains__(self, lane: str) -> bool:
        """Whether a lane is no junction's."""
        return lane in self._lanes

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> tuple[Floats, Floats]:
        """Return the number of vehicles in each section, and the sum of their speeds [m/s].

        Of each vehicle: its lane and how far along it is [m], and its speed.
        """
        count = len(self.speed_limits)
        cells = [self._section_at(*place) if place[0] in self._section_ranges else count for place in lane_positions]
        there, total = (np.bincount(cells, weight, count + 1)[:count] for weight in (None, speeds))
        return there.astype(np.float64), total.astype(np.float64)

    def sections_ahead(self, lane: str, position: float, route: Sequence[str]) -> list[int]:
        """Return the sections ahead, that of the vehicle first; `route` has its edge and those that follow.

        The others are those in which the middles of the next hundreds of metres lie. Where a lane does not
        lead along the route, it goes on with the lane beside; behind the end of the route is `NOWHERE`.
        """
        found, way, length = [self._section_at(lane, position)], iter(route[1:]), self._lanes[lane].length
        place = (
            min((position // ROAD_SECTION_LENGTH + 1) * ROAD_SECTION_LENGTH, length) - ROAD_SECTION_LENGTH / 2
        )  # half a section before its end
        for _ in range(1, SECTIONS_AHEAD):
            place += ROAD_SECTION_LENGTH
            while lane and place >= length:
                place -= length
                lane = self._next_lane(lane, next(way, ""))
                length = self._lanes[lane].length if lane else inf
            found.append(self._section_at(lane, place) if lane else NO_SECTION)
        return found

    def _section_at(self, lane: str, position: float) -> int:
        first, end = self._section_ranges[lane]
        return min(first + int(position // ROAD_SECTION_LENGTH), end - 1)

    def _next_lane(self, lane: str, edge: str) -> str:
        """Return the lane of the next edge that a lane leads to; empty behind the end of the route."""
        lanes = self._lanes
        if not edge:
            return ""
        for following in lanes[lane].successors:
            if following in lanes and lanes[following].edge == edge:
                return following
        beside = (f"{edge}_{number}" for number in range(int(lane.rpartition("_")[2]), -1, -1))
        return next((name for name in beside if name in lanes), "")


class RoadsideService:
    """What CAVs are told of the road ahead; in a junction, of that before which they last were in a lane."""

    def __init__(self, simulation: Simulation, messages: RoadsideMessages, step: float) -> None:
        """Begin where nothing was measured yet; `step` is the time between two measurements [s]."""
        self._simulation, self._messages, self._sections = simulation, messages, LaneSections(simulation)
        self._monitor = CongestionMonitor(1 + int(self._sections.cross_sections.max()), step)
        self._last_sections: dict[str, list[int]] = {}
        """of each CAV the sections ahead when it was last in a lane"""
        self._desired_speeds: dict[str, tuple[float, float]] = {}
        """of each CAV how fast it wants to drive over what is allowed, and at most [m/s]"""

    def measure(self, lane_positions: Sequence[tuple[str, float]], speeds: Floats) -> None:
        """Take where everybody is, in which lane and how far along it [m], and how fast."""
        sections = self._sections
        counts, totals = sections.measure(lane_positions, speeds)
        means = np.where(counts > 0, totals / counts.clip(1), sections.speed_limits)
        across = sections.cross_sections
        density, flow = (np.bincount(across, each).astype(np.float64) for each in (counts, totals))
        congested = self._monitor.update(density, flow)[across] & sections.is_monitored
        self._messages.send(np.stack([means, congested.astype(np.float64)]))

    def local_state_fields(
        self, names: Sequence[str], lane_positions: Sequence[tuple[str, float]]
    ) -> dict[str, Floats]:
        """Return what these CAVs are told, by field of a `LocalState`."""
        sections, wishes = self._sections, self._desired_speeds
        for name, place, way in zip(names, lane_positions, self._simulation.remaining_routes(names), strict=True):
            if place[0] in sections:
                self._last_sections[name] = sections.sections_ahead(*place, way)
        unknown = [NO_SECTION] * SECTIONS_AHEAD
        ahead = np.array([self._last_sections.get(name, unknown) for name in names], np.intp).reshape(
            -1, SECTIONS_AHEAD
        )
        new = [name for name in names if name not in wishes]
        wishes |= zip(new, self._simulation.desired_speeds(new), strict=True)  # before anybody is held back
        factors, fastest = np.array([wishes[name] for name in names]).reshape(-1, 2).T
        legal = np.where(ahead[:, 0] == NO_SECTION, inf, sections.speed_limits[ahead[:, 0]])
        allowed = np.minimum(legal * factors, fastest)
        means, congestion = self._messages.latest[:, ahead]
        beyond = ahead == NO_SECTION
        speeds = np.where(beyond, allowed[:, None], means)
        return {"allowed_speed": allowed, "lane_speeds": speeds, "congestion": np.where(beyond, 0.0, congestion)}


def distances_to_stop_lines(lanes: dict[str, NetworkLane]) -> dict[str, float]:
    """Return how far the end of a lane is before the nearest stop line that it leads to [m], by lane."""
    before: dict[str, list[str]] = {}
    for lane in lanes.values():
        for following in lane.successors:
            before.setdefault(following, []).append(lane.name)
    found: dict[str, float] = {}
    nearest = [(0.0, lane.name) for lane in lanes.values() if lane.has_stop_line]
    heapify(nearest)
    while nearest:
        way, name = heappop(nearest)
        if name not in found and way < MAX_QUEUE_LENGTH:
            found[name] = way
            for other in before.get(name, ()):
                heappush(nearest, (way + lanes[name].length, other))
    return found
