"""Calibrating the IDM on people: the parameters with which the simulated gap is nearest to the real one.

Of all drivers together, and of each for itself on top of what suits all. Least squares on single
accelerations would degenerate: the model then hardly reacts. On the simulated gap it has to drive. Source of
the method: Treiber and Kesting, Traffic Flow Dynamics (2013), chapter 16.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass as checked_dataclass

from unjam.drivers.local_state import LocalState
from unjam.following.open_loop import Bounds, Model, drive_behind, open_loop, personal_idm, with_values
from unjam.following.pairs import Floats, Pair, Stretches, people_behind, stretches_of
from unjam.parameters import STRICT, Count, CountOrNone, NotNegative, Positive
from unjam.physics.idm import IDMParameters, IDMRows
from unjam.scenarios.scenario import Scenario

Range = tuple[Positive, Positive]


@checked_dataclass(frozen=True, config=STRICT)
class CalibrationSettings:
    """What is searched, and how long; the exponent stays 4."""

    desired_speed: Range = (5.0, 40.0)
    """v0 [m/s]"""
    time_headway: Range = (0.1, 4.0)
    """T [s]"""
    max_acceleration: Range = (0.1, 4.0)
    """a [m/s2]"""
    comfortable_deceleration: Range = (0.1, 6.0)
    """b [m/s2]"""
    minimum_gap: Range = (0.5, 6.0)
    """s0 [m]"""
    kept_headway: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    """share of the headway with which a driver was found that it keeps, see `personal_idm`"""
    every: Literal["trajectory", "moment"] = "trajectory"
    """what counts alike: `trajectory`: the mean of their root mean squared errors, of all stretches of each;
    `moment`: one root mean square over all of them, in which the few who leave very large gaps decide"""
    limits: Bounds = (-4.0, 2.0)
    """within which the acceleration is kept [m/s2]: where a gap is nearly used up the IDM alone brakes beyond
    all bounds"""
    seconds: Positive = 120.0
    """longer trajectories are cut into stretches of this length, each starting with the recorded gap"""
    candidates: Count = 8
    """sets of parameters that are tried at once, for each of the five parameters"""
    generations: Count = 100
    """of differential evolution, at most"""
    tolerance: Positive = 1e-3
    """spread of the candidates' errors, relative to their mean, at which it ends"""
    seed: CountOrNone = 0


SEARCHED = ("desired_speed", "time_headway", "max_acceleration", "comfortable_deceleration", "minimum_gap")
GRID = 32
"""values of an only parameter that are tried at first"""
TOLERANCE = 1e-3
"""to which the best of them is then refined, in the parameter's unit"""
BEHIND_CAVS = CalibrationSettings(candidates=4, generations=40)
"""for those who drove behind the CAVs of a training"""


@dataclass(frozen=True)
class Calibrated:
    """What came of a calibration."""

    parameters: IDMParameters
    kept_headway: float
    """of `personal_idm`"""
    gap_error: float
    """root mean squared error of the simulated gap [m]"""
    speed_error: float
    """of the simulated speed [m/s]"""
    collided: int
    """stretches in which the model used the gap up"""
    seconds: float
    """of driving that it was calibrated on"""
    bounds: tuple[str, ...]
    """parameters that lie at the end of what was searched: the data do not tell them"""

    def model(self, limits: Bounds) -> Model:
        """Return it as a driver."""
        return personal_idm(self.parameters, self.kept_headway, limits)


def calibrate(
    pairs: Sequence[Pair],
    settings: CalibrationSettings | None = None,
    headways: Sequence[float] | None = None,
) -> Calibrated:
    """Return the parameters that suit `pairs` best when all are driven by one IDM.

    Differential evolution over the error of the simulated gap; all candidates and all stretches are simulated
    at once.

    Args:
        pairs: trajectories.
        settings: what is searched.
        headways: by what factor the time headway of each trajectory's driver is known to differ; None: it is
            not known.

    Raises:
        InputError: the pairs have different time steps.
    """
    from scipy.optimize import differential_evolution  # half a second that help need not wait

    settings = settings or CalibrationSettings()
    stretches = stretches_of(pairs, settings.seconds)
    factors = 1.0 if headways is None else np.array(headways)[stretches.owner]
    found = differential_evolution(
        gap_objective(stretches, settings.limits, settings.every, factors),
        bounds=[getattr(settings, name) for name in (*SEARCHED, "kept_headway")],
        popsize=settings.candidates,
        maxiter=settings.generations,
        tol=settings.tolerance,
        rng=settings.seed,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    *searched, kept = map(float, found.x)
    parameters = IDMParameters(**dict(zip(SEARCHED, searched, strict=True)))
    driven = with_values(parameters, time_headway=parameters.time_headway * factors)
    drove = open_loop(personal_idm(driven, kept, settings.limits), stretches)
    weights = drove.moments / drove.moments.sum()
    return Calibrated(
        parameters,
        kept,
        float(np.sqrt((drove.gap_square * weights).sum())),
        float(np.sqrt((drove.speed_square * weights).sum())),
        int(drove.collided.sum()),
        sum(pair.seconds for pair in pairs),
        tuple(name for name in SEARCHED if at_an_end(getattr(parameters, name), getattr(settings, name))),
    )


def gap_objective(
    stretches: Stretches, limits: Bounds, every: str, headways: Floats | float = 1.0
) -> Callable[[Floats], Floats]:
    """Return the error of the simulated gap [m] as a function of candidates, shape (6, S) -> (S,).

    `headways` are factors on the time headway, of each stretch.
    """
    moments, (first, weights) = stretches.moments, _in_trajectories(stretches)

    def objective(candidates: Floats) -> Floats:
        v0, headway, acceleration, deceleration, minimum_gap, kept = candidates.reshape(6, -1, 1)
        rows = IDMRows(v0, headway * headways, acceleration, deceleration, 4.0, minimum_gap)
        squares = gap_squares(stretches, personal_idm(rows, kept, limits), len(v0))
        if every == "trajectory":
            return np.sqrt(np.add.reduceat(squares * weights, first, axis=1)).mean(1)
        return np.sqrt((squares * moments).sum(1) / moments.sum())

    return objective


def gap_squares(stretches: Stretches, model: Model, candidates: int = 1) -> Floats:
    """Return the mean squared error of the gap of each stretch [m2], shape (candidates, n).

    As `open_loop`, but for many drivers at once, and without keeping where they were.
    """
    total = np.zeros((candidates, len(stretches.moments)))
    speed, gap = (np.broadcast_to(values, total.shape) for values in stretches.start)
    driven = drive_behind(model(speed, gap), (speed, gap), stretches.leader, stretches.step)
    for moment, (_, gap) in enumerate(driven, 1):
        total += np.square(gap - stretches.gap[moment]) * stretches.present[moment]
    return total / stretches.moments


def _in_trajectories(stretches: Stretches) -> tuple[NDArray[np.intp], Floats]:
    """Return the first stretch of each trajectory, and each one's share of its trajectory's moments."""
    owner, moments = stretches.owner, stretches.moments
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    return first, moments / np.bincount(owner, moments)[owner]


def at_an_end(value: float, within: Range) -> bool:
    """Return whether a value lies at the end of what was searched: the data do not tell it."""
    low, high = within
    return low < high and min(value - low, high - value) < 0.01 * (high - low)


def calibrate_each(
    groups: Sequence[Sequence[Pair]],
    typical: IDMParameters,
    own: Sequence[str],
    settings: CalibrationSettings | None = None,
    on_progress: Callable[[int], object] = lambda done: None,
) -> list[Calibrated]:
    """Return a calibration of each group of pairs, for instance of each driver.

    Only the parameters `own` are searched, the others are those of `typical`: a minute of driving tells the
    distance that somebody keeps, but not how fast they would like to be on an empty road. A single parameter
    is searched for all groups at once, several for one group after the other, which takes a second each.
    `on_progress` is told how many are done.
    """
    settings = settings or CalibrationSettings()
    if len(own) == 1:
        found = _one_parameter(groups, typical, own[0], settings)
        on_progress(len(found))
        return found
    fixed = {name: (getattr(typical, name),) * 2 for name in SEARCHED if name not in own}
    found: list[Calibrated] = []
    for number, pairs in enumerate(groups, 1):
        found.append(calibrate(pairs, replace(settings, **fixed)))
        on_progress(number)
    return found


def _one_parameter(
    groups: Sequence[Sequence[Pair]], typical: IDMParameters, name: str, settings: CalibrationSettings
) -> list[Calibrated]:
    """Return each group's own value of one parameter, and how it drives with it."""
    stretches = stretches_of(list(chain.from_iterable(groups)), settings.seconds)
    group = np.repeat(np.arange(len(groups)), [len(pairs) for pairs in groups])[stretches.owner]

    def model(values: Floats) -> Model:
        return personal_idm(with_values(typical, **{name: values[group]}), 0.0, settings.limits)

    def errors(values: Floats) -> Floats:
        (squares,) = gap_squares(stretches, model(values))
        return _by_group(squares, stretches, group, settings.every)

    low, high = within = getattr(settings, name)
    values = _least(errors, np.linspace(low, high, GRID), len(groups))
    drove = open_loop(model(values), stretches)
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
            bounds=(name,) if at_an_end(value, within) else (),
        )
        for number, value in enumerate(values)
    ]


def _least(errors: Callable[[Floats], Floats], grid: Floats, groups: int) -> Floats:
    """Return where each group's error is least: the best of a grid, refined between its neighbours."""
    from scipy.optimize import elementwise  # half a second that help need not wait

    tried = np.stack([errors(np.full(groups, value)) for value in grid])
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
    return values


def _by_group(squares: Floats, stretches: Stretches, group: NDArray[np.int64], every: str) -> Floats:
    """Return the error of each group from the mean squared errors of its stretches, as settings say."""
    if every == "trajectory":
        first, weights = _in_trajectories(stretches)
        errors, group = np.sqrt(np.add.reduceat(squares * weights, first)), group[first]
        return np.bincount(group, errors) / np.bincount(group)
    moments = stretches.moments
    return np.sqrt(np.bincount(group, squares * moments) / np.bincount(group, moments))


def calibrated_people(recordings: Iterable[LocalState], scenario: Scenario) -> IDMParameters:
    """Return the IDM parameters that suit the people behind the CAVs best; the scenario's where nobody was.

    `recordings` are what CAVs perceived, see `people_behind`. Desired speed and smallest gap stay the
    scenario's: in traffic that moves slowly nobody shows them.
    """
    pairs = people_behind(recordings, scenario.decision_step, scenario.steps_per_decision)
    known = scenario.humans
    if not pairs:
        return known
    speed, gap = known.desired_speed, known.minimum_gap
    found = calibrate(pairs, replace(BEHIND_CAVS, desired_speed=(speed, speed), minimum_gap=(gap, gap)))
    return replace(found.parameters, exponent=known.exponent)
