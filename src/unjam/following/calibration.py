"""Calibrating the IDM on people: the parameters with which the simulated gap is nearest to the real one.

Least squares on single accelerations would degenerate: the model then hardly reacts. On the simulated gap it
has to drive. Source of the method: Treiber and Kesting, Traffic Flow Dynamics (2013), chapter 16.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic.dataclasses import dataclass as checked_dataclass

from unjam.following.open_loop import Limits, Model, drive_behind, open_loop, personal_idm
from unjam.following.pairs import Floats, Pair, Stretches, stretches_of
from unjam.parameters import STRICT, Count, CountOrNone, NotNegative, Positive
from unjam.physics.idm import IDMParameters, IDMRows

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
    """what counts alike: `trajectory`: the mean of their root mean squared errors; `moment`: one root mean
    square over all of them, in which the few who leave very large gaps decide"""
    limits: Limits = (-4.0, 2.0)
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
KEPT = "kept_headway"


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
    bounds: tuple[str, ...] = field(default=())
    """parameters that lie at the end of what was searched: the data do not tell them"""

    def model(self, limits: Limits) -> Model:
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
        bounds=[getattr(settings, name) for name in (*SEARCHED, KEPT)],
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
    driven = IDMRows(**{**vars(parameters), "time_headway": parameters.time_headway * factors})
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
    stretches: Stretches, limits: Limits, every: str, headways: Floats | float = 1.0
) -> Callable[[Floats], Floats]:
    """Return the error of the simulated gap [m] as a function of candidates, shape (6, S) -> (S,).

    `headways` are factors on the time headway, of each stretch.
    """
    moments = stretches.present[1:].sum(0)

    def objective(candidates: Floats) -> Floats:
        v0, headway, acceleration, deceleration, minimum_gap, kept = candidates.reshape(6, -1, 1)
        rows = IDMRows(v0, headway * headways, acceleration, deceleration, 4.0, minimum_gap)
        squares = gap_squares(stretches, personal_idm(rows, kept, limits), len(v0))
        if every == "trajectory":
            return np.sqrt(squares).mean(1)
        return np.sqrt((squares * moments).sum(1) / moments.sum())

    return objective


def gap_squares(stretches: Stretches, model: Model, candidates: int = 1) -> Floats:
    """Return the mean squared error of the gap of each stretch [m2], shape (candidates, n).

    As `open_loop`, but for many drivers at once, and without keeping where they were.
    """
    moments = stretches.present[1:].sum(0)
    shape = (candidates, len(moments))
    start = (np.broadcast_to(stretches.speed[0], shape), np.broadcast_to(stretches.gap[0], shape))
    leader = (stretches.leader_speed, stretches.leader_path)
    total = np.zeros(shape)
    for moment, (_, gap) in enumerate(drive_behind(model(*start), start, leader, stretches.step), 1):
        total += np.square(gap - stretches.gap[moment]) * stretches.present[moment]
    return total / moments


def at_an_end(value: float, within: Range) -> bool:
    """Return whether a value lies at the end of what was searched: the data do not tell it."""
    low, high = within
    return low < high and min(value - low, high - value) < 0.01 * (high - low)
