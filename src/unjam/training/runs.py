"""Listing, comparing and removing run folders."""

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from unjam.errors import InputError, UnjamError
from unjam.files import INVALID_DATA_ERRORS, remove
from unjam.measures.feasibility import RowsByDriver
from unjam.measures.statistics import Estimate, paired_difference
from unjam.parameters import flatten_keys
from unjam.processes import check_not_locked, is_locked
from unjam.reports.results import EVALUATION_FILE, damaged_results_error, is_outdated, read_evaluation, read_progress
from unjam.training.config import CONFIG_FILE, MANIFEST_FILE, RunConfig
from unjam.training.run_folder import read_config

_LOG = logging.getLogger(__name__)

RunState = Literal["running", "finished", "stopped", "damaged"]


@dataclass(frozen=True)
class Run:
    """A run folder with the progress and results of the run."""

    name: str
    """path relative to the listed folder"""
    folder: Path
    config: RunConfig = field(repr=False)
    state: RunState
    """`running`: a process of this machine trains it; `stopped`: `unjam train --resume` can continue it"""
    steps: int
    """completed environment steps, out of `config.steps`"""
    gains: dict[str, Estimate | None]
    """difference of return to the expert on test seeds, by task; a single task has an empty name"""

    def document(self) -> dict[str, Any]:
        """Return the run as JSON."""
        config = self.config
        return {
            "name": self.name,
            "folder": str(self.folder),
            **{name: getattr(config, name) for name in ("scenario", "preset", "expert", "agent", "seed")},
            "state": self.state,
            "steps": self.steps,
            "steps_total": config.steps,
            "test_gain": {task: asdict(gain) if gain else None for task, gain in self.gains.items()},
        }


def list_runs(root: Path | str = "runs", scenario: str = "") -> list[Run]:
    """Return the runs in a folder and its subfolders, sorted by folder; with `scenario`, only runs on this scenario.

    Raise `InputError` if there is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"root: {str(root)!r} is not a folder; allowed: a folder with run folders")
    runs: list[Run] = []
    for folder, config in _run_folders(root):
        if not scenario or scenario in {Path(task.scenario).name for task in config.task_configs().values()}:
            name = str(folder.relative_to(root))
            try:
                runs.append(read_run(folder, name))
            except InputError:
                runs.append(Run(name, folder, config, "damaged", 0, dict.fromkeys(config.task_configs())))
    return sorted(runs, key=lambda run: run.folder)


def _run_folders(root: Path) -> Iterator[tuple[Path, RunConfig]]:
    for path, subfolders, files in os.walk(root):
        if {CONFIG_FILE, MANIFEST_FILE} <= set(files):
            subfolders.clear()  # the tasks of a run are not runs
            try:
                yield Path(path), read_config(Path(path), check_trust=False)
            except UnjamError as error:  # for example of another version, or with an untrusted scenario
                _LOG.warning("%s is not listed: %s", path, error)


def read_run(folder: Path, name: str = "") -> Run:
    """Return a run; raise `InputError` if the folder is not a run folder."""
    config, progress = read_config(folder, check_trust=False), read_progress(folder)
    if not (folder / MANIFEST_FILE).is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no {MANIFEST_FILE}")
    try:
        steps = int(progress[-1]["environment_steps"]) if progress else 0
        evaluations = {task: _current_evaluation(folder / task) for task in config.task_configs()}
        gains = {task: evaluation and _test_gain(*evaluation) for task, evaluation in evaluations.items()}
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None
    is_evaluated = all(evaluations.values())
    is_trained = steps >= config.steps or config.evaluation.should_stop_early(progress)
    state: RunState = "finished" if is_evaluated and is_trained else "stopped"
    return Run(name or str(folder), folder, config, "running" if is_locked(folder) else state, steps, gains)


def _current_evaluation(folder: Path) -> tuple[dict[str, Any], RowsByDriver] | None:
    """Return metadata and rows of the evaluation of the controller in a folder; None if it is not evaluated."""
    if not (folder / EVALUATION_FILE).is_file():
        return None
    metadata, rows = read_evaluation(folder)
    return None if is_outdated(folder, metadata) else (metadata, rows)


def _test_gain(metadata: dict[str, Any], rows: RowsByDriver) -> Estimate | None:
    """Return the paired difference of return to the expert; None without an expert."""
    expert = rows.get(metadata.get("expert", ""))
    return paired_difference(rows[metadata["trained"]], expert, "return") if expert else None


def find_run(name: str, root: Path) -> Path:
    """Return the folder of a run, given by its name relative to `root`, or by its path."""
    return root / name if (root / name).is_dir() else Path(name)


def config_differences(runs: Sequence[Run]) -> dict[str, list[Any]]:
    """Return the values of all runs for each setting in which they differ; names have dots."""
    run_settings = [flatten_keys(asdict(run.config)) for run in runs]
    names = dict.fromkeys(chain(*run_settings))
    values_by_name = {name: [settings.get(name) for settings in run_settings] for name in names}
    return {name: values for name, values in values_by_name.items() if any(value != values[0] for value in values)}


def remove_run(folder: Path) -> None:
    """Remove a run folder; raise `InputError` if it is none, in use, a link, or contains the working folder."""
    read_run(folder)
    if folder.is_symlink() or Path.cwd().is_relative_to(folder.resolve()):
        raise InputError(f"run: {str(folder)!r} is a link or has the working folder; allowed: a run folder elsewhere")
    check_not_locked(folder)
    remove(folder)
