"""Residuals that learn from the drives of March what a tuned law does not know, with and without the model.

The policy sees what the law sees, and means of the CAV's speed and gap over ten seconds to some minutes.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from shutil import copyfile, rmtree
from typing import Any

from unjam.files import make_folder
from unjam.reports.results import read_progress
from unjam.training.config import RunConfig, load_config
from unjam.training.train import train
from unjam_paper.study import Table

WINDOW_SECONDS = 200.0
STEPS_PER_ITERATION, TRAINING_STEPS = 400_000, 4_000_000
"""environment steps; with the model, model steps are a part of them"""
TRAINING_CHANGES: dict[str, Any] = {
    **{"scenario": "recorded", "backend": "batch", "scenario_options.window": WINDOW_SECONDS, "workers": 1},
    **{"policy.history_features": True, "policy.authority": 0.15},
    **{"policy.exploration_std": 0.03, "policy.learn_exploration_std": False},
    **{"trpo.target_kl": 0.01, "trpo.critic_batch_size": 2_000},
    **{"evaluation.validation_episodes": 64, "evaluation.validation_interval": 3},
    **{"evaluation.episodes": 2, "evaluation.baselines": []},
}
"""the best of nine trials in validation, one training each with up to 12,000,000 steps; windows are drawn from the
training drives"""
MODEL_RATIOS = {"without model": 0.0, "with model": 1.0}
"""model steps for each environment step, by the name of the residual"""


@dataclass(frozen=True)
class PlannedResidual:
    """A training on recorded drives."""

    folder: str
    """of all residuals of the study"""
    drives: str
    """pattern of the files of the training drives"""
    expert: str
    label: str
    """a name in `MODEL_RATIOS`"""
    seed: int

    @property
    def name(self) -> str:
        """Its name among all residuals."""
        return f"{self.label} {self.seed}"

    @property
    def controller(self) -> Path:
        """The file of the trained controller."""
        return Path(self.folder, f"{self.name}.unjam")

    @property
    def config(self) -> RunConfig:
        """Its configuration: with the model, there are as many updates of the policy from fewer environment steps."""
        ratio = MODEL_RATIOS[self.label]
        changes = {"scenario_options.recordings": self.drives, "expert": self.expert, "seed": self.seed}
        changes |= {"trpo.steps_per_iteration": round(STEPS_PER_ITERATION / (1.0 + ratio)), "model.model_ratio": ratio}
        return load_config(changes=TRAINING_CHANGES | changes | {"steps": round(TRAINING_STEPS / (1.0 + ratio))})


def planned_residuals(folder: Path, drives: str, expert: str, seeds: int) -> list[PlannedResidual]:
    """Return the trainings with and without the model, ordered by seed."""
    return [
        PlannedResidual(str(folder), drives, expert, label, seed) for seed, label in product(range(seeds), MODEL_RATIOS)
    ]


def train_residual(run: PlannedResidual, workers: int) -> Table:
    """Train a residual, store its controller, and return its validations."""
    folder = Path(run.folder, run.name)
    rmtree(folder, ignore_errors=True)
    make_folder(folder.parent)
    result = train(run.config, folder)
    rows = [row for row in read_progress(folder) if row["return_validation"] is not None]
    copyfile(result.controller, run.controller)
    rmtree(folder)
    names = "environment_steps", "return_validation", "return_expert"
    return [{"residual": run.label, "seed": run.seed, **{name: row[name] for name in names}} for row in rows]
