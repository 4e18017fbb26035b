"""Calibration of the human drivers and the demand of a user's network, so that detectors measure what they did.

It varies factors on the values in the network's own files, so that differences between vehicle types remain.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
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
"""trials that run again on twice as many other seeds, because the best of many trials is partly lucky"""
CALIBRATION_TEST_SEEDS = 10
"""seeds on which the best and the original factors are evaluated"""
FLOW_FACTOR = "flow"
FACTOR_RANGES: SearchSpace = {
    "tau": FloatDistribution(0.5, 2.0, log=True),
    "accel": FloatDistribution(0.5, 2.0, log=True),
    "decel": FloatDistribution(0.5, 2.0, log=True),
    "minGap": FloatDistribution(0.5, 2.0, log=True),
    "speedFactor": FloatDistribution(0.8, 1.25, log=True),
    FLOW_FACTOR: FloatDistribution(0.67, 1.5, log=True),
}
"""factors on the attributes of passenger vehicle types, and on flows"""
SUMO_TYPE_DEFAULTS = {"tau": 1.0, "accel": 2.6, "decel": 4.5, "minGap": 2.5, "speedFactor": 1.0}
SPEED_PERCENTILE, MAX_SPEED_LIMIT_RATIO = 95, 1.6
"""percentile of the measured speeds relative to the speed limits, and its maximum: speeds in mph would have 2.2"""
NORMAL_DISTRIBUTION = re.compile(r"(normc?)\(([^()]*)\)")
"""a speed factor that is drawn for each vehicle"""

CalibrationFactors = dict[str, float]
"""factors by the names of `FACTOR_RANGES`"""


@dataclass(frozen=True)
class Corridor:
    """A network and its detector measurements, both checked."""

    files: SumoFiles
    detectors: Path
    begin: float
    """begin of the calibrated time [s]"""
    end: float
    """end of the calibrated time [s]"""
    measurements: tuple[Measurement, ...]
    """intervals between `begin` and `end`"""
    excluded_count: int
    loops: tuple[InductionLoop, ...]
    loop_numbers: tuple[tuple[int, ...], ...]

    def scenario(self, file: Path) -> UserNetwork:
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
    """Return a network, a .sumocfg file, and its detector measurements, a CSV file, from `begin` to `end` [s].

    None: times of the configuration, or of the last interval. Raise `InputError` if an argument is wrong, a detector is
    not on the network, or nothing can be varied.
    """
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    kind, rows = read_detectors(detectors)
    # The penetration rate is so small that no vehicle is a CAV.
    times = {name: time for name, time in (("begin", begin), ("end", end)) if time is not None}
    checked = load_user_network(file, {"penetration_rate": ZERO_PENETRATION_RATE, "cav_classes": ROAD_CLASSES, **times})
    files = read_sumo_files(Path(checked.file))
    first = files.begin if begin is None else begin
    last = next((limit for limit in (end, files.end) if limit is not None), inf)
    used = [row for row in rows if row.begin >= first and row.end <= last]
    if not used:
        raise InputError(f"{detectors.name}: no interval lies between {first:g} s and {last:g} s")
    if not passenger_types(files):
        known = ", ".join(sorted(files.used_types))
        raise InputError(f"{files.path.name}: no vehicle type is a passenger car; its types are {known}")
    row_loops = [_detector_loops(files.network, kind, row) for row in used]
    _check_speed_unit(files.network, kind, used, detectors.name)
    numbers = {loop: number for number, loop in enumerate(dict.fromkeys(loop for each in row_loops for loop in each))}
    loop_numbers = tuple(tuple(numbers[loop] for loop in each) for each in row_loops)
    end_time = max(row.end for row in used)
    excluded = len(rows) - len(used)
    return Corridor(files, detectors, first, end_time, tuple(used), excluded, tuple(numbers), loop_numbers)


def _check_speed_unit(network: Path, kind: str, rows: Sequence[Measurement], file: str) -> None:
    """Raise `InputError` if measured speeds are so far above the speed limits that they have another unit."""
    limits = network_geometry(network).speed_limits
    edges = [row.place if kind == "edge" else row.place.rpartition("_")[0] for row in rows]
    ratios = [row.speed / limits[edge] for row, edge in zip(rows, edges, strict=True) if isfinite(row.speed)]
    ratio = float(np.percentile(ratios, SPEED_PERCENTILE)) if ratios else 0.0
    if ratio > MAX_SPEED_LIMIT_RATIO:
        raise InputError(
            f"{file}: speed: {ratio:.2g} times the speed limit is not allowed; allowed: m/s, up to "
            f"{MAX_SPEED_LIMIT_RATIO:g} times the limit; multiply km/h by 0.2778, mph by 0.447"
        )


def _detector_loops(network: Path, kind: str, row: Measurement) -> list[InductionLoop]:
    """Return the loops of a detector; raise `InputError` if the network has no such place."""
    _, lengths, counts, _ = network_geometry(network)
    edge = row.place if kind == "edge" else row.place.rpartition("_")[0]
    all_lanes = [f"{edge}_{number}" for number in range(counts.get(edge, 0))]
    lanes = all_lanes if kind == "edge" else [lane for lane in all_lanes if lane == row.place]
    if not lanes:
        raise invalid_value(kind, row.place, f"one of {network.name}{spelling_hint(row.place, all_lanes or counts)}")
    if row.position > lengths[edge]:
        raise invalid_value(f"{kind} {row.place}: position", row.position, f"<= {lengths[edge]:g} m, its length")
    return [InductionLoop(lane, row.position) for lane in lanes]


def scale_vehicle_types(files: SumoFiles, factors: CalibrationFactors) -> dict[str, dict[str, str]]:
    """Return the changed attributes of all passenger types multiplied by `factors`, by id.

    Reaction times stay at least as long as the simulation step, or vehicles would collide. Raise `InputError` if an
    attribute is not a number.
    """
    scaled: dict[str, dict[str, str]] = {}
    for name in passenger_types(files):
        attributes = {**{key: str(value) for key, value in SUMO_TYPE_DEFAULTS.items()}, **files.types.get(name, {})}
        changes = {
            key: _scale_attribute(f"vType {name}: {key}", attributes[key], factor, files.step if key == "tau" else 0.0)
            for key, factor in factors.items()
            if key != FLOW_FACTOR and factor != 1
        }
        if changes:
            scaled[name] = changes
    return scaled


def _scale_attribute(field: str, text: str, factor: float, minimum: float) -> str:
    drawn = NORMAL_DISTRIBUTION.fullmatch(text.replace(" ", ""))
    try:
        if drawn:  # mean, deviation and bounds: this multiplies the value of each vehicle
            return f"{drawn[1]}({','.join(f'{float(part) * factor:.6g}' for part in drawn[2].split(','))})"
        value = float(text)
    except ValueError:
        raise invalid_value(field, text, "a number, or norm(...) or normc(...) of numbers") from None
    return f"{max(value * factor, min(value, minimum)):.6g}"


def parse_factor_space(texts: list[str]) -> SearchSpace:
    """Return a search space from `tau=0.5..2` or `tau=0.5..2:log`, without any `FACTOR_RANGES`; or `InputError`."""
    space: SearchSpace = {}
    for name, values in (parse_search_space(texts) if texts else FACTOR_RANGES).items():
        if name not in FACTOR_RANGES:
            raise unknown_name("vary", name, FACTOR_RANGES)
        if isinstance(values, CategoricalDistribution) or not values.low > 0:
            raise invalid_value(f"vary {name}", boundary_values(values), "a range of factors > 0, as 0.5..2")
        space[name] = float_range(values)
    return space


@dataclass(frozen=True)
class CalibrationTrial:
    """A trial of factors."""

    factors: CalibrationFactors
    score: float | None
    """mean over the seeds; None if SUMO failed"""
    failure: str


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration."""

    factors: CalibrationFactors
    vehicle_types: dict[str, dict[str, str]]
    """changed attributes of vehicle types, by id"""
    original: list[Agreement]
    calibrated: list[Agreement]
    trials: list[CalibrationTrial]
    file: Path

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return the mean of each measure with its CI: original, calibrated, and the paired difference."""
        estimates = {}
        for name in asdict(self.original[0]):
            both = self.original, self.calibrated
            before, after = (np.array([getattr(each, name) for each in rows]) for rows in both)
            columns = {"original": before, "calibrated": after, "difference": after - before}
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
    """Search factors on vehicle types and flows, and write the best as a network and `calibration.json`.

    The trials are stored in the folder: an interrupted calibration resumes with the same result, also with more trials.
    The first trial has factors of one, or the nearest values in the space; `seed` is that of the proposals. The result
    does not depend on the number of processes. Raise `UnjamError` if SUMO cannot simulate the original network, or if
    its process was lost repeatedly.
    """
    original, watch = dict.fromkeys(space, 1.0), FileWatch(lambda: (corridor.detectors, *corridor.files.sources))
    log = TrialLog(folder, corridor.metadata() | {"space": repr(space), "seeds": seeds_per_trial, "seed": seed})
    measurements = corridor.measurements

    def simulate(factors: CalibrationFactors, seeds: Sequence[tuple[int, ...]]) -> list[Agreement]:
        with PrivateFolder() as private:
            scenario = corridor.scenario(_write_network(corridor, factors, Path(private) / CALIBRATED_NETWORK_FILE))
            runs = simulator.run(scenario, seeds, corridor.loops)
        watch.check()
        flows_and_speeds = (aggregate_passages(measurements, corridor.loop_numbers, passages) for passages in runs)
        return [compute_agreement(measurements, *each) for each in flows_and_speeds]

    def score_factors(factors: CalibrationFactors, first: int, count: int) -> CalibrationTrial:
        text = to_json(factors)
        if (first, text) not in log.verdicts:
            try:
                rows = simulate(factors, tuning_seeds(count, first))
                log.add(first, text, (float(np.mean([row.score for row in rows])), ""))
            except LostWorkerError:  # says nothing about these factors
                raise
            except EpisodeError as error:
                if factors == original:
                    reason = f"the original network cannot be simulated: {error}"
                    raise UnjamError(f"{corridor.files.path.name}: {reason}") from None
                log.add(first, text, (None, str(error)))
        return CalibrationTrial(factors, *log.verdicts[first, text])

    results: list[CalibrationTrial] = []
    study = create_study(sampler=TPESampler(seed=seed, multivariate=True))
    limits = {name: boundary_values(values) for name, values in space.items()}
    study.enqueue_trial({name: min(max(1.0, low), high) for name, (low, high) in limits.items()})
    original_trial = score_factors(original, 0, seeds_per_trial)
    for number in range(trials):
        asked = study.ask(dict(space))
        factors = {name: float(f"{value:.4g}") for name, value in asked.params.items()}
        results.append(trial := score_factors(factors, 0, seeds_per_trial))
        study.tell(asked, trial.score, state=TrialState.FAIL if trial.score is None else None)
        text = trial.failure if trial.score is None else f"{trial.score:.4g}"
        on_message(f"{number + 1} of {trials}: {_factor_text(trial.factors)}: {text}")
    ranked = sorted((each for each in results if each.score is not None), key=_ranking_score)[:CALIBRATION_FINALISTS]
    again = [*ranked, original_trial]
    finalists = [score_factors(each.factors, seeds_per_trial, 2 * seeds_per_trial) for each in again]
    best = min(finalists, key=_ranking_score).factors
    on_message(f"evaluating on {CALIBRATION_TEST_SEEDS} test seeds: {_factor_text(best)}")
    before, after = (simulate(factors, held_out_seeds(CALIBRATION_TEST_SEEDS)) for factors in (original, best))
    types, file = scale_vehicle_types(corridor.files, best), folder / CALIBRATED_NETWORK_FILE
    result = CalibrationResult(best, types, before, after, results, _write_network(corridor, best, file))
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
            name: {column: asdict(each) for column, each in columns.items()}
            for name, columns in result.estimates().items()
        },
        "rows": {"original": list(map(asdict, result.original)), "calibrated": list(map(asdict, result.calibrated))},
        "trials": list(map(asdict, result.trials)),
    }


def _ranking_score(trial: CalibrationTrial) -> float:
    return inf if trial.score is None else trial.score


def _factor_text(factors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} x {value:g}" for name, value in factors.items())


def _write_network(corridor: Corridor, factors: CalibrationFactors, file: Path) -> Path:
    types = scale_vehicle_types(corridor.files, factors)
    return write_variant(corridor.files, types, factors.get(FLOW_FACTOR, 1.0), file)
