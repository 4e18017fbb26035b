"""How all vehicles of W figures eight move: people are commanded, and SUMO's right of way rules all."""

from collections.abc import Sequence

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.physics.arrays import Array, at_least
from unjam.physics.idm import idm_acceleration
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.crossing import Crossing, Memory
from unjam.worlds.batch.lanes import Leader
from unjam.worlds.batch.layer import layer_of
from unjam.worlds.batch.noise import Numbers


class EightMovement:
    """People are commanded the IDM's speeds with noise, but on the crossing; all obey the right of way."""

    def __init__(
        self, scenario: Scenario, roads: Sequence[ClosedRoad], places: list[int], numbers: Numbers
    ) -> None:
        """Take the places of CAVs among the vehicles; people drive them until they are handed over."""
        vehicles = len(roads[0].vehicle_ids)
        self._humans, self._step, self._places = scenario.humans, scenario.simulation_step, places
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
        gap = at_least(ahead.gap, SMALLEST_GAP)
        change = idm_acceleration(speed, ahead.speed, gap, self._humans) * self._step
        wanted = at_least(speed + change + noise, 0.0)
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
