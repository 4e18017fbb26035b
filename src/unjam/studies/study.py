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
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.drivable import verdicts
from unjam.reports.results import EVALUATION_FILE, read_progress, read_rows
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig, load_config
from unjam.training.evaluate import TRAINED, evaluate, raise_failures
from unjam.training.folder import read_config
from unjam.training.presets import ON_RAMP_LONG
from unjam.training.seeds import held_out_seeds
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.workers import Workers

BUDGET = 300_000
"""actual steps of every learner"""
LONG_BUDGET = 4_000_000
"""the paper's own"""
MILLION = 1_000_000
"""where an hour makes no more"""

ROADS: dict[str, dict[str, Any]] = {
    **{name: {"scenario": name} for name in ("ring", "ring-jammed", "figure-eight", "merge")},
    "on-ramp": {"scenario": "on-ramp", "road.cav_share": 0.05},
    **{name: {"scenario": "ring"} for name in ("rings", "shared-rings", "everywhere")},
    "ring-11": {"scenario": "ring", "road.vehicles": 11},
    "ring-5": {"scenario": "ring", "road.vehicles": 5},
}
PAPERS_ROADS = ("ring", "figure-eight", "merge")
LAST_SHARE = 0.1
"""share of the iterations, the last ones, that the paper's convention is read from"""

Table = list[dict[str, Any]]
"""rows, of results or of metrics of episodes"""


def planned(roads: Iterable[str], variants: Sequence[str], seeds: int) -> "list[PlannedRun]":
    """Return the runs of all variants on all roads: all of one seed first."""
    return [
        PlannedRun(road, variant, seed)
        for seed, road, variant in product(range(seeds), tuple(roads), variants)
    ]


def about_study(folder: Path, **facts: Any) -> dict[str, Any]:
    """Return where a study comes from: its first call (`facts`, manifest), and what went on with it when."""
    make_folder(folder)
    path, about = folder / "manifest.json", {**facts, **manifest()}
    if path.is_file():
        went_on = {"commit": about["commit"], "started": about["started"]}
        about = json.loads(path.read_text(encoding="utf-8"))
        about["went_on"] = [*about.get("went_on", []), went_on]
    write_whole(path, to_json(about, indent=1))
    return about


def judged(
    scenario: Scenario, drivers: dict[str, Driver], seeds: int, kept: Sequence[str], workers: Workers
) -> dict[str, Any]:
    """Return what each driver did on seeds that judge: its verdict, and the numbers `kept` of each episode.

    People alone, where they are among them, are `human`.
    """
    driven = evaluate(scenario, drivers, held_out_seeds(seeds), workers)
    raise_failures(driven)
    rows = driven.rows
    said = verdicts(rows)
    return {
        label: {"drivable": said[label], "episodes": [{name: row[name] for name in kept} for row in found]}
        for label, found in rows.items()
    }


@dataclass(frozen=True)
class Variant:
    """A way to learn, as changes to a preset."""

    label: str
    preset: str
    changes: dict[str, Any]
    steps: int | None = BUDGET
    """None: those of the preset"""
    papers: str = ""
    """the variant whose numbers the paper gives for it, if it is another"""


def few_steps(prefix: str, batch: int, steps: int, horizon: int = 3000, **same: Any) -> dict[str, Variant]:
    """Return `best` with an eighth of a road's steps: alone, with as many again, with roads imagined.

    Of the last an eighth of an iteration is actual, the rest are whole episodes of `horizon` decisions. What
    is the `same` differs from `best` in all of them.
    """
    few, twice = ({"world": "batch", **same, "trpo.batch_steps": times * batch} for times in (1, 2))
    whole = {"virtual_ratio": 7.0, "model": "road", "begin": "first", "k_max": horizon}
    imagined = {**few, **{f"virtual.{key}": value for key, value in whole.items()}}
    return {
        f"{prefix}-few": Variant("ours, few steps", "best", few, steps),
        f"{prefix}-middle": Variant("ours, twice as many", "best", twice, 2 * steps),
        f"{prefix}-imagined": Variant("ours, few steps and whole roads imagined", "best", imagined, steps),
    }


WITHOUT_MODEL = {
    **{f"virtual.{name}": getattr(VirtualSettings, name) for name in ("model", "begin", "k_max", "update")},
    "virtual.virtual_ratio": 0.0,
}
LEFT_TO_LEARN = {"expert": "jam-ahead:margin=2,margin_by_share=0", "world": "sumo"}
"""a law that gains nothing on the on-ramp: on the tuned one little is left to learn"""
RAMP = few_steps("ramp", 9_600, 86_400, horizon=2400, **LEFT_TO_LEARN, **WITHOUT_MODEL)
SMALL = {**RAMP["ramp-few"].changes, "trpo.batch_steps": 4_800, "evaluation.every": 6}
"""twice as many updates from the same steps, as many as those in turn have by three times their steps"""
LONG_IN_BATCHES = {
    **{"expert": ON_RAMP_LONG, "world": "batch", "trpo.batch_steps": 153_600, **WITHOUT_MODEL},
    **{"evaluation.every": 10, "evaluation.validation_episodes": 128},
}
ALONE = {"expert": "none", "virtual.virtual_ratio": 0.0}
TO_THE_END = {"evaluation.converged": 0}
TWO_EACH = {"evaluation.episodes": 2}
"""of each road; a study judges on all of them, held out or seen"""
PLAIN = {
    **{"expert": "none", "policy.exploration_std": 0.5, **TWO_EACH},
    **{
        f"{agent}.{key}": value
        for agent in ("trpo", "ppo")
        for key, value in (("batch_steps", 60_000), ("gamma", 0.99))
    },
    **{"trpo.target_kl": 0.01, "ppo.epochs": 20, "evaluation.every": 5, "evaluation.validation_episodes": 4},
}
"""learning from nothing on many roads: with a residual's little noise it ends with CAVs that stand"""
BY_150_SECONDS = {
    **{"road.horizon": 1500, "trpo.batch_steps": 48_000, "trpo.target_kl": 0.016, "trpo.gamma": 0.996},
    **{"trpo.gae_lambda": 0.96, "policy.exploration_std": 0.05, "policy.hold": 1.5},
}
"""what a search found for the jammed ring by the first half of its episodes; `best` is by whole ones"""
VARIANTS: dict[str, Variant] = {
    "trpo": Variant("TRPO", "paper", ALONE),
    "ppo": Variant("PPO", "paper", {"agent": "ppo", **ALONE}),
    "sac": Variant("SAC", "paper", {"agent": "sac", **ALONE}),
    "mb-trpo": Variant("MB-TRPO", "paper", {"expert": "none", "virtual.base": "none"}),
    "no-initial-policy": Variant("no initial policy", "paper", {"expert": "none"}),
    "without-model": Variant("residual without model", "paper", {"virtual.virtual_ratio": 0.0}),
    "proposed": Variant("proposed", "paper", {}),
    "proposed-ppo": Variant("proposed with PPO", "paper", {"agent": "ppo"}),
    "proposed-sac": Variant("proposed with SAC", "paper", {"agent": "sac"}),
    "trpo-eq16": Variant("TRPO, Eq. 16 as meant", "paper", {**ALONE, "reward": "eq16"}),
    "trpo-as-printed": Variant("TRPO, Eq. 16 as printed", "paper", {**ALONE, "reward": "eq16-as-printed"}),
    "proposed-eq16": Variant("proposed, Eq. 16 as meant", "paper", {"reward": "eq16"}),
    "proposed-as-printed": Variant("proposed, Eq. 16 as printed", "paper", {"reward": "eq16-as-printed"}),
    "trpo-exact": Variant("TRPO", "paper-exact", {**ALONE, **TO_THE_END}, LONG_BUDGET, "trpo"),
    "proposed-exact": Variant("proposed", "paper-exact", TO_THE_END, LONG_BUDGET, "proposed"),
    "trpo-exact-million": Variant("TRPO", "paper-exact", {**ALONE, **TO_THE_END}, MILLION, "trpo"),
    "proposed-exact-million": Variant("proposed", "paper-exact", TO_THE_END, MILLION, "proposed"),
    "ours": Variant("ours", "quick", {}),
    "ours-without-model": Variant("ours without model", "quick", {"virtual.virtual_ratio": 0.0}),
    "best": Variant("ours, all its steps", "best", {}, None),
    **few_steps("best", 12_000, 756_000),
    **few_steps("jammed", 24_000, 768_000),
    **few_steps("eight", 6_000, 612_000, horizon=1500),
    **RAMP,
    "ramp-imagined": replace(RAMP["ramp-imagined"], changes=LEFT_TO_LEARN, steps=28_800),
    "ramp-in-turn": Variant("ours, on the tuned law", "best", {}, None),
    "ramp-long": Variant("ours, on the law that was tuned longer", "best", LONG_IN_BATCHES, 4_608_000),
    "ramp-small": Variant("ours, few steps in small iterations", "best", SMALL, 86_400),
    "best-in-batches": Variant("ours, all its steps", "best", {"world": "batch"}, None),
    "by-150-seconds": Variant("residual", "best", BY_150_SECONDS, None),
    "rings": Variant("residual", "rings", TWO_EACH, None),
    "shared-rings": Variant("residual", "shared-rings", TWO_EACH, None),
    "rings-trpo": Variant("TRPO", "rings", PLAIN, 1_200_000),
    "rings-ppo": Variant("PPO", "rings", {"agent": "ppo", **PLAIN}, 1_200_000),
    "everywhere": Variant("residual", "everywhere", TWO_EACH, None),
    "everywhere-trpo": Variant("TRPO", "everywhere", PLAIN, MILLION),
    "everywhere-ppo": Variant("PPO", "everywhere", {"agent": "ppo", **PLAIN}, MILLION),
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
        changes = {**ROADS[self.road], "seed": self.seed, "workers": 1, "evaluation.baselines": []}
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

    def in_training(self, name: str) -> float:
        """Return a number of the training batches, exploration included, in the last tenth of them."""
        last = self.progress[-ceil(LAST_SHARE * len(self.progress)) :]
        return float(np.mean([row[name] for row in last]))

    @property
    def seconds(self) -> float:
        """Wall time of its iterations."""
        return float(sum(sum(row["seconds"].values()) for row in self.progress))


@dataclass(frozen=True)
class StudyFolder:
    """A folder with the trainings and drives of all studies, each made once; nothing need be there yet."""

    folder: Path

    def folder_of(self, run: PlannedRun) -> Path:
        """Return where a training is."""
        return self.folder / "runs" / run.name

    def controller_of(self, run: PlannedRun) -> Path:
        """Return where its controller is: of several roads, which one network drives, that of the first."""
        return self.folder_of(run) / next(iter(run.config.roads()))

    def keep_controllers(self, runs: Iterable[PlannedRun], folder: Path) -> None:
        """Copy the controllers of trainings into a folder, VARIANT-SEED.unjam: a row can be driven again."""
        make_folder(folder)
        for run in runs:
            found = self.controller_of(run) / "controller.unjam"
            write_whole(folder / f"{run.variant}-{run.seed}.unjam", found.read_bytes())

    def drives_of(self, road: str) -> Path:
        """Return where the drivers that do not learn are, on a road."""
        return self.folder / "drives" / road

    def has(self, run: PlannedRun) -> bool:
        """Return whether a training is finished, with these settings."""
        folder = self.folder_of(run)
        judged = [folder / road / EVALUATION_FILE for road in run.config.roads()]
        return all(file.is_file() for file in judged) and read_config(folder) == run.config

    def trained(self, road: str, variant: str, seeds: int) -> list[TrainedRun]:
        """Return the finished trainings of a variant on a road, one of each seed."""
        runs = {run: self.folder_of(run) for run in planned([road], [variant], seeds)}
        return [TrainedRun(run, read_progress(at), read_rows(at)[TRAINED]) for run, at in runs.items()]

    def references(self, road: str) -> dict[str, Table]:
        """Return the rows of the drivers that do not learn, by label, on the seeds that judge."""
        return read_rows(self.drives_of(road))


@dataclass(frozen=True)
class Study:
    """A table or a figure of the paper."""

    title: str
    runs: Callable[[int], list[PlannedRun]]
    """the trainings for a number of seeds"""
    write: Callable[[StudyFolder, int, Path, int], None]
    """measures what else it needs, and writes numbers and pictures into a folder: (studies, seeds, folder,
    processes)"""
    roads: tuple[str, ...] = ()
    """where drivers that do not learn are driven beside them"""
    minutes: float = 0.0
    """what it takes beside trainings and drives, on two cores"""
    goes_on: bool = False
    """whether `write` keeps what it finds of an earlier call; its manifest then says when it went on"""
    tables: Mapping[str, Callable[[Path], pd.DataFrame]] = field(default_factory=dict)
    """of its page, by name, made of what it wrote into a folder"""
