"""How SUMO's extended intelligent drivers follow and stop, as one formula on arrays.

They are Treiber and Kesting's improved IDM, with coolness when somebody cuts in, a bounded jerk, a slow
start, and misjudged gaps and speeds. Arrays have shape (n,) of n vehicles, units are m/s, m and s. In a
`step` of the simulation drivers think `EIDM_SUBSTEPS` times; SUMO's reaction time is one step: all act in each.
Sources: SUMO's MSCFModel_EIDM (`_v`, `finalizeSpeed`, `slowToStartTerm`); Salles, Kaufmann and Reuss 2020.
"""

from math import exp, sqrt
from typing import NamedTuple

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, square_root
from unjam.physics.idm import IDMArrays, desired_gap

EIDM_SUBSTEPS = 2
"""steps into which a driver divides one of half a second"""
EIDM_EPSILON = 1e-3
"""SUMO's NUMERICAL_EPS"""
EIDM_SLACK = 0.05
"""EIDM_POS_ACC_EPS [m, m/s2]"""
LOW_SPEED_THRESHOLD = 3.0
"""speed below which nobody misjudges, and all stop with care: EST_REAC_THRESHOLD [m/s]"""
CLUTCH_ENGAGE_SPEED = 0.5
"""speed below which drivers start slowly: ClutchEngageSpeed [m/s]"""
START_UP_DURATION, START_UP_SHAPE, START_UP_SHIFT, MIN_START_UP_INTERVAL = 1.2, 2.0, 0.7, 4.0
"""how long they start, the shape of it, and how long after one start there is no other [s]"""
COOLNESS = 0.99
MAX_JERK = 3.0
"""[m/s3]"""
GAP_ERROR_STRENGTH, LEADER_SPEED_ERROR_STRENGTH, DRIVING_ERROR_STRENGTH = 0.1, 0.02, 0.04
"""strengths of the three errors"""
ESTIMATION_ERROR_TIME, DRIVING_ERROR_TIME = 10.0, 3.0
"""[s]"""
EIDM_EMERGENCY_BRAKING = 9.0
"""hardest braking [m/s2]"""
EIDM_HALTING_SPEED, LEADER_STANDING_SPEED = 0.1, 0.1
"""speeds at which a vehicle halts, and a leader counts as standing [m/s]"""


class DriverErrors(NamedTuple):
    """By how much drivers err, as processes that forget: standard normal, or half as strong for judgement."""

    gap: Array
    leader_speed: Array
    driving: Array

    def next_errors(self, speed: Array, noise: Array, step: float) -> "DriverErrors":
        """Return those after a step that ended with a speed; `drawn` is standard normal, shape (3, n)."""
        xp, found, acts = namespace(speed), [], speed > LOW_SPEED_THRESHOLD
        lasting = (ESTIMATION_ERROR_TIME, 0.5), (ESTIMATION_ERROR_TIME, 0.5), (DRIVING_ERROR_TIME, 1.0)
        for value, (time, strength), one in zip(self, lasting, noise, strict=True):
            new = exp(-step / time) * value + sqrt(2.0 * step / time) * strength * one
            found.append(xp.where(acts, new, value))
        return DriverErrors(*found)


class LeaderMotion(NamedTuple):
    """Who is ahead of each driver who may stay cool about it."""

    acceleration: Array
    """[m/s2]"""
    may_stay_cool: Array
    """whether the driver may"""


def eidm_acceleration(speed: Array, gap_ratio: Array, parameters: IDMArrays) -> Array:
    """Return what the improved IDM wants, `ratio` being the wanted gap over that to the leader [m/s2]."""
    xp, most, braking = namespace(speed), parameters.max_acceleration, parameters.comfortable_deceleration
    share = speed / parameters.desired_speed
    square = clamp_max(share, 1.0) ** 2
    free = most * (1.0 - square * square)
    near = most * (1.0 - gap_ratio * gap_ratio)
    far = free * (1.0 - xp.exp(xp.log(clamp_max(gap_ratio, 1.0)) * (2.0 * most / clamp_min(free, 1e-6))))
    found, close = xp.where(gap_ratio >= 1.0, near, far), gap_ratio >= 1.0
    beyond = share > 1.0
    if bool(beyond.any()):
        slowing = -braking * (1.0 - xp.exp(-xp.log(clamp_min(share, 1.0)) * (4.0 * most / braking)))
        found = xp.where(beyond, xp.where(close, slowing + near, slowing), found)
    return found


class DesiredSpeed(NamedTuple):
    """What drivers want after a step behind somebody."""

    speed: Array
    uncooled_acceleration: Array
    """the acceleration for it if they were not cool: by it they choose which of several to heed [m/s2]"""


def eidm_follow_speed(
    speed: Array,
    gap: Array,
    leader_speed: Array,
    parameters: IDMArrays,
    errors: DriverErrors,
    step: float,
    leader_motion: LeaderMotion | None = None,
) -> DesiredSpeed:
    """Return how fast drivers want to be after a step behind leaders whose bumpers are `gap` ahead."""
    xp, most = namespace(speed), parameters.max_acceleration
    least = parameters.minimum_gap
    left = eidm_effective_gap(gap, parameters)
    new, each = speed, step / EIDM_SUBSTEPS
    misjudged, slower = xp.exp(GAP_ERROR_STRENGTH * errors.gap), LEADER_SPEED_ERROR_STRENGTH * errors.leader_speed
    urgent = 0.0 * speed
    for _ in range(EIDM_SUBSTEPS):
        leader, seen = clamp_min(leader_speed - left * slower, 0.0), left * misjudged
        wanted = desired_gap(new, new - leader, parameters) + EIDM_SLACK
        enough = seen * square_root(1.0 + 2.0 * EIDM_SLACK / most)
        stops = (seen < least + (10.0 * step + 1.0) * EIDM_SLACK) & (new < LOW_SPEED_THRESHOLD)
        wanted = xp.where(stops, xp.maximum(wanted, enough), wanted)
        told = urgent = eidm_acceleration(new, wanted / seen, parameters)
        if leader_motion is not None:
            told = _with_coolness(told, new, leader, seen, wanted, parameters, leader_motion)
        new = clamp_min(new + told * each, 0.0)
        left = clamp_min(left - clamp_min(new - leader_speed, 0.0) * each, EIDM_EPSILON)
    return DesiredSpeed(new, urgent)


def eidm_effective_gap(gap: Array, parameters: IDMArrays) -> Array:
    """Return the gaps to leaders with which drivers reckon: a quarter of a metre less than they are."""
    least = parameters.minimum_gap
    return clamp_min(gap - least + clamp_min(least - 0.25, EIDM_EPSILON), EIDM_EPSILON)


def _with_coolness(
    acceleration: Array,
    speed: Array,
    leader_speed: Array,
    gap: Array,
    wanted_gap: Array,
    parameters: IDMArrays,
    leader_motion: LeaderMotion,
) -> Array:
    """Return what is left of braking for which the leader, who goes on as it is, gives no reason."""
    xp, braking = namespace(speed), parameters.comfortable_deceleration
    its = xp.minimum(leader_motion.acceleration, parameters.max_acceleration)
    its = xp.where(gap > 1.5 * wanted_gap, its * 1.5 * wanted_gap / gap, its)
    its = xp.where(leader_speed >= LEADER_STANDING_SPEED, its, EIDM_EPSILON)
    leader_speed = clamp_min(leader_speed, LEADER_STANDING_SPEED)
    nearing = speed - leader_speed
    divisor = leader_speed * leader_speed - 2.0 * gap * its
    both_stop = leader_speed * nearing <= -2.0 * gap * its
    steady = its - clamp_min(nearing, 0.0) ** 2 / (2.0 * gap)
    enough = xp.where(both_stop, speed * speed * its / xp.where(both_stop, divisor, 1.0), steady)
    cooled = (1.0 - COOLNESS) * acceleration + COOLNESS * (
        enough + braking * xp.tanh((acceleration - enough) / braking)
    )
    return xp.where(leader_motion.may_stay_cool & (acceleration < enough), cooled, acceleration)


def eidm_stop_speed(speed: Array, distance: Array, parameters: IDMArrays, errors: DriverErrors, step: float) -> Array:
    """Return how fast drivers want to be after a step who must stand within a way."""
    xp, most = namespace(speed), parameters.max_acceleration
    keeps = EIDM_SLACK + 0.2 * clamp_min(most, 0.25)
    own = parameters._replace(minimum_gap=keeps)
    room = left = clamp_min(distance + keeps, EIDM_EPSILON)
    new, each = speed, step / EIDM_SUBSTEPS
    for number in range(EIDM_SUBSTEPS):
        seen = left * xp.exp(GAP_ERROR_STRENGTH * errors.gap * clamp_max(new / LOW_SPEED_THRESHOLD, 1.0))
        wanted = desired_gap(new, new, own) + EIDM_SLACK
        enough = seen * square_root(1.0 + EIDM_SLACK / most)
        wanted = xp.where(seen < keeps + 2.0 * EIDM_SLACK, xp.maximum(wanted, enough), wanted)
        new = clamp_min(new + eidm_acceleration(new, wanted / seen, parameters) * each, 0.0)
        left = clamp_min(left - new * each, EIDM_EPSILON)
        reached = clamp_min((room - left) / step * EIDM_SUBSTEPS / (number + 1.0), 0.0)
        new = xp.where(new < LOW_SPEED_THRESHOLD * step, reached, new)
    return new


def eidm_secure_gap(speed: Array, leader_speed: Array, parameters: IDMArrays) -> Array:
    """Return the gap beyond the smallest one with which drivers change lanes (`getSecureGap`)."""
    divisor = square_root(parameters.comfortable_deceleration / parameters.max_acceleration + 1.0)
    return (desired_gap(speed, speed - leader_speed, parameters) - parameters.minimum_gap) / divisor


class SpeedBounds(NamedTuple):
    """Speeds after a step: the lowest and the highest that are allowed, and one that is wanted."""

    lowest: Array
    desired: Array
    highest: Array


def eidm_speed_bounds(
    speed: Array,
    safe_speed: Array,
    effective_gap: Array,
    leader_speed: Array,
    parameters: IDMArrays,
    errors: DriverErrors,
    step: float,
) -> SpeedBounds:
    """Return what engine, brakes and safety leave, and what drivers want of it, who do not drive evenly."""
    xp, most = namespace(speed), parameters.max_acceleration
    hard = clamp_min(speed - EIDM_EMERGENCY_BRAKING * step, 0.0)
    slowest = clamp_min(speed - parameters.comfortable_deceleration * step, 0.0)
    lowest = xp.minimum(slowest, xp.maximum(safe_speed, hard))
    highest = xp.maximum(lowest, xp.minimum(speed + most * step, safe_speed))
    critical = (desired_gap(speed, speed - leader_speed, parameters) + EIDM_SLACK) / effective_gap - 0.5
    critical = clamp_max(clamp_min(critical, -0.4), 0.0)
    strength = xp.minimum(most, clamp_min(highest - 0.5 * most, 0.0)) * (2.75**2 * critical * critical + 1.0)
    wanted = xp.maximum(lowest, highest + step * DRIVING_ERROR_STRENGTH * errors.driving * strength)
    return SpeedBounds(lowest, wanted, highest)


def finalize_eidm_speed(
    speed: Array,
    acceleration: Array,
    desired: Array,
    highest: Array,
    start_time: Array,
    max_acceleration: Array,
    end_time: float,
    step: float,
) -> tuple[Array, Array]:
    """Return the speeds after a step that ends `now`, and when drivers last began to start [s].

    `acceleration` is that of the step before, `wanted` what they want, `highest` what is safe; `max_acceleration` is the
    highest acceleration of each.
    """
    xp, rolling = namespace(speed), speed > 2.0 * CLUTCH_ENGAGE_SPEED
    change, before = desired - speed, acceleration * step
    jerk = MAX_JERK * step * step
    faster = xp.minimum(change, before + xp.where(MAX_JERK * step + acceleration < 0.0, 2.0 * jerk, jerk))
    slower = xp.minimum(highest - speed, xp.maximum(change, before - jerk))
    up = (change > 0.0) & rolling & (start_time + START_UP_DURATION + EIDM_EPSILON < end_time)
    down = (change <= 0.0) & rolling & (desired < highest - EIDM_EPSILON)
    change = xp.where(up, faster, xp.where(down, slower, change))
    change = xp.maximum(change, -speed)
    starts = change > 0.0
    part, done = change / EIDM_SUBSTEPS, 0.0 * change
    for number in range(EIDM_SUBSTEPS):
        time = end_time - step * (EIDM_SUBSTEPS - number - 1.0) / EIDM_SUBSTEPS
        rested = start_time + MIN_START_UP_INTERVAL - EIDM_EPSILON < time
        begins = (
            starts & (speed < CLUTCH_ENGAGE_SPEED) & rested & (acceleration < clamp_max(max_acceleration / 4.0, 0.2))
        )
        start_time = xp.where(begins, time, start_time)
        since = time - start_time
        slow = (xp.tanh((since * 2.0 / START_UP_DURATION - START_UP_SHIFT) * START_UP_SHAPE) + 1.0) / 2.0
        done = done + part * xp.where(since < START_UP_DURATION + EIDM_EPSILON, slow, 1.0)
    return speed + xp.where(starts, done, change), start_time
