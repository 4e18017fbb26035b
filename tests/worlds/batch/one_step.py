"""One step of a batch from each step of a figure eight in SUMO, compared with the next step of SUMO."""

import numpy as np

from unjam.drivers.driver import Driver
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.figure_eight.crossing import FigureEightMovement
from unjam.worlds.batch.human_idm import Leader
from unjam.worlds.episode import run_episode
from unjam.worlds.ordered_road import NOISE_BLOCK_STEPS
from unjam.worlds.record import Floats
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation


def errors(eight: FigureEight, driver: Driver, seed: int, simulation: Simulation) -> Floats:
    """Return by how much each speed differs after one step from SUMO's own state, (steps, vehicles) [m/s]."""
    episode = run_episode(eight, driver, (seed,), backend=SumoBackend(simulation))
    road, others = eight.draw_from_seed((seed,))
    assert isinstance(road, ClosedRoad)
    steps, vehicles = len(episode.speeds) - 1, len(road.vehicle_ids)
    controlled = [road.vehicle_ids.index(name) for name in road.cav_ids] if episode.trajectories else []
    applied = np.array([trajectory.applied_acceleration for trajectory in episode.trajectories])
    generator = np.random.default_rng(others[0])
    blocks = [generator.standard_normal((NOISE_BLOCK_STEPS, vehicles)) for _ in range(steps // NOISE_BLOCK_STEPS + 1)]
    step = eight.simulation_step
    noise = np.concatenate(blocks) * eight.noise_per_step * step
    movement, found = FigureEightMovement(eight, [road], controlled, np.asarray), np.empty((steps, vehicles))
    movement.hand_over()
    for moment in range(steps):
        speed, position = episode.speeds[moment][:, None], episode.positions[moment][:, None]
        gap = gap_on_loop(position, np.roll(position, -1, 0), road.loop_length, VEHICLE_LENGTH)
        commanded = None
        if controlled:
            commanded = np.maximum(speed[controlled] + applied[:, [moment]] * step, 0.0)
        ahead = Leader(np.roll(speed, -1, 0), gap)
        moved = movement.move(speed, position, ahead, noise[moment][:, None], commanded)
        found[moment] = moved[:, 0] - episode.speeds[moment + 1]
    return found
