"""How all vehicles of a batch move in a step: on rings by SUMO's IDM, on figures eight as commanded."""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple, Protocol

import numpy as np

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.physics.arrays import Array, at_least, at_most, namespace
from unjam.physics.idm import IDMParameters, IDMRows, idm_acceleration
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.crossing import Crossing, Memory
from unjam.worlds.batch.eight import touching_across
from unjam.worlds.batch.lanes import Leader, end_of_lane, leaders, touching
from unjam.worlds.batch.layer import layer_of
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.people import People, parameters_of, people_speed, without_gap


class Step(NamedTuple):
    """What a step begins with; arrays of shape (vehicles, W)."""

    speed: Array
    """[m/s]"""
    position: Array
    """front bumpers along the road, not wrapped [m]"""
    ahead: Leader
    """the vehicle ahead of each"""
    noise: Array
    """by how much noise changes each speed, 0 for CAVs [m/s]; None: there is none"""
    commanded: Array
    """the speeds that CAVs are told, shape (CAVs, W) [m/s]; None: they are human"""


class Movement(Protocol):
    """How the vehicles of W roads move."""

    def after(self, now: Step) -> tuple[Array, Array]:
        """Return the speeds with which all move in a step, and those that they have after it [m/s]."""
        ...

    def collided(self, position: Array, gap: Array, loop: Array) -> Array:
        """Return which vehicles touch another one, as SUMO sees it; shapes (vehicles, ...), [m]."""
        ...

    def hand_over(self) -> None:
        """Let drivers drive the CAVs from now on."""
        ...

    @property
    def memory(self) -> Memory | None:
        """What one step leaves to the next besides speeds and places."""
        ...

    def remember(self, memory: Sequence[Memory | None]) -> None:
        """Go on from what earlier steps left, road by road."""
        ...


class RingMovement:
    """People drive as SUMO's IDM does, then noise is added; CAVs do what they are told."""

    memory = None

    def __init__(
        self,
        scenario: Scenario,
        roads: Sequence[ClosedRoad],
        places: list[int],
        numbers: Numbers,
        people: People | None = None,
        quick: bool = False,
    ) -> None:
        """Take the places of CAVs, how people drive, and whether they see the car ahead alone."""
        self._people, self._drives = parameters_of(roads, scenario.humans, numbers), people
        self._loop = numbers(np.array([road.loop_length for road in roads]))
        self._step, self._top = scenario.simulation_step, scenario.top_speed
        self._brakes = scenario.cav_brakes * scenario.simulation_step
        self._places, self._quick = places, quick

    def after(self, now: Step) -> tuple[Array, Array]:
        """Return the speeds with which all move in a step, and those that they have after it [m/s]."""
        moved = self._people_speed(now.speed, now.position, now.ahead)
        if now.commanded is not None:
            slowest = now.speed[self._places] - self._brakes
            moved[self._places] = at_most(at_least(now.commanded, slowest), self._top)
        return moved, moved if now.noise is None else at_least(moved + now.noise, 0.0)

    def _people_speed(self, speed: Array, position: Array, ahead: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them, shape (vehicles, W)."""
        people, step = self._people, self._step
        if self._drives is not None:
            return self._drives(speed, *ahead)
        if self._quick:
            return people_speed(speed, *ahead, people, step)
        seen = leaders(speed, position, ahead, self._loop, people, step)
        xp = namespace(speed)
        found = reduce(xp.minimum, (people_speed(speed, *each, people, step) for each in seen))
        beyond = speed > people.desired_speed  # noise did it
        if bool(beyond.any()):
            end = end_of_lane(speed, position, self._loop, people)
            slower = people_speed(speed, *end, without_gap(people), step)
            slowest = speed - people.comfortable_deceleration * step
            found = xp.where(beyond, xp.minimum(found, xp.maximum(slower, slowest)), found)
        return found

    def collided(self, position: Array, gap: Array, loop: Array) -> Array:
        """Return which vehicles touch the one ahead."""
        return touching(position, gap, loop)

    def hand_over(self) -> None:
        """Do nothing: who is commanded is told in each step."""

    def remember(self, memory: Sequence[Memory | None]) -> None:
        """Do nothing: nothing is left."""


class EightMovement:
    """People are commanded the IDM's speeds with noise, but on the crossing; all obey the right of way."""

    def __init__(
        self, scenario: Scenario, roads: Sequence[ClosedRoad], places: list[int], numbers: Numbers
    ) -> None:
        """Take the places of CAVs among the vehicles."""
        vehicles = len(roads[0].vehicle_ids)
        self._humans: IDMParameters | IDMRows = scenario.humans
        self._step, self._places = scenario.simulation_step, places
        self._crossing = Crossing(scenario, roads, numbers)
        self._layer = layer_of(scenario, vehicles, [], numbers)
        self._with_cavs = layer_of(scenario, vehicles, places, numbers)

    def after(self, now: Step) -> tuple[Array, Array]:
        """Return the speeds with which all move in a step, and those that they have after it [m/s]."""
        gap = at_least(now.ahead.gap, SMALLEST_GAP)
        change = idm_acceleration(now.speed, now.ahead.speed, gap, self._humans) * self._step
        noise = 0.0 if now.noise is None else now.noise
        wanted = at_least(now.speed + change + noise, 0.0)
        told = ~self._crossing.inside(now.position)
        if now.commanded is not None:
            wanted[self._places], told[self._places] = now.commanded, True
        moved = self._crossing.moved(self._layer, now.speed, now.position, now.ahead, wanted, told)
        return moved, moved

    def collided(self, position: Array, gap: Array, loop: Array) -> Array:
        """Return which vehicles touch the one ahead, or one that crosses."""
        return touching_across(position, gap, loop)

    def hand_over(self) -> None:
        """Let drivers drive the CAVs from now on."""
        self._layer = self._with_cavs

    @property
    def memory(self) -> Memory:
        """Who waits since when, and who is on the crossing."""
        return self._crossing.memory

    def remember(self, memory: Sequence[Memory | None]) -> None:
        """Go on from what earlier steps left."""
        self._crossing.remember([each for each in memory if each is not None])
