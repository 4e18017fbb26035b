"""The log of an episode on a road with ends, and the fields of its record.

Thousands of vehicles are each on the road for a short time; in large tables, vehicles of different times share columns.
"""

from array import array
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.scenarios.scenario import Scenario
from unjam.worlds import audit
from unjam.worlds.record import SHARED_COLUMN_FRAMES, Floats, Trajectory, assign_columns, make_trajectory
from unjam.worlds.world import DriverLog

TRIPS_PER_PROGRESS = 500
MAX_SNAPSHOT_VEHICLES = 600_000
"""maximum number of vehicles in all snapshots; beyond it, only snapshots of every second, fourth, ... moment remain"""
MAX_UNSHARED_CELLS = 2_000_000
"""maximum number of cells of a table with one column per vehicle; in larger tables vehicles share columns"""

TrackedLeader = tuple[str, FollowingState]
"""id of the leader of a CAV, empty without a leader within range, and the state of the CAV behind the leader"""


class TrafficLog:
    """Ids and speeds of the vehicles on the road at each moment, and snapshots of other quantities at some moments."""

    def __init__(self) -> None:
        self.names: list[str] = []
        """ids of the vehicles on the road at the last moment"""
        self.snapshot_stride = 1
        self._vehicle_indices: dict[str, int] = {}
        self._current_indices: NDArray[np.int32] = np.zeros(0, np.int32)
        self._indices_by_moment: list[NDArray[np.int32]] = []
        self._speeds: list[Floats] = []
        self._snapshots: dict[int, dict[str, Any]] = {}
        self._snapshot_vehicle_count = 0

    def __len__(self) -> int:
        return len(self._indices_by_moment)

    @property
    def vehicle_ids(self) -> tuple[str, ...]:
        """Ids of all vehicles so far, in order of entry."""
        return tuple(self._vehicle_indices)

    def add(self, names: Sequence[str], speeds: Any) -> None:
        """Add a moment: ids of the vehicles on the road, and their speeds [m/s]."""
        if names != self.names:  # otherwise both moments share an array
            self.names = list(names)
            for vehicle_id in names:
                self._vehicle_indices.setdefault(vehicle_id, len(self._vehicle_indices))
            self._current_indices = np.array(list(map(self._vehicle_indices.__getitem__, names)), np.int32)
        self._indices_by_moment.append(self._current_indices)
        self._speeds.append(np.array(speeds, np.float64))

    @property
    def needs_snapshot(self) -> bool:
        """Whether the last moment needs a snapshot."""
        return (len(self) - 1) % self.snapshot_stride == 0

    def add_snapshot(self, quantities: dict[str, Any]) -> None:
        """Add the snapshot of the last moment: values of each quantity in the order of `names`."""
        self._snapshots[len(self) - 1] = quantities
        self._snapshot_vehicle_count += len(self.names)
        while self._snapshot_vehicle_count > MAX_SNAPSHOT_VEHICLES and len(self._snapshots) > 2:
            self.snapshot_stride *= 2
            self._snapshots = {
                moment: snapshot for moment, snapshot in self._snapshots.items() if moment % self.snapshot_stride == 0
            }
            self._snapshot_vehicle_count = sum(len(self._indices_by_moment[moment]) for moment in self._snapshots)

    def columns(self, groups: Sequence[Hashable]) -> NDArray[np.intp]:
        """Return the column of each vehicle, given its group; vehicles of the same group may share columns."""
        if len(self) * len(groups) <= MAX_UNSHARED_CELLS:
            return np.arange(len(groups))
        first, last = np.full(len(groups), len(self)), np.zeros(len(groups), int)
        for moment, vehicles in enumerate(self._indices_by_moment):
            first[vehicles], last[vehicles] = np.minimum(first[vehicles], moment), moment
        return assign_columns(first, last, groups, max(self.snapshot_stride, len(self) // SHARED_COLUMN_FRAMES))

    def speeds(self, columns: NDArray[np.intp]) -> Floats:
        """Return the speeds at all moments [m/s], shape (moments, columns); NaN without a vehicle."""
        return self._make_table(dict(enumerate(self._speeds)), columns)

    def snapshots(self, name: str, columns: NDArray[np.intp]) -> Floats:
        """Return a quantity in all snapshots, shape (snapshots, columns, ...); NaN without a vehicle."""
        return self._make_table({moment: snapshot[name] for moment, snapshot in self._snapshots.items()}, columns)

    def _make_table(self, values_by_moment: dict[int, Any], columns: NDArray[np.intp]) -> Floats:
        shape = next((np.shape(values)[1:] for values in values_by_moment.values()), ())
        table = np.full((len(values_by_moment), int(columns.max(initial=-1)) + 1, *shape), np.nan)
        for row, (moment, values) in enumerate(values_by_moment.items()):
            table[row, columns[self._indices_by_moment[moment]]] = values
        return table


class TripLog:
    """The CAVs on the road at each moment, their states, and their commands in the next control step."""

    def __init__(self) -> None:
        self.cav_ids: list[Sequence[str]] = []
        self.states: list[LocalState] = []
        self.applied_accelerations: list[list[float]] = []
        self.filter_brakings: list[list[float]] = []
        """reductions of accelerations by the safety filter"""
        self.shield_brakings: list[list[float]] = []
        """braking that SUMO added; this list and the two above have one entry per control step [m/s2]"""

    def trajectories(
        self, driver_log: DriverLog, has_crashed: bool, on_progress: Callable[[], object]
    ) -> tuple[Trajectory, ...]:
        """Return the trips that last at least one control step, in order of entry; call `on_progress` regularly."""
        trips = list[tuple[str, list[tuple[int, int]]]]()
        """vehicle, and its (moment, row) pairs; a teleported vehicle that is reinserted starts another trip"""
        latest_trips = dict[str, list[tuple[int, int]]]()
        for moment, cav_ids in enumerate(self.cav_ids):
            for row, cav_id in enumerate(cav_ids):
                if cav_id not in latest_trips or latest_trips[cav_id][-1][0] < moment - 1:
                    latest_trips[cav_id] = list[tuple[int, int]]()
                    trips.append((cav_id, latest_trips[cav_id]))
                latest_trips[cav_id].append((moment, row))
        states, trajectories = list(zip(*self.states, strict=True)), list[Trajectory]()
        commands = self.applied_accelerations, self.filter_brakings, self.shield_brakings
        for trip_index, (cav_id, entries) in enumerate(trips):
            if trip_index % TRIPS_PER_PROGRESS == 0:
                on_progress()
            if len(entries) > 1:
                start, rows = entries[0][0], np.array([row for _, row in entries])
                state = LocalState(*(_trip_values(values, entries) for values in states))
                values = (_trip_values(command, entries[:-1]) for command in commands)
                terminated = has_crashed and entries[-1][0] == len(self.applied_accelerations)
                trip = cav_id, trip_index, start, rows, state
                trajectories.append(make_trajectory(*trip, *values, terminated=terminated, driver_log=driver_log))
        return tuple(trajectories)


def _trip_values(values: Sequence[Any], entries: Sequence[tuple[int, int]]) -> Any:
    """Return one quantity of a CAV at its (moment, row) pairs; None if the road does not provide the quantity."""
    return None if values[0] is None else np.array([values[moment][row] for moment, row in entries])


class OpenRoadLog:
    """Speeds, snapshots, CAV trips, braking, backlog and fuel of an episode on a road with ends."""

    def __init__(self, scenario: Scenario, names: Sequence[str], speeds: Floats) -> None:
        self.traffic, self.trips = TrafficLog(), TripLog()
        self.backlog: list[int] = []
        self.fuel: list[float] = []
        """total fuel rate of the vehicles [mg/s]"""
        self._scenario, self._braking = scenario, audit.BrakingLog(scenario.simulation_step)
        self._names, self._speeds = list(names), speeds
        self._cav_ids: Sequence[str] = ()
        self._kinds = np.zeros(len(names), np.uint8)

    def add_step(self, names: Sequence[str], speeds: Floats, cav_ids: Sequence[str]) -> None:
        """Add the speeds of all vehicles after a simulation step [m/s]; `cav_ids` are the CAVs with a driver."""
        last_speeds, has_same_vehicles = self._speeds, names == self._names
        if not has_same_vehicles:  # rarely
            speed_by_vehicle = dict(zip(self._names, last_speeds.tolist(), strict=True))
            last_speeds = np.array(list(map(speed_by_vehicle.get, names, speeds.tolist())), np.float64)
        if not has_same_vehicles or cav_ids is not self._cav_ids:
            self._kinds = np.array(list(map(set(cav_ids).__contains__, names)), np.uint8)
            self._names, self._cav_ids = list(names), cav_ids
        self._braking.add(speeds - last_speeds, self._driver_kinds())
        self._speeds = speeds

    def _driver_kinds(self) -> NDArray[np.uint8]:
        return self._kinds

    def episode_fields(
        self,
        trajectories: Sequence[Trajectory],
        branches: Sequence[str],
        teleported: Sequence[str],
        groups: Sequence[Hashable],
    ) -> tuple[NDArray[np.intp], dict[str, Any]]:
        """Return the column of each vehicle, and the fields of the record by name.

        `branches` are the origins of the vehicles, empty if unknown. Only vehicles of the same branch and group share
        columns.
        """
        vehicles, cavs = self.traffic.vehicle_ids, dict.fromkeys(trajectory.vehicle for trajectory in trajectories)
        columns = self.traffic.columns([*zip((name in cavs for name in vehicles), branches, groups, strict=True)])
        branch_of_column = dict(zip(columns.tolist(), branches, strict=True))
        is_shared = len(branch_of_column) < len(vehicles)
        return columns, {
            "vehicle_ids": vehicles,
            "cav_ids": tuple(cavs),
            "vehicle_columns": tuple(columns.tolist()) if is_shared else (),
            "branches": tuple(branch for _, branch in sorted(branch_of_column.items())) if any(branches) else (),
            "speeds": self.traffic.speeds(columns),
            "snapshot_stride": self.traffic.snapshot_stride,
            "backlog": np.array(self.backlog, np.float64),
            "teleported": len(set(teleported).intersection(vehicles)),
            "trajectories": trajectories,
            "audit": self.make_audit(trajectories),
        }

    def make_audit(self, trajectories: Sequence[Trajectory]) -> audit.Audit:
        """Return the braking in every simulation step, and the CAVs' car following in every control step."""
        moments = max((len(trajectory.states.speed) for trajectory in trajectories), default=0)
        speed, leader_speed, gap = np.full((3, moments, len(trajectories)), np.nan)
        for column, trajectory in enumerate(trajectories):
            states, rows = trajectory.states, slice(len(trajectory.states.speed))
            speed[rows, column], leader_speed[rows, column] = states.speed, states.leader_speed
            gap[rows, column] = states.leader_gap
        added_braking = np.concatenate([np.zeros(0), *(trajectory.shield_braking for trajectory in trajectories)])
        is_overridden, step = added_braking > audit.OVERRIDE_TOLERANCE, self._scenario.control_step
        is_yielding = np.zeros_like(added_braking)
        following = audit.following_statistics(speed, leader_speed, gap, step, is_overridden, is_yielding)
        human, cav = map(self._braking.statistics, (audit.HUMAN_DRIVER, audit.CAV_DRIVER))
        return audit.Audit(human, cav, following, self._scenario.safety.time_gap)


class MultiLaneLog(OpenRoadLog):
    """The log of a road with lanes: braking after cut-ins counts separately, and time gaps count after recovery."""

    def __init__(
        self,
        scenario: Scenario,
        names: Sequence[str],
        speeds: Floats,
        tracked_leaders: Callable[[Sequence[str]], list[TrackedLeader]],
    ) -> None:
        super().__init__(scenario, names, speeds)
        self._tracked_leaders = tracked_leaders
        self._following: dict[str, tuple[str, int, bool, FollowingState]] = {}
        """for each CAV: its leader, first step behind the leader, whether it recovers from the change, and state"""
        self._steady_following = array("d")
        """speed, leader speed, gap and recovery of CAVs that have followed the same leader for long enough"""
        self._step_count = 0

    def _driver_kinds(self) -> NDArray[np.uint8]:
        self._step_count += 1
        kinds, rows = self._kinds.copy(), {vehicle_id: row for row, vehicle_id in enumerate(self._names)}
        cav_ids = [cav_id for cav_id in self._cav_ids if cav_id in rows]
        tracked_leaders = self._tracked_leaders(cav_ids) if cav_ids else ()
        for cav_id, (leader, current) in zip(cav_ids, tracked_leaders, strict=True):
            last_leader, first_step, was_recovering, previous = self._following.get(cav_id, (None, 0, False, current))
            first_step = first_step if leader == last_leader else self._step_count
            time_behind_leader = (self._step_count - first_step) * self._scenario.simulation_step
            if time_behind_leader < audit.CUT_IN_SECONDS:
                kinds[rows[cav_id]] = audit.CAV_AFTER_CUT_IN
            recovers = bool(leader) and audit.is_recovering(was_recovering, time_behind_leader, previous, current)
            self._following[cav_id] = leader, first_step, recovers, current
            if leader and time_behind_leader > audit.STEADY_FOLLOWING_SECONDS:
                self._steady_following.extend((*current, recovers))
        return kinds

    def make_audit(self, trajectories: Sequence[Trajectory]) -> audit.Audit:
        """Return the audit of every simulation step; overrides and jerk are those of control steps."""
        speed, leader_speed, gap, recovers = np.array(self._steady_following, np.float64).reshape(-1, 4).T[:, None]
        step, common = self._scenario.simulation_step, super().make_audit(trajectories)
        steady = audit.following_statistics(speed, leader_speed, gap, step, in_recovery=recovers)
        commands = {name: getattr(common.following, name) for name in ("max_jerk", "override_share", "yield_share")}
        return replace(
            common,
            following=replace(steady, **commands),
            required_time_gap=audit.SHORT_TIME_GAP,
            has_lanes=True,
            cut_in_braking=self._braking.statistics(audit.CAV_AFTER_CUT_IN),
        )
