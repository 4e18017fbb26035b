"""Search: which settings learn best. `unjam search`, with Optuna.

Each trial is a training like any other, in a folder of its own. It is judged by the validation seeds, which
choose a training's controller anyway; the held-out ones stay unseen.
"""

import math
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unjam.errors import InputError, MissingPartError, UnjamError, invalid_value
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.parameters import merge_changes, nest_keys
from unjam.reports.results import read_progress, validation_gains
from unjam.training.config import RunConfig, load_config, to_toml
from unjam.training.executors import CommandLine, Executor, MessageCallback, open_executor, training_command
from unjam.training.run_folder import check_config, make_new_folder, read_config
from unjam.training.search_space import Categorical, NumericRange, SearchSpace

if TYPE_CHECKING:
    from optuna import Study

SEARCH_CONFIG_FILE, SEARCH_FILE, BEST_CONFIG_FILE = "config.toml", "search.json", "best.toml"
JOURNAL_FILE = "journal.log"
"""what Optuna remembers: which trials there were, and what became of them"""


def check_search_space(base: RunConfig, space: SearchSpace) -> None:
    """Raise `InputError` where a search cannot work: an unknown key, a value out of range, no validation."""
    if base.evaluation.validation_interval == 0:
        raise invalid_value("evaluation.validation_interval", 0, ">= 1: trials are judged by validations")
    for key, values in space.items():
        for end in values.boundary_values:
            check_config(trial_config(base, {key: end}))


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
    """return beyond the expert's on the validation seeds, of the best controller; None where it failed"""
    last_gain: float | None
    """the same of the last checkpoint"""


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

    The folder gets `search.json`, and `best.toml` for `unjam train --config`. A search that was stopped goes
    on where it was, and one that has ended goes on if `trials`, those of an earlier call included, is larger.
    `base` and `space` are checked with `check_search_space`; `on_line` gets a line when a training has ended.

    Raises:
        InputError: the folder holds another search.
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
                failed = done.result() != 0
                _report_gain(study, number, None if failed else _objective(_trial_folder(folder, number), space))
                on_message(_progress_line(study, number, trials))
    ended = study.get_trials()
    ended.sort(key=lambda one: -math.inf if one.value is None else one.value, reverse=True)
    found = [_make_trial(folder, one.number, one.params, one.value is None) for one in ended]
    rows = [
        {"trial": one.number, "gain": one.gain, "last_gain": one.last_gain, "folder": str(one.folder), **one.values}
        for one in found
    ]
    atomic_write(folder / SEARCH_FILE, to_json({"manifest": manifest(), "trials": rows}, indent=1))
    if found[0].gain is None:
        raise UnjamError(f"all {len(found)} trainings failed; what they said is in {folder / 'plans'}")
    atomic_write(folder / BEST_CONFIG_FILE, to_toml(trial_config(base, found[0].values)))
    return found


def _make_trial(folder: Path, number: int, values: dict[str, Any], has_failed: bool) -> SearchTrial:
    place = _trial_folder(folder, number)
    validated = None if has_failed else validation_gains(read_progress(place))
    return SearchTrial(number, values, place, *(validated or (None, None)))


def _trial_folder(folder: Path, number: int) -> Path:
    return folder / "trials" / f"{number:04d}"


def _trial_command(base: RunConfig, folder: Path, number: int, values: dict[str, Any]) -> CommandLine:
    """Return the command line of a trial."""
    config = trial_config(base, values)
    few = replace(config.evaluation, baselines=(), episodes=1)  # the held-out seeds decide nothing here
    plan, log = (folder / "configs" / f"{number:04d}{suffix}" for suffix in (".toml", ".log"))
    config = replace(config, workers=1, evaluation=few)
    return training_command(config, _trial_folder(folder, number), plan, log)


def import_optuna(command: str) -> Any:
    """Return Optuna, which says nothing but warnings; raise `MissingPartError` where it is not installed."""
    try:
        import optuna
    except ImportError:
        raise MissingPartError(f"{command}: optuna is not installed: pip install optuna") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _open_study(base: RunConfig, space: SearchSpace, folder: Path) -> "Study":
    optuna = import_optuna("search")
    from optuna.storages import JournalStorage

    from unjam.training.journal import Journal

    known = (folder / SEARCH_CONFIG_FILE).is_file()
    if not known:
        make_new_folder(folder, ", or that of a search")
    if known and read_config(folder, check_trust=False) != base:
        raise InputError(f"out: {str(folder)!r} is of another configuration; allowed: a new folder")
    atomic_write(folder / SEARCH_CONFIG_FILE, to_toml(base))
    storage = JournalStorage(Journal(folder / JOURNAL_FILE))
    study = optuna.create_study(storage=storage, study_name="search", direction="maximize", load_if_exists=True)
    # Who begins anew with the same seed would propose again what it has proposed before.
    study.sampler = optuna.samplers.TPESampler(seed=base.seed + 1_000_003 * len(study.get_trials()))
    before = study.user_attrs.get("space")
    if before is not None and before != repr(space):
        raise InputError(f"vary: {str(folder)!r} is of other ranges; allowed: a new folder")
    study.set_user_attr("space", repr(space))
    return study


def _propose_trials(study: "Study", space: SearchSpace, trials: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number and values of what is to be tried: what was stopped, then new ones, so many in all."""
    for stored in study.get_trials():
        for key, value in stored.params.items():
            _check_in_space(key, value, space.get(key))
        if stored.state.name == "WAITING":
            raise InputError(f"out: {JOURNAL_FILE} holds a trial that no search began; allowed: a new folder")
        if stored.state.is_finished():
            continue
        if stored.state.name == "RUNNING" and stored.params.keys() == space.keys():
            yield stored.number, stored.params
        else:
            _report_gain(study, stored.number, None)  # it was stopped before it had all its values
    while len(study.get_trials(deepcopy=False)) < trials:
        trial = study.ask()
        for key, values in space.items():
            values.suggest(trial, key)
        yield trial.number, {key: trial.params[key] for key in space}


def _check_in_space(key: str, value: Any, values: NumericRange | Categorical | None) -> None:
    """Raise `InputError` where a value that a folder holds was not offered: a text may name code."""
    if values is None or (not isinstance(value, int | float) and value not in values.boundary_values):
        raise InputError(f"out: {key}: {value!r} in {JOURNAL_FILE} was not offered; allowed: a new folder")


def _report_gain(study: "Study", number: int, gain: float | None) -> None:
    from optuna.trial import TrialState

    if gain is None or not math.isfinite(gain):
        study.tell(number, state=TrialState.FAIL)
    else:
        study.tell(number, gain)


def validation_gain(folder: Path) -> float | None:
    """Return a training's best validation beyond its expert's; None where there was no validation."""
    found = validation_gains(read_progress(folder))
    return found and found[0]


def _objective(folder: Path, space: SearchSpace) -> float | None:
    """Return what a search maximises: the gain or, as gains beyond other experts say little, the return."""
    gain = validation_gain(folder)
    if gain is None or "expert" not in space:
        return gain
    return max(gain, 0.0) + float(read_progress(folder)[0]["return_expert"] or 0.0)


def describe_trial(trial: SearchTrial) -> str:
    """Return what a trial has reached: the controller that validation chose, and the last checkpoint."""
    values = ", ".join(f"{key}={value}" for key, value in trial.values.items())
    if trial.gain is None or trial.last_gain is None:
        return f"trial {trial.number}: failed: {values}"
    kept = "" if trial.gain > 0 else " (the untrained network was kept)"
    last = f"last checkpoint {trial.last_gain:+.1f}"
    return f"trial {trial.number}: {trial.gain:+.1f} beyond the expert, {last}, validation seeds{kept}: {values}"


def _progress_line(study: "Study", number: int, trials: int) -> str:
    trial = study.get_trials(deepcopy=False)[number]
    ended = sum(one.state.is_finished() for one in study.get_trials(deepcopy=False))
    values = ", ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in trial.params.items()
    )
    result = "failed" if trial.value is None else f"{trial.value:+.1f}"
    return f"{ended} of {trials}: trial {number}: {values}: {result}"
