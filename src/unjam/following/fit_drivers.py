"""Calibration of a population of human drivers to recorded trajectories (`unjam fit-drivers`)."""

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, field, replace
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from unjam.drivers.network import Network
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.following.calibration import (
    CALIBRATED_PARAMETERS,
    CalibratedIDM,
    CalibrationSettings,
    MultiStepSettings,
    calibrate_groups,
    calibrate_idm,
)
from unjam.manifest import manifest, strip_folders
from unjam.parameters import STRICT, NonNegativeInt, PositiveInt, build_dataclass, nest_keys, parameter_dataclass
from unjam.physics.idm import IDMParameters
from unjam.recordings.loaders import ReadOptions, read_trajectories
from unjam.recordings.trajectories import FollowingTrajectory, select_splits, split_by_driver
from unjam.scenarios.population import Population
from unjam.text import format_count, shorten_list

DriverProgress = Callable[[int, int], object]
"""function that receives the number of finished drivers and the number of all drivers"""
RESIDUAL_VALIDATION_SHARE = 0.2
"""share of the drivers whose trajectories validate a residual"""
MIN_RESIDUAL_DRIVERS = 5
"""minimum number of drivers for a residual, so that at least one of them validates it"""
MIN_SUSPICIOUS_PARAMETERS = 3
"""number of parameters at a bound from which on there is a warning of wrong units or data"""
FILTER_FIELDS = ("kind", "split", "driver")
"""fields of a trajectory by which trajectories can be selected"""


@parameter_dataclass(frozen=True, config=STRICT)
class FitDriversSettings:
    """Settings for the calibration of a population."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    individual: Annotated[tuple[str, ...], Field(min_length=1)] = ("time_headway",)
    """names of the IDM parameters that are individual; other parameters are the same for all drivers. On NGSIM, after
    a calibration to half a minute of each driver, individual time headways predict the other half better than one IDM
    for all drivers; five individual parameters predict it much worse"""
    rounds: PositiveInt = 3
    """number of rounds; each round calibrates the common parameters, then the individual parameters"""
    residual: bool = False
    """whether a network learns an acceleration that is added to the IDM of every driver"""
    multi_step: MultiStepSettings = field(default_factory=MultiStepSettings)
    seed: NonNegativeInt = 0
    """seed of the residual, and of its validation drivers"""


@plain_dataclass(frozen=True)
class FittedDrivers:
    """A calibrated population, and notes on its data."""

    population: Population
    notes: list[str]
    """summary of each file, and a note if trajectories are interpolated"""

    def facts(self) -> dict[str, Any]:
        """Return statistics of the population and results of the fit as JSON."""
        population = self.population
        statistics = {"drivers": len(population.drivers), "parameter_statistics": population.parameter_statistics()}
        return statistics | {key: value for key, value in population.metadata["fit"].items() if key != "settings"}

    def report_lines(self) -> list[str]:
        """Return the lines of a report: errors of the simulated gaps, warnings, and the use of the residual."""
        fit, details = self.population.metadata["fit"], self.population.details
        errors, seconds = np.array([[detail["gap_error"], detail["seconds"]] for detail in details]).T
        individual_error = np.sqrt(np.average(np.square(errors), weights=seconds))
        comparison = f"one IDM for all {fit['common']['gap_error']:.2f} m, individual IDMs {individual_error:.2f} m"
        lines = [f"root mean squared error of the simulated gap: {comparison}"]
        at_bounds = fit["common"]["parameters_at_bounds"]
        if len(at_bounds) >= MIN_SUSPICIOUS_PARAMETERS:
            problem = f"{len(at_bounds)} of {len(CALIBRATED_PARAMETERS)} parameters are at a bound of their range"
            reason = "this is not plausible for human drivers; are speeds in m/s and gaps in m?"
            lines.append(f"warning: {problem} ({', '.join(at_bounds)}): {reason}")
        collisions = sum(detail["collisions"] > 0 for detail in details)
        if collisions:
            lines.append(f"in the simulation, {format_count(collisions, 'driver')} had a collision with the leader")
        if "residual_gap_errors" in fit:
            base_error, best_error = fit["residual_gap_errors"][0], min(fit["residual_gap_errors"])
            use = "used" if fit["residual_is_better"] else "not used, because it is not better"
            comparison = f"{base_error:.2f} m without, {best_error:.2f} m with it, on validation drivers"
            lines.append(f"residual: {use}: {comparison}")
        return lines


def fit_drivers_from_files(
    files: Sequence[Path],
    overrides: dict[str, Any],
    format: str = "",
    drop_bad_rows: bool = False,
    driver_columns: tuple[str, ...] = (),
    filters: dict[str, str] | None = None,
    on_progress: DriverProgress = lambda *done: None,
) -> FittedDrivers:
    """Calibrate a population to the trajectories in files.

    `overrides` are values for `FitDriversSettings`; `format`, `drop_bad_rows` and `driver_columns` are arguments of
    `read_trajectories`; `filters` are required values of `FILTER_FIELDS`. Raise `InputError` if a file, a row or a
    setting is wrong, or if no trajectory is selected.

    """
    settings = build_dataclass(FitDriversSettings, nest_keys(overrides), "")
    options = ReadOptions(drop_bad_rows=drop_bad_rows, driver_columns=driver_columns)
    trajectories: list[FollowingTrajectory] = []
    notes = []
    for file, prefix in zip(files, _name_prefixes(files), strict=True):
        loaded = read_trajectories(file, format, options)
        notes += [f"{file.name}: {line}" for line in loaded.summary_lines()]
        trajectories += [
            replace(trajectory, name=prefix + trajectory.name, driver=prefix + trajectory.driver)
            for trajectory in loaded.trajectories
        ]
    for name, value in (filters or {}).items():
        if name not in FILTER_FIELDS:
            raise unknown_name("select", name, FILTER_FIELDS)
        values = {str(getattr(trajectory, name)) for trajectory in trajectories} - {""}
        trajectories = [trajectory for trajectory in trajectories if getattr(trajectory, name) == value]
        if not trajectories:
            available = shorten_list(sorted(values)) or "none"
            raise InputError(f"select: no trajectory has the {name} {value!r}; available: {available}")
    time_step = max(trajectory.time_step for trajectory in trajectories)
    if any(trajectory.time_step != time_step for trajectory in trajectories):
        notes.append(f"trajectories with a shorter time step are interpolated to {time_step:g} s")
        trajectories = [
            trajectory if trajectory.time_step == time_step else trajectory.resample(time_step)
            for trajectory in trajectories
        ]
    population = fit_drivers(trajectories, settings, on_progress)
    run_manifest = manifest()
    # Populations are published, and must not contain names of folders of this machine.
    run_manifest["command"] = strip_folders(run_manifest["command"])
    metadata = {"data": [file.name for file in files], "filters": filters or {}, "manifest": run_manifest}
    return FittedDrivers(replace(population, metadata={**population.metadata, **metadata}), notes)


def _name_prefixes(files: Sequence[Path]) -> list[str]:
    """Return a prefix for the names of drivers in each file, so that names from different files differ."""
    for index, file in enumerate(files):
        if os.path.realpath(file) in map(os.path.realpath, files[:index]):
            raise invalid_value("data", str(file), "each file once")
    stems = [file.stem for file in files]
    if len(set(stems)) < len(stems):
        stems = [f"{number}-{stem}" for number, stem in enumerate(stems, 1)]
    return [f"{stem}-" for stem in stems] if len(files) > 1 else [""]


def fit_drivers(
    trajectories: Sequence[FollowingTrajectory],
    settings: FitDriversSettings | None = None,
    on_progress: DriverProgress = lambda *done: None,
) -> Population:
    """Calibrate a population with one IDM for each driver of `trajectories`.

    The population has a residual only if this reduces the error of simulated gaps for validation drivers. Raise
    `InputError` if there are too few drivers for a residual, if time steps differ, or if a simulated gap is not finite.
    """
    settings = settings or FitDriversSettings()
    for name in settings.individual:
        if name not in CALIBRATED_PARAMETERS:
            raise unknown_name("individual", name, CALIBRATED_PARAMETERS)
    names = list(dict.fromkeys(trajectory.driver for trajectory in trajectories))
    if settings.residual and len(names) < MIN_RESIDUAL_DRIVERS:
        raise invalid_value("drivers", len(names), f">= {MIN_RESIDUAL_DRIVERS} for a residual")
    # The individual time headways replace the dependence on initial headways.
    calibration = replace(settings.calibration, initial_headway_weight=(0.0, 0.0))
    common_idm = calibrate_idm(trajectories, calibration)
    settings_in_rounds = replace(settings, calibration=calibration)
    typical, individual_idms = _calibrate_in_rounds(trajectories, names, settings_in_rounds, on_progress)
    for name, calibrated in {"one IDM for all": common_idm, **individual_idms}.items():
        if not np.isfinite(calibrated.gap_error):
            allowed = "a finite number; are the data in m, m/s and s?"
            raise invalid_value(f"gap error of {name}", calibrated.gap_error, allowed)
    residual, results = _fit_residual(trajectories, individual_idms, settings) if settings.residual else (None, {})
    return Population(
        typical=typical,
        drivers=tuple(calibrated.parameters for calibrated in individual_idms.values()),
        limits=calibration.limits,
        residual=residual,
        details=tuple({"name": name, **_calibration_details(idm)} for name, idm in individual_idms.items()),
        metadata={"fit": {"settings": asdict(settings), "common": _calibration_details(common_idm), **results}},
    )


def _calibrate_in_rounds(
    trajectories: Sequence[FollowingTrajectory],
    names: Sequence[str],
    settings: FitDriversSettings,
    on_progress: DriverProgress,
) -> tuple[IDMParameters, dict[str, CalibratedIDM]]:
    """Return typical IDM parameters and the IDM of each driver: calibrate common and individual parameters in turn.

    One IDM for drivers with different parameters would react too weakly to its leader.
    """
    groups = [[trajectory for trajectory in trajectories if trajectory.driver == name] for name in names]
    has_individual_headways = "time_headway" in settings.individual
    weights = (0.0, 1.0 if has_individual_headways else 0.0)
    typical = calibrate_idm(trajectories, replace(settings.calibration, initial_headway_weight=weights)).parameters
    individual_idms: dict[str, CalibratedIDM] = {}
    for round_index in range(settings.rounds):
        if round_index:
            factors = [
                individual_idms[trajectory.driver].parameters.time_headway / typical.time_headway
                for trajectory in trajectories
            ]
            typical = calibrate_idm(trajectories, settings.calibration, factors).parameters
        arguments = typical, settings.individual, settings.calibration
        results = calibrate_groups(groups, *arguments, lambda done: on_progress(done, len(names)))
        individual_idms = dict(zip(names, results, strict=True))
    if has_individual_headways:  # the rounds have determined only products of common headway and factors
        (common_idm,) = calibrate_groups([trajectories], typical, ["time_headway"], settings.calibration)
        typical = common_idm.parameters
    return typical, individual_idms


def _fit_residual(
    trajectories: Sequence[FollowingTrajectory], individual_idms: dict[str, CalibratedIDM], settings: FitDriversSettings
) -> tuple[Network | None, dict[str, Any]]:
    """Return the residual, or None if it does not reduce the gap errors, and results of the fit for metadata."""
    from unjam.following.networks import CalibratedTrajectories, fit_multi_step  # imports torch, which IDMs do not need

    shares = 1.0 - RESIDUAL_VALIDATION_SHARE, RESIDUAL_VALIDATION_SHARE, 0.0
    split_trajectories = split_by_driver(trajectories, shares, settings.seed)
    training, validation = (
        CalibratedTrajectories(selected, [individual_idms[trajectory.driver].parameters for trajectory in selected])
        for selected in (select_splits(split_trajectories, name) for name in ("train", "validation"))
    )
    limits = settings.calibration.limits
    network, errors = fit_multi_step(training, validation, limits, settings.multi_step, settings.seed)
    is_better = min(errors) < errors[0]
    results = {"residual_gap_errors": errors, "residual_is_better": is_better}
    return network.to_numpy_network() if is_better else None, results


def _calibration_details(calibrated: CalibratedIDM) -> dict[str, Any]:
    return {name: value for name, value in asdict(calibrated).items() if name != "parameters"}
