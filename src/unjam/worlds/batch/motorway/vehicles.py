"""The vehicles of W motorways and their drivers in one table, sorted by road and from front to back.

Arrays have shape (n,) for the n vehicles on all roads, in m/s, m and s. Functions return new tables and columns.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from unjam.physics.arrays import Array, clamp_min, square_root
from unjam.physics.idm import IDMArrays, desired_gap, fast_power, idm_acceleration
from unjam.physics.kinematics import next_speed, stopping_distance
from unjam.worlds.batch.human_idm import SUMO_MIN_GAP
from unjam.worlds.batch.motorway import eidm
from unjam.worlds.batch.motorway.eidm import DesiredSpeed, DriverErrors, LeaderMotion
from unjam.worlds.lane_neighbors import NO_VEHICLE

KEYS_PER_ROAD = 100_000
"""number of keys for the vehicles of one road: more than enter it in an episode"""
NO_ADVICE = 1e6
"""advised acceleration without advice, which is never carried out [m/s2]"""
ADVICE_FIELDS = ("lane_change_advice", "cooperative_advice", "adjacent_advice")
MIN_IDM_STOP_DISTANCE = 0.01
"""distance below which an IDM stands [m]"""


def as_rows(index: Array) -> Array:
    """Return the rows of a mask, and rows unchanged, because selecting many columns by rows takes half the time."""
    return np.flatnonzero(index) if index.dtype == np.bool_ else index


class MotorwayVehicles(NamedTuple):
    """The vehicles on all roads."""

    road: Array
    """index of the road"""
    entry: Array
    """index of the vehicle in the entries of its road"""
    lane: Array
    """index of the lane: 0 for the ramp and its lane, then the lanes of the motorway from right to left"""
    position: Array
    """position of the front bumper along the road [m]"""
    speed: Array
    acceleration: Array
    """acceleration in the last step [m/s2]"""
    time_headway: Array
    max_acceleration: Array
    braking: Array
    """comfortable deceleration [m/s2]"""
    minimum_gap: Array
    speed_factor: Array
    """desired speed over the speed limit"""
    is_eidm: Array
    """whether the driver is SUMO's EIDM instead of its IDM"""
    speed_cap: Array
    desired_speed: Array
    """desired speed of an EIDM, which adapts gradually when the limit rises [m/s]"""
    start_time: Array
    """time of the last start from standstill [s]"""
    gap_error: Array
    leader_error: Array
    driving_error: Array
    speed_gain: Array
    """accumulated relative speed gain of a change to the left; negative: to the right"""
    keep_right: Array
    """accumulated obligation to keep right, negative"""
    look_ahead_speed: Array
    """smoothed speed that determines the look-ahead distance of mandatory changes"""
    lane_change_advice: Array
    """acceleration that helps the own lane change [m/s2], or `NO_ADVICE`"""
    cooperative_advice: Array
    """acceleration that helps the lane change of another vehicle"""
    adjacent_advice: Array
    """acceleration that avoids passing on the right, or lets a stuck vehicle merge"""
    speed_bias: Array
    """preference for a speed halfway to the maximum safe speed (1) or to the minimum speed (-1); 0 without one"""

    def map(self, function: Callable[..., Any], *others: "MotorwayVehicles") -> "MotorwayVehicles":
        """Return the vehicles after applying `function` to each column."""
        return MotorwayVehicles(*(function(*values) for values in zip(self, *others, strict=True)))

    def select(self, index: Array) -> "MotorwayVehicles":
        """Return the vehicles of some rows, in the order of the rows."""
        index = as_rows(index)
        return self.map(lambda values: values[index])

    def replace_rows(self, rows: Array, **values: Any) -> "MotorwayVehicles":
        """Return the vehicles with new values of some columns in some rows."""
        columns = {name: getattr(self, name).copy() for name in values}
        for name, column in columns.items():
            column[rows] = values[name]
        return self._replace(**columns)

    @property
    def drivers(self) -> "MotorwayDrivers":
        """The drivers of the vehicles."""
        speed = np.minimum(self.desired_speed, self.speed_cap)
        parameters = IDMArrays(speed, self.time_headway, self.max_acceleration, self.braking, 4.0, self.minimum_gap)
        errors = DriverErrors(self.gap_error, self.leader_error, self.driving_error)
        return MotorwayDrivers(parameters, errors, self.is_eidm)


class MotorwayDrivers(NamedTuple):
    """Drivers of n vehicles, each SUMO's EIDM or IDM."""

    parameters: IDMArrays
    errors: DriverErrors
    is_eidm: Array

    def select(self, index: Array) -> "MotorwayDrivers":
        """Return the drivers of some rows."""
        index = as_rows(index)
        parameters = IDMArrays(
            *(parameter if type(parameter) is float else parameter[index] for parameter in self.parameters)
        )
        return MotorwayDrivers(parameters, DriverErrors(*(error[index] for error in self.errors)), self.is_eidm[index])

    def follow_speed(self, speed: Array, gap: Array, leader_speed: Array, step: float) -> Array:
        """Return the desired speeds after a step with bumper-to-bumper gaps to leaders."""
        return self.desired_speed(speed, gap, leader_speed, step).speed

    def desired_speed(
        self, speed: Array, gap: Array, leader_speed: Array, step: float, motion: LeaderMotion | None = None
    ) -> DesiredSpeed:
        """Return the desired speeds as `follow_speed`, with accelerations; `motion` of leaders can reduce braking."""
        speeds, uncooled = eidm.eidm_follow_speed(speed, gap, leader_speed, self.parameters, self.errors, step, motion)
        desired = self._select_model(speeds, _idm_follow_speed, speed, gap, leader_speed, step=step)
        return DesiredSpeed(desired, np.where(self.is_eidm, uncooled, (desired - speed) / step))

    def stop_speed(self, speed: Array, distance: Array, step: float) -> Array:
        """Return the desired speeds after a step of drivers that must stop within a distance."""
        speeds = eidm.eidm_stop_speed(speed, distance, self.parameters, self.errors, step)
        return self._select_model(speeds, _idm_stop_speed, speed, distance, step=step)

    def secure_gap(self, speed: Array, leader_speed: Array) -> Array:
        """Return the gap, beyond the minimum gap, that drivers require for a lane change (`getSecureGap`)."""
        p = self.parameters
        gap = desired_gap(speed, speed - leader_speed, p) - p.minimum_gap
        divisor = square_root(p.comfortable_deceleration / p.max_acceleration + 1.0)
        return gap / np.where(self.is_eidm, divisor, 1.0)

    def safe_speed(self, gap: Array, leader_speed: Array, leader_braking: Array, step: float) -> Array:
        """Return the maximum speeds from which drivers can stop behind braking leaders after a time headway.

        Gaps are those beyond the minimum gap. Source: SUMO's MSCFModel (`maximumSafeFollowSpeed`).
        """
        braking = self.parameters.comfortable_deceleration
        change, delay = braking * step, self.parameters.time_headway / step
        stop_distance = stopping_distance(leader_speed, np.maximum(braking, leader_braking), step)
        room = (clamp_min(gap, 0.0) + stop_distance) / step
        # n whole steps of braking from v = n b h + r require n b h ((n - 1) / 2 + delay) + (n + delay) r = room.
        steps = np.floor(0.5 - delay + square_root(0.25 + delay * (delay - 1.0) + 2.0 * room / change))
        remaining_gap = room - change * steps * ((steps - 1.0) / 2.0 + delay)
        return change * steps + remaining_gap / (steps + delay)

    def brake_gap(self, speed: Array, step: float) -> Array:
        """Return the stopping distances of drivers that brake after their time headway."""
        braking, time_headway = self.parameters.comfortable_deceleration, self.parameters.time_headway
        return stopping_distance(speed, braking, step) + speed * time_headway

    def _select_model(
        self, eidm_values: Array, idm_function: Callable[..., Array], *values: Array, **options: float
    ) -> Array:
        """Return `eidm_values` for EIDM drivers, and the values of `idm_function` for IDM drivers."""
        is_idm = as_rows(~self.is_eidm)
        if not len(is_idm):
            return eidm_values
        eidm_values = eidm_values + 0.0
        eidm_values[is_idm] = idm_function(
            *(value[is_idm] for value in values), self.select(is_idm).parameters, **options
        )
        return eidm_values


def _idm_follow_speed(speed: Array, gap: Array, leader_speed: Array, parameters: IDMArrays, step: float) -> Array:
    substep = step / eidm.EIDM_SUBSTEPS
    for _ in range(eidm.EIDM_SUBSTEPS):
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, SUMO_MIN_GAP), parameters, fast_power)
        speed = next_speed(speed, acceleration, substep)
        gap = gap - clamp_min(speed - leader_speed, 0.0) * substep
    return speed


def _idm_stop_speed(speed: Array, distance: Array, parameters: IDMArrays, step: float) -> Array:
    stop_parameters = parameters._replace(minimum_gap=0.0 * parameters.minimum_gap)
    return _idm_follow_speed(speed, distance, 0.0 * speed, stop_parameters, step) * (distance >= MIN_IDM_STOP_DISTANCE)


def vehicle_keys(vehicles: MotorwayVehicles, rows: Any = slice(None)) -> Array:
    """Return a key for each vehicle in `rows`: the index of its road and that of its entry as one integer."""
    return vehicles.road[rows] * KEYS_PER_ROAD + vehicles.entry[rows]


def find_rows(keys: Array, vehicles: MotorwayVehicles, candidates: Array) -> Array:
    """Return the row of the vehicle with each key among the rows `candidates`; `NO_VEHICLE` if it is not there."""
    if not len(candidates):
        return 0 * keys + NO_VEHICLE
    candidate_keys = vehicle_keys(vehicles, candidates)
    order = candidate_keys.argsort()
    rows = order[np.searchsorted(candidate_keys[order], keys).clip(0, len(order) - 1)]
    return np.where(candidate_keys[rows] == keys, candidates[rows], NO_VEHICLE)


def sorted_rows(vehicles: MotorwayVehicles) -> Array:
    """Return the rows of the vehicles sorted by road and from front to back."""
    return (vehicles.road * 1e6 - vehicles.position).argsort(stable=True)


def sort_vehicles(vehicles: MotorwayVehicles) -> MotorwayVehicles:
    """Return the vehicles sorted by road and from front to back."""
    return vehicles.select(sorted_rows(vehicles))
