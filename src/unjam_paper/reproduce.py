"""Making what studies need, each training once, and drawing them. `unjam reproduce`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unjam.controller.file import WEIGHTS_PART, sha256_of, unpack_parts
from unjam.errors import InputError, unknown_name
from unjam.files import atomic_write, make_folder, to_json
from unjam.manifest import manifest
from unjam.reports.results import EVALUATION_FILE
from unjam.scenarios import SCENARIOS
from unjam.training.executors import Executor, run_all, training_command
from unjam.training.run_folder import read_config
from unjam_paper import STUDIES, STUDY_GROUPS
from unjam_paper.parts import PartCallback
from unjam_paper.references import drive_references
from unjam_paper.results_file import collect_results
from unjam_paper.study import STUDY_ROADS, PlannedRun, Study, StudyFolder, study_manifest

TRAINING_SECONDS: dict[str, dict[str, float]] = {
    "trpo": {"ring": 45, "figure-eight": 80, "merge": 900, "on-ramp": 170},
    "ppo": {"ring": 75, "figure-eight": 110, "merge": 930, "on-ramp": 190},
    "sac": {"ring": 450, "figure-eight": 480, "merge": 1300},
}
"""what 300,000 actual steps took on one core of the machine of results/, model-free, on the on-ramp in
batches [s]"""
SUMO_ON_RAMP_SECONDS = 1150.0
"""what more they take on the on-ramp where its episodes are SUMO's [s]"""
MODEL_ROLLOUT_SECONDS = 60.0
"""what the virtual environment adds, for each virtual decision per actual one up to one [s]"""
REFERENCE_SECONDS = {"ring": 60.0, "figure-eight": 60.0, "merge": 400.0, "on-ramp": 1500.0}
"""what the drivers that do not learn take on a road [s]"""


def make_plan(names: Sequence[str], seeds: int, study_folder: StudyFolder) -> "StudyPlan":
    """Return what is still to do.

    Raises:
        InputError: an unknown study, or the folder holds such a training with other settings.
    """
    chosen = find_studies(names)
    wanted = list(dict.fromkeys(run for study in chosen.values() for run in study.make_runs(seeds)))
    for run in wanted:
        folder = study_folder.run_folder(run)
        if (folder / "config.toml").is_file():
            before = replace(read_config(folder), workers=run.config.workers, steps=run.config.steps)
            if before != run.config:
                words = f"out: {str(folder)!r} was trained with other settings; allowed: a new folder"
                raise InputError(words)
    for name in (name for name, study in chosen.items() if study.is_resumable):
        begun = study_folder.folder / name / "manifest.json"
        before = json.loads(begun.read_text()).get("seeds", seeds) if begun.is_file() else seeds
        if before != seeds:  # what is there already is of so many trainings
            raise InputError(f"seeds: {seeds} is not allowed; allowed: {before}, as in {begun}, or a new --out")
    missing = [run for run in wanted if not study_folder.is_finished(run)]
    roads = dict.fromkeys(road for study in chosen.values() for road in study.roads)
    undriven = [road for road in roads if not (study_folder.reference_folder(road) / EVALUATION_FILE).is_file()]
    return StudyPlan(tuple(chosen), seeds, study_folder, missing, len(wanted) - len(missing), undriven)


def find_studies(names: Sequence[str]) -> dict[str, Study]:
    """Return the studies of these names; `all` is all of them."""
    for name in names:
        if name not in (*STUDIES, *STUDY_GROUPS):
            raise unknown_name("study", name, [*STUDIES, *STUDY_GROUPS])
    chosen = {study for name in names for study in STUDY_GROUPS.get(name, (name,))}
    return {name: study for name, study in STUDIES.items() if name in chosen}


def estimated_seconds(run: PlannedRun) -> float:
    """Return about how long a training takes on one core [s]."""
    config = run.config
    actual, virtual = TRAINING_SECONDS[config.agent][_scenario_kind(run.road)], config.model
    rows, roads = MODEL_ROLLOUT_SECONDS * min(1.0, virtual.model_ratio), actual * virtual.model_ratio
    in_sumo = SUMO_ON_RAMP_SECONDS if _scenario_kind(run.road) == "on-ramp" and config.simulator == "sumo" else 0.0
    return config.steps / 300_000 * (actual + in_sumo + (roads if virtual.kind == "road" else rows))


def _scenario_kind(road: str) -> str:
    return SCENARIOS[STUDY_ROADS[road]["scenario"]].title


def run_plan(
    plan: "StudyPlan", workers: int, executor: Executor = "local", on_message: PartCallback = lambda line: None
) -> list[Path]:
    """Make what is missing, `workers` trainings at once, draw the studies, and return their folders.

    Beside the folder of each study lies its results file, NAME.json.

    A study that was stopped goes on where it was: trainings from their last checkpoint. With `ray` they run
    on a cluster whose machines share the folder.

    Raises:
        UnjamError: a training failed; the others are there.
    """
    studies = plan.study_folder
    make_folder(studies.folder)
    for road in plan.roads:
        on_message(f"drivers that do not learn: {road}")
        drive_references(road, studies, workers)
    plans, logs = studies.folder / "plans", studies.folder / "logs"
    commands = {
        run.name: training_command(
            run.config, studies.run_folder(run), plans / f"{run.name}.toml", logs / f"{run.name}.log"
        )
        for run in plan.runs
    }
    run_all(commands, workers, executor, on_message)
    for name in plan.names:
        study, target = STUDIES[name], studies.folder / name
        on_message(f"writing {name}: {study.title}")
        make_folder(target)
        begun = study_manifest(target, seeds=plan.seeds) if study.is_resumable else manifest()
        study.write(studies, plan.seeds, target, workers)
        about = {"study": name, "title": study.title, "seeds": plan.seeds, **begun}
        about["trainings"] = [_training_record(run, studies) for run in study.make_runs(plan.seeds)]
        atomic_write(target / "manifest.json", to_json(about, indent=1))
        collect_results(target)
    return [studies.folder / name for name in plan.names]


def _training_record(run: PlannedRun, study_folder: StudyFolder) -> dict[str, Any]:
    """Return what is needed to repeat a training, and what its network is known by, whoever repeats it."""
    folder = study_folder.run_folder(run)
    commit = json.loads((folder / "manifest.json").read_text())["commit"]
    weights = unpack_parts(study_folder.controller_folder(run) / "controller.unjam")[WEIGHTS_PART]
    return {"run": run.name, "commit": commit, "weights_sha256": sha256_of(weights)}


@dataclass(frozen=True)
class StudyPlan:
    """What is still to do for some studies."""

    names: tuple[str, ...]
    seeds: int
    """of each training"""
    study_folder: StudyFolder
    runs: list[PlannedRun]
    """trainings, those that are finished left out"""
    finished_count: int
    """trainings that are there already"""
    roads: list[str]
    """where drivers that do not learn must still drive"""

    def seconds(self, workers: int) -> float:
        """Return about how long it takes on `workers` cores [s]."""
        alone = sum(estimated_seconds(run) for run in self.runs)
        alone += sum(REFERENCE_SECONDS[_scenario_kind(road)] for road in self.roads)
        return alone / workers + 60.0 * sum(STUDIES[name].minutes for name in self.names)
