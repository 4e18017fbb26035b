"""How all vehicles of W figures eight move: people are commanded, and SUMO's right of way rules all."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import _MIN_GAP
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.figure_eight.car_following import make_car_following_models
from unjam.worlds.batch.figure_eight.crossing import Crossing, CrossingMemory
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.leaders import Leader
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.record import Floats

COMMANDED_SPEED_TOLERANCE = 1e-9
"""[m/s]"""


def commanded_speed(speed: Array, leader_speed: Array, gap: Array, parameters: Any, step: float) -> Array:
    """Return the speeds that people are commanded, before noise is added; those below 0 are not cut off.

    Arguments as of `human_idm_speed`.
    """
    return speed + idm_acceleration(speed, leader_speed, clamp_min(gap, _MIN_GAP), parameters) * step


class FigureEightMovement:
    """People are commanded the IDM's speeds with noise, but on the crossing; all obey the right of way."""

    def __init__(
        self,
        scenario: Scenario,
        roads: Sequence[ClosedRoad],
        cav_indices: list[int],
        to_array: ArrayFactory,
        human_model: HumanSpeedModel | None = None,
    ) -> None:
        """Take the places of CAVs among the vehicles; people drive them until they are handed over.

        `people` is what people are commanded; None: the road's IDM.
        """
        vehicles = len(roads[0].vehicle_ids)
        idm = partial(commanded_speed, parameters=scenario.humans, step=scenario.simulation_step)
        self._human_model, self._cav_indices = human_model or idm, cav_indices
        self._crossing = Crossing(scenario, roads, to_array)
        self._models = make_car_following_models(scenario, vehicles, [], to_array)
        self._models_with_cavs = make_car_following_models(scenario, vehicles, cav_indices, to_array)

    def hand_over(self) -> None:
        """Let drivers drive the CAVs from now on."""
        self._models = self._models_with_cavs

    def next_speeds(self, speed: Array, position: Array, leader: Leader, noise: Array, cav_speeds: Array) -> Array:
        """Return the speeds after a step [m/s], shape (vehicles, W).

        Args:
            speed: [m/s], likewise.
            position: front bumpers along the road, not wrapped [m], likewise.
            ahead: the vehicle ahead of each.
            noise: by how much noise changes each speed [m/s], likewise, or 0.
            cavs: the speeds that CAVs are told, shape (CAVs, W) [m/s]; None: they are human.
        """
        wanted = clamp_min(self._human_model(speed, *leader) + noise, 0.0)
        told = ~self._crossing.is_on_crossing(position)
        if cav_speeds is not None:
            wanted[self._cav_indices], told[self._cav_indices] = cav_speeds, True
        return self._crossing.next_speeds(self._models, speed, position, leader, wanted, told)

    @property
    def memory(self) -> CrossingMemory:
        """Who waits since when, and who is on the crossing."""
        return self._crossing.memory

    def restore_memory(self, memories: Sequence[CrossingMemory]) -> None:
        """Go on from what earlier steps left, road by road."""
        self._crossing.restore_memory(memories)


def crossing_memories(scenario: Scenario, road: ClosedRoad, speeds: Floats, positions: Floats) -> CrossingMemory:
    """Return who waits since when at each step of an episode, and who is on the crossing, (steps, vehicles).

    Args:
        scenario: what the episode was driven on.
        road: likewise, as it was drawn.
        speeds: of all vehicles in road order at each step [m/s], shape (steps, vehicles).
        positions: front bumpers along the road [m], likewise.
    """
    crossing, found = Crossing(scenario, [road], np.asarray), list[CrossingMemory]()
    for at in range(len(speeds)):
        found.append(crossing.memory)
        if at + 1 < len(speeds):
            crossing.record_step(speeds[at][:, None], speeds[at + 1][:, None], positions[at][:, None])
    return CrossingMemory(*(np.concatenate(each, 1).T for each in zip(*found, strict=True)))


def may_follow_commands(
    scenario: Scenario,
    road: ClosedRoad,
    cav_indices: list[int],
    memories: CrossingMemory,
    motion: tuple[Floats, Floats],
    commanded_speeds: Floats,
) -> NDArray[np.bool_]:
    """Return whether the right of way lets vehicles do what they are commanded, shape (moments, vehicles).

    Args:
        scenario: what the episode was driven on.
        road: likewise, as it was drawn.
        places: of the CAVs among the vehicles.
        waits: what `crossing_memories` returns, at the moments.
        moment: speeds and positions [m/s, m], shape (moments, vehicles).
        wanted: speeds that vehicles are commanded [m/s], likewise.
    """
    speed, position, told = (each.T for each in (*motion, commanded_speeds))
    movement = FigureEightMovement(scenario, [road] * len(commanded_speeds), cav_indices, np.asarray, lambda *_: told)
    movement.hand_over()
    movement.restore_memory([CrossingMemory(*each) for each in zip(*memories, strict=True)])
    gap = gap_on_loop(position, np.roll(position, -1, 0), road.loop_length, VEHICLE_LENGTH)
    ahead = Leader(np.roll(speed, -1, 0), gap)
    moved = movement.next_speeds(speed, position, ahead, 0.0, told[cav_indices])
    return (np.abs(moved - told) < COMMANDED_SPEED_TOLERANCE).T
