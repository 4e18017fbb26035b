"""The road model of motorways: human drivers of the batch simulator with known entry times, and a learned correction.

Perception errors are noise. One ensemble learns the correction for vehicles that keep their lane: vehicles in samples
of environment episodes are simulated for a step with the base, and the difference to the recorded speed is the target.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.errors import InputError
from unjam.models.ensemble import ModelFit, Seed
from unjam.models.road_model import HumanRows, RoadEnsemble, fit_human_model, residual_function
from unjam.models.settings import ModelSettings
from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.worlds.batch.motorway import traffic
from unjam.worlds.batch.motorway.vehicles import MotorwayVehicles, find_rows, vehicle_keys
from unjam.worlds.lane_neighbors import find_road_neighbors, neighbors_on_lane
from unjam.worlds.record import Episode

Index = NDArray[np.intp]
MAX_SAMPLE_INTERVAL = 60
MIN_ERROR_REDUCTION = 0.3
"""relative reduction of the base's mean squared error that networks must reach. Records lack the lane-change memory
of human drivers that rollouts have, and networks would add its mean effect again. Networks with a reduction of a fifth
made model episodes 10 s too long; with more than half, errors fell from 180 to 20 s (docs/virtual-measurements.md)"""
PERCEPTION_ERROR_STD = 0.5
"""stationary standard deviation of the errors in gap and leader speed, if that of the driving error is 1"""


@dataclass(frozen=True)
class MotorwaySamples:
    """The human drivers on a motorway at some steps of an environment episode."""

    episode: int
    seed: tuple[int, ...]
    """seed of the episode, which determines the vehicles and their entry times"""
    episode_return: float
    human_rows: HumanRows
    """steps of human drivers that keep their lane; the base has no perception errors"""
    noise_variance: float
    """mean square of the speed change by perception errors in a control step [m2/s2]"""


def motorway_samples(episode: Episode, index: int, scenario: Motorway, base: str = "idm") -> MotorwaySamples:
    """Return the samples of the environment episode `index`; raise `InputError` if its record skips steps."""
    if episode.snapshot_stride > 1:
        raise InputError("road: its record skips steps; allowed: a shorter horizon, with model.kind road")
    road = cast(MotorwayRoad, scenario.draw_from_seed(episode.seed)[0])
    interval = max(1, min(MAX_SAMPLE_INTERVAL, episode.control_steps // 4))
    steps = np.arange(interval, episode.control_steps, interval)
    sample, column, vehicle = _sample_vehicles(episode, steps)
    current, following = (steps[sample], column), (steps[sample] + 1, column)
    vehicles = _batch_vehicles(episode, road, scenario, current, sample, vehicle)
    generator = np.random.default_rng([*episode.seed, index])
    errors = generator.standard_normal((3, len(sample)))
    perception = {"gap_error": PERCEPTION_ERROR_STD * errors[0], "leader_error": PERCEPTION_ERROR_STD * errors[1]}
    noisy_vehicles = vehicles._replace(**perception, driving_error=errors[2])
    base_speed = _speeds_after_step(vehicles, road, scenario, len(steps), np.zeros)
    noisy_speed = _speeds_after_step(noisy_vehicles, road, scenario, len(steps), generator.standard_normal)
    neighbors = find_road_neighbors(vehicles.road, vehicles.lane, vehicles.position, road.geometry)
    leader = neighbors_on_lane(neighbors.leaders, vehicles.lane)
    next_speed = episode.speeds[following]
    keeps_lane = episode.lane_indices[following] == episode.lane_indices[current]
    is_used = (leader >= 0) & vehicles.is_eidm & keeps_lane & ~np.isnan(base_speed + noisy_speed + next_speed)
    gap = vehicles.position[leader] - road.geometry.vehicle_length - vehicles.position
    noise_variance = float(np.square(noisy_speed - base_speed)[is_used].mean()) if is_used.any() else 0.0
    if base == "none":
        base_speed = vehicles.speed
    columns = vehicles.speed, vehicles.speed[leader], gap, base_speed, next_speed, next_speed
    rows = HumanRows(*(values[is_used] for values in (*columns, np.full(len(leader), float(index)))))
    return MotorwaySamples(index, tuple(episode.seed), float(episode.reward.sum()), rows, noise_variance)


def _sample_vehicles(episode: Episode, steps: Index) -> tuple[Index, Index, Index]:
    """Return index in `steps`, column of the record and index of each vehicle at each of `steps`, from front to back.

    Several vehicles have the same column one after the other.
    """
    is_present = ~np.isnan(episode.speeds)
    has_entered = is_present & ~np.vstack([np.zeros((1, is_present.shape[1]), bool), is_present[:-1]])
    index_in_column = np.cumsum(has_entered, 0) - 1
    columns = np.array(episode.vehicle_columns or range(is_present.shape[1]))
    order = np.argsort(columns, kind="stable")
    first_in_column = np.searchsorted(columns[order], np.arange(is_present.shape[1]))
    sample, column = np.nonzero(is_present[steps])
    rows = np.lexsort((-episode.positions[steps[sample], column], sample))
    sample, column = sample[rows], column[rows]
    return sample, column, order[first_in_column[column] + index_in_column[steps[sample], column]]


def _batch_vehicles(
    episode: Episode, road: MotorwayRoad, scenario: Motorway, at: tuple[Index, Index], sample: Index, vehicle: Index
) -> MotorwayVehicles:
    """Return the vehicles of a batch without errors and memory; `at` has steps and columns of the record."""
    entry_indices = {entry.name: index for index, entry in enumerate(road.entries)}
    entries = np.array([entry_indices[vehicle_id] for vehicle_id in episode.vehicle_ids])
    types = [road.vehicle_types[road.entries[index].vehicle_type] for index in entries.tolist()]
    *parameters, speed_factor, is_eidm = np.array([traffic.driver_columns(vehicle_type) for vehicle_type in types])[
        vehicle
    ].T
    geometry = road.geometry
    lane = (geometry.lane_count - episode.lane_indices[at]).astype(np.intp)
    position, speed = episode.positions[at] + geometry.origin, episode.speeds[at]
    acceleration = np.nan_to_num(speed - episode.speeds[at[0] - 1, at[1]]) / episode.control_step
    limit = geometry.speed_limits(lane, geometry.sections(lane, position))
    moving = sample, entries[vehicle], lane, position, speed, acceleration
    vehicles = traffic.make_vehicles(*moving, *parameters, speed_factor, is_eidm, limit * speed_factor)
    is_cav = np.isin(np.array(episode.vehicle_ids), episode.cav_ids)
    return traffic.enable_acc(vehicles, is_cav[vehicle], scenario.cruise)


def _speeds_after_step(
    vehicles: MotorwayVehicles,
    road: MotorwayRoad,
    scenario: Motorway,
    road_count: int,
    draw_noise: Callable[..., Floats],
) -> Floats:
    """Return the speeds after a control step [m/s]; NaN for vehicles that changed lanes or left the road."""
    empty_roads = [replace(road, entries=())] * road_count
    batch = traffic.BatchMotorways(empty_roads, scenario.simulation_step, draw_noise)
    batch.vehicles = vehicles.map(np.copy)
    for _ in range(scenario.steps_per_control_step):
        batch.step()
    next_vehicles = batch.vehicles
    row = find_rows(vehicle_keys(vehicles), next_vehicles, np.arange(len(next_vehicles.road)))
    keeps_lane = (row >= 0) & (next_vehicles.lane[row] == vehicles.lane)
    return np.where(keeps_lane, next_vehicles.speed[row], np.nan)


def learned_correction(
    model: RoadEnsemble, generator: torch.Generator, steps: int, has_noise: bool = True
) -> traffic.LearnedCorrection | None:
    """Return the model's change of human drivers' speeds in a control step; with base `none`, it replaces the base."""
    residual = residual_function(model, generator)
    if model.base != "none":
        return residual
    sigma = float(model.noise) * sqrt(steps) if has_noise else 0.0

    def replace_base(speed: Floats, leader_speed: Floats, gap: Floats, base_speed: Floats) -> Floats:
        noise = torch.randn(speed.size, generator=generator, dtype=torch.float64).numpy()
        change = residual(speed, leader_speed, gap, speed) if residual else 0.0
        return speed - base_speed + change + sigma * noise

    return replace_base


def fit_motorway_model(
    model: RoadEnsemble, samples: Sequence[MotorwaySamples], settings: ModelSettings, seed: Seed, group_size: int = 1
) -> ModelFit:
    """Fit `model` with `fit_human_model`; groups of `group_size` episodes with equal vehicles are held out together."""
    rows = HumanRows(
        *(np.concatenate(columns) for columns in zip(*(sample.human_rows for sample in samples), strict=True))
    )
    rows = rows._replace(episode=rows.episode // group_size)
    sigma = float(np.sqrt(np.mean([sample.noise_variance for sample in samples])))
    min_reduction = 0.0 if model.base == "none" else MIN_ERROR_REDUCTION
    return fit_human_model(model, rows, sigma, settings, seed, False, min_reduction)
