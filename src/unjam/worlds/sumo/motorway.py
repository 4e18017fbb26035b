"""Traffic on a motorway with several lanes and ramps. SUMO drives the human-driven vehicles; CAVs have an ACC."""

from collections.abc import Sequence
from itertools import chain
from math import inf
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.drivers.roadside import MeasuredVehicles, RoadSections, RoadsideMessages, SpeedMeasurement
from unjam.drivers.safety import FollowingState
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.sumo_files.reader import CAV_TYPE_TEMPLATE
from unjam.worlds.lane_neighbors import find_unsorted_neighbors, neighbors_on_lane, observe_lane
from unjam.worlds.open_road_log import TrackedLeader
from unjam.worlds.record import Floats
from unjam.worlds.sumo.inputs import motorway_inputs
from unjam.worlds.sumo.open_road import MultiLaneTraffic, neighbor_state
from unjam.worlds.sumo.road_control import ControlledVehicles, RampControl


class MotorwayTraffic(MultiLaneTraffic[MotorwayRoad]):
    """The world of a motorway in SUMO."""

    inputs = staticmethod(motorway_inputs)
    _cav_type_template = CAV_TYPE_TEMPLATE

    def _prepare(self) -> None:
        super()._prepare()
        road, types, self._geometry = self.road, self.road.vehicle_types, self.road.geometry
        self._edge_lane_names, *lanes_and_starts = zip(*self._geometry.edge_lanes, strict=True)
        self._lane_of_edge_lane, self._edge_lane_starts = map(np.array, lanes_and_starts)
        self._lengths = {entry.name: types[entry.vehicle_type].length for entry in road.entries}
        self._speed_factors = {entry.name: types[entry.vehicle_type].speed_factor for entry in road.entries}
        self._road_sections = RoadSections(1 + self._geometry.lane_count, self._geometry.length)
        step, limit = self.scenario.control_step, self._geometry.speed_limit
        self._measurement = SpeedMeasurement(road.roadside, self._road_sections, limit, step)
        self._messages = RoadsideMessages(road.roadside, step, self.noise_generator)
        self._entered_is_cav: list[bool] = []
        scenario = cast(Motorway, self.scenario)
        ramps = zip(self._geometry.ramps, self._geometry.route_names[1:], strict=True)
        is_controlled = scenario.speed_limit_control.active or scenario.ramp_meter.active
        self._ramp_controls = [
            RampControl(self._simulation, self._speed_caps, scenario, *ramp) for ramp in ramps if is_controlled
        ]

    def _update_vehicles(self, left_ids: Sequence[str], entered_ids: Sequence[str]) -> None:
        """Read the vehicles on SUMO's lanes, which are parts of the lanes of the road, and find their neighbors."""
        self._entered_is_cav += [vehicle_id in self.road.cav_ids for vehicle_id in entered_ids]
        simulation, ids, edge_lanes = self._simulation, list[str](), list[int]()
        for index, edge_lane in enumerate(self._edge_lane_names):
            ids_on_lane = simulation.vehicles_on_lane(edge_lane)
            ids += ids_on_lane
            edge_lanes += [index] * len(ids_on_lane)
        self._vehicle_ids = ids
        self._length = np.array([self._lengths[vehicle_id] for vehicle_id in ids])
        self._row_of_vehicle = {vehicle_id: row for row, vehicle_id in enumerate(ids)}
        self._speed = np.array(simulation.speeds(ids), np.float64)
        self._lane = lane = self._lane_of_edge_lane[edge_lanes]
        self._position = self._edge_lane_starts[edge_lanes] + np.array(simulation.lane_offsets(ids), np.float64)
        self._sections = self._geometry.sections(lane, self._position)
        self._neighbors = find_unsorted_neighbors(lane, self._position, self._geometry)
        self._leader, self._follower = (neighbors_on_lane(neighbors, lane) for neighbors in self._neighbors)

    def _command_humans(self) -> None:
        """Let the road operator control speed limits and ramp meters; SUMO drives the human-driven vehicles."""
        vehicles = ControlledVehicles(self._vehicle_ids, self._lane, self._position, self._speed, self._length)
        for ramp_control in self._ramp_controls:
            ramp_control.control(vehicles)

    def _ids_and_speeds(self) -> tuple[Sequence[str], Floats]:
        return self._vehicle_ids, self._speed

    def _tracked_leaders(self, ids: Sequence[str]) -> list[TrackedLeader]:
        rows = [self._row_of_vehicle[vehicle_id] for vehicle_id in ids]
        leaders = self._leader[rows]
        leader_ids = [self._vehicle_ids[leader] if leader >= 0 else "" for leader in leaders.tolist()]
        gaps = np.where(leaders >= 0, self._leader_gaps(rows, leaders), inf)
        columns = (column.tolist() for column in (self._speed[rows], self._speed[leaders], gaps))
        return list(zip(leader_ids, map(FollowingState, *columns), strict=True))

    def _leader_gaps(self, rows: Any, leaders: Any) -> Floats:
        return self._position[leaders] - self._length[leaders] - self._position[rows]

    def _snapshot(self, ids: Sequence[str]) -> dict[str, Any]:
        leaders = self._leader
        gaps = np.where(leaders >= 0, self._leader_gaps(np.arange(len(leaders)), leaders), np.nan)
        positions = self._position - self._geometry.origin  # zero at the merge point, as on the road `merge`
        return {"positions": positions, "gaps": gaps, "lane_indices": self._geometry.lane_count - self._lane}

    def _local_states(self, ids: Sequence[str]) -> LocalState:
        geometry, fields = self._geometry, self.options.measured_fields
        rows = np.array([self._row_of_vehicle[vehicle_id] for vehicle_id in ids], np.intp)
        leaders, followers, position = self._leader[rows], self._follower[rows], self._position[rows]
        state = neighbor_state(rows, leaders, followers, self._position, self._speed, self._leader_gaps)
        if "lane_speeds" in fields or "road_speeds" in fields:
            state = state._replace(**self._receive_speeds_ahead(rows))
        if "adjacent_gaps" in fields or "adjacent_speeds" in fields:
            motion, lane = (self._position, self._speed, self._length), self._lane[rows]
            sides = (observe_lane(self._neighbors, rows, lane + offset, *motion) for offset in (1, -1))  # left, right
            speeds, gaps = (np.stack(columns, -1) for columns in zip(*chain(*sides), strict=True))
            state = state._replace(adjacent_gaps=gaps, adjacent_speeds=speeds)
        factors = np.array([self._speed_factors[vehicle_id] for vehicle_id in ids])
        return state._replace(
            route_position=position - geometry.origin,
            allowed_speed=geometry.speed_limits(self._lane, self._sections)[rows] * factors,
            distance_to_merge=geometry.distance_to_merge(self._lane[rows], position),
            penetration_rate=np.full(len(rows), sum(self._entered_is_cav) / max(len(self._entered_is_cav), 1)),
        )

    def _receive_speeds_ahead(self, rows: NDArray[np.intp]) -> dict[str, Floats]:
        """Send the current measurement, and return the speeds ahead in the latest message, by field of `LocalState`."""
        is_cav = np.array([vehicle_id in self.road.cav_ids for vehicle_id in self._vehicle_ids], bool)
        vehicles = MeasuredVehicles(self._lane, self._position, self._speed, is_cav)
        self._messages.send(self._measurement.update(vehicles))
        if self.road.roadside.source == "none":
            return {}
        ahead = self._road_sections.speeds_ahead(self._messages.latest, self._lane[rows], self._position[rows])
        return dict(zip(("lane_speeds", "road_speeds"), ahead, strict=True))

    def _following_states(self, ids: Sequence[str]) -> list[FollowingState]:
        return [state for _, state in self._tracked_leaders(ids)]

    def _collisions(self) -> tuple[Sequence[str], bool]:
        """Return the vehicles that collided, and whether a controlled CAV did, which ends the episode."""
        colliding, _ = super()._collisions()
        return colliding, self.is_controlled and not self.road.cav_ids.isdisjoint(colliding)

    def _is_uncapped(self, vehicle_id: str) -> bool:
        """Return whether a CAV is where its lane or an adjacent one ends, and vehicles make room for each other."""
        return bool(self._sections.is_merging[self._row_of_vehicle[vehicle_id]])

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        routes = {entry.name: entry.route for entry in self.road.entries}
        return [routes[vehicle_id] for vehicle_id in vehicles]

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        warmup = self.scenario.warmup * self.scenario.simulation_step
        begin, end = (max(0.0, time - warmup) for time in self.road.peak)
        lanes = self._log.traffic.snapshots("lane_indices", columns)
        fields = {"demand_peak": (begin, end), "free_flow_time": self.road.free_flow_time, "lane_indices": lanes}
        return {**super()._snapshot_fields(columns), **fields, "lane_names": self._geometry.lane_names[::-1]}
