"""Residuals on a tuned formula, trained behind recorded vehicles with and without the model and more recordings."""

import os
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from shutil import copyfile, rmtree
from typing import Any

import pandas as pd

from unjam.errors import InputError
from unjam.files import make_folder
from unjam.reports.results import read_progress
from unjam.training.config import RunConfig, load_config
from unjam.training.train import train
from unjam_paper.results_file import read_part
from unjam_paper.study import Table, group_rows, trainings_text

RESIDUALS_PART = "residuals"
STEPS_PER_ITERATION, TRAINING_STEPS = 400_000, 4_000_000
"""steps of an iteration and of a training, including model steps"""
TASK_OPTIONS = {"window": 200.0}
"""options of all tasks: windows of the drives [s]"""
TRAINING_CHANGES: dict[str, Any] = {
    **{"scenario": "recorded", "backend": "batch", "scenario_options": TASK_OPTIONS, "workers": 1},
    **{"policy.history_features": True, "policy.authority": 0.15},
    **{"policy.exploration_std": 0.03, "policy.learn_exploration_std": False},
    **{"trpo.target_kl": 0.01, "trpo.critic_batch_size": 2_000},
    **{"evaluation.validation_episodes": 64, "evaluation.validation_interval": 3},
    **{"evaluation.episodes": 2, "evaluation.baselines": []},
}
"""the best settings, in validation, of nine trials with one training each of up to 12,000,000 steps; windows are drawn
from the training drives"""
MORE_RECORDINGS_LABEL = "without model, more recordings"
MODEL_RATIOS = {"without model": 0.0, "with model": 1.0, MORE_RECORDINGS_LABEL: 0.0}
"""model steps for each environment step, by label of the residual"""
I24_TASK = "i24"
OTHER_RECORDINGS: dict[str, dict[str, Any]] = {
    "openacc": {"recordings": "recordings/openacc_astazero_pairs.parquet"},
    "ngsim": {"recordings": "recordings/ngsim_i80_recon_pairs.parquet", "window": 30.0},
}
"""recordings of `MORE_RECORDINGS_LABEL`, besides the training drives and artificial waves: on a test track (OpenACC,
Makridis et al. 2021), and in a jam on I-80 (NGSIM, at least 30 s long); all four tasks have equal shares of steps"""


@dataclass(frozen=True)
class PlannedResidual:
    """A training on recorded drives."""

    folder: str
    """folder of all residuals of the study"""
    drives: str
    """pattern of the files of the training drives"""
    expert: str
    label: str
    """a name in `MODEL_RATIOS`"""
    seed: int

    @property
    def name(self) -> str:
        """Name of the training: label and seed."""
        return f"{self.label} {self.seed}"

    @property
    def controller(self) -> Path:
        """Path of the trained controller."""
        return Path(self.folder, f"{self.name}.unjam")

    @property
    def config(self) -> RunConfig:
        """Run configuration; with the model, the same number of policy updates needs fewer environment steps."""
        ratio = MODEL_RATIOS[self.label]
        changes = {"scenario_options.recordings": self.drives, "expert": self.expert, "seed": self.seed}
        changes |= {"trpo.steps_per_iteration": round(STEPS_PER_ITERATION / (1.0 + ratio)), "model.model_ratio": ratio}
        if self.label == MORE_RECORDINGS_LABEL:
            changes["tasks"] = [
                {"name": name, "scenario": "recorded", "scenario_options": TASK_OPTIONS | options}
                for name, options in self._task_options().items()
            ]
        return load_config(changes=TRAINING_CHANGES | changes | {"steps": round(TRAINING_STEPS / (1.0 + ratio))})

    def _task_options(self) -> dict[str, dict[str, Any]]:
        tasks: dict[str, dict[str, Any]] = {I24_TASK: {"recordings": self.drives}}
        for name, options in OTHER_RECORDINGS.items():
            tasks[name] = {**options, "recordings": _recordings_path(self.drives, options)}
        return {**tasks, "artificial": {}}


def planned_residuals(folder: Path, drives: str, expert: str, seeds: int) -> list[PlannedResidual]:
    """Return the trainings of all labels, ordered by seed; raise `InputError` if recordings are missing."""
    for name, options in OTHER_RECORDINGS.items():
        if not os.path.isfile(file := _recordings_path(drives, options)):
            allowed = "pairs of vehicles that follow each other, in a format of unjam fit-drivers"
            raise InputError(f"{name}: {file} does not exist; allowed: {allowed}")
    return [
        PlannedResidual(str(folder), drives, expert, label, seed) for seed, label in product(range(seeds), MODEL_RATIOS)
    ]


def _recordings_path(drives: str, options: dict[str, Any]) -> str:
    """Return the path of other recordings in the folder of all studies, which contains the training drives."""
    return str(Path(drives).parents[2] / options["recordings"])


def train_residual(run: PlannedResidual, workers: int) -> Table:
    """Train a residual, store its controller, and return a row for each validation."""
    folder = Path(run.folder, run.name)
    rmtree(folder, ignore_errors=True)
    make_folder(folder.parent)
    result = train(run.config, folder)
    result = result.tasks.get(I24_TASK, result)
    rows = [row for row in read_progress(result.folder) if row["return_validation"] is not None]
    copyfile(result.controller, run.controller)
    rmtree(folder)
    names = "environment_steps", "return_validation", "return_expert"
    return [{"residual": run.label, "seed": run.seed, **{name: row[name] for name in names}} for row in rows]


def residuals_table(folder: Path) -> pd.DataFrame:
    """Return the gains of the trainings over their expert on validation windows of the training drives."""
    rows = read_part(folder, RESIDUALS_PART)
    table: Table = []
    for label in MODEL_RATIOS:
        label_rows = [row for row in rows if row["residual"] == label]
        trainings = group_rows(label_rows, "seed").values()
        gains = [[row["return_validation"] - row["return_expert"] for row in training] for training in trainings]
        steps = f"{max(row['environment_steps'] for row in label_rows):,}"
        cells = {"residual": label, "trainings": len(gains), "environment steps": steps}
        cells["best gain in validation"] = trainings_text([max(curve) for curve in gains], 1, sign="+")
        table.append({**cells, "last gain in validation": trainings_text([curve[-1] for curve in gains], 1, sign="+")})
    return pd.DataFrame(table)
