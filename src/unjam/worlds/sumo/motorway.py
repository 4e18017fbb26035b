"""Traffic of a motorway with lanes and ramps: SUMO drives people, who overtake; CAVs have their own ACC."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.roadside import MainRoad, Messages
from unjam.drivers.safety import Ahead
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.record import Floats
from unjam.worlds.sumo.files import CAV_TYPES
from unjam.worlds.sumo.lanes import Followed, LaneTraffic
from unjam.worlds.sumo.networks import network_file, network_lines
from unjam.worlds.world import OnProgress


class MotorwayTraffic(LaneTraffic[MotorwayRoad]):
    """The actual environment of a motorway."""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        road, scenario = self.road, self.scenario
        self._ways, self._starts, self._allowed = (
            np.array(each) for each in zip(*(lane[1:4] for lane in road.lanes), strict=True)
        )
        self._closing = {number for number, lane in enumerate(road.lanes) if lane.closing}
        self._factors = {entry.name: road.kinds[entry.kind].speed_factor for entry in road.entries}
        ways, step = int(self._ways.max()) + 1, scenario.decision_step
        self._main_road = MainRoad(ways, road.length)
        self._messages = Messages(road.roadside, step, self._noise_generator)
        self._came: list[bool] = []
        """of all who have entered, whether they are CAVs"""
        super().start(controlled, on_progress)

    @property
    def _cav_type(self) -> str:
        return CAV_TYPES

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        """Look who is where: SUMO's lanes, joined to ways, say who follows whom."""
        self._came += [name in self.road.cav_ids for name in entered]
        simulation, names, lanes = self._simulation, list[str](), list[int]()
        for number, lane in enumerate(self.road.lanes):
            there = simulation.on_lane(lane.name)
            names += there
            lanes += [number] * len(there)
        self._names, self._lanes = names, lanes
        self._row = {name: row for row, name in enumerate(names)}
        self._speed = np.array(simulation.speeds(names), np.float64)
        self._way = self._ways[lanes]
        self._place = self._starts[lanes] + np.array(simulation.along_lanes(names), np.float64)
        self._order = order = np.lexsort((self._place, self._way))
        same = self._way[order[1:]] == self._way[order[:-1]]
        self._leader, self._follower = np.full((2, len(names)), -1)
        self._leader[order[:-1][same]] = order[1:][same]
        self._follower[order[1:][same]] = order[:-1][same]

    def _everybody(self) -> tuple[Sequence[str], Floats]:
        return self._names, self._speed

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        rows = [self._row[name] for name in names]
        leaders = self._leader[rows]
        ahead = [self._names[leader] if leader >= 0 else "" for leader in leaders.tolist()]
        seen = self._speed[rows], self._speed[leaders], self._gap(rows, leaders)
        return list(map(Followed, ahead, *(values.tolist() for values in seen)))

    def _gap(self, rows: Any, leaders: Any) -> Floats:
        """Return the gaps of vehicles to their leaders [m]."""
        return self._place[leaders] - self.road.vehicle_length - self._place[rows]

    def _note_moment(self) -> None:
        means = self._main_road.means(self._way, self._place, self._speed, self.road.limit_speed)
        self._messages.send(means)

    def _pictured_now(self, names: Sequence[str]) -> dict[str, Any]:
        ahead = self._leader
        gaps = np.where(ahead >= 0, self._gap(np.arange(len(ahead)), ahead), np.nan)
        places = self._place - self.road.merge  # as on the merge: zero where the ways meet
        return {"positions": places, "gaps": gaps, "lanes": len(self.road.ways) - 1 - self._way}

    def _states(self, names: Sequence[str]) -> LocalState:
        rows = np.array([self._row[name] for name in names], np.intp)
        speed, place, way = self._speed[rows], self._place[rows], self._way[rows]
        leader, follower = self._leader[rows], self._follower[rows]
        ahead, behind = self._gap(rows, leader), self._gap(follower, rows)
        near, close = (leader >= 0) & (ahead < LARGEST_GAP), (follower >= 0) & (behind < LARGEST_GAP)
        factors = np.array([self._factors[name] for name in names])
        lane_speeds, road_speeds = self._main_road.ahead(self._messages.arrived, way, place)
        beside_gaps, beside_speeds = self._beside(rows)
        return LocalState(
            speed=speed,
            leader_speed=np.where(near, self._speed[leader], speed),
            leader_gap=np.where(near, ahead, LARGEST_GAP),
            follower_speed=np.where(close, self._speed[follower], speed),
            follower_gap=np.where(close, behind, LARGEST_GAP),
            route_position=place - self.road.merge,
            loop_length=np.full(len(rows), np.nan),
            allowed_speed=self._allowed[[self._lanes[row] for row in rows]] * factors,
            to_merge=self.road.merge - place,
            lane_speeds=lane_speeds,
            road_speeds=road_speeds,
            beside_gaps=beside_gaps,
            beside_speeds=beside_speeds,
            cav_share=np.full(len(rows), sum(self._came) / max(len(self._came), 1)),
        )

    def _beside(self, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return gaps and speeds of those on the lanes beside these vehicles, as `LocalState` has them."""
        order, length, apart = self._order, self.road.vehicle_length, 2.0 * self.road.length
        along = self._way[order] * apart + self._place[order]  # one way behind the other
        gaps, speeds = list[Floats](), list[Floats]()
        for way in (self._way[rows] + 1, self._way[rows] - 1):  # to the left, to the right
            first_ahead = np.searchsorted(along, way * apart + self._place[rows])
            for found, towards in ((first_ahead, 1.0), (first_ahead - 1, -1.0)):
                other = order[found.clip(0, len(order) - 1)]
                gap = towards * (self._place[other] - self._place[rows]) - length
                near = (found >= 0) & (found < len(order)) & (self._way[other] == way) & (gap < LARGEST_GAP)
                gaps.append(np.where(near, gap, LARGEST_GAP))
                speeds.append(np.where(near, self._speed[other], self._speed[rows]))
        return np.stack(gaps, -1), np.stack(speeds, -1)

    def _ahead(self, names: Sequence[str]) -> list[Ahead]:
        rows = [self._row[name] for name in names]
        leaders = self._leader[rows]
        gaps = np.where(leaders >= 0, self._gap(rows, leaders), inf).tolist()
        speeds, ahead = self._speed[rows].tolist(), self._speed[leaders].tolist()
        return list(map(Ahead, speeds, ahead, gaps))

    def _is_free(self, name: str) -> bool:
        """Whether its lane, or one beside it, closes: there vehicles make room for each other."""
        return self._lanes[self._row[name]] in self._closing

    def _lines(self) -> Floats:
        return network_lines(network_file(self.road.network))

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        routes = {entry.name: entry.route for entry in self.road.entries}
        return [routes[name] for name in vehicles]

    def _pictured(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        lanes = {"lanes": self._log.pictures("lanes", columns), "lane_names": self.road.ways[::-1]}
        before = self.scenario.warmup * self.scenario.simulation_step
        begin, end = (max(0.0, moment - before) for moment in self.road.peak)
        road = {"peak": (begin, end), "free_time": self.road.free_time}
        return {**super()._pictured(columns), **road, **lanes}
