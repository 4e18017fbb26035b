"""How SUMO's own models follow and stop beneath commands: a quick IDM for people, a Krauss model for CAVs.

Arrays have shape (vehicles, W). Sources: SUMO's MSCFModel_IDM (`_v`, `followSpeed`, `stopSpeed`),
MSCFModel_Krauss, MSCFModel (`maximumSafeStopSpeedEuler`, `maximumSafeFollowSpeed`, `getMinimalArrivalTime`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.physics.arrays import Array, at_least, at_most, namespace, square_root
from unjam.physics.idm import IDMParameters, by_squaring, idm_acceleration
from unjam.physics.kinematics import next_speed, speed_to_stop_within, stopping_distance
from unjam.scenarios.scenario import ACCELERATION, SMALLEST_CAV_GAP, Scenario
from unjam.worlds.batch.lanes import sight
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.people import EMERGENCY_BRAKING, SMALLEST_GAP, without_gap

PEOPLES_BRAKING = 4.5
"""of commanded people's layer [m/s2]"""
HALTING = 0.1
"""speed below which SUMO says that a vehicle stands [m/s]"""
NO_ROOM = 0.01
"""way below which people's `stopSpeed` is zero [m]"""


@dataclass(frozen=True)
class Layer:
    """The models of the vehicles of a road: those at some places are CAVs, the others people."""

    people: IDMParameters
    """of commanded people"""
    cavs: list[int]
    """places of those that are driven by commands of a driver"""
    braking: Array
    """that SUMO gives each [m/s2], shape (vehicles, 1)"""
    emergency: Array
    """hardest braking of each [m/s2], likewise"""
    keeps: Array
    """gap that SUMO keeps for each [m], likewise"""
    headway: Array
    """time headway of each [s], likewise"""
    cavs_braking: float
    """[m/s2]"""
    top: float
    """what the road allows [m/s]"""
    step: float
    """[s]"""

    def follow(self, speed: Array, leader_speed: Array, gap: Array) -> Array:
        """Return how fast each drives at most behind somebody a gap ahead [m/s]."""
        found = self._idm(speed, leader_speed, gap, self.people)
        if own := self.cavs:
            room = (
                gap[own]
                - SMALLEST_CAV_GAP
                + stopping_distance(leader_speed[own], self.cavs_braking, self.step)
            )
            found[own] = self._krauss(speed[own], room)
        return found

    def stop(self, speed: Array, way: Array) -> Array:
        """Return how fast each drives at most that must stand within a way [m/s]."""
        xp = namespace(speed)
        found = self._idm(speed, 0.0, way, without_gap(self.people))
        creep = (speed < SMALLEST_GAP) & (found < SMALLEST_GAP)
        if bool(creep.any()):  # the IDM would not start again before a line
            reached = speed_to_stop_within(way - SMALLEST_GAP, PEOPLES_BRAKING, self.step)
            found = xp.where(creep, reached, found)
        found = xp.minimum(found, way / self.step) * (way >= NO_ROOM)
        if own := self.cavs:
            found[own] = self._krauss(speed[own], way[own])
        return found

    def within_limits(self, speed: Array, wanted: Array) -> Array:
        """Return speeds that engine and brakes allow [m/s]."""
        xp = namespace(speed)
        return xp.maximum(xp.minimum(wanted, self.fastest(speed)), self.slowest(speed))

    def slowest(self, speed: Array) -> Array:
        """Return the lowest speed after a step, but in an emergency [m/s]."""
        return at_least(speed - self.braking * self.step, 0.0)

    def fastest(self, speed: Array) -> Array:
        """Return the highest speed after a step [m/s]."""
        return at_most(speed + ACCELERATION * self.step, self.top)

    def finished(self, speed: Array, safe: Array) -> Array:
        """Return what nobody commands drives after a step, where so much is safe [m/s]."""
        xp = namespace(speed)
        hard = at_least(speed - self.emergency * self.step, 0.0)
        slowest = xp.minimum(self.slowest(speed), xp.maximum(safe, hard))
        return xp.maximum(slowest, xp.minimum(self.fastest(speed), safe))

    def brake_gap(self, speed: Array) -> Array:
        """Return the way in which each can stand, from the next step on [m]."""
        return stopping_distance(speed, self.braking, self.step)

    def sight(self, speed: Array) -> Array:
        """Return how far each looks ahead: the way to stand after its headway, as fast as it may be [m]."""
        return sight(self.fastest(speed), self.headway, self.braking, self.step)

    def arrival(self, way: Array, speed: Array, arrival_speed: Array) -> Array:
        """Return the soonest time in which a way is driven that ends with a speed at most [s]."""
        xp = namespace(speed)
        faster = arrival_speed >= speed
        acceleration = xp.where(faster, ACCELERATION + 0.0 * speed, -self.braking + 0.0 * speed)
        while_changing = (arrival_speed - speed) / acceleration
        changing = while_changing * (arrival_speed + speed) * 0.5
        steady = at_least(xp.maximum(speed, arrival_speed), HALTING)
        within = at_least(speed * speed + 2.0 * acceleration * way, 0.0)
        sooner = (square_root(within) - speed) / acceleration
        return xp.where(way >= changing, while_changing + (way - changing) / steady, sooner)

    def _idm(self, speed: Array, leader_speed: Array, gap: Array, people: Any) -> Array:
        acceleration = idm_acceleration(speed, leader_speed, at_least(gap, SMALLEST_GAP), people, by_squaring)
        return next_speed(speed, acceleration, self.step)

    def _krauss(self, speed: Array, room: Array) -> Array:
        within = speed_to_stop_within(room - SMALLEST_GAP, self.cavs_braking, self.step)
        return namespace(speed).minimum(within, self.fastest(speed))


def layer_of(scenario: Scenario, vehicles: int, cavs: list[int], numbers: Numbers) -> Layer:
    """Return the models of a road on which those at the places `cavs` are driven by a driver."""
    braking, emergency = np.full((vehicles, 1), PEOPLES_BRAKING), np.full((vehicles, 1), EMERGENCY_BRAKING)
    braking[cavs] = emergency[cavs] = scenario.cav_brakes
    keeps = np.zeros((vehicles, 1))
    keeps[cavs] = SMALLEST_CAV_GAP
    headway = np.ones((vehicles, 1))
    headway[cavs] = scenario.simulation_step
    people = IDMParameters(
        desired_speed=scenario.top_speed,
        time_headway=1.0,
        max_acceleration=ACCELERATION,
        comfortable_deceleration=PEOPLES_BRAKING,
        exponent=scenario.humans.exponent,
        minimum_gap=1e-9,
    )
    return Layer(
        people=people,
        cavs=cavs,
        braking=numbers(braking),
        emergency=numbers(emergency),
        keeps=numbers(keeps),
        headway=numbers(headway),
        cavs_braking=scenario.cav_brakes,
        top=scenario.top_speed,
        step=scenario.simulation_step,
    )


def speed_after(way: Array, speed: Array) -> Array:
    """Return how fast somebody is who speeds up over a way [m/s]."""
    return square_root(2.0 * ACCELERATION * at_least(way, 0.0) + speed * speed)
