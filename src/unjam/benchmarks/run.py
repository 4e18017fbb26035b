"""Run a benchmark: the human baseline and a driver on the test seeds of each road of a suite."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from unjam.benchmarks.result import (
    FAMILY_METRICS,
    FAMILY_TEST_SEEDS,
    MAX_LABEL_CHARACTERS,
    BenchmarkResult,
    RoadRecord,
    read_result,
    to_columns,
    write_result,
)
from unjam.benchmarks.suites import DEFAULT_SUITE, Suite, find_suite
from unjam.controller import DEFAULT_DRIVER, controller_hash, controller_path, make_driver
from unjam.controller.domain import SB3_SUFFIX, control_step_note
from unjam.controller.file import read_controller
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_recipe, is_serializable, user_code_recipes
from unjam.drivers.user_driver import DriverLike, as_driver, code_hashes
from unjam.errors import InputError, invalid_value, raise_failure, unknown_name
from unjam.files import make_folder, sha256_of, sha256_of_file, to_json
from unjam.manifest import manifest, strip_folders
from unjam.measures.gain import EpisodeRows
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.parameters import check_integer, split_parameters
from unjam.processes import lock_file
from unjam.road_family import FAMILY_PREFIX
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.text import format_count, to_one_line
from unjam.training.run_folder import check_controllers
from unjam.worlds.backend import BackendLike, check_support, open_backend
from unjam.worlds.batch.run import run_batches
from unjam.worlds.batch.support import unsupported_reason
from unjam.worlds.episode import check_can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

EXACT_BACKEND = (
    "exact"  # default backend of benchmarks: the batch if its episodes are identical to those of SUMO, else SUMO
)
MAX_TRAINING_STEPS = 2**53  # environment steps that a result can record
Seeds = Sequence[tuple[int, ...]]


def benchmark(
    driver: str | DriverLike = DEFAULT_DRIVER,
    suite: str = DEFAULT_SUITE,
    out: str | Path | None = None,
    workers: int | None = None,
    backend: str = EXACT_BACKEND,
    training_steps: int | None = None,
    progress: Callable[[str], object] = lambda line: None,
    roads: Sequence[str] = (),
) -> BenchmarkResult:
    """Evaluate a driver and the human baseline on the test seeds of each road of a suite.

    Args:
        driver: a name as in `drive`, or a Python object, which is called in this process.
        suite: `all-roads-v1`, `closed-roads-v1` or `motorways-v1`.
        out: file for the result, written after each road; a second call continues with the missing roads.
        workers: number of processes, by default that of cores; it does not change the result.
        backend: `exact`: the batch on rings for drivers without user code, SUMO for other roads and drivers; or the
            simulator of all episodes: `sumo`, `batch` or `path.py:name`.
        training_steps: control steps in the simulator, in all environments together, with which the driver was trained
            or tuned; the number in a controller file has priority.
        progress: called with a line after each road.
        roads: names of roads of the suite to which a trial is limited; its result cannot be compared.

    Raises:
        InputError: an argument is wrong, the driver fails or can drive on no road, `out` has another result, or
            another process is writing `out`.
    """
    selected = _select_roads(roads, find_suite(suite))
    scenarios = {name: make_scenario(f"{FAMILY_PREFIX}{name}") for name in find_suite(suite).roads}
    for name, value, *limits in (("workers", workers, 1), ("training_steps", training_steps, 0, MAX_TRAINING_STEPS)):
        if value is not None:
            check_integer(name, value, *limits)
    if not (out is None or (isinstance(out, str | os.PathLike) and Path(out).name)):
        raise invalid_value("out", out, "the path of a file")
    if not callable(progress):
        raise invalid_value("progress", progress, "a function of a line of text")
    drivers, errors = _make_drivers(driver, scenarios)
    if isinstance(driver, str):
        check_controllers(driver, "benchmark")
    if backend != EXACT_BACKEND:
        with open_backend(backend) as opened_backend:
            check_support(opened_backend, *scenarios.values())
    label, any_driver = driver if isinstance(driver, str) else "", next(iter(drivers.values()))
    if label.endswith(SB3_SUFFIX):
        progress(control_step_note(label, (scenario.control_step for scenario in scenarios.values())))
    origin = manifest()
    result = BenchmarkResult(
        suite=suite,
        driver=to_one_line(strip_folders([label])[0] or any_driver.describe(), MAX_LABEL_CHARACTERS),
        sha256=_driver_hash(label, any_driver),
        training_steps=_recorded_steps(label) or training_steps,
        manifest={
            **origin,
            "command": strip_folders(origin["command"]),
            "backend": backend,
            "backend_sha256": next(iter(code_hashes([str(backend)]).values()), None),
        },
    )
    path, lock = None if out is None else Path(out), nullcontext()
    if path is not None:
        if path.is_symlink():
            raise invalid_value("out", str(path), "a file, and no link")
        make_folder(path.parent)
        lock = lock_file(path.with_name(f".{path.name}.lock"), f"out: {str(path)!r}")
    with lock, WorkerPool(workers or os.cpu_count() or 1) as pool:
        if path is not None and os.path.lexists(path):
            result = _stored_result(path, result)
            stored_count = len({*selected} - {*result.missing_roads})
            progress(f"{stored_count} of {format_count(len(selected), 'road')} in {path.name}; not driven again")
        remaining = [name for name in result.missing_roads if name in selected]
        for number, name in enumerate(remaining, len(selected) - len(remaining) + 1):
            scenario = scenarios[name]
            human = make_driver(HUMAN_LABEL, scenario.control_step)
            simulator, rows = human_simulator, baseline = _drive_road(scenario, human, backend, pool)
            if (road_driver := drivers.get(name)) != human:
                simulator, rows = human_simulator, []
                if road_driver:
                    simulator, rows = _drive_road(scenario, road_driver, backend, pool)
            record = RoadRecord(simulator, to_columns(baseline), to_columns(rows), to_one_line(errors.get(name, "")))
            result = replace(result, roads={**result.roads, name: record})
            if path is not None:
                write_result(path, result)
            row = result.road_rows()[len(result.roads) - 1]
            progress(f"{number} of {len(selected)}: {name}: gain {row['gain']:.2f}, {row['feasible']}")
    return result


def _select_roads(roads: Sequence[str], suite: Suite) -> Sequence[str]:
    """Return the names of `roads` without `family/`, or else of all roads of a suite; `InputError` if unknown."""
    if isinstance(roads, str) or not isinstance(roads, Sequence):
        raise invalid_value("roads", roads, f"a list of names of roads of {suite.name}")
    names = [str(name).removeprefix(FAMILY_PREFIX) for name in roads]
    for name in names:
        if name not in suite.roads:
            raise unknown_name(f"roads of {suite.name}", name, suite.roads)
    return names or suite.roads


def _make_drivers(
    driver: str | DriverLike, scenarios: dict[str, Scenario]
) -> tuple[dict[str, Driver], dict[str, InputError]]:
    """Return drivers and errors by road: the driver, or why it cannot drive; raise the error if no road is possible."""
    drivers, errors = dict[str, Driver](), dict[str, InputError]()
    for name, scenario in scenarios.items():
        try:
            step = scenario.control_step
            road_driver = make_driver(driver, step) if isinstance(driver, str) else as_driver(driver, step)
            check_can_drive(road_driver, scenario)
            drivers[name] = road_driver
        except InputError as error:
            errors[name] = error
    if not drivers:
        raise next(iter(errors.values()))
    return drivers, errors


def _drive_road(scenario: Scenario, driver: Driver, backend: str, pool: WorkerPool) -> tuple[str, EpisodeRows]:
    """Return the simulator, and a row of metrics for each test seed; raise the error of the first failed episode."""
    is_exact = backend == EXACT_BACKEND
    simulator = "sumo" if is_exact else backend
    tasks = make_tasks(scenario, driver, FAMILY_TEST_SEEDS, simulator)
    # Code of users may combine rows, and the rows of a batch are CAVs of different roads.
    can_batch = is_exact and not unsupported_reason(scenario) and is_serializable(driver)
    if can_batch and not user_code_recipes(driver_recipe(driver)[0]):
        return "batch", [_measure_episode(index, episode) for index, episode in enumerate(run_batches(tasks))]
    if tasks[0].is_serializable:
        return simulator, pool.run_and_map(tasks, _measure_episode)
    return simulator, [_measure_episode(0, run_episode(**vars(task))) for task in tasks]


def _measure_episode(index: int, episode: Episode) -> dict[str, Any]:
    raise_failure([row := measure(episode)])
    return row


def make_tasks(scenario: Scenario, driver: Driver, seeds: Seeds, backend: BackendLike = "sumo") -> list[EpisodeTask]:
    """Return an episode task of a driver for each seed; together they cover the range of sizes of the road evenly."""
    strata = (scenario.stratum(index, len(seeds)) for index in range(len(seeds)))
    return [EpisodeTask(road, driver, seed, backend=backend) for road, seed in zip(strata, seeds, strict=True)]


def drive_by_label(
    scenario: Scenario, drivers: Mapping[str, str], seeds: Seeds, workers: WorkerPool, in_batches: bool
) -> dict[str, EpisodeRows]:
    """Return the rows of `FAMILY_METRICS` of drivers by label; `drivers` has the names of the drivers by label.

    With `in_batches`, episodes run in batches if batches support the scenario.
    """
    drivers_by_label = {label: make_driver(name, scenario.control_step) for label, name in drivers.items()}
    tasks = {label: make_tasks(scenario, driver, seeds) for label, driver in drivers_by_label.items()}
    if in_batches and not unsupported_reason(scenario):
        return {label: list(map(_family_metrics, run_batches(road_tasks))) for label, road_tasks in tasks.items()}
    # Workers return metrics only, because an episode of a motorway takes 80 MB.
    rows = iter(workers.run_and_map([*chain(*tasks.values())], lambda index, episode: _family_metrics(episode)))
    return {label: [next(rows) for _ in road_tasks] for label, road_tasks in tasks.items()}


def _family_metrics(episode: Episode) -> dict[str, Any]:
    row = measure(episode)
    return {key: row[key] for key in FAMILY_METRICS}


def _driver_hash(label: str, driver: Driver) -> str | None:
    """Return the SHA-256 of the driver's file, or else of its recipe, code and weights; None for a Python object."""
    if sha256 := label and controller_hash(label):
        return sha256
    if not is_serializable(driver):
        file, parameters = split_parameters(label)  # the file is that of a policy of another library
        if not file or not Path(file).is_file():
            return None
        content = sha256_of_file(Path(file))
        return sha256_of(to_json([content, parameters]).encode()) if parameters else content
    recipe, arrays = driver_recipe(driver)
    for code_recipe in user_code_recipes(recipe):  # contains the hash of the code, too
        code_recipe["path"] = Path(code_recipe["path"]).name
    return sha256_of(to_json(recipe).encode() + save(arrays))


def _recorded_steps(label: str) -> int | None:
    """Return the environment steps in a controller file, for training or tuning; None if unknown."""
    path = controller_path(label) if label else None
    if path is None:
        return None
    stored = read_controller(path).manifest
    tuning = stored.get("tuning", {})
    return stored.get("environment_steps") or tuning.get("environment_steps", 0) + tuning.get("batch_steps", 0) or None


def _stored_result(path: Path, new: BenchmarkResult) -> BenchmarkResult:
    """Return the result in a file to continue it; raise `InputError` unless driver and versions are the same."""
    stored = read_result(path)

    def identity(result: BenchmarkResult) -> dict[str, Any]:
        origin = result.manifest
        sumo = (origin.get("packages") or {}).get("eclipse-sumo")
        return {
            **{"suite": result.suite, "driver": result.driver, "hash of the driver": result.sha256},
            **{"training steps": result.training_steps, "backend": origin.get("backend")},
            **{"hash of the backend": origin.get("backend_sha256"), "unjam": origin.get("unjam"), "SUMO": sumo},
        }

    if new.sha256 is None:
        raise invalid_value("out", str(path), "a new file: it is unknown whether a Python object has changed")
    for (key, expected), stored_value in zip(identity(new).items(), identity(stored).values(), strict=True):
        if stored_value != expected:
            raise InputError(
                f"out: {path} has {key} {stored_value!r}, not {expected!r}; allowed: the same, or a new file"
            )
    return replace(stored, manifest=stored.manifest | {"command": new.manifest["command"]})
