"""The lanes of a user's network in sections, and what a service tells CAVs of those ahead on their routes."""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import ceil, inf

import numpy as np

from unjam.drivers.local_state import SECTION, SECTIONS_AHEAD
from unjam.drivers.roadside import Messages
from unjam.physics.arrays import Floats
from unjam.worlds.sumo.simulation import Simulation

NOWHERE = -1
"""the section behind the end of a route"""


class LaneSections:
    """All lanes cut into sections of `SECTION` metres, the last of each shorter; junctions are none."""

    def __init__(self, simulation: Simulation) -> None:
        """Ask the simulator which lanes there are."""
        self._lanes = {lane.name: lane for lane in simulation.lanes()}
        counts = [max(1, ceil(lane.length / SECTION)) for lane in self._lanes.values()]
        firsts = [0, *accumulate(counts)]
        self._ends = dict(zip(self._lanes, pairwise(firsts), strict=True))
        """of each lane the number of its first section, and of the next lane's"""
        self.allowed: Floats = np.repeat([lane.speed for lane in self._lanes.values()], counts)
        """what each section allows [m/s]"""

    def __contains__(self, lane: str) -> bool:
        """Whether a lane is no junction's."""
        return lane in self._lanes

    def means(self, places: Sequence[tuple[str, float]], speeds: Floats) -> Floats:
        """Return the mean speed in each section; where nobody is, what it allows [m/s].

        Of each vehicle: its lane and how far along it is [m], and its speed.
        """
        count = len(self.allowed)
        cells = [self._section(*place) if place[0] in self._ends else count for place in places]
        there = np.bincount(cells, minlength=count + 1)[:count]
        total = np.bincount(cells, speeds, minlength=count + 1)[:count]
        return np.where(there > 0, total / there.clip(1), self.allowed)

    def ahead(self, lane: str, along: float, route: Sequence[str]) -> list[int]:
        """Return the sections ahead, that of the vehicle first; `route` has its edge and those that follow.

        The others are those in which the middles of the next hundreds of metres lie. Where a lane does not
        lead along the route, it goes on with the lane beside; behind the end of the route is `NOWHERE`.
        """
        found, way, length = [self._section(lane, along)], iter(route[1:]), self._lanes[lane].length
        place = min((along // SECTION + 1) * SECTION, length) - SECTION / 2  # half a section before its end
        for _ in range(1, SECTIONS_AHEAD):
            place += SECTION
            while lane and place >= length:
                place -= length
                lane = self._next(lane, next(way, ""))
                length = self._lanes[lane].length if lane else inf
            found.append(self._section(lane, place) if lane else NOWHERE)
        return found

    def _section(self, lane: str, along: float) -> int:
        first, end = self._ends[lane]
        return min(first + int(along // SECTION), end - 1)

    def _next(self, lane: str, edge: str) -> str:
        """Return the lane of the next edge that a lane leads to; empty behind the end of the route."""
        lanes = self._lanes
        if not edge:
            return ""
        for following in lanes[lane].leads_to:
            if following in lanes and lanes[following].edge == edge:
                return following
        beside = (f"{edge}_{number}" for number in range(int(lane.rpartition("_")[2]), -1, -1))
        return next((name for name in beside if name in lanes), "")


class RoadAhead:
    """What CAVs are told of the road ahead; in a junction, of that before which they last were in a lane."""

    def __init__(self, simulation: Simulation, messages: Messages) -> None:
        """Begin where nothing was measured yet."""
        self._simulation, self._messages, self._sections = simulation, messages, LaneSections(simulation)
        self._last: dict[str, list[int]] = {}
        """of each CAV the sections ahead when it was last in a lane"""
        self._wishes: dict[str, tuple[float, float]] = {}
        """of each CAV how fast it wants to drive over what is allowed, and at most [m/s]"""

    def measure(self, places: Sequence[tuple[str, float]], speeds: Floats) -> None:
        """Take where everybody is, in which lane and how far along it [m], and how fast."""
        self._messages.send(self._sections.means(places, speeds))

    def told(self, names: Sequence[str], places: Sequence[tuple[str, float]]) -> dict[str, Floats]:
        """Return what these CAVs are told, by field of a `LocalState`."""
        sections, wishes = self._sections, self._wishes
        for name, place, way in zip(names, places, self._simulation.ways(names), strict=True):
            if place[0] in sections:
                self._last[name] = sections.ahead(*place, way)
        beyond = [NOWHERE] * SECTIONS_AHEAD
        ahead = np.array([self._last.get(name, beyond) for name in names], np.intp).reshape(
            -1, SECTIONS_AHEAD
        )
        new = [name for name in names if name not in wishes]
        wishes |= zip(new, self._simulation.wishes(new), strict=True)  # before anybody is held back
        factors, fastest = np.array([wishes[name] for name in names]).reshape(-1, 2).T
        legal = np.where(ahead[:, 0] == NOWHERE, inf, sections.allowed[ahead[:, 0]])
        allowed = np.minimum(legal * factors, fastest)
        speeds = np.where(ahead == NOWHERE, allowed[:, None], self._messages.arrived[ahead])
        return {"allowed_speed": allowed, "lane_speeds": speeds}
