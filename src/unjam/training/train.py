"""Train: from a configuration to a folder with everything about the run. `unjam train`, `unjam.train`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from unjam.kernels import child_would_be_pinned
from unjam.measures.statistics import Estimate, paired_difference
from unjam.reports.html import write_report
from unjam.training.apart import train_apart
from unjam.training.config import RunConfig
from unjam.training.evaluate import TRAINED, judge
from unjam.training.folder import check_possible, continue_folder, start_folder
from unjam.training.model_facts import write_model_facts
from unjam.training.run import Run, Told
from unjam.worlds.workers import Workers


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

    Where NumPy was imported before unjam, it trains in a process of its own, so that the result is the same:
    see `unjam.kernels`.

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
    if child_would_be_pinned():
        rows = train_apart(config, folder, resume, told, progress)
        return TrainResult(folder, rows, gain_of(config, rows))
    check_possible(config)  # what is wrong is told before anything is written
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
    return paired_difference(rows[TRAINED], rows[config.make_expert().describe()], "return")
