"""W motorways that a ramp joins, stepped at once: who enters, how all move and change lanes, who leaves.

It is SUMO's on-ramp but for the order in which vehicles change lanes and the numbers that are drawn: the same
people who want to enter at the same times, whole episodes alike in distribution. Lanes are ways from the
ramp's, 0, to the left one; places are along the motorway.
Sources: SUMO's MSVehicle (`planMoveInternal`), MSLane (`insertVehicle`), MSLCM_LC2013 (`_patchSpeed`).
"""

from collections.abc import Callable, Sequence

import numpy as np

from unjam.physics.arrays import Array, at_least, namespace
from unjam.scenarios.on_ramp import AFTER, BEFORE, MERGING, RAMP, RAMP_SPEED
from unjam.scenarios.road import MotorwayRoad, Person
from unjam.scenarios.scenario import CruiseControl
from unjam.worlds.batch.beside import Stretch
from unjam.worlds.batch.extended import (
    HALTING,
    SMALLEST,
    STARTING,
    Ahead,
    bounds,
    felt,
    finished,
)
from unjam.worlds.batch.lane_changes import change_lanes
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.vehicles import FREELY, Around, Vehicles, around, chosen, in_order

NEVER = -1000.0
"""long before an episode began [s]"""
GETS_USED = 4.0
"""time in which extended drivers get used to a higher limit [s]"""
NOBODY_AHEAD = 500.0
"""gap with which they reckon where nobody is ahead [m]"""
BEGINNING = 0.1
"""way behind its own length at which a vehicle enters [m]"""
BRAKES = 0.5
"""harder than anybody brakes with nobody ahead: who brakes so does it for a leader [m/s2]"""
UNCAPPED = 1e6
"""[m/s]"""


Learned = Callable[[Array, Array, Array, Array], Array]
"""What people do besides: from own speed, leader's, gap, and speed after a decision as known, what it is
beyond that [m/s]; arrays of shape (n,)"""


class Waiting:
    """Those of W roads who want to enter, way by way in the order in which they come."""

    def __init__(self, roads: Sequence[MotorwayRoad], numbers: Numbers) -> None:
        """Take the entries of each road."""
        ways = 1 + max(lane.way for lane in roads[0].lanes)
        self._roads, self._numbers = roads, numbers
        self._lines: list[list[list[int]]] = [[[] for _ in roads] for _ in range(ways)]
        for road, each in enumerate(roads):
            for number, entry in enumerate(each.entries):
                self._lines[0 if entry.route == "ramp" else 1 + int(entry.lane)][road].append(number)
        longest = max(len(line) for lines in self._lines for line in lines) + 1
        self._times = np.full((ways, len(roads), longest), np.inf)
        for way, lines in enumerate(self._lines):
            for road, line in enumerate(lines):
                self._times[way, road, : len(line)] = [roads[road].entries[number].time for number in line]
        self._next = np.zeros((ways, len(roads)), np.intp)

    @property
    def entered(self) -> np.ndarray:
        """How many have entered each road."""
        return self._next.sum(0)

    def count(self, now: float) -> np.ndarray:
        """Return how many of each road want to be on it at a time and are not."""
        return (self._times <= now).sum((0, 2)) - self.entered

    def enter(self, vehicles: Vehicles, now: float) -> Vehicles:
        """Return the vehicles with those who enter now, the last of each way leaving them room."""
        roads, new = np.arange(len(self._roads)), list[tuple[float, ...]]()
        due = np.take_along_axis(self._times, self._next[..., None], 2)[..., 0] <= now + 1e-9
        if not due.any():
            return vehicles
        road, way, place, speed = (np.asarray(each) for each in vehicles[:1] + vehicles[2:5])
        for number, ready in enumerate(due):
            if not ready.any():
                continue
            begins = (BEFORE - RAMP if number == 0 else 0.0) + self._roads[0].vehicle_length + BEGINNING
            there = np.flatnonzero((way == number) & (place < BEFORE))
            last = np.full(len(roads), -1)
            last[road[there]] = there  # in order: the last one written is the last on the road
            for each in np.flatnonzero(ready).tolist():
                entry = self._roads[each].entries[self._lines[number][each][self._next[number, each]]]
                person, own = self._roads[each].kinds[entry.kind], last[each]
                room = place[own] - self._roads[each].vehicle_length - begins if own >= 0 else np.inf
                if room < person.gap:
                    continue
                limit = RAMP_SPEED if number == 0 else self._roads[each].limit_speed
                allowed = limit * person.speed_factor
                wanted = allowed if entry.speed == "last" else float(entry.speed)
                if entry.speed == "last" and own >= 0:
                    wanted = min(wanted, float(speed[own]))
                where = each, self._lines[number][each][self._next[number, each]], number, begins
                new.append((*where, min(wanted, allowed), 0.0, *driven_by(person), allowed))
                self._next[number, each] += 1
        if not new:
            return vehicles
        xp = namespace(vehicles.speed)
        newcomers = begun(*map(np.array, zip(*new, strict=True)))
        added = vehicles.each(
            lambda old, new: xp.concatenate([old, _alike(new, old, self._numbers)]), newcomers
        )
        return in_order(added)


def driven_by(person: Person) -> tuple[float, ...]:
    """Return how a person drives as a table of vehicles has it, from `time_headway` to `extended`."""
    follows = person.time_headway, person.acceleration, person.deceleration, person.gap
    return (*follows, person.speed_factor, person.model == "EIDM")


def begun(*columns: np.ndarray) -> Vehicles:
    """Return vehicles that remember nothing and err in nothing, and are told nothing.

    `columns` are those of a table up to `extended`, then the speeds that they want there.
    """
    *known, extended, allowed = columns
    none = 0.0 * allowed
    advice = dict.fromkeys(("own_advice", "told_advice", "beside_advice"), none + FREELY)
    named = {"cap": none + UNCAPPED, "wish": allowed, "started": none + NEVER, **advice}
    nothing = dict.fromkeys(Vehicles._fields, none)
    first = dict(zip(Vehicles._fields, [*known, extended.astype(bool)], strict=False))
    return Vehicles(**(nothing | named | first))


def let_acc_drive(vehicles: Vehicles, rows: np.ndarray, cruise: CruiseControl) -> None:
    """Let the own ACCs of some vehicles drive instead of people."""
    vehicles.extended[rows] = False
    vehicles.time_headway[rows], vehicles.most[rows] = cruise.time_headway, cruise.acceleration
    vehicles.braking[rows], vehicles.gap[rows] = cruise.deceleration, cruise.gap


def _alike(column: np.ndarray, old: Array, numbers: Numbers) -> Array:
    """Return a column as an array of the kind and precision of another."""
    if isinstance(old, np.ndarray):
        return column.astype(old.dtype)
    return numbers(column.astype(np.float64)).to(old.dtype)


def nobody(numbers: Numbers) -> Vehicles:
    """Return empty roads."""
    xp = namespace(numbers(np.zeros(0)))
    integers, truths = ("road", "entry", "way"), ("extended",)
    empty = {name: numbers(np.zeros(0)) for name in Vehicles._fields}
    empty |= {name: xp.zeros(0, dtype=xp.int64) for name in integers}
    empty |= {name: xp.zeros(0, dtype=xp.bool) if xp is not np else np.zeros(0, bool) for name in truths}
    return Vehicles(**empty)


class Motorways:
    """W motorways, alike but for who enters."""

    def __init__(
        self,
        roads: Sequence[MotorwayRoad],
        step: float,
        draw: Callable[[tuple[int, ...]], Array],
        numbers: Numbers,
        learned: Learned | None = None,
        steps: int = 1,
    ) -> None:
        """Take empty roads; `draw` returns standard normal numbers of a shape.

        What was `learned` of people is of a decision, which takes so many `steps`.
        """
        self._learned, self._steps = learned, steps
        road = roads[0]
        self.stretch = Stretch(
            merge=BEFORE,
            closes=BEFORE + MERGING,
            length=BEFORE + MERGING + AFTER,
            limit=road.limit_speed,
            ramp_limit=RAMP_SPEED,
            lanes=len(road.ways) - 1,
            vehicle_length=road.vehicle_length,
        )
        self.vehicles, self.now = nobody(numbers), 0.0
        self._near: tuple[Vehicles, Around] | None = None
        self.waiting = Waiting(roads, numbers)
        self._step, self._draw = step, draw

    @property
    def near(self) -> Around:
        """Who is next to whom now."""
        if self._near is None or self._near[0] is not self.vehicles:
            self._near = self.vehicles, around(self.vehicles, self.stretch.lanes + 1)
        return self._near[1]

    def step(self) -> Vehicles:
        """Make one step of all, and return who has left."""
        moved = in_order(self._moved())
        left = moved.place >= self.stretch.length
        self.vehicles = moved.at(~left)
        if len(self.vehicles.road):
            self.vehicles = change_lanes(self.vehicles, self.stretch, self._step)
        self.now += self._step
        self.vehicles = self.waiting.enter(self.vehicles, self.now - self._step)
        return moved.at(left)

    def _moved(self) -> Vehicles:
        """Return the vehicles after a step, none of whom changes lanes."""
        vehicles, stretch, step = self.vehicles, self.stretch, self._step
        xp, speed, place, way = namespace(vehicles.speed), vehicles.speed, vehicles.place, vehicles.way
        if not len(speed):
            return vehicles
        row = chosen(self.near.ahead, way)
        there = row >= 0
        on_ramp, on_lane = (way == 0) & (place < stretch.merge), (way == 0) & (place >= stretch.merge)
        allowed = xp.where(on_ramp, stretch.ramp_limit, stretch.limit) * vehicles.factor
        allowed = xp.minimum(allowed, vehicles.cap)
        wish = self._wish(on_ramp)
        vehicles = vehicles._replace(wish=xp.where(vehicles.extended, wish, allowed))
        drivers = vehicles.drivers
        leader = xp.where(there, speed[row], allowed)
        gap = xp.where(there, place[row] - stretch.vehicle_length - place, NOBODY_AHEAD + vehicles.gap)
        cool = (vehicles.started + STARTING + SMALLEST < self.now) & (speed > HALTING) & there
        own = xp.where(there, vehicles.acceleration[row], 0.0 * speed)
        follow, urgent = drivers.wish(speed, gap, leader, step, Ahead(own, cool))
        next_allowed = xp.minimum(stretch.limit * vehicles.factor, vehicles.cap)
        # Extended drivers want what is allowed, and are a little faster or slower; IDMs are never faster.
        most = xp.where(vehicles.extended, vehicles.cap, allowed)
        safe = xp.minimum(xp.minimum(speed + vehicles.most * step, most), follow)
        may = safe > speed - BRAKES * step
        rows = drivers.at(may)
        free = rows.wish(speed[may], NOBODY_AHEAD + vehicles.gap[may], next_allowed[may], step)
        # Of whom they follow and what is allowed they heed what they would brake for more if not cool.
        alone = may & True
        alone[may] = free.urgent < urgent[may] + SMALLEST
        safe[may] = xp.where(alone[may], xp.minimum(safe[may], free.speed), safe[may])
        near = xp.where(alone, NOBODY_AHEAD, felt(gap, drivers.people))
        leader = xp.where(alone, next_allowed, leader)
        if bool(on_lane.any()):
            way_left = at_least(stretch.closes - place[on_lane], 0.0)
            stops, before = drivers.at(on_lane).stop(speed[on_lane], way_left, step), safe[on_lane]
            safe[on_lane] = xp.minimum(before, stops)
            near[on_lane] = xp.where(
                stops < before, way_left + 0.05 + 0.2 * vehicles.most[on_lane], near[on_lane]
            )
            leader[on_lane] = xp.where(stops < before, 0.0, leader[on_lane])
        new, started = self._finished(vehicles, safe, near, leader)
        if self._learned is not None:
            new = self._with_learned(new, row)
        errors = drivers.errors.after(new, self._draw((3, len(speed))), step)
        return vehicles._replace(
            place=place + new * step,
            speed=new,
            acceleration=(new - speed) / step,
            started=started,
            gap_error=errors.gap,
            leader_error=errors.leader_speed,
            driving_error=errors.driving,
        )

    def _with_learned(self, new: Array, row: Array) -> Array:
        """Return the speeds after this step with what was learned of people who follow somebody."""
        vehicles, steps = self.vehicles, self._steps
        which = vehicles.extended & (row >= 0)
        if not bool(which.any()):
            return new
        speed, leader = vehicles.speed[which], row[which]
        gap = vehicles.place[leader] - self.stretch.vehicle_length - vehicles.place[which]
        known = speed + (new[which] - speed) * steps
        assert self._learned is not None
        beyond = self._learned(speed, vehicles.speed[leader], gap, known) / steps
        new = new + 0.0
        new[which] = at_least(new[which] + beyond, 0.0)
        return new

    def _wish(self, on_ramp: Array) -> Array:
        """Return the speeds that extended drivers want, who get used to a higher limit bit by bit."""
        vehicles, stretch = self.vehicles, self.stretch
        low, high = stretch.ramp_limit * vehicles.factor, stretch.limit * vehicles.factor
        xp, rises = namespace(low), (high - low) * self._step / GETS_USED
        return xp.minimum(xp.where(on_ramp, low, high), vehicles.wish + rises)

    def _finished(self, vehicles: Vehicles, safe: Array, near: Array, leader: Array) -> tuple[Array, Array]:
        """Return the speeds after this step, and when drivers last began to start."""
        step, speed, xp = self._step, vehicles.speed, namespace(vehicles.speed)
        drivers = vehicles.drivers
        lowest, wanted, highest = bounds(speed, safe, near, leader, drivers.people, drivers.errors, step)
        wanted = xp.where(vehicles.extended, wanted, highest)
        patched, advised = wanted, speed < 0.0
        for advice in (vehicles.own_advice, vehicles.told_advice, vehicles.beside_advice):
            told = speed + advice * step
            counts = (told >= lowest) & (told <= highest)
            patched, advised = xp.where(counts, xp.minimum(told, patched), patched), advised | counts
        leaning = (
            wanted + 0.5 * xp.where(vehicles.leans > 0.0, highest - wanted, wanted - lowest) * vehicles.leans
        )
        wanted = xp.where(advised, patched, leaning)
        found, started = finished(
            speed,
            vehicles.acceleration,
            wanted,
            highest,
            vehicles.started,
            vehicles.most,
            self.now + step,
            step,
        )
        return xp.where(vehicles.extended, found, wanted), started
