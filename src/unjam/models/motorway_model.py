"""On-ramps as the virtual environment: who came when is known, and how they drive, beside what is learned.

The base is the batch's: people's own drivers and lane changes. What they misjudge is noise, drawn anew. What
they did besides, where they keep their lane, one ensemble learns from moments of actual episodes: a vehicle
of each such moment makes a decision's steps as the base has it, and what is left of its speed is to predict.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.errors import InputError
from unjam.models.fitting import ModelFit
from unjam.models.road_model import HumanRows, RoadModel, fit_human_model, residual_function
from unjam.models.settings import ModelSettings
from unjam.physics.arrays import Floats
from unjam.scenarios.on_ramp import RAMP_SPEED_LIMIT, OnRamp
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.batch.on_ramp.traffic import (
    BatchMotorways,
    LearnedCorrection,
    driver_columns,
    enable_acc,
    make_vehicles,
)
from unjam.worlds.batch.on_ramp.vehicles import (
    MotorwayVehicles,
    find_neighbors,
    find_rows,
    neighbors_on_lane,
    vehicle_numbers,
)
from unjam.worlds.record import Episode

MAX_SAMPLE_INTERVAL = 60
"""decisions from one moment that is learned from to the next, at most"""
MIN_ERROR_REDUCTION = 0.3
"""share of the base's mean square error that networks must save: a record does not tell what people remember
of lane changes, and who imagines them knows it; its mean effect would be added twice. Networks that saved a
fifth made imagined episodes 10 s too long; others, that saved more than half, 20 s instead of
180 (docs/virtual.md)"""
PERCEPTION_ERROR_STD = 0.5
"""standard deviation of what people misjudge once they have driven for a while; of how they drive it is 1"""


@dataclass(frozen=True)
class MotorwaySamples:
    """What is kept of an actual episode on an on-ramp."""

    episode: int
    """number of the episode"""
    seed: tuple[int, ...]
    """of the episode: it says who wanted to enter, and when"""
    episode_return: float
    """return of the episode"""
    human_rows: HumanRows
    """what people did who kept their lane; the base is without what they misjudge"""
    noise_variance: float
    """mean square of what that adds to a speed in a decision [m2/s2]"""


def check_motorway_model(scenario: OnRamp, settings: ModelSettings) -> None:
    """Raise `InputError` where an on-ramp cannot be imagined with these settings."""
    if settings.rollout_starts != "first":
        raise InputError(
            f"model.rollout_starts: {settings.rollout_starts} is not allowed; allowed: first, on the on-ramp"
        )
    if settings.base not in ("idm", "none"):
        words = "idm, as each drives, or none, on the on-ramp"
        raise InputError(f"model.base: {settings.base} is not allowed; allowed: {words}")
    if settings.calibrate_base:
        raise InputError("model.calibrate_base: true is not allowed; allowed: false, on the on-ramp")


class _SampledVehicles(NamedTuple):
    """Vehicles at some moments of an episode, moment by moment from front to back; V in all."""

    sample: NDArray[np.intp]
    """which of the moments, shape (V,)"""
    column: NDArray[np.intp]
    """of the record's tables"""
    vehicle: NDArray[np.intp]
    """number among the record's vehicles"""


def motorway_samples(episode: Episode, number: int, scenario: OnRamp, base: str = "idm") -> MotorwaySamples:
    """Return what is kept of an actual episode, the so many-th, on a scenario.

    Raises:
        InputError: so many drove for so long that the record skips moments.
    """
    if episode.snapshot_stride > 1:
        raise InputError("road: its record skips moments; allowed: a shorter horizon, where it is imagined")
    road = cast(MotorwayRoad, scenario.draw_from_seed(episode.seed)[0])
    every = max(1, min(MAX_SAMPLE_INTERVAL, episode.control_steps // 4))
    at = np.arange(every, episode.control_steps, every)
    those = _sample_vehicles(episode, at)
    now, later = (at[those.sample], those.column), (at[those.sample] + 1, those.column)
    before = _batch_vehicles(episode, road, scenario, now, those)
    generator = np.random.default_rng([*episode.seed, number])
    errors = generator.standard_normal((3, len(those.sample)))
    erring = before._replace(
        gap_error=PERCEPTION_ERROR_STD * errors[0],
        leader_error=PERCEPTION_ERROR_STD * errors[1],
        driving_error=errors[2],
    )
    known, noisy = (
        _speeds_after_step(each, road, scenario, len(at), draw)
        for each, draw in ((before, np.zeros), (erring, generator.standard_normal))
    )
    row, after = (
        neighbors_on_lane(find_neighbors(before, len(road.lane_names)).leaders, before.lane),
        episode.speeds[later],
    )
    keeps = episode.lane_indices[later] == episode.lane_indices[now]
    counts = (row >= 0) & before.is_eidm & keeps & ~np.isnan(known + noisy + after)
    gap = before.position[row] - road.vehicle_length - before.position
    noise = float(np.square(noisy - known)[counts].mean()) if counts.any() else 0.0
    based = before.speed if base == "none" else known
    columns = before.speed, before.speed[row], gap, based, after, after, np.full(len(row), float(number))
    people = HumanRows(*(each[counts] for each in columns))
    return MotorwaySamples(number, tuple(episode.seed), float(episode.reward.sum()), people, noise)


def _sample_vehicles(episode: Episode, steps: NDArray[np.intp]) -> _SampledVehicles:
    """Return who is on the road at moments, and where: vehicles share columns one after the other."""
    there = ~np.isnan(episode.speeds)
    begins = there & ~np.vstack([np.zeros((1, there.shape[1]), bool), there[:-1]])
    so_many = np.cumsum(begins, 0) - 1
    columns = np.array(episode.vehicle_columns or range(there.shape[1]))
    order = np.argsort(columns, kind="stable")
    first = np.searchsorted(columns[order], np.arange(there.shape[1]))
    moment, column = np.nonzero(there[steps])
    rows = np.lexsort((-episode.positions[steps[moment], column], moment))
    moment, column = moment[rows], column[rows]
    return _SampledVehicles(moment, column, order[first[column] + so_many[steps[moment], column]])


def _batch_vehicles(
    episode: Episode,
    road: MotorwayRoad,
    scenario: OnRamp,
    sample_index: tuple[NDArray[np.intp], NDArray[np.intp]],
    sampled: _SampledVehicles,
) -> MotorwayVehicles:
    """Return the vehicles of moments as a batch has them, each moment a road; nobody errs or remembers."""
    numbers = {entry.name: number for number, entry in enumerate(road.entries)}
    entries = np.array([numbers[name] for name in episode.vehicle_ids])
    people = np.array([driver_columns(road.vehicle_types[road.entries[number].vehicle_type]) for number in entries.tolist()])
    *follows, factor, extended = people[sampled.vehicle].T
    way = (len(road.lane_names) - 1 - episode.lane_indices[sample_index]).astype(np.intp)
    place, speed = episode.positions[sample_index] + road.merge_position, episode.speeds[sample_index]
    change = np.nan_to_num(speed - episode.speeds[sample_index[0] - 1, sample_index[1]]) / episode.control_step
    limit = np.where((way == 0) & (place < road.merge_position), RAMP_SPEED_LIMIT, road.limit_speed)
    where = sampled.sample, entries[sampled.vehicle], way, place, speed, change
    found = make_vehicles(*where, *follows, factor, extended, limit * factor)
    cavs = np.isin(np.array(episode.vehicle_ids), episode.cav_ids)
    enable_acc(found, cavs[sampled.vehicle], scenario.cruise)
    return found


def _speeds_after_step(
    vehicles: MotorwayVehicles, road: MotorwayRoad, scenario: OnRamp, road_count: int, draw_noise: Callable[..., Floats]
) -> Floats:
    """Return the speeds after a decision of those who kept their lane and are there [m/s]; NaN of others."""
    empty = [replace(road, entries=())] * road_count
    traffic = BatchMotorways(empty, scenario.simulation_step, draw_noise, np.asarray)
    traffic.vehicles = vehicles.map(np.copy)
    for _ in range(scenario.steps_per_control_step):
        traffic.step()
    after = traffic.vehicles
    row = find_rows(vehicle_numbers(vehicles), after)
    keeps = (row >= 0) & (after.lane[row] == vehicles.lane)
    return np.where(keeps, after.speed[row], np.nan)


def learned_correction(
    model: RoadModel, generator: torch.Generator, steps: int, has_noise: bool = True
) -> LearnedCorrection | None:
    """Return what people do in a decision of so many steps beside what the batch has them do.

    With the base `none` that takes back what the batch knows of following, and what people misjudge, of which
    `noise` of as much strength is left.
    """
    residual = residual_function(model, generator)
    if model.base != "none":
        return residual
    sigma = float(model.noise) * sqrt(steps) if has_noise else 0.0

    def residual_speed(speed: Floats, leader_speed: Floats, gap: Floats, base_speed: Floats) -> Floats:
        drawn = torch.randn(speed.size, generator=generator, dtype=torch.float64).numpy()
        learned = residual(speed, leader_speed, gap, speed) if residual else 0.0
        return speed - base_speed + learned + sigma * drawn

    return residual_speed


def fit_motorway_model(
    model: RoadModel,
    samples: Sequence[MotorwaySamples],
    settings: ModelSettings,
    seed: Sequence[int],
    episodes_per_group: int = 1,
) -> ModelFit:
    """Teach `model` what people did beside the base; what they misjudge is no ignorance.

    So many `twins` in a row meet the same people: they are held out together.

    Raises:
        UnjamError: a loss is not finite.
    """
    rows = HumanRows(*(np.concatenate(each) for each in zip(*(one.human_rows for one in samples), strict=True)))
    rows = rows._replace(episode=rows.episode // episodes_per_group)
    sigma = float(np.sqrt(np.mean([one.noise_variance for one in samples])))
    least = 0.0 if model.base == "none" else MIN_ERROR_REDUCTION
    return fit_human_model(model, rows, sigma, settings, seed, is_noise_known=False, min_error_reduction=least)
