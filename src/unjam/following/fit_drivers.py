"""From trajectories to a population: every driver's own IDM, and what all of them do beside it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, field, replace
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.network import Network
from unjam.errors import wrong, wrong_name
from unjam.following.calibration import SEARCHED, Calibrated, CalibrationSettings, calibrate
from unjam.following.each_driver import calibrate_each
from unjam.following.multi_step import Known, MultiStepSettings, fit_multi_step
from unjam.following.pairs import Pair, of_split, split_by_trajectory
from unjam.parameters import STRICT, Count, CountOrNone
from unjam.physics.idm import IDMParameters
from unjam.scenarios.population import Population

VALIDATION_SHARE = 0.2
"""share of the drivers who decide whether a residual is better than none"""
FEWEST = 5
"""drivers that a residual needs: one of them judges"""


@dataclass(frozen=True, config=STRICT)
class FitDriversSettings:
    """How a population is calibrated."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    own: Annotated[tuple[str, ...], Field(min_length=1)] = ("time_headway",)
    """parameters of the IDM that each driver has for itself; the others are those that suit all. On NGSIM,
    with half a minute of each driver, own headways predict the next half better than one IDM for all, and
    all parameters own far worse"""
    turns: Count = 3
    """how often what is common and what is own are calibrated"""
    residual: bool = False
    """whether a network learns what all drivers do beside their own IDM, from simulated driving"""
    multi_step: MultiStepSettings = field(default_factory=MultiStepSettings)
    seed: CountOrNone = 0


def fit_drivers(
    pairs: Sequence[Pair],
    settings: FitDriversSettings | None = None,
    told: Callable[[int, int], None] | None = None,
) -> Population:
    """Return the population of all drivers in `pairs`.

    The parameters are those with which the gap, simulated behind the recorded leader, is nearest to the
    recorded one. With a residual, a network learns from simulated driving on these; where it makes the
    gaps of drivers that it has not learned from no better, there is none.

    Args:
        pairs: with one and the same time step.
        settings: how.
        told: told how many drivers are done, and of how many.

    Raises:
        InputError: too few drivers for a residual, or different time steps.
    """
    settings = settings or FitDriversSettings()
    for name in settings.own:
        if name not in SEARCHED:
            raise wrong_name("own", name, SEARCHED)
    names = list(dict.fromkeys(pair.driver for pair in pairs))
    if settings.residual and len(names) < FEWEST:
        raise wrong("drivers", len(names), f">= {FEWEST} for a residual")
    calibration = replace(settings.calibration, kept_headway=(0.0, 0.0))  # each has its own
    together = calibrate(pairs, calibration)
    typical, found = _levels(pairs, names, settings, calibration, told)
    residual, learned = None, {}
    if settings.residual:
        residual, learned = _residual(pairs, found, settings)
    return Population(
        typical=typical,
        drivers=tuple(one.parameters for one in found.values()),
        limits=calibration.limits,
        residual=residual,
        details=tuple({"name": name, **_detail(one)} for name, one in found.items()),
        about={"fit": {"settings": asdict(settings), "together": _detail(together), **learned}},
    )


def _levels(
    pairs: Sequence[Pair],
    names: Sequence[str],
    settings: FitDriversSettings,
    calibration: CalibrationSettings,
    told: Callable[[int, int], None] | None,
) -> tuple[IDMParameters, dict[str, Calibrated]]:
    """Return what drivers have in common, and each driver's own, each calibrated given the other in turn.

    One IDM for people who keep different distances is too soft: it must not react to gaps that are just the
    driver's own. So what is common is calibrated with everybody's own headway.
    """
    groups = [[pair for pair in pairs if pair.driver == name] for name in names]
    typical = calibrate(pairs, replace(calibration, kept_headway=(0.0, 1.0))).parameters
    each: list[Calibrated] = []
    for turn in range(settings.turns):
        if turn:
            own = {name: one.parameters.time_headway for name, one in zip(names, each, strict=True)}
            factors = [own[pair.driver] / typical.time_headway for pair in pairs]
            typical = calibrate(pairs, calibration, factors).parameters
        each = calibrate_each(
            groups, typical, settings.own, calibration, lambda done: told and told(done, len(names))
        )
    return typical, dict(zip(names, each, strict=True))


def _residual(
    pairs: Sequence[Pair], found: dict[str, Calibrated], settings: FitDriversSettings
) -> tuple[Network | None, dict[str, Any]]:
    """Return the residual, None where it is of no use, and how it did."""
    shares = (1.0 - VALIDATION_SHARE, VALIDATION_SHARE, 0.0)
    chosen = split_by_trajectory(pairs, shares, settings.seed)
    known, validation = (
        Known(part, [found[pair.driver].parameters for pair in part])
        for part in (of_split(chosen, "train"), of_split(chosen, "validation"))
    )
    fitted = fit_multi_step(
        known, validation, settings.calibration.limits, settings.multi_step, settings.seed
    )
    better = min(fitted.validation) < fitted.validation[0]
    facts = {"residual_gap_errors": fitted.validation, "residual_is_better": better}
    return fitted.network.as_driver() if better else None, facts


def _detail(found: Calibrated) -> dict[str, Any]:
    """Return what is known of a driver beside the parameters."""
    return {key: value for key, value in asdict(found).items() if key not in ("parameters", "kept_headway")}
