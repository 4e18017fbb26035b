"""W motorways that a ramp joins, stepped at once: who enters, how all move and change lanes, who leaves.

It is SUMO's on-ramp but for the order in which vehicles change lanes and the numbers that are drawn: the same
people who want to enter at the same times, whole episodes alike in distribution. Lanes are ways from the
ramp's, 0, to the left one; places are along the motorway.
Sources: SUMO's MSVehicle (`planMoveInternal`), MSLane (`insertVehicle`), MSLCM_LC2013 (`_patchSpeed`).
"""

from collections.abc import Callable, Sequence

import numpy as np

from unjam.physics.arrays import Array, clamp_min, namespace
from unjam.scenarios.on_ramp import DOWNSTREAM_LENGTH, MERGING_LENGTH, RAMP_LENGTH, RAMP_SPEED_LIMIT, UPSTREAM_LENGTH
from unjam.scenarios.road import MotorwayRoad, VehicleType
from unjam.scenarios.scenario import CruiseControl
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.batch.on_ramp.eidm import (
    EIDM_EPSILON,
    EIDM_HALTING_SPEED,
    START_UP_DURATION,
    LeaderMotion,
    eidm_effective_gap,
    eidm_speed_bounds,
    finalize_eidm_speed,
)
from unjam.worlds.batch.on_ramp.lane_change_context import MotorwayGeometry
from unjam.worlds.batch.on_ramp.lane_changes import change_lanes
from unjam.worlds.batch.on_ramp.vehicles import (
    NO_ADVICE,
    LaneNeighbors,
    MotorwayVehicles,
    find_neighbors,
    neighbors_on_lane,
    sort_vehicles,
)

LONG_BEFORE_START = -1000.0
"""long before an episode began [s]"""
LIMIT_ADAPTATION_TIME = 4.0
"""time in which extended drivers get used to a higher limit [s]"""
FREE_DRIVING_GAP = 500.0
"""gap with which they reckon where nobody is ahead [m]"""
INSERTION_OFFSET = 0.1
"""way behind its own length at which a vehicle enters [m]"""
LEADER_BRAKING_THRESHOLD = 0.5
"""harder than anybody brakes with nobody ahead: who brakes so does it for a leader [m/s2]"""
NO_SPEED_CAP = 1e6
"""[m/s]"""


LearnedCorrection = Callable[[Array, Array, Array, Array], Array]
"""What people do besides: from own speed, leader's, gap, and speed after a decision as known, what it is
beyond that [m/s]; arrays of shape (n,)"""


class InsertionQueue:
    """Those of W roads who want to enter, way by way in the order in which they come."""

    def __init__(self, roads: Sequence[MotorwayRoad], to_array: ArrayFactory) -> None:
        """Take the entries of each road."""
        ways = 1 + max(lane.lane_index for lane in roads[0].edge_lanes)
        self._roads, self._to_array = roads, to_array
        self._queues: list[list[list[int]]] = [[[] for _ in roads] for _ in range(ways)]
        for road, each in enumerate(roads):
            for number, entry in enumerate(each.entries):
                self._queues[0 if entry.route == "ramp" else 1 + int(entry.lane)][road].append(number)
        longest = max(len(line) for lines in self._queues for line in lines) + 1
        self._entry_times = np.full((ways, len(roads), longest), np.inf)
        for way, lines in enumerate(self._queues):
            for road, line in enumerate(lines):
                self._entry_times[way, road, : len(line)] = [roads[road].entries[number].time for number in line]
        self._next = np.zeros((ways, len(roads)), np.intp)

    @property
    def entry_counts(self) -> np.ndarray:
        """How many have entered each road."""
        return self._next.sum(0)

    def backlog(self, time: float) -> np.ndarray:
        """Return how many of each road want to be on it at a time and are not."""
        return (self._entry_times <= time).sum((0, 2)) - self.entry_counts

    def insert(self, vehicles: MotorwayVehicles, time: float) -> MotorwayVehicles:
        """Return the vehicles with those who enter now, the last of each way leaving them room."""
        roads, new = np.arange(len(self._roads)), list[tuple[float, ...]]()
        due = np.take_along_axis(self._entry_times, self._next[..., None], 2)[..., 0] <= time + 1e-9
        if not due.any():
            return vehicles
        road, way, place, speed = (np.asarray(each) for each in vehicles[:1] + vehicles[2:5])
        for number, ready in enumerate(due):
            if not ready.any():
                continue
            begins = (
                (UPSTREAM_LENGTH - RAMP_LENGTH if number == 0 else 0.0)
                + self._roads[0].vehicle_length
                + INSERTION_OFFSET
            )
            there = np.flatnonzero((way == number) & (place < UPSTREAM_LENGTH))
            last = np.full(len(roads), -1)
            last[road[there]] = there  # in order: the last one written is the last on the road
            for each in np.flatnonzero(ready).tolist():
                entry = self._roads[each].entries[self._queues[number][each][self._next[number, each]]]
                person, own = self._roads[each].vehicle_types[entry.vehicle_type], last[each]
                room = place[own] - self._roads[each].vehicle_length - begins if own >= 0 else np.inf
                if room < person.minimum_gap:
                    continue
                limit = RAMP_SPEED_LIMIT if number == 0 else self._roads[each].limit_speed
                allowed = limit * person.speed_factor
                wanted = allowed if entry.speed == "last" else float(entry.speed)
                if entry.speed == "last" and own >= 0:
                    wanted = min(wanted, float(speed[own]))
                where = each, self._queues[number][each][self._next[number, each]], number, begins
                new.append((*where, min(wanted, allowed), 0.0, *driver_columns(person), allowed))
                self._next[number, each] += 1
        if not new:
            return vehicles
        xp = namespace(vehicles.speed)
        newcomers = make_vehicles(*map(np.array, zip(*new, strict=True)))
        added = vehicles.map(lambda old, new: xp.concatenate([old, _convert_like(new, old, self._to_array)]), newcomers)
        return sort_vehicles(added)


def driver_columns(vehicle_type: VehicleType) -> tuple[float, ...]:
    """Return how a person drives as a table of vehicles has it, from `time_headway` to `is_eidm`."""
    follows = vehicle_type.time_headway, vehicle_type.acceleration, vehicle_type.deceleration, vehicle_type.minimum_gap
    return (*follows, vehicle_type.speed_factor, vehicle_type.model == "EIDM")


def make_vehicles(*columns: np.ndarray) -> MotorwayVehicles:
    """Return vehicles that remember nothing and err in nothing, and are told nothing.

    `columns` are those of a table up to `is_eidm`, then the speeds that they want there.
    """
    *known, extended, allowed = columns
    none = 0.0 * allowed
    advice = dict.fromkeys(("own_advice", "cooperative_advice", "adjacent_advice"), none + NO_ADVICE)
    named = {"speed_cap": none + NO_SPEED_CAP, "desired_speed": allowed, "start_time": none + LONG_BEFORE_START, **advice}
    nothing = dict.fromkeys(MotorwayVehicles._fields, none)
    first = dict(zip(MotorwayVehicles._fields, [*known, extended.astype(bool)], strict=False))
    return MotorwayVehicles(**(nothing | named | first))


def enable_acc(vehicles: MotorwayVehicles, rows: np.ndarray, cruise_control: CruiseControl) -> None:
    """Let the own ACCs of some vehicles drive instead of people."""
    vehicles.is_eidm[rows] = False
    vehicles.time_headway[rows], vehicles.max_acceleration[rows] = cruise_control.time_gap, cruise_control.acceleration
    vehicles.braking[rows], vehicles.minimum_gap[rows] = cruise_control.deceleration, cruise_control.minimum_gap


def _convert_like(column: np.ndarray, reference: Array, to_array: ArrayFactory) -> Array:
    """Return a column as an array of the kind and precision of another."""
    if isinstance(reference, np.ndarray):
        return column.astype(reference.dtype)
    return to_array(column.astype(np.float64)).to(reference.dtype)


def empty_vehicles(to_array: ArrayFactory) -> MotorwayVehicles:
    """Return empty roads."""
    xp = namespace(to_array(np.zeros(0)))
    integers, truths = ("road", "entry", "lane"), ("is_eidm",)
    empty = {name: to_array(np.zeros(0)) for name in MotorwayVehicles._fields}
    empty |= {name: xp.zeros(0, dtype=xp.int64) for name in integers}
    empty |= {name: xp.zeros(0, dtype=xp.bool) if xp is not np else np.zeros(0, bool) for name in truths}
    return MotorwayVehicles(**empty)


class BatchMotorways:
    """W motorways, alike but for who enters."""

    def __init__(
        self,
        roads: Sequence[MotorwayRoad],
        step: float,
        draw: Callable[[tuple[int, ...]], Array],
        to_array: ArrayFactory,
        correction: LearnedCorrection | None = None,
        steps_per_control_step: int = 1,
    ) -> None:
        """Take empty roads; `draw` returns standard normal numbers of a shape.

        What was `learned` of people is of a decision, which takes so many `steps`.
        """
        self._correction, self._steps_per_control_step = correction, steps_per_control_step
        road = roads[0]
        self.geometry = MotorwayGeometry(
            merge_start=UPSTREAM_LENGTH,
            merge_end=UPSTREAM_LENGTH + MERGING_LENGTH,
            length=UPSTREAM_LENGTH + MERGING_LENGTH + DOWNSTREAM_LENGTH,
            speed_limit=road.limit_speed,
            ramp_speed_limit=RAMP_SPEED_LIMIT,
            lane_count=len(road.lane_names) - 1,
            vehicle_length=road.vehicle_length,
        )
        self.vehicles, self.time = empty_vehicles(to_array), 0.0
        self._cached_neighbors: tuple[MotorwayVehicles, LaneNeighbors] | None = None
        self.insertion_queue = InsertionQueue(roads, to_array)
        self._step, self._draw = step, draw

    @property
    def neighbors(self) -> LaneNeighbors:
        """Who is next to whom now."""
        if self._cached_neighbors is None or self._cached_neighbors[0] is not self.vehicles:
            self._cached_neighbors = self.vehicles, find_neighbors(self.vehicles, self.geometry.lane_count + 1)
        return self._cached_neighbors[1]

    def step(self) -> MotorwayVehicles:
        """Make one step of all, and return who has left."""
        moved = sort_vehicles(self._moved_vehicles())
        left = moved.position >= self.geometry.length
        self.vehicles = moved.select(~left)
        if len(self.vehicles.road):
            self.vehicles = change_lanes(self.vehicles, self.geometry, self._step)
        self.time += self._step
        self.vehicles = self.insertion_queue.insert(self.vehicles, self.time - self._step)
        return moved.select(left)

    def _moved_vehicles(self) -> MotorwayVehicles:
        """Return the vehicles after a step, none of whom changes lanes."""
        vehicles, stretch, step = self.vehicles, self.geometry, self._step
        xp, speed, place, way = namespace(vehicles.speed), vehicles.speed, vehicles.position, vehicles.lane
        if not len(speed):
            return vehicles
        row = neighbors_on_lane(self.neighbors.leaders, way)
        there = row >= 0
        on_ramp, on_lane = (way == 0) & (place < stretch.merge_start), (way == 0) & (place >= stretch.merge_start)
        allowed = xp.where(on_ramp, stretch.ramp_speed_limit, stretch.speed_limit) * vehicles.speed_factor
        allowed = xp.minimum(allowed, vehicles.speed_cap)
        wish = self._desired_speeds(on_ramp)
        vehicles = vehicles._replace(desired_speed=xp.where(vehicles.is_eidm, wish, allowed))
        drivers = vehicles.drivers
        leader = xp.where(there, speed[row], allowed)
        gap = xp.where(there, place[row] - stretch.vehicle_length - place, FREE_DRIVING_GAP + vehicles.minimum_gap)
        cool = (
            (vehicles.start_time + START_UP_DURATION + EIDM_EPSILON < self.time) & (speed > EIDM_HALTING_SPEED) & there
        )
        own = xp.where(there, vehicles.acceleration[row], 0.0 * speed)
        follow, urgent = drivers.desired_speed(speed, gap, leader, step, LeaderMotion(own, cool))
        next_allowed = xp.minimum(stretch.speed_limit * vehicles.speed_factor, vehicles.speed_cap)
        # Extended drivers want what is allowed, and are a little faster or slower; IDMs are never faster.
        most = xp.where(vehicles.is_eidm, vehicles.speed_cap, allowed)
        safe = xp.minimum(xp.minimum(speed + vehicles.max_acceleration * step, most), follow)
        may = safe > speed - LEADER_BRAKING_THRESHOLD * step
        rows = drivers.select(may)
        free = rows.desired_speed(speed[may], FREE_DRIVING_GAP + vehicles.minimum_gap[may], next_allowed[may], step)
        # Of whom they follow and what is allowed they heed what they would brake for more if not cool.
        alone = may & True
        alone[may] = free.uncooled_acceleration < urgent[may] + EIDM_EPSILON
        safe[may] = xp.where(alone[may], xp.minimum(safe[may], free.speed), safe[may])
        near = xp.where(alone, FREE_DRIVING_GAP, eidm_effective_gap(gap, drivers.parameters))
        leader = xp.where(alone, next_allowed, leader)
        if bool(on_lane.any()):
            way_left = clamp_min(stretch.merge_end - place[on_lane], 0.0)
            stops, before = drivers.select(on_lane).stop_speed(speed[on_lane], way_left, step), safe[on_lane]
            safe[on_lane] = xp.minimum(before, stops)
            near[on_lane] = xp.where(
                stops < before, way_left + 0.05 + 0.2 * vehicles.max_acceleration[on_lane], near[on_lane]
            )
            leader[on_lane] = xp.where(stops < before, 0.0, leader[on_lane])
        new, started = self._final_speeds(vehicles, safe, near, leader)
        if self._correction is not None:
            new = self._corrected_speeds(new, row)
        errors = drivers.errors.next_errors(new, self._draw((3, len(speed))), step)
        return vehicles._replace(
            position=place + new * step,
            speed=new,
            acceleration=(new - speed) / step,
            start_time=started,
            gap_error=errors.gap,
            leader_error=errors.leader_speed,
            driving_error=errors.driving,
        )

    def _corrected_speeds(self, speeds: Array, leader_rows: Array) -> Array:
        """Return the speeds after this step with what was learned of people who follow somebody."""
        vehicles, steps = self.vehicles, self._steps_per_control_step
        which = vehicles.is_eidm & (leader_rows >= 0)
        if not bool(which.any()):
            return speeds
        speed, leader = vehicles.speed[which], leader_rows[which]
        gap = vehicles.position[leader] - self.geometry.vehicle_length - vehicles.position[which]
        known = speed + (speeds[which] - speed) * steps
        assert self._correction is not None
        beyond = self._correction(speed, vehicles.speed[leader], gap, known) / steps
        speeds = speeds + 0.0
        speeds[which] = clamp_min(speeds[which] + beyond, 0.0)
        return speeds

    def _desired_speeds(self, is_on_ramp: Array) -> Array:
        """Return the speeds that extended drivers want, who get used to a higher limit bit by bit."""
        vehicles, stretch = self.vehicles, self.geometry
        low, high = stretch.ramp_speed_limit * vehicles.speed_factor, stretch.speed_limit * vehicles.speed_factor
        xp, rises = namespace(low), (high - low) * self._step / LIMIT_ADAPTATION_TIME
        return xp.minimum(xp.where(is_on_ramp, low, high), vehicles.desired_speed + rises)

    def _final_speeds(
        self, vehicles: MotorwayVehicles, safe_speed: Array, effective_gap: Array, leader_speed: Array
    ) -> tuple[Array, Array]:
        """Return the speeds after this step, and when drivers last began to start."""
        step, speed, xp = self._step, vehicles.speed, namespace(vehicles.speed)
        drivers = vehicles.drivers
        lowest, wanted, highest = eidm_speed_bounds(
            speed, safe_speed, effective_gap, leader_speed, drivers.parameters, drivers.errors, step
        )
        wanted = xp.where(vehicles.is_eidm, wanted, highest)
        patched, advised = wanted, speed < 0.0
        for advice in (vehicles.own_advice, vehicles.cooperative_advice, vehicles.adjacent_advice):
            told = speed + advice * step
            counts = (told >= lowest) & (told <= highest)
            patched, advised = xp.where(counts, xp.minimum(told, patched), patched), advised | counts
        leaning = (
            wanted + 0.5 * xp.where(vehicles.speed_bias > 0.0, highest - wanted, wanted - lowest) * vehicles.speed_bias
        )
        wanted = xp.where(advised, patched, leaning)
        found, started = finalize_eidm_speed(
            speed,
            vehicles.acceleration,
            wanted,
            highest,
            vehicles.start_time,
            vehicles.max_acceleration,
            self.time + step,
            step,
        )
        return xp.where(vehicles.is_eidm, found, wanted), started
