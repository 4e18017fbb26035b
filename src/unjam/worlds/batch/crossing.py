"""Who goes first where a figure eight crosses itself, as SUMO's right of way has it, for W roads at once.

Arrays have shape (vehicles, W). Sources: SUMO's MSVehicle (`planMoveInternal`, `checkLinkLeader`,
`adaptToJunctionLeader`, `processLinkApproaches`, `isLeader`) and MSLink (`opened`, `blockedByFoe`,
`computeFoeArrivalTimeBraking`, `getLeaderInfo`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, at_least, at_most, namespace, square_root
from unjam.scenarios.figure_eight import CROSSING_LINK
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import ACCELERATION, VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.eight import Side, eights_of
from unjam.worlds.batch.lanes import NOBODY, Leader
from unjam.worlds.batch.layer import HALTING, Layer, speed_after
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.people import CREEPING, SMALLEST_GAP

VISIBLE = 4.5
"""way before the crossing from which those who must yield see who comes [m]"""
MINOR_STOP, MAJOR_STOP = 0.1, 1.0
"""way before the crossing at which vehicles stand that must wait [m]"""
LOOK_AHEAD = 1.0
"""time that must be left before who has the right of way arrives [s]"""
TO_IMPATIENCE = 300.0
"""time of waiting in which impatience grows by one [s]"""
WAITING = 0.5 * ACCELERATION
"""acceleration up to which who stands waits [m/s2]"""
WIDTH = 3.2
"""of the lane that is crossed [m]"""
AREA = CROSSING_LINK / 2.0 - WIDTH / 2.0
"""way from the beginning of the crossing to the other lane [m]"""
NEVER = 30.0
"""later than it would be by so much who can stand before the crossing [s]"""


class Approach(NamedTuple):
    """Those on their way to one side of the crossing, as SUMO plans their step."""

    way: Array
    """to the crossing [m]; negative on it"""
    coming: Array
    """whether SUMO expects each there"""
    speed: Array
    """that the road up to the crossing allows in this step [m/s]"""
    waiting: Array
    """the same of who must wait [m/s]"""
    beyond: Array
    """the same of who may go on [m/s]"""
    arrival: Array
    """when each arrives [s]"""
    leaving: Array
    """when each has left [s]"""


class Memory(NamedTuple):
    """What one step leaves to the next; shape (vehicles, W), or (vehicles,) of one road."""

    waited: Array
    """how long each has stood [s]"""
    entered: Array
    """when each came onto the crossing it is on or was on last, steps from now"""


def _last_on(speed: Array, beyond: Array) -> tuple[Array, Array, Array]:
    """Return where the front of the last vehicle beyond a crossing is, its speed and its place, (W,) each."""
    place = beyond.argmin(0)
    columns = np.arange(beyond.shape[1])
    return beyond[place, columns], speed[place, columns], place


class Crossing:
    """The right of way of W figures eight; it remembers who waits, and since when each is on the crossing."""

    def __init__(self, scenario: Scenario, roads: Sequence[ClosedRoad], numbers: Numbers) -> None:
        """Take roads that cross themselves once: first the way that goes first, then the one that yields."""
        self._eights = eights_of(roads, numbers)
        self._loop = self._eights.loop
        self._crossings = numbers(np.transpose([road.crossings for road in roads], (1, 2, 0)))
        self._road = numbers(np.array([road.loop_length for road in roads]))
        self._step, self._impatience = scenario.simulation_step, scenario.impatience
        self._numbers, self._columns = numbers, np.arange(len(roads))
        none = numbers(np.zeros((len(roads[0].vehicle_ids), len(roads))))
        self.memory = Memory(none, none)

    def inside(self, position: Array) -> Array:
        """Return who is on the crossing, where SUMO drives people itself."""
        place = position % self._road
        (first, end), (second, last) = self._crossings
        return ((first <= place) & (place < end)) | ((second <= place) & (place < last))

    def moved(
        self, layer: Layer, speed: Array, position: Array, ahead: Leader, wanted: Array, commanded: Array
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
        own = xp.where(commanded, layer.within_limits(speed, wanted), layer.fastest(speed))
        sight = layer.sight(speed)
        on, (major_side, minor_side, *_) = self._eights.beyond(position), self._eights
        seen = ahead.gap <= self._seen(sight, on)
        follows = layer.follow(
            speed, xp.where(seen, ahead.speed, layer.top), xp.where(seen, ahead.gap, NOBODY)
        )
        across = [_last_on(speed, each) for each in on]
        safe = xp.minimum(own, follows)
        for beyond, (foe, foe_speed, foe_place) in zip(on, across[::-1], strict=True):
            safe = self._on_crossing(layer, speed, safe, beyond, foe, foe_speed, foe_place)
        major, minor = (
            self._approach(layer, side, stop, speed, self._loop - beyond, ahead, own, follows, sight, *ways)
            for side, stop, beyond, ways in (
                (major_side, MAJOR_STOP, on[0], across),
                (minor_side, MINOR_STOP, on[1], across[::-1]),
            )
        )
        safe = xp.where(major.coming, major.beyond, safe)
        safe = xp.where(minor.coming, minor.waiting, safe)
        first = minor.way.argmin(0), self._columns
        goes, can_brake = self._opened(layer, speed, major, minor, first)
        # Who would have to slow down to go on, and can still stand before the crossing, does that.
        onward, now = minor.beyond[first], speed[first]
        slows = onward + SMALLEST_GAP < xp.minimum(minor.speed, layer.fastest(speed))[first]
        slows = slows & can_brake & (onward < now)
        stands = xp.maximum(layer.stop(speed, minor.way), layer.slowest(speed))[first]
        onward = xp.where(slows, xp.minimum(onward, stands), onward)
        safe[first] = xp.where(goes, onward, safe[first])
        finished = layer.finished(speed, safe)
        finished = finished * (finished > CREEPING * step)
        moved = xp.where(commanded, layer.within_limits(speed, xp.minimum(wanted, safe)), finished)
        self._remember(speed, moved, on)
        return moved

    def watch(self, speed: Array, moved: Array, position: Array) -> None:
        """Remember a step in which vehicles moved so; arguments as of `moved`."""
        self._remember(speed, moved, self._eights.beyond(position))

    def _seen(self, sight: Array, on: list[Array]) -> Array:
        """Return how far ahead each sees others [m]: to the end of a lane beyond those it must look at."""
        xp = namespace(sight)
        found = sight + self._loop
        for side, beyond in zip(self._eights[:2], on, strict=True):
            way = self._loop - beyond
            after = CROSSING_LINK + side.lane
            across = xp.where((way <= side.lane) | (way <= sight), way + after, way)
            found = xp.where(way <= side.seen, across, found)
            found = xp.where(beyond < CROSSING_LINK, after - beyond, found)
        return xp.where(found <= sight, sight + self._loop, found)

    def _approach(
        self,
        layer: Layer,
        side: Side,
        stop: float,
        speed: Array,
        way: Array,
        ahead: Leader,
        own: Array,
        follows: Array,
        sight: Array,
        there: tuple[Array, Array, Array],
        foe: tuple[Array, Array, Array],
    ) -> Approach:
        """Return how all come to one side; `there` is the last vehicle on it, `foe` that on the other one."""
        xp = namespace(speed)
        coming, on_lane = way <= side.seen, way <= side.lane
        front = xp.where(on_lane, -way, self._loop - way)
        last = front.argmin(0)
        last_front, last_speed = front[last, self._columns], speed[last, self._columns]
        # The car ahead counts on the lane on which its rear bumper is; who is still before the lane also sees
        # the last car of it.
        before_lane, before_crossing = ahead.gap <= way - side.lane, ahead.gap <= way
        sees = ~on_lane & (last_front < VEHICLE_LENGTH)
        to_last = layer.follow(speed, last_speed + 0.0 * speed, way + last_front - VEHICLE_LENGTH)
        before = xp.where(before_lane, xp.minimum(own, follows), own)
        nearest = xp.where(before_crossing, follows, layer.top)
        nearest = xp.where(sees, xp.minimum(nearest, to_last), nearest)
        to_crossing = xp.minimum(own, nearest)
        passing = at_most(speed_after(xp.minimum(way, side.lane), before), layer.top)
        limiting = xp.where(on_lane, nearest, xp.where(sees, to_last, layer.top))
        passing = xp.minimum(passing, limiting)
        there_front, there_speed, _ = there
        gap = way + there_front - VEHICLE_LENGTH
        looks = coming & (on_lane | (way <= sight))
        occupied = looks & (there_front < CROSSING_LINK + VEHICLE_LENGTH)
        leaving = at_most(speed_after(CROSSING_LINK + 0.0 * way, passing), layer.top)
        leaving = xp.where(
            occupied, xp.minimum(leaving, layer.follow(leaving, there_speed + 0.0 * speed, gap)), leaving
        )
        beyond = xp.minimum(to_crossing, follows)
        to_there = layer.follow(speed, there_speed + 0.0 * speed, gap)
        beyond = xp.where(occupied, xp.minimum(beyond, to_there), beyond)
        kept = at_least(at_most(way - layer.brake_gap(speed), stop), MINOR_STOP)
        waiting = xp.minimum(to_crossing, layer.stop(speed, at_least(way - kept, 0.0)))
        waiting = xp.where(occupied, xp.minimum(waiting, to_there), waiting)
        foe_front, foe_speed, _ = foe
        behind = self._behind_foe(layer, speed, way, foe_front, foe_speed)
        crossed = looks & (foe_front < AREA + WIDTH + VEHICLE_LENGTH)
        beyond = xp.where(crossed, xp.maximum(xp.minimum(beyond, behind), waiting), beyond)
        leaving = xp.where(crossed, xp.minimum(leaving, behind), leaving)
        arrival = layer.arrival(way, to_crossing, passing) - self._step
        mean = at_least(0.5 * (passing + leaving), 1e-3)
        left = arrival + (CROSSING_LINK + VEHICLE_LENGTH) / mean
        return Approach(way, coming, to_crossing, waiting, beyond, arrival, left)

    def _behind_foe(
        self, layer: Layer, speed: Array, way: Array, foe_front: Array, foe_speed: Array
    ) -> Array:
        """Return how fast each drives at most that must let somebody on the crossing pass [m/s]."""
        xp = namespace(speed)
        keeps = layer.keeps
        rear = AREA - (foe_front - VEHICLE_LENGTH)
        to_area = way + AREA
        gap = to_area - rear - WIDTH
        free = gap - keeps >= 0.0
        safe = xp.where(
            free,
            layer.follow(speed, foe_speed + 0.0 * speed, gap),
            layer.stop(speed, at_least(way - MINOR_STOP, 0.0)),
        )
        stands = layer.stop(speed, at_least(to_area - keeps, 0.0))
        until_past = (keeps + rear + WIDTH) / at_least(foe_speed, HALTING)
        until_past = at_least(until_past, 1e-3)
        final = xp.maximum(speed, 2.0 * (to_area - keeps) / until_past - speed)
        drives_up = speed + (final - speed) / until_past * self._step
        return xp.where(to_area >= 0.0, xp.maximum(safe, xp.minimum(drives_up, stands)), safe)

    def _on_crossing(
        self,
        layer: Layer,
        speed: Array,
        safe: Array,
        beyond: Array,
        foe_front: Array,
        foe_speed: Array,
        foe_place: Array,
    ) -> Array:
        """Return how fast those drive who have just begun to cross: who came first goes first [m/s]."""
        xp = namespace(speed)
        early = (beyond < AREA + MINOR_STOP) & (foe_front < AREA + WIDTH + VEHICLE_LENGTH)
        if not bool(early.any()):
            return safe
        entered = self.memory.entered
        came = entered[foe_place, self._columns]
        sooner = (entered > came) | ((entered == came) & (speed < foe_speed))
        in_the_way = (foe_front > AREA) & (beyond < AREA)
        leads = early & (sooner | in_the_way | (foe_front > CROSSING_LINK))
        behind = self._behind_foe(layer, speed, -beyond, foe_front, foe_speed)
        return xp.where(leads, xp.minimum(safe, behind), safe)

    def _opened(
        self, layer: Layer, speed: Array, major: Approach, minor: Approach, first: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return where the first of those who yield may go, and whether it can still stand, (W,) each."""
        xp, step = namespace(speed), self._step
        way, arrival, leaving = (each[first] for each in (minor.way, minor.arrival, minor.leaving))
        can_brake = (way > layer.brake_gap(speed)[first]) | (layer.slowest(speed)[first] == 0.0)
        patience = at_most(self._impatience + self.memory.waited[first] / TO_IMPATIENCE, 1.0)
        impatience = xp.where(can_brake, patience, 1.0)
        expected = major.arrival + impatience * self._delay(layer, major, arrival, impatience)
        expected = xp.where(arrival < major.arrival, expected, major.arrival)
        passes = (major.leaving < arrival) | (expected > leaving + LOOK_AHEAD)
        blocks = major.coming & (major.speed > CREEPING * step) & ~passes
        return (way <= VISIBLE) & minor.coming[first] & ~blocks.any(0), can_brake

    def _delay(self, layer: Layer, major: Approach, arrival: Array, impatience: Array) -> Array:
        """Return how much later each would arrive who begins to brake as another one does [s]."""
        xp, step = namespace(arrival), self._step
        begin = xp.ceil(arrival / step) * step
        same = xp.floor(arrival / step) == xp.floor(major.arrival / step)
        braking = at_least(layer.braking * impatience, 1e-6)
        lasting = major.arrival - begin
        change = lasting * braking
        saved = lasting * change / 2.0
        speed = major.way / at_least(major.arrival + step, 1e-3)
        stands = 0.5 * speed * speed / braking <= major.way - speed * begin
        left = speed - change
        root = square_root(at_least(4.0 * left * left - 8.0 * braking * saved, 1e-12))
        longer = (left - 0.5 * root) / braking
        return xp.where(same, 0.0, xp.where(stands, NEVER, longer))

    def _remember(self, speed: Array, moved: Array, on: list[Array]) -> None:
        """Note who waits, and who is on the crossing since when."""
        xp, step = namespace(speed), self._step
        stands = (moved <= HALTING) & (moved - speed <= WAITING * step)
        waited, entered = (self.memory.waited + step) * stands, self.memory.entered - 1.0
        for beyond in on:
            entered = xp.where(self._loop - beyond < moved * step, 0.0, entered)
        self.memory = Memory(waited, entered)

    def remember(self, memory: Sequence["Memory"]) -> None:
        """Go on from what earlier steps left, road by road, shape (vehicles,) each."""
        self.memory = Memory(*(self._numbers(np.stack(each, 1)) for each in zip(*memory, strict=True)))
