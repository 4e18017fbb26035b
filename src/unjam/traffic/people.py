"""How commanded people drive: the paper's IDM with noise, as a speed for each step, as Flow does it."""

from collections.abc import Sequence
from typing import Any

from unjam.drivers.idm import SMALLEST_GAP
from unjam.physics.arrays import at_least
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario

LEAVE_TO_SUMO = -1.0
"""the commanded speed that stands for none"""


def wanted_speeds(
    scenario: Scenario,
    road: ClosedRoad,
    people: Sequence[int],
    speeds: Sequence[float],
    positions: Any,
    noise: Sequence[float],
) -> list[float]:
    """Return the speeds that people want after the next step [m/s]; on a crossing SUMO drives them.

    Args:
        scenario: whose IDM they drive by.
        road: on which they drive, closed and with one lane.
        people: their places in road order.
        speeds: of all vehicles [m/s], by place.
        positions: of all front bumpers along the road, not wrapped [m], by place.
        noise: by how much noise changes each speed [m/s], by place.
    """
    step, loop, humans, count = scenario.simulation_step, road.loop_length, scenario.humans, len(speeds)
    wanted = []
    for place in people:
        position = positions[place]
        on_road = position % loop
        if any(start <= on_road < end for start, end in road.crossings):
            wanted.append(LEAVE_TO_SUMO)
            continue
        ahead = place + 1 if place + 1 < count else 0
        gap = gap_on_loop(position, positions[ahead], loop, VEHICLE_LENGTH)
        speed = speeds[place]
        acceleration = idm_acceleration(speed, speeds[ahead], at_least(gap, SMALLEST_GAP), humans)
        wanted.append(at_least(speed + acceleration * step + noise[place], 0.0))
    return wanted
