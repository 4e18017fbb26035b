"""Calibration of the IDM on recorded drivers: the parameters whose simulated gap is closest to the recorded one.

Parameters are calibrated for all drivers together, or individually on top of common ones. A least-squares fit of single
accelerations would degenerate to a model that hardly reacts; a fit of the simulated gap must drive. Source of the
method: Treiber and Kesting, Traffic Flow Dynamics (2013), chapter 16.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
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
HiddenSizes = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


@checked_dataclass(frozen=True, config=STRICT)
class CalibrationSettings:
    """Ranges and budget of the search; the exponent stays 4."""

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
    """weight of the time headway at which a driver takes over, see `individual_idm`"""
    weighting: Literal["trajectory", "sample"] = "trajectory"
    """mean of the trajectories' RMS errors, or RMS over all samples, which few drivers with very large gaps dominate"""
    limits: AccelerationBounds = (-4.0, 2.0)
    """of the acceleration [m/s2]; without them the IDM brakes arbitrarily hard when a gap is nearly used up"""
    segment_seconds: Positive = 120.0
    """duration of the segments into which trajectories are cut, each starting with the recorded gap [s]"""
    candidates: PositiveInt = 8
    """sets of parameters that are tried at once, for each parameter"""
    generations: PositiveInt = 100
    """maximum number of generations of differential evolution"""
    tolerance: Positive = 1e-3
    """spread of the candidates' errors, relative to their mean, at which the search ends"""
    seed: NonNegativeInt = 0


@checked_dataclass(frozen=True, config=STRICT)
class MultiStepSettings:
    """A network that learns a residual from simulated driving."""

    hidden: HiddenSizes = (32, 32)
    """sizes of the hidden layers"""
    authority: Positive = 2.0
    """largest residual [m/s2]"""
    segment_seconds: Positive = 30.0
    """duration of the simulated segments [s]"""
    batch_size: PositiveInt = 64
    """segments in a gradient step"""
    gradient_steps: PositiveInt = 120
    learning_rate: Positive = 1e-3
    """initial learning rate of Adam, which falls to zero as a cosine"""
    speed_weight: NonNegative = 2.0
    """weight of a speed error of 1 m/s relative to a gap error of 1 m"""
    residual_weight: NonNegative = 0.1
    """weight of the squared residual, so that the base drives where there are no data"""
    validation_interval: PositiveInt = 20
    """gradient steps between two validations, which select the weights"""


CALIBRATED_PARAMETERS = ("desired_speed", "time_headway", "max_acceleration", "comfortable_deceleration", "minimum_gap")
CALIBRATION_GRID_SIZE = 32
"""grid values of a single parameter"""
CALIBRATION_TOLERANCE = 1e-3
"""to which the best grid value is refined, in the parameter's unit"""
CAV_FOLLOWER_SETTINGS = CalibrationSettings(candidates=4, generations=40)
"""for human drivers behind the CAVs of a training"""


@dataclass(frozen=True)
class CalibratedIDM:
    """The result of a calibration."""

    parameters: IDMParameters
    initial_headway_weight: float
    """of `individual_idm`"""
    gap_error: float
    """root mean squared error of the simulated gap [m]"""
    speed_error: float
    """of the simulated speed [m/s]"""
    collisions: int
    """segments in which the model used up the gap"""
    seconds: float
    """duration of the data [s]"""
    parameters_at_bounds: tuple[str, ...]
    """parameters at the bounds of the search, which the data do not determine"""

    def model(self, limits: AccelerationBounds) -> DriverModel:
        """Return it as a driver."""
        return individual_idm(self.parameters, self.initial_headway_weight, limits)


def calibrate_idm(
    pairs: Sequence[Pair], settings: CalibrationSettings | None = None, headway_factors: Sequence[float] | None = None
) -> CalibratedIDM:
    """Return the parameters of one IDM for all `pairs`.

    The search is differential evolution over the error of the simulated gap, with all candidates and segments simulated
    at once. `headway_factors` are known factors of the time headway, one for each trajectory.

    Raises:
        InputError: the pairs have different time steps.
    """
    from scipy.optimize import differential_evolution  # takes half a second, which --help need not wait for

    settings = settings or CalibrationSettings()
    segments = make_segments(pairs, settings.segment_seconds)
    factors = 1.0 if headway_factors is None else np.array(headway_factors)[segments.pair_index]
    result = differential_evolution(
        gap_objective(segments, settings.limits, settings.weighting, factors),
        bounds=[getattr(settings, name) for name in (*CALIBRATED_PARAMETERS, "initial_headway_weight")],
        popsize=settings.candidates,
        maxiter=settings.generations,
        tol=settings.tolerance,
        rng=settings.seed,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    *values, weight = map(float, result.x)
    parameters = IDMParameters(**dict(zip(CALIBRATED_PARAMETERS, values, strict=True)))
    individual = replace_parameters(parameters, time_headway=parameters.time_headway * factors)
    simulated = simulate_open_loop(individual_idm(individual, weight, settings.limits), segments)
    shares = simulated.sample_counts / simulated.sample_counts.sum()
    gap_error, speed_error = (float(np.sqrt((mse * shares).sum())) for mse in (simulated.gap_mse, simulated.speed_mse))
    collisions, seconds = int(simulated.has_collided.sum()), sum(pair.seconds for pair in pairs)
    names = CALIBRATED_PARAMETERS
    at_bounds = [name for name in names if is_at_bound(getattr(parameters, name), getattr(settings, name))]
    return CalibratedIDM(parameters, weight, gap_error, speed_error, collisions, seconds, tuple(at_bounds))


def gap_objective(
    segments: Segments, limits: AccelerationBounds, weighting: str, headway_factors: Floats | float = 1.0
) -> Callable[[Floats], Floats]:
    """Return the error of the simulated gap [m] as a function of S candidates, shape (6, S) -> (S,)."""
    counts, (first, weights) = segments.sample_counts, _trajectory_weights(segments)

    def objective(candidates: Floats) -> Floats:
        v0, headway, acceleration, deceleration, minimum_gap, weight = candidates.reshape(6, -1, 1)
        parameters = IDMArrays(v0, headway * headway_factors, acceleration, deceleration, 4.0, minimum_gap)
        squares = gap_mean_squares(segments, individual_idm(parameters, weight, limits), len(v0))
        if weighting == "trajectory":
            return np.sqrt(np.add.reduceat(squares * weights, first, axis=1)).mean(1)
        return np.sqrt((squares * counts).sum(1) / counts.sum())

    return objective


def gap_mean_squares(segments: Segments, model: DriverModel, candidate_count: int = 1) -> Floats:
    """Return `gap_mse` of `simulate_open_loop` for many candidates at once [m2], shape (candidates, n)."""
    total = np.zeros((candidate_count, len(segments.sample_counts)))
    speed, gap = (np.broadcast_to(values, total.shape) for values in segments.start)
    states = follow_leader(model(speed, gap), (speed, gap), segments.leader, segments.step)
    for moment, (_, gap) in enumerate(states, 1):
        total += np.square(gap - segments.gap[moment]) * segments.is_present[moment]
    return total / segments.sample_counts


def _trajectory_weights(segments: Segments) -> tuple[NDArray[np.intp], Floats]:
    """Return the first segment of each trajectory, and the share of each segment in its trajectory."""
    pair_index, counts = segments.pair_index, segments.sample_counts
    return np.flatnonzero(np.diff(pair_index, prepend=-1)), counts / np.bincount(pair_index, counts)[pair_index]


def is_at_bound(value: float, bounds: ParameterRange) -> bool:
    """Return whether a value lies at a bound of the search, so that the data do not determine it."""
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

    Only the parameters `individual` are searched, the others are those of `typical`: a minute of driving reveals the
    distance that a driver keeps, but not the desired speed on an empty road. A single parameter is searched for all
    groups at once, several for one group after the other, a second each. `on_progress` receives the number of groups.
    """
    settings = settings or CalibrationSettings()
    calibrated: list[CalibratedIDM] = []
    if len(individual) == 1:
        calibrated = _calibrate_one_parameter(groups, typical, individual[0], settings)
        on_progress(len(calibrated))
        return calibrated
    fixed = {name: (getattr(typical, name),) * 2 for name in CALIBRATED_PARAMETERS if name not in individual}
    for pairs in groups:
        calibrated.append(calibrate_idm(pairs, replace(settings, **fixed)))
        on_progress(len(calibrated))
    return calibrated


def _calibrate_one_parameter(
    groups: Sequence[Sequence[Pair]], typical: IDMParameters, name: str, settings: CalibrationSettings
) -> list[CalibratedIDM]:
    segments = make_segments(list(chain.from_iterable(groups)), settings.segment_seconds)
    group = np.repeat(np.arange(len(groups)), [len(pairs) for pairs in groups])[segments.pair_index]

    def model(values: Floats) -> DriverModel:
        return individual_idm(replace_parameters(typical, **{name: values[group]}), 0.0, settings.limits)

    def errors(values: Floats) -> Floats:
        (squares,) = gap_mean_squares(segments, model(values))
        return _group_errors(squares, segments, group, settings.weighting)

    bounds = getattr(settings, name)
    values = _minimize_on_grid(errors, np.linspace(bounds[0], bounds[1], CALIBRATION_GRID_SIZE), len(groups))
    simulated = simulate_open_loop(model(values), segments)
    gap_errors = _group_errors(simulated.gap_mse, segments, group, "sample").tolist()
    speed_errors = _group_errors(simulated.speed_mse, segments, group, "sample").tolist()
    collisions = np.bincount(group, simulated.has_collided, len(groups)).astype(int).tolist()
    calibrated = []
    for value, pairs, gap_error, speed_error, crashes in zip(
        values.tolist(), groups, gap_errors, speed_errors, collisions, strict=True
    ):
        parameters, at_bounds = replace(typical, **{name: value}), (name,) if is_at_bound(value, bounds) else ()
        seconds = sum(pair.seconds for pair in pairs)
        calibrated.append(CalibratedIDM(parameters, 0.0, gap_error, speed_error, crashes, seconds, at_bounds))
    return calibrated


def _minimize_on_grid(errors: Callable[[Floats], Floats], grid: Floats, group_count: int) -> Floats:
    """Return the value with the least error of each group: the best of a grid, refined between its neighbors."""
    from scipy.optimize import elementwise  # slow to import, see above

    grid_errors = np.stack([errors(np.full(group_count, value)) for value in grid])
    best = grid_errors.argmin(0)
    values = grid[best]
    inner = np.flatnonzero((best > 0) & (best < CALIBRATION_GRID_SIZE - 1))

    def refined_errors(candidates: Floats, indices: NDArray[np.int64]) -> Floats:
        every = values.copy()
        every[indices.astype(int)] = candidates
        return errors(every)[indices.astype(int)]

    if len(inner):
        bracket = tuple(grid[best[inner] + shift] for shift in (-1, 0, 1))
        tolerances = {"xatol": CALIBRATION_TOLERANCE}
        found = elementwise.find_minimum(refined_errors, bracket, args=(inner,), tolerances=tolerances)
        is_better = found.f_x <= grid_errors.min(0)[inner]
        values[inner[is_better]] = found.x[is_better]
    return values


def _group_errors(mean_squares: Floats, segments: Segments, group: NDArray[np.int64], weighting: str) -> Floats:
    """Return the error of each group from the mean squared errors of its segments, with a weighting of the settings."""
    if weighting == "trajectory":
        first, weights = _trajectory_weights(segments)
        errors, group = np.sqrt(np.add.reduceat(mean_squares * weights, first)), group[first]
        return np.bincount(group, errors) / np.bincount(group)
    counts = segments.sample_counts
    return np.sqrt(np.bincount(group, mean_squares * counts) / np.bincount(group, counts))


def calibrate_human_drivers(recordings: Iterable[LocalState], scenario: Scenario) -> IDMParameters:
    """Return the IDM parameters of human drivers, see `pairs_behind_cavs`; those of the scenario without data.

    Desired speed and minimum gap always stay those of the scenario, because slow traffic does not reveal them.
    """
    pairs = pairs_behind_cavs(recordings, scenario.control_step, scenario.steps_per_control_step)
    known = scenario.humans
    if not pairs:
        return known
    fixed = {name: (getattr(known, name),) * 2 for name in ("desired_speed", "minimum_gap")}
    return replace(calibrate_idm(pairs, replace(CAV_FOLLOWER_SETTINGS, **fixed)).parameters, exponent=known.exponent)
