"""Train: from a configuration to a folder with everything about the run. `unjam train`, `unjam.train`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from unjam.controller import make_driver
from unjam.drivers.registry import describe
from unjam.drivers.residual import observation_size
from unjam.errors import InputError
from unjam.experiments.config import RunConfig, load_config, to_toml
from unjam.experiments.judge import TRAINED, judge
from unjam.experiments.manifest import manifest
from unjam.experiments.model_facts import write_model_facts
from unjam.experiments.run import Run, Told
from unjam.files import make_folder, to_json, write_whole
from unjam.reports.html import write_report
from unjam.reports.statistics import Estimate, paired_difference
from unjam.traffic.reward import make_reward
from unjam.traffic.workers import Workers


@dataclass(frozen=True)
class TrainResult:
    """A finished training run."""

    folder: Path
    rows: dict[str, list[dict[str, Any]]]
    """by driver: a row of metrics per held-out episode"""
    gain: Estimate | None
    """return of the trained controller beyond its expert's, same seeds paired; None without an expert"""

    @property
    def controller(self) -> Path:
        """The trained controller: the best on the validation seeds."""
        return self.folder / "controller.unjam"

    @property
    def report(self) -> Path:
        """The page that shows what happened."""
        return self.folder / "report.html"


def train(
    config: RunConfig,
    folder: Path | str,
    resume: bool = False,
    told: Told | None = None,
    progress: Callable[[tuple[str, int], int], None] | None = None,
) -> TrainResult:
    """Train as `config` says into `folder`, judge the controller on held-out seeds, and write the report.

    A run that was stopped goes on where it was with `resume`; one that ended goes on if `config.steps` is
    larger than before. It then ends with the same parameters as if it had never stopped.

    Args:
        config: what to do; see `unjam.load_config`.
        folder: new, or the run's.
        resume: whether to go on with the run in `folder`.
        told: told a row of progress after each iteration.
        progress: told how far the final evaluation is: ((driver, episode), decisions).

    Raises:
        InputError: the folder holds something else, or the driver or reward are at fault.
        DiskError: the disk is full; the last checkpoint is whole.
    """
    folder = Path(folder)
    scenario = config.make_scenario()  # what is wrong is told before anything is written
    observation_size(config.policy.observe, config.make_expert())
    make_reward(config.reward or scenario.reward)
    for name in config.evaluation.baselines:
        make_driver(name, scenario.decision_step)
    if resume:
        continue_folder(folder, config)
    else:
        start_folder(folder, config)
    torch.set_num_threads(1)  # more threads would fight with the workers for the cores
    with Workers(config.workers) as workers:
        Run(folder, config, workers, told).train()
        found = judge(folder, config, workers, progress=progress)
    if config.virtual.virtual_ratio > 0:
        write_model_facts(folder, config)
    write_report([folder], folder / "report.html")
    return TrainResult(folder, found.rows, gain_of(config, found.rows))


def gain_of(config: RunConfig, rows: dict[str, list[dict[str, Any]]]) -> Estimate | None:
    """Return what the trained controller earns beyond its expert, same seeds paired."""
    if config.expert == "none":
        return None
    return paired_difference(rows[TRAINED], rows[describe(config.make_expert())], "return")


def start_folder(folder: Path, config: RunConfig) -> None:
    """Make the folder of a new run and write what it is about.

    Raises:
        InputError: the folder holds something already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder, or --resume {folder}")
    make_folder(folder)
    write_whole(folder / "config.toml", to_toml(config))
    write_whole(folder / "manifest.json", to_json(manifest(), indent=1))


def read_config(folder: Path) -> RunConfig:
    """Return the configuration of a run folder; raise `InputError` where it is none."""
    if not (folder / "config.toml").is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no config.toml")
    return load_config(folder / "config.toml")


def continue_folder(folder: Path, config: RunConfig) -> None:
    """Check that `config` may go on with the run in `folder`, and write down its new budget.

    Raises:
        InputError: something else than the budget or the number of workers differs.
    """
    before = read_config(folder)
    if replace(before, steps=config.steps, workers=config.workers) != config:
        raise InputError("resume: only steps and workers may change; all else is the run's")
    if config != before:
        write_whole(folder / "config.toml", to_toml(config))
