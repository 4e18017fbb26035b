"""Traffic on open roads: vehicles enter and leave, and each trip of a CAV is one trajectory."""

from collections.abc import Callable, Hashable, Sequence
from math import inf
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, commanded_time_gaps
from unjam.drivers.local_state import LocalState, observe_neighbor
from unjam.drivers.safety import FollowingState
from unjam.physics.kinematics import next_speed
from unjam.scenarios.road import BuiltRoad
from unjam.worlds.open_road_log import MultiLaneLog, OpenRoadLog, TrackedLeader
from unjam.worlds.record import Episode, Floats
from unjam.worlds.road_world import RoadScene
from unjam.worlds.sumo.inputs import lane_change_parameters
from unjam.worlds.sumo.networks import network_file, network_geometry
from unjam.worlds.sumo.road_control import SpeedCaps
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import OpenRoadT, Traffic
from unjam.worlds.world import DriverLog, ProgressCallback


def neighbor_state(
    rows: NDArray[np.intp],
    leaders: NDArray[np.intp],
    followers: NDArray[np.intp],
    positions: Floats,
    speeds: Floats,
    leader_gaps: Callable[[NDArray[np.intp], NDArray[np.intp]], Floats],
) -> LocalState:
    """Return the local states of the vehicles in `rows`.

    `leaders` and `followers` are the rows of their neighbors, or -1. `leader_gaps` returns the gaps between rows [m].
    """
    fields = [speeds[rows]]
    for neighbors, gaps in ((leaders, leader_gaps(rows, leaders)), (followers, leader_gaps(followers, rows))):
        fields += observe_neighbor(neighbors >= 0, gaps, speeds[neighbors], speeds[rows])
    return LocalState(*fields, route_position=positions[rows], loop_length=np.full(len(rows), np.nan))


class ActiveVehicles:
    """The vehicles on an open road, and counts of arrivals, teleports and collisions."""

    def __init__(self) -> None:
        self.is_cav: dict[str, bool] = {}
        """whether each vehicle on the road is a CAV, in order of entry"""
        self.teleported: dict[str, bool] = {}
        """vehicles that SUMO has teleported and not yet reinserted, and whether each is a CAV"""
        self.off_road: dict[str, bool] = {}
        """vehicles that SUMO is removing, but lists as arrived or teleported only later, and whether each is a CAV"""
        self._removed_unlisted = set[str]()
        """vehicles that were removed in a collision, and that SUMO has not yet listed as arrived"""
        self.collided_vehicles = set[str]()
        self.arrivals = self.teleports = 0
        self.removed_count = 0
        """number of vehicles that SUMO removed for good; they are also counted as teleports, and never arrive"""

    def update(self, simulation: Simulation, is_cav: Callable[[str], bool]) -> tuple[list[str], Sequence[str]]:
        """Update after a step, and return the vehicles that left and that entered; `is_cav` selects the CAVs."""
        entered, arrived = simulation.departed_vehicles(), simulation.arrived_vehicles()
        teleporting = simulation.teleporting_vehicles()
        self.arrivals += len(set(arrived) - self._removed_unlisted)
        self._removed_unlisted.difference_update(arrived)
        self.teleports += len(teleporting)
        known = {**self.off_road, **self.is_cav} if self.off_road else self.is_cav
        self.teleported |= {vehicle_id: known[vehicle_id] for vehicle_id in teleporting if vehicle_id in known}
        left = [*arrived, *teleporting]
        for vehicle_id in left:
            self.is_cav.pop(vehicle_id, None)
            self.off_road.pop(vehicle_id, None)
        for vehicle_id in arrived:  # SUMO may have teleported the vehicle to the end of its route
            self.teleported.pop(vehicle_id, None)
        for vehicle_id in entered:
            self.is_cav[vehicle_id] = is_cav(vehicle_id)
        for vehicle_id in filter(self.teleported.__contains__, simulation.reinserted_vehicles()):
            self.is_cav[vehicle_id] = self.teleported.pop(vehicle_id)
        return left, entered

    def take_off_road(self, ids: Sequence[str]) -> None:
        """Take vehicles from the road that SUMO is removing because of a calibrator or a collision."""
        self.off_road |= {vehicle_id: self.is_cav.pop(vehicle_id) for vehicle_id in ids}

    def add_collision(self, colliding: Sequence[str], simulation: Simulation) -> None:
        """Count the vehicles that collided in the last step; those that SUMO removes are teleports, not arrivals."""
        self.collided_vehicles.update(colliding)
        removed = set(colliding) & {*simulation.arrived_vehicles(), *self.off_road}
        removed -= set(simulation.teleporting_vehicles())  # a vehicle that is teleported to its destination arrives
        unlisted = removed & self.off_road.keys()
        self._removed_unlisted |= unlisted
        self.teleports += len(removed)
        self.add_removals(len(removed))
        self.arrivals += len(unlisted)  # `add_removals` has subtracted them, but they were not yet counted

    def add_removals(self, count: int) -> None:
        """Count vehicles that SUMO has removed, and that were counted both as arrivals and as teleports."""
        self.arrivals -= count
        self.removed_count += count


class OpenTraffic(Traffic[OpenRoadT]):
    """Base class of the worlds of open roads in SUMO.

    A vehicle becomes a CAV at the first control step after its entry. The trip of a CAV ends with the last control step
    after which it is still on the road.
    """

    _fuel_interval = 1
    """number of control steps between two measurements of fuel"""
    _cav_type_template = "cav"
    """id of the vehicle type of CAVs; `{}` stands for the type that the vehicle had before"""

    # Methods that the kinds of roads override:

    def _network_file(self) -> Path:
        return network_file(cast(BuiltRoad, self.road).network)

    def _is_cav(self, vehicle_id: str) -> bool:
        return vehicle_id in self.road.cav_ids

    def _update_vehicles(self, left_ids: Sequence[str], entered_ids: Sequence[str]) -> None:
        """Update the states of the vehicles after a simulation step."""

    def _command_humans(self) -> None:
        """Command the speeds of human-driven vehicles that SUMO does not drive itself."""

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        self._simulation.command_speeds(speeds.keys(), speeds.values())

    def _collisions(self) -> tuple[Sequence[str], bool]:
        """Return the vehicles that collided in the last step, and whether that ends the episode."""
        colliding = self._simulation.colliding_vehicles()
        return colliding, bool(colliding)

    def _ids_and_speeds(self) -> tuple[Sequence[str], Floats]:
        """Return the vehicles on the road after the last step, and their speeds [m/s], in the same order."""
        if self._cached_speeds is None:
            ids = list(self._vehicles.is_cav)
            self._cached_speeds = ids, np.array(self._simulation.speeds(ids), np.float64)
        return self._cached_speeds

    def _vehicles_off_road(self) -> list[str]:
        """Return the vehicles that SUMO is removing, but does not yet list as arrived; only user networks have some."""
        return []

    def _local_states(self, ids: Sequence[str]) -> LocalState:
        """Return the local states of CAVs; called once after each control step."""
        raise NotImplementedError

    def _following_states(self, ids: Sequence[str]) -> list[FollowingState]:
        """Return the states that the safety filter uses; without a filter, states without a leader."""
        return [FollowingState(speed, speed, inf) for speed in self._simulation.speeds(ids)]

    def _snapshot(self, ids: Sequence[str]) -> dict[str, Any]:
        """Return `positions` [m], `gaps` to the leaders [m] and other columns for figures, by name."""
        raise NotImplementedError

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return the fields of the record from snapshots in `columns`, and fields that only this kind of road has."""
        names = ("positions", "gaps", "poses") if self.options.record_details else ("positions", "gaps")
        return {name: self._log.traffic.snapshots(name, columns) for name in names}

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        """Return the names of the branches on which vehicles enter; empty on roads with one entrance."""
        return [""] * len(vehicles)

    def _column_groups(self, vehicles: Sequence[str]) -> Sequence[Hashable]:
        """Return the groups of vehicles that may share columns of the record."""
        return [""] * len(vehicles)

    def _make_log(self) -> OpenRoadLog:
        return OpenRoadLog(self.scenario, *self._ids_and_speeds())

    # Methods that all kinds of roads share:

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter, as not all CAVs of the road have entered."""
        return self.entered_count < len(self.road.cav_ids)

    @property
    def backlog(self) -> int:
        """The current insertion backlog, including teleported and removed vehicles."""
        return self._log.backlog[-1]

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, and let the driver control the CAVs if `is_controlled`; return no history."""
        self._vehicles = ActiveVehicles()
        self._controlled_cavs = set[str]()
        self.cav_ids = []
        self._report_progress = on_progress or (lambda steps: None)
        self._update_active_vehicles()
        self._log = self._make_log()
        self._warm_up(lambda: self._simulate({}), on_progress)
        self.is_controlled = is_controlled
        self._vehicles.arrivals = self._vehicles.teleports = 0
        self._vehicles.collided_vehicles.clear()
        self._log = self._make_log()
        self._log_control_step()

    def exact_state(self) -> LocalState:
        """Return the exact current local state of the CAVs."""
        return self._log.trips.states[-1].as_read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one control step; with the command None, the CAVs drive as human-driven vehicles."""
        self._simulation.check()
        scenario, ids, trips = self.scenario, self.cav_ids, self._log.trips
        is_exact = scenario.actuation != "cruise"
        requested = self.limited_accelerations(command) if self.is_controlled else []
        previous_speeds = trips.states[-1].speed
        shield_brakings = dict.fromkeys(ids, 0.0)
        reductions: dict[str, list[float]] = {vehicle_id: [] for vehicle_id in ids}
        for _ in range(scenario.steps_per_control_step):
            pairs = zip(ids, requested, strict=False)
            active = {vehicle_id: value for vehicle_id, value in pairs if vehicle_id in self._vehicles.is_cav}
            commanded, safe = self._safe_speeds(active)
            for vehicle_id, value in safe.items():
                reductions[vehicle_id].append(active[vehicle_id] - value)
            self._simulate(commanded)
            remaining = [vehicle_id for vehicle_id in commanded if vehicle_id in self._vehicles.is_cav]
            actual = dict(zip(remaining, self._simulation.speeds(remaining), strict=True)) if is_exact else {}
            slower = [vehicle_id for vehicle_id, speed in actual.items() if speed < commanded[vehicle_id]]
            # SUMO does not override a CAV that drives at the allowed speed.
            for vehicle_id, allowed in zip(slower, self._simulation.allowed_speeds(slower), strict=True):
                difference = float(np.fmin(commanded[vehicle_id], allowed)) - actual[vehicle_id]
                shield_brakings[vehicle_id] = max(shield_brakings[vehicle_id], difference / scenario.simulation_step)
            if self.has_crashed or self.stop_reason:
                break
        self.control_steps += 1
        self._log_control_step()
        if not (self.is_controlled and is_exact):  # use actual accelerations, zero for vehicles that have left
            speeds = dict(zip(self._log.traffic.names, self.speeds, strict=True))
            changes = (speeds.get(vehicle_id, old) - old for vehicle_id, old in zip(ids, previous_speeds, strict=True))
            requested = [change / scenario.control_step for change in changes]
        means = [sum(values) / scenario.steps_per_control_step * is_exact for values in reductions.values()]
        trips.applied_accelerations.append([value - mean for value, mean in zip(requested, means, strict=True)])
        trips.filter_brakings.append([max(values, default=0.0) for values in reductions.values()])
        trips.shield_brakings.append(list(shield_brakings.values()))
        if self.options.record_details and (self.control_steps - 1) % self._fuel_interval == 0:
            self._log.fuel.append(sum(self._simulation.fuel(self._log.traffic.names)))

    def _safe_speeds(self, accelerations: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the CAVs' speeds after this step [m/s], and their accelerations after the safety filter [m/s2]."""
        speeds, safe = dict[str, float](), dict[str, float]()
        for vehicle_id, state in zip(accelerations, self._following_states(list(accelerations)), strict=True):
            safe[vehicle_id], actual = self.filtered_acceleration(vehicle_id, accelerations[vehicle_id], state)
            speeds[vehicle_id] = next_speed(state.speed, actual, self.scenario.simulation_step)
        return speeds, safe

    def _simulate(self, cav_speeds: dict[str, float]) -> None:
        """Simulate one step, given the commanded speeds of CAVs [m/s]."""
        self._command_humans()
        self._command_cavs(cav_speeds)
        self._simulation.step()
        self._update_active_vehicles()
        self._log.add_step(*self._ids_and_speeds(), self.cav_ids if self.is_controlled else ())
        colliding, ends_episode = self._collisions()
        if colliding:
            self._vehicles.add_collision(colliding, self._simulation)
            self.has_crashed = self.has_crashed or ends_episode

    def _update_active_vehicles(self) -> None:
        self._cached_speeds: tuple[Sequence[str], Floats] | None = None
        left, entered = self._vehicles.update(self._simulation, self._is_cav)
        if off_road := self._vehicles_off_road():
            self._vehicles.take_off_road(off_road)
            left, self._cached_speeds = [*left, *off_road], None
        self._controlled_cavs.difference_update(entered)  # a new vehicle may have the id of one that has left
        self._update_vehicles(left, entered)

    def _log_control_step(self) -> None:
        """Take control of the CAVs that have entered, and log the state after a control step."""
        simulation, scenario, previous = self._simulation, self.scenario, set(self.cav_ids)
        rows = [row for row, vehicle_id in enumerate(self.cav_ids) if vehicle_id in self._vehicles.is_cav]
        new = [vehicle for vehicle, is_cav in self._vehicles.is_cav.items() if is_cav and vehicle not in previous]
        self.remaining_rows = rows if new or len(rows) < len(previous) else None
        if self.remaining_rows is not None:
            self.cav_ids = [*(self.cav_ids[row] for row in rows), *new]
        self.entered_count += len(new)
        if self.is_controlled:
            new = [vehicle_id for vehicle_id in new if vehicle_id not in self._controlled_cavs]
            self._controlled_cavs.update(new)
            settings = scenario.actuation, scenario.right_of_way, self._cav_type_template
            simulation.take_control(new, *settings, lane_change_parameters(scenario))
        ids, self.speeds = self._ids_and_speeds()
        log, states = self._log, self._local_states(self.cav_ids)
        log.traffic.add(ids, self.speeds)
        if log.traffic.needs_snapshot:
            poses = {"poses": simulation.poses(ids)} if self.options.record_details else {}
            log.traffic.add_snapshot({**self._snapshot(ids), **poses})
        log.trips.cav_ids.append(self.cav_ids)
        log.trips.states.append(states)
        outside = len(simulation.pending_vehicles()) + len(self._vehicles.teleported)
        log.backlog.append(outside + self._waiting_removed_count)

    @property
    def _waiting_removed_count(self) -> int:
        """Number of removed vehicles in the backlog until the end; zero where a removal ends the episode."""
        return 0

    def _make_record(self, driver_log: DriverLog) -> Episode:
        log, vehicles, details = self._log, self._vehicles, self.options.record_details
        trips = log.trips.trajectories(driver_log, self.has_crashed, lambda: self._report_progress(self.control_steps))
        branches = self._branches(log.traffic.vehicle_ids)
        groups = self._column_groups(log.traffic.vehicle_ids)
        columns, fields = log.episode_fields(trips, branches, list(vehicles.teleported), groups)
        fields |= {
            "fuel": np.repeat(log.fuel, self._fuel_interval)[: self.control_steps] if details else np.zeros((0, 0)),
            "arrivals": vehicles.arrivals,
            "teleports": vehicles.teleports,
            "removed": self._waiting_removed_count,
            "collisions": len(vehicles.collided_vehicles),
            "planned_duration": self.scenario.horizon * self.scenario.control_step,
            "lane_lines": network_geometry(self._network_file()).lane_lines if details else np.zeros((0, 2)),
        }
        return Episode(**{**self.record_fields(), **fields, **self._snapshot_fields(columns)})

    def last_applied_acceleration(self) -> Floats:
        """Return the CAVs' accelerations in the last control step, after the safety filter [m/s2], shape (CAVs,)."""
        return np.array(self._log.trips.applied_accelerations[-1])

    def scene(self) -> RoadScene:
        """Return the current state of the road for pictures."""
        self._simulation.check()
        ids = self._log.traffic.names
        is_cav = np.array([vehicle_id in self.cav_ids for vehicle_id in ids], bool)
        lines = network_geometry(self._network_file()).lane_lines
        return RoadScene(lines, self._simulation.poses(ids), np.array(self.speeds), is_cav)


class MultiLaneTraffic(OpenTraffic[OpenRoadT]):
    """Base class of the worlds of open roads with several lanes, on which an ACC may carry out commands."""

    def _prepare(self) -> None:
        self._speed_caps = SpeedCaps(self._simulation)
        self._time_gaps: dict[str, float] = {}
        """current time gap of the CAVs that have received a time gap command for their ACC [s]"""

    def _make_log(self) -> OpenRoadLog:
        return MultiLaneLog(self.scenario, *self._ids_and_speeds(), self._tracked_leaders)

    def advance(self, command: Command | None) -> None:
        """Set the time gaps that the command has for the ACCs of CAVs, and simulate one control step."""
        has_time_gaps = command is not None and command.time_gap is not None
        if self.scenario.actuation == "cruise" and (has_time_gaps or self._time_gaps):
            default = self.scenario.cruise.time_gap
            commanded = commanded_time_gaps(command, default, self.cav_ids, self.control_steps)
            for vehicle_id, time_gap in zip(self.cav_ids, commanded, strict=True):
                if time_gap != self._time_gaps.get(vehicle_id, default):
                    self._simulation.set_time_gap(vehicle_id, time_gap)
                    self._time_gaps[vehicle_id] = time_gap
        super().advance(command)

    def _tracked_leaders(self, ids: Sequence[str]) -> list[TrackedLeader]:
        raise NotImplementedError

    def _acc_limits(self, ids: Sequence[str]) -> tuple[Floats, Floats] | None:
        """Return acceleration and comfortable deceleration of CAVs [m/s2]; None: the ACC's settings apply."""
        return None

    def _is_uncapped(self, vehicle_id: str) -> bool:
        """Return whether a CAV gets no set-speed cap at its position."""
        return False

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        """Set the set-speed caps of CAVs with an ACC, which SUMO drives; command the speeds of other CAVs."""
        cruise, simulation, ids = self.scenario.cruise, self._simulation, list(speeds)
        if self.scenario.actuation != "cruise":
            super()._command_cavs(speeds)
            return
        current, targets = np.array(simulation.speeds(ids)), np.array([*speeds.values()])
        step, limits = self.scenario.simulation_step, self._acc_limits(ids)
        caps = cruise.set_speed(current, targets, self.limits.highest, step, limits)
        for vehicle_id, cap in zip(ids, caps.tolist(), strict=True):
            self._speed_caps.set_cap(vehicle_id, "set speed", inf if self._is_uncapped(vehicle_id) else cap)
