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
    BEYOND,
    CAV,
    CAV_CUT_IN,
    CUT_IN,
    PEOPLE,
    ROUNDING,
    SETTLED,
    SHORT_HEADWAY,
    Audit,
    Brakings,
    Pair,
    following,
    is_recovering,
)
from unjam.worlds.batch.vehicles import Vehicles
from unjam.worlds.record import FRAMES, Episode, Trajectory, shared_columns, trajectory
from unjam.worlds.world import Driven

NEVER = int(np.iinfo(np.intp).max)
"""the decision after which a road ends on which nobody has touched"""


class _Where(NamedTuple):
    """Where vehicles are; arrays of shape (n,)."""

    moment: NDArray[np.intp]
    """after so many decisions"""
    road: NDArray[np.intp]
    entry: NDArray[np.intp]
    """which of those who want to enter the road"""
    way: NDArray[np.intp]
    place: Floats
    """[m]"""
    speed: Floats
    """[m/s]"""
    gap: Floats
    """to the one ahead [m]; NaN where nobody is"""

    def at(self, rows: NDArray[np.intp]) -> "_Where":
        """Return where some of them are."""
        whole = (self.moment[rows], self.road[rows], self.entry[rows], self.way[rows])
        return _Where(*whole, self.place[rows], self.speed[rows], self.gap[rows])


@dataclass
class MotorwayLog:
    """All decisions of W motorways; braking and headways in every simulation step."""

    roads: Sequence[MotorwayRoad]
    entries: int
    step: float
    """of the simulation [s]"""
    decision_step: float
    """[s]"""
    planned: float
    """how long they are driven [s]"""
    ends: NDArray[np.intp] = field(init=False)
    """decision after which vehicles touched on each, or NEVER"""

    def __post_init__(self) -> None:
        """Begin with nothing."""
        roads, kinds = len(self.roads), 1 + max(PEOPLE, CAV, CAV_CUT_IN)
        self.ends = np.full(roads, NEVER)
        self._wheres = list[_Where]()
        self._waiting = list[NDArray[np.intp]]()
        self._cavs = list[NDArray[np.intp]]()
        self._states = list[LocalState]()
        self._applied = list[Floats]()
        self._arrived = np.zeros(roads, np.intp)
        self._hardest, self._braked = np.zeros((roads, kinds)), np.zeros((roads, kinds), np.intp)
        self._beyond = np.zeros((roads, kinds, len(BEYOND)), np.intp)
        self._leader, self._since = np.full((2, roads, self.entries), -1)
        self._steps, self._settled = 0, list[Floats]()
        self._recovers = np.zeros((roads, self.entries), bool)
        """whether each vehicle, if it is a CAV, recovers from a change of leader"""
        self._pairs = np.zeros((len(Pair._fields), roads, self.entries))
        """each of them and its leader in the last step, as `Pair` has them"""

    def note_step(
        self,
        vehicles: Vehicles,
        ahead: NDArray[np.intp],
        left: Vehicles,
        cavs: NDArray[np.intp],
        controlled: bool,
    ) -> None:
        """Note how all braked in a step, and how CAVs, the rows `cavs`, follow those `ahead` of each."""
        self._steps += 1
        goes_on = self.ends == NEVER
        self._arrived += np.bincount(left.road, minlength=len(self.roads)) * goes_on
        road, entry = vehicles.road, vehicles.entry
        kind = np.full(len(road), PEOPLE)
        if controlled:
            rows = cavs[cavs >= 0]
            kind[rows] = CAV
            leader = ahead[rows]
            now, own = np.where(leader >= 0, entry[leader], -1), (road[rows], entry[rows])
            changed = self._leader[own] != now
            self._leader[own] = now
            self._since[own] = np.where(changed, self._steps, self._since[own])
            lasts = (self._steps - self._since[own]) * self.step
            kind[rows[lasts < CUT_IN]] = CAV_CUT_IN
            follows = (leader >= 0) & (lasts > SETTLED) & goes_on[road[rows]]
            gap = vehicles.place[leader] - self.roads[0].vehicle_length - vehicles.place[rows]
            pair = Pair(vehicles.speed[rows], vehicles.speed[leader], gap)
            recovers = is_recovering(self._recovers[own], lasts, Pair(*self._pairs[:, *own]), pair)
            self._recovers[own] = recovers = recovers & (leader >= 0)
            self._pairs[:, *own] = pair
            seen = road[rows], *pair, recovers
            self._settled.append(np.stack([each[follows].astype(np.float64) for each in seen]))
        np.add.at(self._braked, (road, kind), goes_on[road])
        hard = np.flatnonzero((vehicles.acceleration < 0.0) & goes_on[road])
        braking = -vehicles.acceleration[hard].astype(np.float64)
        np.maximum.at(self._hardest, (road[hard], kind[hard]), braking)
        for number, limit in enumerate(BEYOND):
            there = hard[braking > limit + ROUNDING]
            np.add.at(self._beyond[..., number], (road[there], kind[there]), 1)

    def note_moment(
        self,
        vehicles: Vehicles,
        gaps: Floats,
        waiting: NDArray[np.intp],
        cavs: NDArray[np.intp],
        states: LocalState,
    ) -> None:
        """Note who is where after a decision, and what CAVs perceive, whose names are `cavs`."""
        moment = np.full(len(gaps), len(self._wheres))
        self._wheres.append(_Where(moment, *vehicles[:5], gaps))
        self._waiting.append(waiting)
        self._cavs.append(cavs)
        self._states.append(states)

    def note_applied(self, applied: Floats) -> None:
        """Note what the CAVs of the moment before did in a decision [m/s2]."""
        self._applied.append(applied)

    def episodes(self, driven: Driven, seeds: Sequence[Sequence[int]], per_road: int) -> tuple[Episode, ...]:
        """Return the record of each road; CAVs' names are `road * per_road + entry`."""
        stays, wheres = self._stays(driven, per_road), self._by_road()
        settled = np.concatenate(self._settled, 1) if self._settled else np.zeros((5, 0))
        waiting = np.stack(self._waiting, 1).astype(np.float64)
        return tuple(
            self._episode(number, tuple(seed), wheres[number], stays[number], waiting[number], settled)
            for number, seed in enumerate(seeds)
        )

    def _by_road(self) -> list[_Where]:
        """Return where vehicles were at all moments until the end, road by road."""
        every = _Where(*(np.concatenate(values) for values in zip(*self._wheres, strict=True)))
        order = np.argsort(every.road, kind="stable")
        starts = np.searchsorted(every.road[order], np.arange(len(self.roads) + 1))
        rows = [order[start:end] for start, end in pairwise(starts)]
        rows = [each[every.moment[each] <= end] for each, end in zip(rows, self.ends, strict=True)]
        return [every.at(each) for each in rows]

    def _stays(self, driven: Driven, per_road: int) -> list[list[Trajectory]]:
        """Return the stays of CAVs on each road of at least one decision, in order of entry."""
        counts = [len(each) for each in self._cavs]
        time = np.repeat(np.arange(len(counts)), counts)
        row = np.concatenate([np.arange(count) for count in counts])
        names = np.concatenate(self._cavs)
        order = np.argsort(names, kind="stable")
        cut = np.flatnonzero(np.diff(names[order])) + 1
        first, *others = self._states
        states = first.each(lambda *values: np.concatenate(values), *others)
        # Nobody had decided anything at the last moment.
        applied = np.concatenate([*self._applied, np.zeros(counts[-1])])
        found: list[list[Trajectory]] = [[] for _ in self.roads]
        entered = np.argsort(
            [group[0] for group in np.split(order, cut)] if len(order) else [], kind="stable"
        )
        groups = np.split(order, cut) if len(order) else []
        for number, which in enumerate(entered.tolist()):
            rows = groups[which]
            road, entry = divmod(int(names[rows[0]]), per_road)
            end = self.ends[road]
            rows = rows[time[rows] <= end]
            if len(rows) < 2:
                continue
            steps = rows[:-1]
            nothing = np.zeros(len(steps))
            found[road].append(
                trajectory(
                    vehicle=self.roads[road].entries[entry].name,
                    number=number,
                    start=int(time[rows[0]]),
                    rows=row[rows],
                    states=states.at(rows),
                    applied=applied[steps],
                    filtered=nothing,
                    shield=nothing,
                    terminated=bool(time[rows[-1]] == end),
                    driven=driven,
                )
            )
        return found

    def _episode(
        self,
        number: int,
        seed: tuple[int, ...],
        where: _Where,
        stays: list[Trajectory],
        waiting: Floats,
        settled: Floats,
    ) -> Episode:
        road, entry = self.roads[number], where.entry
        moments, crashed = len(waiting), self.ends[number] < len(waiting)
        if crashed:
            moments = int(self.ends[number]) + 1
        came, first = np.unique(entry, return_index=True)
        came = came[np.argsort(first, kind="stable")]
        of_entry = np.full(self.entries, -1)
        of_entry[came] = np.arange(len(came))
        mine = of_entry[entry]
        begins, ends = np.full(len(came), moments), np.zeros(len(came), np.intp)
        np.minimum.at(begins, mine, where.moment)
        np.maximum.at(ends, mine, where.moment)
        cavs = dict.fromkeys(each.vehicle for each in stays)
        entries = [road.entries[each] for each in came.tolist()]
        groups = [(each.name in cavs, each.route) for each in entries]
        columns = shared_columns(begins, ends, groups, max(1, moments // FRAMES))
        branches = dict(zip(columns.tolist(), [each.route for each in entries], strict=True))

        def table(values: Floats) -> Floats:
            found = np.full((moments, int(columns.max(initial=-1)) + 1), np.nan)
            found[where.moment, columns[mine]] = values
            return found

        return Episode(
            seed=seed,
            status="collision" if crashed else "completed",
            collisions=2 * int(crashed),
            step=self.decision_step,
            limit_speed=road.limit_speed,
            vehicle_ids=tuple(each.name for each in entries),
            cav_ids=tuple(cavs),
            columns=tuple(columns.tolist()),
            branches=tuple(branches[column] for column in sorted(branches)),
            speeds=table(where.speed),
            positions=table(where.place - road.merge),
            gaps=table(where.gap),
            lanes=table(len(road.ways) - 1.0 - where.way.astype(np.float64)),
            lane_names=road.ways[::-1],
            arrived=int(self._arrived[number]),
            waiting=waiting[:moments],
            planned=self.planned,
            peak=road.peak,
            free_time=road.free_time,
            trajectories=tuple(stays),
            audit=self._audit(number, stays, settled[1:, settled[0] == number]),
        )

    def _audit(self, number: int, stays: list[Trajectory], settled: Floats) -> Audit:
        """Return the physics of every simulation step of a road."""
        people, cavs, cut_in = (
            Brakings(
                float(self._hardest[number, kind]),
                tuple(map(int, self._beyond[number, kind])),
                int(self._braked[number, kind]),
            )
            for kind in (PEOPLE, CAV, CAV_CUT_IN)
        )
        jerks = [np.abs(np.diff(each.states.speed, 2)).max(initial=0.0) for each in stays]
        jerk = max(jerks, default=0.0) / self.decision_step**2
        speed, leader, gap, recovering = settled[:, None]
        found = following(speed, leader, gap, self.step, recovering=recovering)
        found = replace(found, jerk=float(jerk))
        return Audit(people, cavs, found, SHORT_HEADWAY, lanes=True, cut_in=cut_in)
