"""What a study is, what it is made of - trainings, drives, measured parts - and where all that lies."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.drivers.driver import Driver
from unjam.files import atomic_write, make_folder, to_json
from unjam.manifest import manifest
from unjam.measures.feasibility import feasibility_by_driver
from unjam.models.settings import ModelSettings
from unjam.reports.results import EVALUATION_FILE, read_progress, read_rows
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig, load_config
from unjam.training.evaluate import TRAINED_LABEL, evaluate, raise_failures
from unjam.training.presets import ON_RAMP_JAM_AHEAD
from unjam.training.run_folder import read_config
from unjam.training.seeds import make_test_seeds
from unjam.worlds.worker_pool import WorkerPool

STEP_BUDGET = 300_000
"""actual steps of every learner"""
PAPER_STEP_BUDGET = 4_000_000
"""the paper's own"""
MILLION_STEPS = 1_000_000
"""where an hour makes no more"""

STUDY_ROADS: dict[str, dict[str, Any]] = {
    **{name: {"scenario": name} for name in ("ring", "ring-jammed", "figure-eight", "merge")},
    "on-ramp": {"scenario": "on-ramp", "scenario_options.penetration_rate": 0.05},
    **{name: {"scenario": "ring"} for name in ("rings", "shared-rings", "everywhere")},
    "ring-11": {"scenario": "ring", "scenario_options.vehicles": 11},
    "ring-5": {"scenario": "ring", "scenario_options.vehicles": 5},
}
PAPER_ROADS = ("ring", "figure-eight", "merge")
FINAL_SHARE = 0.1
"""share of the iterations, the last ones, that the paper's convention is read from"""

Table = list[dict[str, Any]]
"""rows, of results or of metrics of episodes"""


def planned_runs(roads: Iterable[str], variants: Sequence[str], seeds: int) -> "list[PlannedRun]":
    """Return the runs of all variants on all roads: all of one seed first."""
    return [PlannedRun(road, variant, seed) for seed, road, variant in product(range(seeds), tuple(roads), variants)]


def study_manifest(folder: Path, **facts: Any) -> dict[str, Any]:
    """Return where a study comes from: its first call (`facts`, manifest), and what went on with it when."""
    make_folder(folder)
    path, about = folder / "manifest.json", {**facts, **manifest()}
    if path.is_file():
        went_on = {"commit": about["commit"], "started": about["started"]}
        about = json.loads(path.read_text(encoding="utf-8"))
        about["went_on"] = [*about.get("went_on", []), went_on]
    atomic_write(path, to_json(about, indent=1))
    return about


def evaluate_on_test_seeds(
    scenario: Scenario, drivers: dict[str, Driver], seeds: int, metrics: Sequence[str], workers: WorkerPool
) -> dict[str, Any]:
    """Return what each driver did on seeds that judge: its verdict, and the numbers `remaining_rows` of each episode.

    People alone, where they are among them, are `human`.
    """
    driven = evaluate(scenario, drivers, make_test_seeds(seeds), workers)
    raise_failures(driven)
    rows = driven.rows
    said = feasibility_by_driver(rows)
    return {
        label: {"drivable": said[label], "episodes": [{name: row[name] for name in metrics} for row in found]}
        for label, found in rows.items()
    }


@dataclass(frozen=True)
class Variant:
    """A way to learn, as changes to a preset."""

    label: str
    preset: str
    changes: dict[str, Any]
    steps: int | None = STEP_BUDGET
    """None: those of the preset"""
    paper_variant: str = ""
    """the variant whose numbers the paper gives for it, if it is another"""


def reduced_step_variants(
    prefix: str, batch_steps: int, steps: int, horizon: int = 3000, **common_changes: Any
) -> dict[str, Variant]:
    """Return `best` with an eighth of a road's steps: alone, with as many again, with roads imagined.

    Of the last an eighth of an iteration is actual, the rest are whole episodes of `horizon` decisions. What
    is the `same` differs from `best` in all of them.
    """
    few, twice = (
        {"world": "batch", **common_changes, "trpo.steps_per_iteration": times * batch_steps} for times in (1, 2)
    )
    whole = {"model_ratio": 7.0, "model": "road", "begin": "first", "k_max": horizon}
    imagined = {**few, **{f"virtual.{key}": value for key, value in whole.items()}}
    return {
        f"{prefix}-few": Variant("ours, few steps", "best", few, steps),
        f"{prefix}-middle": Variant("ours, twice as many", "best", twice, 2 * steps),
        f"{prefix}-imagined": Variant("ours, few steps and whole roads imagined", "best", imagined, steps),
    }


NO_MODEL = {
    **{f"virtual.{name}": getattr(ModelSettings, name) for name in ("model", "begin", "k_max", "update")},
    "model.model_ratio": 0.0,
}
WEAK_EXPERT = {"expert": "jam-ahead:speed_margin=2,margin_by_penetration=0", "world": "sumo"}
"""a law that gains nothing on the on-ramp: on the tuned one little is left to learn"""
ON_RAMP_VARIANTS = reduced_step_variants("ramp", 9_600, 86_400, horizon=2400, **WEAK_EXPERT, **NO_MODEL)
SMALL_BATCHES = {
    **ON_RAMP_VARIANTS["ramp-few"].changes,
    "trpo.steps_per_iteration": 4_800,
    "evaluation.validation_interval": 6,
}
"""twice as many updates from the same steps, as many as those in turn have by three times their steps"""
LONG_TRAINING = {
    **{"expert": ON_RAMP_JAM_AHEAD, "world": "batch", "trpo.steps_per_iteration": 153_600, **NO_MODEL},
    **{"evaluation.validation_interval": 10, "evaluation.validation_episodes": 128},
}
NO_EXPERT = {"expert": "none", "model.model_ratio": 0.0}
NO_EARLY_STOPPING = {"evaluation.convergence_window": 0}
TWO_EPISODES_PER_ROAD = {"evaluation.episodes": 2}
"""of each road; a study judges on all of them, held out or seen"""
FROM_SCRATCH = {
    **{"expert": "none", "policy.exploration_std": 0.5, **TWO_EPISODES_PER_ROAD},
    **{
        f"{agent}.{key}": value
        for agent in ("trpo", "ppo")
        for key, value in (("batch_steps", 60_000), ("gamma", 0.99))
    },
    **{
        "trpo.target_kl": 0.01,
        "ppo.epochs": 20,
        "evaluation.validation_interval": 5,
        "evaluation.validation_episodes": 4,
    },
}
"""learning from nothing on many roads: with a residual's little noise it ends with CAVs that stand"""
FIRST_150_SECONDS = {
    **{
        "scenario_options.horizon": 1500,
        "trpo.steps_per_iteration": 48_000,
        "trpo.target_kl": 0.016,
        "trpo.gamma": 0.996,
    },
    **{"trpo.gae_lambda": 0.96, "policy.exploration_std": 0.05, "policy.action_duration": 1.5},
}
"""what a search found for the jammed ring by the first half of its episodes; `best` is by whole ones"""
VARIANTS: dict[str, Variant] = {
    "trpo": Variant("TRPO", "paper", NO_EXPERT),
    "ppo": Variant("PPO", "paper", {"agent": "ppo", **NO_EXPERT}),
    "sac": Variant("SAC", "paper", {"agent": "sac", **NO_EXPERT}),
    "mb-trpo": Variant("MB-TRPO", "paper", {"expert": "none", "model.base": "none"}),
    "no-initial-policy": Variant("no initial policy", "paper", {"expert": "none"}),
    "without-model": Variant("residual without model", "paper", {"model.model_ratio": 0.0}),
    "proposed": Variant("proposed", "paper", {}),
    "proposed-ppo": Variant("proposed with PPO", "paper", {"agent": "ppo"}),
    "proposed-sac": Variant("proposed with SAC", "paper", {"agent": "sac"}),
    "trpo-eq16": Variant("TRPO, Eq. 16 as meant", "paper", {**NO_EXPERT, "reward": "eq16"}),
    "trpo-as-printed": Variant("TRPO, Eq. 16 as printed", "paper", {**NO_EXPERT, "reward": "eq16-as-printed"}),
    "proposed-eq16": Variant("proposed, Eq. 16 as meant", "paper", {"reward": "eq16"}),
    "proposed-as-printed": Variant("proposed, Eq. 16 as printed", "paper", {"reward": "eq16-as-printed"}),
    "trpo-exact": Variant("TRPO", "paper-exact", {**NO_EXPERT, **NO_EARLY_STOPPING}, PAPER_STEP_BUDGET, "trpo"),
    "proposed-exact": Variant("proposed", "paper-exact", NO_EARLY_STOPPING, PAPER_STEP_BUDGET, "proposed"),
    "trpo-exact-million": Variant("TRPO", "paper-exact", {**NO_EXPERT, **NO_EARLY_STOPPING}, MILLION_STEPS, "trpo"),
    "proposed-exact-million": Variant("proposed", "paper-exact", NO_EARLY_STOPPING, MILLION_STEPS, "proposed"),
    "ours": Variant("ours", "quick", {}),
    "ours-without-model": Variant("ours without model", "quick", {"model.model_ratio": 0.0}),
    "best": Variant("ours, all its steps", "best", {}, None),
    **reduced_step_variants("best", 12_000, 756_000),
    **reduced_step_variants("jammed", 24_000, 768_000),
    **reduced_step_variants("eight", 6_000, 612_000, horizon=1500),
    **ON_RAMP_VARIANTS,
    "ramp-imagined": replace(ON_RAMP_VARIANTS["ramp-imagined"], changes=WEAK_EXPERT, steps=28_800),
    "ramp-in-turn": Variant("ours, on the tuned law", "best", {}, None),
    "ramp-long": Variant("ours, on the law that was tuned longer", "best", LONG_TRAINING, 4_608_000),
    "ramp-small": Variant("ours, few steps in small iterations", "best", SMALL_BATCHES, 86_400),
    "best-in-batches": Variant("ours, all its steps", "best", {"world": "batch"}, None),
    "by-150-seconds": Variant("residual", "best", FIRST_150_SECONDS, None),
    "rings": Variant("residual", "rings", TWO_EPISODES_PER_ROAD, None),
    "shared-rings": Variant("residual", "shared-rings", TWO_EPISODES_PER_ROAD, None),
    "rings-trpo": Variant("TRPO", "rings", FROM_SCRATCH, 1_200_000),
    "rings-ppo": Variant("PPO", "rings", {"agent": "ppo", **FROM_SCRATCH}, 1_200_000),
    "everywhere": Variant("residual", "everywhere", TWO_EPISODES_PER_ROAD, None),
    "everywhere-trpo": Variant("TRPO", "everywhere", FROM_SCRATCH, MILLION_STEPS),
    "everywhere-ppo": Variant("PPO", "everywhere", {"agent": "ppo", **FROM_SCRATCH}, MILLION_STEPS),
}
"""the paper's methods with the paper's settings, and what we make of them"""


@dataclass(frozen=True)
class PlannedRun:
    """A training that a study needs."""

    road: str
    variant: str
    seed: int

    @property
    def name(self) -> str:
        """Its place among all trainings of the studies."""
        return f"{self.road}/{self.variant}/{self.seed}"

    @cached_property
    def config(self) -> RunConfig:
        """Its configuration: one worker, judged without drivers that all trainings would share."""
        variant = VARIANTS[self.variant]
        changes = {**STUDY_ROADS[self.road], "seed": self.seed, "workers": 1, "evaluation.baselines": []}
        changes |= variant.changes
        if variant.steps is not None:
            changes["steps"] = variant.steps
        return load_config(preset=variant.preset, changes=changes)


@dataclass(frozen=True)
class TrainedRun:
    """A finished training."""

    run: PlannedRun
    progress: Table
    rows: Table
    """of the trained controller, deterministic, on held-out seeds"""

    def final_training_mean(self, name: str) -> float:
        """Return a number of the training batches, exploration included, in the last tenth of them."""
        last = self.progress[-ceil(FINAL_SHARE * len(self.progress)) :]
        return float(np.mean([row[name] for row in last]))

    @property
    def seconds(self) -> float:
        """Wall time of its iterations."""
        return float(sum(sum(row["seconds"].values()) for row in self.progress))


@dataclass(frozen=True)
class StudyFolder:
    """A folder with the trainings and drives of all studies, each made once; nothing need be there yet."""

    folder: Path

    def run_folder(self, run: PlannedRun) -> Path:
        """Return where a training is."""
        return self.folder / "runs" / run.name

    def controller_folder(self, run: PlannedRun) -> Path:
        """Return where its controller is: of several roads, which one network drives, that of the first."""
        return self.run_folder(run) / next(iter(run.config.task_configs()))

    def copy_controllers(self, runs: Iterable[PlannedRun], folder: Path) -> None:
        """Copy the controllers of trainings into a folder, VARIANT-SEED.unjam: a row can be driven again."""
        make_folder(folder)
        for run in runs:
            found = self.controller_folder(run) / "controller.unjam"
            atomic_write(folder / f"{run.variant}-{run.seed}.unjam", found.read_bytes())

    def reference_folder(self, road: str) -> Path:
        """Return where the drivers that do not learn are, on a road."""
        return self.folder / "drives" / road

    def is_finished(self, run: PlannedRun) -> bool:
        """Return whether a training is finished, with these settings."""
        folder = self.run_folder(run)
        judged = [folder / road / EVALUATION_FILE for road in run.config.task_configs()]
        return all(file.is_file() for file in judged) and read_config(folder) == run.config

    def trained_runs(self, road: str, variant: str, seeds: int) -> list[TrainedRun]:
        """Return the finished trainings of a variant on a road, one of each seed."""
        runs = {run: self.run_folder(run) for run in planned_runs([road], [variant], seeds)}
        return [TrainedRun(run, read_progress(at), read_rows(at)[TRAINED_LABEL]) for run, at in runs.items()]

    def reference_rows(self, road: str) -> dict[str, Table]:
        """Return the rows of the drivers that do not learn, by label, on the seeds that judge."""
        return read_rows(self.reference_folder(road))


@dataclass(frozen=True)
class Study:
    """A table or a figure of the paper."""

    title: str
    make_runs: Callable[[int], list[PlannedRun]]
    """the trainings for a number of seeds"""
    write: Callable[[StudyFolder, int, Path, int], None]
    """measures what else it needs, and writes numbers and pictures into a folder: (studies, seeds, folder,
    processes)"""
    roads: tuple[str, ...] = ()
    """where drivers that do not learn are driven beside them"""
    minutes: float = 0.0
    """what it takes beside trainings and drives, on two cores"""
    is_resumable: bool = False
    """whether `write` keeps what it finds of an earlier call; its manifest then says when it went on"""
    tables: Mapping[str, Callable[[Path], pd.DataFrame]] = field(default_factory=dict)
    """of its page, by name, made of what it wrote into a folder"""
