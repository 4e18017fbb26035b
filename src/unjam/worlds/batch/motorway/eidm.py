"""SUMO's extended intelligent driver model (EIDM) as formulas on arrays of shape (n,) for n vehicles; m/s, m and s.

It is the improved IDM of Treiber and Kesting, with less braking behind vehicles that cut in (coolness), bounded jerk,
slow starts, and errors in the estimation of gaps and speeds. Drivers act in each of the `EIDM_SUBSTEPS` of a step.
Sources: SUMO's MSCFModel_EIDM (`_v`, `finalizeSpeed`, `slowToStartTerm`); Salles, Kaufmann and Reuss 2020.
"""

from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, square_root
from unjam.physics.idm import IDMArrays, desired_gap

EIDM_SUBSTEPS = 2
"""number of steps into which SUMO divides a simulation step of 0.5 s"""
EIDM_EPSILON = 1e-3
"""SUMO's NUMERICAL_EPS"""
EIDM_SLACK = 0.05
"""SUMO's EIDM_POS_ACC_EPS [m, m/s2]"""
LOW_SPEED_THRESHOLD = 3.0
"""speed below which estimation errors do not change and drivers stop carefully: EST_REAC_THRESHOLD [m/s]"""
CLUTCH_ENGAGE_SPEED = 0.5
"""speed below which drivers start slowly: ClutchEngageSpeed [m/s]"""
START_UP_DURATION, START_UP_SHAPE, START_UP_SHIFT, MIN_START_UP_INTERVAL = 1.2, 2.0, 0.7, 4.0
"""duration of a start [s], shape and shift of its profile, and minimum time between two starts [s]"""
COOLNESS = 0.99
"""weight of the reduced braking of cool drivers"""
MAX_JERK = 3.0
"""[m/s3]"""
GAP_ERROR_STRENGTH, LEADER_SPEED_ERROR_STRENGTH, DRIVING_ERROR_STRENGTH = 0.1, 0.02, 0.04
"""factors of the three `DriverErrors`"""
ESTIMATION_ERROR_TIME, DRIVING_ERROR_TIME = 10.0, 3.0
"""correlation times of the errors [s]"""
EIDM_EMERGENCY_BRAKING = 9.0
EIDM_HALTING_SPEED, LEADER_STANDING_SPEED = 0.1, 0.1
"""speeds below which a vehicle halts, and a leader counts as standing [m/s]"""


class DriverErrors(NamedTuple):
    """Errors of drivers: Ornstein-Uhlenbeck processes with standard deviation 0.5, for driving 1."""

    gap: Array
    leader_speed: Array
    driving: Array

    def next_errors(self, speed: Array, noise: Array, step: float) -> "DriverErrors":
        """Return the errors after a step, given the speed after it and standard normal noise of shape (3, n)."""
        processes = (ESTIMATION_ERROR_TIME, 0.5), (ESTIMATION_ERROR_TIME, 0.5), (DRIVING_ERROR_TIME, 1.0)
        next_values = (
            exp(-step / time) * value + sqrt(2.0 * step / time) * strength * normal
            for value, (time, strength), normal in zip(self, processes, noise, strict=True)
        )
        is_fast = speed > LOW_SPEED_THRESHOLD
        return DriverErrors(*(np.where(is_fast, new, old) for new, old in zip(next_values, self, strict=True)))


class LeaderMotion(NamedTuple):
    """The acceleration of each leader [m/s2], and whether the driver behind may brake less because of it."""

    acceleration: Array
    may_stay_cool: Array

    def reduce_braking(
        self, uncooled: Array, speed: Array, leader_speed: Array, gap: Array, wanted_gap: Array, parameters: IDMArrays
    ) -> Array:
        """Return accelerations with less braking if a constant acceleration of the leader does not require more."""
        braking = parameters.comfortable_deceleration
        acceleration = np.minimum(self.acceleration, parameters.max_acceleration)
        acceleration = np.where(gap > 1.5 * wanted_gap, acceleration * 1.5 * wanted_gap / gap, acceleration)
        acceleration = np.where(leader_speed >= LEADER_STANDING_SPEED, acceleration, EIDM_EPSILON)
        leader_speed = clamp_min(leader_speed, LEADER_STANDING_SPEED)
        closing_speed = speed - leader_speed
        divisor = leader_speed * leader_speed - 2.0 * gap * acceleration
        both_stop = leader_speed * closing_speed <= -2.0 * gap * acceleration
        stopping = speed * speed * acceleration / np.where(both_stop, divisor, 1.0)
        required = np.where(both_stop, stopping, acceleration - clamp_min(closing_speed, 0.0) ** 2 / (2.0 * gap))
        smooth = required + braking * np.tanh((uncooled - required) / braking)
        reduced = (1.0 - COOLNESS) * uncooled + COOLNESS * smooth
        return np.where(self.may_stay_cool & (uncooled < required), reduced, uncooled)


def eidm_acceleration(speed: Array, gap_ratio: Array, parameters: IDMArrays) -> Array:
    """Return the accelerations of the improved IDM [m/s2]; `gap_ratio` is the desired gap over the actual gap."""
    highest, braking = parameters.max_acceleration, parameters.comfortable_deceleration
    speed_ratio = speed / parameters.desired_speed
    square = clamp_max(speed_ratio, 1.0) ** 2
    free = highest * (1.0 - square * square)
    near = highest * (1.0 - gap_ratio * gap_ratio)
    far = free * (1.0 - np.exp(np.log(clamp_max(gap_ratio, 1.0)) * (2.0 * highest / clamp_min(free, 1e-6))))
    is_near = gap_ratio >= 1.0
    acceleration = np.where(is_near, near, far)
    if len(rows := np.flatnonzero(speed_ratio > 1.0)):
        highest, braking = highest[rows], braking[rows]
        slowing = -braking * (1.0 - np.exp(-np.log(speed_ratio[rows]) * (4.0 * highest / braking)))
        acceleration[rows] = np.where(is_near[rows], slowing + near[rows], slowing)
    return acceleration


class DesiredSpeed(NamedTuple):
    """Desired speeds of drivers after a step behind their leaders [m/s]."""

    speed: Array
    uncooled_acceleration: Array
    """acceleration without coolness, by which drivers choose between a leader and a limit [m/s2]"""


def eidm_follow_speed(
    speed: Array,
    gap: Array,
    leader_speed: Array,
    parameters: IDMArrays,
    errors: DriverErrors,
    step: float,
    leader_motion: LeaderMotion | None = None,
) -> DesiredSpeed:
    """Return the desired speeds after a step with bumper-to-bumper gaps to leaders."""
    minimum_gap, remaining = parameters.minimum_gap, eidm_effective_gap(gap, parameters)
    new, substep = speed, step / EIDM_SUBSTEPS
    gap_factor = np.exp(GAP_ERROR_STRENGTH * errors.gap)
    speed_error = LEADER_SPEED_ERROR_STRENGTH * errors.leader_speed
    uncooled = 0.0 * speed
    for _ in range(EIDM_SUBSTEPS):
        seen_speed, seen_gap = clamp_min(leader_speed - remaining * speed_error, 0.0), remaining * gap_factor
        wanted_gap = desired_gap(new, new - seen_speed, parameters) + EIDM_SLACK
        stop_gap = seen_gap * square_root(1.0 + 2.0 * EIDM_SLACK / parameters.max_acceleration)
        stops = (seen_gap < minimum_gap + (10.0 * step + 1.0) * EIDM_SLACK) & (new < LOW_SPEED_THRESHOLD)
        wanted_gap = np.where(stops, np.maximum(wanted_gap, stop_gap), wanted_gap)
        acceleration = uncooled = eidm_acceleration(new, wanted_gap / seen_gap, parameters)
        if leader_motion is not None:
            acceleration = leader_motion.reduce_braking(acceleration, new, seen_speed, seen_gap, wanted_gap, parameters)
        new = clamp_min(new + acceleration * substep, 0.0)
        remaining = clamp_min(remaining - clamp_min(new - leader_speed, 0.0) * substep, EIDM_EPSILON)
    return DesiredSpeed(new, uncooled)


def eidm_effective_gap(gap: Array, parameters: IDMArrays) -> Array:
    """Return the gaps that drivers use, which are 0.25 m smaller than the actual gaps."""
    minimum_gap = parameters.minimum_gap
    return clamp_min(gap - minimum_gap + clamp_min(minimum_gap - 0.25, EIDM_EPSILON), EIDM_EPSILON)


def eidm_stop_speed(speed: Array, distance: Array, parameters: IDMArrays, errors: DriverErrors, step: float) -> Array:
    """Return the desired speeds after a step of drivers that must stop within a distance."""
    highest = parameters.max_acceleration
    minimum_gap = EIDM_SLACK + 0.2 * clamp_min(highest, 0.25)
    stop_parameters = parameters._replace(minimum_gap=minimum_gap)
    total = remaining = clamp_min(distance + minimum_gap, EIDM_EPSILON)
    new, substep = speed, step / EIDM_SUBSTEPS
    for substep_index in range(EIDM_SUBSTEPS):
        seen_gap = remaining * np.exp(GAP_ERROR_STRENGTH * errors.gap * clamp_max(new / LOW_SPEED_THRESHOLD, 1.0))
        wanted_gap = desired_gap(new, new, stop_parameters) + EIDM_SLACK
        stop_gap = seen_gap * square_root(1.0 + EIDM_SLACK / highest)
        wanted_gap = np.where(seen_gap < minimum_gap + 2.0 * EIDM_SLACK, np.maximum(wanted_gap, stop_gap), wanted_gap)
        new = clamp_min(new + eidm_acceleration(new, wanted_gap / seen_gap, parameters) * substep, 0.0)
        remaining = clamp_min(remaining - new * substep, EIDM_EPSILON)
        mean_speed = clamp_min((total - remaining) / step * EIDM_SUBSTEPS / (substep_index + 1.0), 0.0)
        new = np.where(new < LOW_SPEED_THRESHOLD * step, mean_speed, new)
    return new


def eidm_speed_bounds(
    speed: Array,
    safe_speed: Array,
    effective_gap: Array,
    leader_speed: Array,
    parameters: IDMArrays,
    errors: DriverErrors,
    step: float,
) -> tuple[Array, Array, Array]:
    """Return minimum, desired and maximum speeds after a step; desired speeds contain the driving errors."""
    max_acceleration = parameters.max_acceleration
    emergency = clamp_min(speed - EIDM_EMERGENCY_BRAKING * step, 0.0)
    comfortable = clamp_min(speed - parameters.comfortable_deceleration * step, 0.0)
    min_speed = np.minimum(comfortable, np.maximum(safe_speed, emergency))
    max_speed = np.maximum(min_speed, np.minimum(speed + max_acceleration * step, safe_speed))
    critical = (desired_gap(speed, speed - leader_speed, parameters) + EIDM_SLACK) / effective_gap - 0.5
    critical = clamp_max(clamp_min(critical, -0.4), 0.0)
    strength = np.minimum(max_acceleration, clamp_min(max_speed - 0.5 * max_acceleration, 0.0))
    strength = strength * (2.75**2 * critical * critical + 1.0)
    desired = max_speed + step * DRIVING_ERROR_STRENGTH * errors.driving * strength
    return min_speed, np.maximum(min_speed, desired), max_speed


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
    """Return the speeds after a step with bounded jerk and slow starts, and the time of the last start [s].

    `acceleration` is that of the previous step; speeds are those of `eidm_speed_bounds`.
    """
    is_rolling = speed > 2.0 * CLUTCH_ENGAGE_SPEED
    change, previous_change = desired - speed, acceleration * step
    jerk = MAX_JERK * step * step
    max_increase = np.where(MAX_JERK * step + acceleration < 0.0, 2.0 * jerk, jerk + 0.0 * speed)
    faster = np.minimum(change, previous_change + max_increase)
    slower = np.minimum(highest - speed, np.maximum(change, previous_change - jerk))
    is_bounded_above = (change > 0.0) & is_rolling & (start_time + START_UP_DURATION + EIDM_EPSILON < end_time)
    is_bounded_below = (change <= 0.0) & is_rolling & (desired < highest - EIDM_EPSILON)
    change = np.where(is_bounded_above, faster, np.where(is_bounded_below, slower, change))
    change = np.maximum(change, -speed)
    accelerates = change > 0.0
    may_start = accelerates & (speed < CLUTCH_ENGAGE_SPEED) & (acceleration < clamp_max(max_acceleration / 4.0, 0.2))
    substep_change, total_change = change / EIDM_SUBSTEPS, 0.0 * change
    for substep_index in range(EIDM_SUBSTEPS):
        time = end_time - step * (EIDM_SUBSTEPS - substep_index - 1.0) / EIDM_SUBSTEPS
        starts = may_start & (start_time + MIN_START_UP_INTERVAL - EIDM_EPSILON < time)
        start_time = np.where(starts, time, start_time)
        elapsed = time - start_time
        profile = (np.tanh((elapsed * 2.0 / START_UP_DURATION - START_UP_SHIFT) * START_UP_SHAPE) + 1.0) / 2.0
        profile = np.where(elapsed < START_UP_DURATION + EIDM_EPSILON, profile, 1.0)
        total_change = total_change + substep_change * profile
    return speed + np.where(accelerates, total_change, change), start_time
