"""SUMO's car-following models that limit commanded vehicles: an IDM for human drivers, and a Krauss model for CAVs.

Arrays have shape (vehicles, W). Sources: SUMO's MSCFModel_IDM (`_v`, `followSpeed`, `stopSpeed`), MSCFModel_Krauss,
MSCFModel (`maximumSafeStopSpeedEuler`, `maximumSafeFollowSpeed`, `getMinimalArrivalTime`).
"""

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, square_root
from unjam.physics.idm import IDMArrays, IDMParameters, fast_power, idm_acceleration
from unjam.physics.kinematics import HALTING_SPEED, max_speed_to_stop, next_speed, stopping_distance
from unjam.scenarios.scenario import MIN_CAV_GAP, SUMO_ACCELERATION, Scenario
from unjam.worlds.batch.human_idm import EMERGENCY_BRAKING, SUMO_MIN_GAP, look_ahead_distance, set_zero_minimum_gap
from unjam.worlds.batch.noise import ArrayFactory

COMMANDED_HUMAN_BRAKING = 4.5
"""deceleration of the SUMO model that limits commanded human drivers [m/s2]"""
MIN_STOP_DISTANCE = 0.01
"""distance below which the `stopSpeed` of human drivers is zero [m]"""


class CarFollowingModels:
    """The SUMO models of all vehicles of a road: CAVs and commanded human drivers."""

    def __init__(self, scenario: Scenario, vehicle_count: int, cav_indices: list[int], to_array: ArrayFactory) -> None:
        self._cav_indices, self._cav_braking = cav_indices, scenario.cav_max_braking
        self._step, self.speed_limit = scenario.simulation_step, scenario.top_speed
        """speed limit of the road [m/s]"""
        self._humans = IDMParameters(
            desired_speed=scenario.top_speed,
            time_headway=1.0,
            max_acceleration=SUMO_ACCELERATION,
            comfortable_deceleration=COMMANDED_HUMAN_BRAKING,
            exponent=scenario.humans.exponent,
            minimum_gap=1e-9,
        )
        self._humans_before_stop = set_zero_minimum_gap(self._humans)

        def make_column(human_value: float, cav_value: float) -> Array:
            column = np.full((vehicle_count, 1), human_value)
            column[cav_indices] = cav_value
            return to_array(column)

        self.braking = make_column(COMMANDED_HUMAN_BRAKING, self._cav_braking)
        """deceleration of the SUMO model [m/s2], shape (vehicles, 1)"""
        self._emergency_braking = make_column(EMERGENCY_BRAKING, self._cav_braking)
        self.minimum_gap = make_column(0.0, MIN_CAV_GAP)
        """minimum gap of the SUMO model [m], shape (vehicles, 1)"""
        self._time_headway = make_column(1.0, scenario.simulation_step)

    def follow_speed(self, speed: Array, leader_speed: Array, gap: Array) -> Array:
        """Return the maximum speeds after a step behind leaders [m/s]."""
        new_speed = self._idm_speed(speed, leader_speed, gap, self._humans)
        if cavs := self._cav_indices:
            distance = gap[cavs] - MIN_CAV_GAP + stopping_distance(leader_speed[cavs], self._cav_braking, self._step)
            new_speed[cavs] = self._krauss_speed(speed[cavs], distance)
        return new_speed

    def stop_speed(self, speed: Array, distance: Array) -> Array:
        """Return the maximum speeds after a step of vehicles that must stop within a distance [m/s]."""
        xp = namespace(speed)
        stop_speed = self._idm_speed(speed, 0.0, distance, self._humans_before_stop)
        creeps = (speed < SUMO_MIN_GAP) & (stop_speed < SUMO_MIN_GAP)
        if bool(creeps.any()):  # the IDM would stand still too far from the stop line
            reachable = max_speed_to_stop(distance - SUMO_MIN_GAP, COMMANDED_HUMAN_BRAKING, self._step)
            stop_speed = xp.where(creeps, reachable, stop_speed)
        stop_speed = xp.minimum(stop_speed, distance / self._step) * (distance >= MIN_STOP_DISTANCE)
        if cavs := self._cav_indices:
            stop_speed[cavs] = self._krauss_speed(speed[cavs], distance[cavs])
        return stop_speed

    def clip_speed(self, speed: Array, wanted_speed: Array) -> Array:
        """Limit wanted speeds after a step to the limits of engine and brakes [m/s]."""
        xp = namespace(speed)
        return xp.maximum(xp.minimum(wanted_speed, self.max_speed(speed)), self.min_speed(speed))

    def min_speed(self, speed: Array) -> Array:
        """Return the minimum speeds after a step without emergency braking [m/s]."""
        return clamp_min(speed - self.braking * self._step, 0.0)

    def max_speed(self, speed: Array) -> Array:
        """Return the maximum speeds after a step [m/s]."""
        return clamp_max(speed + SUMO_ACCELERATION * self._step, self.speed_limit)

    def finalize_speed(self, speed: Array, safe_speed: Array) -> Array:
        """Return the speeds after a step of vehicles without commands, given their safe speeds [m/s]."""
        xp = namespace(speed)
        emergency = clamp_min(speed - self._emergency_braking * self._step, 0.0)
        min_speed = xp.minimum(self.min_speed(speed), xp.maximum(safe_speed, emergency))
        return xp.maximum(min_speed, xp.minimum(self.max_speed(speed), safe_speed))

    def brake_gap(self, speed: Array) -> Array:
        """Return the stopping distances if vehicles brake from the next step on [m]."""
        return stopping_distance(speed, self.braking, self._step)

    def look_ahead_distance(self, speed: Array) -> Array:
        """Return the look-ahead distances: to stop from the maximum speeds of this step after a time headway [m]."""
        return look_ahead_distance(self.max_speed(speed), self._time_headway, self.braking, self._step)

    def arrival_time(self, distance: Array, speed: Array, arrival_speed: Array) -> Array:
        """Return the minimum times to drive a distance and reach its end with at most `arrival_speed` [s]."""
        xp = namespace(speed)
        acceleration = xp.where(arrival_speed >= speed, SUMO_ACCELERATION + 0.0 * speed, -self.braking + 0.0 * speed)
        change_time = (arrival_speed - speed) / acceleration
        change_distance = change_time * (arrival_speed + speed) * 0.5
        steady_speed = clamp_min(xp.maximum(speed, arrival_speed), HALTING_SPEED)
        squared_speed = clamp_min(speed * speed + 2.0 * acceleration * distance, 0.0)
        time_while_changing = (square_root(squared_speed) - speed) / acceleration
        time = change_time + (distance - change_distance) / steady_speed
        return xp.where(distance >= change_distance, time, time_while_changing)

    def _idm_speed(self, speed: Array, leader_speed: Array, gap: Array, parameters: IDMParameters | IDMArrays) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, SUMO_MIN_GAP), parameters, fast_power)
        return next_speed(speed, acceleration, self._step)

    def _krauss_speed(self, speed: Array, stop_distance: Array) -> Array:
        safe = max_speed_to_stop(stop_distance - SUMO_MIN_GAP, self._cav_braking, self._step)
        return namespace(speed).minimum(safe, self.max_speed(speed))


def speed_after_distance(distance: Array, speed: Array) -> Array:
    """Return the speeds of vehicles after full acceleration over a distance [m/s]."""
    return square_root(2.0 * SUMO_ACCELERATION * clamp_min(distance, 0.0) + speed * speed)
