"""The log of an episode on a road with ends, and the fields of the record made from it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.scenarios.scenario import Scenario
from unjam.worlds.audit import (
    CAV_DRIVER,
    HUMAN_DRIVER,
    OVERRIDE_TOLERANCE,
    Audit,
    BrakingLog,
    FollowingStatistics,
    following_statistics,
)
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.traffic_log import TrafficLog
from unjam.worlds.sumo.trip_log import TripLog


class OpenRoadLog:
    """Speeds, snapshots, CAV trips, braking, backlog and fuel of an episode on a road with ends."""

    def __init__(self, scenario: Scenario, names: Sequence[str], speeds: Floats) -> None:
        """Start with the vehicles on the road now, and their speeds [m/s]."""
        self.traffic, self.trips = TrafficLog(), TripLog()
        self.backlog: list[int] = []
        """of each moment"""
        self.fuel: list[float] = []
        """total fuel rate of the vehicles [mg/s]"""
        self._scenario, self._braking = scenario, BrakingLog(scenario.simulation_step)
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
        """Return the driver kinds of the vehicles in the last step."""
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
            "audit": self.audit(trajectories),
        }

    def audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the braking in every simulation step, and the CAVs' car following in every control step."""
        human, cav = self._braking.statistics(HUMAN_DRIVER), self._braking.statistics(CAV_DRIVER)
        return Audit(human, cav, self._following_statistics(trajectories), self._scenario.safety.time_gap)

    def _following_statistics(self, trajectories: Sequence[Trajectory]) -> FollowingStatistics:
        """Return the CAVs' car following and overrides in every control step."""
        moments = max((len(each.states.speed) for each in trajectories), default=0)
        speed, leader, gap = np.full((3, moments, len(trajectories)), np.nan)
        for column, each in enumerate(trajectories):
            rows = slice(len(each.states.speed))
            speed[rows, column] = each.states.speed
            leader[rows, column], gap[rows, column] = each.states.leader_speed, each.states.leader_gap
        step = self._scenario.control_step
        added = np.concatenate([each.shield_braking for each in trajectories]) if trajectories else np.zeros(0)
        return following_statistics(speed, leader, gap, step, added > OVERRIDE_TOLERANCE, np.zeros_like(added))
