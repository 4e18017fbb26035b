"""Traffic of the user's own network: SUMO drives people, chooses lanes, and knows who is whose neighbour."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.roadside import RoadsideMessages
from unjam.drivers.safety import FollowingState
from unjam.scenarios.road import UserNetworkRoad
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.backends import NeighborStates
from unjam.worlds.sumo.control import VehicleLimits
from unjam.worlds.sumo.inputs import CALIBRATED_TYPE_TEMPLATE, CAV_TYPE_TEMPLATE, vehicle_class_by_type
from unjam.worlds.sumo.multi_lane import MultiLaneTraffic, TrackedLeader
from unjam.worlds.sumo.networks import edge_lengths, lane_center_lines, lane_counts
from unjam.worlds.sumo.sections import RoadsideService
from unjam.worlds.world import DriverLog, ProgressCallback

SAFETY_FILTER_RANGE = 400.0
"""how far a safety filter looks ahead [m]: what a car at 60 m/s needs"""
FUEL_INTERVAL_SECONDS = 1.0
"""time for which what all vehicles burn is held: SUMO computes it as long as it takes to drive"""


class UserNetworkTraffic(MultiLaneTraffic[UserNetworkRoad]):
    """The actual environment of a network of the user's own."""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._route_counts: Counter[tuple[str, ...]] = Counter()
        self._edge_numbers: dict[str, int] = {}
        """number of each edge on which anybody was"""
        self._allowed_speed_sum, self._allowed_speed_count = 0.0, 0
        """sum of the speeds that were allowed to vehicles [m/s], and of how many"""
        self._contact_cavs = set[str]()
        """CAVs that were in contact with another vehicle"""
        self._entered_vehicle_count, self._selected_cav_count = 0, 0
        """vehicles that have entered, and CAVs among them"""
        self._limits_of_vehicle: dict[str, VehicleLimits] = {}
        """of the vehicles that CAVs replace"""
        self._roadside_service = None
        if "lane_speeds" in self.measured_fields:
            step = self.scenario.control_step
            messages = RoadsideMessages(self.road.roadside, step, self._noise_generator)
            self._roadside_service = RoadsideService(self._simulation, messages, step)
        self._fuel_interval = max(1, int(FUEL_INTERVAL_SECONDS / self.scenario.control_step))
        super().start(is_controlled, on_progress)

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: while anybody may, as SUMO alone knows who will."""
        return not self.is_finished and self._may_add_cav

    @property
    def _may_add_cav(self) -> bool:
        """Whether there may be one more CAV."""
        return self.road.cavs is None or self._selected_cav_count < self.road.cavs

    def _is_cav(self, name: str) -> bool:
        found = self._may_add_cav and self._is_selected(name)
        self._entered_vehicle_count, self._selected_cav_count = (
            self._entered_vehicle_count + 1,
            self._selected_cav_count + found,
        )
        return found

    def _is_selected(self, name: str) -> bool:
        """Whether a vehicle may be a CAV: by its type, or by a draw of its id and the seed alone.

        So the same vehicles are CAVs whoever drives them, also where one enters later for it.
        """
        road, kind = self.road, self._simulation.type_of(name)
        if kind in road.cav_types:
            return True
        if kind not in road.eligible_types:
            return False
        return self._hash_number(name) < road.penetration_rate * 2**64

    def _hash_number(self, name: str) -> int:
        """Return a number below 2**64 that a vehicle's id and the seed alone draw."""
        digest = hashlib.sha256(f"{self.road.cav_seed} {name}".encode()).digest()
        return int.from_bytes(digest[:8], "big")

    def _update_active_vehicles(self) -> None:
        """Keep up with who is on the road, and let calibrated people drive the cars that have entered."""
        self._cached_neighbors: dict[str, NeighborStates] = {}
        self._cached_lane_positions: dict[str, tuple[str, float]] = {}
        before = self._teleport_count
        super()._update_active_vehicles()
        most = int(self.road.files.options.get("max-num-teleports", -1))
        if self._teleport_count > before and 0 <= most < self._simulation.teleport_count():
            self.stop_reason = f"more than {most} teleports (max-num-teleports)"
        road, simulation = self.road, self._simulation
        for name in simulation.departed_vehicles() if road.drivers else ():
            kind = simulation.type_of(name)
            if kind in road.calibrated_types:
                number = self._hash_number(f"driver of {name}") % len(road.drivers)
                simulation.change_type(name, CALIBRATED_TYPE_TEMPLATE.format(kind, number))

    def _update_vehicles(self, left_names: Sequence[str], entered_names: Sequence[str]) -> None:
        # SUMO does not expect the vehicles that calibrators will bring.
        until, simulation = self.road.files.calibrated_until, self._simulation
        self.is_finished = not simulation.expects_vehicles() and (not until or simulation.now() >= until)
        if self.record_details:
            self._route_counts.update(self._simulation.route_of(name) for name in entered_names)

    @property
    def _cav_type_template(self) -> str:
        return "{}" if self.scenario.actuation == "flow" else CAV_TYPE_TEMPLATE

    def _vehicle_limits(self, names: Sequence[str]) -> tuple[Floats, Floats, Floats]:
        """Return acceleration, comfortable and hardest braking of the vehicles that CAVs replace [m/s2]."""
        for name in [name for name in names if name not in self._limits_of_vehicle]:
            kind = self._simulation.type_of(name)
            own = self._simulation.type_limits(kind.removeprefix(CAV_TYPE_TEMPLATE.format("")))
            self._limits_of_vehicle[name] = own
            if self.scenario.actuation in ("shielded", "raw"):
                self._simulation.limit_braking(kind, min(own.emergency_deceleration, self.scenario.cav_max_braking))
        rows = np.array([self._limits_of_vehicle[name] for name in names], np.float64).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats]:
        return self._vehicle_limits(names)[:2]

    def _limited_accelerations(self, command: Command | None) -> list[float]:
        told = super()._limited_accelerations(command)
        if self.scenario.actuation == "cruise":
            return told
        most, _, hardest = self._vehicle_limits(self.cav_ids)
        return np.clip(told, -hardest, most).tolist()

    def _clip_to_allowed_speeds(self, speeds: dict[str, float]) -> dict[str, float]:
        if self.scenario.actuation == "cruise":  # SUMO keeps to it, and takes set speeds for allowed ones
            return speeds
        allowed = self._simulation.allowed_speeds(list(speeds))
        return dict(zip(speeds, map(min, speeds.values(), allowed), strict=True))

    def _tracked_leaders(self, names: Sequence[str]) -> list[TrackedLeader]:
        near = zip(self._simulation.speeds(names), map(self._neighbors, names), strict=True)
        return [TrackedLeader(leader, speed, ahead, gap) for speed, (leader, ahead, gap, *_) in near]

    def _following_states(self, names: Sequence[str]) -> list[FollowingState]:
        if not self.scenario.safety.active:
            return super()._following_states(names)
        near = zip(names, self._simulation.speeds(names), map(self._neighbors, names), strict=True)
        found: list[FollowingState] = []
        for name, speed, (leader, ahead, gap, *_) in near:
            if not leader:  # who drives fast must see farther than what drivers are told
                _, ahead, gap, *_ = self._simulation.neighbors(name, SAFETY_FILTER_RANGE)
            found.append(FollowingState(speed, ahead, gap))
        return found

    def _neighbors(self, name: str) -> NeighborStates:
        """Return who is ahead of a vehicle and behind it; SUMO is asked once in a step."""
        if name not in self._cached_neighbors:
            self._cached_neighbors[name] = self._simulation.neighbors(name, MAX_OBSERVED_GAP)
        return self._cached_neighbors[name]

    def _colliding_vehicles(self) -> Sequence[str]:
        """Return what SUMO counts as collided under the user's settings, and CAVs that touch their leader.

        With `collision.action` none, SUMO itself counts nothing.
        """
        found = dict.fromkeys(super()._colliding_vehicles())
        for name, (leader, _, gap, *_) in self._cached_neighbors.items() if self._is_controlled else ():
            if leader and gap <= 0.0 and self._simulation.is_in_contact(name, leader):
                found |= {name: None, leader: None}
        return list(found)

    def _ends_episode(self, colliding: Sequence[str]) -> bool:
        """Whether a CAV is among them, which is recorded, and that ends the episode.

        In human-only traffic, the baseline, there are no CAVs.
        """
        found = set(self.cav_ids).intersection(colliding) if self._is_controlled else set[str]()
        self._contact_cavs |= found
        return self.stop_at_contact and bool(found)

    def _snapshot(self, names: Sequence[str]) -> dict[str, Any]:
        unknown = np.full(len(names), np.nan)
        if not self.record_details:
            return {"positions": unknown, "gaps": unknown}
        free = [name for name in names if name not in self._uncapped_max_speeds] or names
        allowed = self._simulation.allowed_speeds(free)
        self._allowed_speed_sum, self._allowed_speed_count = (
            self._allowed_speed_sum + sum(allowed),
            self._allowed_speed_count + len(allowed),
        )
        rows: list[tuple[float, ...]] = []
        for name, along in self._lane_positions(names):
            edge, _, number = name.rpartition("_")
            number = float(number or -1)  # nowhere, where SUMO has lifted a vehicle off the road
            rows.append((self._edge_numbers.setdefault(edge, len(self._edge_numbers)), number, along))
        edge, lane, along = np.array(rows, np.float64).reshape(-1, 3).T
        return {"edge": edge, "lane_index": lane, "lane_position": along, "gaps": unknown}

    def _local_states(self, names: Sequence[str]) -> LocalState:
        found = [self._neighbors(name)[1:] for name in names]
        leader_speed, leader_gap, follower_speed, follower_gap = np.array(found).reshape(-1, 4).T
        unknown = np.full(len(names), np.nan)
        speed = np.array(self._simulation.speeds(names), np.float64)
        near = LocalState(speed, leader_speed, leader_gap, follower_speed, follower_gap, unknown, unknown)
        if self._roadside_service is None:
            return near
        share = np.full(len(names), self._selected_cav_count / max(self._entered_vehicle_count, 1))
        return near._replace(
            **self._roadside_service.local_state_fields(names, self._lane_positions(names)), penetration_rate=share
        )

    def _prepare_states(self) -> None:
        if self._roadside_service is not None:
            names, speeds = self._names_and_speeds()
            self._roadside_service.measure(self._lane_positions(names), speeds)

    def record(self, driver_log: DriverLog) -> Episode:
        """Return what happened since the start, with all trips; SUMO ends with it."""
        episode = super().record(driver_log)
        start = self.road.files.begin + self.scenario.warmup * self.scenario.simulation_step
        trips = self._simulation.end_with_trips(vehicle_class_by_type(self.road), start)
        return replace(episode, trips=trips, contacts=len(self._contact_cavs))

    def _lane_positions(self, names: Sequence[str]) -> list[tuple[str, float]]:
        """Return in which lane vehicles are, and how far along it [m]; SUMO is asked once in a step."""
        new = [name for name in names if name not in self._cached_lane_positions]
        self._cached_lane_positions |= zip(new, self._simulation.lane_positions(new) if new else (), strict=True)
        return [self._cached_lane_positions[name] for name in names]

    def _lane_lines(self) -> Floats:
        return lane_center_lines(self.road.files.network)

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return what pictures show; positions are those along the route that is driven most.

        Its lanes count from the left: what widens a road is on its right most of the time.
        """
        if not self.record_details:
            return super()._snapshot_fields(columns)
        gaps, places, edge = (self._traffic_log.snapshots(name, columns) for name in ("gaps", "poses", "edge"))
        shown = {"gaps": gaps, "poses": places, "positions": np.full(edge.shape, np.nan)}
        shown["limit_speed"] = (
            self._allowed_speed_sum / self._allowed_speed_count if self._allowed_speed_count else float("nan")
        )
        if not self._route_counts:
            return shown
        network = self.road.files.network
        lengths, counts = edge_lengths(network), lane_counts(network)
        planned: Counter[str] = Counter()  # not where they were: all drivers' pictures show the same route
        for edges, count in self._route_counts.items():
            planned.update(dict.fromkeys(edges, count))
        route = max(self._route_counts, key=lambda edges: sum(planned[edge] for edge in set(edges)))
        starts = accumulate((lengths[edge] for edge in route), initial=0.0)
        begins = dict(reversed(list(zip(route, starts, strict=False))))
        facts = [(begins.get(name, np.nan), counts.get(name, 0)) for name in self._edge_numbers]
        nobody = (np.nan, np.nan)
        begin, lanes = np.array([*facts, nobody]).T[:, np.nan_to_num(edge, nan=-1).astype(int)]
        shown["positions"] = begin + self._traffic_log.snapshots("lane_position", columns)
        most = max(counts[edge] for edge in route)
        if most == 1:
            return shown
        lane = np.where(np.isnan(begin), np.nan, lanes - 1 - self._traffic_log.snapshots("lane_index", columns))
        further = ("2nd", "3rd", *(f"{number}th" for number in range(4, most + 1)))
        named = ("left lane", *(f"{ordinal} lane" for ordinal in further[: most - 1]))
        return {**shown, "lane_indices": lane, "lane_names": named}
