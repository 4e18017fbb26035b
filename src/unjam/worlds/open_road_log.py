"""The log of an episode on a road with ends, and the fields of the record made from it.

Each of thousands of vehicles is on the road for a small part of the time: in large tables, those of different times
share a column.
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
"""total number of vehicles in all snapshots: beyond it, only every second moment is kept, then every fourth, ..."""
MAX_UNSHARED_CELLS = 2_000_000
"""cells of a table with one column per vehicle; in larger tables columns are shared"""

TrackedLeader = tuple[str, FollowingState]
"""the leader of a CAV, empty without a leader within range, and the state of the CAV behind it"""


class TrafficLog:
    """The vehicles on the road at each moment with their speeds, and snapshots at some moments."""

    def __init__(self) -> None:
        self.names: list[str] = []
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
        """All vehicles, in order of entry."""
        return tuple(self._vehicle_indices)

    def add(self, names: Sequence[str], speeds: Any) -> None:
        """Add a moment: the vehicles on the road, and their speeds [m/s]."""
        if names != self.names:  # rarely: otherwise both moments share an array
            self.names = list(names)
            for name in names:
                self._vehicle_indices.setdefault(name, len(self._vehicle_indices))
            self._current_indices = np.array(list(map(self._vehicle_indices.__getitem__, names)), np.int32)
        self._indices_by_moment.append(self._current_indices)
        self._speeds.append(np.array(speeds, np.float64))

    @property
    def needs_snapshot(self) -> bool:
        """Whether the last moment needs a snapshot."""
        return (len(self) - 1) % self.snapshot_stride == 0

    def add_snapshot(self, quantities: dict[str, Any]) -> None:
        """Add the snapshot of the last moment: quantities by name, each with values in the order of `names`."""
        self._snapshots[len(self) - 1] = quantities
        self._snapshot_vehicle_count += len(self.names)
        while self._snapshot_vehicle_count > MAX_SNAPSHOT_VEHICLES and len(self._snapshots) > 2:
            self.snapshot_stride *= 2
            self._snapshots = {
                time: snapshot for time, snapshot in self._snapshots.items() if time % self.snapshot_stride == 0
            }
            self._snapshot_vehicle_count = sum(len(self._indices_by_moment[time]) for time in self._snapshots)

    def columns(self, groups: Sequence[Hashable]) -> NDArray[np.intp]:
        """Return a column for each vehicle, given the groups of vehicles that may share columns, in order of entry."""
        if len(self) * len(groups) <= MAX_UNSHARED_CELLS:
            return np.arange(len(groups))
        first, last = np.full(len(groups), len(self)), np.zeros(len(groups), int)
        for time, row in enumerate(self._indices_by_moment):
            first[row], last[row] = np.minimum(first[row], time), time
        return assign_columns(first, last, groups, max(self.snapshot_stride, len(self) // SHARED_COLUMN_FRAMES))

    def speeds(self, columns: NDArray[np.intp]) -> Floats:
        """Return all speeds [m/s], shape (moments, columns); NaN without a vehicle."""
        return self._table(dict(enumerate(self._speeds)), columns)

    def snapshots(self, name: str, columns: NDArray[np.intp]) -> Floats:
        """Return a quantity of all snapshots, shape (snapshots, columns, ...); NaN without a vehicle."""
        return self._table({time: snapshot[name] for time, snapshot in self._snapshots.items()}, columns)

    def _table(self, values_by_moment: dict[int, Any], columns: NDArray[np.intp]) -> Floats:
        shape = next((np.shape(values)[1:] for values in values_by_moment.values()), ())
        table = np.full((len(values_by_moment), int(columns.max(initial=-1)) + 1, *shape), np.nan)
        for row, (time, values) in enumerate(values_by_moment.items()):
            table[row, columns[self._indices_by_moment[time]]] = values
        return table


class TripLog:
    """The CAVs on the road at each moment, their states, and their commands in the control step that follows."""

    def __init__(self) -> None:
        self.cav_ids: list[Sequence[str]] = []
        self.states: list[LocalState] = []
        self.applied_accelerations: list[list[float]] = []
        self.filter_brakings: list[list[float]] = []
        """reductions by the safety filter"""
        self.shield_brakings: list[list[float]] = []
        """braking that SUMO added; these three lists [m/s2] have one entry per control step"""

    def trajectories(
        self, driver_log: DriverLog, has_crashed: bool, on_progress: Callable[[], object]
    ) -> tuple[Trajectory, ...]:
        """Return the trips of at least one control step, in order of entry, after an episode that may have crashed."""
        trips = list[tuple[str, list[tuple[int, int]]]]()
        """vehicle, and its moments and rows; a teleported vehicle that is reinserted starts another trip"""
        latest = dict[str, list[tuple[int, int]]]()
        for time, names in enumerate(self.cav_ids):
            for row, name in enumerate(names):
                if name not in latest or latest[name][-1][0] < time - 1:
                    latest[name] = list[tuple[int, int]]()
                    trips.append((name, latest[name]))
                latest[name].append((time, row))
        states, trajectories = list(zip(*self.states, strict=True)), list[Trajectory]()
        commands = self.applied_accelerations, self.filter_brakings, self.shield_brakings
        for number, (name, entries) in enumerate(trips):
            if number % TRIPS_PER_PROGRESS == 0:
                on_progress()
            if len(entries) > 1:
                start, rows = entries[0][0], np.array([row for _, row in entries])
                state = LocalState(*(_trip_values(values, entries) for values in states))
                values = (_trip_values(command, entries[:-1]) for command in commands)
                terminated = has_crashed and entries[-1][0] == len(self.applied_accelerations)
                trip = name, number, start, rows, state
                trajectories.append(make_trajectory(*trip, *values, terminated=terminated, driver_log=driver_log))
        return tuple(trajectories)


def _trip_values(values: Sequence[Any], entries: Sequence[tuple[int, int]]) -> Any:
    """Return a CAV's values of one quantity at its moments and rows; None if the road does not provide it."""
    return None if values[0] is None else np.array([values[time][row] for time, row in entries])


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
        """Add the speeds of all vehicles after a simulation step [m/s]; `cav_ids` are those of the driver."""
        last, is_same = self._speeds, names == self._names
        if not is_same:  # in few steps, so that the others are fast
            previous = dict(zip(self._names, last.tolist(), strict=True))
            last = np.array(list(map(previous.get, names, speeds.tolist())), np.float64)
        if not is_same or cav_ids is not self._cav_ids:
            self._kinds = np.array(list(map(set(cav_ids).__contains__, names)), np.uint8)
            self._names, self._cav_ids = list(names), cav_ids
        self._braking.add(speeds - last, self._driver_kinds())
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
        """Return the column of each vehicle, and the fields of the record; empty `branches`: unknown origins.

        Only vehicles of one branch and group share columns.
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
        speed, leader, gap = np.full((3, moments, len(trajectories)), np.nan)
        for column, each in enumerate(trajectories):
            rows = slice(len(each.states.speed))
            speed[rows, column] = each.states.speed
            leader[rows, column], gap[rows, column] = each.states.leader_speed, each.states.leader_gap
        added = np.concatenate([np.zeros(0), *(trajectory.shield_braking for trajectory in trajectories)])
        is_overridden, step = added > audit.OVERRIDE_TOLERANCE, self._scenario.control_step
        following = audit.following_statistics(speed, leader, gap, step, is_overridden, np.zeros_like(added))
        human, cav = map(self._braking.statistics, (audit.HUMAN_DRIVER, audit.CAV_DRIVER))
        return audit.Audit(human, cav, following, self._scenario.safety.time_gap)


class MultiLaneLog(OpenRoadLog):
    """The log on a road with lanes: braking after cut-ins counts separately, time gaps not until recovery."""

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
        """state of each CAV: leader, its first step, whether the CAV recovers from the change of leader, last state"""
        self._steady_following = array("d")
        """steps of CAVs long behind the same leader: speed, leader speed, gap, and recovery"""
        self._step_count = 0

    def _driver_kinds(self) -> NDArray[np.uint8]:
        self._step_count += 1
        kinds, rows = self._kinds.copy(), {name: row for row, name in enumerate(self._names)}
        names = [name for name in self._cav_ids if name in rows]
        for name, (leader, current) in zip(names, self._tracked_leaders(names) if names else (), strict=True):
            last_leader, since, was_recovering, previous = self._following.get(name, (None, 0, False, current))
            since = since if leader == last_leader else self._step_count
            time_behind_leader = (self._step_count - since) * self._scenario.simulation_step
            if time_behind_leader < audit.CUT_IN_SECONDS:
                kinds[rows[name]] = audit.CAV_AFTER_CUT_IN
            recovers = bool(leader) and audit.is_recovering(was_recovering, time_behind_leader, previous, current)
            self._following[name] = leader, since, recovers, current
            if leader and time_behind_leader > audit.STEADY_FOLLOWING_SECONDS:
                self._steady_following.extend((*current, recovers))
        return kinds

    def make_audit(self, trajectories: Sequence[Trajectory]) -> audit.Audit:
        """Return the audit of every simulation step; overrides and jerk of every control step."""
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
