"""From trajectories to a population: every driver's own IDM, and what all of them do beside it.

`unjam fit-drivers`.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, field, replace
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.network import Network
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.files import check_parent_folder
from unjam.following.calibration import (
    CALIBRATED_PARAMETERS,
    CalibratedIDM,
    CalibrationSettings,
    calibrate_groups,
    calibrate_idm,
)
from unjam.following.loaders import ReadOptions, read_pairs
from unjam.following.pairs import Pair, pairs_in_splits, split_by_driver
from unjam.following.settings import MultiStepSettings
from unjam.manifest import manifest
from unjam.parameters import STRICT, NonNegativeInt, PositiveInt, build_dataclass, nest_keys
from unjam.physics.idm import IDMParameters
from unjam.scenarios.population import Population

DriverProgress = Callable[[int, int], object]
RESIDUAL_VALIDATION_SHARE = 0.2
"""share of the drivers who decide whether a residual is better than none"""
MIN_RESIDUAL_DRIVERS = 5
"""drivers that a residual needs: one of them judges"""
UNIT_RATIO_LIMITS = (0.5, 2.0)
"""share of the difference of speeds by which gaps change, if both are in metres: one, but for noise"""
MIN_SUSPICIOUS_PARAMETERS = 3
"""parameters at the end of what was searched from which the units, or the data, are doubted"""
PAIR_FILTERS = ("kind", "split", "driver")
"""what trajectories can be chosen by"""


@dataclass(frozen=True, config=STRICT)
class FitDriversSettings:
    """How a population is calibrated."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    individual: Annotated[tuple[str, ...], Field(min_length=1)] = ("time_headway",)
    """parameters of the IDM that each driver has for itself; the others are those that suit all. On NGSIM,
    with half a minute of each driver, own headways predict the next half better than one IDM for all, and
    all parameters own far worse"""
    rounds: PositiveInt = 3
    """how often what is common and what is own are calibrated"""
    residual: bool = False
    """whether a network learns what all drivers do beside their own IDM, from simulated driving"""
    multi_step: MultiStepSettings = field(default_factory=MultiStepSettings)
    seed: NonNegativeInt = 0


@plain_dataclass(frozen=True)
class FittedDrivers:
    """A population, and what it was made from."""

    population: Population
    notes: list[str]
    """what was read and what was not"""

    def facts(self) -> dict[str, Any]:
        """Return what matters about it, as JSON."""
        population = self.population
        fit = {key: value for key, value in population.metadata["fit"].items() if key != "settings"}
        return {"drivers": len(population.drivers), "parameter_statistics": population.parameter_statistics(), **fit}

    def report_lines(self) -> list[str]:
        """Return in words how near the drivers come to the recorded gaps."""
        fit, details = self.population.metadata["fit"], self.population.details
        errors, seconds = np.array([[one["gap_error"], one["seconds"]] for one in details]).T
        own = np.sqrt(np.average(np.square(errors), weights=seconds))
        lines = [
            "error of the simulated gap, root mean square: "
            f"one IDM for all {fit['common']['gap_error']:.2f} m, each driver's own {own:.2f} m"
        ]
        unknown = fit["common"]["parameters_at_bounds"]
        if len(unknown) >= MIN_SUSPICIOUS_PARAMETERS:
            lines.append(
                f"warning: {len(unknown)} of {len(CALIBRATED_PARAMETERS)} parameters lie at the end of what was searched "
                f"({', '.join(unknown)}): these are no people; are speeds in m/s and gaps in m?"
            )
        collided = sum(one["collisions"] > 0 for one in details)
        if collided:
            lines.append(f"{collided} drivers use up their gap in the simulation")
        if "residual_gap_errors" in fit:
            before, best = fit["residual_gap_errors"][0], min(fit["residual_gap_errors"])
            made = "kept" if fit["residual_is_better"] else "of no use, left out"
            lines.append(f"residual: {made}: {before:.2f} m without, {best:.2f} m with, on other drivers")
        return lines


def fit_drivers_from_files(
    files: Sequence[Path],
    overrides: dict[str, Any],
    format: str = "",
    drop_bad_rows: bool = False,
    driver_columns: tuple[str, ...] = (),
    filters: dict[str, str] | None = None,
    out: Path | None = None,
    on_progress: DriverProgress = lambda done, drivers: None,
) -> FittedDrivers:
    """Return the population of the drivers in files.

    Args:
        files: of one format and one time step.
        changes: to `FitDriversSettings`; keys may have dots.
        format: of `unjam.following.loaders.FORMATS`; empty: told from the columns.
        cut_bad: whether bad rows are cut out instead of refused.
        driver: columns of a plain table that together name the driver.
        filters: values of `kind`, `split` or `driver` that select trajectories.
        out: where the population will be written; checked before anything is calibrated.
        on_progress: told how many drivers are done, and of how many.

    Raises:
        InputError: a file, a row or a setting is wrong, or no trajectory is chosen.
        DiskError: the folder of `out` is not there.
    """
    if out is not None:
        if out.suffix != ".json":
            raise invalid_value("out", str(out), "a .json file")
        check_parent_folder(out)
    settings = build_dataclass(FitDriversSettings, nest_keys(overrides), "")
    pairs: list[Pair] = []
    words = []
    prefixes = _name_prefixes(files)
    for file, prefix in zip(files, prefixes, strict=True):
        found = read_pairs(file, format, ReadOptions(drop_bad_rows=drop_bad_rows, driver_columns=driver_columns))
        words += [f"{file.name}: {line}" for line in found.summary_lines()]
        pairs += [replace(pair, name=prefix + pair.name, driver=prefix + pair.driver) for pair in found.pairs]
    for name, value in (filters or {}).items():
        if name not in PAIR_FILTERS:
            raise unknown_name("select", name, PAIR_FILTERS)
        there = sorted({str(getattr(pair, name)) for pair in pairs} - {""})
        pairs = [pair for pair in pairs if getattr(pair, name) == value]
        if not pairs:
            raise InputError(f"select: no trajectory has {name} {value!r}; there are: {', '.join(there) or 'none'}")
    words += unit_warnings(pairs)
    population = fit_drivers(pairs, settings, on_progress)
    made = manifest()
    # It is given away: no folder of this machine is named.
    made["command"] = [Path(word).name if "/" in word else word for word in made["command"]]
    about = {"data": [file.name for file in files], "filters": filters or {}, "manifest": made}
    return FittedDrivers(replace(population, metadata={**population.metadata, **about}), words)


def _name_prefixes(files: Sequence[Path]) -> list[str]:
    """Return what names of drivers begin with in each file: those of two files are different people."""
    for number, file in enumerate(files):
        if file.resolve() in [other.resolve() for other in files[:number]]:
            raise invalid_value("data", str(file), "each file once")
    stems = [file.stem for file in files]
    if len(set(stems)) < len(stems):
        stems = [f"{number}-{stem}" for number, stem in enumerate(stems, 1)]
    return [f"{stem}-" for stem in stems] if len(files) > 1 else [""]


def unit_warnings(pairs: Sequence[Pair]) -> list[str]:
    """Return a line where gaps change otherwise than the speeds say: the two have not the same unit."""
    differences = [pair.leader_speed - pair.speed for pair in pairs]
    closing = np.concatenate([(each[1:] + each[:-1]) / 2.0 for each in differences])
    change = np.concatenate([np.diff(pair.gap) / pair.step for pair in pairs])
    share = float(closing @ change / max(closing @ closing, 1e-9))
    low, high = UNIT_RATIO_LIMITS
    if low <= share <= high or not closing.any():
        return []
    return [
        f"warning: gaps change {share:.2f} times as fast as the speeds say (0.28 where speeds are in km/h); "
        "allowed: speeds in m/s and gaps in m"
    ]


def fit_drivers(
    pairs: Sequence[Pair],
    settings: FitDriversSettings | None = None,
    on_progress: DriverProgress = lambda done, drivers: None,
) -> Population:
    """Return the population of all drivers in `pairs`.

    The parameters are those with which the gap, simulated behind the recorded leader, is nearest to the
    recorded one. With a residual, a network learns from simulated driving on these; where it makes the
    gaps of drivers that it has not learned from no better, there is none.

    Args:
        pairs: with one and the same time step.
        settings: how.
        on_progress: told how many drivers are done, and of how many.

    Raises:
        InputError: too few drivers for a residual, or different time steps.
    """
    settings = settings or FitDriversSettings()
    for name in settings.individual:
        if name not in CALIBRATED_PARAMETERS:
            raise unknown_name("individual", name, CALIBRATED_PARAMETERS)
    names = list(dict.fromkeys(pair.driver for pair in pairs))
    if settings.residual and len(names) < MIN_RESIDUAL_DRIVERS:
        raise invalid_value("drivers", len(names), f">= {MIN_RESIDUAL_DRIVERS} for a residual")
    calibration = replace(settings.calibration, initial_headway_weight=(0.0, 0.0))  # each has its own
    together = calibrate_idm(pairs, calibration)
    typical, found = _calibrate_in_rounds(pairs, names, replace(settings, calibration=calibration), on_progress)
    residual, learned = _fit_residual(pairs, found, settings) if settings.residual else (None, {})
    return Population(
        typical=typical,
        drivers=tuple(one.parameters for one in found.values()),
        limits=calibration.limits,
        residual=residual,
        details=tuple({"name": name, **_calibration_details(one)} for name, one in found.items()),
        metadata={"fit": {"settings": asdict(settings), "common": _calibration_details(together), **learned}},
    )


def _calibrate_in_rounds(
    pairs: Sequence[Pair], names: Sequence[str], settings: FitDriversSettings, on_progress: DriverProgress
) -> tuple[IDMParameters, dict[str, CalibratedIDM]]:
    """Return what drivers have in common, and each driver's own, each calibrated given the other in turn.

    One IDM for people who keep different distances is too soft: it must not react to gaps that are just the
    driver's own. So what is common is calibrated with everybody's own headway, and only then the headway with
    which one IDM suits all of them.
    """
    groups = [[pair for pair in pairs if pair.driver == name] for name in names]
    each_its_own = "time_headway" in settings.individual
    shared = replace(settings.calibration, initial_headway_weight=(0.0, 1.0)) if each_its_own else settings.calibration
    typical, found = calibrate_idm(pairs, shared).parameters, {}
    for turn in range(settings.rounds):
        if turn:
            own = [found[pair.driver].parameters.time_headway / typical.time_headway for pair in pairs]
            typical = calibrate_idm(pairs, settings.calibration, own).parameters
        each = calibrate_groups(
            groups, typical, settings.individual, settings.calibration, lambda done: on_progress(done, len(names))
        )
        found = dict(zip(names, each, strict=True))
    if each_its_own:  # so far it is a unit for the others': any would do
        (one,) = calibrate_groups([pairs], typical, ["time_headway"], settings.calibration)
        typical = one.parameters
    return typical, found


def _fit_residual(
    pairs: Sequence[Pair], calibrated: dict[str, CalibratedIDM], settings: FitDriversSettings
) -> tuple[Network | None, dict[str, Any]]:
    """Return the residual, None where it is of no use, and how it did."""
    from unjam.following.networks import CalibratedPairs, fit_multi_step  # and torch, which IDMs do without

    chosen = split_by_driver(pairs, (1.0 - RESIDUAL_VALIDATION_SHARE, RESIDUAL_VALIDATION_SHARE, 0.0), settings.seed)
    known, validation = (
        CalibratedPairs(part, [calibrated[pair.driver].parameters for pair in part])
        for part in (pairs_in_splits(chosen, "train"), pairs_in_splits(chosen, "validation"))
    )
    fitted = fit_multi_step(known, validation, settings.calibration.limits, settings.multi_step, settings.seed)
    better = min(fitted.validation_errors) < fitted.validation_errors[0]
    facts = {"residual_gap_errors": fitted.validation_errors, "residual_is_better": better}
    return fitted.network.to_numpy_network() if better else None, facts


def _calibration_details(calibrated: CalibratedIDM) -> dict[str, Any]:
    """Return what is known of a driver beside the parameters."""
    return {
        key: value for key, value in asdict(calibrated).items() if key not in ("parameters", "initial_headway_weight")
    }
