"""Calibration of the IDM to recorded drivers: the search for parameters with small errors of simulated gaps.

A least-squares fit of single accelerations would give a model that hardly reacts to its leader. Source of the method:
Treiber and Kesting, Traffic Flow Dynamics (2013), chapter 16.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from unjam.drivers.local_state import LocalState
from unjam.following.leader_replay import (
    AccelerationBounds,
    DriverModel,
    follow_leader,
    individual_idm,
    replace_parameters,
    simulate_followers,
)
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt, parameter_dataclass
from unjam.physics.idm import IDMArrays, IDMParameters
from unjam.recordings.trajectories import Floats, FollowingTrajectory, Segments, make_segments, trajectories_behind_cavs
from unjam.scenarios.scenario import Scenario

ParameterRange = tuple[Positive, Positive]
"""smallest and largest value in the search"""
HiddenSizes = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
"""sizes of the hidden layers of a network"""


@parameter_dataclass(frozen=True, config=STRICT)
class CalibrationSettings:
    """Ranges and budget of the search; the exponent of the IDM is always 4."""

    desired_speed: ParameterRange = (5.0, 40.0)
    """range of the desired speed v0 [m/s]"""
    time_headway: ParameterRange = (0.1, 4.0)
    """range of the time headway T [s]"""
    max_acceleration: ParameterRange = (0.1, 4.0)
    """range of the maximum acceleration a [m/s2]"""
    comfortable_deceleration: ParameterRange = (0.1, 6.0)
    """range of the comfortable deceleration b [m/s2]"""
    minimum_gap: ParameterRange = (0.5, 6.0)
    """range of the minimum gap s0 [m]"""
    initial_headway_weight: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """range of the weight of the initial time headway, see `individual_idm`"""
    weighting: Literal["trajectory", "sample"] = "trajectory"
    """objective: `trajectory` mean of the RMS gap errors of the trajectories; `sample` RMS gap error over all samples,
    which a few drivers with very large gaps dominate"""
    limits: AccelerationBounds = (-4.0, 2.0)
    """limits of the acceleration [m/s2]; without limits the IDM brakes arbitrarily hard at very small gaps"""
    segment_seconds: Positive = 120.0
    """duration of the segments into which trajectories are cut [s]; each starts with its recorded speed and gap"""
    candidates: PositiveInt = 8
    """population size of the differential evolution, as a multiple of the number of parameters"""
    generations: PositiveInt = 100
    """maximum number of generations of the differential evolution"""
    tolerance: Positive = 1e-3
    """standard deviation of the candidates' errors, relative to their mean, at which the search ends"""
    seed: NonNegativeInt = 0
    """seed of the differential evolution"""


@parameter_dataclass(frozen=True, config=STRICT)
class MultiStepSettings:
    """Settings of a network that learns a residual from simulation behind recorded leaders, see `fit_multi_step`."""

    hidden: HiddenSizes = (32, 32)
    """sizes of the hidden layers"""
    authority: Positive = 2.0
    """largest magnitude of the residual [m/s2]"""
    segment_seconds: Positive = 30.0
    """duration of the simulated segments [s]"""
    batch_size: PositiveInt = 64
    """number of segments in a gradient step"""
    gradient_steps: PositiveInt = 120
    """number of gradient steps"""
    learning_rate: Positive = 1e-3
    """initial learning rate of Adam, which decreases to zero on a cosine schedule"""
    speed_weight: NonNegative = 2.0
    """weight of a speed error of 1 m/s, relative to a gap error of 1 m"""
    residual_weight: NonNegative = 0.1
    """weight of the squared residual in the loss; it keeps the residual small where there are no data"""
    validation_interval: PositiveInt = 20
    """gradient steps between two validations; the result has the weights with the smallest validation error"""


CALIBRATED_PARAMETERS = ("desired_speed", "time_headway", "max_acceleration", "comfortable_deceleration", "minimum_gap")
"""IDM parameters that a calibration can search, in the order of its candidates"""
CALIBRATION_GRID_SIZE = 32
"""number of grid values with which the search for a single parameter starts"""
CALIBRATION_TOLERANCE = 1e-3
"""absolute tolerance of the search for a single parameter, in the unit of the parameter"""
CAV_FOLLOWER_SETTINGS = CalibrationSettings(candidates=4, generations=40)
"""settings of `calibrate_human_drivers`"""


@dataclass(frozen=True)
class CalibratedIDM:
    """The result of a calibration."""

    parameters: IDMParameters
    gap_error: float
    """root mean squared error of the simulated gap [m]"""
    speed_error: float
    """root mean squared error of the simulated speed [m/s]"""
    collisions: int
    """number of segments in which the simulated gap became zero"""
    seconds: float
    """duration of the data [s]"""
    parameters_at_bounds: tuple[str, ...]
    """parameters at a bound of their range, which the data do not determine"""


def calibrate_idm(
    trajectories: Sequence[FollowingTrajectory],
    settings: CalibrationSettings | None = None,
    headway_factors: Sequence[float] | None = None,
) -> CalibratedIDM:
    """Return the IDM parameters with the smallest error of the simulated gaps of all `trajectories`.

    The search is differential evolution. `headway_factors` are known factors of the time headway, one for each
    trajectory. Raise `InputError` if the trajectories have different time steps.
    """
    from scipy.optimize import differential_evolution  # slow to import, and not needed for --help

    settings = settings or CalibrationSettings()
    segments = make_segments(trajectories, settings.segment_seconds)
    factors = 1.0 if headway_factors is None else np.array(headway_factors)[segments.trajectory_index]
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
    segment_parameters = replace_parameters(parameters, time_headway=parameters.time_headway * factors)
    errors = simulate_followers(individual_idm(segment_parameters, weight, settings.limits), segments)
    weights = segments.sample_counts / segments.sample_counts.sum()
    gap_error, speed_error = (float(np.sqrt((mse * weights).sum())) for mse in (errors.gap_mse, errors.speed_mse))
    collisions, seconds = int(errors.has_collided.sum()), sum(trajectory.seconds for trajectory in trajectories)
    names = CALIBRATED_PARAMETERS
    at_bounds = [name for name in names if is_at_bound(getattr(parameters, name), getattr(settings, name))]
    return CalibratedIDM(parameters, gap_error, speed_error, collisions, seconds, tuple(at_bounds))


def gap_objective(
    segments: Segments, limits: AccelerationBounds, weighting: str, headway_factors: Floats | float = 1.0
) -> Callable[[Floats], Floats]:
    """Return the objective of the search: it maps S candidates, shape (6, S), to their gap errors [m], shape (S,)."""
    counts, (first_segments, weights) = segments.sample_counts, _trajectory_weights(segments)

    def compute_gap_errors(candidates: Floats) -> Floats:
        v0, headway, acceleration, deceleration, minimum_gap, headway_weight = candidates.reshape(6, -1, 1)
        parameters = IDMArrays(v0, headway * headway_factors, acceleration, deceleration, 4.0, minimum_gap)
        mean_squares = gap_mean_squares(segments, individual_idm(parameters, headway_weight, limits), len(v0))
        if weighting == "trajectory":
            return np.sqrt(np.add.reduceat(mean_squares * weights, first_segments, axis=1)).mean(1)
        return np.sqrt((mean_squares * counts).sum(1) / counts.sum())

    return compute_gap_errors


def gap_mean_squares(segments: Segments, model: DriverModel, candidate_count: int = 1) -> Floats:
    """Return `SimulationErrors.gap_mse` for several candidates at once [m2], shape (candidates, n)."""
    squares = np.zeros((candidate_count, len(segments.sample_counts)))
    speed, gap = (np.broadcast_to(values, squares.shape) for values in segments.initial_state)
    states = follow_leader(model(speed, gap), (speed, gap), segments.leader, segments.time_step)
    for step, (_, gap) in enumerate(states, 1):
        squares += np.square(gap - segments.gap[step]) * segments.is_present[step]
    return squares / segments.sample_counts


def _trajectory_weights(segments: Segments) -> tuple[NDArray[np.intp], Floats]:
    """Return the index of each trajectory's first segment, and each segment's share of its trajectory's samples."""
    index, counts = segments.trajectory_index, segments.sample_counts
    return np.flatnonzero(np.diff(index, prepend=-1)), counts / np.bincount(index, counts)[index]


def is_at_bound(value: float, bounds: ParameterRange) -> bool:
    """Return whether a value is at a bound of its range: within 1 % of the width of the range."""
    low, high = bounds
    return low < high and min(value - low, high - value) < 0.01 * (high - low)


def calibrate_groups(
    groups: Sequence[Sequence[FollowingTrajectory]],
    typical: IDMParameters,
    individual: Sequence[str],
    settings: CalibrationSettings | None = None,
    on_progress: Callable[[int], object] = lambda done: None,
) -> list[CalibratedIDM]:
    """Calibrate parameters for each group of trajectories, for instance for each driver.

    Search only the parameters in `individual`, and take other parameters from `typical`: a minute of driving determines
    the time headway of a driver, but not the desired speed. A single parameter is searched for all groups at once.
    `on_progress` is called with the number of finished groups.
    """
    settings = settings or CalibrationSettings()
    if len(individual) == 1:
        results = _calibrate_one_parameter(groups, typical, individual[0], settings)
        on_progress(len(results))
        return results
    results = list[CalibratedIDM]()
    fixed_ranges = {name: (getattr(typical, name),) * 2 for name in CALIBRATED_PARAMETERS if name not in individual}
    for trajectories in groups:
        results.append(calibrate_idm(trajectories, replace(settings, **fixed_ranges)))
        on_progress(len(results))
    return results


def _calibrate_one_parameter(
    groups: Sequence[Sequence[FollowingTrajectory]], typical: IDMParameters, name: str, settings: CalibrationSettings
) -> list[CalibratedIDM]:
    segments = make_segments(list(chain.from_iterable(groups)), settings.segment_seconds)
    trajectory_groups = np.repeat(np.arange(len(groups)), [len(trajectories) for trajectories in groups])
    segment_groups = trajectory_groups[segments.trajectory_index]

    def make_model(group_values: Floats) -> DriverModel:
        parameters = replace_parameters(typical, **{name: group_values[segment_groups]})
        return individual_idm(parameters, 0.0, settings.limits)

    def compute_errors(group_values: Floats) -> Floats:
        (mean_squares,) = gap_mean_squares(segments, make_model(group_values))
        return _group_errors(mean_squares, segments, segment_groups, settings.weighting)

    bounds = getattr(settings, name)
    grid = np.linspace(bounds[0], bounds[1], CALIBRATION_GRID_SIZE)
    values = _minimize_on_grid(compute_errors, grid, len(groups))
    errors = simulate_followers(make_model(values), segments)
    collisions = np.bincount(segment_groups, errors.has_collided, len(groups)).astype(int).tolist()
    group_errors = (
        _group_errors(mean_squares, segments, segment_groups, "sample").tolist()
        for mean_squares in (errors.gap_mse, errors.speed_mse)
    )
    results = list[CalibratedIDM]()
    rows = zip(values.tolist(), groups, *group_errors, collisions, strict=True)
    for value, trajectories, gap_error, speed_error, group_collisions in rows:
        parameters, at_bounds = replace(typical, **{name: value}), (name,) if is_at_bound(value, bounds) else ()
        seconds = sum(trajectory.seconds for trajectory in trajectories)
        results.append(CalibratedIDM(parameters, gap_error, speed_error, group_collisions, seconds, at_bounds))
    return results


def _minimize_on_grid(compute_errors: Callable[[Floats], Floats], grid: Floats, group_count: int) -> Floats:
    """Return the value with the smallest error for each group: the best grid value, refined between its neighbors."""
    from scipy.optimize import elementwise  # slow to import

    grid_errors = np.stack([compute_errors(np.full(group_count, value)) for value in grid])
    best_indices = grid_errors.argmin(0)
    values = grid[best_indices]
    inner_groups = np.flatnonzero((best_indices > 0) & (best_indices < CALIBRATION_GRID_SIZE - 1))

    def compute_some_errors(candidates: Floats, groups: NDArray[np.int64]) -> Floats:
        candidate_values = values.copy()
        candidate_values[groups.astype(int)] = candidates
        return compute_errors(candidate_values)[groups.astype(int)]

    if len(inner_groups):
        bracket = tuple(grid[best_indices[inner_groups] + shift] for shift in (-1, 0, 1))
        tolerances = {"xatol": CALIBRATION_TOLERANCE}
        minimum = elementwise.find_minimum(compute_some_errors, bracket, args=(inner_groups,), tolerances=tolerances)
        is_better = minimum.f_x <= grid_errors.min(0)[inner_groups]
        values[inner_groups[is_better]] = minimum.x[is_better]
    return values


def _group_errors(mean_squares: Floats, segments: Segments, groups: NDArray[np.int64], weighting: str) -> Floats:
    """Return the RMS error of each group for mean squares of segments; `groups` are the groups of the segments."""
    if weighting == "trajectory":
        first_segments, weights = _trajectory_weights(segments)
        errors, groups = np.sqrt(np.add.reduceat(mean_squares * weights, first_segments)), groups[first_segments]
        return np.bincount(groups, errors) / np.bincount(groups)
    counts = segments.sample_counts
    return np.sqrt(np.bincount(groups, mean_squares * counts) / np.bincount(groups, counts))


def calibrate_human_drivers(recordings: Iterable[LocalState], scenario: Scenario) -> IDMParameters:
    """Calibrate the IDM to followers of CAVs, if any; slow traffic does not determine desired speed and minimum gap."""
    trajectories = trajectories_behind_cavs(recordings, scenario.control_step, scenario.steps_per_control_step)
    humans = scenario.humans
    if not trajectories:
        return humans
    fixed_ranges = {name: (getattr(humans, name),) * 2 for name in ("desired_speed", "minimum_gap")}
    calibrated = calibrate_idm(trajectories, replace(CAV_FOLLOWER_SETTINGS, **fixed_ranges))
    return replace(calibrated.parameters, exponent=humans.exponent)
