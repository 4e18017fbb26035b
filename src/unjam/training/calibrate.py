"""Calibration of the human drivers and the demand of a user's network, so that detectors measure what they did.

`unjam calibrate`, with Optuna, in SUMO. It varies factors on the values in the network's own files, so that differences
between vehicle types remain. Tuning seeds select the factors, test seeds evaluate them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from unjam.errors import EpisodeError, LostWorkerError, UnjamError
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.detectors import Agreement, aggregate_passages, compute_agreement
from unjam.measures.metrics import UNBOUNDED
from unjam.measures.statistics import Estimate, estimate
from unjam.processes import PrivateFolder
from unjam.sumo_files.variants import write_variant
from unjam.training.corridor import FACTOR_RANGES, FLOW_FACTOR, CalibrationFactors, Corridor, scale_vehicle_types
from unjam.training.search import import_optuna
from unjam.training.search_space import SearchSpace, suggest_values
from unjam.training.seeds import make_test_seeds, tuning_seeds
from unjam.training.trial_log import TrialLog
from unjam.worlds.sumo.detectors import DetectorPool

CALIBRATED_NETWORK_FILE, CALIBRATION_FILE = "calibrated.sumocfg", "calibration.json"
CALIBRATION_FINALISTS = 3
"""trials that run again on twice as many other seeds, because the best of many trials is partly lucky"""
CALIBRATION_TEST_SEEDS = 10
"""seeds on which the best and the original factors are evaluated"""


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
    """on test seeds"""
    calibrated: list[Agreement]
    """on the same seeds"""
    trials: list[CalibrationTrial]
    file: Path
    """the new configuration"""

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return the mean of each measure with its CI: original, calibrated, and the paired difference."""
        estimates = {}
        for name in asdict(self.original[0]):
            before, after = (
                np.array([getattr(each, name) for each in rows]) for rows in (self.original, self.calibrated)
            )
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

    Args:
        corridor: the network and its measurements.
        folder: new, empty, or that of this calibration.
        simulator: the result does not depend on its number of processes.
        space: factors to vary, by the names of `FACTOR_RANGES`.
        trials: total number; the first one has factors of one, or the nearest values in the space.
        seeds_per_trial: number of seeds.
        seed: of the proposals.
        on_message: called with a line for each trial.

    Raise `UnjamError` if SUMO cannot simulate the original network, or if its process was lost repeatedly.
    """
    original = dict.fromkeys(space, 1.0)
    log = TrialLog(folder, corridor.metadata() | {"space": repr(space), "seeds": seeds_per_trial, "seed": seed})
    measurements = corridor.measurements

    def simulate(factors: CalibrationFactors, seeds: Sequence[tuple[int, ...]]) -> list[Agreement]:
        with PrivateFolder() as private:
            scenario = corridor.scenario(_write_network(corridor, factors, Path(private) / CALIBRATED_NETWORK_FILE))
            runs = simulator.run(scenario, seeds, corridor.loops)
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
                    raise UnjamError(f"{corridor.files.path.name}: as it is: {error}") from None
                log.add(first, text, (None, str(error)))
        return CalibrationTrial(factors, *log.verdicts[first, text])

    optuna, results = import_optuna("calibrate"), list[CalibrationTrial]()
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    limits = {name: values.boundary_values for name, values in space.items()}
    study.enqueue_trial({name: min(max(1.0, low), high) for name, (low, high) in limits.items()})
    original_trial = score_factors(original, 0, seeds_per_trial)
    for number in range(trials):
        asked = study.ask()
        factors = {name: float(f"{value:.4g}") for name, value in suggest_values(asked, space).items()}
        results.append(trial := score_factors(factors, 0, seeds_per_trial))
        study.tell(asked, trial.score, state=None if trial.score is not None else optuna.trial.TrialState.FAIL)
        text = trial.failure if trial.score is None else f"{trial.score:.4g}"
        on_message(f"{number + 1} of {trials}: {_factor_text(trial.factors)}: {text}")
    ranked = sorted((each for each in results if each.score is not None), key=_ranking_score)[:CALIBRATION_FINALISTS]
    finalists = [
        score_factors(each.factors, seeds_per_trial, 2 * seeds_per_trial) for each in (*ranked, original_trial)
    ]
    best = min(finalists, key=_ranking_score).factors
    on_message(f"evaluating on {CALIBRATION_TEST_SEEDS} test seeds: {_factor_text(best)}")
    before, after = (simulate(factors, make_test_seeds(CALIBRATION_TEST_SEEDS)) for factors in (original, best))
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
