"""The road model: samples of whole closed roads, and human drivers that follow a base plus a learned residual.

SUMO's own drivers add noise to speeds after they have moved, so that the driven distance gives the intended speed. The
noise of commanded drivers also changes the distance, and only its strength is known. Steps in which the right of way
constrains a driver are not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import nan
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.models import ensemble
from unjam.models.environment_data import is_holdout_episode
from unjam.models.row_model import BASE_DRIVERS
from unjam.models.settings import ModelSettings
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.figure_eight import crossing
from unjam.worlds.batch.human_idm import HumanSpeedModel, human_idm_speed
from unjam.worlds.batch.motorway.traffic import LearnedCorrection
from unjam.worlds.record import Episode, Floats

ROAD_MODEL_INPUTS = 4
"""inputs of the networks: speed, leader speed, gap, and the speed after the step according to the base"""
MIN_NOISE_SPEED = 0.5
"""intended speed above which noise is not clipped at standstill [m/s]"""
MAX_NOISE_STDS = 3.0
"""number of standard deviations of noise that the right of way must allow in steps used for training"""


@dataclass(frozen=True)
class RoadSamples:
    """N vehicles of a closed road, in order, at M steps with a new action; arrays of shape (M, N), SI units."""

    episode: int
    interval: int
    """control steps between samples"""
    size: int
    """drawn value of the episode: length of the ring or radius of the figure eight [m]"""
    length: float
    is_human: Floats
    """1 for human drivers, 0 for CAVs, shape (N,)"""
    speeds: Floats
    positions: Floats
    """front bumpers, not wrapped"""
    intended_speeds: Floats
    """driven distance divided by time in the next control step: the speed before noise"""
    next_speeds: Floats
    crossing_memory: crossing.CrossingMemory | None
    """waiting times and entry steps on a road that crosses itself"""


def with_size(scenario: LoopScenario, size: int) -> LoopScenario:
    """Return a scenario without warm-up in which all episodes draw the same size [m]."""
    return replace(scenario, **{scenario.size_parameter: (size, size)}, warmup=0)


def _road_of_size(scenario: LoopScenario, size: int) -> ClosedRoad:
    return cast(ClosedRoad, with_size(scenario, size).draw_from_seed((0,))[0])


def road_samples(episode: Episode, index: int, scenario: LoopScenario) -> RoadSamples:
    """Return the samples of the environment episode `index`."""
    interval, size = episode.trajectories[0].action_repeat, round(episode.drawn_values[scenario.size_parameter])
    steps, sampled_memory = np.arange(0, episode.control_steps, interval), None
    if episode.crossings:
        memory = crossing.crossing_memories(scenario, _road_of_size(scenario, size), episode.speeds, episode.positions)
        sampled_memory = crossing.CrossingMemory(memory.waiting_time[steps], memory.entry_step[steps])
    return RoadSamples(
        episode=index,
        interval=interval,
        size=size,
        length=episode.loop_length,
        is_human=np.array([float(vehicle_id not in episode.cav_ids) for vehicle_id in episode.vehicle_ids]),
        speeds=episode.speeds[steps],
        positions=episode.positions[steps],
        intended_speeds=(episode.positions[steps + 1] - episode.positions[steps]) / episode.control_step,
        next_speeds=episode.speeds[steps + 1],
        crossing_memory=sampled_memory,
    )


class HumanRows(NamedTuple):
    """Steps of human drivers in many episodes; R rows, each field of shape (R,), SI units."""

    speed: Floats
    leader_speed: Floats
    gap: Floats
    base_speed: Floats
    """speed after the step according to the base"""
    intended_speed: Floats
    """driven distance divided by time: the speed before noise, but with noise for commanded drivers"""
    next_speed: Floats
    episode: Floats


class RoadEnsemble(ensemble.Ensemble):
    """An ensemble for the residual of a base model of human drivers, with the strength of their noise."""

    noise: Tensor
    """standard deviation of the noise of a speed [m/s]"""

    def __init__(self, settings: ModelSettings, seed: ensemble.Seed) -> None:
        super().__init__(settings, ROAD_MODEL_INPUTS, 1, seed)
        self.base = settings.base
        self.register_buffer("noise", torch.zeros((), dtype=torch.float64))


def base_human_model(base: str, scenario: Scenario) -> HumanSpeedModel:
    """Return the human speed model of a base in `BASE_DRIVERS`."""
    make_driver, step = BASE_DRIVERS[base], scenario.simulation_step
    if base == "idm":
        follow = crossing.commanded_speed if scenario.human_control == "commanded" else human_idm_speed
        return partial(follow, parameters=scenario.humans, step=step)
    if make_driver is None:
        return lambda speed, leader_speed, gap: speed + 0.0  # a copy, which the caller changes
    driver = make_driver(scenario)

    def human_speed(speed: Array, leader_speed: Array, gap: Array) -> Array:
        state = LocalState(speed, leader_speed, gap, speed, MAX_OBSERVED_GAP, nan, nan)
        return next_speed(speed, driver.act(state, {})[0], step)

    return human_speed


def _stack_inputs(*columns: Array) -> Tensor:
    """Return inputs of the networks from columns of any shape, shape (rows, columns)."""
    flat = [column.ravel() for column in columns]
    return torch.from_numpy(np.stack(flat, 1)) if isinstance(flat[0], np.ndarray) else torch.stack(flat, 1)


def residual_function(model: RoadEnsemble, generator: torch.Generator) -> LearnedCorrection | None:
    """Return the learned residual with a random member for each block of vehicles; None if only the base is used."""
    if not model.output_mask.any():
        return None
    layers = model.layers()

    def residual(speed: Array, leader_speed: Array, gap: Array, base_speed: Array) -> Array:
        inputs = _stack_inputs(speed, leader_speed, gap, base_speed).float()
        predicted = ensemble.predict(layers, inputs, ensemble.random_members(model.members, len(inputs), generator))
        return (predicted.numpy() if isinstance(speed, np.ndarray) else predicted).reshape(speed.shape)

    return residual


def learned_human_model(model: RoadEnsemble, scenario: Scenario, generator: torch.Generator) -> HumanSpeedModel:
    """Return the human speed model of the ensemble: the base plus the residual of random members."""
    base_model, residual = base_human_model(model.base, scenario), residual_function(model, generator)
    if residual is None:
        return base_model

    def human_speed(speed: Array, leader_speed: Array, gap: Array) -> Array:
        base_speed = base_model(speed, leader_speed, gap)
        return clamp_min(base_speed + residual(speed, leader_speed, gap, base_speed), 0.0)

    return human_speed


def _has_right_of_way(samples: RoadSamples, scenario: Scenario, desired_speeds: Floats) -> NDArray[np.bool_]:
    """Return whether the right of way allows the desired speeds of human drivers [m/s], shape (M, N)."""
    road = _road_of_size(cast(LoopScenario, scenario), samples.size)
    is_human, memory = samples.is_human > 0.0, cast(crossing.CrossingMemory, samples.crossing_memory)
    desired_speeds = np.where(is_human, desired_speeds, samples.next_speeds).clip(0.0)
    cav_columns, motion = np.flatnonzero(~is_human).tolist(), (samples.speeds, samples.positions)
    return crossing.may_follow_commands(scenario, road, cav_columns, memory, motion, desired_speeds)


def human_rows(samples: Sequence[RoadSamples], base: str, scenario: Scenario) -> HumanRows:
    """Return a row for each step of a human driver that the right of way does not constrain."""
    base_model, tables = base_human_model(base, scenario), []
    max_noise = MAX_NOISE_STDS * scenario.noise_per_step * scenario.simulation_step
    for sample in samples:
        gap = gap_on_loop(sample.positions, np.roll(sample.positions, -1, 1), sample.length, VEHICLE_LENGTH)
        inputs = sample.speeds, np.roll(sample.speeds, -1, 1), gap
        base_speed, episode = base_model(*inputs), np.full(gap.shape, sample.episode)
        is_used = np.broadcast_to(sample.is_human > 0.0, gap.shape)
        if sample.crossing_memory is not None:
            is_used = is_used & _has_right_of_way(sample, scenario, base_speed + max_noise)
        columns = (*inputs, base_speed, sample.intended_speeds, sample.next_speeds, episode)
        tables.append(np.stack([column[is_used] for column in columns]))
    return HumanRows(*np.concatenate(tables, 1))


def fit_road_model(
    model: RoadEnsemble,
    samples: Sequence[RoadSamples],
    settings: ModelSettings,
    scenario: Scenario,
    seed: ensemble.Seed,
) -> ensemble.ModelFit:
    """Fit `model` with `fit_human_model`; the noise is measured, or that of the scenario for commanded drivers."""
    rows = human_rows(samples, model.base, scenario)
    if scenario.human_control == "commanded":
        noise = scenario.noise_per_step * scenario.simulation_step
        return fit_human_model(model, rows, noise, settings, seed, is_noise_known=False)
    is_moving = rows.intended_speed > MIN_NOISE_SPEED
    noise = float((rows.next_speed - rows.intended_speed)[is_moving].std()) if is_moving.any() else 0.0
    return fit_human_model(model, rows, noise, settings, seed, is_noise_known=True)


def fit_human_model(
    model: RoadEnsemble,
    rows: HumanRows,
    sigma: float,
    settings: ModelSettings,
    seed: ensemble.Seed,
    is_noise_known: bool,
    min_error_reduction: float = 0.0,
) -> ensemble.ModelFit:
    """Continue to fit `model` in place to the residual of intended speeds relative to the base, see `fit_ensemble`.

    `sigma` is the standard deviation of noise in the rows [m/s]. With `is_noise_known`, intended speeds have no noise;
    otherwise its variance is subtracted from squared errors. `min_error_reduction` is the relative reduction of the
    base's squared error that networks must reach.
    """
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    is_holdout = is_holdout_episode(rows.episode, settings.holdout)
    if is_holdout.all() or not is_holdout.any():  # too few episodes: hold out the last rows
        is_holdout = np.arange(len(is_holdout)) >= (1.0 - settings.holdout) * len(is_holdout)
    model.noise.fill_(sigma)
    targets = torch.from_numpy((rows.intended_speed - rows.base_speed)[:, None])
    fit = ensemble.fit_ensemble(
        model, _stack_inputs(*rows[:ROAD_MODEL_INPUTS]), targets, is_holdout, settings, generator
    )
    base_error = ensemble.root_mean_square(fit.targets)
    model_error = ensemble.root_mean_square(fit.targets - fit.predictions)
    is_base_enough = base_error < ensemble.MIN_CHANGE or model_error**2 > (1.0 - min_error_reduction) * base_error**2
    if settings.fallback_to_base and is_base_enough:
        model.output_mask.zero_()
    predictions = fit.predictions * model.output_mask.numpy()
    errors = fit.targets - predictions
    change = float((rows.intended_speed - rows.speed)[fit.holdout_indices].std())
    one_step = ensemble.OneStepRMSE(base_error, ensemble.root_mean_square(errors), change)
    if not is_noise_known:
        errors = np.sqrt((np.square(errors).mean((0, 1)) - sigma**2).clip(0.0))
    estimates = {
        "unexplained_variance": (ensemble.root_mean_square(errors) / max(change, ensemble.MIN_CHANGE)) ** 2,
        "transitions": ensemble.transition_variation(errors, sigma),
        "total_variation": ensemble.total_variation(predictions, np.array([sigma])),
        "training_loss": fit.loss,
    }
    learned = ("speed",) if model.output_mask.any() else ()
    holdout_rows = len(fit.holdout_indices)
    return ensemble.ModelFit(estimates, {"speed": one_step}, learned, fit.training_rows, holdout_rows, fit.epochs)
