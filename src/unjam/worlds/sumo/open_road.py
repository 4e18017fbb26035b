"""Traffic on roads with ends: vehicles enter and leave, and each trip of a CAV is a trajectory."""

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
    """Return the local states of some rows, given rows of neighbors (-1: none) and a function for gaps [m]."""
    values = [speeds[rows]]
    for neighbors, gaps in ((leaders, leader_gaps(rows, leaders)), (followers, leader_gaps(followers, rows))):
        values += observe_neighbor(neighbors >= 0, gaps, speeds[neighbors], speeds[rows])
    return LocalState(*values, route_position=positions[rows], loop_length=np.full(len(rows), np.nan))


class ActiveVehicles:
    """The vehicles on a road with ends, and counts of arrivals, teleports and collisions."""

    def __init__(self) -> None:
        self.is_cav: dict[str, bool] = {}
        """whether each vehicle on the road is a CAV, in order of entry"""
        self.teleported: dict[str, bool] = {}
        """the same for vehicles that SUMO has teleported and not yet reinserted"""
        self.off_road: dict[str, bool] = {}
        """the same for vehicles that SUMO is removing, which it lists as arrived or teleported only later"""
        self._removed_unlisted = set[str]()
        self.collided_vehicles = set[str]()
        self.arrivals = self.teleports = 0
        self.removed_count = 0
        """vehicles that SUMO removed for good, among the teleports: they never arrive"""

    def update(self, simulation: Simulation, is_cav: Callable[[str], bool]) -> tuple[list[str], Sequence[str]]:
        """Update after a step, and return the vehicles that left and that entered, which `is_cav` judges."""
        entered, arrived = simulation.departed_vehicles(), simulation.arrived_vehicles()
        teleporting = simulation.teleporting_vehicles()
        self.arrivals += len(set(arrived) - self._removed_unlisted)
        self._removed_unlisted.difference_update(arrived)
        self.teleports += len(teleporting)
        known = {**self.off_road, **self.is_cav} if self.off_road else self.is_cav
        self.teleported |= {name: known[name] for name in teleporting if name in known}
        left = [*arrived, *teleporting]
        for name in left:
            self.is_cav.pop(name, None)
            self.off_road.pop(name, None)
        for name in arrived:  # SUMO may teleport a vehicle to the end of its route
            self.teleported.pop(name, None)
        for name in entered:
            self.is_cav[name] = is_cav(name)
        for name in filter(self.teleported.__contains__, simulation.reinserted_vehicles()):
            self.is_cav[name] = self.teleported.pop(name)
        return left, entered

    def take_off_road(self, names: Sequence[str]) -> None:
        """Take vehicles from the road which SUMO is removing: calibrators do so, and collisions."""
        self.off_road |= {name: self.is_cav.pop(name) for name in names}

    def add_collision(self, colliding: Sequence[str], simulation: Simulation) -> None:
        """Count a collision in the last step; vehicles that SUMO removes for it are teleports, not arrivals."""
        self.collided_vehicles.update(colliding)
        removed = set(colliding) & {*simulation.arrived_vehicles(), *self.off_road}
        removed -= set(simulation.teleporting_vehicles())  # one that is teleported to its end has arrived
        unlisted = removed & self.off_road.keys()
        self._removed_unlisted |= unlisted
        self.teleports += len(removed)
        self.add_removals(len(removed))
        self.arrivals += len(unlisted)  # not counted as arrived so far

    def add_removals(self, count: int) -> None:
        """Count vehicles that SUMO has removed, and lists as arrived; they are counted as teleports, too."""
        self.arrivals -= count
        self.removed_count += count


class OpenTraffic(Traffic[OpenRoadT]):
    """Common part of the roads with ends.

    A vehicle becomes a CAV at the first control step after its entry. Its trip ends with the last control step after
    which it is still on the road.
    """

    _fuel_interval = 1
    _cav_type_template = "cav"
    """vehicle type of a CAV; `{}` stands for its own type"""

    # What the kinds of roads do in their own way:

    def _network_file(self) -> Path:
        return network_file(cast(BuiltRoad, self.road).network)

    def _is_cav(self, name: str) -> bool:
        return name in self.road.cav_ids

    def _update_vehicles(self, left_names: Sequence[str], entered_names: Sequence[str]) -> None:
        """Update what is known of the vehicles after a simulation step."""

    def _command_humans(self) -> None:
        """Command the speeds of human drivers, unless SUMO drives them."""

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        self._simulation.command_speeds(speeds.keys(), speeds.values())

    def _collisions(self) -> tuple[Sequence[str], bool]:
        """Return the vehicles that collided in the last step, and whether that ends the episode."""
        colliding = self._simulation.colliding_vehicles()
        return colliding, bool(colliding)

    def _names_and_speeds(self) -> tuple[Sequence[str], Floats]:
        """Return the vehicles on the road after the last step, and their speeds [m/s], in the same order."""
        if self._cached_speeds is None:
            names = list(self._vehicles.is_cav)
            self._cached_speeds = names, np.array(self._simulation.speeds(names), np.float64)
        return self._cached_speeds

    def _vehicles_off_road(self) -> list[str]:
        """Return the vehicles that SUMO is removing, and does not yet list as arrived: on user networks only."""
        return []

    def _local_states(self, names: Sequence[str]) -> LocalState:
        """Return the local states of CAVs; called once after each control step."""
        raise NotImplementedError

    def _following_states(self, names: Sequence[str]) -> list[FollowingState]:
        """Return the states that the safety filter uses; without a filter, there is no leader."""
        return [FollowingState(speed, speed, inf) for speed in self._simulation.speeds(names)]

    def _snapshot(self, names: Sequence[str]) -> dict[str, Any]:
        """Return `positions` [m], `gaps` to the leaders [m] and other values of these vehicles for figures."""
        raise NotImplementedError

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return the fields of the record that are made from snapshots, and others of this kind of road."""
        names = ("positions", "gaps", "poses") if self.options.record_details else ("positions", "gaps")
        return {name: self._log.traffic.snapshots(name, columns) for name in names}

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        return [""] * len(vehicles)

    def _column_groups(self, vehicles: Sequence[str]) -> Sequence[Hashable]:
        """Return the groups of vehicles that may share columns of the record."""
        return [""] * len(vehicles)

    def _make_log(self) -> OpenRoadLog:
        return OpenRoadLog(self.scenario, *self._names_and_speeds())

    # What they have in common:

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: not all CAVs of the road have entered."""
        return self.entered_count < len(self.road.cav_ids)

    @property
    def backlog(self) -> int:
        """The insertion backlog now, including teleported and removed vehicles."""
        return self._log.backlog[-1]

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs to the driver, without a history."""
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
        self._log_moment()

    def exact_state(self) -> LocalState:
        """Return the exact local state of the CAVs now."""
        return self._log.trips.states[-1].as_read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one control step; None: the CAVs stay human."""
        self._simulation.check()
        scenario, names, trips = self.scenario, self.cav_ids, self._log.trips
        is_exact = scenario.actuation != "cruise"
        requested = self.limited_accelerations(command) if self.is_controlled else []
        before = trips.states[-1].speed
        shield = dict.fromkeys(names, 0.0)
        reductions: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(scenario.steps_per_control_step):
            values = zip(names, requested, strict=False)
            active = {name: value for name, value in values if name in self._vehicles.is_cav}
            commanded, safe = self._safe_speeds(active)
            for name, value in safe.items():
                reductions[name].append(active[name] - value)
            self._simulate(commanded)
            remaining = [name for name in commanded if name in self._vehicles.is_cav]
            moved = dict(zip(remaining, self._simulation.speeds(remaining), strict=True)) if is_exact else {}
            slower = [name for name, speed in moved.items() if speed < commanded[name]]
            # A CAV at the allowed speed is not overridden.
            for name, allowed in zip(slower, self._simulation.allowed_speeds(slower), strict=True):
                added = (float(np.fmin(commanded[name], allowed)) - moved[name]) / scenario.simulation_step
                shield[name] = max(shield[name], added)
            if self.has_crashed or self.stop_reason:
                break
        self.control_steps += 1
        self._log_moment()
        if not (self.is_controlled and is_exact):  # the actual accelerations, zero for vehicles that have left
            after = dict(zip(self._log.traffic.names, self.speeds, strict=True))
            changes = (after.get(name, speed) - speed for name, speed in zip(names, before, strict=True))
            requested = [change / scenario.control_step for change in changes]
        means = [sum(values) / scenario.steps_per_control_step * is_exact for values in reductions.values()]
        trips.applied_accelerations.append([value - mean for value, mean in zip(requested, means, strict=True)])
        trips.filter_brakings.append([max(values, default=0.0) for values in reductions.values()])
        trips.shield_brakings.append(list(shield.values()))
        if self.options.record_details and (self.control_steps - 1) % self._fuel_interval == 0:
            self._log.fuel.append(sum(self._simulation.fuel(self._log.traffic.names)))

    def _safe_speeds(self, accelerations: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the CAVs' speeds after this step [m/s], and their accelerations after the safety filter [m/s2]."""
        speeds, safe = dict[str, float](), dict[str, float]()
        for name, state in zip(accelerations, self._following_states(list(accelerations)), strict=True):
            safe[name], actual = self.filtered_acceleration(name, accelerations[name], state)
            speeds[name] = next_speed(state.speed, actual, self.scenario.simulation_step)
        return speeds, safe

    def _simulate(self, cav_speeds: dict[str, float]) -> None:
        self._command_humans()
        self._command_cavs(cav_speeds)
        self._simulation.step()
        self._update_active_vehicles()
        self._log.add_step(*self._names_and_speeds(), self.cav_ids if self.is_controlled else ())
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
        self._controlled_cavs.difference_update(entered)  # SUMO allows the name of a vehicle that has left
        self._update_vehicles(left, entered)

    def _log_moment(self) -> None:
        """Take control of CAVs that have entered, and log the state after a control step."""
        simulation, scenario, known = self._simulation, self.scenario, set(self.cav_ids)
        rows = [row for row, name in enumerate(self.cav_ids) if name in self._vehicles.is_cav]
        new = [name for name, is_cav in self._vehicles.is_cav.items() if is_cav and name not in known]
        self.remaining_rows = rows if new or len(rows) < len(known) else None
        if self.remaining_rows is not None:
            self.cav_ids = [*(self.cav_ids[row] for row in rows), *new]
        self.entered_count += len(new)
        if self.is_controlled:
            new = [name for name in new if name not in self._controlled_cavs]
            self._controlled_cavs.update(new)
            changes = lane_change_parameters(scenario)
            simulation.take_control(new, scenario.actuation, scenario.right_of_way, self._cav_type_template, changes)
        names, self.speeds = self._names_and_speeds()
        log, states = self._log, self._local_states(self.cav_ids)
        log.traffic.add(names, self.speeds)
        if log.traffic.needs_snapshot:
            poses = {"poses": simulation.poses(names)} if self.options.record_details else {}
            log.traffic.add_snapshot({**self._snapshot(names), **poses})
        log.trips.cav_ids.append(self.cav_ids)
        log.trips.states.append(states)
        waiting = len(simulation.pending_vehicles()) + len(self._vehicles.teleported)
        log.backlog.append(waiting + self._waiting_removed_count)

    @property
    def _waiting_removed_count(self) -> int:
        """Number of removed vehicles that count until the end; zero where a removal ends the episode."""
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
        names = self._log.traffic.names
        is_cav = np.array([name in self.cav_ids for name in names], bool)
        lines = network_geometry(self._network_file()).lane_lines
        return RoadScene(lines, self._simulation.poses(names), np.array(self.speeds), is_cav)


class MultiLaneTraffic(OpenTraffic[OpenRoadT]):
    """Common part of the roads with lanes, on which the CAV's own ACC may carry out commands."""

    def _prepare(self) -> None:
        self._speed_caps = SpeedCaps(self._simulation)
        self._time_gaps: dict[str, float] = {}
        """current time gap of CAVs with a time gap command to their ACC [s]"""

    def _make_log(self) -> OpenRoadLog:
        return MultiLaneLog(self.scenario, *self._names_and_speeds(), self._tracked_leaders)

    def advance(self, command: Command | None) -> None:
        """Simulate one control step, after time gap commands to the CAVs' own ACCs, if any."""
        has_time_gaps = command is not None and command.time_gap is not None
        if self.scenario.actuation == "cruise" and (has_time_gaps or self._time_gaps):
            default = self.scenario.cruise.time_gap
            commanded = commanded_time_gaps(command, default, self.cav_ids, self.control_steps)
            for name, time_gap in zip(self.cav_ids, commanded, strict=True):
                if time_gap != self._time_gaps.get(name, default):
                    self._simulation.set_time_gap(name, time_gap)
                    self._time_gaps[name] = time_gap
        super().advance(command)

    def _tracked_leaders(self, names: Sequence[str]) -> list[TrackedLeader]:
        raise NotImplementedError

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats] | None:
        """Return acceleration and comfortable deceleration of CAVs [m/s2]; None: those of the ACC."""
        return None

    def _is_uncapped(self, name: str) -> bool:
        """Whether a set-speed cap is not allowed where a CAV is."""
        return False

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        """Give a CAV with its own ACC, which SUMO still drives, a set-speed cap, or none if it may drive freely."""
        cruise, simulation, names = self.scenario.cruise, self._simulation, list(speeds)
        if self.scenario.actuation != "cruise":
            super()._command_cavs(speeds)
            return
        current, targets = np.array(simulation.speeds(names)), np.array([*speeds.values()])
        step, limits = self.scenario.simulation_step, self._acc_limits(names)
        caps = cruise.set_speed(current, targets, self.limits.highest, step, limits)
        for name, cap in zip(names, caps.tolist(), strict=True):
            self._speed_caps.set_cap(name, "set speed", inf if self._is_uncapped(name) else cap)
