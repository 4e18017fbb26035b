"""W motorways that a ramp joins as one world to drive in: CAVs hold their own ACCs back, as in SUMO.

Rows of CAVs are in the order in which they entered, whatever their road.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, accelerations_of_many, time_headways
from unjam.drivers.local_state import BESIDE, LARGEST_GAP, SECTIONS_AHEAD, LocalState
from unjam.drivers.roadside import MainRoad, Messages
from unjam.physics.arrays import Floats
from unjam.physics.kinematics import next_speed
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.batch.lanes import CONTACT
from unjam.worlds.batch.motorway import UNCAPPED, Learned, Motorways, let_acc_drive
from unjam.worlds.batch.motorway_record import MotorwayLog
from unjam.worlds.batch.vehicles import PER_ROAD, Vehicles, chosen, number_of, rows_of
from unjam.worlds.record import Episode
from unjam.worlds.world import Driven, OnProgress


class Again(NamedTuple):
    """What is otherwise where the people of an episode come once more, all at the same times."""

    seeds: Sequence[tuple[Sequence[int], Sequence[int]]]
    """of what people misjudge, and of exploration, for each road"""
    decisions: int
    """after which it ends"""
    errs: bool
    """whether people misjudge anything"""
    learned: Learned | None
    """what people do besides"""


class MotorwayBatch:
    """W on-ramps of the same kind, each with a seed of its own; alike SUMO's in distribution."""

    single = False
    asked: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at"""
    kept: Sequence[int] | None = None

    def __init__(
        self,
        scenario: OnRamp,
        seeds: Sequence[Sequence[int]],
        kind: type = np.float64,
        explore: Sequence[float] | None = None,
        again: "Again | None" = None,
    ) -> None:
        """Take empty roads, one for each seed; numbers have the precision `kind`.

        By `explore` exploration noise counts on each road; None: as it is drawn. `again`: what is otherwise
        than in the episodes of these seeds.
        """
        self._explore = np.ones(len(seeds)) if explore is None else np.array(explore)
        self.scenario, self._seeds = scenario, seeds
        drawn = [scenario.of_seed(seed) for seed in seeds]
        self.roads = [cast(MotorwayRoad, road) for road, _ in drawn]
        self._again, own = again, [(noise, seed) for _, (noise, seed, *_) in drawn]
        self._people, self._exploration = (
            [np.random.default_rng(seed) for seed in seeds]
            for seeds in zip(*(own if again is None else again.seeds), strict=True)
        )
        self._kind, step = kind, self.scenario.simulation_step
        numbers, learned = lambda values: values.astype(kind), again and again.learned
        taken = self.scenario.steps_per_decision
        self._traffic = Motorways(self.roads, step, self._drawn, numbers, learned, taken)
        entries = max(len(road.entries) for road in self.roads)
        self._is_cav = np.zeros((len(drawn), entries), bool)
        for number, road in enumerate(self.roads):
            self._is_cav[number, : len(road.entries)] = [entry.name in road.cav_ids for entry in road.entries]
        ways, road = len(self.roads[0].ways), self.roads[0]
        self._main_road = MainRoad(ways, road.length, len(drawn))
        self._messages = Messages(road.roadside, self.scenario.decision_step, self._people[0])
        self.limits, self.decisions, self.entered = self.scenario.limits, 0, 0
        self._cavs: NDArray[np.intp] = np.zeros(0, np.intp)
        """road and entry of each CAV as one number, in order of entry"""
        self._came = np.zeros(len(drawn))
        """CAVs that have entered each road"""
        self._controlled, self._headways_asked = False, False
        self._lasting: Floats | None = None
        """what networks explore with all episode long, of each road"""
        decision_step = self.scenario.decision_step
        planned = self.scenario.horizon * decision_step
        self._log = MotorwayLog(self.roads, entries, step, decision_step, planned)

    def _drawn(self, shape: tuple[int, ...]) -> Floats:
        """Return the errors of all vehicles in this step: each road draws its own."""
        if self._again is not None and not self._again.errs:
            return np.zeros(shape, self._kind)
        counts = np.bincount(self._traffic.vehicles.road, minlength=len(self.roads))
        drawn = [
            generator.standard_normal((shape[0], count))
            for generator, count in zip(self._people, counts.tolist(), strict=True)
        ]
        return np.concatenate(drawn, 1).astype(self._kind)

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Begin with empty roads; nothing was before."""
        self._controlled = controlled
        self._look()

    @property
    def rows(self) -> int:
        """CAVs on the roads now."""
        return len(self._cavs)

    @property
    def of_road(self) -> NDArray[np.intp]:
        """Which road each CAV is on, shape (CAVs,)."""
        return self._cavs // PER_ROAD

    @property
    def ended(self) -> bool:
        """Whether the horizon is reached."""
        horizon = self.scenario.horizon if self._again is None else self._again.decisions
        return self.decisions >= horizon

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,)."""
        return self._perceived

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its steps; None: the CAVs stay human."""
        scenario, before = self.scenario, self._perceived.speed
        wanted = None
        if self._controlled:
            wanted = accelerations_of_many(command, self.limits, self.rows, self.decisions)
            self._ask_for_headways(command)
        for _ in range(scenario.steps_per_decision):
            if wanted is not None:
                self._hold_back(np.asarray(wanted, np.float64))
            left = self._traffic.step()
            vehicles = self._traffic.vehicles
            ahead = chosen(self._traffic.near.ahead, vehicles.way)
            self._log.note_step(vehicles, ahead, left, rows_of(self._cavs, vehicles), self._controlled)
        self.decisions += 1
        self._look()
        after, kept = before.copy(), slice(len(before)) if self.kept is None else self.kept
        after[kept] = self._perceived.speed[: len(after[kept])]
        self._log.note_applied((after - before) / scenario.decision_step)

    def _ask_for_headways(self, command: Command | None) -> None:
        """Let CAVs' ACCs keep the time headways that a driver asks for; their own, where it asks no more."""
        self._headways_asked = self._headways_asked or (
            command is not None and command.time_headway is not None
        )
        if not self._headways_asked:
            return
        names = [str(number) for number in self._cavs]
        least = self.scenario.cruise.time_headway
        headways = time_headways(command, least, names, self.decisions)
        self._traffic.vehicles.time_headway[rows_of(self._cavs, self._traffic.vehicles)] = headways

    def _hold_back(self, wanted: Floats) -> None:
        """Give each CAV a set speed, or none where its ACC may drive as it likes or a lane closes."""
        vehicles, cruise, step = self._traffic.vehicles, self.scenario.cruise, self.scenario.simulation_step
        found = rows_of(self._cavs, vehicles)
        there = found >= 0
        rows, wanted = found[there], wanted[there]
        speed, stretch = vehicles.speed[rows].astype(np.float64), self._traffic.stretch
        asked = cruise.set_speed(speed, next_speed(speed, wanted, step), self.limits.highest, step)
        beside = (vehicles.place[rows] >= stretch.merge) & (vehicles.place[rows] < stretch.closes)
        vehicles.cap[rows] = np.where(beside, UNCAPPED, np.minimum(asked, UNCAPPED))

    def _look(self) -> None:
        """Note who is where after a decision, and take control of the CAVs that have entered."""
        vehicles = self._traffic.vehicles
        there = rows_of(self._cavs, vehicles) >= 0
        keys = number_of(vehicles)
        chosen_ones = np.flatnonzero(self._is_cav[vehicles.road, vehicles.entry])
        new = chosen_ones[~np.isin(keys[chosen_ones], self._cavs)]
        new = new[np.argsort(keys[new], kind="stable")]
        self.kept = np.flatnonzero(there).tolist() if len(new) or not there.all() else None
        self._cavs = np.concatenate([self._cavs[there], keys[new]])
        self.entered += len(new)
        if self._controlled and len(new):
            let_acc_drive(vehicles, new, self.scenario.cruise)
        self._came += np.bincount(vehicles.road[new], minlength=len(self.roads))
        means = self._main_road.means(
            vehicles.way, vehicles.place, vehicles.speed, self._traffic.stretch.limit, vehicles.road
        )
        self._messages.send(means)
        self._perceived = self._state(vehicles)
        waiting = self._traffic.waiting.count(self._traffic.now - self.scenario.simulation_step)
        gaps = self._gaps(vehicles)
        touched = vehicles.road[gaps < CONTACT]
        self._log.ends[touched] = np.minimum(self._log.ends[touched], self.decisions)
        self._log.note_moment(vehicles, gaps, waiting, self._cavs, self._perceived)

    def _gaps(self, vehicles: Vehicles) -> Floats:
        """Return the gaps of all to those ahead on their ways [m]; NaN where nobody is."""
        if not len(vehicles.road):
            return np.zeros(0)
        row = chosen(self._traffic.near.ahead, vehicles.way)
        gaps = vehicles.place[row] - self.roads[0].vehicle_length - vehicles.place
        return np.where(row >= 0, gaps, np.nan)

    def _state(self, vehicles: Vehicles) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        rows, road = rows_of(self._cavs, vehicles), self.roads[0]
        if not len(rows):
            return _nobody()
        near = self._traffic.near
        way, place, speed = vehicles.way[rows], vehicles.place[rows], vehicles.speed[rows]

        def other(neighbours: NDArray[np.intp], beside: int, towards: float) -> tuple[Floats, Floats]:
            row = chosen(neighbours, vehicles.way + beside)[rows]
            gap = towards * (vehicles.place[row] - place) - road.vehicle_length
            there = (row >= 0) & (gap < LARGEST_GAP)
            return np.where(there, vehicles.speed[row], speed), np.where(there, gap, LARGEST_GAP)

        beside = [
            other(each, side, sign)
            for side in (1, -1)
            for each, sign in ((near.ahead, 1.0), (near.behind, -1.0))
        ]
        ramp = (way == 0) & (place < road.merge)
        allowed = np.where(ramp, self._traffic.stretch.ramp_limit, self._traffic.stretch.limit)
        lane_speeds, road_speeds = self._main_road.ahead(
            self._messages.arrived, way, place, vehicles.road[rows]
        )
        share = self._came / self._traffic.waiting.entered.clip(1)
        found = LocalState(
            speed,
            *other(near.ahead, 0, 1.0),
            *other(near.behind, 0, -1.0),
            place - road.merge,
            np.full(len(rows), np.nan),
            allowed_speed=allowed * vehicles.factor[rows],
            to_merge=road.merge - place,
            lane_speeds=lane_speeds,
            road_speeds=road_speeds,
            beside_gaps=np.stack([gap for _, gap in beside], -1),
            beside_speeds=np.stack([its for its, _ in beside], -1),
            cav_share=share[vehicles.road[rows]],
        )
        return found.each(lambda values: values.astype(np.float64)).read_only()

    def noise(self, lasting: int = 0) -> Floats:
        """Return standard normal noise for one look of a network, shape (CAVs,), or what lasts."""
        roads = self.of_road
        if lasting:
            if self._lasting is None:
                each = [generator.standard_normal(lasting) for generator in self._exploration]
                self._lasting = np.stack(each)
            return self._explore[roads, None] * self._lasting[roads]
        found = np.empty(len(roads))
        for road in np.unique(roads).tolist():
            here = roads == road
            found[here] = self._exploration[road].standard_normal(int(here.sum()))
        return self._explore[roads] * found

    def record(self, driven: Driven) -> tuple[Episode, ...]:
        """Return what happened on each road since the start, without what was earned."""
        return self._log.episodes(driven, self._seeds, PER_ROAD)


def _nobody() -> LocalState:
    """Return what is perceived where no CAV is on the road."""
    one, many, four = np.zeros(0), np.zeros((0, SECTIONS_AHEAD)), np.zeros((0, len(BESIDE)))
    own = LocalState(one, one, one, one, one, one, one)
    told = {"allowed_speed": one, "to_merge": one, "lane_speeds": many, "road_speeds": many}
    return own._replace(**told, beside_gaps=four, beside_speeds=four, cav_share=one)
