"""Making what studies need, each training once, and drawing them. `unjam reproduce`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unjam.controller import make_driver
from unjam.errors import InputError, wrong_name
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.scenarios.registry import SCENARIOS
from unjam.studies import STUDIES, TOGETHER
from unjam.studies.plan import ROADS, PlannedRun
from unjam.studies.pool import REFERENCES, Pool
from unjam.studies.study import Study
from unjam.training.config import load_config
from unjam.training.evaluate import evaluate, held_out_seeds, save_evaluation
from unjam.training.executors import Executor, OnLine, run_all
from unjam.training.folder import read_config
from unjam.worlds.drive import can_drive
from unjam.worlds.workers import Workers

SECONDS: dict[str, dict[str, float]] = {
    "trpo": {"ring": 45, "figure-eight": 80, "merge": 900},
    "ppo": {"ring": 75, "figure-eight": 110, "merge": 930},
    "sac": {"ring": 450, "figure-eight": 480, "merge": 1300},
}
"""what 300,000 actual steps took on one core of the machine of results/, model-free [s]"""
VIRTUAL_SECONDS = 60.0
"""what the virtual environment adds, for each virtual decision per actual one up to one [s]"""
DRIVE_SECONDS = {"ring": 60.0, "figure-eight": 60.0, "merge": 400.0}
"""what the drivers that do not learn take on a road [s]"""


@dataclass(frozen=True)
class Plan:
    """What is still to do for some studies."""

    names: tuple[str, ...]
    seeds: int
    """of each training"""
    pool: Pool
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


def make_plan(names: Sequence[str], seeds: int, pool: Pool) -> Plan:
    """Return what is still to do.

    Raises:
        InputError: an unknown study, or the folder holds such a training with other settings.
    """
    chosen = studies_of(names)
    wanted = list(dict.fromkeys(run for study in chosen.values() for run in study.runs(seeds)))
    for run in wanted:
        _check_settings(run, pool)
    missing = [run for run in wanted if not pool.has(run)]
    roads = dict.fromkeys(road for study in chosen.values() for road in study.roads)
    undriven = [road for road in roads if not pool.has_drives(road)]
    return Plan(tuple(chosen), seeds, pool, missing, len(wanted) - len(missing), undriven)


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
    virtual = VIRTUAL_SECONDS * min(1.0, config.virtual.virtual_ratio)
    return config.steps / 300_000 * (SECONDS[config.agent][_kind(run.road)] + virtual)


def _kind(road: str) -> str:
    return SCENARIOS[ROADS[road]["scenario"]].title


def _check_settings(run: PlannedRun, pool: Pool) -> None:
    folder = pool.folder_of(run)
    if not (folder / "config.toml").is_file():
        return
    before, wanted = read_config(folder), run.config
    if replace(before, workers=wanted.workers, steps=wanted.steps) != wanted:
        raise InputError(f"out: {str(folder)!r} was trained with other settings; allowed: a new folder")


def reproduce(
    plan: Plan,
    workers: int,
    executor: Executor = "local",
    told: OnLine = lambda line: None,
) -> list[Path]:
    """Make what is missing for some studies, draw them, and return their folders.

    A study that was stopped goes on where it was: trainings from their last checkpoint.

    Args:
        plan: of `make_plan`.
        workers: trainings at once.
        executor: `ray`: on a Ray cluster whose machines share the folder.
        told: told a line when something is done.

    Raises:
        UnjamError: a training failed; the others are there.
    """
    pool = plan.pool
    make_folder(pool.folder)
    for road in plan.roads:
        told(f"drivers that do not learn: {road}")
        drive_references(road, pool, workers)
    commands = {run.name: pool.command(run) for run in plan.runs}
    run_all(commands, workers, executor, told)
    written = []
    for name in plan.names:
        study = STUDIES[name]
        told(f"writing {name}: {study.title}")
        target = pool.folder / name
        make_folder(target)
        study.write(pool, plan.seeds, target, workers)
        about = {"study": name, "title": study.title, "seeds": plan.seeds, **manifest()}
        about["trainings"] = [_trained_by(run, pool) for run in study.runs(plan.seeds)]
        write_whole(target / "manifest.json", to_json(about, indent=1))
        written.append(target)
    return written


def _trained_by(run: PlannedRun, pool: Pool) -> dict[str, Any]:
    """Return what is needed to repeat a training, and what its controller is known by."""
    made = json.loads((pool.folder_of(run) / "manifest.json").read_text())
    return {"run": run.name, "commit": made["commit"], "weights_sha256": pool.weights_sha256(run)}


def drive_references(road: str, pool: Pool, workers: int) -> None:
    """Drive a road with the drivers that do not learn, on the held-out seeds of the trainings."""
    config = load_config(changes=ROADS[road])
    scenario = config.make_scenario()
    made = {label: make_driver(name, scenario.decision_step) for label, name in REFERENCES.items()}
    drivers = {label: driver for label, driver in made.items() if can_drive(driver, scenario)}
    with Workers(workers) as processes:
        found = evaluate(scenario, drivers, held_out_seeds(config.evaluation.episodes), processes)
    save_evaluation(pool.drives_of(road), found, {"scenario": config.scenario, "manifest": manifest()})
