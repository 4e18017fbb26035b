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
from unjam.following.open_loop import (
    AccelerationBounds,
    DriverModel,
    follow_leader,
    individual_idm,
    replace_parameters,
    simulate_open_loop,
)
from unjam.following.pairs import Floats, Pair, Segments, make_segments, pairs_behind_cavs
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt
from unjam.physics.idm import IDMArrays, IDMParameters
from unjam.scenarios.scenario import Scenario

ParameterRange = tuple[Positive, Positive]


@checked_dataclass(frozen=True, config=STRICT)
class CalibrationSettings:
    """What is searched, and how long; the exponent stays 4."""

    desired_speed: ParameterRange = (5.0, 40.0)
    """v0 [m/s]"""
    time_headway: ParameterRange = (0.1, 4.0)
    """T [s]"""
    max_acceleration: ParameterRange = (0.1, 4.0)
    """a [m/s2]"""
    comfortable_deceleration: ParameterRange = (0.1, 6.0)
    """b [m/s2]"""
    minimum_gap: ParameterRange = (0.5, 6.0)
    """s0 [m]"""
    initial_headway_weight: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """share of the headway with which a driver was found that it keeps, see `individual_idm`"""
    weighting: Literal["trajectory", "sample"] = "trajectory"
    """what counts alike: `trajectory`: the mean of their root mean squared errors, of all stretches of each;
    `sample`: one root mean square over all of them, in which the few who leave very large gaps decide"""
    limits: AccelerationBounds = (-4.0, 2.0)
    """within which the acceleration is kept [m/s2]: where a gap is nearly used up the IDM alone brakes beyond
    all bounds"""
    segment_seconds: Positive = 120.0
    """longer trajectories are cut into stretches of this length, each starting with the recorded gap"""
    candidates: PositiveInt = 8
    """sets of parameters that are tried at once, for each of the five parameters"""
    generations: PositiveInt = 100
    """of differential evolution, at most"""
    tolerance: Positive = 1e-3
    """spread of the candidates' errors, relative to their mean, at which it ends"""
    seed: NonNegativeInt = 0


CALIBRATED_PARAMETERS = ("desired_speed", "time_headway", "max_acceleration", "comfortable_deceleration", "minimum_gap")
CALIBRATION_GRID_SIZE = 32
"""values of an only parameter that are tried at first"""
CALIBRATION_TOLERANCE = 1e-3
"""to which the best of them is then refined, in the parameter's unit"""
CAV_FOLLOWER_SETTINGS = CalibrationSettings(candidates=4, generations=40)
"""for those who drove behind the CAVs of a training"""


@dataclass(frozen=True)
class CalibratedIDM:
    """What came of a calibration."""

    parameters: IDMParameters
    initial_headway_weight: float
    """of `individual_idm`"""
    gap_error: float
    """root mean squared error of the simulated gap [m]"""
    speed_error: float
    """of the simulated speed [m/s]"""
    collisions: int
    """stretches in which the model used the gap up"""
    seconds: float
    """of driving that it was calibrated on"""
    parameters_at_bounds: tuple[str, ...]
    """parameters that lie at the end of what was searched: the data do not tell them"""

    def model(self, limits: AccelerationBounds) -> DriverModel:
        """Return it as a driver."""
        return individual_idm(self.parameters, self.initial_headway_weight, limits)


def calibrate_idm(
    pairs: Sequence[Pair], settings: CalibrationSettings | None = None, headway_factors: Sequence[float] | None = None
) -> CalibratedIDM:
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
    stretches = make_segments(pairs, settings.segment_seconds)
    factors = 1.0 if headway_factors is None else np.array(headway_factors)[stretches.pair_index]
    found = differential_evolution(
        gap_objective(stretches, settings.limits, settings.weighting, factors),
        bounds=[getattr(settings, name) for name in (*CALIBRATED_PARAMETERS, "initial_headway_weight")],
        popsize=settings.candidates,
        maxiter=settings.generations,
        tol=settings.tolerance,
        rng=settings.seed,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    *searched, kept = map(float, found.x)
    parameters = IDMParameters(**dict(zip(CALIBRATED_PARAMETERS, searched, strict=True)))
    driven = replace_parameters(parameters, time_headway=parameters.time_headway * factors)
    drove = simulate_open_loop(individual_idm(driven, kept, settings.limits), stretches)
    weights = drove.sample_counts / drove.sample_counts.sum()
    return CalibratedIDM(
        parameters,
        kept,
        float(np.sqrt((drove.gap_mse * weights).sum())),
        float(np.sqrt((drove.speed_mse * weights).sum())),
        int(drove.has_collided.sum()),
        sum(pair.seconds for pair in pairs),
        tuple(
            name for name in CALIBRATED_PARAMETERS if is_at_bound(getattr(parameters, name), getattr(settings, name))
        ),
    )


def gap_objective(
    segments: Segments, limits: AccelerationBounds, weighting: str, headway_factors: Floats | float = 1.0
) -> Callable[[Floats], Floats]:
    """Return the error of the simulated gap [m] as a function of candidates, shape (6, S) -> (S,).

    `time_gaps` are factors on the time headway, of each stretch.
    """
    moments, (first, weights) = segments.sample_counts, _trajectory_weights(segments)

    def objective(candidates: Floats) -> Floats:
        v0, headway, acceleration, deceleration, minimum_gap, kept = candidates.reshape(6, -1, 1)
        rows = IDMArrays(v0, headway * headway_factors, acceleration, deceleration, 4.0, minimum_gap)
        squares = gap_mean_squares(segments, individual_idm(rows, kept, limits), len(v0))
        if weighting == "trajectory":
            return np.sqrt(np.add.reduceat(squares * weights, first, axis=1)).mean(1)
        return np.sqrt((squares * moments).sum(1) / moments.sum())

    return objective


def gap_mean_squares(segments: Segments, model: DriverModel, candidate_count: int = 1) -> Floats:
    """Return the mean squared error of the gap of each stretch [m2], shape (candidates, n).

    As `open_loop`, but for many drivers at once, and without keeping where they were.
    """
    total = np.zeros((candidate_count, len(segments.sample_counts)))
    speed, gap = (np.broadcast_to(values, total.shape) for values in segments.start)
    driven = follow_leader(model(speed, gap), (speed, gap), segments.leader, segments.step)
    for moment, (_, gap) in enumerate(driven, 1):
        total += np.square(gap - segments.gap[moment]) * segments.is_present[moment]
    return total / segments.sample_counts


def _trajectory_weights(segments: Segments) -> tuple[NDArray[np.intp], Floats]:
    """Return the first stretch of each trajectory, and each one's share of its trajectory's moments."""
    owner, moments = segments.pair_index, segments.sample_counts
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    return first, moments / np.bincount(owner, moments)[owner]


def is_at_bound(value: float, bounds: ParameterRange) -> bool:
    """Return whether a value lies at the end of what was searched: the data do not tell it."""
    low, high = bounds
    return low < high and min(value - low, high - value) < 0.01 * (high - low)


def calibrate_groups(
    groups: Sequence[Sequence[Pair]],
    typical: IDMParameters,
    individual: Sequence[str],
    settings: CalibrationSettings | None = None,
    on_progress: Callable[[int], object] = lambda done: None,
) -> list[CalibratedIDM]:
    """Return a calibration of each group of pairs, for instance of each driver.

    Only the parameters `own` are searched, the others are those of `typical`: a minute of driving tells the
    distance that somebody keeps, but not how fast they would like to be on an empty road. A single parameter
    is searched for all groups at once, several for one group after the other, which takes a second each.
    `on_progress` is told how many are done.
    """
    settings = settings or CalibrationSettings()
    if len(individual) == 1:
        found = _calibrate_one_parameter(groups, typical, individual[0], settings)
        on_progress(len(found))
        return found
    fixed = {name: (getattr(typical, name),) * 2 for name in CALIBRATED_PARAMETERS if name not in individual}
    found: list[CalibratedIDM] = []
    for number, pairs in enumerate(groups, 1):
        found.append(calibrate_idm(pairs, replace(settings, **fixed)))
        on_progress(number)
    return found


def _calibrate_one_parameter(
    groups: Sequence[Sequence[Pair]], typical: IDMParameters, name: str, settings: CalibrationSettings
) -> list[CalibratedIDM]:
    """Return each group's own value of one parameter, and how it drives with it."""
    stretches = make_segments(list(chain.from_iterable(groups)), settings.segment_seconds)
    group = np.repeat(np.arange(len(groups)), [len(pairs) for pairs in groups])[stretches.pair_index]

    def model(values: Floats) -> DriverModel:
        return individual_idm(replace_parameters(typical, **{name: values[group]}), 0.0, settings.limits)

    def errors(values: Floats) -> Floats:
        (squares,) = gap_mean_squares(stretches, model(values))
        return _group_errors(squares, stretches, group, settings.weighting)

    low, high = within = getattr(settings, name)
    values = _minimize_on_grid(errors, np.linspace(low, high, CALIBRATION_GRID_SIZE), len(groups))
    drove = simulate_open_loop(model(values), stretches)
    gap_errors, speed_errors = (
        _group_errors(squares, stretches, group, "sample") for squares in (drove.gap_mse, drove.speed_mse)
    )
    collided = np.bincount(group, drove.has_collided, len(groups))
    return [
        CalibratedIDM(
            parameters=replace(typical, **{name: float(value)}),
            initial_headway_weight=0.0,
            gap_error=float(gap_errors[number]),
            speed_error=float(speed_errors[number]),
            collisions=int(collided[number]),
            seconds=sum(pair.seconds for pair in groups[number]),
            parameters_at_bounds=(name,) if is_at_bound(value, within) else (),
        )
        for number, value in enumerate(values)
    ]


def _minimize_on_grid(errors: Callable[[Floats], Floats], grid: Floats, group_count: int) -> Floats:
    """Return where each group's error is least: the best of a grid, refined between its neighbours."""
    from scipy.optimize import elementwise  # half a second that help need not wait

    tried = np.stack([errors(np.full(group_count, value)) for value in grid])
    place = tried.argmin(0)
    values = grid[place]
    inner = np.flatnonzero((place > 0) & (place < CALIBRATION_GRID_SIZE - 1))

    def refined_errors(candidates: Floats, indices: NDArray[np.int64]) -> Floats:
        wanted = values.copy()
        wanted[indices.astype(int)] = candidates
        return errors(wanted)[indices.astype(int)]

    if len(inner):
        bracket = tuple(grid[place[inner] + shift] for shift in (-1, 0, 1))
        found = elementwise.find_minimum(
            refined_errors, bracket, args=(inner,), tolerances={"xatol": CALIBRATION_TOLERANCE}
        )
        better = found.f_x <= tried.min(0)[inner]
        values[inner[better]] = found.x[better]
    return values


def _group_errors(mean_squares: Floats, segments: Segments, group: NDArray[np.int64], weighting: str) -> Floats:
    """Return the error of each group from the mean squared errors of its stretches, as settings say."""
    if weighting == "trajectory":
        first, weights = _trajectory_weights(segments)
        errors, group = np.sqrt(np.add.reduceat(mean_squares * weights, first)), group[first]
        return np.bincount(group, errors) / np.bincount(group)
    moments = segments.sample_counts
    return np.sqrt(np.bincount(group, mean_squares * moments) / np.bincount(group, moments))


def calibrate_human_drivers(recordings: Iterable[LocalState], scenario: Scenario) -> IDMParameters:
    """Return the IDM parameters that suit the people behind the CAVs best; the scenario's where nobody was.

    `recordings` are what CAVs perceived, see `pairs_behind_cavs`. Desired speed and smallest gap stay the
    scenario's: in traffic that moves slowly nobody shows them.
    """
    pairs = pairs_behind_cavs(recordings, scenario.control_step, scenario.steps_per_control_step)
    known = scenario.humans
    if not pairs:
        return known
    speed, gap = known.desired_speed, known.minimum_gap
    found = calibrate_idm(pairs, replace(CAV_FOLLOWER_SETTINGS, desired_speed=(speed, speed), minimum_gap=(gap, gap)))
    return replace(found.parameters, exponent=known.exponent)
