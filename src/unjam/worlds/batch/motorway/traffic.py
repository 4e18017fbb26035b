"""W motorways, stepped at once: vehicles enter, move, change lanes and leave.

They equal SUMO's, with the same vehicles entering at the same times, except for the order in which vehicles
change lanes and for the random numbers, so that whole episodes agree in distribution. Positions are along the motorway.
Sources: SUMO's MSVehicle (`planMoveInternal`), MSLane (`insertVehicle`), MSLCM_LC2013 (`_patchSpeed`).
"""

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
from numpy.typing import DTypeLike

from unjam.physics.arrays import Array, clamp_min, replace_padded_rows
from unjam.scenarios.motorway_road import MAIN_ROUTE, MotorwayRoad
from unjam.scenarios.road import VehicleType
from unjam.scenarios.scenario import CruiseControl
from unjam.worlds.batch.motorway import eidm
from unjam.worlds.batch.motorway.lane_changes import change_lanes
from unjam.worlds.batch.motorway.vehicles import (
    ADVICE_FIELDS,
    NO_ADVICE,
    MotorwayVehicles,
    as_rows,
    sort_vehicles,
    sorted_rows,
)
from unjam.worlds.batch.noise import DrawNormal
from unjam.worlds.lane_neighbors import LaneNeighbors, find_road_neighbors, neighbors_on_lane

LONG_BEFORE_START = -1000.0
LIMIT_ADAPTATION_TIME = 4.0
"""time in which EIDM drivers adapt to a higher limit [s]"""
FREE_DRIVING_GAP = 500.0
"""gap that drivers assume without a leader [m]"""
INSERTION_OFFSET = 0.1
"""distance behind its own length at which a vehicle enters [m]"""
LEADER_BRAKING_THRESHOLD = 0.5
"""braking that drivers never exceed without a leader [m/s2]"""
NO_SPEED_CAP = 1e6

LearnedCorrection = Callable[[Array, Array, Array, Array], Array]
"""A learned model of human drivers: from own speed, leader speed, gap, and known speed after a control step, to the
difference of the speed after that step [m/s]; arrays of shape (n,)"""


class InsertionQueue:
    """The vehicles of W roads that wait, by origin: ramps from upstream on, then main lanes from the right on."""

    def __init__(self, roads: Sequence[MotorwayRoad]) -> None:
        self._roads, self._geometry = list(roads), roads[0].geometry
        ramp_of_route = {name: number - 1 for number, name in enumerate(self._geometry.route_names)}
        self._ramp_count = len(self._geometry.ramps)
        shape = self._ramp_count + self._geometry.lane_count, len(roads)
        self._entry_times = np.full((*shape, 1 + max(len(road.entries) for road in roads)), np.inf)
        self._entry_numbers = np.zeros(self._entry_times.shape, np.intp)
        counts = np.zeros(shape, np.intp)
        for index, road in enumerate(roads):
            for number, entry in enumerate(road.entries):
                is_main = entry.route == MAIN_ROUTE
                origin = self._ramp_count + entry.lane if is_main else ramp_of_route[entry.route]
                self._entry_times[origin, index, counts[origin, index]] = entry.time
                self._entry_numbers[origin, index, counts[origin, index]] = number
                counts[origin, index] += 1
        self._next = np.zeros(shape, np.intp)

    def replace_roads(self, roads: Sequence[int], source: Self, source_roads: Sequence[int], time: float) -> None:
        """Continue on some roads with the vehicles that wait in another queue, as if their roads started at `time`."""
        times, numbers = source._entry_times + time, source._entry_numbers
        self._entry_times = replace_padded_rows(self._entry_times, roads, times, source_roads, np.inf)
        self._entry_numbers = replace_padded_rows(self._entry_numbers, roads, numbers, source_roads, 0)
        self._next[:, roads] = source._next[:, source_roads]
        for own, other in zip(roads, source_roads, strict=True):
            self._roads[own] = source._roads[other]

    @property
    def entry_counts(self) -> np.ndarray:
        """Number of vehicles that have entered each road."""
        return self._next.sum(0)

    def backlog(self, time: float) -> np.ndarray:
        """Return the insertion backlog of each road at a time [vehicles]."""
        return (self._entry_times <= time).sum((0, 2)) - self.entry_counts

    def insert(self, vehicles: MotorwayVehicles, time: float) -> MotorwayVehicles:
        """Return the vehicles with those that enter now, where the last vehicle on the lane leaves them room."""
        is_due = np.take_along_axis(self._entry_times, self._next[..., None], 2)[..., 0] <= time + 1e-9
        if not is_due.any():
            return vehicles
        new, last, geometry = list[tuple[float, ...]](), np.full(is_due.shape, -1), self._geometry
        road, _, lane, position, speed = vehicles[:5]
        sections = geometry.sections(lane, position)
        is_on_first_edge = sections.is_before & ((lane == 0) | (sections.ramp == 0))
        upstream = np.flatnonzero(is_on_first_edge)
        origin = np.where(lane == 0, sections.ramp, self._ramp_count + lane - 1)
        last[origin[upstream], road[upstream]] = upstream  # sorted: the last assignment is the last vehicle there
        for number, index in np.argwhere(is_due).tolist():
            built, row = self._roads[index], last[number, index]
            ramp = geometry.ramps[number] if number < self._ramp_count else None
            start = (ramp.start if ramp else 0.0) + geometry.vehicle_length + INSERTION_OFFSET
            entry_number = int(self._entry_numbers[number, index, self._next[number, index]])
            entry = built.entries[entry_number]
            vehicle_type = built.vehicle_types[entry.vehicle_type]
            room = position[row] - geometry.vehicle_length - start if row >= 0 else np.inf
            if room < vehicle_type.minimum_gap:
                continue
            allowed = (ramp or geometry).speed_limit * vehicle_type.speed_factor
            desired = allowed if entry.speed == "last" else float(entry.speed)
            if entry.speed == "last" and row >= 0:
                desired = min(desired, float(speed[row]))
            number_of_lane = 0 if ramp else number - self._ramp_count + 1
            motion = index, entry_number, number_of_lane, start, min(desired, allowed), 0.0
            new.append((*motion, *driver_columns(vehicle_type), allowed))
            self._next[number, index] += 1
        if not new:
            return vehicles
        entered = make_vehicles(*map(np.array, zip(*new, strict=True)))
        return sort_vehicles(vehicles.map(lambda old, new: np.concatenate([old, new.astype(old.dtype)]), entered))


def driver_columns(vehicle_type: VehicleType) -> tuple[float, ...]:
    """Return the parameters of a driver in the order of `MotorwayVehicles`, from `time_headway` to `is_eidm`."""
    kind = vehicle_type
    following = kind.time_headway, kind.acceleration, kind.deceleration, kind.minimum_gap
    return *following, kind.speed_factor, kind.model == "EIDM"


def make_vehicles(*columns: np.ndarray) -> MotorwayVehicles:
    """Return vehicles without memory, errors and advice; `columns` are those up to `is_eidm`, and the desired speed."""
    *known, is_eidm, desired_speed = columns
    zeros = 0.0 * desired_speed
    advice = dict.fromkeys(ADVICE_FIELDS, zeros + NO_ADVICE)
    times = {"speed_cap": zeros + NO_SPEED_CAP, "start_time": zeros + LONG_BEFORE_START}
    first = dict(zip(MotorwayVehicles._fields, [*known, is_eidm.astype(bool)], strict=False))
    defaults = dict.fromkeys(MotorwayVehicles._fields, zeros)
    return MotorwayVehicles(**defaults | times | advice | first | {"desired_speed": desired_speed})


def enable_acc(vehicles: MotorwayVehicles, rows: np.ndarray, cruise_control: CruiseControl) -> MotorwayVehicles:
    """Return the vehicles with some of them driven by their ACC instead of human drivers."""
    gaps = {"time_headway": cruise_control.time_gap, "minimum_gap": cruise_control.minimum_gap}
    limits = {"max_acceleration": cruise_control.acceleration, "braking": cruise_control.deceleration}
    return vehicles.replace_rows(rows, is_eidm=False, **gaps, **limits)


class BatchMotorways:
    """W motorways that differ only in the vehicles that enter."""

    def __init__(
        self,
        roads: Sequence[MotorwayRoad],
        step: float,
        draw: DrawNormal,
        correction: LearnedCorrection | None = None,
        steps_per_control_step: int = 1,
        precision: DTypeLike = np.float64,
    ) -> None:
        self._correction, self._steps_per_control_step = correction, steps_per_control_step
        self.geometry = roads[0].geometry
        columns = dict.fromkeys(MotorwayVehicles._fields, np.zeros(0, precision)) | {"is_eidm": np.zeros(0, bool)}
        columns |= dict.fromkeys(("road", "entry", "lane"), np.zeros(0, np.int64))
        self.vehicles, self.time = MotorwayVehicles(**columns), 0.0
        self._cached_neighbors: tuple[Array, LaneNeighbors] | None = None
        self.insertion_queue = InsertionQueue(roads)
        self._step, self._draw = step, draw

    @property
    def neighbors(self) -> LaneNeighbors:
        """The neighbors of the vehicles."""
        lane = self.vehicles.lane  # a new column if vehicles enter, leave, change lanes or are sorted
        if self._cached_neighbors is None or self._cached_neighbors[0] is not lane:
            neighbors = find_road_neighbors(self.vehicles.road, lane, self.vehicles.position, self.geometry)
            self._cached_neighbors = lane, neighbors
        return self._cached_neighbors[1]

    def replace_roads(self, roads: Sequence[int], source: Self, source_roads: Sequence[int]) -> None:
        """Continue on some roads with empty ones of another batch that has not been stepped."""
        self.vehicles = self.vehicles.select(~np.isin(self.vehicles.road, roads))
        self.insertion_queue.replace_roads(roads, source.insertion_queue, source_roads, self.time)

    def step(self) -> MotorwayVehicles:
        """Simulate one step, and return the vehicles that have left."""
        moved = self._moved_vehicles()
        has_left = moved.position >= self.geometry.length
        order = sorted_rows(moved)
        self.vehicles = moved.select(order[~has_left[order]])
        if len(self.vehicles.road):
            self.vehicles = change_lanes(self.vehicles, self.geometry, self._step)
        self.time += self._step
        self.vehicles = self.insertion_queue.insert(self.vehicles, self.time - self._step)
        return moved.select(has_left)

    def _moved_vehicles(self) -> MotorwayVehicles:
        vehicles, geometry, step = self.vehicles, self.geometry, self._step
        speed, position = vehicles.speed, vehicles.position
        if not len(speed):
            return vehicles
        row = neighbors_on_lane(self.neighbors.leaders, vehicles.lane)
        sections, has_leader = geometry.sections(vehicles.lane, position), row >= 0
        is_on_ramp, is_on_lane = (vehicles.lane == 0) & sections.is_before, (vehicles.lane == 0) & ~sections.is_before
        limit, ramp_limit = (
            lane_limit * vehicles.speed_factor for lane_limit in (geometry.speed_limit, sections.ramp_speed_limit)
        )
        allowed = geometry.speed_limits(vehicles.lane, sections) * vehicles.speed_factor
        allowed = np.minimum(allowed, vehicles.speed_cap)
        adapted = vehicles.desired_speed + clamp_min(limit - ramp_limit, 0.0) * step / LIMIT_ADAPTATION_TIME
        eidm_desired = np.minimum(np.where(is_on_ramp, ramp_limit, limit), adapted)
        vehicles = vehicles._replace(desired_speed=np.where(vehicles.is_eidm, eidm_desired, allowed))
        drivers = vehicles.drivers
        leader_speed, free_gap = np.where(has_leader, speed[row], allowed), FREE_DRIVING_GAP + vehicles.minimum_gap
        gap = np.where(has_leader, position[row] - geometry.vehicle_length - position, free_gap)
        is_started = vehicles.start_time + eidm.START_UP_DURATION + eidm.EIDM_EPSILON < self.time
        may_stay_cool = is_started & (speed > eidm.EIDM_HALTING_SPEED) & has_leader
        motion = eidm.LeaderMotion(np.where(has_leader, vehicles.acceleration[row], 0.0 * speed), may_stay_cool)
        follow, uncooled = drivers.desired_speed(speed, gap, leader_speed, step, motion)
        next_allowed = np.minimum(limit, vehicles.speed_cap)
        # EIDMs desire the allowed speed, and drive a little faster or slower; IDMs never drive faster.
        max_speed = np.where(vehicles.is_eidm, vehicles.speed_cap, allowed)
        safe = np.minimum(np.minimum(speed + vehicles.max_acceleration * step, max_speed), follow)
        may_be_free = as_rows(safe > speed - LEADER_BRAKING_THRESHOLD * step)
        own, ahead, limits = (values[may_be_free] for values in (speed, free_gap, next_allowed))
        free = drivers.select(may_be_free).desired_speed(own, ahead, limits, step)
        # Of the leader and the allowed speed, drivers obey the one that requires more braking without coolness.
        is_free = np.zeros(len(speed), bool)
        is_free[may_be_free] = free.uncooled_acceleration < uncooled[may_be_free] + eidm.EIDM_EPSILON
        safe[may_be_free] = np.where(is_free[may_be_free], np.minimum(safe[may_be_free], free.speed), safe[may_be_free])
        effective_gap = np.where(is_free, FREE_DRIVING_GAP, eidm.eidm_effective_gap(gap, drivers.parameters))
        leader_speed = np.where(is_free, next_allowed, leader_speed)
        if bool(is_on_lane.any()):
            remaining = clamp_min((sections.merge_end - position)[is_on_lane], 0.0)
            stop_speed = drivers.select(is_on_lane).stop_speed(speed[is_on_lane], remaining, step)
            must_stop = stop_speed < safe[is_on_lane]
            safe[is_on_lane] = np.minimum(safe[is_on_lane], stop_speed)
            stop_gap = remaining + 0.05 + 0.2 * vehicles.max_acceleration[is_on_lane]
            effective_gap[is_on_lane] = np.where(must_stop, stop_gap, effective_gap[is_on_lane])
            leader_speed[is_on_lane] = np.where(must_stop, 0.0, leader_speed[is_on_lane])
        new, start_time = self._final_speeds(vehicles, safe, effective_gap, leader_speed)
        if self._correction is not None:
            new = self._corrected_speeds(new, row, self._correction)
        errors = drivers.errors.next_errors(new, self._draw((3, len(speed))), step)
        vehicles = vehicles._replace(gap_error=errors[0], leader_error=errors[1], driving_error=errors[2])
        position, acceleration = position + new * step, (new - speed) / step
        return vehicles._replace(position=position, speed=new, acceleration=acceleration, start_time=start_time)

    def _corrected_speeds(self, speeds: Array, leader_rows: Array, correction: LearnedCorrection) -> Array:
        """Return the speeds after this step with the learned correction of EIDM drivers with a leader."""
        vehicles, steps = self.vehicles, self._steps_per_control_step
        is_corrected = vehicles.is_eidm & (leader_rows >= 0)
        if not bool(is_corrected.any()):
            return speeds
        speed, leader = vehicles.speed[is_corrected], leader_rows[is_corrected]
        gap = vehicles.position[leader] - self.geometry.vehicle_length - vehicles.position[is_corrected]
        known = speed + (speeds[is_corrected] - speed) * steps
        difference = correction(speed, vehicles.speed[leader], gap, known) / steps
        speeds = speeds + 0.0
        speeds[is_corrected] = clamp_min(speeds[is_corrected] + difference, 0.0)
        return speeds

    def _final_speeds(
        self, vehicles: MotorwayVehicles, safe_speed: Array, effective_gap: Array, leader_speed: Array
    ) -> tuple[Array, Array]:
        step, speed, drivers = self._step, vehicles.speed, vehicles.drivers
        lowest, desired, highest = eidm.eidm_speed_bounds(
            speed, safe_speed, effective_gap, leader_speed, drivers.parameters, drivers.errors, step
        )
        desired = np.where(vehicles.is_eidm, desired, highest)
        patched, is_advised = desired, speed < 0.0
        for advice in (vehicles.lane_change_advice, vehicles.cooperative_advice, vehicles.adjacent_advice):
            advised = speed + advice * step
            is_possible = (advised >= lowest) & (advised <= highest)
            patched = np.where(is_possible, np.minimum(advised, patched), patched)
            is_advised = is_advised | is_possible
        room = np.where(vehicles.speed_bias > 0.0, highest - desired, desired - lowest)
        desired = np.where(is_advised, patched, desired + 0.5 * room * vehicles.speed_bias)
        start_limits = vehicles.start_time, vehicles.max_acceleration, self.time + step, step
        eidm_speed, start_time = eidm.finalize_eidm_speed(speed, vehicles.acceleration, desired, highest, *start_limits)
        return np.where(vehicles.is_eidm, eidm_speed, desired), start_time
