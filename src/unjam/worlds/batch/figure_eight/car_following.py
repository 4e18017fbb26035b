"""How SUMO's own models follow and stop beneath commands: a quick IDM for people, a Krauss model for CAVs.

Arrays have shape (vehicles, W). Sources: SUMO's MSCFModel_IDM (`_v`, `followSpeed`, `stopSpeed`),
MSCFModel_Krauss, MSCFModel (`maximumSafeStopSpeedEuler`, `maximumSafeFollowSpeed`, `getMinimalArrivalTime`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, square_root
from unjam.physics.idm import IDMParameters, fast_power, idm_acceleration
from unjam.physics.kinematics import max_speed_to_stop, next_speed, stopping_distance
from unjam.scenarios.scenario import MIN_CAV_GAP, SUMO_ACCELERATION, Scenario
from unjam.worlds.batch.human_idm import EMERGENCY_BRAKING, SUMO_MIN_GAP, without_minimum_gap
from unjam.worlds.batch.leaders import look_ahead_distance
from unjam.worlds.batch.noise import ArrayFactory

COMMANDED_HUMAN_BRAKING = 4.5
"""of commanded people's layer [m/s2]"""
HALTING_SPEED = 0.1
"""speed below which SUMO says that a vehicle stands [m/s]"""
MIN_STOP_DISTANCE = 0.01
"""way below which people's `stopSpeed` is zero [m]"""


@dataclass(frozen=True)
class CarFollowingModels:
    """The models of the vehicles of a road: those at some places are CAVs, the others people."""

    human_parameters: IDMParameters
    """of commanded people"""
    cav_indices: list[int]
    """places of those that are driven by commands of a driver"""
    braking: Array
    """that SUMO gives each [m/s2], shape (vehicles, 1)"""
    emergency_braking: Array
    """hardest braking of each [m/s2], likewise"""
    minimum_gap: Array
    """gap that SUMO keeps for each [m], likewise"""
    time_headway: Array
    """time headway of each [s], likewise"""
    cav_braking: float
    """[m/s2]"""
    speed_limit: float
    """what the road allows [m/s]"""
    step: float
    """[s]"""

    def follow_speed(self, speed: Array, leader_speed: Array, gap: Array) -> Array:
        """Return how fast each drives at most behind somebody a gap ahead [m/s]."""
        found = self._idm_speed(speed, leader_speed, gap, self.human_parameters)
        if own := self.cav_indices:
            room = gap[own] - MIN_CAV_GAP + stopping_distance(leader_speed[own], self.cav_braking, self.step)
            found[own] = self._krauss_speed(speed[own], room)
        return found

    def stop_speed(self, speed: Array, distance: Array) -> Array:
        """Return how fast each drives at most that must stand within a way [m/s]."""
        xp = namespace(speed)
        found = self._idm_speed(speed, 0.0, distance, without_minimum_gap(self.human_parameters))
        creep = (speed < SUMO_MIN_GAP) & (found < SUMO_MIN_GAP)
        if bool(creep.any()):  # the IDM would not start again before a line
            reached = max_speed_to_stop(distance - SUMO_MIN_GAP, COMMANDED_HUMAN_BRAKING, self.step)
            found = xp.where(creep, reached, found)
        found = xp.minimum(found, distance / self.step) * (distance >= MIN_STOP_DISTANCE)
        if own := self.cav_indices:
            found[own] = self._krauss_speed(speed[own], distance[own])
        return found

    def clip_speed(self, speed: Array, wanted_speed: Array) -> Array:
        """Return speeds that engine and brakes allow [m/s]."""
        xp = namespace(speed)
        return xp.maximum(xp.minimum(wanted_speed, self.max_speed(speed)), self.min_speed(speed))

    def min_speed(self, speed: Array) -> Array:
        """Return the lowest speed after a step, but in an emergency [m/s]."""
        return clamp_min(speed - self.braking * self.step, 0.0)

    def max_speed(self, speed: Array) -> Array:
        """Return the highest speed after a step [m/s]."""
        return clamp_max(speed + SUMO_ACCELERATION * self.step, self.speed_limit)

    def finalize_speed(self, speed: Array, safe_speed: Array) -> Array:
        """Return what nobody commands drives after a step, where so much is safe [m/s]."""
        xp = namespace(speed)
        hard = clamp_min(speed - self.emergency_braking * self.step, 0.0)
        slowest = xp.minimum(self.min_speed(speed), xp.maximum(safe_speed, hard))
        return xp.maximum(slowest, xp.minimum(self.max_speed(speed), safe_speed))

    def brake_gap(self, speed: Array) -> Array:
        """Return the way in which each can stand, from the next step on [m]."""
        return stopping_distance(speed, self.braking, self.step)

    def look_ahead_distance(self, speed: Array) -> Array:
        """Return how far each looks ahead: the way to stand after its headway, as fast as it may be [m]."""
        return look_ahead_distance(self.max_speed(speed), self.time_headway, self.braking, self.step)

    def arrival_time(self, distance: Array, speed: Array, arrival_speed: Array) -> Array:
        """Return the soonest time in which a way is driven that ends with a speed at most [s]."""
        xp = namespace(speed)
        faster = arrival_speed >= speed
        acceleration = xp.where(faster, SUMO_ACCELERATION + 0.0 * speed, -self.braking + 0.0 * speed)
        while_changing = (arrival_speed - speed) / acceleration
        changing = while_changing * (arrival_speed + speed) * 0.5
        steady = clamp_min(xp.maximum(speed, arrival_speed), HALTING_SPEED)
        within = clamp_min(speed * speed + 2.0 * acceleration * distance, 0.0)
        sooner = (square_root(within) - speed) / acceleration
        return xp.where(distance >= changing, while_changing + (distance - changing) / steady, sooner)

    def _idm_speed(self, speed: Array, leader_speed: Array, gap: Array, parameters: Any) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, clamp_min(gap, SUMO_MIN_GAP), parameters, fast_power)
        return next_speed(speed, acceleration, self.step)

    def _krauss_speed(self, speed: Array, stop_distance: Array) -> Array:
        within = max_speed_to_stop(stop_distance - SUMO_MIN_GAP, self.cav_braking, self.step)
        return namespace(speed).minimum(within, self.max_speed(speed))


def make_car_following_models(
    scenario: Scenario, vehicle_count: int, cav_indices: list[int], to_array: ArrayFactory
) -> CarFollowingModels:
    """Return the models of a road on which those at the places `cavs` are driven by a driver."""
    braking, emergency = (
        np.full((vehicle_count, 1), COMMANDED_HUMAN_BRAKING),
        np.full((vehicle_count, 1), EMERGENCY_BRAKING),
    )
    braking[cav_indices] = emergency[cav_indices] = scenario.cav_max_braking
    keeps = np.zeros((vehicle_count, 1))
    keeps[cav_indices] = MIN_CAV_GAP
    headway = np.ones((vehicle_count, 1))
    headway[cav_indices] = scenario.simulation_step
    people = IDMParameters(
        desired_speed=scenario.top_speed,
        time_headway=1.0,
        max_acceleration=SUMO_ACCELERATION,
        comfortable_deceleration=COMMANDED_HUMAN_BRAKING,
        exponent=scenario.humans.exponent,
        minimum_gap=1e-9,
    )
    return CarFollowingModels(
        human_parameters=people,
        cav_indices=cav_indices,
        braking=to_array(braking),
        emergency_braking=to_array(emergency),
        minimum_gap=to_array(keeps),
        time_headway=to_array(headway),
        cav_braking=scenario.cav_max_braking,
        speed_limit=scenario.top_speed,
        step=scenario.simulation_step,
    )


def speed_after_distance(distance: Array, speed: Array) -> Array:
    """Return how fast somebody is who speeds up over a way [m/s]."""
    return square_root(2.0 * SUMO_ACCELERATION * clamp_min(distance, 0.0) + speed * speed)
