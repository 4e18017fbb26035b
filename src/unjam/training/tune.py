"""Tuning of an expert's parameters with the environment steps of a training, as a baseline for trained controllers.

Infeasible settings have no score, and settings with too large a string gain are not tried.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from optuna import create_study
from optuna.samplers import TPESampler
from optuna.trial import Trial, TrialState

from unjam.controller.file import SUFFIX, controller_bytes
from unjam.drivers.driver import label_with_parameters
from unjam.drivers.registry import driver_from_name
from unjam.drivers.user_driver import is_file_reference
from unjam.errors import InputError, UnjamError, invalid_value, raise_failure, unknown_name
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.feasibility import FEASIBLE, HARD_BRAKING_METRIC, overall_feasibility
from unjam.measures.gain import MEAN_GAIN_OBJECTIVE, EpisodeRows, normalized_gain, performance_bound
from unjam.measures.metrics import measure
from unjam.scenarios import scenario_recipe
from unjam.scenarios.file_watch import watch_files
from unjam.scenarios.scenario import Scenario
from unjam.seeds import tuning_seeds
from unjam.training.fingerprint import file_hashes
from unjam.training.run_folder import controller_origin
from unjam.training.search_space import SearchSpace, tunable_parameters
from unjam.training.string_limit import find_operating_points
from unjam.training.trial_log import TrialLog, TrialScore, TuningTrial
from unjam.worlds.backend import check_support, open_backend
from unjam.worlds.batch.run import run_batch, run_batches
from unjam.worlds.batch.support import required_batch_kind, statistically_unsupported_reason, unsupported_reason
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

TUNING_FILE = "tuned.json"
TUNING_EPISODES = 8
TUNING_EPISODES_PER_ROAD = 2
TUNING_FINALISTS = 5
"""number of best trials that run again on twice as many other seeds, because the best trial is partly lucky"""
MAX_REFUSED_SETTINGS = 60
"""number of consecutive settings with too large string gains, after which the tuning fails"""
SCREENING_BATCH_SIZE = 8
"""number of trials that are screened together, each on its own rings"""
STRING_GAIN_SEED = -1
"""placeholder for the first seed in log entries of string gains, which need no episode"""

TuningRunner = Callable[[list[list[EpisodeTask]]], list[EpisodeRows]]
"""runs the tasks of each driver on a road, in SUMO or in a batch, and returns the rows of each driver"""


@dataclass(frozen=True)
class TuningResult:
    """Result of a tuning."""

    best: TuningTrial
    """the best finalist"""
    default: TuningTrial
    """the expert with default parameters, on the seeds of the finalists"""
    trials: list[TuningTrial]
    environment_steps: int
    """control steps in SUMO"""
    batch_steps: int
    """control steps in batches"""
    file: Path | None
    """the tuned controller; None for a class `path.py:name`, because a controller file must not run code"""

    @property
    def driver(self) -> str:
        """Name of the tuned driver for the option `--driver`."""
        return str(self.file or self.best.driver)


def invalid_reason(driver: str) -> str:
    """Return why a driver cannot be made, for example with contradictory parameters, or an empty text."""
    try:
        driver_from_name(driver, 1.0)
    except InputError as error:
        return str(error)
    return ""


class SettingSampler:
    """Proposes settings of an expert with Optuna's TPE, which learns from scores and from refused settings."""

    def __init__(
        self,
        expert: str,
        space: SearchSpace,
        seed: int,
        string_gain: Callable[[str], float],
        max_string_gain: float = 0.0,
    ) -> None:
        """Start a study; `string_gain` returns the string gain of a named driver, and is not called without a limit."""
        self._expert, self._space = expert, space
        self._string_gain, self._max_string_gain = string_gain, max_string_gain
        self._study = create_study(direction="maximize", sampler=TPESampler(seed=seed, multivariate=True))

    def ask(self, count: int) -> list[tuple[Trial, dict[str, Any]]]:
        """Return new settings; raise `UnjamError` if too many consecutive settings have too large a string gain."""
        accepted: list[tuple[Trial, dict[str, Any]]] = []
        refused: list[float] = []
        while len(accepted) < count:
            trial = self._study.ask(dict(self._space))
            values = {
                key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in trial.params.items()
            }
            if self._max_string_gain and not self._accept_or_refuse(trial, values, refused):
                continue
            accepted.append((trial, values))
            refused = []
        return accepted

    def tell(self, trial: Trial, score: float | None) -> None:
        """Report the score of a setting, or None if the setting is infeasible."""
        self._study.tell(trial, score, state=TrialState.FAIL if score is None else None)

    def _accept_or_refuse(self, trial: Trial, values: dict[str, Any], refused: list[float]) -> bool:
        """Return whether the string gain of a setting is allowed; if not, tell Optuna, and extend `refused`."""
        driver = label_with_parameters(self._expert, values)
        gain = 0.0 if invalid_reason(driver) else self._string_gain(driver)
        trial.set_constraint("excess_gain", gain - self._max_string_gain)
        if gain <= self._max_string_gain:
            return True
        self._study.tell(trial, 0.0)
        refused.append(gain)
        if len(refused) == MAX_REFUSED_SETTINGS:
            reason = f"{len(refused)} settings of {self._expert} in a row have a string gain of at least"
            allowed = f"allowed: at most {self._max_string_gain:g}, or another expert, such as smooth-acc"
            raise UnjamError(f"tune: {reason} {min(refused):.3g}; {allowed}")
        return False


def tune(
    roads: Mapping[str, Scenario],
    expert: str,
    space: SearchSpace,
    steps: int,
    folder: Path,
    workers: WorkerPool,
    reward: str = "",
    seed: int = 0,
    backend: str = "sumo",
    on_message: Callable[[str], None] = lambda line: None,
    screen: bool | None = False,
    max_string_gain: float = 0.0,
) -> TuningResult:
    """Search the parameters of an expert, and write `tuned.json` and the expert as `EXPERT.unjam` into a folder.

    The trials are stored in the folder: an interrupted tuning resumes with the same result. On one road, the objective
    is the return. On several roads, it is the mean normalized gain, which is zero on roads where the driver cannot run.

    Args:
        roads: scenarios by name, with their limits and filters.
        expert: name of a driver, or a class `path.py:name` with defaults for all parameters.
        steps: total budget of control steps.
        reward: objective on one road; empty: the reward of the scenario.
        seed: seed of the proposals.
        screen: whether trials run in batches on roads that support this (on several roads: exactly), and only the
            finalists and the default in SUMO; None: if any road supports this. Not with another backend than SUMO.
        max_string_gain: settings with a larger string gain on a closed road are not tried; 0: no limit.

    Raises:
        InputError: too few steps, a wrong parameter, no road that supports batches, or a folder of another tuning.
        UnjamError: all trials are infeasible, or too many consecutive settings have too large string gains.
    """
    parameters = tunable_parameters(expert, 1.0)
    for name in space:
        if name not in parameters:
            raise unknown_name("vary", name, parameters)
    is_single = len(roads) == 1
    episodes = TUNING_EPISODES if is_single else TUNING_EPISODES_PER_ROAD
    trial_steps = episodes * sum(scenario.max_episode_steps for scenario in roads.values())
    # On several roads the human baseline runs as often as a trial and a finalist.
    final_steps = (TUNING_FINALISTS + 1) * 2 * trial_steps + (0 if is_single else 3 * trial_steps)
    trial_count = (steps - final_steps) // trial_steps
    if trial_count < 2:
        raise InputError(f"steps: {steps} is not allowed; allowed: >= {final_steps + 2 * trial_steps} for two settings")
    find_reason = statistically_unsupported_reason if is_single else unsupported_reason
    with open_backend(backend) as simulator:
        check_support(simulator, *roads.values())
    backend_reason = "" if backend == "sumo" else f"trials run in {backend}"
    reasons = {road: backend_reason or find_reason(scenario) for road, scenario in roads.items()}
    if max_string_gain and not any(scenario.is_closed for scenario in roads.values()):
        raise invalid_value("max_string_gain", max_string_gain, f"0 on {next(iter(roads))}: it is no closed road")
    if screen and all(reasons.values()):
        raise InputError(f"screen: {next(iter(reasons.values()))}")
    batch_roads = [road for road, reason in reasons.items() if screen is not False and not reason]
    recipes = {road: scenario_recipe(scenario) for road, scenario in roads.items()}
    request = {"roads": recipes, "expert": expert, "space": repr(space), "steps": steps, "reward": reward}
    files = file_hashes([expert, reward, backend], *roads.values())
    request |= {"files": files} if files else {}
    request |= {"max_string_gain": max_string_gain} if max_string_gain else {}
    log = TrialLog(folder, request | {"seed": seed, "screen": bool(batch_roads), "backend": backend})
    watch = watch_files(roads.values(), expert, reward, backend)
    operating_points = find_operating_points(roads, workers) if max_string_gain else {}
    sumo_runners = dict.fromkeys(roads, partial(_run_in_sumo, workers))
    trial_runners = sumo_runners | dict.fromkeys(batch_roads, _run_in_batch)

    @cache
    def human_rows(first: int, count: int) -> dict[str, EpisodeRows]:
        return {} if is_single else _run_drivers(roads, ["human"], first, count, (reward, backend), sumo_runners)[0]

    def score_settings(
        settings: list[dict[str, Any]], first: int, count: int, runners: Mapping[str, TuningRunner]
    ) -> list[TuningTrial]:
        drivers = [label_with_parameters(expert, values) for values in settings]
        verdicts: dict[str, TrialScore] = {name: (None, why) for name in drivers if (why := invalid_reason(name))}
        new = [name for name in dict.fromkeys(drivers) if name not in verdicts and (first, name) not in log.verdicts]
        for driver, rows in zip(new, _run_drivers(roads, new, first, count, (reward, backend), runners), strict=True):
            watch.check()
            log.add(first, driver, _score_rows(rows, human_rows(first, count)))
        verdicts |= {name: log.verdicts[first, name] for name in drivers if name not in verdicts}
        return [TuningTrial(name, values, *verdicts[name]) for name, values in zip(drivers, settings, strict=True)]

    def string_gain(driver: str) -> float:
        key = STRING_GAIN_SEED, driver
        if key not in log.verdicts:
            gains = [
                point.string_gain(driver_from_name(driver, point.road.control_step))
                for point in operating_points.values()
            ]
            log.add(*key, (max(gains, default=0.0), "largest string gain"))
        return log.verdicts[key][0] or 0.0

    def proposal_gain(driver: str) -> float:
        if (gain := string_gain(driver)) > max_string_gain:
            on_message(f"{driver}: not tried: a string gain of {gain:.4g}; allowed: at most {max_string_gain:g}")
        return gain

    trials: list[TuningTrial] = []
    sampler = SettingSampler(expert, space, seed, proposal_gain, max_string_gain)
    shares_batches = any(required_batch_kind(roads[road]).has_own_drivers for road in batch_roads)
    batch_size = SCREENING_BATCH_SIZE if screen or shares_batches else 1  # many trials take as long as few
    for first in range(0, trial_count, batch_size):
        proposals = sampler.ask(min(batch_size, trial_count - first))
        batch = score_settings([values for _, values in proposals], 0, episodes, trial_runners)
        for (proposal, _), trial in zip(proposals, batch, strict=True):
            sampler.tell(proposal, trial.score)
            trials.append(trial)
            result = trial.verdict if trial.score is None else f"{trial.score:.4g}"
            on_message(f"{len(trials)} of {trial_count}: {trial.driver}: {result}")
    ranked = sorted((trial for trial in trials if trial.score is not None), key=_ranking_score, reverse=True)
    best_values = list({trial.driver: trial.values for trial in ranked}.values())[:TUNING_FINALISTS]
    *finalists, default = score_settings([*best_values, {}], episodes, 2 * episodes, sumo_runners)
    is_default_allowed = not operating_points or string_gain(default.driver) <= max_string_gain
    if not is_default_allowed:
        gain = string_gain(default.driver)
        on_message(f"{default.driver}: not selected: a string gain of {gain:.4g}; allowed: at most {max_string_gain:g}")
    best = max((*finalists, default) if is_default_allowed else finalists, key=_ranking_score, default=None)
    if best is None or best.score is None:
        raise UnjamError(f"all {trial_count} settings of {expert} are infeasible: {default.verdict}")
    run_count = len({trial.driver for trial in trials if not invalid_reason(trial.driver)})
    batch_steps = run_count * episodes * sum(roads[road].max_episode_steps for road in batch_roads)
    unused_steps = (TUNING_FINALISTS - len(best_values)) * 2 * trial_steps
    sumo_steps = run_count * trial_steps + final_steps - unused_steps - batch_steps
    file = None if is_file_reference(expert) else folder / f"{expert}{SUFFIX}"
    result = TuningResult(best, default, trials, sumo_steps, batch_steps, file)
    recipe = next(iter(recipes.values())) if is_single else recipes
    scenario = next(iter(roads.values()))
    tuning = {
        "reward": reward or (scenario.reward if is_single else MEAN_GAIN_OBJECTIVE),
        "seed": seed,
        "environment_steps": sumo_steps,
        "batch_steps": batch_steps,
        "best": asdict(best),
        "default": asdict(default),
        **({"string_gain": string_gain(best.driver), "max_string_gain": max_string_gain} if operating_points else {}),
    }
    if file is not None:
        driver = driver_from_name(best.driver, scenario.control_step)
        atomic_write(file, controller_bytes(driver, {**controller_origin(scenario, driver), "tuning": tuning}))
    document = {
        "scenario": recipe,
        "expert": expert,
        **tuning,
        "manifest": {**manifest(), "starts": log.starts},
        "trials": [asdict(trial) for trial in trials],
    }
    atomic_write(folder / TUNING_FILE, to_json(document, indent=1))
    return result


def _ranking_score(trial: TuningTrial) -> float:
    return -inf if trial.score is None else trial.score


def _run_drivers(
    roads: Mapping[str, Scenario],
    drivers: Sequence[str],
    first: int,
    count: int,
    reward_and_backend: tuple[str, str],
    runners: Mapping[str, TuningRunner],
) -> list[dict[str, EpisodeRows]]:
    """Return the rows by road of each driver, given by name, on `count` tuning seeds from `first` on."""
    results: list[dict[str, EpisodeRows]] = [{} for _ in drivers]
    seeds, (reward, backend) = tuning_seeds(count, first), reward_and_backend
    for road, scenario in roads.items() if drivers else ():
        tasks = [
            [
                EpisodeTask(scenario.stratum(index, count), driver, seed, reward, backend=backend)
                for index, seed in enumerate(seeds)
            ]
            for driver in (driver_from_name(name, scenario.control_step) for name in drivers)
        ]
        for result, rows in zip(results, runners[road](tasks), strict=True):
            result[road] = rows
            raise_failure(rows)
    return results


def _run_in_sumo(workers: WorkerPool, tasks: list[list[EpisodeTask]]) -> list[EpisodeRows]:
    # Each episode is measured when it ends, because an episode of a motorway takes 80 MB of memory.
    rows = iter(workers.run_and_map([*chain(*tasks)], lambda index, episode: measure(episode)))
    return [[next(rows) for _ in driver_tasks] for driver_tasks in tasks]


def _run_in_batch(tasks: list[list[EpisodeTask]]) -> list[EpisodeRows]:
    all_tasks = [*chain(*tasks)]
    run = run_batches if required_batch_kind(all_tasks[0].scenario).has_own_drivers else run_batch
    episodes = iter(run(all_tasks, allow_statistical=True))
    return [[measure(next(episodes)) for _ in driver_tasks] for driver_tasks in tasks]


def _score_rows(rows_by_road: Mapping[str, EpisodeRows], human_rows: Mapping[str, EpisodeRows]) -> TrialScore:
    if human_rows:
        gains = {
            road: normalized_gain(rows, human_rows[road], [performance_bound(row) for row in human_rows[road]]).mean
            for road, rows in rows_by_road.items()
        }
        worst_road = min(gains, key=lambda road: gains[road])
        return float(np.mean(list(gains.values()))), f"worst on {worst_road}: {gains[worst_road]:+.2f}"
    (rows,) = rows_by_road.values()
    verdict = overall_feasibility([{**row, HARD_BRAKING_METRIC: 0.0} for row in rows])
    return float(np.mean([row["return"] for row in rows])) if verdict == FEASIBLE else None, verdict
