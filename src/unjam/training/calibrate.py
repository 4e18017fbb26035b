"""Calibration of the human drivers and the demand of a user's network to detector measurements.

The calibration varies factors on the values in the network's files, so that differences between vehicle types remain.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from optuna import create_study
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.samplers import TPESampler
from optuna.trial import TrialState

from unjam.errors import EpisodeError, InputError, LostWorkerError, UnjamError, invalid_value, unknown_name
from unjam.files import FileWatch, atomic_write, sha256_of_file, to_json
from unjam.manifest import manifest
from unjam.measures.detectors import Agreement, Measurement, aggregate_passages, compute_agreement, read_detectors
from unjam.measures.metrics import UNBOUNDED
from unjam.measures.statistics import Estimate, estimate
from unjam.processes import PrivateFolder
from unjam.scenarios.user_network import ROAD_CLASSES, UserNetwork, load_user_network, passenger_types
from unjam.seeds import held_out_seeds, tuning_seeds
from unjam.sumo_files import SumoFiles, read_sumo_files
from unjam.sumo_files.variants import write_variant
from unjam.text import spelling_hint
from unjam.training.assessment_request import ZERO_PENETRATION_RATE
from unjam.training.search_space import SearchSpace, boundary_values, float_range, parse_search_space
from unjam.training.trial_log import TrialLog
from unjam.worlds.sumo.detectors import DetectorPool
from unjam.worlds.sumo.networks import network_geometry
from unjam.worlds.sumo.simulation import InductionLoop

CALIBRATED_NETWORK_FILE, CALIBRATION_FILE = "calibrated.sumocfg", "calibration.json"
CALIBRATION_FINALISTS = 3
"""number of best trials that run again on twice as many other seeds, because the best trial is partly lucky"""
CALIBRATION_TEST_SEEDS = 10
"""number of seeds on which the best and the original factors are evaluated"""
FLOW_FACTOR = "flow"
FACTOR_RANGES: SearchSpace = {
    "tau": FloatDistribution(0.5, 2.0, log=True),
    "accel": FloatDistribution(0.5, 2.0, log=True),
    "decel": FloatDistribution(0.5, 2.0, log=True),
    "minGap": FloatDistribution(0.5, 2.0, log=True),
    "speedFactor": FloatDistribution(0.8, 1.25, log=True),
    FLOW_FACTOR: FloatDistribution(0.67, 1.5, log=True),
}
"""ranges of the factors on attributes of passenger vehicle types and on flows"""
SUMO_TYPE_DEFAULTS = {"tau": 1.0, "accel": 2.6, "decel": 4.5, "minGap": 2.5, "speedFactor": 1.0}
SPEED_PERCENTILE, MAX_SPEED_LIMIT_RATIO = 95, 1.6
"""a percentile of measured speed divided by speed limit, and its maximum; speeds in mph would give 2.2"""
NORMAL_DISTRIBUTION = re.compile(r"(normc?)\(([^()]*)\)")
"""distribution in an attribute, such as a speed factor, from which SUMO draws a value for each vehicle"""

CalibrationFactors = dict[str, float]
"""factors by the names of `FACTOR_RANGES`"""


@dataclass(frozen=True)
class Corridor:
    """A checked network with its checked detector measurements."""

    files: SumoFiles
    detectors: Path
    begin: float
    """begin of the calibrated time [s]"""
    end: float
    """end of the calibrated time [s]"""
    measurements: tuple[Measurement, ...]
    """measurements in intervals between `begin` and `end`"""
    excluded_count: int
    """number of other measurements"""
    loops: tuple[InductionLoop, ...]
    """simulated loops, one per lane of a detector"""
    loop_indices: tuple[tuple[int, ...], ...]
    """indices of the loops of each measurement"""

    def load_scenario(self, file: Path) -> UserNetwork:
        """Return the human-only traffic of a variant of the network, until the last measurement."""
        options = {"penetration_rate": ZERO_PENETRATION_RATE, "cav_types": (), "begin": self.begin, "end": self.end}
        return load_user_network(str(file), options)

    def metadata(self) -> dict[str, Any]:
        """Return names and hashes of the files, and the times of the measurements."""
        files = self.files
        return {
            "scenario": files.path.name,
            "detectors": self.detectors.name,
            "files": [{"name": path.name, "sha256": sha256_of_file(path)} for path in (self.detectors, *files.sources)],
            "begin": self.begin,
            "end": self.end,
            "intervals": {"used": len(self.measurements), "excluded": self.excluded_count},
        }


def load_corridor(file: str, detectors: Path, begin: float | None = None, end: float | None = None) -> Corridor:
    """Read a network from a .sumocfg file, and its detector measurements from `begin` to `end` [s] from a CSV file.

    Without `begin` and `end`, use the times in the .sumocfg file, or the end of the last interval. Raise `InputError`
    if an argument is wrong, a detector is not on the network, or the network has no passenger cars.
    """
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    watch = FileWatch(lambda: filter(Path.is_file, [detectors]))  # before the network, which can take minutes to read
    kind, all_measurements = read_detectors(detectors)
    # The penetration rate is so small that no vehicle is a CAV.
    times = {name: time for name, time in (("begin", begin), ("end", end)) if time is not None}
    network = load_user_network(file, {"penetration_rate": ZERO_PENETRATION_RATE, "cav_classes": ROAD_CLASSES, **times})
    files = read_sumo_files(Path(network.file))
    first = files.begin if begin is None else begin
    last = next((limit for limit in (end, files.end) if limit is not None), inf)
    measurements = tuple(row for row in all_measurements if row.begin >= first and row.end <= last)
    if not measurements:
        raise InputError(f"{detectors.name}: no interval lies between {first:g} s and {last:g} s")
    if not passenger_types(files):
        type_names = ", ".join(sorted(files.used_types))
        raise InputError(f"{files.path.name}: no vehicle type is a passenger car; its types are {type_names}")
    loops_by_measurement = [_detector_loops(files.network, kind, measurement) for measurement in measurements]
    _check_speed_unit(files.network, kind, measurements, detectors.name)
    loops = tuple(dict.fromkeys(chain(*loops_by_measurement)))
    loop_indices = tuple(tuple(map(loops.index, detector_loops)) for detector_loops in loops_by_measurement)
    end_time = max(measurement.end for measurement in measurements)
    excluded_count = len(all_measurements) - len(measurements)
    watch.check()
    return Corridor(files, detectors, first, end_time, measurements, excluded_count, loops, loop_indices)


def _edge_id(kind: str, measurement: Measurement) -> str:
    return measurement.location if kind == "edge" else measurement.location.rpartition("_")[0]


def _check_speed_unit(network: Path, kind: str, measurements: Sequence[Measurement], file: str) -> None:
    """Raise `InputError` if measured speeds are so far above the speed limits that they have another unit."""
    limits = network_geometry(network).speed_limits
    ratios = [row.speed / limits[_edge_id(kind, row)] for row in measurements if isfinite(row.speed)]
    ratio = float(np.percentile(ratios, SPEED_PERCENTILE)) if ratios else 0.0
    if ratio > MAX_SPEED_LIMIT_RATIO:
        raise InputError(
            f"{file}: speed: {ratio:.2g} times the speed limit is not allowed; allowed: m/s, up to "
            f"{MAX_SPEED_LIMIT_RATIO:g} times the limit; multiply km/h by 0.2778, mph by 0.447"
        )


def _detector_loops(network: Path, kind: str, measurement: Measurement) -> list[InductionLoop]:
    """Return the loops of a detector, one per lane; raise `InputError` if the network has no such edge or lane."""
    _, lengths, lane_counts, _ = network_geometry(network)
    edge, place, position = _edge_id(kind, measurement), measurement.location, measurement.position
    all_lanes = [f"{edge}_{index}" for index in range(lane_counts.get(edge, 0))]
    lanes = all_lanes if kind == "edge" else [lane for lane in all_lanes if lane == place]
    if not lanes:
        raise invalid_value(kind, place, f"one of {network.name}{spelling_hint(place, all_lanes or lane_counts)}")
    if position > lengths[edge]:
        raise invalid_value(f"{kind} {place}: position", position, f"<= {lengths[edge]:g} m, its length")
    return [InductionLoop(lane, position) for lane in lanes]


def scale_vehicle_types(files: SumoFiles, factors: CalibrationFactors) -> dict[str, dict[str, str]]:
    """Return the scaled attributes of passenger vehicle types, those with factors other than one, by id of the type.

    The time gap `tau` stays at least as long as the simulation step, or vehicles would collide. Raise `InputError` if
    an attribute is not a number.
    """
    scaled_types, minimums = dict[str, dict[str, str]](), {"tau": files.step}
    for type_id in passenger_types(files):
        attributes = {**{key: str(value) for key, value in SUMO_TYPE_DEFAULTS.items()}, **files.types.get(type_id, {})}
        scaled = {
            key: _scale_attribute(f"vType {type_id}: {key}", attributes[key], factor, minimums.get(key, 0.0))
            for key, factor in factors.items()
            if key != FLOW_FACTOR and factor != 1
        }
        if scaled:
            scaled_types[type_id] = scaled
    return scaled_types


def _scale_attribute(field: str, text: str, factor: float, minimum: float) -> str:
    distribution = NORMAL_DISTRIBUTION.fullmatch(text.replace(" ", ""))
    try:
        if distribution:  # a factor on mean, deviation and bounds is a factor on the value of each vehicle
            arguments = ",".join(f"{float(argument) * factor:.6g}" for argument in distribution[2].split(","))
            return f"{distribution[1]}({arguments})"
        value = float(text)
    except ValueError:
        raise invalid_value(field, text, "a number, or norm(...) or normc(...) of numbers") from None
    return f"{max(value * factor, min(value, minimum)):.6g}"


def parse_factor_space(texts: list[str]) -> SearchSpace:
    """Return a search space from texts such as `tau=0.5..2` or `tau=0.5..2:log`, or `FACTOR_RANGES` without texts.

    Raise `InputError` for other texts.
    """
    space: SearchSpace = {}
    for name, distribution in (parse_search_space(texts) if texts else FACTOR_RANGES).items():
        if name not in FACTOR_RANGES:
            raise unknown_name("vary", name, FACTOR_RANGES)
        if isinstance(distribution, CategoricalDistribution) or not distribution.low > 0:
            raise invalid_value(f"vary {name}", boundary_values(distribution), "a range of factors > 0, as 0.5..2")
        space[name] = float_range(distribution)
    return space


@dataclass(frozen=True)
class CalibrationTrial:
    """Factors and their score."""

    factors: CalibrationFactors
    score: float | None
    """mean of `Agreement.score` over the seeds, to minimize; None if SUMO failed"""
    failure: str
    """reason of SUMO's failure, or an empty text"""


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration."""

    factors: CalibrationFactors
    vehicle_types: dict[str, dict[str, str]]
    """changed attributes of vehicle types, by id"""
    original: list[Agreement]
    """agreement of the original network on each test seed, as `calibrated` for the calibrated network"""
    calibrated: list[Agreement]
    trials: list[CalibrationTrial]
    file: Path
    """the calibrated network"""

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return the mean of each measure with its CI: original, calibrated, and the paired difference."""
        estimates = {}
        for name in asdict(self.original[0]):
            agreements = self.original, self.calibrated
            original, calibrated = (np.array([getattr(row, name) for row in rows]) for rows in agreements)
            columns = {"original": original, "calibrated": calibrated, "difference": calibrated - original}
            bounds = (0.0, 1.0 if name == "geh_below_5" else inf)
            estimates[name] = {
                column: estimate(values.tolist(), bounds=UNBOUNDED if column == "difference" else bounds)
                for column, values in columns.items()
            }
        return estimates


def calibrate(
    corridor: Corridor,
    folder: Path,
    simulator: DetectorPool,
    space: SearchSpace = FACTOR_RANGES,
    trials: int = 60,
    seeds_per_trial: int = 3,
    seed: int = 0,
    on_message: Callable[[str], None] = lambda line: None,
) -> CalibrationResult:
    """Search factors on vehicle types and flows, and write the calibrated network and `calibration.json`.

    The trials are stored in the folder: an interrupted calibration resumes with the same result, also with more trials.
    The first trial has factors of one, or the nearest values in the space; `seed` is the seed of the proposals. The
    result does not depend on the number of processes. Raise `UnjamError` if SUMO cannot simulate the original network,
    or if its process was lost repeatedly.
    """
    original, watch = dict.fromkeys(space, 1.0), FileWatch(lambda: (corridor.detectors, *corridor.files.sources))
    log = TrialLog(folder, corridor.metadata() | {"space": repr(space), "seeds": seeds_per_trial, "seed": seed})
    measurements = corridor.measurements

    def simulate(factors: CalibrationFactors, seeds: Sequence[tuple[int, ...]]) -> list[Agreement]:
        with PrivateFolder() as private:
            file = _write_scaled_network(corridor, factors, Path(private) / CALIBRATED_NETWORK_FILE)
            runs = simulator.run(corridor.load_scenario(file), seeds, corridor.loops)
        watch.check()
        flows_and_speeds = (aggregate_passages(measurements, corridor.loop_indices, passages) for passages in runs)
        return [compute_agreement(measurements, flows, speeds) for flows, speeds in flows_and_speeds]

    def score_factors(factors: CalibrationFactors, first: int, count: int) -> CalibrationTrial:
        text = to_json(factors)
        if (first, text) not in log.verdicts:
            try:
                agreements = simulate(factors, tuning_seeds(count, first))
                log.add(first, text, (float(np.mean([agreement.score for agreement in agreements])), ""))
            except LostWorkerError:  # not caused by these factors
                raise
            except EpisodeError as error:
                if factors == original:
                    reason = f"the original network cannot be simulated: {error}"
                    raise UnjamError(f"{corridor.files.path.name}: {reason}") from None
                log.add(first, text, (None, str(error)))
        return CalibrationTrial(factors, *log.verdicts[first, text])

    results: list[CalibrationTrial] = []
    study = create_study(sampler=TPESampler(seed=seed, multivariate=True))
    limits = {name: boundary_values(distribution) for name, distribution in space.items()}
    study.enqueue_trial({name: min(max(1.0, low), high) for name, (low, high) in limits.items()})
    original_trial = score_factors(original, 0, seeds_per_trial)
    for number in range(1, trials + 1):
        proposal = study.ask(dict(space))
        factors = {name: float(f"{value:.4g}") for name, value in proposal.params.items()}
        results.append(trial := score_factors(factors, 0, seeds_per_trial))
        study.tell(proposal, trial.score, state=TrialState.FAIL if trial.score is None else None)
        text = trial.failure if trial.score is None else f"{trial.score:.4g}"
        on_message(f"{number} of {trials}: {_factor_text(trial.factors)}: {text}")
    ranked = sorted((trial for trial in results if trial.score is not None), key=_score_or_infinity)
    finalists = [
        score_factors(trial.factors, seeds_per_trial, 2 * seeds_per_trial)
        for trial in (*ranked[:CALIBRATION_FINALISTS], original_trial)
    ]
    best = min(finalists, key=_score_or_infinity).factors
    on_message(f"evaluating on {CALIBRATION_TEST_SEEDS} test seeds: {_factor_text(best)}")
    test_seeds = held_out_seeds(CALIBRATION_TEST_SEEDS)
    original_rows, calibrated_rows = (simulate(factors, test_seeds) for factors in (original, best))
    types = scale_vehicle_types(corridor.files, best)
    file = _write_scaled_network(corridor, best, folder / CALIBRATED_NETWORK_FILE)
    result = CalibrationResult(best, types, original_rows, calibrated_rows, results, file)
    document = {
        **corridor.metadata(),
        "seed": seed,
        "seeds": {"trial": seeds_per_trial, "test": CALIBRATION_TEST_SEEDS},
        **calibration_document(result),
        "manifest": {**manifest(), "starts": log.starts},
    }
    atomic_write(folder / CALIBRATION_FILE, to_json(document, indent=1))
    return result


def calibration_document(result: CalibrationResult) -> dict[str, Any]:
    """Return the result of a calibration as JSON."""
    return {
        "factors": result.factors,
        "vehicle_types": result.vehicle_types,
        "agreement": {
            name: {column: asdict(column_estimate) for column, column_estimate in columns.items()}
            for name, columns in result.estimates().items()
        },
        "rows": {"original": list(map(asdict, result.original)), "calibrated": list(map(asdict, result.calibrated))},
        "trials": list(map(asdict, result.trials)),
    }


def _score_or_infinity(trial: CalibrationTrial) -> float:
    """Return the score of a trial, of which smaller ones are better; infinity for a failed trial."""
    return inf if trial.score is None else trial.score


def _factor_text(factors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} x {value:g}" for name, value in factors.items())


def _write_scaled_network(corridor: Corridor, factors: CalibrationFactors, file: Path) -> Path:
    types = scale_vehicle_types(corridor.files, factors)
    return write_variant(corridor.files, types, factors.get(FLOW_FACTOR, 1.0), file)
