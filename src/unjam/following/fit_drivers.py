"""Calibration of a population from trajectories: individual IDMs and a common residual (`unjam fit-drivers`)."""

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
    MultiStepSettings,
    calibrate_groups,
    calibrate_idm,
)
from unjam.following.loaders import ReadOptions, read_pairs
from unjam.following.pairs import Pair, pairs_in_splits, split_by_driver
from unjam.manifest import manifest
from unjam.parameters import STRICT, NonNegativeInt, PositiveInt, build_dataclass, nest_keys
from unjam.physics.idm import IDMParameters
from unjam.scenarios.population import Population

DriverProgress = Callable[[int, int], object]
"""called with the number of finished drivers, and that of all drivers"""
RESIDUAL_VALIDATION_SHARE = 0.2
"""share of the drivers that validate a residual"""
MIN_RESIDUAL_DRIVERS = 5
"""minimum number of drivers for a residual: one of them validates it"""
UNIT_RATIO_LIMITS = (0.5, 2.0)
"""ratio of gap changes and speed differences with equal units, which is one except for noise"""
MIN_SUSPICIOUS_PARAMETERS = 3
"""number of parameters at bounds that suggests wrong units or data"""
PAIR_FILTERS = ("kind", "split", "driver")
"""fields by which trajectories can be selected"""


@dataclass(frozen=True, config=STRICT)
class FitDriversSettings:
    """Settings for the calibration of a population."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    individual: Annotated[tuple[str, ...], Field(min_length=1)] = ("time_headway",)
    """IDM parameters of each driver; the others are common. On NGSIM, with half a minute of each driver, individual
    headways predict the other half better than one IDM for all, and five individual parameters much worse"""
    rounds: PositiveInt = 3
    """alternations between common and individual parameters"""
    residual: bool = False
    """whether a network learns, from simulated driving, what all drivers have in common beyond their IDMs"""
    multi_step: MultiStepSettings = field(default_factory=MultiStepSettings)
    seed: NonNegativeInt = 0


@plain_dataclass(frozen=True)
class FittedDrivers:
    """A population, and notes about its data."""

    population: Population
    notes: list[str]
    """summary of the files"""

    def facts(self) -> dict[str, Any]:
        """Return the main facts for JSON."""
        population = self.population
        facts = {"drivers": len(population.drivers), "parameter_statistics": population.parameter_statistics()}
        return facts | {key: value for key, value in population.metadata["fit"].items() if key != "settings"}

    def report_lines(self) -> list[str]:
        """Return how close the drivers come to the recorded gaps."""
        fit, details = self.population.metadata["fit"], self.population.details
        errors, seconds = np.array([[each["gap_error"], each["seconds"]] for each in details]).T
        individual_error = np.sqrt(np.average(np.square(errors), weights=seconds))
        comparison = f"one IDM for all {fit['common']['gap_error']:.2f} m, individual IDMs {individual_error:.2f} m"
        lines = [f"root mean squared error of the simulated gap: {comparison}"]
        at_bounds = fit["common"]["parameters_at_bounds"]
        if len(at_bounds) >= MIN_SUSPICIOUS_PARAMETERS:
            share = f"{len(at_bounds)} of {len(CALIBRATED_PARAMETERS)} parameters are at the bounds of the search"
            question = "not plausible for human drivers; are speeds in m/s and gaps in m?"
            lines.append(f"warning: {share} ({', '.join(at_bounds)}): {question}")
        collisions = sum(each["collisions"] > 0 for each in details)
        if collisions:
            lines.append(f"{collisions} drivers use up their gap in the simulation")
        if "residual_gap_errors" in fit:
            before, best = fit["residual_gap_errors"][0], min(fit["residual_gap_errors"])
            decision = "used" if fit["residual_is_better"] else "not used, because it is not better"
            lines.append(f"residual: {decision}: {before:.2f} m without, {best:.2f} m with it, on validation drivers")
        return lines


def fit_drivers_from_files(
    files: Sequence[Path],
    overrides: dict[str, Any],
    format: str = "",
    drop_bad_rows: bool = False,
    driver_columns: tuple[str, ...] = (),
    filters: dict[str, str] | None = None,
    out: Path | None = None,
    on_progress: DriverProgress = lambda *done: None,
) -> FittedDrivers:
    """Return the population of the drivers in files.

    Args:
        overrides: of `FitDriversSettings`; keys may have dots.
        format: of the files, see `read_pairs`; options of reading are those of `ReadOptions`.
        filters: values of `kind`, `split` or `driver` that select trajectories.
        out: future file of the population, which is checked before the calibration.

    Raises:
        InputError: a file, a row or a setting is wrong, or no trajectory is selected.
        DiskError: the folder of `out` does not exist.
    """
    if out is not None:
        if out.suffix != ".json":
            raise invalid_value("out", str(out), "a .json file")
        check_parent_folder(out)
    settings = build_dataclass(FitDriversSettings, nest_keys(overrides), "")
    pairs: list[Pair] = []
    notes = []
    for file, prefix in zip(files, _name_prefixes(files), strict=True):
        result = read_pairs(file, format, ReadOptions(drop_bad_rows=drop_bad_rows, driver_columns=driver_columns))
        notes += [f"{file.name}: {line}" for line in result.summary_lines()]
        pairs += [replace(pair, name=prefix + pair.name, driver=prefix + pair.driver) for pair in result.pairs]
    for name, value in (filters or {}).items():
        if name not in PAIR_FILTERS:
            raise unknown_name("select", name, PAIR_FILTERS)
        known = ", ".join(sorted({str(getattr(pair, name)) for pair in pairs} - {""})) or "none"
        pairs = [pair for pair in pairs if getattr(pair, name) == value]
        if not pairs:
            raise InputError(f"select: no trajectory has the {name} {value!r}; available: {known}")
    notes += unit_warnings(pairs)
    population = fit_drivers(pairs, settings, on_progress)
    origin = manifest()
    # Populations are published: they do not name folders of this machine.
    origin["command"] = [Path(word).name if "/" in word else word for word in origin["command"]]
    metadata = {"data": [file.name for file in files], "filters": filters or {}, "manifest": origin}
    return FittedDrivers(replace(population, metadata={**population.metadata, **metadata}), notes)


def _name_prefixes(files: Sequence[Path]) -> list[str]:
    """Return the prefixes of the drivers' names in each file, as drivers of different files are different."""
    for number, file in enumerate(files):
        if file.resolve() in [other.resolve() for other in files[:number]]:
            raise invalid_value("data", str(file), "each file once")
    stems = [file.stem for file in files]
    if len(set(stems)) < len(stems):
        stems = [f"{number}-{stem}" for number, stem in enumerate(stems, 1)]
    return [f"{stem}-" for stem in stems] if len(files) > 1 else [""]


def unit_warnings(pairs: Sequence[Pair]) -> list[str]:
    """Return a warning if changes of gaps do not match the speeds, so that their units differ."""
    differences = [pair.leader_speed - pair.speed for pair in pairs]
    closing = np.concatenate([(each[1:] + each[:-1]) / 2.0 for each in differences])
    change = np.concatenate([np.diff(pair.gap) / pair.step for pair in pairs])
    ratio = float(closing @ change / max(closing @ closing, 1e-9))
    low, high = UNIT_RATIO_LIMITS
    if low <= ratio <= high or not closing.any():
        return []
    ratio_text = f"gaps change {ratio:.2f} times as fast as the speeds imply (0.28 for speeds in km/h)"
    return [f"warning: {ratio_text}; allowed: speeds in m/s and gaps in m"]


def fit_drivers(
    pairs: Sequence[Pair], settings: FitDriversSettings | None = None, on_progress: DriverProgress = lambda *done: None
) -> Population:
    """Return the population of all drivers in `pairs`.

    The parameters minimize the error of the gap that is simulated behind the recorded leader. A residual learns from
    simulated driving; it is left out unless it improves the gaps of drivers that it did not learn from.

    Raises:
        InputError: there are too few drivers for a residual, or the time steps differ.
    """
    settings = settings or FitDriversSettings()
    for name in settings.individual:
        if name not in CALIBRATED_PARAMETERS:
            raise unknown_name("individual", name, CALIBRATED_PARAMETERS)
    names = list(dict.fromkeys(pair.driver for pair in pairs))
    if settings.residual and len(names) < MIN_RESIDUAL_DRIVERS:
        raise invalid_value("drivers", len(names), f">= {MIN_RESIDUAL_DRIVERS} for a residual")
    calibration = replace(settings.calibration, initial_headway_weight=(0.0, 0.0))  # headways are individual
    common = calibrate_idm(pairs, calibration)
    typical, calibrated = _calibrate_in_rounds(pairs, names, replace(settings, calibration=calibration), on_progress)
    residual, facts = _fit_residual(pairs, calibrated, settings) if settings.residual else (None, {})
    return Population(
        typical=typical,
        drivers=tuple(each.parameters for each in calibrated.values()),
        limits=calibration.limits,
        residual=residual,
        details=tuple({"name": name, **_calibration_details(each)} for name, each in calibrated.items()),
        metadata={"fit": {"settings": asdict(settings), "common": _calibration_details(common), **facts}},
    )


def _calibrate_in_rounds(
    pairs: Sequence[Pair], names: Sequence[str], settings: FitDriversSettings, on_progress: DriverProgress
) -> tuple[IDMParameters, dict[str, CalibratedIDM]]:
    """Return the common IDM and that of each driver, which are calibrated in turn.

    One IDM for drivers with different distances is too soft, because it must not react to individual gaps. Therefore
    the common parameters are calibrated with individual headways, and only then the common headway.
    """
    groups = [[pair for pair in pairs if pair.driver == name] for name in names]
    has_own_headways = "time_headway" in settings.individual
    weights = (0.0, 1.0 if has_own_headways else 0.0)
    typical = calibrate_idm(pairs, replace(settings.calibration, initial_headway_weight=weights)).parameters
    calibrated: dict[str, CalibratedIDM] = {}
    for number in range(settings.rounds):
        if number:
            factors = [calibrated[pair.driver].parameters.time_headway / typical.time_headway for pair in pairs]
            typical = calibrate_idm(pairs, settings.calibration, factors).parameters
        search = typical, settings.individual, settings.calibration
        own = calibrate_groups(groups, *search, lambda done: on_progress(done, len(names)))
        calibrated = dict(zip(names, own, strict=True))
    if has_own_headways:  # the common headway was arbitrary until now, a unit of the individual ones
        (one,) = calibrate_groups([pairs], typical, ["time_headway"], settings.calibration)
        typical = one.parameters
    return typical, calibrated


def _fit_residual(
    pairs: Sequence[Pair], calibrated: dict[str, CalibratedIDM], settings: FitDriversSettings
) -> tuple[Network | None, dict[str, Any]]:
    """Return the residual, or None if it does not improve the gaps, and its errors."""
    from unjam.following.networks import CalibratedPairs, fit_multi_step  # imports torch, which IDMs do not need

    split = split_by_driver(pairs, (1.0 - RESIDUAL_VALIDATION_SHARE, RESIDUAL_VALIDATION_SHARE, 0.0), settings.seed)
    parts = [pairs_in_splits(split, name) for name in ("train", "validation")]
    drivers = [[calibrated[pair.driver].parameters for pair in part] for part in parts]
    training, validation = map(CalibratedPairs, parts, drivers)
    fit = fit_multi_step(training, validation, settings.calibration.limits, settings.multi_step, settings.seed)
    is_better = min(fit.validation_errors) < fit.validation_errors[0]
    facts = {"residual_gap_errors": fit.validation_errors, "residual_is_better": is_better}
    return fit.network.to_numpy_network() if is_better else None, facts


def _calibration_details(calibrated: CalibratedIDM) -> dict[str, Any]:
    details = asdict(calibrated)
    del details["parameters"], details["initial_headway_weight"]
    return details
