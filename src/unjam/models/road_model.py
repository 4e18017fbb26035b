"""Whole roads as the virtual environment: how everybody drove, and how people are taken to drive on.

People differ from the base in the same way, whoever they are and wherever they drive: one ensemble learns it
from all of them. Their noise is known from the record: it changes speeds after everybody has moved, so that
the way that a vehicle made tells how fast it meant to drive. What is left of an error is ignorance. Where
people are commanded noise moves them too, and its strength is known, not its draws. The right of way is
known: what people do where it binds them is not learned from.
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
from unjam.errors import InputError
from unjam.models.ensemble import MIN_CHANGE, Ensemble, fit_ensemble, predict, random_members
from unjam.models.environment_data import is_holdout_episode
from unjam.models.fitting import ModelFit, OneStepRMSE, root_mean_square, total_variation, transition_variation
from unjam.models.row_model import BASE_DRIVERS
from unjam.models.settings import ModelSettings
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.figure_eight.movement import commanded_speed, crossing_memories, may_follow_commands
from unjam.worlds.batch.human_idm import HumanSpeedModel, human_idm_speed
from unjam.worlds.batch.on_ramp.traffic import LearnedCorrection
from unjam.worlds.batch.support import statistically_unsupported_reason
from unjam.worlds.record import Episode, Floats

ROAD_MODEL_INPUTS = 4
"""of the networks: speed, the leader's, the gap, and the speed after the step as the base has it"""
MIN_NOISE_SPEED = 0.5
"""speed from which noise is not cut off at standstill [m/s]"""
MAX_NOISE_STDS = 3.0
"""standard deviations of noise that the right of way must leave room for, where people are learned from"""


@dataclass(frozen=True)
class RoadSamples:
    """Everybody on a closed road, at each decision of an episode at which a residual was due.

    M moments, N vehicles in the order of the road.
    """

    episode: int
    """number of the episode"""
    interval: int
    """decisions from one moment to the next"""
    size: int
    """that the episode drew: length of the ring, radius of the figure eight [m]"""
    length: float
    """of the road [m]"""
    is_human: Floats
    """1 for people, 0 for CAVs, shape (N,)"""
    speeds: Floats
    """[m/s], shape (M, N)"""
    positions: Floats
    """front bumpers, not wrapped [m], shape (M, N)"""
    intended_speeds: Floats
    """how fast each moved in the decision that followed, before noise [m/s], shape (M, N)"""
    next_speeds: Floats
    """how fast each was then [m/s], shape (M, N)"""
    crossing_memory: CrossingMemory | None
    """where the road crosses itself: who waits, and who is on the crossing, shape (M, N) each"""


def check_road_model(scenario: Scenario) -> None:
    """Raise `InputError` where whole roads cannot be imagined on a scenario."""
    why = statistically_unsupported_reason(scenario)
    if isinstance(scenario, LoopScenario) and scenario.steps_per_control_step > 1:
        why = f"{scenario.title}: steps_per_decision is {scenario.steps_per_control_step}"
    if why:
        raise InputError(f"model.kind: road is not allowed; allowed: row, for {why}")


def with_size(scenario: LoopScenario, size: int) -> LoopScenario:
    """Return a scenario whose episodes all draw a size [m], and begin without a warm-up."""
    return replace(scenario, **{scenario.size_parameter: (size, size)}, warmup=0)


def _closed_road(scenario: LoopScenario, size: int) -> ClosedRoad:
    return cast(ClosedRoad, with_size(scenario, size).draw_from_seed((0,))[0])


def road_samples(episode: Episode, number: int, scenario: LoopScenario) -> RoadSamples:
    """Return what is kept of an actual episode, the so many-th, on a scenario."""
    every, size = episode.trajectories[0].action_repeat, round(episode.drawn_values[scenario.size_parameter])
    at, waits = np.arange(0, episode.control_steps, every), None
    if episode.crossings:
        memory = crossing_memories(scenario, _closed_road(scenario, size), episode.speeds, episode.positions)
        waits = CrossingMemory(memory.waiting_time[at], memory.entry_step[at])
    return RoadSamples(
        episode=number,
        interval=every,
        size=size,
        length=episode.loop_length,
        is_human=np.array([float(name not in episode.cav_ids) for name in episode.vehicle_ids]),
        speeds=episode.speeds[at],
        positions=episode.positions[at],
        intended_speeds=(episode.positions[at + 1] - episode.positions[at]) / episode.control_step,
        next_speeds=episode.speeds[at + 1],
        crossing_memory=waits,
    )


class HumanRows(NamedTuple):
    """What people did in steps of many episodes; R rows."""

    speed: Floats
    """[m/s], shape (R,)"""
    leader_speed: Floats
    """likewise"""
    gap: Floats
    """[m], likewise"""
    base_speed: Floats
    """how fast each is after the step as the base has it [m/s], likewise"""
    intended_speed: Floats
    """how fast each moved, before noise unless people are commanded [m/s], likewise"""
    next_speed: Floats
    """how fast each was then [m/s], likewise"""
    episode: Floats
    """number of the episode, likewise"""

    @property
    def inputs(self) -> Tensor:
        """What the networks see, shape (R, 4)."""
        return _inputs(*self[:ROAD_MODEL_INPUTS])


class RoadModel(Ensemble):
    """What people do beside the base, and how noisy they are."""

    noise: Tensor

    def __init__(self, settings: ModelSettings, seed: Sequence[int]) -> None:
        """Begin with the base alone."""
        super().__init__(settings, ROAD_MODEL_INPUTS, 1, seed)
        self.base = settings.base
        self.register_buffer("noise", torch.zeros((), dtype=torch.float64))


def base_human_model(base: str, scenario: Scenario) -> HumanSpeedModel:
    """Return how people drive as far as a base in `BASES` knows."""
    make, step = BASE_DRIVERS[base], scenario.simulation_step
    if base == "idm":
        follow = commanded_speed if scenario.human_control == "commanded" else human_idm_speed
        return partial(follow, parameters=scenario.humans, step=step)
    if make is None:
        return lambda speed, leader_speed, gap: speed + 0.0  # the caller writes into what it gets
    person = make(scenario)

    def human_speed(speed: Array, leader_speed: Array, gap: Array) -> Array:
        state = LocalState(speed, leader_speed, gap, speed, MAX_OBSERVED_GAP, nan, nan)
        return next_speed(speed, person.act(state, {})[0], step)

    return human_speed


def _inputs(speed: Array, leader_speed: Array, gap: Array, base_speed: Array) -> Tensor:
    """Return what the networks see of vehicles of any shape, one row each."""
    seen = [each.ravel() for each in (speed, leader_speed, gap, base_speed)]
    return torch.from_numpy(np.stack(seen, 1)) if isinstance(speed, np.ndarray) else torch.stack(seen, 1)


def residual_function(model: RoadModel, generator: torch.Generator) -> LearnedCorrection | None:
    """Return what the networks add, a random one for each 64 vehicles; None where that is nothing."""
    if not model.output_mask.any():
        return None
    layers = model.layers()

    def residual(speed: Array, leader_speed: Array, gap: Array, base_speed: Array) -> Array:
        inputs = _inputs(speed, leader_speed, gap, base_speed).float()
        found = predict(layers, inputs, random_members(model.members, len(inputs), generator))
        found = found.numpy() if isinstance(speed, np.ndarray) else found
        return found.reshape(speed.shape)

    return residual


def learned_human_model(model: RoadModel, scenario: Scenario, generator: torch.Generator) -> HumanSpeedModel:
    """Return how people drive in the virtual environment: the base, and what a random network adds to it."""
    known, residual = base_human_model(model.base, scenario), residual_function(model, generator)
    if residual is None:
        return known

    def human_speed(speed: Array, leader_speed: Array, gap: Array) -> Array:
        base = known(speed, leader_speed, gap)
        return clamp_min(base + residual(speed, leader_speed, gap, base), 0.0)

    return human_speed


def _noise_std(scenario: Scenario) -> float:
    """Return the standard deviation of what noise adds to people's speeds in a step [m/s]."""
    return scenario.noise_per_step * scenario.simulation_step


def _has_right_of_way(samples: RoadSamples, scenario: Scenario, desired_speeds: Floats) -> NDArray[np.bool_]:
    """Return whether the right of way lets people drive so fast [m/s], shapes (M, N)."""
    road, waits = (
        _closed_road(cast(LoopScenario, scenario), samples.size),
        cast(CrossingMemory, samples.crossing_memory),
    )
    desired_speeds = np.where(samples.is_human > 0.0, desired_speeds, samples.next_speeds).clip(0.0)
    places = np.flatnonzero(samples.is_human == 0.0).tolist()
    return may_follow_commands(scenario, road, places, waits, (samples.speeds, samples.positions), desired_speeds)


def human_rows(samples: Sequence[RoadSamples], base: str, scenario: Scenario) -> HumanRows:
    """Return what people did, a row each, where no right of way binds them."""
    known, columns = base_human_model(base, scenario), []
    for moments in samples:
        ahead = np.roll(moments.positions, -1, 1)
        gap = gap_on_loop(moments.positions, ahead, moments.length, VEHICLE_LENGTH)
        seen = moments.speeds, np.roll(moments.speeds, -1, 1), gap
        based, episode = known(*seen), np.full(gap.shape, moments.episode)
        counts = np.broadcast_to(moments.is_human > 0.0, gap.shape)
        if moments.crossing_memory is not None:
            counts = counts & _has_right_of_way(moments, scenario, based + MAX_NOISE_STDS * _noise_std(scenario))
        each = (*seen, based, moments.intended_speeds, moments.next_speeds, episode)
        columns.append(np.stack([values[counts] for values in each]))
    return HumanRows(*np.concatenate(columns, 1))


def fit_road_model(
    model: RoadModel, samples: Sequence[RoadSamples], settings: ModelSettings, scenario: Scenario, seed: Sequence[int]
) -> ModelFit:
    """Teach `model` what the base leaves of how people moved, and measure their noise.

    The errors, of the speed alone: `unexplained_variance` is the squared error on the holdout over the variance of
    what there was to predict; `transitions` is between the next speed as a member has it and as it truly
    was drawn, with the noise known from the record; `total_variation` between members. Where people are
    commanded it is the mean square of the errors beyond the noise's variance that counts as ignorance.

    Raises:
        UnjamError: a loss is not finite.
    """
    rows, commanded = human_rows(samples, model.base, scenario), scenario.human_control == "commanded"
    moves = rows.intended_speed > MIN_NOISE_SPEED
    sigma = float((rows.next_speed - rows.intended_speed)[moves].std()) if moves.any() else 0.0
    if commanded:
        sigma = _noise_std(scenario)
    return fit_human_model(model, rows, sigma, settings, seed, is_noise_known=not commanded)


def fit_human_model(
    model: RoadModel,
    rows: HumanRows,
    sigma: float,
    settings: ModelSettings,
    seed: Sequence[int],
    is_noise_known: bool,
    min_error_reduction: float = 0.0,
) -> ModelFit:
    """Teach `model` what the base leaves of rows, as `fit_road_model` says.

    `sigma` is the standard deviation of noise [m/s]; `noise_known` where rows are without it. Networks that
    save less than the share `least` of the base's mean square error add nothing.
    """
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    held_out = is_holdout_episode(rows.episode, settings.holdout)
    if held_out.all() or not held_out.any():  # too few episodes: the last part of what was seen
        held_out = np.arange(len(held_out)) >= (1.0 - settings.holdout) * len(held_out)
    model.noise.fill_(sigma)
    targets = torch.from_numpy((rows.intended_speed - rows.base_speed)[:, None])
    found = fit_ensemble(model, rows.inputs, targets, held_out, settings, generator)
    left, before = root_mean_square(found.targets - found.predictions), root_mean_square(found.targets)
    known = before < MIN_CHANGE or left**2 > (1.0 - min_error_reduction) * before**2  # of rounding, the base knows all
    if settings.fallback_to_base and known:
        model.output_mask.zero_()
    wrong = found.targets - found.predictions * model.output_mask.numpy()
    change = (rows.intended_speed - rows.speed)[found.holdout_indices]
    step = OneStepRMSE(root_mean_square(found.targets), root_mean_square(wrong), float(change.std()))
    if not is_noise_known:
        wrong = np.sqrt((np.square(wrong).mean((0, 1)) - sigma**2).clip(0.0))
    errors = {
        "unexplained_variance": (root_mean_square(wrong) / max(step.change, MIN_CHANGE)) ** 2,
        "transitions": transition_variation(wrong, sigma),
        "total_variation": total_variation(found.predictions * model.output_mask.numpy(), np.array([sigma])),
        "training_loss": found.loss,
    }
    learned = ("speed",) if model.output_mask.any() else ()
    return ModelFit(errors, {"speed": step}, learned, found.training_rows, len(found.holdout_indices), found.epochs)
