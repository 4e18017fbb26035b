"""Movement of all vehicles of W figure eights, limited by SUMO's right of way; human drivers are commanded.

Arrays have shape (vehicles, W) or (W,). Sources: SUMO's MSVehicle (`planMoveInternal`, `checkLinkLeader`,
`adaptToJunctionLeader`, `processLinkApproaches`, `isLeader`) and MSLink (`opened`, `blockedByFoe`,
`computeFoeArrivalTimeBraking`, `getLeaderInfo`). As in SUMO, a foe is a vehicle of the crossing direction.
"""

from collections.abc import Sequence
from functools import partial
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.physics.arrays import Array, Floats, clamp_max, clamp_min, namespace, replace_columns, square_root
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import HALTING_SPEED, gap_on_loop
from unjam.scenarios.figure_eight import CROSSING_LINK, INNER_LINK, OUTER_LINK, figure_eight_radius, lane_lengths
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import SUMO_ACCELERATION, VEHICLE_LENGTH, Scenario
from unjam.worlds.batch import human_idm
from unjam.worlds.batch.figure_eight.car_following import CarFollowingModels, speed_after_distance
from unjam.worlds.batch.noise import ArrayFactory

FOE_VISIBILITY_DISTANCE = 4.5
"""distance before the crossing from which yielding vehicles see foes [m]"""
MINOR_STOP_DISTANCE, MAJOR_STOP_DISTANCE = 0.1, 1.0
"""distance before the crossing at which waiting vehicles stop [m]"""
FOE_TIME_MARGIN = 1.0
"""minimum time between leaving the crossing and the arrival of a foe with the right of way [s]"""
IMPATIENCE_TIME = 300.0
"""waiting time in which impatience grows by one [s]"""
MAX_WAITING_ACCELERATION = 0.5 * SUMO_ACCELERATION
"""acceleration up to which a slow vehicle counts as waiting [m/s2]"""
CROSSED_LANE_WIDTH, CAR_WIDTH = 3.2, 1.8
"""width of the crossed lane, and of a car [m]"""
CONFLICT_AREA_START = CROSSING_LINK / 2.0 - CROSSED_LANE_WIDTH / 2.0
"""distance from the start of the crossing to the crossed lane [m]"""
STOPPING_FOE_DELAY = 30.0
"""additional arrival time of foes that can stop before the crossing [s]"""
LANE_LENGTH_DIGITS = 6
COMMANDED_SPEED_TOLERANCE = 1e-9


class CrossingMemory(NamedTuple):
    """State of the vehicles between steps, shape (vehicles, W); shape (vehicles,) for one road."""

    waiting_time: Array
    """time that a vehicle has waited [s]"""
    entry_step: Array
    """number of steps since each vehicle entered the crossing for the last time, negative"""


class _CrossingSide(NamedTuple):
    """One of the two directions across the crossing; shapes (W,)."""

    start: Array
    """position where the crossing starts [m]"""
    lane_length: Array
    """length of the lane before the crossing [m]"""
    approach_distance: Array
    """distance before the crossing from which SUMO registers approaching vehicles [m]"""


class _Vehicle(NamedTuple):
    """The last vehicle past the start of a crossing; shapes (W,)."""

    front: Array
    """position of the front bumper past the start [m]"""
    speed: Array
    index: Array
    """row of the vehicle"""


class _Approach(NamedTuple):
    """The plans of vehicles that approach one side of the crossing."""

    distance: Array
    """distance to the crossing [m]; negative on it"""
    is_approaching: Array
    approach_speed: Array
    """maximum speed in this step before the crossing [m/s]"""
    stop_speed: Array
    """maximum speed of vehicles that must wait [m/s]"""
    go_speed: Array
    """maximum speed of vehicles that may enter [m/s]"""
    arrival_time: Array
    leave_time: Array


def _last_vehicle(speed: Array, distance_past: Array) -> _Vehicle:
    index, columns = distance_past.argmin(0), np.arange(distance_past.shape[1])
    return _Vehicle(distance_past[index, columns], speed[index, columns], index)


def commanded_speed(speed: Array, leader_speed: Array, gap: Array, parameters: Any, step: float) -> Array:
    """Return noise-free commanded speeds of human drivers, which may be negative; see `human_idm_speed`."""
    return speed + idm_acceleration(speed, leader_speed, clamp_min(gap, MIN_IDM_GAP), parameters) * step


class FigureEightMovement:
    """Commands the IDM with noise to human drivers outside the crossing, and applies the right of way."""

    def __init__(
        self,
        scenario: Scenario,
        roads: Sequence[ClosedRoad],
        cav_indices: list[int],
        to_array: ArrayFactory,
        human_model: human_idm.HumanSpeedModel | None = None,
    ) -> None:
        """Take roads that cross themselves once, and the indices of the CAVs, which humans drive until `hand_over`."""
        idm = partial(commanded_speed, parameters=scenario.humans, step=scenario.simulation_step)
        self._human_model, self._cav_indices = human_model or idm, cav_indices
        self._models, self._models_with_cavs = (
            CarFollowingModels(scenario, len(roads[0].vehicle_ids), cavs, to_array) for cavs in ([], cav_indices)
        )
        self._crossings = to_array(np.transpose([road.crossings for road in roads], (1, 2, 0)))
        self._loop_length = to_array(np.array([road.loop_length for road in roads]))
        self._step, self._impatience = scenario.simulation_step, scenario.impatience
        self._to_array, self._columns = to_array, np.arange(len(roads))
        zeros = to_array(np.zeros((len(roads[0].vehicle_ids), len(roads))))
        self.memory = CrossingMemory(zeros, zeros)
        radius = np.array([road.drawn_values["radius"] for road in roads])
        exact_arc = 1.5 * pi * radius
        arc = exact_arc.round(LANE_LENGTH_DIGITS)
        before = 2 * radius + CROSSING_LINK + 2 * INNER_LINK
        self._sides = [  # the direction with the right of way first
            _CrossingSide(*map(to_array, (start, radius, radius + link + arc)))
            for start, link in ((radius, OUTER_LINK), (before + arc + radius, INNER_LINK))
        ]
        self._sumo_loop_length = to_array(2 * (2 * radius + CROSSING_LINK + INNER_LINK + OUTER_LINK + arc))
        is_behind_arc = np.stack([road.start_positions for road in roads], 1) >= before + exact_arc
        self._position_offset = to_array(np.where(is_behind_arc, arc - exact_arc, 0.0))
        """position of each vehicle in SUMO minus its position on the exact road [m]"""

    def hand_over(self) -> None:
        """Hand the CAVs to their driver."""
        self._models = self._models_with_cavs

    def move(self, speed: Array, position: Array, leader: human_idm.Leader, noise: Array, cav_speeds: Array) -> Array:
        """Return the speeds after a step with `noise`; `cav_speeds` are commands, (CAVs, W), or None [m/s]."""
        commanded = clamp_min(self._human_model(speed, *leader) + noise, 0.0)
        lap_position = position % self._loop_length
        (major_start, major_end), (minor_start, minor_end) = self._crossings  # SUMO drives human vehicles there
        is_commanded = ((lap_position < major_start) | (major_end <= lap_position)) & (
            (lap_position < minor_start) | (minor_end <= lap_position)
        )
        if cav_speeds is not None:
            commanded[self._cav_indices], is_commanded[self._cav_indices] = cav_speeds, True
        return self._next_speeds(speed, position, leader, commanded, is_commanded)

    def distances_past(self, position: Array) -> list[Array]:
        """Return how far each vehicle is past the start of each side of the crossing, within one lap [m]."""
        sumo_position = position + self._position_offset
        return [(sumo_position - side.start) % self._sumo_loop_length for side in self._sides]

    def _next_speeds(
        self, speed: Array, position: Array, leader: human_idm.Leader, commanded_speed: Array, is_commanded: Array
    ) -> Array:
        """Return the speeds after a step [m/s], shape (vehicles, W), and update the memory."""
        xp, models = namespace(speed), self._models
        free_speed = xp.where(is_commanded, models.clip_speed(speed, commanded_speed), models.max_speed(speed))
        look_ahead = models.look_ahead_distance(speed)
        distances_past, (major_side, minor_side) = self.distances_past(position), self._sides
        is_visible = leader.gap <= self._visible_distance(look_ahead, distances_past)
        leader_speed = xp.where(is_visible, leader.speed, models.speed_limit)
        follow_speed = models.follow_speed(speed, leader_speed, xp.where(is_visible, leader.gap, human_idm.FREE_GAP))
        motion = speed, leader, free_speed, follow_speed, look_ahead
        major_last, minor_last = (_last_vehicle(speed, distance) for distance in distances_past)
        safe = xp.minimum(free_speed, follow_speed)
        for distance_past, foe in zip(distances_past, (minor_last, major_last), strict=True):
            safe = self._speed_on_crossing(speed, safe, distance_past, foe)
        to_major, to_minor = (self._sumo_loop_length - distance for distance in distances_past)
        major = self._approach(*motion, major_side, MAJOR_STOP_DISTANCE, to_major, major_last, minor_last)
        minor = self._approach(*motion, minor_side, MINOR_STOP_DISTANCE, to_minor, minor_last, major_last)
        safe = xp.where(major.is_approaching, major.go_speed, safe)
        safe = xp.where(minor.is_approaching, minor.stop_speed, safe)
        first = minor.distance.argmin(0), self._columns
        may_enter, can_brake = self._may_enter(speed, major, minor, first)
        # A vehicle that would have to slow down to enter, and can still stop before the crossing, stops.
        go_speed = minor.go_speed[first]
        usual_speed = xp.minimum(minor.approach_speed, models.max_speed(speed))[first]
        slows_down = go_speed + human_idm.SUMO_MIN_GAP < usual_speed
        slows_down = slows_down & can_brake & (go_speed < speed[first])
        stop_speed = xp.maximum(models.stop_speed(speed, minor.distance), models.min_speed(speed))[first]
        go_speed = xp.where(slows_down, xp.minimum(go_speed, stop_speed), go_speed)
        safe[first] = xp.where(may_enter, go_speed, safe[first])
        uncommanded = models.finalize_speed(speed, safe)
        uncommanded = uncommanded * (uncommanded > human_idm.STANDSTILL_ACCELERATION * self._step)
        commanded = models.clip_speed(speed, xp.minimum(commanded_speed, safe))
        next_speed = xp.where(is_commanded, commanded, uncommanded)
        self.update_memory(speed, next_speed, distances_past)
        return next_speed

    def _visible_distance(self, look_ahead: Array, distances_past: list[Array]) -> Array:
        """Return the distance up to which leaders are visible: the end of the last lane that SUMO considers [m]."""
        xp = namespace(look_ahead)
        visible = look_ahead + self._sumo_loop_length
        for side, distance_past in zip(self._sides, distances_past, strict=True):
            distance = self._sumo_loop_length - distance_past
            after = CROSSING_LINK + side.lane_length
            looks_past = (distance <= side.lane_length) | (distance <= look_ahead)
            to_end = xp.where(looks_past, distance + after, distance)
            visible = xp.where(distance <= side.approach_distance, to_end, visible)
            visible = xp.where(distance_past < CROSSING_LINK, after - distance_past, visible)
        return xp.where(visible <= look_ahead, look_ahead + self._sumo_loop_length, visible)

    def _approach(
        self,
        speed: Array,
        leader: human_idm.Leader,
        free_speed: Array,
        follow_speed: Array,
        look_ahead: Array,
        side: _CrossingSide,
        stop_distance: float,
        distance: Array,
        last: _Vehicle,
        foe: _Vehicle,
    ) -> _Approach:
        """Return the plans of all vehicles for one side; `last` and `foe` are the last vehicles on both sides."""
        xp, models, speed_limit = namespace(speed), self._models, self._models.speed_limit
        is_approaching, is_on_lane = distance <= side.approach_distance, distance <= side.lane_length
        front = xp.where(is_on_lane, -distance, self._sumo_loop_length - distance)
        rearmost = front.argmin(0)
        lane_front, lane_speed = front[rearmost, self._columns], speed[rearmost, self._columns]
        # A leader is on the lane of its rear bumper. Vehicles before the lane also see the last vehicle on the lane.
        is_leader_before_lane, is_leader_before = leader.gap <= distance - side.lane_length, leader.gap <= distance
        sees_lane = ~is_on_lane & (lane_front < VEHICLE_LENGTH)
        behind_lane = models.follow_speed(speed, lane_speed + 0.0 * speed, distance + lane_front - VEHICLE_LENGTH)
        before_lane = xp.where(is_leader_before_lane, xp.minimum(free_speed, follow_speed), free_speed)
        nearest = xp.where(is_leader_before, follow_speed, speed_limit)
        nearest = xp.where(sees_lane, xp.minimum(nearest, behind_lane), nearest)
        to_crossing = xp.minimum(free_speed, nearest)
        passing = clamp_max(speed_after_distance(xp.minimum(distance, side.lane_length), before_lane), speed_limit)
        passing = xp.minimum(passing, xp.where(is_on_lane, nearest, xp.where(sees_lane, behind_lane, speed_limit)))
        last_speed, gap = last.speed + 0.0 * speed, distance + last.front - VEHICLE_LENGTH
        looks = is_approaching & (is_on_lane | (distance <= look_ahead))
        is_occupied = looks & (last.front < CROSSING_LINK + VEHICLE_LENGTH)
        leaving = clamp_max(speed_after_distance(CROSSING_LINK + 0.0 * distance, passing), speed_limit)
        leaving_behind = xp.minimum(leaving, models.follow_speed(leaving, last_speed, gap))
        leaving = xp.where(is_occupied, leaving_behind, leaving)
        behind_last = models.follow_speed(speed, last_speed, gap)
        go_speed = xp.minimum(to_crossing, follow_speed)
        go_speed = xp.where(is_occupied, xp.minimum(go_speed, behind_last), go_speed)
        stop_gap = clamp_min(clamp_max(distance - models.brake_gap(speed), stop_distance), MINOR_STOP_DISTANCE)
        stop_speed = xp.minimum(to_crossing, models.stop_speed(speed, clamp_min(distance - stop_gap, 0.0)))
        stop_speed = xp.where(is_occupied, xp.minimum(stop_speed, behind_last), stop_speed)
        behind_foe = self._speed_behind_foe(speed, distance, foe)
        is_crossed = looks & (foe.front < CONFLICT_AREA_START + CROSSED_LANE_WIDTH + VEHICLE_LENGTH)
        go_speed = xp.where(is_crossed, xp.maximum(xp.minimum(go_speed, behind_foe), stop_speed), go_speed)
        leaving = xp.where(is_crossed, xp.minimum(leaving, behind_foe), leaving)
        arrival_time = models.arrival_time(distance, to_crossing, passing) - self._step
        mean_speed = clamp_min(0.5 * (passing + leaving), 1e-3)
        leave_time = arrival_time + (CROSSING_LINK + VEHICLE_LENGTH) / mean_speed
        return _Approach(distance, is_approaching, to_crossing, stop_speed, go_speed, arrival_time, leave_time)

    def _speed_behind_foe(self, speed: Array, distance: Array, foe: _Vehicle) -> Array:
        """Return the maximum speeds of vehicles that must wait for a foe on the crossing [m/s]."""
        xp, models, minimum_gap = namespace(speed), self._models, self._models.minimum_gap
        rear = CONFLICT_AREA_START - (foe.front - VEHICLE_LENGTH)
        to_area = distance + CONFLICT_AREA_START
        gap = to_area - rear - CROSSED_LANE_WIDTH
        safe = models.stop_speed(speed, clamp_min(distance - MINOR_STOP_DISTANCE, 0.0))
        follow_speed = models.follow_speed(speed, foe.speed + 0.0 * speed, gap)
        safe = xp.where(gap - minimum_gap >= 0.0, follow_speed, safe)
        stop_speed = models.stop_speed(speed, clamp_min(to_area - minimum_gap, 0.0))
        pass_time = clamp_min((minimum_gap + rear + CROSSED_LANE_WIDTH) / clamp_min(foe.speed, HALTING_SPEED), 1e-3)
        final = xp.maximum(speed, 2.0 * (to_area - minimum_gap) / pass_time - speed)
        drives_up = speed + (final - speed) / pass_time * self._step
        return xp.where(to_area >= 0.0, xp.maximum(safe, xp.minimum(drives_up, stop_speed)), safe)

    def _speed_on_crossing(self, speed: Array, safe_speed: Array, distance_past: Array, foe: _Vehicle) -> Array:
        """Return the maximum speeds of vehicles that just entered the crossing: earlier vehicles go first [m/s]."""
        xp = namespace(speed)
        is_before_area = distance_past < CONFLICT_AREA_START + MINOR_STOP_DISTANCE
        has_conflict = is_before_area & (foe.front < CONFLICT_AREA_START + CROSSED_LANE_WIDTH + VEHICLE_LENGTH)
        if not bool(has_conflict.any()):
            return safe_speed
        entry = self.memory.entry_step
        foe_entry = entry[foe.index, self._columns]
        is_foe_earlier = (entry > foe_entry) | ((entry == foe_entry) & (speed < foe.speed))
        is_foe_in_area = (foe.front > CONFLICT_AREA_START) & (distance_past < CONFLICT_AREA_START)
        yields = has_conflict & (is_foe_earlier | is_foe_in_area | (foe.front > CROSSING_LINK))
        behind_foe = self._speed_behind_foe(speed, -distance_past, foe)
        return xp.where(yields, xp.minimum(safe_speed, behind_foe), safe_speed)

    def _may_enter(
        self, speed: Array, major: _Approach, minor: _Approach, first: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return whether the first vehicle without right of way may enter, and whether it can still stop, (W,) each."""
        xp, models = namespace(speed), self._models
        distance, arrival, leave = minor.distance[first], minor.arrival_time[first], minor.leave_time[first]
        can_brake = (distance > models.brake_gap(speed)[first]) | (models.min_speed(speed)[first] == 0.0)
        impatience = clamp_max(self._impatience + self.memory.waiting_time[first] / IMPATIENCE_TIME, 1.0)
        impatience = xp.where(can_brake, impatience, 1.0)
        expected = major.arrival_time + impatience * self._foe_delay(major, arrival, impatience)
        expected = xp.where(arrival < major.arrival_time, expected, major.arrival_time)
        has_room = (major.leave_time < arrival) | (expected > leave + FOE_TIME_MARGIN)
        moves = major.approach_speed > human_idm.STANDSTILL_ACCELERATION * self._step
        is_blocked = (major.is_approaching & moves & ~has_room).any(0)
        return (distance <= FOE_VISIBILITY_DISTANCE) & minor.is_approaching[first] & ~is_blocked, can_brake

    def _foe_delay(self, major: _Approach, arrival_time: Array, impatience: Array) -> Array:
        """Return the delay of each foe if it starts to brake when the vehicle without right of way arrives [s]."""
        xp, step = namespace(arrival_time), self._step
        start = xp.ceil(arrival_time / step) * step
        is_same_step = xp.floor(arrival_time / step) == xp.floor(major.arrival_time / step)
        braking = clamp_min(self._models.braking * impatience, 1e-6)
        duration = major.arrival_time - start
        speed_drop = duration * braking
        lost_distance = duration * speed_drop / 2.0
        speed = major.distance / clamp_min(major.arrival_time + step, 1e-3)
        can_stop = 0.5 * speed * speed / braking <= major.distance - speed * start
        final_speed = speed - speed_drop
        root = square_root(clamp_min(4.0 * final_speed * final_speed - 8.0 * braking * lost_distance, 1e-12))
        delay = xp.where(can_stop, STOPPING_FOE_DELAY, (final_speed - 0.5 * root) / braking)
        return xp.where(is_same_step, 0.0, delay)

    def update_memory(self, speed: Array, next_speed: Array, distances_past: list[Array]) -> None:
        """Update the memory after a step; `distances_past` the crossing are those before the step."""
        xp, step = namespace(speed), self._step
        waits = (next_speed <= HALTING_SPEED) & (next_speed - speed <= MAX_WAITING_ACCELERATION * step)
        waiting_time, entry_step = (self.memory.waiting_time + step) * waits, self.memory.entry_step - 1.0
        for distance_past in distances_past:
            has_entered = self._sumo_loop_length - distance_past < next_speed * step
            entry_step = xp.where(has_entered, 0.0, entry_step)
        self.memory = CrossingMemory(waiting_time, entry_step)

    def replace_roads(self, roads: Any, source: "FigureEightMovement", source_roads: Any) -> None:
        """Continue on `roads` with `source_roads` of another batch."""
        for name in ("memory", "_crossings", "_loop_length", "_sides", "_sumo_loop_length", "_position_offset"):
            setattr(self, name, replace_columns(getattr(self, name), roads, getattr(source, name), source_roads))

    def restore_memory(self, memories: Sequence[CrossingMemory]) -> None:
        """Continue from the memory of each road, shape (vehicles,)."""
        self.memory = CrossingMemory(*(self._to_array(np.stack(values, 1)) for values in zip(*memories, strict=True)))


def crossing_memories(scenario: Scenario, road: ClosedRoad, speeds: Floats, positions: Floats) -> CrossingMemory:
    """Return the memory of the right of way in each step of an episode; all arrays have shape (steps, vehicles)."""
    movement = FigureEightMovement(scenario, [road], [], np.asarray)
    memories = [movement.memory]
    for speed, next_speed, position in zip(speeds, speeds[1:], positions, strict=False):
        movement.update_memory(speed[:, None], next_speed[:, None], movement.distances_past(position[:, None]))
        memories.append(movement.memory)
    return CrossingMemory(*(np.concatenate(values, 1).T for values in zip(*memories, strict=True)))


def may_follow_commands(
    scenario: Scenario,
    road: ClosedRoad,
    cav_indices: list[int],
    memories: CrossingMemory,
    motion: tuple[Floats, Floats],
    commanded_speeds: Floats,
) -> NDArray[np.bool_]:
    """Return whether the right of way allows commanded speeds; `motion` has speeds and positions.

    All arrays have shape (steps, vehicles).
    """
    speed, position, commanded = (values.T for values in (*motion, commanded_speeds))
    roads = [road] * len(commanded_speeds)
    movement = FigureEightMovement(scenario, roads, cav_indices, np.asarray, lambda *_: commanded)
    movement.hand_over()
    movement.restore_memory([CrossingMemory(*values) for values in zip(*memories, strict=True)])
    gap = gap_on_loop(position, np.roll(position, -1, 0), road.loop_length, VEHICLE_LENGTH)
    leader = human_idm.Leader(np.roll(speed, -1, 0), gap)
    new_speed = movement.move(speed, position, leader, 0.0, commanded[cav_indices])
    return (np.abs(new_speed - commanded) < COMMANDED_SPEED_TOLERANCE).T


def figure_eight_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch their leader on the same lane, or overlap on the crossing; see `ring_contacts`."""
    xp, lap_position = namespace(position), position % loop_length
    lengths, touches = lane_lengths(figure_eight_radius(loop_length)), gap < human_idm.CONTACT_GAP
    if bool(touches.any()):
        lane, end = 0.0 * lap_position, 0.0
        for length in lengths[:-1]:
            end = end + length
            lane = lane + (lap_position > end)
        touches = touches & (lane == xp.concatenate([lane[1:], lane[:1]]))
    area_start, area_end = CROSSING_LINK / 2 - CAR_WIDTH / 2, CROSSING_LINK / 2 + CAR_WIDTH / 2 + VEHICLE_LENGTH
    fronts = ((lap_position - start) % loop_length for start in (lengths[0], sum(lengths[:7])))
    first, second = ((front > area_start) & (front < area_end) for front in fronts)
    return touches | ((first | second) & (first.any(0) & second.any(0)))
