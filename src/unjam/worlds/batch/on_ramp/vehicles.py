"""The vehicles of W motorways in one table, each road's from front to back, and who drives beside whom.

Arrays have shape (n,) of all n vehicles that are on a road now, units are m/s, m and s.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, running_maximum, square_root
from unjam.physics.idm import IDMArrays, desired_gap, fast_power, idm_acceleration
from unjam.physics.kinematics import next_speed, stopping_distance
from unjam.worlds.batch.human_idm import SUMO_MIN_GAP
from unjam.worlds.batch.on_ramp import eidm
from unjam.worlds.batch.on_ramp.eidm import DesiredSpeed, DriverErrors, LeaderMotion

NO_VEHICLE = -1
NUMBERS_PER_ROAD = 100_000
"""more than want to enter a road in an episode"""
NO_ADVICE = 1e6
"""what nobody is told, an acceleration [m/s2]"""
MIN_IDM_STOP_DISTANCE = 0.01
"""way below which an IDM stands [m]"""


class MotorwayVehicles(NamedTuple):
    """All vehicles."""

    road: Array
    """number of the road, an integer"""
    entry: Array
    """which of those who want to enter it is, an integer"""
    lane: Array
    """0 is the ramp's, the others are the motorway's lanes from right to left, an integer"""
    position: Array
    """of the front bumper along the road [m]"""
    speed: Array
    acceleration: Array
    """of the last step [m/s2]"""
    time_headway: Array
    max_acceleration: Array
    """highest acceleration [m/s2]"""
    braking: Array
    """comfortable [m/s2]"""
    minimum_gap: Array
    """that is kept at a standstill"""
    speed_factor: Array
    """wanted speed over what a lane allows"""
    is_eidm: Array
    """whether an extended intelligent driver drives; the others are IDMs"""
    speed_cap: Array
    """speed that it may not exceed"""
    desired_speed: Array
    """speed that it wants here: what an extended driver gets used to when the limit rises"""
    start_time: Array
    """when it last began to start [s]"""
    gap_error: Array
    leader_error: Array
    driving_error: Array
    speed_gain: Array
    """how much it would gain, summed up, on the left; negative on the right"""
    keep_right: Array
    """how much it ought to keep right, summed up"""
    look_ahead_speed: Array
    """speed with which it looks ahead for a change that it must make"""
    own_advice: Array
    """acceleration by which it helps its own change [m/s2]; `FREELY`: none"""
    cooperative_advice: Array
    """by which it helps somebody else's"""
    adjacent_advice: Array
    """by which it does not pass somebody on the right, or lets in who stands"""
    speed_bias: Array
    """half way to the fastest that is safe, 1, or the slowest, -1, for the sake of a change; 0: neither"""

    def map(self, function: Callable[..., Any], *others: "MotorwayVehicles") -> "MotorwayVehicles":
        """Return `function` of each column."""
        return MotorwayVehicles(*(function(*values) for values in zip(self, *others, strict=True)))

    def select(self, index: Array) -> "MotorwayVehicles":
        """Return some of them, or all in another order."""
        return self.map(lambda values: values[index])

    @property
    def drivers(self) -> "MotorwayDrivers":
        """How they follow."""
        wish = namespace(self.speed).minimum(self.desired_speed, self.speed_cap)
        people = IDMArrays(wish, self.time_headway, self.max_acceleration, self.braking, 4.0, self.minimum_gap)
        errors = DriverErrors(self.gap_error, self.leader_error, self.driving_error)
        return MotorwayDrivers(people, errors, self.is_eidm)


class MotorwayDrivers(NamedTuple):
    """How n vehicles follow, be they extended intelligent drivers or SUMO's IDM."""

    parameters: IDMArrays
    errors: DriverErrors
    is_eidm: Array

    def select(self, index: Array) -> "MotorwayDrivers":
        """Return some of them."""
        people = IDMArrays(*(each if each is self.parameters.exponent else each[index] for each in self.parameters))
        return MotorwayDrivers(people, DriverErrors(*(each[index] for each in self.errors)), self.is_eidm[index])

    def follow_speed(
        self, speed: Array, gap: Array, leader_speed: Array, step: float, leader_motion: LeaderMotion | None = None
    ) -> Array:
        """Return the speeds they want after a step, `gap` to the leaders' bumpers."""
        return self.desired_speed(speed, gap, leader_speed, step, leader_motion).speed

    def desired_speed(
        self, speed: Array, gap: Array, leader_speed: Array, step: float, leader_motion: LeaderMotion | None = None
    ) -> DesiredSpeed:
        """Return the same, and how urgent it is."""
        one, urgent = eidm.eidm_follow_speed(
            speed, gap, leader_speed, self.parameters, self.errors, step, leader_motion
        )
        found = self._eidm_or_idm(one, _idm_follow_speed, speed, gap, leader_speed, step=step)
        xp = namespace(found)
        return DesiredSpeed(found, xp.where(self.is_eidm, urgent, (found - speed) / step))

    def stop_speed(self, speed: Array, distance: Array, step: float) -> Array:
        """Return the speeds they want after a step who must stand within a way."""
        one = eidm.eidm_stop_speed(speed, distance, self.parameters, self.errors, step)
        return self._eidm_or_idm(one, _idm_stop_speed, speed, distance, step=step)

    def secure_gap(self, speed: Array, leader_speed: Array) -> Array:
        """Return the gap beyond the smallest one that is left when lanes are changed."""
        one = eidm.eidm_secure_gap(speed, leader_speed, self.parameters)
        return self._eidm_or_idm(one, _idm_secure_gap, speed, leader_speed)

    def safe_speed(self, gap: Array, leader_speed: Array, leader_braking: Array, step: float) -> Array:
        """Return the highest speed from which they can stand behind leaders who brake, a time headway later.

        Source: SUMO's MSCFModel (`maximumSafeFollowSpeed`), of any driver; all stand a gap behind the leader.
        """
        xp, braking = namespace(gap), self.parameters.comfortable_deceleration
        change, late = braking * step, self.parameters.time_headway / step
        way = stopping_distance(leader_speed, xp.maximum(braking, leader_braking), step)
        room = (clamp_min(gap, 0.0) + way) / step
        # n whole steps of braking from v = n b h + r take n b h ((n - 1) / 2 + late) + (n + late) r = room.
        steps = xp.floor(0.5 - late + square_root(0.25 + late * (late - 1.0) + 2.0 * room / change))
        rest = room - change * steps * ((steps - 1.0) / 2.0 + late)
        return change * steps + rest / (steps + late)

    def brake_gap(self, speed: Array, step: float) -> Array:
        """Return the way in which they can stand, after their time headway."""
        people = self.parameters
        return stopping_distance(speed, people.comfortable_deceleration, step) + speed * people.time_headway

    def _eidm_or_idm(
        self, eidm_values: Array, idm_function: Callable[..., Array], *values: Array, **options: float
    ) -> Array:
        """Return what extended drivers do, and for the others what IDMs do."""
        others = ~self.is_eidm
        if not bool(others.any()):
            return eidm_values
        there = self.select(others)
        eidm_values = eidm_values + 0.0
        eidm_values[others] = idm_function(*(each[others] for each in values), there.parameters, **options)
        return eidm_values


def _idm_follow_speed(speed: Array, gap: Array, leader_speed: Array, parameters: IDMArrays, step: float) -> Array:
    each = step / eidm.EIDM_SUBSTEPS
    for _ in range(eidm.EIDM_SUBSTEPS):
        told = idm_acceleration(speed, leader_speed, clamp_min(gap, SUMO_MIN_GAP), parameters, fast_power)
        speed = next_speed(speed, told, each)
        gap = gap - clamp_min(speed - leader_speed, 0.0) * each
    return speed


def _idm_stop_speed(speed: Array, distance: Array, parameters: IDMArrays, step: float) -> Array:
    near = parameters._replace(minimum_gap=0.0 * parameters.minimum_gap)
    return _idm_follow_speed(speed, distance, 0.0 * speed, near, step) * (distance >= MIN_IDM_STOP_DISTANCE)


def _idm_secure_gap(speed: Array, leader_speed: Array, parameters: IDMArrays) -> Array:
    return desired_gap(speed, speed - leader_speed, parameters) - parameters.minimum_gap


class LaneNeighbors(NamedTuple):
    """Who is next to each vehicle on each way, as numbers of rows, shape (ways, n); `NOBODY` where none."""

    leaders: Array
    followers: Array


def vehicle_numbers(vehicles: MotorwayVehicles) -> Array:
    """Return road and entry of each as one number."""
    return vehicles.road * NUMBERS_PER_ROAD + vehicles.entry


def find_rows(numbers: Array, vehicles: MotorwayVehicles) -> Array:
    """Return the rows of vehicles of certain numbers; `NOBODY` where one is not among them."""
    there, xp = vehicle_numbers(vehicles), namespace(vehicles.road)
    if not len(there):
        return 0 * numbers + NO_VEHICLE
    order = there.argsort()
    found = order[xp.searchsorted(there[order], numbers).clip(0, len(there) - 1)]
    return xp.where(there[found] == numbers, found, NO_VEHICLE)


def sort_vehicles(vehicles: MotorwayVehicles) -> MotorwayVehicles:
    """Return vehicles road by road, from front to back."""
    key = vehicles.road * 1e6 - vehicles.position
    if bool((key[1:] >= key[:-1]).all()):
        return vehicles
    return vehicles.select(key.argsort(stable=True))


def find_neighbors(vehicles: MotorwayVehicles, lane_count: int) -> LaneNeighbors:
    """Return who is next to whom; vehicles stand in order."""
    road, xp = vehicles.road, namespace(vehicles.position)
    count = len(road)
    rows = xp.arange(count)
    ahead, behind = [], []
    for way in range(lane_count):
        there = vehicles.lane == way
        ahead.append(_previous_row(there, rows, road, xp))
        back = _previous_row(_flip(there, xp), rows, _flip(road, xp), xp)
        back = _flip(back, xp)
        behind.append(xp.where(back >= 0, count - 1 - back, NO_VEHICLE))
    return LaneNeighbors(xp.stack(ahead), xp.stack(behind))


def _flip(values: Array, xp: Any) -> Array:
    return xp.flip(values, (0,))


def _previous_row(is_present: Array, rows: Array, road: Array, xp: Any) -> Array:
    """Return the last row before each where something is there, on the same road."""
    last = running_maximum(xp.where(is_present, rows, NO_VEHICLE))
    before = xp.concatenate([last[:1] * 0 + NO_VEHICLE, last[:-1]])
    same = (before >= 0) & (road[before] == road)
    return xp.where(same, before, NO_VEHICLE)


def neighbors_on_lane(neighbors: Array, lane: Array) -> Array:
    """Return of each row its neighbour on a way of its own; `NOBODY` for a way that is not there."""
    xp, ways = namespace(neighbors), neighbors.shape[0]
    rows = xp.arange(neighbors.shape[1])
    found = neighbors[clamp_max(clamp_min(lane, 0), ways - 1), rows]
    return xp.where((lane >= 0) & (lane < ways), found, NO_VEHICLE)
