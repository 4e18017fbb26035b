"""What happened on W motorways of a batch: the record of each, as SUMO's roads with ends have it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Floats
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.audit import (
    BRAKING_THRESHOLDS,
    BRAKING_TOLERANCE,
    CAV_AFTER_CUT_IN,
    CAV_DRIVER,
    CUT_IN_SECONDS,
    HUMAN_DRIVER,
    SHORT_TIME_GAP,
    STEADY_FOLLOWING_SECONDS,
    Audit,
    BrakingStatistics,
    FollowingPair,
    following_statistics,
    is_recovering,
)
from unjam.worlds.batch.on_ramp.vehicles import MotorwayVehicles
from unjam.worlds.record import SHARED_COLUMN_FRAMES, Episode, Trajectory, assign_columns, make_trajectory
from unjam.worlds.world import DriverLog

NO_END_STEP = int(np.iinfo(np.intp).max)
"""the decision after which a road ends on which nobody has touched"""


class _Placements(NamedTuple):
    """Where vehicles are; arrays of shape (n,)."""

    step_index: NDArray[np.intp]
    """after so many decisions"""
    road: NDArray[np.intp]
    entry: NDArray[np.intp]
    """which of those who want to enter the road"""
    lane: NDArray[np.intp]
    position: Floats
    """[m]"""
    speed: Floats
    """[m/s]"""
    gap: Floats
    """to the one ahead [m]; NaN where nobody is"""

    def select(self, rows: NDArray[np.intp]) -> "_Placements":
        """Return where some of them are."""
        whole = (self.step_index[rows], self.road[rows], self.entry[rows], self.lane[rows])
        return _Placements(*whole, self.position[rows], self.speed[rows], self.gap[rows])


@dataclass
class MotorwayLog:
    """All decisions of W motorways; braking and headways in every simulation step."""

    roads: Sequence[MotorwayRoad]
    entry_count: int
    simulation_step: float
    """of the simulation [s]"""
    control_step: float
    """[s]"""
    planned_duration: float
    """how long they are driven [s]"""
    end_steps: NDArray[np.intp] = field(init=False)
    """decision after which vehicles touched on each, or NEVER"""

    def __post_init__(self) -> None:
        """Begin with nothing."""
        roads, kinds = len(self.roads), 1 + max(HUMAN_DRIVER, CAV_DRIVER, CAV_AFTER_CUT_IN)
        self.end_steps = np.full(roads, NO_END_STEP)
        self._placements = list[_Placements]()
        self._backlogs = list[NDArray[np.intp]]()
        self._cav_numbers = list[NDArray[np.intp]]()
        self._states = list[LocalState]()
        self._accelerations = list[Floats]()
        self._arrivals = np.zeros(roads, np.intp)
        self._max_braking, self._observed_steps = np.zeros((roads, kinds)), np.zeros((roads, kinds), np.intp)
        self._hard_braking_counts = np.zeros((roads, kinds, len(BRAKING_THRESHOLDS)), np.intp)
        self._leader, self._leader_since = np.full((2, roads, self.entry_count), -1)
        self._step_count, self._steady_following = 0, list[Floats]()
        self._is_recovering = np.zeros((roads, self.entry_count), bool)
        """whether each vehicle, if it is a CAV, recovers from a change of leader"""
        self._following_pairs = np.zeros((len(FollowingPair._fields), roads, self.entry_count))
        """each of them and its leader in the last step, as `FollowingPair` has them"""

    def record_step(
        self,
        vehicles: MotorwayVehicles,
        leader_rows: NDArray[np.intp],
        arrived_vehicles: MotorwayVehicles,
        cav_rows: NDArray[np.intp],
        is_controlled: bool,
    ) -> None:
        """Note how all braked in a step, and how CAVs, the rows `cavs`, follow those `ahead` of each."""
        self._step_count += 1
        goes_on = self.end_steps == NO_END_STEP
        self._arrivals += np.bincount(arrived_vehicles.road, minlength=len(self.roads)) * goes_on
        road, entry = vehicles.road, vehicles.entry
        kind = np.full(len(road), HUMAN_DRIVER)
        if is_controlled:
            rows = cav_rows[cav_rows >= 0]
            kind[rows] = CAV_DRIVER
            leader = leader_rows[rows]
            now, own = np.where(leader >= 0, entry[leader], -1), (road[rows], entry[rows])
            changed = self._leader[own] != now
            self._leader[own] = now
            self._leader_since[own] = np.where(changed, self._step_count, self._leader_since[own])
            lasts = (self._step_count - self._leader_since[own]) * self.simulation_step
            kind[rows[lasts < CUT_IN_SECONDS]] = CAV_AFTER_CUT_IN
            follows = (leader >= 0) & (lasts > STEADY_FOLLOWING_SECONDS) & goes_on[road[rows]]
            gap = vehicles.position[leader] - self.roads[0].vehicle_length - vehicles.position[rows]
            pair = FollowingPair(vehicles.speed[rows], vehicles.speed[leader], gap)
            recovers = is_recovering(
                self._is_recovering[own], lasts, FollowingPair(*self._following_pairs[:, *own]), pair
            )
            self._is_recovering[own] = recovers = recovers & (leader >= 0)
            self._following_pairs[:, *own] = pair
            seen = road[rows], *pair, recovers
            self._steady_following.append(np.stack([each[follows].astype(np.float64) for each in seen]))
        np.add.at(self._observed_steps, (road, kind), goes_on[road])
        hard = np.flatnonzero((vehicles.acceleration < 0.0) & goes_on[road])
        braking = -vehicles.acceleration[hard].astype(np.float64)
        np.maximum.at(self._max_braking, (road[hard], kind[hard]), braking)
        for number, limit in enumerate(BRAKING_THRESHOLDS):
            there = hard[braking > limit + BRAKING_TOLERANCE]
            np.add.at(self._hard_braking_counts[..., number], (road[there], kind[there]), 1)

    def record_control_step(
        self,
        vehicles: MotorwayVehicles,
        gaps: Floats,
        backlog: NDArray[np.intp],
        cav_numbers: NDArray[np.intp],
        states: LocalState,
    ) -> None:
        """Note who is where after a decision, and what CAVs perceive, whose names are `cavs`."""
        moment = np.full(len(gaps), len(self._placements))
        self._placements.append(_Placements(moment, *vehicles[:5], gaps))
        self._backlogs.append(backlog)
        self._cav_numbers.append(cav_numbers)
        self._states.append(states)

    def record_accelerations(self, accelerations: Floats) -> None:
        """Note what the CAVs of the moment before did in a decision [m/s2]."""
        self._accelerations.append(accelerations)

    def make_episodes(
        self, driver_log: DriverLog, seeds: Sequence[Sequence[int]], numbers_per_road: int
    ) -> tuple[Episode, ...]:
        """Return the record of each road; CAVs' names are `road * per_road + entry`."""
        stays, wheres = self._trips(driver_log, numbers_per_road), self._placements_by_road()
        settled = np.concatenate(self._steady_following, 1) if self._steady_following else np.zeros((5, 0))
        waiting = np.stack(self._backlogs, 1).astype(np.float64)
        return tuple(
            self._make_episode(number, tuple(seed), wheres[number], stays[number], waiting[number], settled)
            for number, seed in enumerate(seeds)
        )

    def _placements_by_road(self) -> list[_Placements]:
        """Return where vehicles were at all moments until the end, road by road."""
        every = _Placements(*(np.concatenate(values) for values in zip(*self._placements, strict=True)))
        order = np.argsort(every.road, kind="stable")
        starts = np.searchsorted(every.road[order], np.arange(len(self.roads) + 1))
        rows = [order[start:end] for start, end in pairwise(starts)]
        rows = [each[every.step_index[each] <= end] for each, end in zip(rows, self.end_steps, strict=True)]
        return [every.select(each) for each in rows]

    def _trips(self, driver_log: DriverLog, numbers_per_road: int) -> list[list[Trajectory]]:
        """Return the stays of CAVs on each road of at least one decision, in order of entry."""
        counts = [len(each) for each in self._cav_numbers]
        time = np.repeat(np.arange(len(counts)), counts)
        row = np.concatenate([np.arange(count) for count in counts])
        names = np.concatenate(self._cav_numbers)
        order = np.argsort(names, kind="stable")
        cut = np.flatnonzero(np.diff(names[order])) + 1
        first, *others = self._states
        states = first.map(lambda *values: np.concatenate(values), *others)
        # Nobody had decided anything at the last moment.
        applied = np.concatenate([*self._accelerations, np.zeros(counts[-1])])
        found: list[list[Trajectory]] = [[] for _ in self.roads]
        entered = np.argsort([group[0] for group in np.split(order, cut)] if len(order) else [], kind="stable")
        groups = np.split(order, cut) if len(order) else []
        for number, which in enumerate(entered.tolist()):
            rows = groups[which]
            road, entry = divmod(int(names[rows[0]]), numbers_per_road)
            end = self.end_steps[road]
            rows = rows[time[rows] <= end]
            if len(rows) < 2:
                continue
            steps = rows[:-1]
            nothing = np.zeros(len(steps))
            found[road].append(
                make_trajectory(
                    vehicle=self.roads[road].entries[entry].name,
                    entry_number=number,
                    start_step=int(time[rows[0]]),
                    rows=row[rows],
                    states=states.select(rows),
                    applied_acceleration=applied[steps],
                    filter_braking=nothing,
                    shield_braking=nothing,
                    terminated=bool(time[rows[-1]] == end),
                    driver_log=driver_log,
                )
            )
        return found

    def _make_episode(
        self,
        road_index: int,
        seed: tuple[int, ...],
        placements: _Placements,
        trips: list[Trajectory],
        backlog: Floats,
        steady_following: Floats,
    ) -> Episode:
        road, entry = self.roads[road_index], placements.entry
        moments, crashed = len(backlog), self.end_steps[road_index] < len(backlog)
        if crashed:
            moments = int(self.end_steps[road_index]) + 1
        came, first = np.unique(entry, return_index=True)
        came = came[np.argsort(first, kind="stable")]
        of_entry = np.full(self.entry_count, -1)
        of_entry[came] = np.arange(len(came))
        mine = of_entry[entry]
        begins, ends = np.full(len(came), moments), np.zeros(len(came), np.intp)
        np.minimum.at(begins, mine, placements.step_index)
        np.maximum.at(ends, mine, placements.step_index)
        cavs = dict.fromkeys(each.vehicle for each in trips)
        entries = [road.entries[each] for each in came.tolist()]
        groups = [(each.name in cavs, each.route) for each in entries]
        columns = assign_columns(begins, ends, groups, max(1, moments // SHARED_COLUMN_FRAMES))
        branches = dict(zip(columns.tolist(), [each.route for each in entries], strict=True))

        def as_table(values: Floats) -> Floats:
            found = np.full((moments, int(columns.max(initial=-1)) + 1), np.nan)
            found[placements.step_index, columns[mine]] = values
            return found

        return Episode(
            seed=seed,
            status="collision" if crashed else "completed",
            collisions=2 * int(crashed),
            control_step=self.control_step,
            limit_speed=road.limit_speed,
            vehicle_ids=tuple(each.name for each in entries),
            cav_ids=tuple(cavs),
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
            audit=self._audit(road_index, trips, steady_following[1:, steady_following[0] == road_index]),
        )

    def _audit(self, road_index: int, trips: list[Trajectory], steady_following: Floats) -> Audit:
        """Return the physics of every simulation step of a road."""
        people, cavs, cut_in = (
            BrakingStatistics(
                float(self._max_braking[road_index, kind]),
                tuple(map(int, self._hard_braking_counts[road_index, kind])),
                int(self._observed_steps[road_index, kind]),
            )
            for kind in (HUMAN_DRIVER, CAV_DRIVER, CAV_AFTER_CUT_IN)
        )
        jerks = [np.abs(np.diff(each.states.speed, 2)).max(initial=0.0) for each in trips]
        jerk = max(jerks, default=0.0) / self.control_step**2
        speed, leader, gap, recovering = steady_following[:, None]
        found = following_statistics(speed, leader, gap, self.simulation_step, in_recovery=recovering)
        found = replace(found, max_jerk=float(jerk))
        return Audit(people, cavs, found, SHORT_TIME_GAP, has_lanes=True, cut_in_braking=cut_in)
