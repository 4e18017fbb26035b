"""Traffic on a user's network: SUMO drives human-driven vehicles, changes lanes, and reports the neighbors."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.roadside import RoadsideMessages
from unjam.drivers.safety import FollowingState
from unjam.scenarios.road import UserNetworkRoad
from unjam.scenarios.user_network import UserNetwork
from unjam.sumo_files.reader import CALIBRATED_TYPE_TEMPLATE, CAV_TYPE_TEMPLATE
from unjam.worlds.open_road_log import TrackedLeader
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.inputs import user_network_inputs, vehicle_class_by_type
from unjam.worlds.sumo.networks import network_geometry
from unjam.worlds.sumo.open_road import MultiLaneTraffic
from unjam.worlds.sumo.outputs import find_slow_entrances, find_vehicle_class
from unjam.worlds.sumo.sections import RoadsideService
from unjam.worlds.sumo.simulation import VehicleLimits
from unjam.worlds.sumo.transports import NeighborStates
from unjam.worlds.world import DriverLog

SAFETY_FILTER_RANGE = 400.0
"""range in which a safety filter detects leaders [m]: enough at 60 m/s"""
FUEL_INTERVAL_SECONDS = 1.0
"""time between two measurements of fuel [s]; a measurement takes SUMO as long as a simulation step"""


class UserNetworkTraffic(MultiLaneTraffic[UserNetworkRoad]):
    """The world of a user's network in SUMO."""

    inputs = staticmethod(user_network_inputs)

    def _network_file(self) -> Path:
        return self.road.files.network

    def _prepare(self) -> None:
        super()._prepare()
        self._cav_type_template = "{}" if self.scenario.actuation == "flow" else CAV_TYPE_TEMPLATE
        self._route_counts: Counter[tuple[str, ...]] = Counter()
        """number of vehicles with each planned route"""
        self._edge_indices: dict[str, int] = {}
        """index of each edge in the snapshots"""
        self._allowed_speed_sum, self._allowed_speed_count = 0.0, 0
        self._contact_cavs = set[str]()
        """CAVs that have collided, or overlapped with their leader"""
        self._vehicle_types: dict[str, str] = {}
        self._teleport_totals = 0, 0
        """SUMO's numbers of all teleports so far, and of teleports out of jams"""
        self._entered_vehicle_count, self._selected_cav_count = 0, 0
        self._limits_of_vehicle: dict[str, VehicleLimits] = {}
        self._hidden_time_loss: dict[str, float] = {}
        """time that vehicles lost by set-speed caps [s]; SUMO does not count it, as a cap reduces the desired speed"""
        self._roadside_service = None
        step = self.scenario.control_step
        if "lane_speeds" in self.options.measured_fields:
            messages = RoadsideMessages(self.road.roadside, step, self.noise_generator)
            self._roadside_service = RoadsideService(self._simulation, messages, step)
        self._fuel_interval = max(1, int(FUEL_INTERVAL_SECONDS / step))

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: vehicles may enter, and there are fewer CAVs than allowed."""
        return not self.is_finished and self._may_add_cav()

    @property
    def _waiting_removed_count(self) -> int:
        return self._vehicles.removed_count

    def _may_add_cav(self) -> bool:
        return self.road.max_cav_count is None or self._selected_cav_count < self.road.max_cav_count

    def _is_cav(self, vehicle_id: str) -> bool:
        self._vehicle_types[vehicle_id] = self._simulation.type_of(vehicle_id)
        is_cav = self._may_add_cav() and self._is_selected(vehicle_id)
        self._entered_vehicle_count += 1
        self._selected_cav_count += is_cav
        return is_cav

    def _is_selected(self, vehicle_id: str) -> bool:
        """Return whether a vehicle is selected as a CAV, by its type or by a hash of its id and the seed."""
        road, type_id = self.road, self._vehicle_types[vehicle_id]
        if type_id in road.cav_types:
            return True
        return type_id in road.eligible_types and self._hash_number(vehicle_id) < road.penetration_rate * 2**64

    def _hash_number(self, text: str) -> int:
        """Return a number below 2**64 that depends only on a text and the seed."""
        digest = hashlib.sha256(f"{self.road.cav_seed} {text}".encode()).digest()
        return int.from_bytes(digest[:8], "big")

    def _update_active_vehicles(self) -> None:
        """Update the vehicles on the road, and give the cars that have entered a calibrated driver."""
        self._cached_neighbors: dict[str, NeighborStates] = {}
        self._cached_lane_positions: dict[str, tuple[str, float]] = {}
        previous_teleports = self._vehicles.teleports
        super()._update_active_vehicles()
        road, simulation = self.road, self._simulation
        self._correct_teleports(previous_teleports)
        max_teleports = int(road.files.options.get("max-num-teleports", -1))
        if self._vehicles.teleports > previous_teleports and 0 <= max_teleports < self._teleport_totals[0]:
            self.stop_reason = f"more than {max_teleports} teleports (max-num-teleports)"
        for vehicle_id in simulation.departed_vehicles() if road.drivers else ():
            type_id = simulation.type_of(vehicle_id)
            if type_id in road.calibrated_types:
                driver_index = self._hash_number(f"driver of {vehicle_id}") % len(road.drivers)
                simulation.change_type(vehicle_id, CALIBRATED_TYPE_TEMPLATE.format(type_id, driver_index))

    def _vehicles_off_road(self) -> list[str]:
        ids, speeds = self._ids_and_speeds()
        is_off = speeds < 0.0  # SUMO reports a negative speed for vehicles off the road
        return [ids[row] for row in np.flatnonzero(is_off).tolist()] if is_off.any() else []

    def _correct_teleports(self, previous_teleports: int) -> None:
        """Correct the counts of the last step: SUMO lists jumps between stops as teleports, removals as arrivals."""
        vehicles, removes_jammed = self._vehicles, self.road.files.removes_jammed_vehicles
        if vehicles.teleports == previous_teleports and not removes_jammed:
            return
        total, jam_total = self._teleport_totals
        self._teleport_totals = self._simulation.teleport_count(), self._simulation.jam_teleport_count()
        vehicles.teleports = previous_teleports + self._teleport_totals[0] - total
        if removes_jammed:
            vehicles.add_removals(self._teleport_totals[1] - jam_total)

    def _update_vehicles(self, left_ids: Sequence[str], entered_ids: Sequence[str]) -> None:
        # SUMO expects neither vehicles that calibrators will add, nor idle taxis and stopped vehicles that wait for a
        # passenger or another vehicle; plain SUMO simulates these until --end.
        simulation = self._simulation
        may_change = simulation.expects_vehicles() or simulation.vehicle_count() > 0
        self.is_finished = not may_change and simulation.time() >= self.road.files.calibrated_until
        if self.options.record_details:
            self._route_counts.update(simulation.route_of(vehicle_id) for vehicle_id in entered_ids)

    def _column_groups(self, vehicles: Sequence[str]) -> Sequence[str]:
        classes = vehicle_class_by_type(self.road)
        return [find_vehicle_class(self._vehicle_types.get(vehicle_id, ""), classes) for vehicle_id in vehicles]

    def _vehicle_limits(self, ids: Sequence[str]) -> tuple[Floats, Floats, Floats]:
        """Return acceleration, comfortable and emergency deceleration of the vehicles that CAVs replace [m/s2]."""
        simulation = self._simulation
        for vehicle_id in [vehicle_id for vehicle_id in ids if vehicle_id not in self._limits_of_vehicle]:
            type_id = simulation.type_of(vehicle_id)
            limits = simulation.type_limits(type_id.removeprefix(CAV_TYPE_TEMPLATE.format("")))
            limits = limits._replace(acceleration=simulation.type_limits(type_id).acceleration)
            self._limits_of_vehicle[vehicle_id] = limits
            if self.scenario.actuation in ("shielded", "raw"):
                simulation.limit_braking(type_id, min(limits.emergency_deceleration, self.scenario.cav_max_braking))
        rows = np.array([self._limits_of_vehicle[vehicle_id] for vehicle_id in ids], np.float64).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]

    def _acc_limits(self, ids: Sequence[str]) -> tuple[Floats, Floats]:
        return self._vehicle_limits(ids)[:2]

    def limited_accelerations(self, command: Command | None) -> list[float]:
        """Return the commanded accelerations, limited by the scenario and the vehicles [m/s2]."""
        accelerations = super().limited_accelerations(command)
        if self.scenario.actuation == "cruise":
            return accelerations
        acceleration, _, deceleration = self._vehicle_limits(self.cav_ids)
        return np.clip(accelerations, -deceleration, acceleration).tolist()

    def _safe_speeds(self, accelerations: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the results of `OpenTraffic._safe_speeds`, with speeds up to those that the road allows."""
        speeds, safe = super()._safe_speeds(accelerations)
        if self.scenario.actuation == "cruise":  # SUMO limits speeds, and counts set-speed caps as limits of the road
            return speeds, safe
        allowed = self._simulation.allowed_speeds(list(speeds))
        return dict(zip(speeds, np.fmin([*speeds.values()], allowed).tolist(), strict=True)), safe

    def _tracked_leaders(self, ids: Sequence[str]) -> list[TrackedLeader]:
        speeds = zip(self._simulation.speeds(ids), self._neighbors(ids), strict=True)
        return [(leader, FollowingState(speed, *state[:2])) for speed, (leader, *state) in speeds]

    def _following_states(self, ids: Sequence[str]) -> list[FollowingState]:
        if not self.scenario.safety.active:
            return super()._following_states(ids)
        states = list[FollowingState]()
        for vehicle_id, (leader, state) in zip(ids, self._tracked_leaders(ids), strict=True):
            if not leader:  # at high speed, the filter needs a longer range than the sensors of the driver
                state = FollowingState(state.speed, *self._find_neighbors([vehicle_id], SAFETY_FILTER_RANGE)[0][1:3])
            states.append(state)
        return states

    def _neighbors(self, ids: Sequence[str]) -> list[NeighborStates]:
        """Return the vehicles' neighbors; SUMO is called once per step."""
        new = [vehicle_id for vehicle_id in ids if vehicle_id not in self._cached_neighbors]
        self._cached_neighbors |= zip(new, self._find_neighbors(new, MAX_OBSERVED_GAP) if new else (), strict=True)
        return [self._cached_neighbors[vehicle_id] for vehicle_id in ids]

    def _find_neighbors(self, ids: Sequence[str], max_distance: float) -> list[NeighborStates]:
        neighbors, simulation = self._simulation.neighbors(ids, max_distance), self._simulation
        if self.road.files.has_opposite_lanes and (opposite := simulation.vehicles_on_opposite_lanes(ids)):
            # SUMO reports the vehicle behind them as the leader. SUMO itself checks for oncoming traffic.
            for vehicle_id, speed in zip(opposite, simulation.speeds(opposite), strict=True):
                neighbors[ids.index(vehicle_id)] = NeighborStates("", speed, max_distance, speed, max_distance)
        return neighbors

    def _collisions(self) -> tuple[Sequence[str], bool]:
        """Return the vehicles that collide in SUMO or by contact of a CAV, and whether that ends the episode."""
        colliding = dict.fromkeys(self._simulation.colliding_vehicles())
        if not self.is_controlled:
            return list(colliding), False
        for vehicle_id, (leader, _, gap, *_) in self._cached_neighbors.items():
            if leader and gap <= 0.0 and self._simulation.is_in_contact(vehicle_id, leader):
                colliding |= {vehicle_id: None, leader: None}
        cavs = set(self.cav_ids).intersection(colliding)
        self._contact_cavs |= cavs
        return list(colliding), self.options.stop_at_contact and bool(cavs)

    def _snapshot(self, ids: Sequence[str]) -> dict[str, Any]:
        unknown = np.full(len(ids), np.nan)
        if not self.options.record_details:
            return {"positions": unknown, "gaps": unknown}
        allowed = self._allowed_speeds(ids)
        self._allowed_speed_sum += np.nansum(allowed)
        self._allowed_speed_count += np.count_nonzero(np.isfinite(allowed))
        rows: list[tuple[float, ...]] = []
        for lane_id, position in self._lane_positions(ids):
            edge, _, lane = lane_id.rpartition("_")  # empty for a teleported vehicle
            rows.append((self._edge_indices.setdefault(edge, len(self._edge_indices)), float(lane or -1), position))
        edge, lane, position = np.array(rows, np.float64).reshape(-1, 3).T
        return {"edge": edge, "lane": lane, "lane_position": position, "gaps": unknown}

    def _allowed_speeds(self, ids: Sequence[str]) -> Floats:
        """Return the speeds that the road allows to vehicles, without set-speed caps [m/s]; NaN off the road."""
        allowed = np.array(self._simulation.allowed_speeds(ids), np.float64)
        rows = [row for row, vehicle_id in enumerate(ids) if vehicle_id in self._speed_caps.own_max_speeds]
        if rows:
            allowed[rows] = self._speeds_without_caps([ids[row] for row in rows])
        return allowed

    def _speeds_without_caps(self, ids: Sequence[str]) -> Floats:
        """Return the speeds that the road allows to vehicles with a cap, as if they had none [m/s]."""
        max_speeds = [self._speed_caps.own_max_speeds[vehicle_id] for vehicle_id in ids]
        return np.fmin(max_speeds, self._simulation.uncapped_speeds(ids))

    def _simulate(self, cav_speeds: dict[str, float]) -> None:
        super()._simulate(cav_speeds)
        self.is_finished = self.is_finished and not self._vehicles.removed_count  # removed vehicles wait until the end
        capped = [vehicle_id for vehicle_id in self._speed_caps.own_max_speeds if vehicle_id in self._vehicles.is_cav]
        if not capped:
            return
        simulation, step = self._simulation, self.scenario.simulation_step
        speeds, caps = np.array(simulation.speeds(capped)), np.array(simulation.allowed_speeds(capped))
        losses = step * (speeds / caps - speeds / self._speeds_without_caps(capped))
        for vehicle_id, loss in zip(capped, np.nan_to_num(losses).tolist(), strict=True):
            self._hidden_time_loss[vehicle_id] = self._hidden_time_loss.get(vehicle_id, 0.0) + loss

    def _local_states(self, ids: Sequence[str]) -> LocalState:
        neighbors = [states[1:] for states in self._neighbors(ids)]
        leader_speed, leader_gap, follower_speed, follower_gap = np.array(neighbors).reshape(-1, 4).T
        unknown = np.full(len(ids), np.nan)
        speed = np.array(self._simulation.speeds(ids), np.float64)
        state = LocalState(speed, leader_speed, leader_gap, follower_speed, follower_gap, unknown, unknown)
        if self._roadside_service is None:
            return state
        all_ids, all_speeds = self._ids_and_speeds()
        self._roadside_service.measure(self._lane_positions(all_ids), all_speeds)
        fields = self._roadside_service.local_state_fields(ids, self._lane_positions(ids))
        rate = self._selected_cav_count / max(self._entered_vehicle_count, 1)
        return state._replace(**fields, penetration_rate=np.full(len(ids), rate))

    def _lane_positions(self, ids: Sequence[str]) -> list[tuple[str, float]]:
        """Return the vehicles' lanes, and positions on them [m]; SUMO is called once per step."""
        new = [vehicle_id for vehicle_id in ids if vehicle_id not in self._cached_lane_positions]
        self._cached_lane_positions |= zip(new, self._simulation.lane_positions(new) if new else (), strict=True)
        return [self._cached_lane_positions[vehicle_id] for vehicle_id in ids]

    def record(self, driver_log: DriverLog) -> Episode:
        """Return the record as `Traffic.record` does; raise `InputError` if no vehicle entered."""
        episode = super().record(driver_log)
        scenario = cast(UserNetwork, self.scenario)
        scenario.check_vehicles(bool(episode.vehicle_ids), [warning.example for warning in episode.warnings])
        return episode

    def _make_record(self, driver_log: DriverLog) -> Episode:
        """Return the record with the trips of all vehicles; this ends SUMO."""
        episode = super()._make_record(driver_log)
        start = self.road.files.begin + self.scenario.warmup * self.scenario.simulation_step
        classes, removes_jammed = vehicle_class_by_type(self.road), self.road.files.removes_jammed_vehicles
        trips = self._simulation.end_with_trips(classes, start, removes_jammed)
        hidden = [self._hidden_time_loss.get(vehicle_id, 0.0) for vehicle_id in trips.vehicle_ids]
        # Vehicles that wait for persons still wait after the last arrival, until the horizon.
        remaining_time = (self.scenario.horizon - self.control_steps) * self.scenario.control_step
        waiting = remaining_time * np.array([not edge for edge in trips.entrances], np.float64)
        trips = replace(trips, time_loss=trips.time_loss + hidden, depart_delay=trips.depart_delay + waiting)
        slow = find_slow_entrances(trips, network_geometry(self.road.files.network).speed_limits)
        return replace(episode, trips=trips, contacts=len(self._contact_cavs), slow_entrances=slow)

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return the fields for figures: positions along the most frequent route, and lane indices from the left."""
        if not self.options.record_details:
            return super()._snapshot_fields(columns)
        gaps, poses, edge = (self._log.traffic.snapshots(name, columns) for name in ("gaps", "poses", "edge"))
        limit = self._allowed_speed_sum / self._allowed_speed_count if self._allowed_speed_count else float("nan")
        fields = {"gaps": gaps, "poses": poses, "positions": np.full(edge.shape, np.nan), "limit_speed": limit}
        if not self._route_counts:
            return fields
        _, lengths, lane_counts, _ = network_geometry(self.road.files.network)
        # Counts of planned routes, so that the figures of all drivers show the same route.
        edge_counts: Counter[str] = Counter()
        for edges, count in self._route_counts.items():
            edge_counts.update(dict.fromkeys(edges, count))
        route = max(self._route_counts, key=lambda edges: sum(edge_counts[edge] for edge in set(edges)))
        starts = accumulate((lengths[edge] for edge in route), initial=0.0)
        start_of_edge = dict(reversed(list(zip(route, starts, strict=False))))
        fields["merge_positions"] = tuple(sorted({start_of_edge[edge] for edge in self._ramp_targets(route)}))
        rows = [(start_of_edge.get(name, np.nan), lane_counts.get(name, 0)) for name in self._edge_indices]
        no_edge = (np.nan, np.nan)
        start, lanes = np.array([*rows, no_edge]).T[:, np.nan_to_num(edge, nan=-1).astype(int)]
        fields["positions"] = start + self._log.traffic.snapshots("lane_position", columns)
        max_lanes = max(lane_counts[edge] for edge in route)
        if max_lanes == 1:
            return fields
        lane = np.where(np.isnan(start), np.nan, lanes - 1 - self._log.traffic.snapshots("lane", columns))
        ordinals = ("2nd", "3rd", *(f"{number}th" for number in range(4, max_lanes + 1)))[: max_lanes - 1]
        names = ("left lane", *(f"{ordinal} lane" for ordinal in ordinals))
        return {**fields, "lane_indices": lane, "lane_names": names}

    def _ramp_targets(self, route: Sequence[str]) -> set[str]:
        """Return the edges of a route that other vehicles enter from a side without a signal or yield line."""
        links_of_route = set(pairwise(route))
        joining = {pair for edges in self._route_counts for pair in pairwise(edges)} - links_of_route
        lanes = {lane.name: lane for lane in self._simulation.lanes()}
        free = (lane for lane in lanes.values() if not lane.has_stop_line)
        links = {(lane.edge, lanes[name].edge) for lane in free for name in lane.successors if name in lanes}
        return {target for _, target in links & joining if target in route[1:]}
