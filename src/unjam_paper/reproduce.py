"""Run the trainings that studies need, each once, and write the studies: `unjam reproduce`."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from safetensors.numpy import save

import unjam
from unjam.controller import make_driver
from unjam.controller.file import load_controller
from unjam.drivers.driver import Driver
from unjam.drivers.network import network_weights
from unjam.drivers.registry import driver_recipe
from unjam.drivers.residual import ResidualDriver
from unjam.errors import InputError, unknown_name
from unjam.files import make_folder, read_json_object, sha256_of, sha256_of_file, to_json
from unjam.manifest import manifest, package_versions
from unjam.reports.results import read_results
from unjam.scenarios import SCENARIOS, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.seeds import held_out_seeds
from unjam.training.config import MANIFEST_FILE, RunConfig, load_config
from unjam.training.evaluate import evaluate, raise_failures, save_evaluation
from unjam.training.executors import CommandLine, Executor, run_all, training_command
from unjam.training.run_folder import read_config
from unjam.worlds.episode import can_drive
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import collect_results
from unjam_paper.studies import STUDIES, STUDY_GROUPS
from unjam_paper.study import FILTERED_ROADS, STUDY_ROADS, PlannedRun, Study, StudyFolder, write_manifest
from unjam_paper.variants import REFERENCE_DRIVERS, TUNED_REFERENCES

TRAINING_SECONDS: dict[str, dict[str, float]] = {
    "trpo": {"ring": 45, "figure-eight": 80, "merge": 900, "motorway": 170},
    "ppo": {"ring": 75, "figure-eight": 110, "merge": 930, "motorway": 190},
    "sac": {"ring": 450, "figure-eight": 480, "merge": 1300},
}
"""duration of 300,000 environment steps without a model, on one core of the machine of results/ [s]; motorways: in
batches"""
SUMO_ON_RAMP_SECONDS = 1150.0
"""additional duration where episodes of motorways run in SUMO [s]"""
MODEL_ROLLOUT_SECONDS = 60.0
"""additional duration with a model of rows and a model ratio of one or more [s]"""
REFERENCE_SECONDS = {"ring": 60.0, "figure-eight": 60.0, "merge": 400.0, "motorway": 1500.0}
"""duration of the reference drivers on a road [s]"""
INPUTS_HASH = "inputs_sha256"
"""entry of the metadata of reference evaluations with the hash of their inputs"""
EPISODE_PARTS = ("drivers", "measures", "physics", "scenarios", "worlds")
"""subpackages of unjam that episodes and their metrics depend on"""


@dataclass(frozen=True)
class StudyPlan:
    """The trainings and evaluations that some studies still need."""

    names: tuple[str, ...]
    seeds: int
    study_folder: StudyFolder
    runs: list[PlannedRun]
    """trainings that are not finished"""
    finished_count: int
    roads: list[str]
    """roads without a current evaluation of the reference drivers"""

    def seconds(self, workers: int) -> float:
        """Return the estimated duration on `workers` cores [s]."""
        seconds = sum(estimated_seconds(run) for run in self.runs)
        seconds += sum(REFERENCE_SECONDS[_scenario_kind(road)] for road in self.roads)
        return seconds / workers + 60.0 * sum(STUDIES[name].minutes for name in self.names)


def make_plan(names: Sequence[str], seeds: int, study_folder: StudyFolder) -> StudyPlan:
    """Return the plan of studies; `InputError` for unknown studies, or trainings that have other settings."""
    studies = find_studies(names)
    runs = list(dict.fromkeys(run for study in studies.values() for run in study.make_runs(seeds)))
    for run in runs:
        folder = study_folder.run_folder(run)
        if (folder / "config.toml").is_file():
            previous_config = replace(read_config(folder), workers=run.config.workers, steps=run.config.steps)
            if previous_config != run.config:
                raise InputError(f"out: {str(folder)!r} was trained with other settings; allowed: a new folder")
    missing_runs = [run for run in runs if not study_folder.is_finished(run)]
    roads = dict.fromkeys(road for study in studies.values() for road in study.roads)
    missing_roads = [road for road in roads if not _has_current_references(road, study_folder)]
    return StudyPlan(tuple(studies), seeds, study_folder, missing_runs, len(runs) - len(missing_runs), missing_roads)


def find_studies(names: Sequence[str]) -> dict[str, Study]:
    """Return the studies and groups of studies with these names; raise `InputError` for an unknown one."""
    for name in names:
        if name not in (*STUDIES, *STUDY_GROUPS):
            raise unknown_name("study", name, [*STUDIES, *STUDY_GROUPS])
    selected = {study for name in names for study in STUDY_GROUPS.get(name, (name,))}
    return {name: study for name, study in STUDIES.items() if name in selected}


def estimated_seconds(run: PlannedRun) -> float:
    """Return the estimated duration of a training on one core [s]."""
    config, kind = run.config, _scenario_kind(run.road)
    seconds, ratio = TRAINING_SECONDS[config.agent][kind], config.model.model_ratio
    model_seconds = seconds * ratio if config.model.kind == "road" else MODEL_ROLLOUT_SECONDS * min(1.0, ratio)
    sumo_seconds = SUMO_ON_RAMP_SECONDS if kind == "motorway" and config.backend == "sumo" else 0.0
    return config.steps / 300_000 * (seconds + sumo_seconds + model_seconds)


def _scenario_kind(road: str) -> str:
    return SCENARIOS[STUDY_ROADS[road]["scenario"]].title


def run_plan(
    plan: StudyPlan, workers: int, executor: Executor = "local", on_message: Callable[[str], None] = lambda line: None
) -> list[Path]:
    """Run the missing trainings, `workers` at a time, write the studies, and return their folders.

    The results file of each study is written next to its folder. Stopped trainings continue from their last checkpoint.
    With `ray` trainings run on a cluster with a shared folder. Raise `UnjamError` at the end if a training failed.
    """
    study_folder = plan.study_folder
    make_folder(study_folder.folder)
    for road in plan.roads:
        on_message(f"reference drivers: {road}")
        drive_references(road, study_folder, workers)
    commands: dict[str, CommandLine] = {}
    for run in plan.runs:
        config = study_folder.folder / "configs" / f"{run.name}.toml"
        log = study_folder.folder / "logs" / f"{run.name}.log"
        commands[run.name] = training_command(run.config, study_folder.run_folder(run), config, log)
    run_all(commands, workers, executor, on_message)
    for name in plan.names:
        study, folder = STUDIES[name], study_folder.folder / name
        on_message(f"writing {name}: {study.title}")
        trainings = [_training_record(run, study_folder) for run in study.make_runs(plan.seeds)]
        write_manifest(folder, study=name, title=study.title, seeds=plan.seeds, trainings=trainings)
        study.run(study_folder, plan.seeds, folder, workers)
        collect_results(folder)
    return [study_folder.folder / name for name in plan.names]


def drive_references(road: str, study_folder: StudyFolder, workers: int) -> None:
    """Evaluate the reference drivers of a road on the test seeds of the trainings."""
    config, scenario, drivers = _reference_drivers(road)
    with WorkerPool(workers) as pool:
        evaluation = evaluate(scenario, drivers, held_out_seeds(config.evaluation.episodes), pool)
    raise_failures(evaluation)
    metadata = {"scenario": config.scenario, "manifest": manifest(), INPUTS_HASH: _reference_inputs_hash(road)}
    save_evaluation(study_folder.reference_folder(road), evaluation, metadata)


def _reference_drivers(road: str) -> tuple[RunConfig, Scenario, dict[str, Driver]]:
    """Return the run configuration and the scenario of a road, and its reference drivers by label."""
    config = load_config(changes=STUDY_ROADS[road])
    scenario = config.make_scenario()
    names = {**REFERENCE_DRIVERS, **TUNED_REFERENCES.get(FILTERED_ROADS.get(road, road), {})}
    drivers = {label: make_driver(name, scenario.control_step) for label, name in names.items()}
    return config, scenario, {label: driver for label, driver in drivers.items() if can_drive(driver, scenario)}


def _reference_inputs_hash(road: str) -> str:
    """Return a hash of all inputs of the evaluation of the reference drivers on a road."""
    config, scenario, drivers = _reference_drivers(road)
    recipes = [(label, *driver_recipe(driver)) for label, driver in drivers.items()]
    weights = b"".join(save(arrays) for _, _, arrays in recipes)
    settings = [config.evaluation.episodes, scenario_recipe(scenario), [recipe for *recipe, _ in recipes]]
    return sha256_of(to_json([*settings, package_versions(), _episode_code_hash()]).encode() + weights)


@cache
def _episode_code_hash() -> str:
    """Return a hash of the source code that episodes and their metrics depend on."""
    files = sorted(path for part in EPISODE_PARTS for path in (Path(unjam.__file__).parent / part).rglob("*.py"))
    return sha256_of("".join(map(sha256_of_file, files)).encode())


def _has_current_references(road: str, study_folder: StudyFolder) -> bool:
    """Return whether the evaluation of the reference drivers of a road is intact and has the present inputs."""
    with suppress(InputError):
        stored_hash = read_results(study_folder.reference_folder(road)).metadata.get(INPUTS_HASH)
        return stored_hash == _reference_inputs_hash(road)
    return False


def _training_record(run: PlannedRun, study_folder: StudyFolder) -> dict[str, Any]:
    """Return the entry of a training in the manifest of a study, with a hash of its weights."""
    commit = read_json_object(study_folder.run_folder(run) / MANIFEST_FILE).get("commit", "")
    driver = load_controller(study_folder.controller_folder(run))
    assert isinstance(driver, ResidualDriver)
    return {"run": run.name, "commit": commit, "weights_sha256": sha256_of(save(network_weights(driver.network)))}
