"""How all vehicles of W figures eight move: people are commanded, and SUMO's right of way rules all."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.physics.arrays import Array, at_least
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.crossing import Crossing, Memory
from unjam.worlds.batch.lanes import Leader
from unjam.worlds.batch.layer import layer_of
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.people import People
from unjam.worlds.record import Floats

ROUNDING = 1e-9
"""[m/s]"""


def commanded_speed(speed: Array, leader_speed: Array, gap: Array, people: Any, step: float) -> Array:
    """Return the speeds that people are commanded, before noise is added; those below 0 are not cut off.

    Arguments as of `people_speed`.
    """
    return speed + idm_acceleration(speed, leader_speed, at_least(gap, SMALLEST_GAP), people) * step


class EightMovement:
    """People are commanded the IDM's speeds with noise, but on the crossing; all obey the right of way."""

    def __init__(
        self,
        scenario: Scenario,
        roads: Sequence[ClosedRoad],
        places: list[int],
        numbers: Numbers,
        people: People | None = None,
    ) -> None:
        """Take the places of CAVs among the vehicles; people drive them until they are handed over.

        `people` is what people are commanded; None: the road's IDM.
        """
        vehicles = len(roads[0].vehicle_ids)
        idm = partial(commanded_speed, people=scenario.humans, step=scenario.simulation_step)
        self._people, self._places = people or idm, places
        self._crossing = Crossing(scenario, roads, numbers)
        self._layer = layer_of(scenario, vehicles, [], numbers)
        self._with_cavs = layer_of(scenario, vehicles, places, numbers)

    def hand_over(self) -> None:
        """Let drivers drive the CAVs from now on."""
        self._layer = self._with_cavs

    def moved(self, speed: Array, position: Array, ahead: Leader, noise: Array, cavs: Array) -> Array:
        """Return the speeds after a step [m/s], shape (vehicles, W).

        Args:
            speed: [m/s], likewise.
            position: front bumpers along the road, not wrapped [m], likewise.
            ahead: the vehicle ahead of each.
            noise: by how much noise changes each speed [m/s], likewise, or 0.
            cavs: the speeds that CAVs are told, shape (CAVs, W) [m/s]; None: they are human.
        """
        wanted = at_least(self._people(speed, *ahead) + noise, 0.0)
        told = ~self._crossing.inside(position)
        if cavs is not None:
            wanted[self._places], told[self._places] = cavs, True
        return self._crossing.moved(self._layer, speed, position, ahead, wanted, told)

    @property
    def memory(self) -> Memory:
        """Who waits since when, and who is on the crossing."""
        return self._crossing.memory

    def remember(self, memory: Sequence[Memory]) -> None:
        """Go on from what earlier steps left, road by road."""
        self._crossing.remember(memory)


def waits_of(scenario: Scenario, road: ClosedRoad, speeds: Floats, positions: Floats) -> Memory:
    """Return who waits since when at each step of an episode, and who is on the crossing, (steps, vehicles).

    Args:
        scenario: what the episode was driven on.
        road: likewise, as it was drawn.
        speeds: of all vehicles in road order at each step [m/s], shape (steps, vehicles).
        positions: front bumpers along the road [m], likewise.
    """
    crossing, found = Crossing(scenario, [road], np.asarray), list[Memory]()
    for at in range(len(speeds)):
        found.append(crossing.memory)
        if at + 1 < len(speeds):
            crossing.watch(speeds[at][:, None], speeds[at + 1][:, None], positions[at][:, None])
    return Memory(*(np.concatenate(each, 1).T for each in zip(*found, strict=True)))


def heeded(
    scenario: Scenario,
    road: ClosedRoad,
    places: list[int],
    waits: Memory,
    moment: tuple[Floats, Floats],
    wanted: Floats,
) -> NDArray[np.bool_]:
    """Return whether the right of way lets vehicles do what they are commanded, shape (moments, vehicles).

    Args:
        scenario: what the episode was driven on.
        road: likewise, as it was drawn.
        places: of the CAVs among the vehicles.
        waits: what `waits_of` returns, at the moments.
        moment: speeds and positions [m/s, m], shape (moments, vehicles).
        wanted: speeds that vehicles are commanded [m/s], likewise.
    """
    speed, position, told = (each.T for each in (*moment, wanted))
    movement = EightMovement(scenario, [road] * len(wanted), places, np.asarray, lambda *_: told)
    movement.hand_over()
    movement.remember([Memory(*each) for each in zip(*waits, strict=True)])
    gap = gap_on_loop(position, np.roll(position, -1, 0), road.loop_length, VEHICLE_LENGTH)
    ahead = Leader(np.roll(speed, -1, 0), gap)
    moved = movement.moved(speed, position, ahead, 0.0, told[places])
    return (np.abs(moved - told) < ROUNDING).T
