"""How commanded people drive: IDM with noise, as a speed for each step, as Flow does it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.physics.arrays import at_least
from unjam.physics.idm import IDMParameters, idm_acceleration
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.road import ClosedRoad, Road
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario

LEAVE_TO_SUMO = -1.0
"""the commanded speed that stands for none"""


def drivers_of(scenario: Scenario, road: Road, names: Sequence[str]) -> list[IDMParameters]:
    """Return how the human driver of each vehicle drives."""
    return [road.people.get(name, scenario.humans) for name in names]


def wanted_speeds(
    scenario: Scenario,
    road: ClosedRoad,
    drivers: Sequence[IDMParameters],
    people: Sequence[int],
    speeds: Sequence[float],
    positions: Any,
    noise: Sequence[float],
) -> list[float]:
    """Return the speeds that people want after the next step [m/s]; on a crossing SUMO drives them.

    Args:
        scenario: whose people they are.
        road: on which they drive, closed and with one lane.
        drivers: how each drives, by place.
        people: their places in road order.
        speeds: of all vehicles [m/s], by place.
        positions: of all front bumpers along the road, not wrapped [m], by place.
        noise: by how much noise changes each speed [m/s], by place.
    """
    step, loop, count = scenario.simulation_step, road.loop_length, len(speeds)
    population, crossings = scenario.calibrated, road.crossings
    wanted: list[float] = [LEAVE_TO_SUMO] * len(people)
    seen: list[tuple[int, float, float, float, float]] = []
    for index, place in enumerate(people):
        position = positions[place]
        on_road = position % loop
        for start, end in crossings:  # any() would cost as much as the rest
            if start <= on_road < end:
                break
        else:
            ahead = place + 1 if place + 1 < count else 0
            gap = at_least(gap_on_loop(position, positions[ahead], loop, VEHICLE_LENGTH), SMALLEST_GAP)
            speed = speeds[place]
            acceleration = idm_acceleration(speed, speeds[ahead], gap, drivers[place])
            if population is None:
                wanted[index] = at_least(speed + acceleration * step + noise[place], 0.0)
            else:
                seen.append((index, acceleration, speed, speeds[ahead], gap))
    if seen:  # a population's network is asked once for all
        _, *columns = (np.array(column, np.float64) for column in zip(*seen, strict=True))
        for (index, _, speed, *_), acceleration in zip(
            seen, as_calibrated(population, *columns).tolist(), strict=True
        ):
            wanted[index] = at_least(speed + acceleration * step + noise[people[index]], 0.0)
    return wanted
