"""Tuning: how far an expert gets by its parameters alone, with as many actual steps as a training has.

What a training gains is judged beside this: `unjam tune`, with Optuna, on seeds of its own, under the same
limits and filter. Settings that no car could drive do not count.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.file import SUFFIX, controller_bytes
from unjam.drivers.driver import label_with_parameters
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, UnjamError, unknown_name
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.gain import MEAN_GAIN, EpisodeRows, normalized_gain, performance_bound
from unjam.measures.metrics import measure
from unjam.scenarios import scenario_recipe
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.scenario import Scenario
from unjam.training.evaluate import raise_failure
from unjam.training.fingerprint import file_hashes
from unjam.training.run_folder import controller_origin
from unjam.training.search import import_optuna
from unjam.training.search_space import SearchSpace
from unjam.training.seeds import tuning_seeds
from unjam.training.trial_log import TrialLog, TrialVerdict, TuningTrial
from unjam.worlds.batch.run import run_batch, run_batches
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

TUNING_FILE = "tuned.json"
TUNING_EPISODES = 8
"""of each setting that is tried"""
TUNING_EPISODES_PER_ROAD = 2
"""of these on each road, where there are several"""
TUNING_FINALISTS = 5
"""settings that are driven again, on twice as many other seeds: else the luckiest would win"""
SCREENING_BATCH_SIZE = 8
"""settings that are screened at once, each on rings of its own"""

TuningRunner = Callable[[list[list[EpisodeTask]]], list[EpisodeRows]]
"""runs the tasks of each driver on one road, in SUMO or in a batch, and measures their episodes"""


@dataclass(frozen=True)
class TuningResult:
    """What a tuning found."""

    best: TuningTrial
    default: TuningTrial
    """the expert as it is, on the seeds that chose among the finalists"""
    trials: list[TuningTrial]
    """all that were tried, in order"""
    environment_steps: int
    """driven in SUMO"""
    batch_steps: int
    """driven in batches, where settings were screened there"""
    file: Path
    """the tuned expert as a controller"""


def tune(
    roads: Mapping[str, Scenario],
    expert: str,
    space: SearchSpace,
    steps: int,
    folder: Path,
    workers: WorkerPool,
    reward: str = "",
    seed: int = 0,
    on_message: Callable[[str], None] = lambda line: None,
    screen: bool | None = False,
) -> TuningResult:
    """Search an expert's parameters, and write `tuned.json` and the expert as `EXPERT.unjam` into a folder.

    What was tried is kept there: a tuning that was stopped goes on where it was, and finds the same.

    On one road the return is maximised. On several it is the mean over the roads of the share that is gained
    of what people alone leave to be gained; who could not be driven on a road gains nothing there.

    Args:
        roads: by name; limits and filter are theirs.
        expert: its name.
        space: what is varied, of `default_search_space` or `search.parse_search_space`.
        steps: that may be driven in all.
        folder: new, empty, or that of this tuning.
        workers: drive; the result does not depend on how many.
        reward: what is maximised on one road; empty: the scenario's own.
        seed: of the proposals.
        on_line: gets a line for each setting.
        screen: whether settings are tried in batches where a road can be stepped so (of several: exactly),
            and there only the finalists, and the expert as it is, in SUMO; None: if there is one.

    Raises:
        InputError: the steps are too few, a parameter is wrong, no road can be stepped in a batch, or the
            folder holds something else.
        UnjamError: no car could drive any of the settings.
        MissingPartError: Optuna is not installed.
    """
    known = driver_from_name(expert, 1.0).recipe()["parameters"]
    for key in space:
        if key not in known:
            raise unknown_name("vary", key, known)
    episodes = TUNING_EPISODES if len(roads) == 1 else TUNING_EPISODES_PER_ROAD
    each = episodes * sum(scenario.horizon for scenario in roads.values())
    # People, who are the measure on several roads, drive as often as a setting and a finalist.
    final = (TUNING_FINALISTS + 1) * 2 * each + (3 * each if len(roads) > 1 else 0)
    trials = (steps - final) // each
    if trials < 2:
        raise InputError(f"steps: {steps} is not allowed; allowed: >= {final + 2 * each} for two settings")
    why_none = statistically_unsupported_reason if len(roads) == 1 else unsupported_reason
    reasons = {road: why_none(scenario) for road, scenario in roads.items()}
    if screen and all(reasons.values()):
        raise InputError(f"screen: {next(iter(reasons.values()))}")
    screened = [road for road, why in reasons.items() if screen is not False and not why]
    recipes = {road: scenario_recipe(scenario) for road, scenario in roads.items()}
    wanted = {"roads": recipes, "expert": expert, "space": repr(space), "steps": steps, "reward": reward}
    files = file_hashes([reward], *roads.values())
    wanted |= {"files": files} if files else {}
    tried = TrialLog(folder, wanted | {"seed": seed, "screen": bool(screened)})
    in_sumo = dict.fromkeys(roads, partial(_run_in_sumo, workers))
    trying = in_sumo | dict.fromkeys(screened, _run_in_batch)

    @cache
    def human_rows(first: int, count: int) -> dict[str, EpisodeRows]:
        return _run_drivers(roads, ["human"], first, count, reward, in_sumo)[0] if len(roads) > 1 else {}

    def score_settings(
        settings: list[dict[str, Any]], first: int, count: int, runners: Mapping[str, TuningRunner]
    ) -> list[TuningTrial]:
        texts = [label_with_parameters(expert, values) for values in settings]
        scores: dict[str, TrialVerdict] = {text: (None, why) for text in texts if (why := _invalid_reason(text))}
        unknown = [text for text in texts if text not in scores and (first, text) not in tried.verdicts]
        new = list(dict.fromkeys(unknown))
        for text, rows in zip(new, _run_drivers(roads, new, first, count, reward, runners), strict=True):
            tried.add(first, text, _score_rows(rows, human_rows(first, count)))
        scores |= {text: tried.verdicts[first, text] for text in texts if text not in scores}
        return [TuningTrial(text, values, *scores[text]) for text, values in zip(texts, settings, strict=True)]

    optuna, settings = import_optuna("tune"), list[TuningTrial]()
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    motorways = any(isinstance(roads[road], OnRamp) for road in screened)  # many take as long as few
    at_once = SCREENING_BATCH_SIZE if screen or motorways else 1
    for first in range(0, trials, at_once):
        asked = [study.ask() for _ in range(first, min(first + at_once, trials))]
        for trial in asked:
            for key, values in space.items():
                values.suggest(trial, key)
        proposed = [{key: _round_digits(value) for key, value in trial.params.items()} for trial in asked]
        found = score_settings(proposed, 0, episodes, trying)
        for trial, setting in zip(asked, found, strict=True):
            failed = None if setting.score is not None else optuna.trial.TrialState.FAIL
            study.tell(trial, setting.score, state=failed)
            settings.append(setting)
            said = setting.verdict if setting.score is None else f"{setting.score:.4g}"
            on_message(f"{len(settings)} of {trials}: {setting.driver}: {said}")
    able = [(one.score, one) for one in settings if one.score is not None]
    ranked = [one for _, one in sorted(able, key=lambda pair: pair[0], reverse=True)]
    different = {one.driver: one.values for one in ranked}
    best_values = list(different.values())[:TUNING_FINALISTS]
    *again, default = score_settings([*best_values, {}], episodes, 2 * episodes, in_sumo)
    finalists = [one for one in (*again, default) if one.score is not None]
    if not finalists:
        raise UnjamError(f"no car could drive any of {trials} settings of {expert}: {default.verdict}")
    best = max(finalists, key=lambda one: -inf if one.score is None else one.score)
    file = folder / f"{expert}{SUFFIX}"
    made = {setting.driver for setting in settings if not _invalid_reason(setting.driver)}
    imagined = len(made) * episodes * sum(roads[road].horizon for road in screened)
    unused = (TUNING_FINALISTS - len(best_values)) * 2 * each
    tuned = TuningResult(best, default, settings, len(made) * each + final - unused - imagined, imagined, file)
    _write_result(roads, expert, tuned, folder, reward, seed, tried.starts)
    return tuned


def _invalid_reason(driver: str) -> str:
    """Return why there is no such driver, as of parameters that do not go together; empty where there is."""
    try:
        driver_from_name(driver, 1.0)
    except InputError as error:
        return str(error)
    return ""


def _run_drivers(
    roads: Mapping[str, Scenario],
    drivers: Sequence[str],
    first: int,
    count: int,
    reward: str,
    runners: Mapping[str, TuningRunner],
) -> list[dict[str, EpisodeRows]]:
    """Return the rows of each driver, by road, each by its own of `run`, on tuning seeds from `first` on."""
    found: list[dict[str, EpisodeRows]] = [{} for _ in drivers]
    seeds = tuning_seeds(count, first)
    for road, scenario in roads.items() if drivers else ():
        tasks = [
            [EpisodeTask(scenario.stratum(part, count), made, number, reward) for part, number in enumerate(seeds)]
            for made in (driver_from_name(driver, scenario.control_step) for driver in drivers)
        ]
        for rows, measured in zip(found, runners[road](tasks), strict=True):
            rows[road] = measured
            raise_failure(measured)
    return found


def _run_in_sumo(workers: WorkerPool, tasks: list[list[EpisodeTask]]) -> list[EpisodeRows]:
    # Measured as they end: a motorway's whole episode takes 80 MB.
    rows = iter(workers.run_and_map([*chain(*tasks)], lambda index, episode: measure(episode)))
    return [[next(rows) for _ in each] for each in tasks]


def _run_in_batch(tasks: list[list[EpisodeTask]]) -> list[EpisodeRows]:
    import torch

    every = [*chain(*tasks)]
    if isinstance(every[0].scenario, OnRamp):
        driven = iter(run_batches(every, allow_statistical=True))
    else:
        numbers = torch.as_tensor if all(task.driver.accepts_tensors for task in every) else np.asarray
        driven = iter(run_batch(every, numbers, allow_statistical=True))
    return [[measure(next(driven)) for _ in each] for each in tasks]


def _score_rows(
    rows_by_road: Mapping[str, EpisodeRows], human_rows: Mapping[str, EpisodeRows]
) -> tuple[float | None, str]:
    """Return the score of what was driven, road by road, and the verdict."""
    if human_rows:
        gains = {
            road: normalized_gain(rows, human_rows[road], [performance_bound(row) for row in human_rows[road]])
            for road, rows in rows_by_road.items()
        }
        worst = min(gains, key=lambda road: gains[road].mean)
        mean = float(np.mean([each.mean for each in gains.values()]))
        return mean, f"worst on {worst}: {gains[worst].mean:+.2f}"
    (rows,) = rows_by_road.values()
    verdict = overall_feasibility([{**row, "human_braking_beyond_4_5": 0.0} for row in rows])
    return float(np.mean([row["return"] for row in rows])) if verdict == FEASIBLE else None, verdict


def _round_digits(value: Any) -> Any:
    """Return a number with as many digits as anybody wants to read; words as they are."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _write_result(
    roads: Mapping[str, Scenario],
    expert: str,
    result: TuningResult,
    folder: Path,
    reward: str,
    seed: int,
    starts: list[dict[str, Any]],
) -> None:
    recipes = {road: scenario_recipe(scenario) for road, scenario in roads.items()}
    scenario = next(iter(roads.values()))
    about = {
        "scenario": recipes if len(roads) > 1 else scenario_recipe(scenario),
        "expert": expert,
        "reward": reward or (scenario.reward if len(roads) == 1 else MEAN_GAIN),
        "seed": seed,
        "environment_steps": result.environment_steps,
        "batch_steps": result.batch_steps,
        "best": asdict(result.best),
        "default": asdict(result.default),
    }
    driver = driver_from_name(result.best.driver, scenario.control_step)
    tuned = {key: value for key, value in about.items() if key not in ("scenario", "expert")}
    content = controller_bytes(driver, {**controller_origin(scenario, driver), "tuning": tuned})
    atomic_write(result.file, content)
    rows = [asdict(one) for one in result.trials]
    atomic_write(
        folder / TUNING_FILE, to_json({**about, "manifest": {**manifest(), "starts": starts}, "trials": rows}, indent=1)
    )
