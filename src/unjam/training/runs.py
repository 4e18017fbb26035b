"""Run folders as things: which there are, how far each is, in what they differ, and removing one."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from unjam.errors import InputError, UnjamError
from unjam.files import INVALID_DATA_ERRORS, remove
from unjam.measures.statistics import Estimate, paired_difference
from unjam.parameters import flatten_keys
from unjam.processes import check_not_locked, is_locked
from unjam.reports.results import EVALUATION_FILE, damaged_results_error, read_evaluation, read_progress
from unjam.training.config import RunConfig
from unjam.training.early_stopping import should_stop_early
from unjam.training.run_folder import MANIFEST_FILE, read_config

RunState = Literal["running", "finished", "stopped", "damaged"]


@dataclass(frozen=True)
class Run:
    """A run folder, as far as it has come."""

    name: str
    """its path below the folder that was listed"""
    folder: Path
    config: RunConfig = field(repr=False)
    state: RunState
    """`open_executor`: a process of this machine writes it; `stop_reason`: it can go on with `unjam train --resume`"""
    steps: int
    """actual steps that are done, of `config.steps`"""
    gains: dict[str, Estimate | None]
    """return beyond the expert on held-out seeds by road, whose name is empty where it is the only one"""

    def document(self) -> dict[str, Any]:
        """Return it as JSON."""
        config = self.config
        return {
            **{"name": self.name, "folder": str(self.folder), "scenario": config.scenario},
            **{"preset": config.preset, "expert": config.expert, "agent": config.agent, "seed": config.seed},
            **{"state": self.state, "steps": self.steps, "steps_total": config.steps},
            "test_gain": {road: asdict(gain) if gain else None for road, gain in self.gains.items()},
        }


def list_runs(root: Path | str = "runs", scenario: str = "") -> list[Run]:
    """Return the runs in a folder and all below it, by name; with `scenario`, those that train on it.

    Raises:
        InputError: there is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"root: {str(root)!r} is not a folder; allowed: one that holds run folders")
    found = [_read_listed_run(folder, str(folder.relative_to(root))) for folder in sorted(_run_folders(root))]
    return [
        run
        for run in found
        if not scenario or scenario in {Path(road.scenario).name for road in run.config.task_configs().values()}
    ]


def _read_listed_run(folder: Path, name: str) -> Run:
    """Return how far a run is; one that is damaged is listed as such, beside the others."""
    try:
        return read_run(folder, name)
    except InputError:
        config = read_config(folder, check_trust=False)
        return Run(name, folder, config, "damaged", 0, dict.fromkeys(config.task_configs()))


def _run_folders(root: Path) -> Iterator[Path]:
    for place, below, files in os.walk(root):
        if {"config.toml", MANIFEST_FILE} <= set(files):
            below.clear()  # the roads of a run are no runs
            try:
                read_config(Path(place), check_trust=False)
            except UnjamError:  # of another unjam, or somebody else's
                continue
            yield Path(place)


def read_run(folder: Path, name: str = "") -> Run:
    """Return how far a run is; raise `InputError` where the folder is none of a run."""
    config, progress = read_config(folder, check_trust=False), read_progress(folder)
    if not (folder / MANIFEST_FILE).is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no {MANIFEST_FILE}")
    try:
        steps = int(progress[-1]["environment_steps"]) if progress else 0
        gains = {road: _test_gain(folder / road) for road in config.task_configs()}
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None
    judged = all((folder / road / EVALUATION_FILE).is_file() for road in gains)
    over = steps >= config.steps or should_stop_early(config, progress)
    done: RunState = "finished" if judged and over else "stopped"
    return Run(name or str(folder), folder, config, "running" if is_locked(folder) else done, steps, gains)


def _test_gain(folder: Path) -> Estimate | None:
    """Return what a judged controller earns beyond its expert; None before that, or without an expert."""
    if not (folder / EVALUATION_FILE).is_file():
        return None
    about, rows = read_evaluation(folder)
    expert = rows.get(about.get("expert", ""))
    return paired_difference(rows[about["trained"]], expert, "return") if expert else None


def find_run(name: str, root: Path) -> Path:
    """Return the folder of a run by its name below `tensors_with_prefix`, or by its path."""
    return root / name if (root / name).is_dir() else Path(name)


def config_differences(runs: Sequence[Run]) -> dict[str, list[Any]]:
    """Return the settings in which runs differ, each with the value of every run; dots lead into tables."""
    settings = [flatten_keys(asdict(run.config)) for run in runs]
    names = dict.fromkeys(name for of_one in settings for name in of_one)
    values = {name: [of_one.get(name) for of_one in settings] for name in names}
    return {name: each for name, each in values.items() if any(value != each[0] for value in each)}


def remove_run(folder: Path) -> None:
    """Remove a run folder for good.

    Raises:
        InputError: it is none, a process writes it, or it is a link or holds the working folder.
    """
    read_run(folder)
    if folder.is_symlink() or Path.cwd().is_relative_to(folder.resolve()):
        raise InputError(f"run: {str(folder)!r} is a link, or where you are; allowed: a run folder elsewhere")
    check_not_locked(folder)
    remove(folder)
