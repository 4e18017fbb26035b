"""Search for the best settings of a training with Optuna (`unjam search`).

The objective is the validation return, by which a training also selects its controller; test seeds are not used.
"""

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from optuna import Study, create_study
from optuna.distributions import CategoricalDistribution
from optuna.samplers import TPESampler
from optuna.trial import TrialState, create_trial

from unjam.errors import DiskError, InputError, UnjamError, invalid_value
from unjam.files import atomic_write, changed_file_error, to_json
from unjam.learners.settings import unused_tables
from unjam.manifest import manifest
from unjam.parameters import merge_changes, nest_keys
from unjam.reports.results import read_progress, validation_gains
from unjam.text import format_count
from unjam.training.config import CONFIG_FILE, RunConfig, load_config, to_toml
from unjam.training.executors import CommandLine, Executor, MessageCallback, open_executor, training_command
from unjam.training.fingerprint import fingerprint
from unjam.training.run_folder import check_config, read_complete_progress
from unjam.training.search_space import SearchSpace, boundary_values
from unjam.training.trial_log import TRIALS_FILE, TrialLog

SEARCH_FILE, BEST_CONFIG_FILE = "search.json", "best.toml"
MESSAGE_INTERVAL = 30.0
"""time without a message after which the progress of trainings is shown [s]"""
TRIAL_FAILURE_CODES = (UnjamError.exit_code, InputError.exit_code)
"""exit codes of failed trials; after other codes, such as the code of a full disk, a trial is resumed"""


def check_search_space(base: RunConfig, space: SearchSpace) -> None:
    """Raise `InputError` for an unknown key, a value out of range, or a configuration without validations."""
    if base.evaluation.validation_interval == 0:
        raise invalid_value("evaluation.validation_interval", 0, ">= 1: trials are compared by validations")
    for key, distribution in space.items():
        for value in boundary_values(distribution):
            check_config(trial_config(base, {key: value}))


def trial_config(base: RunConfig, values: dict[str, Any]) -> RunConfig:
    """Return the base configuration with the values of a trial; keys may have dots."""
    unused = unused_tables(values.get("agent", base.agent))
    base_values = {key: value for key, value in asdict(base).items() if key not in unused}
    return load_config(changes=merge_changes(base_values, nest_keys(values)))


@dataclass(frozen=True)
class SearchTrial:
    """A training of a search."""

    number: int
    values: dict[str, Any]
    folder: Path
    gain: float | None
    """validation return of the best controller minus that of the expert; None if the training failed"""
    last_gain: float | None
    """the same for the last validation"""


def search(
    base: RunConfig,
    space: SearchSpace,
    trials: int,
    folder: Path,
    workers: int,
    executor: Executor = "local",
    on_message: MessageCallback = lambda line: None,
) -> list[SearchTrial]:
    """Train with settings that Optuna proposes, `workers` at once, and return all trials, the best first.

    The folder gets `search.json`, and `best.toml` for `unjam train --config`. An interrupted search resumes, also with
    more `trials` in total. `base` and `space` must pass `check_search_space`. Raise `InputError` if the folder has
    another search, and `UnjamError` if all trainings failed, or if a training was stopped and can be resumed.
    """
    files = _file_hashes(base, space)
    log = TrialLog(folder, {"config": asdict(base), "space": repr(space), "files": files})
    atomic_write(folder / CONFIG_FILE, to_toml(base))  # marks the folder: files in it may only name trusted code
    study = _restore_study(log, space)
    proposals = _propose_trials(study, log, space, trials, base.seed)
    with open_executor(executor, workers) as start:
        trial_by_future: dict[Future[int], int] = {}
        while True:
            for number, values in islice(proposals, workers - len(trial_by_future)):
                trial_by_future[start(_trial_command(base, folder, number, values))] = number
            if not trial_by_future:
                break
            done_futures = wait(trial_by_future, MESSAGE_INTERVAL, FIRST_COMPLETED).done
            if not done_futures:
                on_message(_running_line(folder, trial_by_future.values(), base.steps))
            for future in done_futures:
                number = trial_by_future.pop(future)
                if changed := {name for name, _ in files.items() ^ _file_hashes(base, space).items()}:
                    raise changed_file_error(min(changed))
                exit_code = future.result()
                if exit_code not in (0, *TRIAL_FAILURE_CODES):  # such as a full disk, which concerns all trials
                    log_file = _log_file(folder, number)
                    reason = f"trial {number} was stopped with exit code {exit_code}; its log: {log_file}"
                    raise (DiskError if exit_code == DiskError.exit_code else UnjamError)(reason)
                objective = _objective(_trial_folder(folder, number), space) if exit_code == 0 else None
                log.append({"trial": number, "objective": objective})
                study.tell(number, objective, state=TrialState.FAIL if objective is None else None)
                on_message(_progress_line(study, number, trials))
    ended = study.get_trials()
    ended.sort(key=lambda trial: -math.inf if trial.value is None else trial.value, reverse=True)
    results = [_make_trial(folder, trial.number, trial.params, trial.value is None) for trial in ended]
    rows = [
        {
            "trial": trial.number,
            "gain": trial.gain,
            "last_gain": trial.last_gain,
            "folder": str(trial.folder),
            **trial.values,
        }
        for trial in results
    ]
    atomic_write(folder / SEARCH_FILE, to_json({"manifest": manifest(), "trials": rows}, indent=1))
    if results[0].gain is None:
        raise UnjamError(
            f"no training of {format_count(len(results), 'trial')} ended; their logs are in {folder / 'configs'}"
        )
    atomic_write(folder / BEST_CONFIG_FILE, to_toml(trial_config(base, results[0].values)))
    return results


def _file_hashes(base: RunConfig, space: SearchSpace) -> dict[str, str]:
    """Return the hashes of all experts and files of the user that a trial may use."""
    choices = {key: values.choices for key, values in space.items() if isinstance(values, CategoricalDistribution)}
    configs = [base, *(trial_config(base, {key: value}) for key, values in choices.items() for value in values)]
    return {name: sha256 for config in configs for name, sha256 in fingerprint(config)["files"].items()}


def _make_trial(folder: Path, number: int, values: dict[str, Any], has_failed: bool) -> SearchTrial:
    trial_folder = _trial_folder(folder, number)
    gains = None if has_failed else validation_gains(read_complete_progress(trial_folder))
    return SearchTrial(number, values, trial_folder, *(gains or (None, None)))


def _trial_folder(folder: Path, number: int) -> Path:
    return folder / "trials" / f"{number:04d}"


def _trial_command(base: RunConfig, folder: Path, number: int, values: dict[str, Any]) -> CommandLine:
    config = trial_config(base, values)
    short_evaluation = replace(config.evaluation, baselines=(), episodes=1)  # a search does not use test seeds
    log = _log_file(folder, number)
    config = replace(config, workers=1, evaluation=short_evaluation)
    return training_command(config, _trial_folder(folder, number), log.with_suffix(".toml"), log)


def _log_file(folder: Path, number: int) -> Path:
    return folder / "configs" / f"{number:04d}.log"


def _restore_study(log: TrialLog, space: SearchSpace) -> Study:
    """Return the study with the trials of earlier calls, including interrupted trials."""
    proposals = [row["values"] for row in log.rows if "values" in row]
    study = create_study(direction="maximize")
    if [row.get("proposal") for row in log.rows if "values" in row] != [*range(len(proposals))]:
        raise InputError(f"out: {TRIALS_FILE} does not have all trials; allowed: a new folder")
    try:
        objectives = {row["trial"]: row["objective"] for row in log.rows if "trial" in row}
        for number, values in enumerate(proposals):
            value = objectives.get(number)
            ended_state = TrialState.FAIL if value is None else TrialState.COMPLETE
            state = ended_state if number in objectives else TrialState.RUNNING
            study.add_trial(create_trial(state=state, value=value, params=values, distributions=dict(space)))
    except (ValueError, TypeError, LookupError, AttributeError):  # a text outside the space may name code
        raise InputError(f"out: {TRIALS_FILE} has a trial outside the search space; allowed: a new folder") from None
    return study


def _propose_trials(
    study: Study, log: TrialLog, space: SearchSpace, trials: int, seed: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number and values of interrupted trials, then of new trials, up to a total number of `trials`."""
    stored = study.get_trials()
    yield from ((trial.number, trial.params) for trial in stored if not trial.state.is_finished())
    for number in range(len(stored), trials):
        study.sampler = TPESampler(seed=seed + 1_000_003 * number)  # an interrupted search proposes the same trials
        values = study.ask(dict(space)).params
        log.append({"proposal": number, "values": values})
        yield number, values


def validation_gain(folder: Path) -> float | None:
    """Return the best validation return of a training minus that of its expert; None without validations.

    Raise `InputError` if rows of progress before the newest checkpoint are missing.
    """
    gains = validation_gains(read_complete_progress(folder))
    return gains and gains[0]


def _objective(folder: Path, space: SearchSpace) -> float | None:
    """Return the objective of a trial: the gain, or the return if experts vary, which have different gains."""
    gain = validation_gain(folder)
    if gain is None or "expert" not in space:
        return gain
    return max(gain, 0.0) + float(read_progress(folder)[0]["return_expert"] or 0.0)


def describe_trial(trial: SearchTrial) -> str:
    """Return a line with the gains of the selected controller and of the last checkpoint, and the values of a trial."""
    values = ", ".join(f"{key}={value}" for key, value in trial.values.items())
    if trial.gain is None or trial.last_gain is None:
        return f"trial {trial.number}: failed: {values}"
    untrained = "" if trial.gain > 0 else " (the controller is the untrained network)"
    last = f"last checkpoint {trial.last_gain:+.1f}"
    return f"trial {trial.number}: validation gain over expert {trial.gain:+.1f}, {last}{untrained}: {values}"


def _running_line(folder: Path, numbers: Iterable[int], total_steps: int) -> str:
    last_rows = {number: read_progress(_trial_folder(folder, number))[-1:] for number in numbers}
    texts = (f"trial {number} {rows[0]['environment_steps'] if rows else 0:,}" for number, rows in last_rows.items())
    return f"steps of {total_steps:,}: {', '.join(texts)}"


def _progress_line(study: Study, number: int, trials: int) -> str:
    study_trials = study.get_trials(deepcopy=False)
    trial, ended_count = study_trials[number], sum(trial.state.is_finished() for trial in study_trials)
    values = ", ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in trial.params.items()
    )
    result = "failed" if trial.value is None else f"{trial.value:+.1f}"
    return f"{ended_count} of {trials}: trial {number}: {values}: {result}"
