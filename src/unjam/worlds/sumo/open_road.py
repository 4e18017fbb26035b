"""Traffic on roads with ends: vehicles come and go, and each stay of a CAV is a trajectory of its own."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.physics.kinematics import next_speed
from unjam.worlds.audit import (
    CAV_DRIVER,
    HUMAN_DRIVER,
    OVERRIDE_TOLERANCE,
    Audit,
    BrakingLog,
    FollowingStatistics,
    following_statistics,
)
from unjam.worlds.record import Episode, Floats, Trajectory
from unjam.worlds.sumo.inputs import lane_change_parameters
from unjam.worlds.sumo.traffic import OpenRoadT, RoadScene, Traffic
from unjam.worlds.sumo.traffic_log import TrafficLog
from unjam.worlds.sumo.trip_log import TripLog
from unjam.worlds.world import DriverLog, ProgressCallback


class OpenTraffic(Traffic[OpenRoadT]):
    """What roads with ends have in common.

    A vehicle becomes a CAV at the first decision after it entered; until then it drives as people do. Its
    stay ends with the last decision after which it is still on the road. What comes before `start` each kind
    of road does in its own way.
    """

    _fuel_interval = 1
    """decisions for which what all vehicles burn is held"""

    def _is_cav(self, name: str) -> bool:
        """Whether a vehicle that has just entered is a CAV."""
        return name in self.road.cav_ids

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: not all that the road names have."""
        return self.entered_count < len(self.road.cav_ids)

    def _update_vehicles(self, left_names: Sequence[str], entered_names: Sequence[str]) -> None:
        """Follow how the vehicles moved in the last step, who left and who entered."""

    def _command_humans(self) -> None:
        """Ask for the speeds that people want, where SUMO does not drive them."""

    def _names_and_speeds(self) -> tuple[Sequence[str], Floats]:
        """Return who is on the road after the last step, and their speeds [m/s], in one order."""
        if self._cached_speeds is None:
            names = list(self._active_vehicles)
            self._cached_speeds = names, np.array(self._simulation.speeds(names), np.float64)
        return self._cached_speeds

    def _prepare_states(self) -> None:
        """Get ready for what is asked of the moment after a decision."""

    def _snapshot(self, names: Sequence[str]) -> dict[str, Any]:
        """Return what pictures show of these vehicles now, `positions` [m] and `gaps` to those ahead [m]."""
        raise NotImplementedError

    def _local_states(self, names: Sequence[str]) -> LocalState:
        """Return what CAVs perceive now."""
        raise NotImplementedError

    def _following_states(self, names: Sequence[str]) -> list[FollowingState]:
        """Return what these CAVs' filters know now; nobody is ahead where there is no filter."""
        return [FollowingState(speed, speed, inf) for speed in self._simulation.speeds(names)]

    def _lane_lines(self) -> Floats:
        """Return the road's lines as `Scene` has them."""
        raise NotImplementedError

    @property
    def _cav_type_template(self) -> str:
        """What the type of a vehicle becomes with which it is a CAV; `{}` stands for the type it had."""
        return "cav"

    def _clip_to_allowed_speeds(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds of CAVs, none above what the road allows [m/s]."""
        return speeds

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        """Command CAVs to have these speeds after the next step [m/s]."""
        self._simulation.command_speeds(speeds.keys(), speeds.values())

    def _colliding_vehicles(self) -> Sequence[str]:
        """Return the vehicles that collided in the last step."""
        return self._simulation.colliding_vehicles()

    def _ends_episode(self, colliding: Sequence[str]) -> bool:
        """Whether a collision of these vehicles ends the episode."""
        return True

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._active_vehicles: dict[str, bool] = {}
        """who is there, in order of entry; true: to be driven by the driver"""
        self._teleported_vehicles: dict[str, bool] = {}
        """whom SUMO has lifted off the road, likewise"""
        self._teleport_count = 0
        self._collided_vehicles = set[str]()
        """who was in contact with another"""
        self._controlled_cavs = set[str]()
        """CAVs that were taken control of"""
        self.cav_ids, self._arrival_count = [], 0
        self._report_progress = on_progress or (lambda steps: None)
        self._cached_speeds: tuple[Sequence[str], Floats] | None = None
        self._reset_log()
        self._update_active_vehicles()
        self._warm_up(lambda: self._simulate({}), on_progress)
        self._is_controlled = is_controlled
        self._traffic_log = TrafficLog()
        self._trip_log = TripLog()
        self._logged_backlog: list[int] = []
        self._logged_fuel: list[float] = []
        self._arrival_count = self._teleport_count = 0
        self._collided_vehicles.clear()
        self._reset_log()
        names, self._last_speeds = self._names_and_speeds()  # or the first step's changes of speed would be none
        self._logged_names, self._cached_driver_kinds = list(names), np.zeros(len(names), np.uint8)
        self._log_moment()

    def _reset_log(self) -> None:
        """Begin the log of everybody's accelerations anew."""
        self._logged_names: Sequence[str] = ()
        self._cached_driver_kinds: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._logged_cav_ids: Sequence[str] = ()
        self._last_speeds = np.zeros(0)
        self._braking_log = BrakingLog(self.scenario.simulation_step)

    @property
    def backlog(self) -> int:
        """How many want to enter now and cannot."""
        return self._logged_backlog[-1]

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        return self._trip_log.states[-1].as_read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        self._simulation.check()
        scenario, names = self.scenario, self.cav_ids
        step, obeys = scenario.simulation_step, scenario.actuation != "cruise"
        wanted = self._limited_accelerations(command) if self._is_controlled else []
        before = self._trip_log.states[-1].speed
        shield = dict.fromkeys(names, 0.0)
        taken: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(scenario.steps_per_control_step):
            asked = {name: value for name, value in zip(names, wanted, strict=False) if name in self._active_vehicles}
            commanded = self._clip_to_allowed_speeds(self._safe_speeds(asked, taken))
            self._simulate(commanded)
            still = [name for name in commanded if name in self._active_vehicles]
            moved = dict(zip(still, self._simulation.speeds(still), strict=True)) if obeys else {}
            slower = [name for name, speed in moved.items() if speed < commanded[name]]
            # Who has reached what the road allows is not overridden.
            for name, most in zip(slower, self._simulation.allowed_speeds(slower), strict=True):
                shield[name] = max(shield[name], (min(commanded[name], most) - moved[name]) / step)
            if self.has_crashed or self.stop_reason:
                break
        self.control_steps += 1
        self._log_moment()
        if not (self._is_controlled and obeys):
            after = dict(zip(self._traffic_log.names, self.speeds, strict=True))
            changes = (after.get(name, speed) - speed for name, speed in zip(names, before, strict=True))
            wanted = [change / scenario.control_step for change in changes]
        less = [sum(values) / scenario.steps_per_control_step * obeys for values in taken.values()]
        self._trip_log.applied_accelerations.append([asked - part for asked, part in zip(wanted, less, strict=True)])
        self._trip_log.filter_brakings.append([max(values, default=0.0) for values in taken.values()])
        self._trip_log.shield_brakings.append(list(shield.values()))
        if self.record_details and (self.control_steps - 1) % self._fuel_interval == 0:
            self._logged_fuel.append(sum(self._simulation.fuel(self._traffic_log.names)))

    def _safe_speeds(
        self, accelerations: dict[str, float], filter_brakings: dict[str, list[float]]
    ) -> dict[str, float]:
        """Return the speeds that CAVs' accelerations lead to in this step, once they are filtered [m/s].

        What the filter takes from each is added to `taken` [m/s2].
        """
        names, found, step = list(accelerations), {}, self.scenario.simulation_step
        for name, ahead in zip(names, self._following_states(names), strict=True):
            told, done = self._apply_acceleration(name, accelerations[name], ahead)
            filter_brakings[name].append(accelerations[name] - told)
            found[name] = next_speed(ahead.speed, done, step)
        return found

    def _simulate(self, cav_speeds: dict[str, float]) -> None:
        """Simulate one step after which these CAVs shall have these speeds [m/s]."""
        self._command_humans()
        self._command_cavs(cav_speeds)
        self._simulation.step()
        self._update_active_vehicles()
        self._log_speed_changes()
        colliding = self._colliding_vehicles()
        if colliding:
            self._collided_vehicles.update(colliding)
            removed = set(colliding).intersection(self._simulation.arrived_vehicles())
            removed -= set(self._simulation.teleporting_vehicles())  # one that is teleported to its end has arrived
            self._arrival_count, self._teleport_count = (
                self._arrival_count - len(removed),
                self._teleport_count + len(removed),
            )
            self.has_crashed = self.has_crashed or self._ends_episode(colliding)

    def _update_active_vehicles(self) -> None:
        """Keep up with who is on the road."""
        self._cached_speeds = None
        simulation = self._simulation
        entered, arrived, lifted = (
            simulation.departed_vehicles(),
            simulation.arrived_vehicles(),
            simulation.teleporting_vehicles(),
        )
        self._arrival_count += len(arrived)
        self._teleport_count += len(lifted)
        self._teleported_vehicles |= {
            name: self._active_vehicles[name] for name in lifted if name in self._active_vehicles
        }
        for name in (*arrived, *lifted):
            self._active_vehicles.pop(name, None)
        for name in arrived:  # also from where it was lifted
            self._teleported_vehicles.pop(name, None)
        self._update_vehicles([*arrived, *lifted], entered)
        for name in entered:
            self._active_vehicles[name] = self._is_cav(name)
        for name in filter(self._teleported_vehicles.__contains__, simulation.reinserted_vehicles()):
            self._active_vehicles[name] = self._teleported_vehicles.pop(name)

    def _log_speed_changes(self) -> None:
        """Note how everybody's speed has changed in this step: people's and CAVs' apart."""
        names, speeds = self._names_and_speeds()
        last, driven = self._last_speeds, self.cav_ids if self._is_controlled else ()
        if names != self._logged_names:  # in few steps: the rest is quick
            before = dict(zip(self._logged_names, last.tolist(), strict=True))
            last = np.array(list(map(before.get, names, speeds.tolist())), np.float64)
        if names != self._logged_names or driven is not self._logged_cav_ids:
            self._cached_driver_kinds = np.array(list(map(set(driven).__contains__, names)), np.uint8)
            self._logged_names, self._logged_cav_ids = list(names), driven
        self._braking_log.add(speeds - last, self._driver_kinds())
        self._last_speeds = speeds

    def _driver_kinds(self) -> NDArray[np.uint8]:
        """Return whose changes of speed those of the last step are, in the order of `_watched`."""
        return self._cached_driver_kinds

    def _log_moment(self) -> None:
        """Note who is where after a decision, and take control of the CAVs that have entered."""
        scenario, simulation, known = self.scenario, self._simulation, set(self.cav_ids)
        rows = [row for row, name in enumerate(self.cav_ids) if name in self._active_vehicles]
        new = [name for name, chosen in self._active_vehicles.items() if chosen and name not in known]
        self.remaining_rows = rows if new or len(rows) < len(known) else None
        if self.remaining_rows is not None:
            self.cav_ids = [*(self.cav_ids[row] for row in rows), *new]
        self.entered_count += len(new)
        if self._is_controlled:
            new = [name for name in new if name not in self._controlled_cavs]
            self._controlled_cavs.update(new)
            simulation.take_control(new, scenario.actuation, scenario.right_of_way, self._cav_type_template)
            for name in new:
                for key, value in lane_change_parameters(scenario).items():
                    simulation.set_parameter(name, key, value)
        names, self.speeds = self._names_and_speeds()
        self._prepare_states()
        self._traffic_log.add(names, self.speeds)
        if self._traffic_log.needs_snapshot:
            pictured = self._snapshot(names)
            places = {"poses": simulation.poses(names)} if self.record_details else {}
            self._traffic_log.add_snapshot({**pictured, **places})
        self._trip_log.cav_ids.append(self.cav_ids)
        self._trip_log.states.append(self._local_states(self.cav_ids))
        self._logged_backlog.append(len(simulation.pending_vehicles()) + len(self._teleported_vehicles))

    def record(self, driver_log: DriverLog) -> Episode:
        """Return what happened since the start."""
        log, vehicles = self._traffic_log, self._traffic_log.vehicle_ids
        trajectories = self._trip_log.trajectories(
            driver_log, self.has_crashed, lambda: self._report_progress(self.control_steps)
        )
        cavs = dict.fromkeys(each.vehicle for each in trajectories)
        branches = self._branches(vehicles)
        columns = log.columns([(name in cavs, branch) for name, branch in zip(vehicles, branches, strict=True)])
        of_column = dict(zip(columns.tolist(), branches, strict=True))
        held = np.repeat(self._logged_fuel, self._fuel_interval)[: self.control_steps]
        facts: dict[str, Any] = {
            "vehicle_ids": vehicles,
            "cav_ids": tuple(cavs),
            "vehicle_columns": tuple(columns.tolist()) if len(of_column) < len(vehicles) else (),
            "branches": tuple(of_column[column] for column in sorted(of_column)) if any(branches) else (),
            "speeds": log.speeds(columns),
            "snapshot_stride": log.snapshot_stride,
            "fuel": held if self.record_details else np.zeros((0, 0)),
            "arrivals": self._arrival_count,
            "teleports": self._teleport_count,
            "collisions": len(self._collided_vehicles),
            "backlog": np.array(self._logged_backlog, np.float64),
            "teleported": len(self._teleported_vehicles.keys() & set(vehicles)),
            "planned_duration": self.scenario.horizon * self.scenario.control_step,
            "lane_lines": self._lane_lines() if self.record_details else np.zeros((0, 2)),
            "trajectories": trajectories,
            "audit": self._audit(trajectories),
        }
        return Episode(**{**self._common_fields(), **facts, **self._snapshot_fields(columns)})

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        """Return where each vehicle came from; an empty text where that is not known."""
        return [""] * len(vehicles)

    def _snapshot_fields(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return what pictures show, as the record has it, and what else it says of the road."""
        names = ("positions", "gaps", "poses") if self.record_details else ("positions", "gaps")
        return {name: self._traffic_log.snapshots(name, columns) for name in names}

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs followed, of every decision."""
        people, cavs = self._braking_log.statistics(HUMAN_DRIVER), self._braking_log.statistics(CAV_DRIVER)
        return Audit(people, cavs, self._following_statistics(trajectories), self.scenario.safety.time_gap)

    def _following_statistics(self, trajectories: Sequence[Trajectory]) -> FollowingStatistics:
        """Return how CAVs followed, and how often they were overridden, from what every decision recorded."""
        most = max((len(each.states.speed) for each in trajectories), default=0)
        speed, leader, gap = np.full((3, most, len(trajectories)), np.nan)
        for column, each in enumerate(trajectories):
            rows = slice(len(each.states.speed))
            speed[rows, column] = each.states.speed
            leader[rows, column], gap[rows, column] = each.states.leader_speed, each.states.leader_gap
        step = self.scenario.control_step
        added = np.concatenate([each.shield_braking for each in trajectories]) if trajectories else np.zeros(0)
        return following_statistics(speed, leader, gap, step, added > OVERRIDE_TOLERANCE, np.zeros_like(added))

    def last_applied_acceleration(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        return np.array(self._trip_log.applied_accelerations[-1])

    def scene(self) -> RoadScene:
        """Return this moment as pictures show it."""
        names, speeds = self._traffic_log.names, np.array(self.speeds)
        cavs = np.array([name in self.cav_ids for name in names], bool)
        return RoadScene(self._lane_lines(), self._simulation.poses(names), speeds, cavs)
