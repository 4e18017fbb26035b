"""Making what studies need, each training once, and drawing them. `unjam reproduce`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unjam.controller.file import WEIGHTS, hash_of, unpack_parts
from unjam.errors import InputError, wrong_name
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.reports.results import EVALUATION_FILE
from unjam.scenarios import SCENARIOS
from unjam.studies import STUDIES, TOGETHER
from unjam.studies.parts import OnProgress
from unjam.studies.references import drive_references
from unjam.studies.results_file import collect_results
from unjam.studies.study import ROADS, PlannedRun, Study, StudyFolder, about_study
from unjam.training.executors import Executor, run_all, training_command
from unjam.training.folder import read_config

SECONDS: dict[str, dict[str, float]] = {
    "trpo": {"ring": 45, "figure-eight": 80, "merge": 900, "on-ramp": 170},
    "ppo": {"ring": 75, "figure-eight": 110, "merge": 930, "on-ramp": 190},
    "sac": {"ring": 450, "figure-eight": 480, "merge": 1300},
}
"""what 300,000 actual steps took on one core of the machine of results/, model-free, on the on-ramp in
batches [s]"""
RAMP_IN_SUMO = 1150.0
"""what more they take on the on-ramp where its episodes are SUMO's [s]"""
VIRTUAL_SECONDS = 60.0
"""what the virtual environment adds, for each virtual decision per actual one up to one [s]"""
DRIVE_SECONDS = {"ring": 60.0, "figure-eight": 60.0, "merge": 400.0, "on-ramp": 1500.0}
"""what the drivers that do not learn take on a road [s]"""


def make_plan(names: Sequence[str], seeds: int, studies: StudyFolder) -> "Plan":
    """Return what is still to do.

    Raises:
        InputError: an unknown study, or the folder holds such a training with other settings.
    """
    chosen = studies_of(names)
    wanted = list(dict.fromkeys(run for study in chosen.values() for run in study.runs(seeds)))
    for run in wanted:
        folder = studies.folder_of(run)
        if (folder / "config.toml").is_file():
            before = replace(read_config(folder), workers=run.config.workers, steps=run.config.steps)
            if before != run.config:
                words = f"out: {str(folder)!r} was trained with other settings; allowed: a new folder"
                raise InputError(words)
    for name in (name for name, study in chosen.items() if study.goes_on):
        begun = studies.folder / name / "manifest.json"
        before = json.loads(begun.read_text()).get("seeds", seeds) if begun.is_file() else seeds
        if before != seeds:  # what is there already is of so many trainings
            raise InputError(
                f"seeds: {seeds} is not allowed; allowed: {before}, as in {begun}, or a new --out"
            )
    missing = [run for run in wanted if not studies.has(run)]
    roads = dict.fromkeys(road for study in chosen.values() for road in study.roads)
    undriven = [road for road in roads if not (studies.drives_of(road) / EVALUATION_FILE).is_file()]
    return Plan(tuple(chosen), seeds, studies, missing, len(wanted) - len(missing), undriven)


def studies_of(names: Sequence[str]) -> dict[str, Study]:
    """Return the studies of these names; `all` is all of them."""
    for name in names:
        if name not in (*STUDIES, *TOGETHER):
            raise wrong_name("study", name, [*STUDIES, *TOGETHER])
    chosen = {study for name in names for study in TOGETHER.get(name, (name,))}
    return {name: study for name, study in STUDIES.items() if name in chosen}


def estimated_seconds(run: PlannedRun) -> float:
    """Return about how long a training takes on one core [s]."""
    config = run.config
    actual, virtual = SECONDS[config.agent][_kind(run.road)], config.virtual
    rows, roads = VIRTUAL_SECONDS * min(1.0, virtual.virtual_ratio), actual * virtual.virtual_ratio
    in_sumo = RAMP_IN_SUMO if _kind(run.road) == "on-ramp" and config.world == "sumo" else 0.0
    return config.steps / 300_000 * (actual + in_sumo + (roads if virtual.model == "road" else rows))


def _kind(road: str) -> str:
    return SCENARIOS[ROADS[road]["scenario"]].title


def reproduce(
    plan: "Plan", workers: int, executor: Executor = "local", on_line: OnProgress = lambda line: None
) -> list[Path]:
    """Make what is missing, `workers` trainings at once, draw the studies, and return their folders.

    Beside the folder of each study lies its results file, NAME.json.

    A study that was stopped goes on where it was: trainings from their last checkpoint. With `ray` they run
    on a cluster whose machines share the folder.

    Raises:
        UnjamError: a training failed; the others are there.
    """
    studies = plan.studies
    make_folder(studies.folder)
    for road in plan.roads:
        on_line(f"drivers that do not learn: {road}")
        drive_references(road, studies, workers)
    plans, logs = studies.folder / "plans", studies.folder / "logs"
    commands = {
        run.name: training_command(
            run.config, studies.folder_of(run), plans / f"{run.name}.toml", logs / f"{run.name}.log"
        )
        for run in plan.runs
    }
    run_all(commands, workers, executor, on_line)
    for name in plan.names:
        study, target = STUDIES[name], studies.folder / name
        on_line(f"writing {name}: {study.title}")
        make_folder(target)
        begun = about_study(target, seeds=plan.seeds) if study.goes_on else manifest()
        study.write(studies, plan.seeds, target, workers)
        about = {"study": name, "title": study.title, "seeds": plan.seeds, **begun}
        about["trainings"] = [_trained_by(run, studies) for run in study.runs(plan.seeds)]
        write_whole(target / "manifest.json", to_json(about, indent=1))
        collect_results(target)
    return [studies.folder / name for name in plan.names]


def _trained_by(run: PlannedRun, studies: StudyFolder) -> dict[str, Any]:
    """Return what is needed to repeat a training, and what its network is known by, whoever repeats it."""
    folder = studies.folder_of(run)
    commit = json.loads((folder / "manifest.json").read_text())["commit"]
    weights = unpack_parts(studies.controller_of(run) / "controller.unjam")[WEIGHTS]
    return {"run": run.name, "commit": commit, "weights_sha256": hash_of(weights)}


@dataclass(frozen=True)
class Plan:
    """What is still to do for some studies."""

    names: tuple[str, ...]
    seeds: int
    """of each training"""
    studies: StudyFolder
    runs: list[PlannedRun]
    """trainings, those that are finished left out"""
    finished: int
    """trainings that are there already"""
    roads: list[str]
    """where drivers that do not learn must still drive"""

    def seconds(self, workers: int) -> float:
        """Return about how long it takes on `workers` cores [s]."""
        alone = sum(estimated_seconds(run) for run in self.runs)
        alone += sum(DRIVE_SECONDS[_kind(road)] for road in self.roads)
        return alone / workers + 60.0 * sum(STUDIES[name].minutes for name in self.names)
