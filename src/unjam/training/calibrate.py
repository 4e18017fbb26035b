"""Calibration: how people drive on a user's own road, and how many, so that detectors measure what they did.

`unjam calibrate`, with Optuna, in SUMO. What is varied are factors on what the network's own files say: types
that differ go on differing. Some seeds choose, others judge.
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
from unjam.training.search_space import SearchSpace
from unjam.training.seeds import make_test_seeds, tuning_seeds
from unjam.training.trial_log import TrialLog
from unjam.worlds.sumo.detector_pool import DetectorPool

CALIBRATED_NETWORK_FILE, CALIBRATION_FILE = "calibrated.sumocfg", "calibration.json"
CALIBRATION_FINALISTS = 3
"""trials that drive again, on twice as many other seeds: else the luckiest would win"""
CALIBRATION_TEST_SEEDS = 10
"""seeds on which the best and the original are judged"""


@dataclass(frozen=True)
class CalibrationTrial:
    """Factors that were tried."""

    factors: CalibrationFactors
    score: float | None
    """mean over the seeds; None where SUMO could not drive so"""
    failure: str


@dataclass(frozen=True)
class CalibrationResult:
    """What a calibration found."""

    factors: CalibrationFactors
    vehicle_types: dict[str, dict[str, str]]
    """attributes that vehicle types have now, by id"""
    original: list[Agreement]
    """on seeds that chose nothing"""
    calibrated: list[Agreement]
    """on the same seeds"""
    trials: list[CalibrationTrial]
    file: Path
    """the new configuration"""

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return each measure's mean with its interval: original, calibrated, and the difference by seed."""
        found = {}
        for name in asdict(self.original[0]):
            before, after = (
                np.array([getattr(one, name) for one in rows]) for rows in (self.original, self.calibrated)
            )
            columns = {"original": before, "calibrated": after, "difference": after - before}
            most = 1.0 if name == "geh_below_5" else inf
            found[name] = {
                column: estimate(values.tolist(), bounds=UNBOUNDED if column == "difference" else (0.0, most))
                for column, values in columns.items()
            }
        return found


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

    What was tried is kept in the folder: a calibration that was stopped goes on where it was, also with more
    trials, and finds the same.

    Args:
        asked: the network and its measurements.
        folder: new, empty, or that of this calibration.
        counting: simulates; the result does not depend on how many at once.
        space: what is varied: factors by the names of `FACTOR_RANGES`.
        trials: in all; the first is the network as it is, or what is nearest to it.
        seeds: of each trial.
        seed: of the proposals.
        on_line: gets a line for each trial.

    Raises:
        InputError: the folder holds something else.
        UnjamError: SUMO cannot drive the network as it is, or was lost again and again.
    """
    original = dict.fromkeys(space, 1.0)
    tried = TrialLog(folder, corridor.metadata() | {"space": repr(space), "seeds": seeds_per_trial, "seed": seed})

    def simulate(factors: CalibrationFactors, seeds: Sequence[tuple[int, ...]]) -> list[Agreement]:
        with PrivateFolder() as private:
            scenario = corridor.scenario(_write_network(corridor, factors, Path(private) / CALIBRATED_NETWORK_FILE))
            passed = simulator.run(scenario, seeds, corridor.loops)
        return [
            compute_agreement(
                corridor.measurements, *aggregate_passages(corridor.measurements, corridor.loop_numbers, one)
            )
            for one in passed
        ]

    def score_factors(factors: CalibrationFactors, first: int, count: int) -> CalibrationTrial:
        text = to_json(factors)
        if (first, text) not in tried.verdicts:
            try:
                rows = simulate(factors, tuning_seeds(count, first))
                tried.add(first, text, (float(np.mean([row.score for row in rows])), ""))
            except LostWorkerError:  # says nothing of these factors
                raise
            except EpisodeError as error:
                if factors == original:
                    raise UnjamError(f"{corridor.files.path.name}: as it is: {error}") from None
                tried.add(first, text, (None, str(error)))
        return CalibrationTrial(factors, *tried.verdicts[first, text])

    optuna, found = import_optuna("calibrate"), list[CalibrationTrial]()
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    ends = {name: values.boundary_values for name, values in space.items()}
    study.enqueue_trial({name: min(max(1.0, low), high) for name, (low, high) in ends.items()})
    as_it_is = score_factors(original, 0, seeds_per_trial)
    for number in range(trials):
        trial = study.ask()
        for name, values in space.items():
            values.suggest(trial, name)
        factors = {name: float(f"{value:.4g}") for name, value in trial.params.items()}
        found.append(one := score_factors(factors, 0, seeds_per_trial))
        study.tell(trial, one.score, state=None if one.score is not None else optuna.trial.TrialState.FAIL)
        said = one.failure if one.score is None else f"{one.score:.4g}"
        on_message(f"{number + 1} of {trials}: {_factor_text(one.factors)}: {said}")
    ranked = sorted((one for one in found if one.score is not None), key=_ranking_score)[:CALIBRATION_FINALISTS]
    again = [score_factors(one.factors, seeds_per_trial, 2 * seeds_per_trial) for one in (*ranked, as_it_is)]
    best = min(again, key=_ranking_score).factors
    on_message(f"judged on {CALIBRATION_TEST_SEEDS} other seeds: {_factor_text(best)}")
    before, after = (simulate(factors, make_test_seeds(CALIBRATION_TEST_SEEDS)) for factors in (original, best))
    types, file = scale_vehicle_types(corridor.files, best), folder / CALIBRATED_NETWORK_FILE
    calibrated = CalibrationResult(best, types, before, after, found, file)
    _write_network(corridor, best, file)
    about = {**corridor.metadata(), "seed": seed, "seeds": {"trial": seeds_per_trial, "test": CALIBRATION_TEST_SEEDS}}
    atomic_write(
        folder / CALIBRATION_FILE,
        to_json(
            {**about, **calibration_document(calibrated), "manifest": {**manifest(), "starts": tried.starts}}, indent=1
        ),
    )
    return calibrated


def calibration_document(result: CalibrationResult) -> dict[str, Any]:
    """Return what a calibration found, as JSON."""
    return {
        "factors": result.factors,
        "vehicle_types": result.vehicle_types,
        "agreement": {
            name: {column: asdict(one) for column, one in columns.items()}
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
    return write_variant(
        corridor.files, scale_vehicle_types(corridor.files, factors), factors.get(FLOW_FACTOR, 1.0), file
    )
