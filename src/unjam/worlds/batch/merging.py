"""Who must leave the lane that ends, and what they ask of others: to make room, to go, or to change too.

Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `informLeader`, `informFollower`, `slowDownForBlocked`).
"""

from unjam.physics.arrays import Array, at_least, namespace, scatter_minimum
from unjam.worlds.batch.beside import Other, Scene, Stretch
from unjam.worlds.batch.vehicles import FREELY, NOBODY, Vehicles

LOOK_FORWARD, LEFT_FACTOR = 10.0, 2.0
"""how long somebody looks ahead for a change that must be made [s], and how much longer to the left"""
URGENCY = 2.0
"""how many times over the way that is left would be driven in the time that is left"""
HELP, FALL_BEHIND = 10.0 / 3.6, 7.0 / 3.6
"""speed by which one overtakes to help [m/s], braking at least to fall behind [m/s2]"""
UNCONGESTED = 60.0 / 3.6
"""speed above which nobody passes on the right [m/s]"""
CLOSE = 0.1
"""SUMO's POSITION_EPS [m]"""


def who_must(vehicles: Vehicles, scene: Scene, stretch: Stretch) -> tuple[Vehicles, Array, Array]:
    """Return the vehicles with advice, who must change now, and who is asked to make room."""
    xp, place = namespace(vehicles.speed), vehicles.place
    on_lane = (vehicles.way == 0) & (scene.target != NOBODY)
    ahead_sum = (vehicles.way == 1) & (place >= stretch.merge)
    lengths = xp.where(ahead_sum, vehicles.gap + stretch.vehicle_length, 0.0 * place)
    so_far = lengths.cumsum(0)
    first = namespace(place).searchsorted(vehicles.road, vehicles.road)
    occupied = so_far - xp.where(first > 0, so_far[first - 1], 0.0 * place)
    left = stretch.closes - place
    needed = vehicles.look * (LOOK_FORWARD * LEFT_FACTOR) + 2.0 * (vehicles.gap + stretch.vehicle_length)
    urgent = on_lane & (left - occupied < needed)
    helps = vehicles.speed < 0.0
    rows = xp.arange(len(place))[urgent]
    if len(rows) == 0:
        return vehicles, urgent, helps
    own, told, leans = vehicles.own_advice, vehicles.told_advice, vehicles.leans
    one = Merging(vehicles, scene, stretch, rows, left[rows])
    planned, mine, passes = one.with_leader()
    own[rows] = mine
    blocked = one.by_leader & one.ahead.there
    leans[one.ahead.row[blocked]] = 1.0
    over = blocked & passes
    scatter_minimum(told, one.ahead.row[over], 0.0 * one.speed[over])
    asked, speeds, more, wishes = one.with_follower(planned, ~over)
    own[rows] = xp.minimum(own[rows], more)
    step = scene.step
    scatter_minimum(told, one.behind.row[asked], (speeds - one.behind.speed)[asked] / step)
    helps[one.behind.row[wishes]] = True
    stuck = one.by_leader | one.by_follower
    leans[rows[stuck]] = 1.0
    vehicles = vehicles._replace(own_advice=own, told_advice=told, leans=leans)
    return _let_in(vehicles, scene, stretch, rows[stuck]), urgent, helps


class Merging:
    """Those who must leave the ramp's lane, and what they ask of others."""

    def __init__(self, vehicles: Vehicles, scene: Scene, stretch: Stretch, rows: Array, left: Array) -> None:
        """Take their rows, and how much of the lane is left to each [m]."""
        self.speed, self.left, self._step = vehicles.speed[rows], left, scene.step
        self._length, self._gap = stretch.vehicle_length, vehicles.gap[rows]
        self.ahead, self.behind = (
            Other(*(each[rows] for each in other)) for other in (scene.ahead, scene.behind)
        )
        self.by_leader, self.by_follower = scene.by_leader[rows], scene.by_follower[rows]
        self._drivers, self._followers = scene.drivers.at(rows), scene.followers.at(rows)
        self._leaders, self._leader_gap = scene.drivers.at(self.ahead.row), vehicles.gap[self.ahead.row]
        self._braking, self._leader_slows = vehicles.braking[rows], vehicles.acceleration[self.ahead.row]
        self._seconds = at_least(left / at_least(vehicles.look[rows], 1e-3) / URGENCY, scene.step)

    def with_leader(self) -> tuple[Array, Array, Array]:
        """Return the speeds that they plan, accelerations for that [m/s2], and who passes the leader."""
        xp, speed, step, leader = namespace(self.speed), self.speed, self._step, self.ahead
        planned = xp.minimum(speed, self._drivers.stop(speed, self.left, step))
        slower = leader.speed - step * at_least(-self._leader_slows, 1.0)
        gap = leader.gap + step * (slower - planned)
        follow = self._drivers.follow(speed, gap + self._gap, slower, step)
        follow = xp.maximum(at_least(speed - self._braking * step, 0.0), follow)
        room = leader.gap + 2.0 * self._length + self._leader_gap
        room = at_least(room + self._leaders.secure_gap(leader.speed, speed), 0.0)
        faster = planned - leader.speed
        lasts = xp.where(faster > 0.0, room / at_least(faster, 1e-6), self._seconds + 1.0)
        within = self.left - self._drivers.brake_gap(speed, step) >= room
        passes = (faster >= 0.0) & (speed < UNCONGESTED) & within & (lasts <= self._seconds)
        braking = xp.minimum(self._braking, at_least((speed - follow) / self._seconds, FALL_BEHIND))
        behind = xp.minimum(planned, at_least(speed - step * braking, 0.0))
        blocked = self.by_leader & leader.there
        falls = blocked & ~passes & (follow < speed)
        told = xp.where(falls, behind, follow)
        mine = xp.where(leader.there & ~(blocked & passes), (told - speed) / step, FREELY)
        unblocked = leader.there & ~self.by_leader
        planned = xp.where(falls, behind, xp.where(unblocked, xp.minimum(follow, planned), planned))
        return planned, mine, passes

    def with_follower(self, planned: Array, speaks: Array) -> tuple[Array, Array, Array, Array]:
        """Return who asks its follower for a speed, which, own accelerations, and who asks it to change."""
        xp, speed, step, other = namespace(self.speed), self.speed, self._step, self.behind
        there, drivers, seconds = speaks & other.there, self._followers, self._seconds
        hard = drivers.people.comfortable_deceleration
        slower, second = at_least(other.speed - step * hard, 0.0), at_least(other.speed - hard, 0.0)
        faster, room = planned - second, other.gap + planned - second
        needed = drivers.secure_gap(second, at_least(planned, 0.0))
        keeps = drivers.people.minimum_gap

        def behind_me(slack: Array) -> Array:
            return drivers.follow(other.speed, other.gap + keeps + step * slack, planned, step)

        follows = behind_me(planned - xp.maximum(slower, behind_me(planned)))
        alone = planned - other.speed >= HELP
        enough = drivers.secure_gap(other.speed, planned) - other.gap < (planned - other.speed) * seconds
        brakes = (room > 0.0) & (room >= needed)
        in_time = (faster > 0.0) & (faster * seconds > needed - room + CLOSE)
        slow = other.speed > speed
        lets = xp.where(slow, xp.maximum(slower, speed + HELP), xp.maximum(other.speed, speed + HELP))
        asked = xp.where(brakes, xp.maximum(slower, follows), xp.where(in_time, slower, lets))
        asked = xp.where(alone & enough, planned - HELP, asked)
        passed = ~(alone & enough) & ~brakes & ~in_time
        overtaken = passed & ~(slow & ((other.speed - speed) / hard < seconds))
        length = other.gap + 2.0 * self._length + self._gap
        length = at_least(length + self._drivers.secure_gap(planned, lets), 0.0)
        mine = xp.maximum(lets - length / seconds, speed - step * self._braking)
        blocked = there & self.by_follower
        own = xp.where(blocked & overtaken, (mine - speed) / step, FREELY)
        stays = there & ~self.by_follower & self.by_leader
        follows = behind_me(planned - behind_me(planned))
        return blocked | stays, xp.where(blocked, asked, follows), own, blocked


def _let_in(vehicles: Vehicles, scene: Scene, stretch: Stretch, stuck: Array) -> Vehicles:
    """Return the vehicles, those who crawl beside the ramp's lane letting in the next one that is stuck."""
    if len(stuck) == 0:
        return vehicles
    xp, place, speed = namespace(vehicles.place), vehicles.place, vehicles.speed
    crawls = (vehicles.way == 1) & (place >= stretch.merge) & (place < stretch.closes)
    crawls = crawls & (speed < vehicles.braking)
    if not bool(crawls.any()):
        return vehicles
    next_one = xp.searchsorted(stuck, xp.arange(len(place))) - 1
    other = stuck[at_least(next_one, 0)]
    gap = place[other] - stretch.vehicle_length - place - vehicles.gap
    lets = crawls & (next_one >= 0) & (vehicles.road[other] == vehicles.road) & (gap > CLOSE)
    if not bool(lets.any()):
        return vehicles
    drivers, advice = scene.drivers.at(lets), vehicles.beside_advice
    wanted = drivers.follow(speed[lets], (gap + vehicles.gap)[lets] - CLOSE, speed[other][lets], scene.step)
    advice[lets] = (wanted - speed[lets]) / scene.step
    return vehicles._replace(beside_advice=advice)
