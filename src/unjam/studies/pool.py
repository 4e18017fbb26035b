"""What studies are made of, once it has been measured: trainings, and drivers that do not learn."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.archive import WEIGHTS, unpack_parts
from unjam.controller.file import hash_of
from unjam.reports.results import EVALUATION_FILE, Results, read_progress, read_results, read_rows
from unjam.studies.plan import PlannedRun
from unjam.training.evaluate import TRAINED
from unjam.training.executors import Command, training_command
from unjam.training.folder import read_config
from unjam.training.presets import CLOSING_ABSORBER

REFERENCES: dict[str, str] = {
    "human": "human",
    "zero": "constant",
    "constant +0.1": "constant:acceleration=0.1",
    "PI (paper)": "pi:time_constant=0",
    "PI": "pi",
    "FollowerStopper": "follower-stopper",
    "IDM": "idm",
    "ACC": "acc",
    "LACC": "lacc",
    "BCM": "bcm",
    "OVM": "ovm",
    "pacer": "pacer",
    "varying pacer": "pacer:varying=true",
    "gentle varying pacer": "pacer:varying=true,time_constant=1",
    "jam absorber": "jam-absorber",
    "closing jam absorber": CLOSING_ABSORBER,
}
"""drivers that do not learn, beside those that do: label and how `unjam drive` names them"""
EXPERTS = tuple(label for label in REFERENCES if label not in ("human", "zero", "constant +0.1"))
LAST_SHARE = 0.1
"""share of the iterations, the last ones, that the paper's convention is read from"""


@dataclass(frozen=True)
class TrainedRun:
    """A finished training."""

    run: PlannedRun
    progress: list[dict[str, Any]]
    rows: list[dict[str, Any]]
    """of the trained controller, deterministic, on held-out seeds"""

    @property
    def last(self) -> list[dict[str, Any]]:
        """The last tenth of the iterations."""
        return self.progress[-ceil(LAST_SHARE * len(self.progress)) :]

    def in_training(self, name: str) -> float:
        """Return a number of the training batches, exploration included, in the last tenth of them."""
        return float(np.mean([row[name] for row in self.last]))

    @property
    def seconds(self) -> float:
        """Wall time of its iterations."""
        return float(sum(sum(row["seconds"].values()) for row in self.progress))


class Pool:
    """A folder with the trainings and drives of all studies, each made once."""

    def __init__(self, folder: Path) -> None:
        """Look into a folder; nothing need be there yet."""
        self.folder = folder

    def folder_of(self, run: PlannedRun) -> Path:
        """Return where a training is."""
        return self.folder / "runs" / run.name

    def drives_of(self, road: str) -> Path:
        """Return where the drivers that do not learn are, on a road."""
        return self.folder / "drives" / road

    def has(self, run: PlannedRun) -> bool:
        """Return whether a training is finished, with these settings."""
        folder = self.folder_of(run)
        return (folder / EVALUATION_FILE).is_file() and read_config(folder) == run.config

    def has_drives(self, road: str) -> bool:
        """Return whether the drivers that do not learn have driven a road."""
        return (self.drives_of(road) / EVALUATION_FILE).is_file()

    def command(self, run: PlannedRun) -> Command:
        """Return the command line that begins a training, or goes on with it."""
        plan = self.folder / "plans" / f"{run.name}.toml"
        log = self.folder / "logs" / f"{run.name}.log"
        return training_command(run.config, self.folder_of(run), plan, log)

    def trained(self, runs: Sequence[PlannedRun]) -> list[TrainedRun]:
        """Return finished trainings."""
        return [
            TrainedRun(run, read_progress(folder), read_rows(folder)[TRAINED])
            for run in runs
            for folder in (self.folder_of(run),)
        ]

    def references(self, road: str) -> dict[str, list[dict[str, Any]]]:
        """Return the rows of the drivers that do not learn, by label, on the seeds that judge."""
        return read_rows(self.drives_of(road))

    def weights_sha256(self, run: PlannedRun) -> str:
        """Return the hash of a trained network: the same whichever unjam repeats the training."""
        return hash_of(unpack_parts(self.folder_of(run) / "controller.unjam")[WEIGHTS])

    def results(self, run: PlannedRun) -> Results:
        """Return all that the folder of a training says, pictures included."""
        return read_results(self.folder_of(run))
