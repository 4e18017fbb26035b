"""The record of W motorways of a batch, which has the same fields as that of roads with ends in SUMO."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.worlds import audit, record
from unjam.worlds.batch.motorway.vehicles import KEYS_PER_ROAD, MotorwayVehicles
from unjam.worlds.world import DriverLog

Integers = NDArray[np.intp]
NO_END_STEP = int(np.iinfo(np.intp).max)
"""end step of a road without a collision"""
_DRIVER_KINDS = (audit.HUMAN_DRIVER, audit.CAV_DRIVER, audit.CAV_AFTER_CUT_IN)


class _Placements(NamedTuple):
    """Places of vehicles after control steps, in SI units; arrays of shape (n,)."""

    step_index: Integers
    """number of earlier control steps"""
    road: Integers
    entry: Integers
    """index of the vehicle in the entries of its road"""
    lane: Integers
    position: Floats
    speed: Floats
    gap: Floats
    """gap to the vehicle ahead [m]; NaN without one"""


class MotorwayLog:
    """All control steps of W motorways, with the braking and car following of every simulation step."""

    def __init__(self, roads: Sequence[MotorwayRoad], scenario: Motorway) -> None:
        self._roads, self._scenario = roads, scenario
        self.end_steps = np.full(len(roads), NO_END_STEP)
        """number of control steps until vehicles touched on each road, or `NO_END_STEP`"""
        self._placements, self.states = list[_Placements](), list[LocalState]()
        self.backlogs, self._cav_keys = list[Integers](), list[Integers]()
        self._arrivals, self._braking = np.zeros(len(roads), np.intp), audit.BrakingLog(1.0)
        shape = len(roads), max(len(road.entries) for road in roads)
        self._leader, self._leader_since = np.full((2, *shape), -1)
        self._step_count, self._steady_following = 0, list[Floats]()
        self._is_recovering = np.zeros(shape, bool)
        self._following_pairs = np.zeros((len(FollowingState._fields), *shape))
        """state of each CAV and its leader in the last step, by the fields of `FollowingState`"""

    def record_step(
        self, vehicles: MotorwayVehicles, leader_rows: Integers, arrived: MotorwayVehicles, cav_rows: Integers
    ) -> None:
        """Record the braking of all vehicles in a simulation step, and the car following of controlled CAVs."""
        self._step_count += 1
        is_running = self.end_steps == NO_END_STEP
        self._arrivals += np.bincount(arrived.road, minlength=len(self._roads)) * is_running
        road, entry = vehicles.road, vehicles.entry
        cavs, leader = (road[cav_rows], entry[cav_rows]), leader_rows[cav_rows]
        leader_entry = np.where(leader >= 0, entry[leader], -1)
        is_new = self._leader[cavs] != leader_entry
        self._leader[cavs] = leader_entry
        self._leader_since[cavs] = np.where(is_new, self._step_count, self._leader_since[cavs])
        duration = (self._step_count - self._leader_since[cavs]) * self._scenario.simulation_step
        kind = np.full(len(road), audit.HUMAN_DRIVER)
        kind[cav_rows] = np.where(duration < audit.CUT_IN_SECONDS, audit.CAV_AFTER_CUT_IN, audit.CAV_DRIVER)
        is_steady = (leader >= 0) & (duration > audit.STEADY_FOLLOWING_SECONDS) & is_running[cavs[0]]
        gap = vehicles.position[leader] - self._roads[0].geometry.vehicle_length - vehicles.position[cav_rows]
        pair = FollowingState(vehicles.speed[cav_rows], vehicles.speed[leader], gap)
        previous = FollowingState(*self._following_pairs[:, *cavs])
        recovers = audit.is_recovering(self._is_recovering[cavs], duration, previous, pair) & (leader >= 0)
        self._is_recovering[cavs], self._following_pairs[:, *cavs] = recovers, pair
        columns = cavs[0], *pair, recovers
        self._steady_following.append(np.stack([column[is_steady].astype(np.float64) for column in columns]))
        is_counted = is_running[road]
        kind_of_road = (road * len(_DRIVER_KINDS) + kind)[is_counted].astype(np.uint16)
        self._braking.add(vehicles.acceleration[is_counted], kind_of_road)

    def record_control_step(
        self, vehicles: MotorwayVehicles, gaps: Floats, backlog: Integers, cav_keys: Integers, states: LocalState
    ) -> None:
        """Record the places of all vehicles after a control step, and the states that the CAVs observe."""
        step_index = np.full(len(gaps), len(self._placements))
        self._placements.append(_Placements(step_index, *vehicles[:5], gaps))
        self.backlogs.append(backlog)
        self._cav_keys.append(cav_keys)
        self.states.append(states)

    def make_episodes(self, driver_log: DriverLog, seeds: Sequence[Sequence[int]]) -> tuple[record.Episode, ...]:
        """Return the record of each road."""
        trips = self._make_trips(driver_log)
        steady = np.concatenate(self._steady_following, 1) if self._steady_following else np.zeros((5, 0))
        backlogs = np.stack(self.backlogs, 1).astype(np.float64)
        placements = _Placements(*(np.concatenate(values) for values in zip(*self._placements, strict=True)))
        order = np.argsort(placements.road, kind="stable")
        starts = np.searchsorted(placements.road[order], np.arange(len(self._roads) + 1))
        episodes = []
        for index, (start, end) in enumerate(pairwise(starts)):
            rows = order[start:end]
            rows = rows[placements.step_index[rows] <= self.end_steps[index]]
            on_road = _Placements(*(values[rows] for values in placements))  # pyright: ignore[reportCallIssue, reportArgumentType]
            pairs = steady[1:, steady[0] == index]
            episodes.append(self._make_episode(index, seeds[index], on_road, trips[index], backlogs[index], pairs))
        return tuple(episodes)

    def _make_trips(self, driver_log: DriverLog) -> list[list[record.Trajectory]]:
        """Return the trips of CAVs on each road with at least one control step, in order of entry."""
        counts = list(map(len, self._cav_keys))
        step_index = np.repeat(np.arange(len(counts)), counts)
        row = np.concatenate([np.arange(count) for count in counts])
        keys = np.concatenate(self._cav_keys)
        order = np.argsort(keys, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1) if len(order) else []
        first, *others = self.states
        states = first.map(lambda *values: np.concatenate(values), *others)
        trips: list[list[record.Trajectory]] = [[] for _ in self._roads]
        for entry_number, rows in enumerate(sorted(groups, key=lambda group: group[0])):
            road, entry = divmod(int(keys[rows[0]]), KEYS_PER_ROAD)
            end = self.end_steps[road]
            rows = rows[step_index[rows] <= end]
            if len(rows) < 2:
                continue
            state, zeros = states.select(rows), np.zeros(len(rows) - 1)
            vehicle_id, start = self._roads[road].entries[entry].name, int(step_index[rows[0]])
            applied = np.diff(state.speed) / self._scenario.control_step
            trip = vehicle_id, entry_number, start, row[rows], state, applied, zeros, zeros
            terminated = bool(step_index[rows[-1]] == end)
            trips[road].append(record.make_trajectory(*trip, terminated=terminated, driver_log=driver_log))
        return trips

    def _make_episode(
        self,
        road_index: int,
        seed: Sequence[int],
        placements: _Placements,
        trips: list[record.Trajectory],
        backlog: Floats,
        steady_following: Floats,
    ) -> record.Episode:
        road, steps = self._roads[road_index], placements.step_index
        geometry = road.geometry
        moments = min(len(backlog), int(self.end_steps[road_index]) + 1)
        has_crashed = self.end_steps[road_index] < len(backlog)
        entry_indices, first_rows, inverse = np.unique(placements.entry, return_index=True, return_inverse=True)
        order = np.argsort(first_rows, kind="stable")
        vehicle = np.argsort(order)[inverse]  # vehicles in order of appearance
        first_steps, last_steps = steps[first_rows[order]], np.zeros(len(order), np.intp)
        np.maximum.at(last_steps, vehicle, steps)
        cav_ids = dict.fromkeys(trip.vehicle for trip in trips)
        entries = [road.entries[index] for index in entry_indices[order].tolist()]
        groups = [(entry.name in cav_ids, entry.route) for entry in entries]
        min_spacing = max(1, moments // record.SHARED_COLUMN_FRAMES)
        columns = record.assign_columns(first_steps, last_steps, groups, min_spacing)
        branches = dict(zip(columns.tolist(), [entry.route for entry in entries], strict=True))

        def make_table(values: Floats) -> Floats:
            table = np.full((moments, len(branches)), np.nan)
            table[steps, columns[vehicle]] = values
            return table

        return record.Episode(
            **record.common_fields(self._scenario, road, seed, bool(has_crashed)),
            collisions=2 * int(has_crashed),
            vehicle_ids=tuple(entry.name for entry in entries),
            cav_ids=tuple(cav_ids),
            vehicle_columns=tuple(columns.tolist()),
            branches=tuple(branches[column] for column in sorted(branches)),
            speeds=make_table(placements.speed),
            positions=make_table(placements.position - geometry.origin),
            gaps=make_table(placements.gap),
            lane_indices=make_table(geometry.lane_count - placements.lane.astype(np.float64)),
            lane_names=geometry.lane_names[::-1],
            arrivals=int(self._arrivals[road_index]),
            backlog=backlog[:moments],
            planned_duration=self._scenario.horizon * self._scenario.control_step,
            demand_peak=road.peak,
            free_flow_time=road.free_flow_time,
            trajectories=tuple(trips),
            audit=self._make_audit(road_index, trips, steady_following),
        )

    def _make_audit(self, road_index: int, trips: list[record.Trajectory], steady_following: Floats) -> audit.Audit:
        first = road_index * len(_DRIVER_KINDS)
        humans, cavs, cut_ins = (self._braking.statistics(first + kind) for kind in _DRIVER_KINDS)
        jerks = [np.abs(np.diff(trip.states.speed, 2)).max(initial=0.0) for trip in trips]
        speed, leader_speed, gap, in_recovery = steady_following[:, None]
        step, control_step = self._scenario.simulation_step, self._scenario.control_step
        following = audit.following_statistics(speed, leader_speed, gap, step, in_recovery=in_recovery)
        following = replace(following, max_jerk=float(max(jerks, default=0.0) / control_step**2))
        return audit.Audit(humans, cavs, following, audit.SHORT_TIME_GAP, has_lanes=True, cut_in_braking=cut_ins)
