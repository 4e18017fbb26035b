"""Movement of all vehicles of W figure eights: human drivers are commanded, and SUMO's right of way limits all."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.figure_eight.car_following import CarFollowingModels
from unjam.worlds.batch.figure_eight.crossing import Crossing, CrossingMemory
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.leaders import Leader
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.record import Floats

COMMANDED_SPEED_TOLERANCE = 1e-9
"""[m/s]"""


def commanded_speed(speed: Array, leader_speed: Array, gap: Array, parameters: Any, step: float) -> Array:
    """Return the commanded speeds of human drivers without noise, not clipped at 0; see `human_idm_speed`."""
    return speed + idm_acceleration(speed, leader_speed, clamp_min(gap, MIN_IDM_GAP), parameters) * step


class FigureEightMovement(Crossing):
    """Commands the IDM with noise to human drivers, except on the crossing, and applies the right of way."""

    def __init__(
        self,
        scenario: Scenario,
        roads: Sequence[ClosedRoad],
        cav_indices: list[int],
        to_array: ArrayFactory,
        human_model: HumanSpeedModel | None = None,
    ) -> None:
        """Take the indices of the CAVs, which humans drive until `hand_over`; `human_model` replaces the road's IDM."""
        super().__init__(scenario, roads, to_array)
        idm = partial(commanded_speed, parameters=scenario.humans, step=scenario.simulation_step)
        self._human_model, self._cav_indices = human_model or idm, cav_indices
        self._models_with_cavs = CarFollowingModels(scenario, len(roads[0].vehicle_ids), cav_indices, to_array)

    def hand_over(self) -> None:
        """Hand the CAVs over to their driver."""
        self.models = self._models_with_cavs

    def move(self, speed: Array, position: Array, leader: Leader, noise: Array, cav_speeds: Array) -> Array:
        """Return the speeds after a step [m/s], shape (vehicles, W).

        `noise` is added to each speed; `cav_speeds` are commands, shape (CAVs, W), or None if the CAVs are human.
        """
        commanded = clamp_min(self._human_model(speed, *leader) + noise, 0.0)
        is_commanded = ~self.is_on_crossing(position)
        if cav_speeds is not None:
            commanded[self._cav_indices], is_commanded[self._cav_indices] = cav_speeds, True
        return self.next_speeds(speed, position, leader, commanded, is_commanded)


def crossing_memories(scenario: Scenario, road: ClosedRoad, speeds: Floats, positions: Floats) -> CrossingMemory:
    """Return the memory of the right of way at each step of an episode; all have the shape (steps, vehicles)."""
    crossing = Crossing(scenario, [road], np.asarray)
    memories = [crossing.memory]
    for speed, next_speed, position in zip(speeds, speeds[1:], positions, strict=False):
        crossing.record_step(speed[:, None], next_speed[:, None], position[:, None])
        memories.append(crossing.memory)
    return CrossingMemory(*(np.concatenate(each, 1).T for each in zip(*memories, strict=True)))


def may_follow_commands(
    scenario: Scenario,
    road: ClosedRoad,
    cav_indices: list[int],
    memories: CrossingMemory,
    motion: tuple[Floats, Floats],
    commanded_speeds: Floats,
) -> NDArray[np.bool_]:
    """Return whether the right of way lets vehicles follow their commands; all have the shape (moments, vehicles).

    `memories` are those of `crossing_memories`; `motion` is speeds [m/s] and positions [m].
    """
    speed, position, commanded = (each.T for each in (*motion, commanded_speeds))
    roads = [road] * len(commanded_speeds)
    movement = FigureEightMovement(scenario, roads, cav_indices, np.asarray, lambda *_: commanded)
    movement.hand_over()
    movement.restore_memory([CrossingMemory(*each) for each in zip(*memories, strict=True)])
    gap = gap_on_loop(position, np.roll(position, -1, 0), road.loop_length, VEHICLE_LENGTH)
    leader = Leader(np.roll(speed, -1, 0), gap)
    moved = movement.move(speed, position, leader, 0.0, commanded[cav_indices])
    return (np.abs(moved - commanded) < COMMANDED_SPEED_TOLERANCE).T
