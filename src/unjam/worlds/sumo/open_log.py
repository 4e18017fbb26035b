"""The log of an episode on a road with ends, and the fields of the record made from it."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.scenarios.scenario import Scenario
from unjam.worlds import audit
from unjam.worlds.record import Floats, Trajectory, make_trajectory
from unjam.worlds.sumo.traffic_log import TrafficLog
from unjam.worlds.world import DriverLog

TRIPS_PER_PROGRESS = 500


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
                values = (_trip_values(each, entries[:-1]) for each in commands)
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
        """Start with the vehicles on the road now, and their speeds [m/s]."""
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
            before = dict(zip(self._names, last.tolist(), strict=True))
            last = np.array(list(map(before.get, names, speeds.tolist())), np.float64)
        if not is_same or cav_ids is not self._cav_ids:
            self._kinds = np.array(list(map(set(cav_ids).__contains__, names)), np.uint8)
            self._names, self._cav_ids = list(names), cav_ids
        self._braking.add(speeds - last, self._driver_kinds())
        self._speeds = speeds

    def _driver_kinds(self) -> NDArray[np.uint8]:
        return self._kinds

    def episode_fields(
        self, trajectories: Sequence[Trajectory], branches: Sequence[str], teleported: Sequence[str]
    ) -> tuple[NDArray[np.intp], dict[str, Any]]:
        """Return the column of each vehicle, and the fields of the record.

        `branches` are the vehicles' origins, empty if unknown, `teleported` those not reinserted at the end.
        """
        vehicles, cavs = self.traffic.vehicle_ids, dict.fromkeys(each.vehicle for each in trajectories)
        groups = [(name in cavs, branch) for name, branch in zip(vehicles, branches, strict=True)]
        columns = self.traffic.columns(groups)
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
        moments = max((len(each.states.speed) for each in trajectories), default=0)
        speed, leader, gap = np.full((3, moments, len(trajectories)), np.nan)
        for column, each in enumerate(trajectories):
            rows = slice(len(each.states.speed))
            speed[rows, column] = each.states.speed
            leader[rows, column], gap[rows, column] = each.states.leader_speed, each.states.leader_gap
        added = np.concatenate([np.zeros(0), *(each.shield_braking for each in trajectories)])
        is_overridden, step = added > audit.OVERRIDE_TOLERANCE, self._scenario.control_step
        following = audit.following_statistics(speed, leader, gap, step, is_overridden, np.zeros_like(added))
        human, cav = map(self._braking.statistics, (audit.HUMAN_DRIVER, audit.CAV_DRIVER))
        return audit.Audit(human, cav, following, self._scenario.safety.time_gap)
