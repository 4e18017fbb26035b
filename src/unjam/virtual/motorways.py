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
from unjam.physics.arrays import Floats
from unjam.scenarios.on_ramp import RAMP_SPEED, OnRamp
from unjam.scenarios.road import MotorwayRoad
from unjam.virtual.fitting import Fit
from unjam.virtual.roads import PeopleRows, RoadModel, fit_people, residual_of
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.batch.motorway import Learned, Motorways, begun, driven_by, let_acc_drive
from unjam.worlds.batch.vehicles import Vehicles, around, chosen, number_of, rows_of
from unjam.worlds.record import Episode

EVERY = 60
"""decisions from one moment that is learned from to the next, at most"""
LEAST = 0.3
"""share of the base's mean square error that networks must save: a record does not tell what people remember
of lane changes, and who imagines them knows it; its mean effect would be added twice. Networks that saved a
fifth made imagined episodes 10 s too long; others, that saved more than half, 20 s instead of
180 (docs/virtual.md)"""
JUDGED = 0.5
"""standard deviation of what people misjudge once they have driven for a while; of how they drive it is 1"""


@dataclass(frozen=True)
class MotorwayMoments:
    """What is kept of an actual episode on an on-ramp."""

    episode: int
    """number of the episode"""
    seed: tuple[int, ...]
    """of the episode: it says who wanted to enter, and when"""
    earned: float
    """return of the episode"""
    people: PeopleRows
    """what people did who kept their lane; the base is without what they misjudge"""
    noise: float
    """mean square of what that adds to a speed in a decision [m2/s2]"""


def check_motorways(scenario: OnRamp, settings: VirtualSettings) -> None:
    """Raise `InputError` where an on-ramp cannot be imagined with these settings."""
    if settings.begin != "first":
        raise InputError(f"virtual.begin: {settings.begin} is not allowed; allowed: first, on the on-ramp")
    if settings.base not in ("idm", "none"):
        words = "idm, as each drives, or none, on the on-ramp"
        raise InputError(f"virtual.base: {settings.base} is not allowed; allowed: {words}")
    if settings.calibrate:
        raise InputError("virtual.calibrate: true is not allowed; allowed: false, on the on-ramp")


class _Chosen(NamedTuple):
    """Vehicles at some moments of an episode, moment by moment from front to back; V in all."""

    moment: NDArray[np.intp]
    """which of the moments, shape (V,)"""
    column: NDArray[np.intp]
    """of the record's tables"""
    vehicle: NDArray[np.intp]
    """number among the record's vehicles"""


def moments_of_motorway(
    episode: Episode, number: int, scenario: OnRamp, base: str = "idm"
) -> MotorwayMoments:
    """Return what is kept of an actual episode, the so many-th, on a scenario.

    Raises:
        InputError: so many drove for so long that the record skips moments.
    """
    if episode.every > 1:
        raise InputError("road: its record skips moments; allowed: a shorter horizon, where it is imagined")
    road = cast(MotorwayRoad, scenario.of_seed(episode.seed)[0])
    every = max(1, min(EVERY, episode.steps // 4))
    at = np.arange(every, episode.steps, every)
    those = _chosen(episode, at)
    now, later = (at[those.moment], those.column), (at[those.moment] + 1, those.column)
    before = _vehicles(episode, road, scenario, now, those)
    generator = np.random.default_rng([*episode.seed, number])
    errors = generator.standard_normal((3, len(those.moment)))
    erring = before._replace(
        gap_error=JUDGED * errors[0], leader_error=JUDGED * errors[1], driving_error=errors[2]
    )
    known, noisy = (
        _stepped(each, road, scenario, len(at), draw)
        for each, draw in ((before, np.zeros), (erring, generator.standard_normal))
    )
    row, after = chosen(around(before, len(road.ways)).ahead, before.way), episode.speeds[later]
    keeps = episode.lanes[later] == episode.lanes[now]
    counts = (row >= 0) & before.extended & keeps & ~np.isnan(known + noisy + after)
    gap = before.place[row] - road.vehicle_length - before.place
    noise = float(np.square(noisy - known)[counts].mean()) if counts.any() else 0.0
    based = before.speed if base == "none" else known
    columns = before.speed, before.speed[row], gap, based, after, after, np.full(len(row), float(number))
    people = PeopleRows(*(each[counts] for each in columns))
    return MotorwayMoments(number, tuple(episode.seed), float(episode.reward.sum()), people, noise)


def _chosen(episode: Episode, at: NDArray[np.intp]) -> _Chosen:
    """Return who is on the road at moments, and where: vehicles share columns one after the other."""
    there = ~np.isnan(episode.speeds)
    begins = there & ~np.vstack([np.zeros((1, there.shape[1]), bool), there[:-1]])
    so_many = np.cumsum(begins, 0) - 1
    columns = np.array(episode.columns or range(there.shape[1]))
    order = np.argsort(columns, kind="stable")
    first = np.searchsorted(columns[order], np.arange(there.shape[1]))
    moment, column = np.nonzero(there[at])
    rows = np.lexsort((-episode.positions[at[moment], column], moment))
    moment, column = moment[rows], column[rows]
    return _Chosen(moment, column, order[first[column] + so_many[at[moment], column]])


def _vehicles(
    episode: Episode,
    road: MotorwayRoad,
    scenario: OnRamp,
    now: tuple[NDArray[np.intp], NDArray[np.intp]],
    those: _Chosen,
) -> Vehicles:
    """Return the vehicles of moments as a batch has them, each moment a road; nobody errs or remembers."""
    numbers = {entry.name: number for number, entry in enumerate(road.entries)}
    entries = np.array([numbers[name] for name in episode.vehicle_ids])
    people = np.array([driven_by(road.kinds[road.entries[number].kind]) for number in entries.tolist()])
    *follows, factor, extended = people[those.vehicle].T
    way = (len(road.ways) - 1 - episode.lanes[now]).astype(np.intp)
    place, speed = episode.positions[now] + road.merge, episode.speeds[now]
    change = np.nan_to_num(speed - episode.speeds[now[0] - 1, now[1]]) / episode.step
    limit = np.where((way == 0) & (place < road.merge), RAMP_SPEED, road.limit_speed)
    where = those.moment, entries[those.vehicle], way, place, speed, change
    found = begun(*where, *follows, factor, extended, limit * factor)
    cavs = np.isin(np.array(episode.vehicle_ids), episode.cav_ids)
    let_acc_drive(found, cavs[those.vehicle], scenario.cruise)
    return found


def _stepped(
    vehicles: Vehicles, road: MotorwayRoad, scenario: OnRamp, roads: int, draw: Callable[..., Floats]
) -> Floats:
    """Return the speeds after a decision of those who kept their lane and are there [m/s]; NaN of others."""
    empty = [replace(road, entries=())] * roads
    traffic = Motorways(empty, scenario.simulation_step, draw, np.asarray)
    traffic.vehicles = vehicles.each(np.copy)
    for _ in range(scenario.steps_per_decision):
        traffic.step()
    after = traffic.vehicles
    row = rows_of(number_of(vehicles), after)
    keeps = (row >= 0) & (after.way[row] == vehicles.way)
    return np.where(keeps, after.speed[row], np.nan)


def beside_known(
    model: RoadModel, generator: torch.Generator, steps: int, noise: bool = True
) -> Learned | None:
    """Return what people do in a decision of so many steps beside what the batch has them do.

    With the base `none` that takes back what the batch knows of following, and what people misjudge, of which
    `noise` of as much strength is left.
    """
    residual = residual_of(model, generator)
    if model.base != "none":
        return residual
    sigma = float(model.noise) * sqrt(steps) if noise else 0.0

    def driven(speed: Floats, leader_speed: Floats, gap: Floats, known: Floats) -> Floats:
        drawn = torch.randn(speed.size, generator=generator, dtype=torch.float64).numpy()
        learned = residual(speed, leader_speed, gap, speed) if residual else 0.0
        return speed - known + learned + sigma * drawn

    return driven


def fit_motorways(
    model: RoadModel,
    kept: Sequence[MotorwayMoments],
    settings: VirtualSettings,
    seed: Sequence[int],
    twins: int = 1,
) -> Fit:
    """Teach `model` what people did beside the base; what they misjudge is no ignorance.

    So many `twins` in a row meet the same people: they are held out together.

    Raises:
        UnjamError: a loss is not finite.
    """
    rows = PeopleRows(*(np.concatenate(each) for each in zip(*(one.people for one in kept), strict=True)))
    rows = rows._replace(episode=rows.episode // twins)
    sigma = float(np.sqrt(np.mean([one.noise for one in kept])))
    least = 0.0 if model.base == "none" else LEAST
    return fit_people(model, rows, sigma, settings, seed, noise_known=False, least=least)
