"""Calibrating every driver for itself, on top of what suits all."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from unjam.following.calibration import (
    SEARCHED,
    Calibrated,
    CalibrationSettings,
    at_an_end,
    calibrate,
    gap_squares,
)
from unjam.following.open_loop import open_loop, personal_idm
from unjam.following.pairs import Floats, Pair, Stretches, stretches_of
from unjam.physics.idm import PARAMETER_NAMES, IDMParameters, IDMRows

GRID = 32
"""values of an only parameter that are tried at first"""
TOLERANCE = 1e-3
"""to which the best of them is then refined, in the parameter's unit"""


def calibrate_each(
    groups: Sequence[Sequence[Pair]],
    typical: IDMParameters,
    own: Sequence[str],
    settings: CalibrationSettings | None = None,
    told: Callable[[int], object] | None = None,
) -> list[Calibrated]:
    """Return a calibration of each group of pairs, for instance of each driver.

    Only the parameters `own` are searched, the others are those of `typical`: a minute of driving tells the
    distance that somebody keeps, but not how fast they would like to be on an empty road. A single parameter
    is searched for all groups at once, several for one group after the other, which takes a second each.
    `told` counts.
    """
    settings = settings or CalibrationSettings()
    if len(own) == 1:
        found = _one_parameter(groups, typical, own[0], settings)
        if told is not None:
            told(len(found))
        return found
    fixed = {name: (getattr(typical, name),) * 2 for name in SEARCHED if name not in own}
    found = []
    for number, pairs in enumerate(groups, 1):
        found.append(calibrate(pairs, replace(settings, **fixed)))
        if told is not None:
            told(number)
    return found


def _one_parameter(
    groups: Sequence[Sequence[Pair]], typical: IDMParameters, name: str, settings: CalibrationSettings
) -> list[Calibrated]:
    """Return each group's own value of one parameter: the best of a grid, refined between its neighbours."""
    from scipy.optimize import elementwise  # half a second that help need not wait

    pairs = list(chain.from_iterable(groups))
    group_of_pair = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    stretches = stretches_of(pairs, settings.seconds)
    group = group_of_pair[stretches.owner]

    def errors(values: Floats) -> Floats:
        rows = _with(typical, name, values[group])
        (squares,) = gap_squares(stretches, personal_idm(rows, 0.0, settings.limits))
        return _by_group(squares, stretches, group, settings.every)

    low, high = getattr(settings, name)
    grid = np.linspace(low, high, GRID)
    tried = np.stack([errors(np.full(len(groups), value)) for value in grid])
    place = tried.argmin(0)
    values = grid[place]
    inner = np.flatnonzero((place > 0) & (place < GRID - 1))

    def refined(chosen: Floats, indices: NDArray[np.int64]) -> Floats:
        wanted = values.copy()
        wanted[indices.astype(int)] = chosen
        return errors(wanted)[indices.astype(int)]

    if len(inner):
        bracket = tuple(grid[place[inner] + shift] for shift in (-1, 0, 1))
        found = elementwise.find_minimum(refined, bracket, args=(inner,), tolerances={"xatol": TOLERANCE})
        better = found.f_x <= tried.min(0)[inner]
        values[inner[better]] = found.x[better]
    return _calibrated(values, stretches, group, groups, typical, name, settings)


def _calibrated(
    values: Floats,
    stretches: Stretches,
    group: NDArray[np.int64],
    groups: Sequence[Sequence[Pair]],
    typical: IDMParameters,
    name: str,
    settings: CalibrationSettings,
) -> list[Calibrated]:
    drove = open_loop(personal_idm(_with(typical, name, values[group]), 0.0, settings.limits), stretches)
    gap_errors, speed_errors = (
        _by_group(squares, stretches, group, "moment") for squares in (drove.gap_square, drove.speed_square)
    )
    collided = np.bincount(group, drove.collided, len(groups))
    return [
        Calibrated(
            parameters=replace(typical, **{name: float(value)}),
            kept_headway=0.0,
            gap_error=float(gap_errors[number]),
            speed_error=float(speed_errors[number]),
            collided=int(collided[number]),
            seconds=sum(pair.seconds for pair in groups[number]),
            bounds=(name,) if at_an_end(value, getattr(settings, name)) else (),
        )
        for number, value in enumerate(values)
    ]


def _by_group(squares: Floats, stretches: Stretches, group: NDArray[np.int64], every: str) -> Floats:
    """Return the error of each group from the mean squared errors of its stretches, as settings say."""
    if every == "trajectory":
        return np.bincount(group, np.sqrt(squares)) / np.bincount(group)
    moments = stretches.present[1:].sum(0)
    return np.sqrt(np.bincount(group, squares * moments) / np.bincount(group, moments))


def _with(typical: IDMParameters, name: str, values: Floats) -> IDMRows:
    """Return the parameters of `typical` with an array in one place."""
    return IDMRows(**{one: values if one == name else getattr(typical, one) for one in PARAMETER_NAMES})
