"""The vehicles of W motorways in one table, each road's from front to back, and who drives beside whom.

Arrays have shape (n,) of all n vehicles that are on a road now, units are m/s, m and s.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from unjam.physics.arrays import Array, at_least, at_most, namespace, running_maximum, square_root
from unjam.physics.idm import IDMRows, by_squaring, desired_gap, idm_acceleration
from unjam.physics.kinematics import next_speed, stopping_distance
from unjam.worlds.batch import extended
from unjam.worlds.batch.extended import Ahead, Errors, Wish
from unjam.worlds.batch.people import SMALLEST_GAP

NOBODY = -1
PER_ROAD = 100_000
"""more than want to enter a road in an episode"""
FREELY = 1e6
"""what nobody is told, an acceleration [m/s2]"""
NO_ROOM = 0.01
"""way below which an IDM stands [m]"""


class Vehicles(NamedTuple):
    """All vehicles."""

    road: Array
    """number of the road, an integer"""
    entry: Array
    """which of those who want to enter it is, an integer"""
    way: Array
    """0 is the ramp's, the others are the motorway's lanes from right to left, an integer"""
    place: Array
    """of the front bumper along the road [m]"""
    speed: Array
    acceleration: Array
    """of the last step [m/s2]"""
    time_headway: Array
    most: Array
    """highest acceleration [m/s2]"""
    braking: Array
    """comfortable [m/s2]"""
    gap: Array
    """that is kept at a standstill"""
    factor: Array
    """wanted speed over what a lane allows"""
    extended: Array
    """whether an extended intelligent driver drives; the others are IDMs"""
    cap: Array
    """speed that it may not exceed"""
    wish: Array
    """speed that it wants here: what an extended driver gets used to when the limit rises"""
    started: Array
    """when it last began to start [s]"""
    gap_error: Array
    leader_error: Array
    driving_error: Array
    gain: Array
    """how much it would gain, summed up, on the left; negative on the right"""
    keep: Array
    """how much it ought to keep right, summed up"""
    look: Array
    """speed with which it looks ahead for a change that it must make"""
    own_advice: Array
    """acceleration by which it helps its own change [m/s2]; `FREELY`: none"""
    told_advice: Array
    """by which it helps somebody else's"""
    beside_advice: Array
    """by which it does not pass somebody on the right, or lets in who stands"""
    leans: Array
    """half way to the fastest that is safe, 1, or the slowest, -1, for the sake of a change; 0: neither"""

    def each(self, function: Callable[..., Any], *others: "Vehicles") -> "Vehicles":
        """Return `function` of each column."""
        return Vehicles(*(function(*values) for values in zip(self, *others, strict=True)))

    def at(self, index: Array) -> "Vehicles":
        """Return some of them, or all in another order."""
        return self.each(lambda values: values[index])

    @property
    def drivers(self) -> "Drivers":
        """How they follow."""
        wish = namespace(self.speed).minimum(self.wish, self.cap)
        people = IDMRows(wish, self.time_headway, self.most, self.braking, 4.0, self.gap)
        errors = Errors(self.gap_error, self.leader_error, self.driving_error)
        return Drivers(people, errors, self.extended)


class Drivers(NamedTuple):
    """How n vehicles follow, be they extended intelligent drivers or SUMO's IDM."""

    people: IDMRows
    errors: Errors
    extended: Array

    def at(self, index: Array) -> "Drivers":
        """Return some of them."""
        people = IDMRows(*(each if each is self.people.exponent else each[index] for each in self.people))
        return Drivers(people, Errors(*(each[index] for each in self.errors)), self.extended[index])

    def follow(
        self, speed: Array, gap: Array, leader_speed: Array, step: float, ahead: Ahead | None = None
    ) -> Array:
        """Return the speeds they want after a step, `gap` to the leaders' bumpers."""
        return self.wish(speed, gap, leader_speed, step, ahead).speed

    def wish(
        self, speed: Array, gap: Array, leader_speed: Array, step: float, ahead: Ahead | None = None
    ) -> Wish:
        """Return the same, and how urgent it is."""
        one, urgent = extended.follow(speed, gap, leader_speed, self.people, self.errors, step, ahead)
        found = self._or_idm(one, _idm_follow, speed, gap, leader_speed, step=step)
        xp = namespace(found)
        return Wish(found, xp.where(self.extended, urgent, (found - speed) / step))

    def stop(self, speed: Array, way: Array, step: float) -> Array:
        """Return the speeds they want after a step who must stand within a way."""
        one = extended.stop(speed, way, self.people, self.errors, step)
        return self._or_idm(one, _idm_stop, speed, way, step=step)

    def secure_gap(self, speed: Array, leader_speed: Array) -> Array:
        """Return the gap beyond the smallest one that is left when lanes are changed."""
        one = extended.secure_gap(speed, leader_speed, self.people)
        return self._or_idm(one, _idm_secure_gap, speed, leader_speed)

    def safe_speed(self, gap: Array, leader_speed: Array, its_braking: Array, step: float) -> Array:
        """Return the highest speed from which they can stand behind leaders who brake, a time headway later.

        Source: SUMO's MSCFModel (`maximumSafeFollowSpeed`), of any driver; all stand a gap behind the leader.
        """
        xp, braking = namespace(gap), self.people.comfortable_deceleration
        change, late = braking * step, self.people.time_headway / step
        way = stopping_distance(leader_speed, xp.maximum(braking, its_braking), step)
        room = (at_least(gap, 0.0) + way) / step
        # n whole steps of braking from v = n b h + r take n b h ((n - 1) / 2 + late) + (n + late) r = room.
        steps = xp.floor(0.5 - late + square_root(0.25 + late * (late - 1.0) + 2.0 * room / change))
        rest = room - change * steps * ((steps - 1.0) / 2.0 + late)
        return change * steps + rest / (steps + late)

    def brake_gap(self, speed: Array, step: float) -> Array:
        """Return the way in which they can stand, after their time headway."""
        people = self.people
        return stopping_distance(speed, people.comfortable_deceleration, step) + speed * people.time_headway

    def _or_idm(self, found: Array, idm: Callable[..., Array], *values: Array, **facts: float) -> Array:
        """Return what extended drivers do, and for the others what IDMs do."""
        others = ~self.extended
        if not bool(others.any()):
            return found
        there = self.at(others)
        found = found + 0.0
        found[others] = idm(*(each[others] for each in values), there.people, **facts)
        return found


def _idm_follow(speed: Array, gap: Array, leader_speed: Array, people: IDMRows, step: float) -> Array:
    each = step / extended.THINKS
    for _ in range(extended.THINKS):
        told = idm_acceleration(speed, leader_speed, at_least(gap, SMALLEST_GAP), people, by_squaring)
        speed = next_speed(speed, told, each)
        gap = gap - at_least(speed - leader_speed, 0.0) * each
    return speed


def _idm_stop(speed: Array, way: Array, people: IDMRows, step: float) -> Array:
    near = people._replace(minimum_gap=0.0 * people.minimum_gap)
    return _idm_follow(speed, way, 0.0 * speed, near, step) * (way >= NO_ROOM)


def _idm_secure_gap(speed: Array, leader_speed: Array, people: IDMRows) -> Array:
    return desired_gap(speed, speed - leader_speed, people) - people.minimum_gap


class Around(NamedTuple):
    """Who is next to each vehicle on each way, as numbers of rows, shape (ways, n); `NOBODY` where none."""

    ahead: Array
    behind: Array


def number_of(vehicles: Vehicles) -> Array:
    """Return road and entry of each as one number."""
    return vehicles.road * PER_ROAD + vehicles.entry


def rows_of(numbers: Array, vehicles: Vehicles) -> Array:
    """Return the rows of vehicles of certain numbers; `NOBODY` where one is not among them."""
    there, xp = number_of(vehicles), namespace(vehicles.road)
    if not len(there):
        return 0 * numbers + NOBODY
    order = there.argsort()
    found = order[xp.searchsorted(there[order], numbers).clip(0, len(there) - 1)]
    return xp.where(there[found] == numbers, found, NOBODY)


def in_order(vehicles: Vehicles) -> Vehicles:
    """Return vehicles road by road, from front to back."""
    key = vehicles.road * 1e6 - vehicles.place
    if bool((key[1:] >= key[:-1]).all()):
        return vehicles
    return vehicles.at(key.argsort(stable=True))


def around(vehicles: Vehicles, ways: int) -> Around:
    """Return who is next to whom; vehicles stand in order."""
    road, xp = vehicles.road, namespace(vehicles.place)
    count = len(road)
    rows = xp.arange(count)
    ahead, behind = [], []
    for way in range(ways):
        there = vehicles.way == way
        ahead.append(_last_before(there, rows, road, xp))
        back = _last_before(_reversed(there, xp), rows, _reversed(road, xp), xp)
        back = _reversed(back, xp)
        behind.append(xp.where(back >= 0, count - 1 - back, NOBODY))
    return Around(xp.stack(ahead), xp.stack(behind))


def _reversed(values: Array, xp: Any) -> Array:
    return xp.flip(values, (0,))


def _last_before(there: Array, rows: Array, road: Array, xp: Any) -> Array:
    """Return the last row before each where something is there, on the same road."""
    last = running_maximum(xp.where(there, rows, NOBODY))
    before = xp.concatenate([last[:1] * 0 + NOBODY, last[:-1]])
    same = (before >= 0) & (road[before] == road)
    return xp.where(same, before, NOBODY)


def chosen(neighbours: Array, way: Array) -> Array:
    """Return of each row its neighbour on a way of its own; `NOBODY` for a way that is not there."""
    xp, ways = namespace(neighbours), neighbours.shape[0]
    rows = xp.arange(neighbours.shape[1])
    found = neighbours[at_most(at_least(way, 0), ways - 1), rows]
    return xp.where((way >= 0) & (way < ways), found, NOBODY)
