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

from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.errors import InputError
from unjam.physics.arrays import Array, at_least
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.ring import Loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.virtual.data import is_held_out
from unjam.virtual.ensemble import SMALLEST_CHANGE, Ensemble, predict, random_members, teach
from unjam.virtual.fitting import (
    Fit,
    OneStep,
    against_transitions,
    root_mean_square,
    total_variation,
)
from unjam.virtual.model import BASES
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.batch.crossing import Memory
from unjam.worlds.batch.motorway import Learned
from unjam.worlds.batch.movement import commanded_speed, heeded, waits_of
from unjam.worlds.batch.people import People, people_speed
from unjam.worlds.batch.possible import statistical_why_not
from unjam.worlds.record import Episode, Floats

INPUTS = 4
"""of the networks: speed, the leader's, the gap, and the speed after the step as the base has it"""
MOVES = 0.5
"""speed from which noise is not cut off at standstill [m/s]"""
LARGEST_NOISE = 3.0
"""standard deviations of noise that the right of way must leave room for, where people are learned from"""


@dataclass(frozen=True)
class Moments:
    """Everybody on a closed road, at each decision of an episode at which a residual was due.

    M moments, N vehicles in the order of the road.
    """

    episode: int
    """number of the episode"""
    every: int
    """decisions from one moment to the next"""
    size: int
    """that the episode drew: length of the ring, radius of the figure eight [m]"""
    length: float
    """of the road [m]"""
    people: Floats
    """1 for people, 0 for CAVs, shape (N,)"""
    speeds: Floats
    """[m/s], shape (M, N)"""
    positions: Floats
    """front bumpers, not wrapped [m], shape (M, N)"""
    moved: Floats
    """how fast each moved in the decision that followed, before noise [m/s], shape (M, N)"""
    after: Floats
    """how fast each was then [m/s], shape (M, N)"""
    waits: Memory | None
    """where the road crosses itself: who waits, and who is on the crossing, shape (M, N) each"""


def check_roads(scenario: Scenario) -> None:
    """Raise `InputError` where whole roads cannot be imagined on a scenario."""
    why = statistical_why_not(scenario)
    if isinstance(scenario, Loop) and scenario.steps_per_decision > 1:
        why = f"{scenario.title}: steps_per_decision is {scenario.steps_per_decision}"
    if why:
        raise InputError(f"virtual.model: road is not allowed; allowed: row, for {why}")


def of_size(scenario: Loop, size: int) -> Loop:
    """Return a scenario whose episodes all draw a size [m], and begin without a warm-up."""
    return replace(scenario, **{scenario.size: (size, size)}, warmup=0)


def _road_of(scenario: Loop, size: int) -> ClosedRoad:
    return cast(ClosedRoad, of_size(scenario, size).of_seed((0,))[0])


def moments_of(episode: Episode, number: int, scenario: Loop) -> Moments:
    """Return what is kept of an actual episode, the so many-th, on a scenario."""
    every, size = episode.trajectories[0].hold, round(episode.drawn[scenario.size])
    at, waits = np.arange(0, episode.steps, every), None
    if episode.crossings:
        memory = waits_of(scenario, _road_of(scenario, size), episode.speeds, episode.positions)
        waits = Memory(memory.waited[at], memory.entered[at])
    return Moments(
        episode=number,
        every=every,
        size=size,
        length=episode.loop_length,
        people=np.array([float(name not in episode.cav_ids) for name in episode.vehicle_ids]),
        speeds=episode.speeds[at],
        positions=episode.positions[at],
        moved=(episode.positions[at + 1] - episode.positions[at]) / episode.step,
        after=episode.speeds[at + 1],
        waits=waits,
    )


class PeopleRows(NamedTuple):
    """What people did in steps of many episodes; R rows."""

    speed: Floats
    """[m/s], shape (R,)"""
    leader_speed: Floats
    """likewise"""
    gap: Floats
    """[m], likewise"""
    base: Floats
    """how fast each is after the step as the base has it [m/s], likewise"""
    moved: Floats
    """how fast each moved, before noise unless people are commanded [m/s], likewise"""
    after: Floats
    """how fast each was then [m/s], likewise"""
    episode: Floats
    """number of the episode, likewise"""

    @property
    def inputs(self) -> Tensor:
        """What the networks see, shape (R, 4)."""
        return _inputs(*self[:INPUTS])


class RoadModel(Ensemble):
    """What people do beside the base, and how noisy they are."""

    noise: Tensor

    def __init__(self, settings: VirtualSettings, seed: Sequence[int]) -> None:
        """Begin with the base alone."""
        super().__init__(settings, INPUTS, 1, seed)
        self.base = settings.base
        self.register_buffer("noise", torch.zeros((), dtype=torch.float64))


def known_speed(base: str, scenario: Scenario) -> People:
    """Return how people drive as far as a base in `BASES` knows."""
    make, step = BASES[base], scenario.simulation_step
    if base == "idm":
        follow = commanded_speed if scenario.human_control == "commanded" else people_speed
        return partial(follow, people=scenario.humans, step=step)
    if make is None:
        return lambda speed, leader_speed, gap: speed + 0.0  # the caller writes into what it gets
    person = make(scenario)

    def driven(speed: Array, leader_speed: Array, gap: Array) -> Array:
        state = LocalState(speed, leader_speed, gap, speed, LARGEST_GAP, nan, nan)
        return next_speed(speed, person.act(state, {})[0], step)

    return driven


def _inputs(speed: Array, leader_speed: Array, gap: Array, known: Array) -> Tensor:
    """Return what the networks see of vehicles of any shape, one row each."""
    seen = [each.ravel() for each in (speed, leader_speed, gap, known)]
    return torch.from_numpy(np.stack(seen, 1)) if isinstance(speed, np.ndarray) else torch.stack(seen, 1)


def residual_of(model: RoadModel, generator: torch.Generator) -> Learned | None:
    """Return what the networks add, a random one for each 64 vehicles; None where that is nothing."""
    if not model.learned.any():
        return None
    layers = model.layers()

    def residual(speed: Array, leader_speed: Array, gap: Array, known: Array) -> Array:
        inputs = _inputs(speed, leader_speed, gap, known).float()
        found = predict(layers, inputs, random_members(model.members, len(inputs), generator))
        found = found.numpy() if isinstance(speed, np.ndarray) else found
        return found.reshape(speed.shape)

    return residual


def people_of(model: RoadModel, scenario: Scenario, generator: torch.Generator) -> People:
    """Return how people drive in the virtual environment: the base, and what a random network adds to it."""
    known, residual = known_speed(model.base, scenario), residual_of(model, generator)
    if residual is None:
        return known

    def driven(speed: Array, leader_speed: Array, gap: Array) -> Array:
        base = known(speed, leader_speed, gap)
        return at_least(base + residual(speed, leader_speed, gap, base), 0.0)

    return driven


def _noise(scenario: Scenario) -> float:
    """Return the standard deviation of what noise adds to people's speeds in a step [m/s]."""
    return scenario.noise_per_step * scenario.simulation_step


def _free(moments: Moments, scenario: Scenario, wanted: Floats) -> NDArray[np.bool_]:
    """Return whether the right of way lets people drive so fast [m/s], shapes (M, N)."""
    road, waits = _road_of(cast(Loop, scenario), moments.size), cast(Memory, moments.waits)
    wanted = np.where(moments.people > 0.0, wanted, moments.after).clip(0.0)
    places = np.flatnonzero(moments.people == 0.0).tolist()
    return heeded(scenario, road, places, waits, (moments.speeds, moments.positions), wanted)


def people_in(kept: Sequence[Moments], base: str, scenario: Scenario) -> PeopleRows:
    """Return what people did, a row each, where no right of way binds them."""
    known, columns = known_speed(base, scenario), []
    for moments in kept:
        ahead = np.roll(moments.positions, -1, 1)
        gap = gap_on_loop(moments.positions, ahead, moments.length, VEHICLE_LENGTH)
        seen = moments.speeds, np.roll(moments.speeds, -1, 1), gap
        based, episode = known(*seen), np.full(gap.shape, moments.episode)
        counts = np.broadcast_to(moments.people > 0.0, gap.shape)
        if moments.waits is not None:
            counts = counts & _free(moments, scenario, based + LARGEST_NOISE * _noise(scenario))
        each = (*seen, based, moments.moved, moments.after, episode)
        columns.append(np.stack([values[counts] for values in each]))
    return PeopleRows(*np.concatenate(columns, 1))


def fit_roads(
    model: RoadModel,
    kept: Sequence[Moments],
    settings: VirtualSettings,
    scenario: Scenario,
    seed: Sequence[int],
) -> Fit:
    """Teach `model` what the base leaves of how people moved, and measure their noise.

    The errors, of the speed alone: `unexplained` is the squared error on the holdout over the variance of
    what there was to predict; `transitions` is between the next speed as a member has it and as it truly
    was drawn, with the noise known from the record; `total_variation` between members. Where people are
    commanded it is the mean square of the errors beyond the noise's variance that counts as ignorance.

    Raises:
        UnjamError: a loss is not finite.
    """
    rows, commanded = people_in(kept, model.base, scenario), scenario.human_control == "commanded"
    moves = rows.moved > MOVES
    sigma = float((rows.after - rows.moved)[moves].std()) if moves.any() else 0.0
    if commanded:
        sigma = _noise(scenario)
    return fit_people(model, rows, sigma, settings, seed, noise_known=not commanded)


def fit_people(
    model: RoadModel,
    rows: PeopleRows,
    sigma: float,
    settings: VirtualSettings,
    seed: Sequence[int],
    noise_known: bool,
    least: float = 0.0,
) -> Fit:
    """Teach `model` what the base leaves of rows, as `fit_roads` says.

    `sigma` is the standard deviation of noise [m/s]; `noise_known` where rows are without it. Networks that
    save less than the share `least` of the base's mean square error add nothing.
    """
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    held_out = is_held_out(rows.episode, settings.holdout)
    if held_out.all() or not held_out.any():  # too few episodes: the last part of what was seen
        held_out = np.arange(len(held_out)) >= (1.0 - settings.holdout) * len(held_out)
    model.noise.fill_(sigma)
    targets = torch.from_numpy((rows.moved - rows.base)[:, None])
    found = teach(model, rows.inputs, targets, held_out, settings, generator)
    left, before = root_mean_square(found.wanted - found.predicted), root_mean_square(found.wanted)
    known = before < SMALLEST_CHANGE or left**2 > (1.0 - least) * before**2  # of rounding, the base knows all
    if settings.fall_back and known:
        model.learned.zero_()
    wrong = found.wanted - found.predicted * model.learned.numpy()
    change = (rows.moved - rows.speed)[found.holdout]
    step = OneStep(root_mean_square(found.wanted), root_mean_square(wrong), float(change.std()))
    if not noise_known:
        wrong = np.sqrt((np.square(wrong).mean((0, 1)) - sigma**2).clip(0.0))
    errors = {
        "unexplained": (root_mean_square(wrong) / max(step.change, SMALLEST_CHANGE)) ** 2,
        "transitions": against_transitions(wrong, sigma),
        "total_variation": total_variation(found.predicted * model.learned.numpy(), np.array([sigma])),
        "released": found.loss,
    }
    learned = ("speed",) if model.learned.any() else ()
    return Fit(errors, {"speed": step}, learned, found.rows, len(found.holdout), found.epochs)
