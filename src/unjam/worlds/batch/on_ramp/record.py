"""The record of W motorways of a batch, as that of SUMO's roads with ends."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Floats
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds import audit
from unjam.worlds.batch.on_ramp.vehicles import MotorwayVehicles
from unjam.worlds.record import SHARED_COLUMN_FRAMES, Episode, Trajectory, assign_columns, make_trajectory
from unjam.worlds.world import DriverLog

Integers = NDArray[np.intp]
NO_END_STEP = int(np.iinfo(np.intp).max)
"""last control step of roads without a collision"""
_DRIVER_KINDS = (audit.HUMAN_DRIVER, audit.CAV_DRIVER, audit.CAV_AFTER_CUT_IN)


class _Placements(NamedTuple):
    """Positions of vehicles; arrays of shape (n,)."""

    step_index: Integers
    """number of control steps before"""
    road: Integers
    entry: Integers
    """index among the entries of the road"""
    lane: Integers
    position: Floats
    """[m]"""
    speed: Floats
    """[m/s]"""
    gap: Floats
    """to the vehicle ahead [m]; NaN without one"""


@dataclass
class MotorwayLog:
    """All control steps of W motorways, with the braking and car following of every simulation step."""

    roads: Sequence[MotorwayRoad]
    entry_count: int
    """maximum number of entries of a road"""
    simulation_step: float
    """[s]"""
    control_step: float
    """[s]"""
    planned_duration: float
    """[s]"""
    end_steps: Integers = field(init=False)
    """control step after which vehicles touched on each road, or `NO_END_STEP`"""

    def __post_init__(self) -> None:
        roads, kinds = len(self.roads), len(_DRIVER_KINDS)
        self.end_steps = np.full(roads, NO_END_STEP)
        self._placements, self._states = list[_Placements](), list[LocalState]()
        self._backlogs, self._cav_numbers, self._accelerations = list[Integers](), list[Integers](), list[Floats]()
        self._arrivals = np.zeros(roads, np.intp)
        self._max_braking, self._observed_steps = np.zeros((roads, kinds)), np.zeros((roads, kinds), np.intp)
        self._hard_braking_counts = np.zeros((roads, kinds, len(audit.BRAKING_THRESHOLDS)), np.intp)
        self._leader, self._leader_since = np.full((2, roads, self.entry_count), -1)
        self._step_count, self._steady_following = 0, list[Floats]()
        self._is_recovering = np.zeros((roads, self.entry_count), bool)
        """whether each CAV recovers from a change of leader"""
        self._following_pairs = np.zeros((len(audit.FollowingPair._fields), roads, self.entry_count))
        """each CAV and its leader in the last step, with the fields of `FollowingPair`"""

    def record_step(
        self, vehicles: MotorwayVehicles, leader_rows: Integers, arrived: MotorwayVehicles, cav_rows: Integers
    ) -> None:
        """Record the braking of all vehicles in a simulation step, and the car following of controlled CAVs."""
        self._step_count += 1
        is_running = self.end_steps == NO_END_STEP
        self._arrivals += np.bincount(arrived.road, minlength=len(self.roads)) * is_running
        road, entry = vehicles.road, vehicles.entry
        own, leader = (road[cav_rows], entry[cav_rows]), leader_rows[cav_rows]
        leader_entry = np.where(leader >= 0, entry[leader], -1)
        is_new = self._leader[own] != leader_entry
        self._leader[own] = leader_entry
        self._leader_since[own] = np.where(is_new, self._step_count, self._leader_since[own])
        duration = (self._step_count - self._leader_since[own]) * self.simulation_step
        kind = np.full(len(road), audit.HUMAN_DRIVER)
        kind[cav_rows] = np.where(duration < audit.CUT_IN_SECONDS, audit.CAV_AFTER_CUT_IN, audit.CAV_DRIVER)
        is_steady = (leader >= 0) & (duration > audit.STEADY_FOLLOWING_SECONDS) & is_running[own[0]]
        gap = vehicles.position[leader] - self.roads[0].vehicle_length - vehicles.position[cav_rows]
        pair = audit.FollowingPair(vehicles.speed[cav_rows], vehicles.speed[leader], gap)
        previous = audit.FollowingPair(*self._following_pairs[:, *own])
        recovers = audit.is_recovering(self._is_recovering[own], duration, previous, pair) & (leader >= 0)
        self._is_recovering[own], self._following_pairs[:, *own] = recovers, pair
        columns = own[0], *pair, recovers
        self._steady_following.append(np.stack([each[is_steady].astype(np.float64) for each in columns]))
        np.add.at(self._observed_steps, (road, kind), is_running[road])
        brakes = np.flatnonzero((vehicles.acceleration < 0.0) & is_running[road])
        braking = -vehicles.acceleration[brakes].astype(np.float64)
        np.maximum.at(self._max_braking, (road[brakes], kind[brakes]), braking)
        for number, threshold in enumerate(audit.BRAKING_THRESHOLDS):
            hard = brakes[braking > threshold + audit.BRAKING_TOLERANCE]
            np.add.at(self._hard_braking_counts[..., number], (road[hard], kind[hard]), 1)

    def record_control_step(
        self, vehicles: MotorwayVehicles, gaps: Floats, backlog: Integers, cav_numbers: Integers, states: LocalState
    ) -> None:
        """Record the positions of all vehicles after a control step, and what the CAVs observe."""
        step_index = np.full(len(gaps), len(self._placements))
        self._placements.append(_Placements(step_index, *vehicles[:5], gaps))
        self._backlogs.append(backlog)
        self._cav_numbers.append(cav_numbers)
        self._states.append(states)

    def record_accelerations(self, accelerations: Floats) -> None:
        """Record the accelerations in a control step of the CAVs before it [m/s2]."""
        self._accelerations.append(accelerations)

    def make_episodes(
        self, driver_log: DriverLog, seeds: Sequence[Sequence[int]], numbers_per_road: int
    ) -> tuple[Episode, ...]:
        """Return the record of each road; CAVs have the numbers `road * numbers_per_road + entry`."""
        trips = self._trips(driver_log, numbers_per_road)
        steady = np.concatenate(self._steady_following, 1) if self._steady_following else np.zeros((5, 0))
        backlogs = np.stack(self._backlogs, 1).astype(np.float64)
        every = _Placements(*(np.concatenate(values) for values in zip(*self._placements, strict=True)))
        order = np.argsort(every.road, kind="stable")
        starts = np.searchsorted(every.road[order], np.arange(len(self.roads) + 1))
        episodes = []
        for number, (start, end) in enumerate(pairwise(starts)):
            rows = order[start:end]
            rows = rows[every.step_index[rows] <= self.end_steps[number]]
            placements = _Placements(*(values[rows] for values in every))  # pyright: ignore[reportCallIssue, reportArgumentType]
            own_steady = steady[1:, steady[0] == number]
            episode = self._make_episode(number, placements, trips[number], backlogs[number], own_steady)
            episodes.append(replace(episode, seed=tuple(seeds[number])))
        return tuple(episodes)

    def _trips(self, driver_log: DriverLog, numbers_per_road: int) -> list[list[Trajectory]]:
        """Return the trips of the CAVs on each road that last at least one control step, in order of entry."""
        counts = [len(each) for each in self._cav_numbers]
        step_index = np.repeat(np.arange(len(counts)), counts)
        row = np.concatenate([np.arange(count) for count in counts])
        numbers = np.concatenate(self._cav_numbers)
        order = np.argsort(numbers, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1) if len(order) else []
        first, *others = self._states
        states = first.map(lambda *values: np.concatenate(values), *others)
        accelerations = np.concatenate([*self._accelerations, np.zeros(counts[-1])])  # none after the last state
        trips: list[list[Trajectory]] = [[] for _ in self.roads]
        for entry_number, rows in enumerate(sorted(groups, key=lambda group: group[0])):
            road, entry = divmod(int(numbers[rows[0]]), numbers_per_road)
            end = self.end_steps[road]
            rows = rows[step_index[rows] <= end]
            if len(rows) < 2:
                continue
            zeros = np.zeros(len(rows) - 1)
            trips[road].append(
                make_trajectory(
                    vehicle=self.roads[road].entries[entry].name,
                    entry_number=entry_number,
                    start_step=int(step_index[rows[0]]),
                    rows=row[rows],
                    states=states.select(rows),
                    applied_acceleration=accelerations[rows[:-1]],
                    filter_braking=zeros,
                    shield_braking=zeros,
                    terminated=bool(step_index[rows[-1]] == end),
                    driver_log=driver_log,
                )
            )
        return trips

    def _make_episode(
        self, road_index: int, placements: _Placements, trips: list[Trajectory], backlog: Floats, steady: Floats
    ) -> Episode:
        road, steps = self.roads[road_index], placements.step_index
        moments = min(len(backlog), int(self.end_steps[road_index]) + 1)
        has_crashed = self.end_steps[road_index] < len(backlog)
        numbers, first_rows, inverse = np.unique(placements.entry, return_index=True, return_inverse=True)
        order = np.argsort(first_rows, kind="stable")
        vehicle = np.argsort(order)[inverse]  # by first appearance
        first, last = np.full(len(order), moments), np.zeros(len(order), np.intp)
        np.minimum.at(first, vehicle, steps)
        np.maximum.at(last, vehicle, steps)
        cav_ids = dict.fromkeys(each.vehicle for each in trips)
        entries = [road.entries[number] for number in numbers[order].tolist()]
        groups = [(each.name in cav_ids, each.route) for each in entries]
        columns = assign_columns(first, last, groups, max(1, moments // SHARED_COLUMN_FRAMES))
        branches = dict(zip(columns.tolist(), [each.route for each in entries], strict=True))

        def as_table(values: Floats) -> Floats:
            table = np.full((moments, len(branches)), np.nan)
            table[steps, columns[vehicle]] = values
            return table

        return Episode(
            seed=(),
            status="collision" if has_crashed else "completed",
            collisions=2 * int(has_crashed),
            control_step=self.control_step,
            limit_speed=road.limit_speed,
            vehicle_ids=tuple(each.name for each in entries),
            cav_ids=tuple(cav_ids),
            vehicle_columns=tuple(columns.tolist()),
            branches=tuple(branches[column] for column in sorted(branches)),
            speeds=as_table(placements.speed),
            positions=as_table(placements.position - road.merge_position),
            gaps=as_table(placements.gap),
            lane_indices=as_table(len(road.lane_names) - 1.0 - placements.lane.astype(np.float64)),
            lane_names=road.lane_names[::-1],
            arrivals=int(self._arrivals[road_index]),
            backlog=backlog[:moments],
            planned_duration=self.planned_duration,
            demand_peak=road.peak,
            free_flow_time=road.free_flow_time,
            trajectories=tuple(trips),
            audit=self._audit(road_index, trips, steady),
        )

    def _audit(self, road_index: int, trips: list[Trajectory], steady_following: Floats) -> audit.Audit:
        humans, cavs, cut_ins = (
            audit.BrakingStatistics(
                float(self._max_braking[road_index, kind]),
                tuple(map(int, self._hard_braking_counts[road_index, kind])),
                int(self._observed_steps[road_index, kind]),
            )
            for kind in _DRIVER_KINDS
        )
        jerks = [np.abs(np.diff(each.states.speed, 2)).max(initial=0.0) for each in trips]
        speed, leader_speed, gap, in_recovery = steady_following[:, None]
        following = audit.following_statistics(speed, leader_speed, gap, self.simulation_step, in_recovery=in_recovery)
        following = replace(following, max_jerk=float(max(jerks, default=0.0) / self.control_step**2))
        return audit.Audit(humans, cavs, following, audit.SHORT_TIME_GAP, has_lanes=True, cut_in_braking=cut_ins)
