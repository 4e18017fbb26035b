"""How SUMO's extended intelligent drivers follow and stop, as one formula on arrays.

They are Treiber and Kesting's improved IDM, with coolness when somebody cuts in, a bounded jerk, a slow
start, and misjudged gaps and speeds. Arrays have shape (n,) of n vehicles, units are m/s, m and s. In a
`step` of the simulation drivers think `THINKS` times; SUMO's reaction time is one step: all act in each.
Sources: SUMO's MSCFModel_EIDM (`_v`, `finalizeSpeed`, `slowToStartTerm`); Salles, Kaufmann and Reuss 2020.
"""

from math import exp, sqrt
from typing import NamedTuple

from unjam.physics.arrays import Array, at_least, at_most, namespace, square_root
from unjam.physics.idm import IDMRows, desired_gap

THINKS = 2
"""steps into which a driver divides one of half a second"""
SMALLEST = 1e-3
"""SUMO's NUMERICAL_EPS"""
SLACK = 0.05
"""EIDM_POS_ACC_EPS [m, m/s2]"""
CAREFUL = 3.0
"""speed below which nobody misjudges, and all stop with care: EST_REAC_THRESHOLD [m/s]"""
ENGAGED = 0.5
"""speed below which drivers start slowly: ClutchEngageSpeed [m/s]"""
STARTING, FLATNESS, BEGINNING, RESTING = 1.2, 2.0, 0.7, 4.0
"""how long they start, the shape of it, and how long after one start there is no other [s]"""
COOLNESS = 0.99
JERK = 3.0
"""[m/s3]"""
MISJUDGED_GAP, MISJUDGED_SPEED, MISDRIVEN = 0.1, 0.02, 0.04
"""strengths of the three errors"""
JUDGEMENT_LASTS, DRIVING_LASTS = 10.0, 3.0
"""[s]"""
EMERGENCY = 9.0
"""hardest braking [m/s2]"""
HALTING, STANDING = 0.1, 0.1
"""speeds at which a vehicle halts, and a leader counts as standing [m/s]"""


class Errors(NamedTuple):
    """By how much drivers err, as processes that forget: standard normal, or half as strong for judgement."""

    gap: Array
    leader_speed: Array
    driving: Array

    def after(self, speed: Array, drawn: Array, step: float) -> "Errors":
        """Return those after a step that ended with a speed; `drawn` is standard normal, shape (3, n)."""
        xp, found, acts = namespace(speed), [], speed > CAREFUL
        lasting = (JUDGEMENT_LASTS, 0.5), (JUDGEMENT_LASTS, 0.5), (DRIVING_LASTS, 1.0)
        for value, (time, strength), one in zip(self, lasting, drawn, strict=True):
            new = exp(-step / time) * value + sqrt(2.0 * step / time) * strength * one
            found.append(xp.where(acts, new, value))
        return Errors(*found)


class Ahead(NamedTuple):
    """Who is ahead of each driver who may stay cool about it."""

    acceleration: Array
    """[m/s2]"""
    cool: Array
    """whether the driver may"""


def acceleration(speed: Array, ratio: Array, people: IDMRows) -> Array:
    """Return what the improved IDM wants, `ratio` being the wanted gap over that to the leader [m/s2]."""
    xp, most, braking = namespace(speed), people.max_acceleration, people.comfortable_deceleration
    share = speed / people.desired_speed
    square = at_most(share, 1.0) ** 2
    free = most * (1.0 - square * square)
    near = most * (1.0 - ratio * ratio)
    far = free * (1.0 - xp.exp(xp.log(at_most(ratio, 1.0)) * (2.0 * most / at_least(free, 1e-6))))
    found, close = xp.where(ratio >= 1.0, near, far), ratio >= 1.0
    beyond = share > 1.0
    if bool(beyond.any()):
        slowing = -braking * (1.0 - xp.exp(-xp.log(at_least(share, 1.0)) * (4.0 * most / braking)))
        found = xp.where(beyond, xp.where(close, slowing + near, slowing), found)
    return found


class Wish(NamedTuple):
    """What drivers want after a step behind somebody."""

    speed: Array
    urgent: Array
    """the acceleration for it if they were not cool: by it they choose which of several to heed [m/s2]"""


def follow(
    speed: Array,
    gap: Array,
    leader_speed: Array,
    people: IDMRows,
    errors: Errors,
    step: float,
    ahead: Ahead | None = None,
) -> Wish:
    """Return how fast drivers want to be after a step behind leaders whose bumpers are `gap` ahead."""
    xp, most = namespace(speed), people.max_acceleration
    least = people.minimum_gap
    left = felt(gap, people)
    new, each = speed, step / THINKS
    misjudged, slower = xp.exp(MISJUDGED_GAP * errors.gap), MISJUDGED_SPEED * errors.leader_speed
    urgent = 0.0 * speed
    for _ in range(THINKS):
        leader, seen = at_least(leader_speed - left * slower, 0.0), left * misjudged
        wanted = desired_gap(new, new - leader, people) + SLACK
        enough = seen * square_root(1.0 + 2.0 * SLACK / most)
        stops = (seen < least + (10.0 * step + 1.0) * SLACK) & (new < CAREFUL)
        wanted = xp.where(stops, xp.maximum(wanted, enough), wanted)
        told = urgent = acceleration(new, wanted / seen, people)
        if ahead is not None:
            told = _cooler(told, new, leader, seen, wanted, people, ahead)
        new = at_least(new + told * each, 0.0)
        left = at_least(left - at_least(new - leader_speed, 0.0) * each, SMALLEST)
    return Wish(new, urgent)


def felt(gap: Array, people: IDMRows) -> Array:
    """Return the gaps to leaders with which drivers reckon: a quarter of a metre less than they are."""
    least = people.minimum_gap
    return at_least(gap - least + at_least(least - 0.25, SMALLEST), SMALLEST)


def _cooler(
    told: Array, speed: Array, leader: Array, gap: Array, wanted: Array, people: IDMRows, ahead: Ahead
) -> Array:
    """Return what is left of braking for which the leader, who goes on as it is, gives no reason."""
    xp, braking = namespace(speed), people.comfortable_deceleration
    its = xp.minimum(ahead.acceleration, people.max_acceleration)
    its = xp.where(gap > 1.5 * wanted, its * 1.5 * wanted / gap, its)
    its = xp.where(leader >= STANDING, its, SMALLEST)
    leader = at_least(leader, STANDING)
    nearing = speed - leader
    divisor = leader * leader - 2.0 * gap * its
    both_stop = leader * nearing <= -2.0 * gap * its
    steady = its - at_least(nearing, 0.0) ** 2 / (2.0 * gap)
    enough = xp.where(both_stop, speed * speed * its / xp.where(both_stop, divisor, 1.0), steady)
    cooled = (1.0 - COOLNESS) * told + COOLNESS * (enough + braking * xp.tanh((told - enough) / braking))
    return xp.where(ahead.cool & (told < enough), cooled, told)


def stop(speed: Array, way: Array, people: IDMRows, errors: Errors, step: float) -> Array:
    """Return how fast drivers want to be after a step who must stand within a way."""
    xp, most = namespace(speed), people.max_acceleration
    keeps = SLACK + 0.2 * at_least(most, 0.25)
    own = people._replace(minimum_gap=keeps)
    room = left = at_least(way + keeps, SMALLEST)
    new, each = speed, step / THINKS
    for number in range(THINKS):
        seen = left * xp.exp(MISJUDGED_GAP * errors.gap * at_most(new / CAREFUL, 1.0))
        wanted = desired_gap(new, new, own) + SLACK
        enough = seen * square_root(1.0 + SLACK / most)
        wanted = xp.where(seen < keeps + 2.0 * SLACK, xp.maximum(wanted, enough), wanted)
        new = at_least(new + acceleration(new, wanted / seen, people) * each, 0.0)
        left = at_least(left - new * each, SMALLEST)
        reached = at_least((room - left) / step * THINKS / (number + 1.0), 0.0)
        new = xp.where(new < CAREFUL * step, reached, new)
    return new


def secure_gap(speed: Array, leader_speed: Array, people: IDMRows) -> Array:
    """Return the gap beyond the smallest one with which drivers change lanes (`getSecureGap`)."""
    divisor = square_root(people.comfortable_deceleration / people.max_acceleration + 1.0)
    return (desired_gap(speed, speed - leader_speed, people) - people.minimum_gap) / divisor


class Bounds(NamedTuple):
    """Speeds after a step: the lowest and the highest that are allowed, and one that is wanted."""

    lowest: Array
    wanted: Array
    highest: Array


def bounds(
    speed: Array,
    safe: Array,
    felt_gap: Array,
    leader_speed: Array,
    people: IDMRows,
    errors: Errors,
    step: float,
) -> Bounds:
    """Return what engine, brakes and safety leave, and what drivers want of it, who do not drive evenly."""
    xp, most = namespace(speed), people.max_acceleration
    hard = at_least(speed - EMERGENCY * step, 0.0)
    slowest = at_least(speed - people.comfortable_deceleration * step, 0.0)
    lowest = xp.minimum(slowest, xp.maximum(safe, hard))
    highest = xp.maximum(lowest, xp.minimum(speed + most * step, safe))
    critical = (desired_gap(speed, speed - leader_speed, people) + SLACK) / felt_gap - 0.5
    critical = at_most(at_least(critical, -0.4), 0.0)
    strength = xp.minimum(most, at_least(highest - 0.5 * most, 0.0)) * (2.75**2 * critical * critical + 1.0)
    wanted = xp.maximum(lowest, highest + step * MISDRIVEN * errors.driving * strength)
    return Bounds(lowest, wanted, highest)


def finished(
    speed: Array,
    acceleration: Array,
    wanted: Array,
    highest: Array,
    started: Array,
    most: Array,
    now: float,
    step: float,
) -> tuple[Array, Array]:
    """Return the speeds after a step that ends `now`, and when drivers last began to start [s].

    `acceleration` is that of the step before, `wanted` what they want, `highest` what is safe; `most` is the
    highest acceleration of each.
    """
    xp, rolling = namespace(speed), speed > 2.0 * ENGAGED
    change, before = wanted - speed, acceleration * step
    jerk = JERK * step * step
    faster = xp.minimum(change, before + xp.where(JERK * step + acceleration < 0.0, 2.0 * jerk, jerk))
    slower = xp.minimum(highest - speed, xp.maximum(change, before - jerk))
    up = (change > 0.0) & rolling & (started + STARTING + SMALLEST < now)
    down = (change <= 0.0) & rolling & (wanted < highest - SMALLEST)
    change = xp.where(up, faster, xp.where(down, slower, change))
    change = xp.maximum(change, -speed)
    starts = change > 0.0
    part, done = change / THINKS, 0.0 * change
    for number in range(THINKS):
        time = now - step * (THINKS - number - 1.0) / THINKS
        rested = started + RESTING - SMALLEST < time
        begins = starts & (speed < ENGAGED) & rested & (acceleration < at_most(most / 4.0, 0.2))
        started = xp.where(begins, time, started)
        since = time - started
        slow = (xp.tanh((since * 2.0 / STARTING - BEGINNING) * FLATNESS) + 1.0) / 2.0
        done = done + part * xp.where(since < STARTING + SMALLEST, slow, 1.0)
    return speed + xp.where(starts, done, change), started
