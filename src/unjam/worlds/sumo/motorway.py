"""Traffic of a motorway with lanes and ramps: SUMO drives people, who overtake; CAVs have their own ACC."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.roadside import RoadSections, RoadsideMessages
from unjam.drivers.safety import FollowingState
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.record import Floats
from unjam.worlds.sumo.inputs import CAV_TYPE_TEMPLATE
from unjam.worlds.sumo.multi_lane import MultiLaneTraffic, TrackedLeader
from unjam.worlds.sumo.networks import lane_center_lines, network_file
from unjam.worlds.world import ProgressCallback


class MotorwayTraffic(MultiLaneTraffic[MotorwayRoad]):
    """The actual environment of a motorway."""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        road, scenario = self.road, self.scenario
        self._edge_lane_indices, self._edge_lane_starts, self._edge_lane_speed_limits = (
            np.array(each) for each in zip(*(lane[1:4] for lane in road.edge_lanes), strict=True)
        )
        self._closing_edge_lanes = {number for number, lane in enumerate(road.edge_lanes) if lane.is_merging}
        self._speed_factors = {
            entry.name: road.vehicle_types[entry.vehicle_type].speed_factor for entry in road.entries
        }
        ways, step = int(self._edge_lane_indices.max()) + 1, scenario.control_step
        self._road_sections = RoadSections(ways, road.length)
        self._messages = RoadsideMessages(road.roadside, step, self._noise_generator)
        self._entered_is_cav: list[bool] = []
        """of all who have entered, whether they are CAVs"""
        super().start(is_controlled, on_progress)

    @property
    def _cav_type_template(self) -> str:
        return CAV_TYPE_TEMPLATE

    def _update_vehicles(self, left_names: Sequence[str], entered_names: Sequence[str]) -> None:
        """Look who is where: SUMO's lanes, joined to ways, say who follows whom."""
        self._entered_is_cav += [name in self.road.cav_ids for name in entered_names]
        simulation, names, lanes = self._simulation, list[str](), list[int]()
        for number, lane in enumerate(self.road.edge_lanes):
            there = simulation.vehicles_on_lane(lane.name)
            names += there
            lanes += [number] * len(there)
        self._names, self._edge_lanes = names, lanes
        self._row_of_name = {name: row for row, name in enumerate(names)}
        self._speed = np.array(simulation.speeds(names), np.float64)
        self._lane = self._edge_lane_indices[lanes]
        self._position = self._edge_lane_starts[lanes] + np.array(simulation.lane_offsets(names), np.float64)
        self._order = order = np.lexsort((self._position, self._lane))
        same = self._lane[order[1:]] == self._lane[order[:-1]]
        self._leader, self._follower = np.full((2, len(names)), -1)
        self._leader[order[:-1][same]] = order[1:][same]
        self._follower[order[1:][same]] = order[:-1][same]

    def _names_and_speeds(self) -> tuple[Sequence[str], Floats]:
        return self._names, self._speed

    def _tracked_leaders(self, names: Sequence[str]) -> list[TrackedLeader]:
        rows = [self._row_of_name[name] for name in names]
        leaders = self._leader[rows]
        ahead = [self._names[leader] if leader >= 0 else "" for leader in leaders.tolist()]
        seen = self._speed[rows], self._speed[leaders], self._leader_gaps(rows, leaders)
        return list(map(TrackedLeader, ahead, *(values.tolist() for values in seen)))

    def _leader_gaps(self, rows: Any, leaders: Any) -> Floats:
        """Return the gaps of vehicles to their leaders [m]."""
        return self._position[leaders] - self.road.vehicle_length - self._position[rows]

    def _prepare_states(self) -> None:
        means = self._road_sections.mean_speeds(self._lane, self._position, self._speed, self.road.limit_speed)
        self._messages.send(means)

    def _snapshot(self, names: Sequence[str]) -> dict[str, Any]:
        ahead = self._leader
        gaps = np.where(ahead >= 0, self._leader_gaps(np.arange(len(ahead)), ahead), np.nan)
        places = self._position - self.road.merge_position  # as on the merge: zero where the ways meet
        return {"positions": places, "gaps": gaps, "lane_indices": len(self.road.lane_names) - 1 - self._lane}

    def _local_states(self, names: Sequence[str]) -> LocalState:
        rows = np.array([self._row_of_name[name] for name in names], np.intp)
        speed, place, way = self._speed[rows], self._position[rows], self._lane[rows]
        leader, follower = self._leader[rows], self._follower[rows]
        ahead, behind = self._leader_gaps(rows, leader), self._leader_gaps(follower, rows)
        near, close = (leader >= 0) & (ahead < MAX_OBSERVED_GAP), (follower >= 0) & (behind < MAX_OBSERVED_GAP)
        factors = np.array([self._speed_factors[name] for name in names])
        lane_speeds, road_speeds = self._road_sections.speeds_ahead(self._messages.latest, way, place)
        beside_gaps, beside_speeds = self._adjacent_vehicles(rows)
        return LocalState(
            speed=speed,
            leader_speed=np.where(near, self._speed[leader], speed),
            leader_gap=np.where(near, ahead, MAX_OBSERVED_GAP),
            follower_speed=np.where(close, self._speed[follower], speed),
            follower_gap=np.where(close, behind, MAX_OBSERVED_GAP),
            route_position=place - self.road.merge_position,
            loop_length=np.full(len(rows), np.nan),
            allowed_speed=self._edge_lane_speed_limits[[self._edge_lanes[row] for row in rows]] * factors,
            distance_to_merge=self.road.merge_position - place,
            lane_speeds=lane_speeds,
            road_speeds=road_speeds,
            adjacent_gaps=beside_gaps,
            adjacent_speeds=beside_speeds,
            penetration_rate=np.full(len(rows), sum(self._entered_is_cav) / max(len(self._entered_is_cav), 1)),
        )

    def _adjacent_vehicles(self, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return gaps and speeds of those on the lanes beside these vehicles, as `LocalState` has them."""
        order, length, apart = self._order, self.road.vehicle_length, 2.0 * self.road.length
        along = self._lane[order] * apart + self._position[order]  # one way behind the other
        gaps, speeds = list[Floats](), list[Floats]()
        for way in (self._lane[rows] + 1, self._lane[rows] - 1):  # to the left, to the right
            first_ahead = np.searchsorted(along, way * apart + self._position[rows])
            for found, towards in ((first_ahead, 1.0), (first_ahead - 1, -1.0)):
                other = order[found.clip(0, len(order) - 1)]
                gap = towards * (self._position[other] - self._position[rows]) - length
                near = (found >= 0) & (found < len(order)) & (self._lane[other] == way) & (gap < MAX_OBSERVED_GAP)
                gaps.append(np.where(near, gap, MAX_OBSERVED_GAP))
                speeds.append(np.where(near, self._speed[other], self._speed[rows]))
        return np.stack(gaps, -1), np.stack(speeds, -1)

    def _following_states(self, names: Sequence[str]) -> list[FollowingState]:
        rows = [self._row_of_name[name] for name in names]
        leaders = self._leader[rows]
        gaps = np.where(leaders >= 0, self._leader_gaps(rows, leaders), inf).tolist()
        speeds, ahead = self._speed[rows].tolist(), self._speed[leaders].tolist()
        return list(map(FollowingState, speeds, ahead, gaps))

    def _is_uncapped(self, name: str) -> bool:
        """Whether its lane, or one beside it, closes: there vehicles make room for each other."""
        return self._edge_lanes[self._row_of_name[name]] in self._closing_edge_lanes

    def _lane_lines(self) -> Floats:
        return lane_center_lines(network_file(self.road.network))

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        routes = {entry.name: entry.route for entry in self.road.entries}
        return [routes[name] for name in vehicles]

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        lanes = {
            "lane_indices": self._traffic_log.snapshots("lane_indices", columns),
            "lane_names": self.road.lane_names[::-1],
        }
        before = self.scenario.warmup * self.scenario.simulation_step
        begin, end = (max(0.0, moment - before) for moment in self.road.peak)
        road = {"demand_peak": (begin, end), "free_flow_time": self.road.free_flow_time}
        return {**super()._snapshot_fields(columns), **road, **lanes}
