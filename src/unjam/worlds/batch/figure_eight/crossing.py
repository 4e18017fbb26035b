"""Who goes first where a figure eight crosses itself, as SUMO's right of way has it, for W roads at once.

Arrays have shape (vehicles, W). Sources: SUMO's MSVehicle (`planMoveInternal`, `checkLinkLeader`,
`adaptToJunctionLeader`, `processLinkApproaches`, `isLeader`) and MSLink (`opened`, `blockedByFoe`,
`computeFoeArrivalTimeBraking`, `getLeaderInfo`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, square_root
from unjam.scenarios.figure_eight import CROSSING_LINK
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import SUMO_ACCELERATION, VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.figure_eight.car_following import HALTING_SPEED, CarFollowingModels, speed_after_distance
from unjam.worlds.batch.figure_eight.geometry import CrossingSide, make_figure_eights
from unjam.worlds.batch.human_idm import STANDSTILL_ACCELERATION, SUMO_MIN_GAP
from unjam.worlds.batch.leaders import FREE_GAP, Leader
from unjam.worlds.batch.noise import ArrayFactory

FOE_VISIBILITY_DISTANCE = 4.5
"""way before the crossing from which those who must yield see who comes [m]"""
MINOR_STOP_DISTANCE, MAJOR_STOP_DISTANCE = 0.1, 1.0
"""way before the crossing at which vehicles stand that must wait [m]"""
FOE_TIME_MARGIN = 1.0
"""time that must be left before who has the right of way arrives [s]"""
IMPATIENCE_TIME = 300.0
"""time of waiting in which impatience grows by one [s]"""
MAX_WAITING_ACCELERATION = 0.5 * SUMO_ACCELERATION
"""acceleration up to which who stands waits [m/s2]"""
CROSSED_LANE_WIDTH = 3.2
"""of the lane that is crossed [m]"""
CONFLICT_AREA_START = CROSSING_LINK / 2.0 - CROSSED_LANE_WIDTH / 2.0
"""way from the beginning of the crossing to the other lane [m]"""
STOPPING_FOE_DELAY = 30.0
"""later than it would be by so much who can stand before the crossing [s]"""


class Approach(NamedTuple):
    """Those on their way to one side of the crossing, as SUMO plans their step."""

    distance: Array
    """to the crossing [m]; negative on it"""
    is_approaching: Array
    """whether SUMO expects each there"""
    approach_speed: Array
    """that the road up to the crossing allows in this step [m/s]"""
    stop_speed: Array
    """the same of who must wait [m/s]"""
    go_speed: Array
    """the same of who may go on [m/s]"""
    arrival_time: Array
    """when each arrives [s]"""
    leave_time: Array
    """when each has left [s]"""


class CrossingMemory(NamedTuple):
    """What one step leaves to the next; shape (vehicles, W), or (vehicles,) of one road."""

    waiting_time: Array
    """how long each has stood [s]"""
    entry_step: Array
    """when each came onto the crossing it is on or was on last, steps from now"""


def _last_vehicle(speed: Array, distance_past: Array) -> tuple[Array, Array, Array]:
    """Return where the front of the last vehicle beyond a crossing is, its speed and its place, (W,) each."""
    place = distance_past.argmin(0)
    columns = np.arange(distance_past.shape[1])
    return distance_past[place, columns], speed[place, columns], place


class Crossing:
    """The right of way of W figures eight; it remembers who waits, and since when each is on the crossing."""

    def __init__(self, scenario: Scenario, roads: Sequence[ClosedRoad], to_array: ArrayFactory) -> None:
        """Take roads that cross themselves once: first the way that goes first, then the one that yields."""
        self._figure_eights = make_figure_eights(roads, to_array)
        self._sumo_loop_length = self._figure_eights.loop_length
        self._crossings = to_array(np.transpose([road.crossings for road in roads], (1, 2, 0)))
        self._loop_length = to_array(np.array([road.loop_length for road in roads]))
        self._step, self._impatience = scenario.simulation_step, scenario.impatience
        self._to_array, self._columns = to_array, np.arange(len(roads))
        none = to_array(np.zeros((len(roads[0].vehicle_ids), len(roads))))
        self.memory = CrossingMemory(none, none)

    def is_on_crossing(self, position: Array) -> Array:
        """Return who is on the crossing, where SUMO drives people itself."""
        place = position % self._loop_length
        (first, end), (second, last) = self._crossings
        return ((first <= place) & (place < end)) | ((second <= place) & (place < last))

    def next_speeds(
        self,
        models: CarFollowingModels,
        speed: Array,
        position: Array,
        leader: Leader,
        commanded_speed: Array,
        is_commanded: Array,
    ) -> Array:
        """Return the speeds of a step, and remember it.

        Args:
            layer: how SUMO's own models drive.
            speed: [m/s].
            position: front bumpers along the road, wrapped or not [m].
            ahead: the vehicle ahead of each.
            wanted: speeds that are commanded [m/s].
            commanded: whom; SUMO drives the others.
        """
        xp, step = namespace(speed), self._step
        own = xp.where(is_commanded, models.clip_speed(speed, commanded_speed), models.max_speed(speed))
        sight = models.look_ahead_distance(speed)
        on, (major_side, minor_side, *_) = self._figure_eights.distances_past(position), self._figure_eights
        seen = leader.gap <= self._visible_distance(sight, on)
        follows = models.follow_speed(
            speed, xp.where(seen, leader.speed, models.speed_limit), xp.where(seen, leader.gap, FREE_GAP)
        )
        across = [_last_vehicle(speed, each) for each in on]
        safe = xp.minimum(own, follows)
        for beyond, (foe, foe_speed, foe_place) in zip(on, across[::-1], strict=True):
            safe = self._speed_on_crossing(models, speed, safe, beyond, foe, foe_speed, foe_place)
        major, minor = (
            self._approach(
                models, side, stop, speed, self._sumo_loop_length - beyond, leader, own, follows, sight, *ways
            )
            for side, stop, beyond, ways in (
                (major_side, MAJOR_STOP_DISTANCE, on[0], across),
                (minor_side, MINOR_STOP_DISTANCE, on[1], across[::-1]),
            )
        )
        safe = xp.where(major.is_approaching, major.go_speed, safe)
        safe = xp.where(minor.is_approaching, minor.stop_speed, safe)
        first = minor.distance.argmin(0), self._columns
        goes, can_brake = self._may_enter(models, speed, major, minor, first)
        # Who would have to slow down to go on, and can still stand before the crossing, does that.
        onward, now = minor.go_speed[first], speed[first]
        slows = onward + SUMO_MIN_GAP < xp.minimum(minor.approach_speed, models.max_speed(speed))[first]
        slows = slows & can_brake & (onward < now)
        stands = xp.maximum(models.stop_speed(speed, minor.distance), models.min_speed(speed))[first]
        onward = xp.where(slows, xp.minimum(onward, stands), onward)
        safe[first] = xp.where(goes, onward, safe[first])
        finished = models.finalize_speed(speed, safe)
        finished = finished * (finished > STANDSTILL_ACCELERATION * step)
        moved = xp.where(is_commanded, models.clip_speed(speed, xp.minimum(commanded_speed, safe)), finished)
        self._update_memory(speed, moved, on)
        return moved

    def record_step(self, speed: Array, next_speed: Array, position: Array) -> None:
        """Remember a step in which vehicles moved so; arguments as of `moved`."""
        self._update_memory(speed, next_speed, self._figure_eights.distances_past(position))

    def _visible_distance(self, look_ahead: Array, distances_past: list[Array]) -> Array:
        """Return how far ahead each sees others [m]: to the end of a lane beyond those it must look at."""
        xp = namespace(look_ahead)
        found = look_ahead + self._sumo_loop_length
        for side, beyond in zip(self._figure_eights[:2], distances_past, strict=True):
            way = self._sumo_loop_length - beyond
            after = CROSSING_LINK + side.lane_length
            across = xp.where((way <= side.lane_length) | (way <= look_ahead), way + after, way)
            found = xp.where(way <= side.approach_distance, across, found)
            found = xp.where(beyond < CROSSING_LINK, after - beyond, found)
        return xp.where(found <= look_ahead, look_ahead + self._sumo_loop_length, found)

    def _approach(
        self,
        models: CarFollowingModels,
        side: CrossingSide,
        stop_distance: float,
        speed: Array,
        distance: Array,
        leader: Leader,
        free_speed: Array,
        follow_speed: Array,
        look_ahead: Array,
        last_vehicle: tuple[Array, Array, Array],
        foe: tuple[Array, Array, Array],
    ) -> Approach:
        """Return how all come to one side; `is_present` is the last vehicle on it, `foe` that on the other one."""
        xp = namespace(speed)
        coming, on_lane = distance <= side.approach_distance, distance <= side.lane_length
        front = xp.where(on_lane, -distance, self._sumo_loop_length - distance)
        last = front.argmin(0)
        last_front, last_speed = front[last, self._columns], speed[last, self._columns]
        # The car ahead counts on the lane on which its rear bumper is; who is still before the lane also sees
        # the last car of it.
        before_lane, before_crossing = leader.gap <= distance - side.lane_length, leader.gap <= distance
        sees = ~on_lane & (last_front < VEHICLE_LENGTH)
        to_last = models.follow_speed(speed, last_speed + 0.0 * speed, distance + last_front - VEHICLE_LENGTH)
        before = xp.where(before_lane, xp.minimum(free_speed, follow_speed), free_speed)
        nearest = xp.where(before_crossing, follow_speed, models.speed_limit)
        nearest = xp.where(sees, xp.minimum(nearest, to_last), nearest)
        to_crossing = xp.minimum(free_speed, nearest)
        passing = clamp_max(speed_after_distance(xp.minimum(distance, side.lane_length), before), models.speed_limit)
        limiting = xp.where(on_lane, nearest, xp.where(sees, to_last, models.speed_limit))
        passing = xp.minimum(passing, limiting)
        there_front, there_speed, _ = last_vehicle
        gap = distance + there_front - VEHICLE_LENGTH
        looks = coming & (on_lane | (distance <= look_ahead))
        occupied = looks & (there_front < CROSSING_LINK + VEHICLE_LENGTH)
        leaving = clamp_max(speed_after_distance(CROSSING_LINK + 0.0 * distance, passing), models.speed_limit)
        leaving = xp.where(
            occupied, xp.minimum(leaving, models.follow_speed(leaving, there_speed + 0.0 * speed, gap)), leaving
        )
        beyond = xp.minimum(to_crossing, follow_speed)
        to_there = models.follow_speed(speed, there_speed + 0.0 * speed, gap)
        beyond = xp.where(occupied, xp.minimum(beyond, to_there), beyond)
        kept = clamp_min(clamp_max(distance - models.brake_gap(speed), stop_distance), MINOR_STOP_DISTANCE)
        waiting = xp.minimum(to_crossing, models.stop_speed(speed, clamp_min(distance - kept, 0.0)))
        waiting = xp.where(occupied, xp.minimum(waiting, to_there), waiting)
        foe_front, foe_speed, _ = foe
        behind = self._speed_behind_foe(models, speed, distance, foe_front, foe_speed)
        crossed = looks & (foe_front < CONFLICT_AREA_START + CROSSED_LANE_WIDTH + VEHICLE_LENGTH)
        beyond = xp.where(crossed, xp.maximum(xp.minimum(beyond, behind), waiting), beyond)
        leaving = xp.where(crossed, xp.minimum(leaving, behind), leaving)
        arrival = models.arrival_time(distance, to_crossing, passing) - self._step
        mean = clamp_min(0.5 * (passing + leaving), 1e-3)
        left = arrival + (CROSSING_LINK + VEHICLE_LENGTH) / mean
        return Approach(distance, coming, to_crossing, waiting, beyond, arrival, left)

    def _speed_behind_foe(
        self, models: CarFollowingModels, speed: Array, distance: Array, foe_front: Array, foe_speed: Array
    ) -> Array:
        """Return how fast each drives at most that must let somebody on the crossing pass [m/s]."""
        xp = namespace(speed)
        keeps = models.minimum_gap
        rear = CONFLICT_AREA_START - (foe_front - VEHICLE_LENGTH)
        to_area = distance + CONFLICT_AREA_START
        gap = to_area - rear - CROSSED_LANE_WIDTH
        free = gap - keeps >= 0.0
        safe = xp.where(
            free,
            models.follow_speed(speed, foe_speed + 0.0 * speed, gap),
            models.stop_speed(speed, clamp_min(distance - MINOR_STOP_DISTANCE, 0.0)),
        )
        stands = models.stop_speed(speed, clamp_min(to_area - keeps, 0.0))
        until_past = (keeps + rear + CROSSED_LANE_WIDTH) / clamp_min(foe_speed, HALTING_SPEED)
        until_past = clamp_min(until_past, 1e-3)
        final = xp.maximum(speed, 2.0 * (to_area - keeps) / until_past - speed)
        drives_up = speed + (final - speed) / until_past * self._step
        return xp.where(to_area >= 0.0, xp.maximum(safe, xp.minimum(drives_up, stands)), safe)

    def _speed_on_crossing(
        self,
        models: CarFollowingModels,
        speed: Array,
        safe_speed: Array,
        distance_past: Array,
        foe_front: Array,
        foe_speed: Array,
        foe_index: Array,
    ) -> Array:
        """Return how fast those drive who have just begun to cross: who came first goes first [m/s]."""
        xp = namespace(speed)
        early = (distance_past < CONFLICT_AREA_START + MINOR_STOP_DISTANCE) & (
            foe_front < CONFLICT_AREA_START + CROSSED_LANE_WIDTH + VEHICLE_LENGTH
        )
        if not bool(early.any()):
            return safe_speed
        entered = self.memory.entry_step
        came = entered[foe_index, self._columns]
        sooner = (entered > came) | ((entered == came) & (speed < foe_speed))
        in_the_way = (foe_front > CONFLICT_AREA_START) & (distance_past < CONFLICT_AREA_START)
        leads = early & (sooner | in_the_way | (foe_front > CROSSING_LINK))
        behind = self._speed_behind_foe(models, speed, -distance_past, foe_front, foe_speed)
        return xp.where(leads, xp.minimum(safe_speed, behind), safe_speed)

    def _may_enter(
        self,
        models: CarFollowingModels,
        speed: Array,
        major: Approach,
        minor: Approach,
        first_index: tuple[Array, Array],
    ) -> tuple[Array, Array]:
        """Return where the first of those who yield may go, and whether it can still stand, (W,) each."""
        xp, step = namespace(speed), self._step
        way, arrival, leaving = (each[first_index] for each in (minor.distance, minor.arrival_time, minor.leave_time))
        can_brake = (way > models.brake_gap(speed)[first_index]) | (models.min_speed(speed)[first_index] == 0.0)
        patience = clamp_max(self._impatience + self.memory.waiting_time[first_index] / IMPATIENCE_TIME, 1.0)
        impatience = xp.where(can_brake, patience, 1.0)
        expected = major.arrival_time + impatience * self._foe_delay(models, major, arrival, impatience)
        expected = xp.where(arrival < major.arrival_time, expected, major.arrival_time)
        passes = (major.leave_time < arrival) | (expected > leaving + FOE_TIME_MARGIN)
        blocks = major.is_approaching & (major.approach_speed > STANDSTILL_ACCELERATION * step) & ~passes
        return (way <= FOE_VISIBILITY_DISTANCE) & minor.is_approaching[first_index] & ~blocks.any(0), can_brake

    def _foe_delay(self, models: CarFollowingModels, major: Approach, arrival_time: Array, impatience: Array) -> Array:
        """Return how much later each would arrive who begins to brake as another one does [s]."""
        xp, step = namespace(arrival_time), self._step
        begin = xp.ceil(arrival_time / step) * step
        same = xp.floor(arrival_time / step) == xp.floor(major.arrival_time / step)
        braking = clamp_min(models.braking * impatience, 1e-6)
        lasting = major.arrival_time - begin
        change = lasting * braking
        saved = lasting * change / 2.0
        speed = major.distance / clamp_min(major.arrival_time + step, 1e-3)
        stands = 0.5 * speed * speed / braking <= major.distance - speed * begin
        left = speed - change
        root = square_root(clamp_min(4.0 * left * left - 8.0 * braking * saved, 1e-12))
        longer = (left - 0.5 * root) / braking
        return xp.where(same, 0.0, xp.where(stands, STOPPING_FOE_DELAY, longer))

    def _update_memory(self, speed: Array, next_speed: Array, distances_past: list[Array]) -> None:
        """Note who waits, and who is on the crossing since when."""
        xp, step = namespace(speed), self._step
        stands = (next_speed <= HALTING_SPEED) & (next_speed - speed <= MAX_WAITING_ACCELERATION * step)
        waited, entered = (self.memory.waiting_time + step) * stands, self.memory.entry_step - 1.0
        for beyond in distances_past:
            entered = xp.where(self._sumo_loop_length - beyond < next_speed * step, 0.0, entered)
        self.memory = CrossingMemory(waited, entered)

    def restore_memory(self, memories: Sequence["CrossingMemory"]) -> None:
        """Go on from what earlier steps left, road by road, shape (vehicles,) each."""
        self.memory = CrossingMemory(*(self._to_array(np.stack(each, 1)) for each in zip(*memories, strict=True)))
