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

from unjam.errors import EpisodeError, LostError, UnjamError
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.detectors import Agreement, agreement, detected
from unjam.measures.metrics import SIGNED
from unjam.measures.statistics import Estimate, estimate
from unjam.processes import PrivateFolder
from unjam.sumo_files.changed import write_changed
from unjam.training.corridor import FLOWS, VARIED, Corridor, Factors, changed_types
from unjam.training.search import quiet_optuna
from unjam.training.seeds import held_out_seeds, tuning_seeds
from unjam.training.space import Space
from unjam.training.tried import Tried
from unjam.worlds.sumo.counting import Counting

CONFIGURATION, CALIBRATION = "calibrated.sumocfg", "calibration.json"
FINALISTS = 3
"""trials that drive again, on twice as many other seeds: else the luckiest would win"""
JUDGED = 10
"""seeds on which the best and the original are judged"""


@dataclass(frozen=True)
class CalibrationTrial:
    """Factors that were tried."""

    factors: Factors
    score: float | None
    """mean over the seeds; None where SUMO could not drive so"""
    why: str


@dataclass(frozen=True)
class Calibrated:
    """What a calibration found."""

    factors: Factors
    types: dict[str, dict[str, str]]
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
                column: estimate(values.tolist(), bounds=SIGNED if column == "difference" else (0.0, most))
                for column, values in columns.items()
            }
        return found


def calibrate(
    asked: Corridor,
    folder: Path,
    counting: Counting,
    space: Space = VARIED,
    trials: int = 60,
    seeds: int = 3,
    seed: int = 0,
    on_line: Callable[[str], None] = lambda line: None,
) -> Calibrated:
    """Search factors on vehicle types and flows, and write the best as a network and `calibration.json`.

    What was tried is kept in the folder: a calibration that was stopped goes on where it was, also with more
    trials, and finds the same.

    Args:
        asked: the network and its measurements.
        folder: new, empty, or that of this calibration.
        counting: simulates; the result does not depend on how many at once.
        space: what is varied: factors by the names of `VARIED`.
        trials: in all; the first is the network as it is, or what is nearest to it.
        seeds: of each trial.
        seed: of the proposals.
        on_line: gets a line for each trial.

    Raises:
        InputError: the folder holds something else.
        UnjamError: SUMO cannot drive the network as it is, or was lost again and again.
    """
    original = dict.fromkeys(space, 1.0)
    tried = Tried(folder, asked.about() | {"space": repr(space), "seeds": seeds, "seed": seed})

    def driven(factors: Factors, numbers: Sequence[tuple[int, ...]]) -> list[Agreement]:
        with PrivateFolder() as private:
            scenario = asked.scenario(_write(asked, factors, Path(private) / CONFIGURATION))
            passed = counting.run(scenario, numbers, asked.loops)
        return [agreement(asked.measured, *detected(asked.measured, asked.loops_of, one)) for one in passed]

    def score(factors: Factors, first: int, count: int) -> CalibrationTrial:
        text = to_json(factors)
        if (first, text) not in tried.known:
            try:
                rows = driven(factors, tuning_seeds(count, first))
                tried.keep(first, text, (float(np.mean([row.score for row in rows])), ""))
            except LostError:  # says nothing of these factors
                raise
            except EpisodeError as error:
                if factors == original:
                    raise UnjamError(f"{asked.files.path.name}: as it is: {error}") from None
                tried.keep(first, text, (None, str(error)))
        return CalibrationTrial(factors, *tried.known[first, text])

    optuna, found = quiet_optuna("calibrate"), list[CalibrationTrial]()
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    ends = {name: values.ends for name, values in space.items()}
    study.enqueue_trial({name: min(max(1.0, low), high) for name, (low, high) in ends.items()})
    as_it_is = score(original, 0, seeds)
    for number in range(trials):
        trial = study.ask()
        for name, values in space.items():
            values.suggest(trial, name)
        factors = {name: float(f"{value:.4g}") for name, value in trial.params.items()}
        found.append(one := score(factors, 0, seeds))
        study.tell(trial, one.score, state=None if one.score is not None else optuna.trial.TrialState.FAIL)
        said = one.why if one.score is None else f"{one.score:.4g}"
        on_line(f"{number + 1} of {trials}: {_words(one.factors)}: {said}")
    ranked = sorted((one for one in found if one.score is not None), key=_rank)[:FINALISTS]
    again = [score(one.factors, seeds, 2 * seeds) for one in (*ranked, as_it_is)]
    best = min(again, key=_rank).factors
    on_line(f"judged on {JUDGED} other seeds: {_words(best)}")
    before, after = (driven(factors, held_out_seeds(JUDGED)) for factors in (original, best))
    types, file = changed_types(asked.files, best), folder / CONFIGURATION
    calibrated = Calibrated(best, types, before, after, found, file)
    _write(asked, best, file)
    about = {**asked.about(), "seed": seed, "seeds": {"trial": seeds, "judged": JUDGED}}
    write_whole(
        folder / CALIBRATION,
        to_json({**about, **facts(calibrated), "manifest": {**manifest(), "starts": tried.starts}}, indent=1),
    )
    return calibrated


def facts(found: Calibrated) -> dict[str, Any]:
    """Return what a calibration found, as JSON."""
    return {
        "factors": found.factors,
        "types": found.types,
        "agreement": {
            name: {column: asdict(one) for column, one in columns.items()}
            for name, columns in found.estimates().items()
        },
        "rows": {
            "original": list(map(asdict, found.original)),
            "calibrated": list(map(asdict, found.calibrated)),
        },
        "trials": list(map(asdict, found.trials)),
    }


def _rank(trial: CalibrationTrial) -> float:
    return inf if trial.score is None else trial.score


def _words(factors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} x {value:g}" for name, value in factors.items())


def _write(asked: Corridor, factors: Factors, file: Path) -> Path:
    return write_changed(asked.files, changed_types(asked.files, factors), factors.get(FLOWS, 1.0), file)
