"""W motorways that are simulated at once: vehicles enter, move, change lanes and leave.

The same vehicles enter at the same times as in SUMO. The order of lane changes and the random numbers differ from SUMO,
so that episodes agree in distribution. Positions are along the motorway.
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
"""time of the last start from standstill of new vehicles [s]"""
LIMIT_ADAPTATION_TIME = 4.0
"""time in which EIDM drivers adapt to a higher limit [s]"""
FREE_DRIVING_GAP = 500.0
"""gap that drivers assume without a leader [m]"""
INSERTION_OFFSET = 0.1
"""distance between the start of the road and the rear bumper of a vehicle that enters [m]"""
LEADER_BRAKING_THRESHOLD = 0.5
"""maximum braking of drivers without a leader [m/s2]"""
NO_SPEED_CAP = 1e6

LearnedCorrection = Callable[[Array, Array, Array, Array], Array]
"""learned model of human drivers; maps speeds, leader speeds, gaps, and predicted speeds after a control step to
differences from these predictions [m/s], shape (n,)"""


class InsertionQueue:
    """The waiting vehicles of W roads by origin: ramps in driving direction, then main lanes from the right."""

    def __init__(self, roads: Sequence[MotorwayRoad]) -> None:
        self._roads, self._geometry = list(roads), roads[0].geometry
        ramp_of_route = {route: index - 1 for index, route in enumerate(self._geometry.route_names)}
        self._ramp_count = len(self._geometry.ramps)
        shape = self._ramp_count + self._geometry.lane_count, len(roads)
        self._entry_times = np.full((*shape, 1 + max(len(road.entries) for road in roads)), np.inf)
        self._entry_indices = np.zeros(self._entry_times.shape, np.intp)
        counts = np.zeros(shape, np.intp)
        for road_index, road in enumerate(roads):
            for entry_index, entry in enumerate(road.entries):
                is_main = entry.route == MAIN_ROUTE
                origin = self._ramp_count + entry.lane if is_main else ramp_of_route[entry.route]
                place = origin, road_index, counts[origin, road_index]
                self._entry_times[place], self._entry_indices[place] = entry.time, entry_index
                counts[origin, road_index] += 1
        self._inserted_counts = np.zeros(shape, np.intp)

    def replace_roads(self, roads: Sequence[int], source: Self, source_roads: Sequence[int], time: float) -> None:
        """Continue on `roads` with `source_roads` of another queue, which start at `time`."""
        times, indices = source._entry_times + time, source._entry_indices
        self._entry_times = replace_padded_rows(self._entry_times, roads, times, source_roads, np.inf)
        self._entry_indices = replace_padded_rows(self._entry_indices, roads, indices, source_roads, 0)
        self._inserted_counts[:, roads] = source._inserted_counts[:, source_roads]
        for road, source_road in zip(roads, source_roads, strict=True):
            self._roads[road] = source._roads[source_road]

    @property
    def entry_counts(self) -> np.ndarray:
        """Number of vehicles that have entered each road."""
        return self._inserted_counts.sum(0)

    def backlog(self, time: float) -> np.ndarray:
        """Return the insertion backlog of each road at a time [vehicles]."""
        return (self._entry_times <= time).sum((0, 2)) - self.entry_counts

    def insert(self, vehicles: MotorwayVehicles, time: float) -> MotorwayVehicles:
        """Return the vehicles, and those that enter at `time` if the last vehicle on their lane leaves room."""
        is_due = np.take_along_axis(self._entry_times, self._inserted_counts[..., None], 2)[..., 0] <= time + 1e-9
        if not is_due.any():
            return vehicles
        new, last, geometry = list[tuple[float, ...]](), np.full(is_due.shape, -1), self._geometry
        road, _, lane, position, speed = vehicles[:5]
        sections = geometry.sections(lane, position)
        is_on_first_edge = sections.is_before & ((lane == 0) | (sections.ramp == 0))
        upstream = np.flatnonzero(is_on_first_edge)
        origin = np.where(lane == 0, sections.ramp, self._ramp_count + lane - 1)
        last[origin[upstream], road[upstream]] = upstream  # sorted: the last assignment is the last vehicle there
        for origin_index, road_index in np.argwhere(is_due).tolist():
            built_road, row = self._roads[road_index], last[origin_index, road_index]
            ramp = geometry.ramps[origin_index] if origin_index < self._ramp_count else None
            start = (ramp.start if ramp else 0.0) + geometry.vehicle_length + INSERTION_OFFSET
            inserted_count = self._inserted_counts[origin_index, road_index]
            entry_index = int(self._entry_indices[origin_index, road_index, inserted_count])
            entry = built_road.entries[entry_index]
            vehicle_type = built_road.vehicle_types[entry.vehicle_type]
            room = position[row] - geometry.vehicle_length - start if row >= 0 else np.inf
            if room < vehicle_type.minimum_gap:
                continue
            allowed = (ramp or geometry).speed_limit * vehicle_type.speed_factor
            desired = allowed if entry.speed == "last" else float(entry.speed)
            if entry.speed == "last" and row >= 0:
                desired = min(desired, float(speed[row]))
            lane_index = 0 if ramp else origin_index - self._ramp_count + 1
            motion = road_index, entry_index, lane_index, start, min(desired, allowed), 0.0
            new.append((*motion, *driver_columns(vehicle_type), allowed))
            self._inserted_counts[origin_index, road_index] += 1
        if not new:
            return vehicles
        entered = make_vehicles(*map(np.array, zip(*new, strict=True)))
        return sort_vehicles(vehicles.map(lambda old, new: np.concatenate([old, new.astype(old.dtype)]), entered))


def driver_columns(vehicle_type: VehicleType) -> tuple[float, ...]:
    """Return the parameters of a driver in the order of `MotorwayVehicles`, from `time_headway` to `is_eidm`."""
    t = vehicle_type
    return t.time_headway, t.acceleration, t.deceleration, t.minimum_gap, t.speed_factor, t.model == "EIDM"


def make_vehicles(*columns: np.ndarray) -> MotorwayVehicles:
    """Return vehicles without memory, errors and advice; `columns` end with `is_eidm` and `desired_speed`."""
    *first_columns, is_eidm, desired_speed = columns
    zeros = 0.0 * desired_speed
    advice = dict.fromkeys(ADVICE_FIELDS, zeros + NO_ADVICE)
    times = {"speed_cap": zeros + NO_SPEED_CAP, "start_time": zeros + LONG_BEFORE_START}
    known = dict(zip(MotorwayVehicles._fields, [*first_columns, is_eidm.astype(bool)], strict=False))
    defaults = dict.fromkeys(MotorwayVehicles._fields, zeros)
    return MotorwayVehicles(**defaults | times | advice | known | {"desired_speed": desired_speed})


def enable_acc(vehicles: MotorwayVehicles, rows: np.ndarray, cruise_control: CruiseControl) -> MotorwayVehicles:
    """Return the vehicles, of which those in `rows` are driven by their ACC instead of human drivers."""
    gaps = {"time_headway": cruise_control.time_gap, "minimum_gap": cruise_control.minimum_gap}
    limits = {"max_acceleration": cruise_control.acceleration, "braking": cruise_control.deceleration}
    return vehicles.replace_rows(rows, is_eidm=False, **gaps, **limits)


class BatchMotorways:
    """The vehicles on W motorways that differ only in the vehicles that enter."""

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
        lane = self.vehicles.lane  # another array if vehicles enter, leave, change lanes or are sorted
        if self._cached_neighbors is None or self._cached_neighbors[0] is not lane:
            neighbors = find_road_neighbors(self.vehicles.road, lane, self.vehicles.position, self.geometry)
            self._cached_neighbors = lane, neighbors
        return self._cached_neighbors[1]

    def replace_roads(self, roads: Sequence[int], source: Self, source_roads: Sequence[int]) -> None:
        """Continue on `roads` with empty roads of another batch that has not been simulated."""
        self.vehicles = self.vehicles.select(~np.isin(self.vehicles.road, roads))
        self.insertion_queue.replace_roads(roads, source.insertion_queue, source_roads, self.time)

    def step(self) -> MotorwayVehicles:
        """Simulate one step, and return the vehicles that have left their road."""
        vehicles = self._move_vehicles()
        has_left = vehicles.position >= self.geometry.length
        order = sorted_rows(vehicles)
        self.vehicles = vehicles.select(order[~has_left[order]])
        if len(self.vehicles.road):
            self.vehicles = change_lanes(self.vehicles, self.geometry, self._step)
        self.time += self._step
        self.vehicles = self.insertion_queue.insert(self.vehicles, self.time - self._step)
        return vehicles.select(has_left)

    def _move_vehicles(self) -> MotorwayVehicles:
        """Return all vehicles with speeds and positions after this step."""
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
        # EIDM drivers may exceed the allowed speed slightly; IDM drivers never exceed it.
        max_speed = np.where(vehicles.is_eidm, vehicles.speed_cap, allowed)
        safe = np.minimum(np.minimum(speed + vehicles.max_acceleration * step, max_speed), follow)
        may_be_free = as_rows(safe > speed - LEADER_BRAKING_THRESHOLD * step)
        free_speeds, free_gaps, free_limits = (values[may_be_free] for values in (speed, free_gap, next_allowed))
        free = drivers.select(may_be_free).desired_speed(free_speeds, free_gaps, free_limits, step)
        # Drivers follow the leader or the allowed speed, depending on which requires more braking without coolness.
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
            new = self._correct_speeds(new, row, self._correction)
        errors = drivers.errors.next_errors(new, self._draw((3, len(speed))), step)
        vehicles = vehicles._replace(gap_error=errors[0], leader_error=errors[1], driving_error=errors[2])
        position, acceleration = position + new * step, (new - speed) / step
        return vehicles._replace(position=position, speed=new, acceleration=acceleration, start_time=start_time)

    def _correct_speeds(self, speeds: Array, leader_rows: Array, correction: LearnedCorrection) -> Array:
        """Return speeds after this step with the learned correction for EIDM drivers behind a leader."""
        vehicles, steps = self.vehicles, self._steps_per_control_step
        is_corrected = vehicles.is_eidm & (leader_rows >= 0)
        if not bool(is_corrected.any()):
            return speeds
        speed, leader = vehicles.speed[is_corrected], leader_rows[is_corrected]
        gap = vehicles.position[leader] - self.geometry.vehicle_length - vehicles.position[is_corrected]
        predicted = speed + (speeds[is_corrected] - speed) * steps
        difference = correction(speed, vehicles.speed[leader], gap, predicted) / steps
        speeds = speeds + 0.0
        speeds[is_corrected] = clamp_min(speeds[is_corrected] + difference, 0.0)
        return speeds

    def _final_speeds(
        self, vehicles: MotorwayVehicles, safe_speed: Array, effective_gap: Array, leader_speed: Array
    ) -> tuple[Array, Array]:
        """Return the speeds after this step, and the times of the last start, with errors and advice of drivers."""
        step, speed, drivers = self._step, vehicles.speed, vehicles.drivers
        min_speed, desired, max_speed = eidm.eidm_speed_bounds(
            speed, safe_speed, effective_gap, leader_speed, drivers.parameters, drivers.errors, step
        )
        desired = np.where(vehicles.is_eidm, desired, max_speed)
        advised_speed, is_advised = desired, speed < 0.0
        for advice in (vehicles.lane_change_advice, vehicles.cooperative_advice, vehicles.adjacent_advice):
            new_speed = speed + advice * step
            is_possible = (new_speed >= min_speed) & (new_speed <= max_speed)
            advised_speed = np.where(is_possible, np.minimum(new_speed, advised_speed), advised_speed)
            is_advised = is_advised | is_possible
        room = np.where(vehicles.speed_bias > 0.0, max_speed - desired, desired - min_speed)
        desired = np.where(is_advised, advised_speed, desired + 0.5 * room * vehicles.speed_bias)
        arguments = vehicles.start_time, vehicles.max_acceleration, self.time + step, step
        eidm_speed, start_time = eidm.finalize_eidm_speed(speed, vehicles.acceleration, desired, max_speed, *arguments)
        return np.where(vehicles.is_eidm, eidm_speed, desired), start_time
