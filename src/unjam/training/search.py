"""Search for the settings with which a training learns best. `unjam search`, with Optuna.

Each trial is a training in its own folder. Its objective is the validation return, which also selects the controller of
a training; test seeds are not used.
"""

import json
import math
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unjam.errors import InputError, UnjamError, import_optional, invalid_value
from unjam.files import append_line, atomic_write, read_json_lines, to_json
from unjam.manifest import manifest
from unjam.parameters import merge_changes, nest_keys
from unjam.reports.results import read_progress, validation_gains
from unjam.training.config import RunConfig, load_config, to_toml
from unjam.training.executors import CommandLine, Executor, MessageCallback, open_executor, training_command
from unjam.training.run_folder import check_config, make_new_folder, read_config
from unjam.training.search_space import Categorical, NumericRange, SearchSpace, suggest_values

if TYPE_CHECKING:
    from optuna import Study

SEARCH_CONFIG_FILE, SEARCH_FILE, BEST_CONFIG_FILE = "config.toml", "search.json", "best.toml"
JOURNAL_FILE = "journal.log"
"""Optuna's log of the trials"""


def check_search_space(base: RunConfig, space: SearchSpace) -> None:
    """Raise `InputError` for an unknown key, a value out of range, and without validations."""
    if base.evaluation.validation_interval == 0:
        raise invalid_value("evaluation.validation_interval", 0, ">= 1: trials are compared by validations")
    for key, values in space.items():
        for value in values.boundary_values:
            check_config(trial_config(base, {key: value}))


def trial_config(base: RunConfig, values: dict[str, Any]) -> RunConfig:
    """Return a configuration with some values changed; keys may have dots."""
    return load_config(changes=merge_changes(asdict(base), nest_keys(values)))


@dataclass(frozen=True)
class SearchTrial:
    """A training of a search."""

    number: int
    values: dict[str, Any]
    folder: Path
    gain: float | None
    """validation return of the best controller minus that of the expert; None if it failed"""
    last_gain: float | None
    """gain of the last checkpoint"""


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
    more `trials`, which include those of earlier calls. `base` and `space` must pass `check_search_space`; `on_message`
    is called with a line when a training has ended.

    Raises:
        InputError: the folder has another search.
        MissingPartError: Optuna is not installed.
        UnjamError: all trainings failed.
    """
    study = _open_study(base, space, folder)
    proposed = _propose_trials(study, space, trials)
    with open_executor(executor, workers) as start:
        jobs: dict[Future[int], int] = {}
        while True:
            for number, values in islice(proposed, workers - len(jobs)):
                jobs[start(_trial_command(base, folder, number, values))] = number
            if not jobs:
                break
            for done in wait(jobs, return_when=FIRST_COMPLETED).done:
                number = jobs.pop(done)
                has_failed = done.result() != 0
                _report_gain(study, number, None if has_failed else _objective(_trial_folder(folder, number), space))
                on_message(_progress_line(study, number, trials))
    ended = study.get_trials()
    ended.sort(key=lambda one: -math.inf if one.value is None else one.value, reverse=True)
    results = [_make_trial(folder, one.number, one.params, one.value is None) for one in ended]
    rows = [
        {"trial": one.number, "gain": one.gain, "last_gain": one.last_gain, "folder": str(one.folder), **one.values}
        for one in results
    ]
    atomic_write(folder / SEARCH_FILE, to_json({"manifest": manifest(), "trials": rows}, indent=1))
    if results[0].gain is None:
        raise UnjamError(f"all {len(results)} trainings failed; their logs are in {folder / 'configs'}")
    atomic_write(folder / BEST_CONFIG_FILE, to_toml(trial_config(base, results[0].values)))
    return results


def _make_trial(folder: Path, number: int, values: dict[str, Any], has_failed: bool) -> SearchTrial:
    trial_folder = _trial_folder(folder, number)
    gains = None if has_failed else validation_gains(read_progress(trial_folder))
    return SearchTrial(number, values, trial_folder, *(gains or (None, None)))


def _trial_folder(folder: Path, number: int) -> Path:
    return folder / "trials" / f"{number:04d}"


def _trial_command(base: RunConfig, folder: Path, number: int, values: dict[str, Any]) -> CommandLine:
    """Return the command line of a trial."""
    config = trial_config(base, values)
    short_evaluation = replace(config.evaluation, baselines=(), episodes=1)  # test seeds do not count in a search
    config_file, log = (folder / "configs" / f"{number:04d}{suffix}" for suffix in (".toml", ".log"))
    config = replace(config, workers=1, evaluation=short_evaluation)
    return training_command(config, _trial_folder(folder, number), config_file, log)


def import_optuna() -> Any:
    """Return Optuna with only its warnings; raise `MissingPartError` if it is not installed."""
    optuna = import_optional("optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _open_study(base: RunConfig, space: SearchSpace, folder: Path) -> "Study":
    optuna = import_optuna()
    from optuna.storages import JournalStorage

    if not (folder / SEARCH_CONFIG_FILE).is_file():
        make_new_folder(folder, ", or that of a search")
    elif read_config(folder, check_trust=False) != base:
        raise InputError(f"out: {str(folder)!r} has another configuration; allowed: a new folder")
    atomic_write(folder / SEARCH_CONFIG_FILE, to_toml(base))
    storage = JournalStorage(Journal(folder / JOURNAL_FILE))  # pyright: ignore[reportArgumentType]
    study = optuna.create_study(storage=storage, study_name="search", direction="maximize", load_if_exists=True)
    # A new sampler with the same seed would repeat earlier proposals.
    study.sampler = optuna.samplers.TPESampler(seed=base.seed + 1_000_003 * len(study.get_trials()))
    before = study.user_attrs.get("space")
    if before is not None and before != repr(space):
        raise InputError(f"vary: {str(folder)!r} has other ranges; allowed: a new folder")
    study.set_user_attr("space", repr(space))
    return study


class Journal:
    """Optuna's log of a study, as `optuna.storages.journal.BaseJournalBackend`; the search's folder must be locked.

    Optuna's own class follows symbolic links, and leaves one as its lock.
    """

    def __init__(self, path: Path) -> None:
        """Read the file, which may be missing; an incomplete line of a crash is left out."""
        self._path, self._lines = path, list(map(_json_line, read_json_lines(path)))
        if path.is_file():
            atomic_write(path, "".join(f"{line}\n" for line in self._lines))

    def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
        """Return the entries of the log from a number on."""
        return map(json.loads, self._lines[log_number_from:])

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Add entries to the log; they are on the disk when this returns."""
        lines = list(map(_json_line, logs))
        append_line(self._path, "\n".join(lines))
        self._lines += lines


def _json_line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, separators=(",", ":"))


def _propose_trials(study: "Study", space: SearchSpace, trials: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number and values of interrupted trials, then of new ones, up to a total number."""
    for stored in study.get_trials():
        for key, value in stored.params.items():
            _check_in_space(key, value, space.get(key))
        if stored.state.name == "WAITING":
            raise InputError(f"out: {JOURNAL_FILE} has a trial that was not started by a search; allowed: a new folder")
        if stored.state.is_finished():
            continue
        if stored.state.name == "RUNNING" and stored.params.keys() == space.keys():
            yield stored.number, stored.params
        else:
            _report_gain(study, stored.number, None)  # it was interrupted before it had all its values
    while len(study.get_trials(deepcopy=False)) < trials:
        trial = study.ask()
        yield trial.number, suggest_values(trial, space)


def _check_in_space(key: str, value: Any, values: NumericRange | Categorical | None) -> None:
    """Raise `InputError` if a stored value is not in the search space, because a text may name code."""
    if values is None or (not isinstance(value, int | float) and value not in values.boundary_values):
        raise InputError(f"out: {key}: {value!r} in {JOURNAL_FILE} is not in the search space; allowed: a new folder")


def _report_gain(study: "Study", number: int, gain: float | None) -> None:
    from optuna.trial import TrialState

    if gain is None or not math.isfinite(gain):
        study.tell(number, state=TrialState.FAIL)
    else:
        study.tell(number, gain)


def validation_gain(folder: Path) -> float | None:
    """Return the best validation return of a training minus that of its expert; None without validations."""
    gains = validation_gains(read_progress(folder))
    return gains and gains[0]


def _objective(folder: Path, space: SearchSpace) -> float | None:
    """Return the objective of a search: the gain or, because gains over different experts differ, the return."""
    gain = validation_gain(folder)
    if gain is None or "expert" not in space:
        return gain
    return max(gain, 0.0) + float(read_progress(folder)[0]["return_expert"] or 0.0)


def describe_trial(trial: SearchTrial) -> str:
    """Return the gains of a trial as text: of the selected controller and of the last checkpoint."""
    values = ", ".join(f"{key}={value}" for key, value in trial.values.items())
    if trial.gain is None or trial.last_gain is None:
        return f"trial {trial.number}: failed: {values}"
    untrained = "" if trial.gain > 0 else " (the controller is the untrained network)"
    last = f"last checkpoint {trial.last_gain:+.1f}"
    return f"trial {trial.number}: validation gain over expert {trial.gain:+.1f}, {last}{untrained}: {values}"


def _progress_line(study: "Study", number: int, trials: int) -> str:
    stored = study.get_trials(deepcopy=False)
    trial, ended = stored[number], sum(one.state.is_finished() for one in stored)
    values = ", ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in trial.params.items()
    )
    result = "failed" if trial.value is None else f"{trial.value:+.1f}"
    return f"{ended} of {trials}: trial {number}: {values}: {result}"
