"""Run folders: creation, resumption and checkpoints.

A checkpoint is written after each iteration, and named by iteration and hash; the newest two are kept. torch is only
imported for checkpoints, so that errors are reported quickly.
"""

import json
import logging
import os
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import tomli_w
from safetensors import safe_open

from unjam import files
from unjam.controller import make_driver
from unjam.controller.file import read_controller, trained_bytes
from unjam.drivers.check import PROBE_ROWS, check_row_independence, probe_state
from unjam.drivers.driver import Driver
from unjam.drivers.observation import feature, observation_size
from unjam.drivers.registry import driver_recipe
from unjam.drivers.requirements import merge_requirements
from unjam.drivers.user_driver import is_file_reference
from unjam.errors import DiskError, InputError, invalid_value, resume_hint
from unjam.file_names import split_names
from unjam.files import sha256_of, to_json
from unjam.folders import reject_unsafe_files
from unjam.manifest import manifest, package_versions
from unjam.parameters import build_dataclass, check_integer, read_toml
from unjam.processes import LOCK_FILE, is_locked, lock_folder
from unjam.reports.results import CONTROLLER_FILE, EVALUATION_FILE, read_progress
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.config import CONFIG_FILE, MANIFEST_FILE, RunConfig, load_config, read_config_values, to_toml
from unjam.training.fingerprint import check_file_hashes, check_fingerprint, check_settings, fingerprint
from unjam.tree import map_leaves
from unjam.trust import check_trusted_values
from unjam.worlds.backend import check_support, open_backend
from unjam.worlds.episode import can_drive, check_can_drive, check_policy_inputs
from unjam.worlds.reward import make_reward

if TYPE_CHECKING:
    from unjam.learners.algorithm import Tensors

_LOG = logging.getLogger(__name__)

CHECKPOINT_FORMAT = 7
"""format of run folders and their checkpoints; other formats are refused"""
MAX_CHECKPOINTS = 2
CONTROLLER_KINDS = "best", "latest"
"""controllers in a checkpoint: that of the best scheduled validation, and that in the folder"""
PROGRESS_FILE = "progress.jsonl"
CHECKPOINT_NAME = re.compile(r"\d{6,}-[0-9a-f]{64}\.safetensors")
"""file name of a checkpoint: iteration and hash of the content"""
ROW_MODEL_FIELDS = {"distance_to_crossing", "penetration_rate"}
"""optional inputs that the row model can predict"""


class CheckpointValues(NamedTuple):
    """The values of a checkpoint, without its tensors."""

    iteration: int
    environment_steps: int
    algorithm: Any
    fingerprint: dict[str, Any]
    sampler: dict[str, list[float]]
    best_validation: float
    expert_returns: list[float]


def check_config(config: RunConfig) -> None:
    """Raise `InputError` if an expert, input, reward, backend, baseline or model does not work on its road."""
    for task in config.task_configs().values():
        scenario = task.make_scenario()
        check_policy_inputs(task.policy.inputs, scenario, "policy.inputs")
        check_controllers(task.expert, "expert")
        expert = task.make_expert()
        check_can_drive(expert, scenario)
        driver_recipe(expert)  # workers build it
        if task.backend == "batch" or config.model.model_ratio > 0:  # both drive many roads at once
            _check_row_independence(expert, scenario)
        observation_size(task.policy.inputs, expert)
        make_reward(task.reward or scenario.reward)
        with open_backend(task.episode_backend) as backend:
            check_support(backend, scenario)
        for name in task.evaluation.baselines:
            check_controllers(name, "baseline")
            baseline = make_driver(name, scenario.control_step)
            if can_drive(baseline, scenario):
                check_can_drive(baseline, scenario, f"driver {name}")
        if config.model.model_ratio > 0 and config.model.kind == "row":
            _check_row_model(task, scenario, expert)
        elif config.model.model_ratio > 0:
            from unjam.models.registry import world_model_class  # imported late: needs torch

            world_model_class(scenario, config.model).check(scenario, config.model)
    config.make_tasks()
    if is_file_reference(config.agent):
        from unjam.learners.agent import check_agent  # imported late: needs torch

        check_agent(config.agent)


def _check_row_independence(expert: Driver, scenario: Scenario) -> None:
    """Raise `InputError` if the command of an expert for a CAV depends on other CAVs."""
    state, memory = probe_state(scenario.provided_fields), expert.initial_memory(PROBE_ROWS)

    def accelerations(rows: slice) -> Any:
        return expert.act(state.select(rows), map_leaves(lambda values: values[rows], memory))[0]

    check_row_independence(accelerations, f"driver {expert.describe()}")


def _check_row_model(config: RunConfig, scenario: Scenario, expert: Driver) -> None:
    """Raise `InputError` if the row model cannot predict an input, or does not support the actuation of CAVs."""
    features = merge_requirements(*(feature(name).requirements for name in config.policy.inputs))
    inputs = expert.requirements(scenario.interface).measured_fields | features.required_fields
    missing = sorted(inputs & set(scenario.provided_fields) - ROW_MODEL_FIELDS)
    reason = f"{expert.describe()} and the network use {', '.join(missing)}" if missing else ""
    if scenario.actuation == "cruise":
        reason = "CAVs use their own ACC"
    if reason:
        allowed = "allowed: road, or model.model_ratio 0"
        raise InputError(f"model.kind: row is not allowed on {scenario.title}, where {reason}; {allowed}")


def make_new_folder(folder: Path, alternative: str = "") -> None:
    """Make a folder; raise `InputError`, with an allowed `alternative`, if it has other files than leftovers."""
    try:
        if folder.exists() and not (
            folder.is_dir() and all(files.is_leftover(path) or path.name == LOCK_FILE for path in folder.iterdir())
        ):
            raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder{alternative}")
        files.make_folder(folder)
    except OSError as error:  # for example under /proc, or with too long a name
        reason = f"cannot be made ({error.strerror})"
        raise InputError(f"out: {str(folder)!r} {reason}; allowed: a new folder") from None


@contextmanager
def lock_new_folder(folder: Path, resumable_file: str = "") -> Iterator[None]:
    """Make and lock a folder for the block, and remove it if it stays empty.

    Raise `InputError` if the folder is locked, or has files but no `resumable_file`.
    """

    def check() -> None:
        if not (resumable_file and (folder / resumable_file).is_file()):
            make_new_folder(folder)

    check()
    with removing_if_empty(folder), lock_folder(folder):
        check()  # another process may have written to it in the meantime
        yield


@contextmanager
def removing_if_empty(folder: Path) -> Iterator[None]:
    """Remove a folder if it is empty after the block."""
    try:
        yield
    finally:
        files.remove_if_empty(folder)


@contextmanager
def empty_if_refused(folder: Path) -> Iterator[None]:
    """Empty the locked folder of a run if the block raises `InputError` before the first iteration is complete."""
    try:
        yield
    except InputError:
        if not read_progress(folder):
            for path in [path for path in folder.iterdir() if path.name != LOCK_FILE]:
                files.remove(path)
        raise


def create_run_folder(folder: Path, config: RunConfig) -> None:
    """Make the folder of a new run, with configuration and manifest; raise `InputError` if it is not empty."""
    make_new_folder(folder, f", or --resume {folder}")
    files.atomic_write(folder / CONFIG_FILE, to_toml(config))
    _write_manifest(folder)


def _write_manifest(folder: Path) -> None:
    facts = {"format": CHECKPOINT_FORMAT, "start_folder": os.path.relpath(Path.cwd(), folder.resolve()), **manifest()}
    files.atomic_write(folder / MANIFEST_FILE, to_json(facts, indent=1))


def read_config(folder: Path, check_trust: bool = True) -> RunConfig:
    """Return the configuration of a run folder; raise `InputError` if the folder is no run or has another format.

    Also raise it for untrusted Python code. Without `check_trust`, only the code of scenarios is checked, and no other
    code may be run.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no {CONFIG_FILE}")
    reject_unsafe_files(folder)
    try:
        if check_trust:
            return load_config(path)
        values = read_config_values(path)
        check_trusted_values(f"config file {path}", {name: values.get(name) for name in ("scenario", "tasks")})
        return build_dataclass(RunConfig, values, "")
    except InputError:
        with suppress(OSError, ValueError, RecursionError, AttributeError, KeyError):
            origin = json.loads((folder / MANIFEST_FILE).read_text())
            if (found_format := origin.get("format", 4)) != CHECKPOINT_FORMAT:
                version = f"format {found_format}, written by unjam {origin['unjam']} (commit {origin['commit']})"
                raise InputError(f"run: {str(folder)!r} has {version}; allowed: format {CHECKPOINT_FORMAT}") from None
        raise


def resume_run_folder(folder: Path, config: RunConfig) -> None:
    """Write the steps and workers of `config` into the run in `folder`.

    Raise `InputError` if another setting differs, if the steps are not possible, for the folder of a task, or if the
    run has lost its checkpoints.
    """
    parent = folder.absolute().parent
    if folder.name in _task_names(parent):
        raise InputError(f"resume: {str(folder)!r} is one task of a run; allowed: {parent}")
    stored, progress = read_config(folder), read_complete_progress(folder)
    if replace(stored, steps=config.steps, workers=config.workers) != config:
        raise InputError("resume: only steps and workers may change")
    if config.steps > stored.steps and stored.evaluation.should_stop_early(progress):
        reason = f"evaluation.patience or evaluation.convergence_window ended it; allowed: {stored.steps}, or a new run"
        raise InputError(f"steps: {config.steps} is not allowed: {reason}")
    done_steps = max((row.get("environment_steps", 0) for row in progress), default=0)
    if config.steps < min(stored.steps, done_steps):
        raise invalid_value("steps", config.steps, f">= {done_steps}, which are done")
    check_run_files(folder, config, "resume", ignored_prefixes=())
    is_evaluated = any((folder / task / EVALUATION_FILE).is_file() for task in stored.task_configs())
    if (is_evaluated or len(progress) > 1) and not _checkpoint_files(folder / "checkpoint"):
        reason = "has no checkpoint to continue from, and a new start would overwrite its results"
        raise InputError(f"resume: {str(folder)!r} {reason}; allowed: the run with its checkpoint/, or a new run")
    if config != stored:  # `read_config` makes file names absolute, and the stored names must not change
        values = {**read_toml(folder / CONFIG_FILE), "steps": config.steps, "workers": config.workers}
        files.atomic_write(folder / CONFIG_FILE, tomli_w.dumps(values))
    if not (folder / MANIFEST_FILE).is_file():  # the run was stopped before it wrote the manifest
        _write_manifest(folder)


def _task_names(folder: Path) -> Collection[str]:
    """Return the names of the tasks of a run folder, or an empty collection for other folders."""
    with suppress(InputError):
        if (folder / MANIFEST_FILE).is_file():
            return read_config(folder, check_trust=False).task_configs()
    return ()


def append_lineage(folder: Path, iteration: int) -> None:
    """Add the versions with which a run is resumed after an iteration to the run's manifest."""
    path = folder / MANIFEST_FILE
    origin = files.read_json_object(path)
    lineage = origin.get("lineage", [])
    if not isinstance(lineage, list):
        raise InputError(f"{path}: lineage is no list; allowed: the file as unjam wrote it")
    origin["lineage"] = [*lineage, {"iteration": iteration, **manifest()}]
    files.atomic_write(path, to_json(origin, indent=1))


def controller_origin(scenario: Scenario, expert: Driver) -> dict[str, Any]:
    """Return the entries of a controller's manifest about its origin, which are equal for equal runs."""
    return {
        "scenario": scenario_recipe(scenario),
        "time_step": scenario.control_step,
        "action_limit": scenario.action_limit,
        "expert": expert.describe(),
        "versions": package_versions(),
    }


def save_checkpoint(folder: Path, state: dict[str, Any], tensors: "Tensors") -> None:
    """Write the checkpoint of `state["iteration"]` into a folder, and remove all but the newest two."""
    from safetensors.torch import save

    data = save(tensors, {"state": json.dumps({**state, "format": CHECKPOINT_FORMAT})})
    name = f"{state['iteration']:06d}-{sha256_of(data)}.safetensors"
    files.make_folder(folder)
    files.atomic_write(folder / name, data)
    for damaged in [path for path in _checkpoint_files(folder) if path.name[:7] == name[:7] and path.name != name]:
        files.remove(damaged)
    _remove_old_checkpoints(folder)


def restore_newest_checkpoint(
    folder: Path, progress_folders: Iterable[Path], expected: dict[str, Any] | None = None
) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest checkpoint of a run, and remove later rows of progress; return None without a checkpoint.

    Raise `InputError` if all checkpoints are damaged, if the fingerprint differs from the `expected` fingerprint, or if
    a row of progress before the checkpoint is missing.
    """
    checkpoint = load_checkpoint(folder / "checkpoint")
    if checkpoint and expected and "fingerprint" in checkpoint[0]:
        check_fingerprint(checkpoint[0]["fingerprint"], expected)
    iteration = checkpoint[0]["iteration"] if checkpoint else 0
    progress = {progress_folder: _progress_until(progress_folder, iteration) for progress_folder in progress_folders}
    _remove_old_checkpoints(folder / "checkpoint")
    for progress_folder, rows in progress.items():
        files.remove_leftovers(progress_folder)
        if (progress_folder / PROGRESS_FILE).is_file():
            files.atomic_write(progress_folder / PROGRESS_FILE, "".join(to_json(row) + "\n" for row in rows))
    return checkpoint


def read_complete_progress(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of progress of a run; raise `InputError` if a row before the newest checkpoint is missing."""
    rows = read_progress(folder)
    state = next((state for _, state, _ in _valid_checkpoints(folder / "checkpoint")), {})
    newest = state.get("iteration", max((row["iteration"] for row in rows), default=0))
    _progress_until(folder, check_integer("checkpoint: iteration", newest, 0))
    return rows


def _progress_until(folder: Path, iteration: int) -> list[dict[str, Any]]:
    """Return the rows of progress up to this iteration; raise `InputError` if a row is missing."""
    rows = [row for row in read_progress(folder) if row["iteration"] <= iteration]
    for expected, found in enumerate([*(row["iteration"] for row in rows), iteration + 1], 1):
        if found != expected:
            gap = f"rows {expected} to {found - 1} are" if found > expected + 1 else f"row {expected} is"
            reason = f"{gap} missing" if found > expected else f"row {expected} is of iteration {found}"
            allowed = f"allowed: all rows up to {iteration}, as when the checkpoint was written"
            raise InputError(f"{folder / PROGRESS_FILE}: {reason}; {allowed}")
    return rows


def load_checkpoint(folder: Path) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest valid checkpoint, or None; raise `InputError` if all are damaged or of another format."""
    from safetensors.torch import load

    for path, state, data in _valid_checkpoints(folder):
        try:
            found_format, tensors = state.pop("format", 1), load(data)
        except files.INVALID_DATA_ERRORS:
            continue
        if found_format != CHECKPOINT_FORMAT:
            version = f"has format {found_format!r}, of another version of unjam"
            raise InputError(f"checkpoint: {path} {version}; allowed: {CHECKPOINT_FORMAT}")
        check_integer("checkpoint: iteration", state.get("iteration"), 0)
        return state, tensors
    if paths := _checkpoint_files(folder):
        raise InputError(f"checkpoint: all {len(paths)} under {folder} are damaged")
    return None


def _valid_checkpoints(folder: Path) -> Iterator[tuple[Path, dict[str, Any], bytes]]:
    """Yield file, state and content of the checkpoints with a correct hash, the newest first."""
    for path in reversed(_checkpoint_files(folder)):
        with suppress(*files.INVALID_DATA_ERRORS):
            data = path.read_bytes()
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            if f"-{sha256_of(data)}." in path.name:
                yield path, dict(json.loads(header["__metadata__"]["state"])), data


def check_run_files(
    folder: Path, config: RunConfig, command: str, ignored_prefixes: tuple[str, ...] = ("evaluation.",)
) -> None:
    """Raise `InputError` if files or settings with which a run was trained have changed since its checkpoint.

    `folder` is the folder of a run or of one of its tasks. A run without a checkpoint is not checked.
    """
    newest = next((state for _, state, _ in _valid_checkpoints(folder / "checkpoint")), {})
    stored = newest.get("fingerprint")
    if not stored and (name := folder.absolute().name) in _task_names(parent := folder.absolute().parent):
        run = read_config(parent)
        check_run_files(parent, run, command)
        stored = fingerprint(run.task_configs()[name])
    if stored:
        current = fingerprint(config)
        check_settings(stored, current, command, ignored_prefixes)
        check_file_hashes(stored, current, command)


def check_controllers(driver_name: str, command: str) -> None:
    """Call `check_controller` for each run folder in the name of a driver."""
    for name in split_names(driver_name):
        check_controller(Path(name), command)


def check_controller(folder: Path, command: str) -> None:
    """Raise `InputError` if the controller in the folder of a run or task is not a controller of the newest checkpoint.

    Other folders and runs that are being trained are not checked; for a run without a checkpoint a warning is logged.
    `folder` may be the path of the controller in the folder.
    """
    folder = folder.parent if folder.name == CONTROLLER_FILE else folder
    file, parent = folder / CONTROLLER_FILE, folder.absolute().parent
    tasks = [*_task_names(parent)]
    run, index = (parent, tasks.index(folder.absolute().name)) if folder.absolute().name in tasks else (folder, 0)
    newest, *_ = next(_valid_checkpoints(run / "checkpoint"), (None,))
    if not file.is_file() or is_locked(run):
        return
    if newest is None:
        if read_progress(run):
            _LOG.warning("%s: %s cannot be compared with the training: the run has no checkpoint", command, file)
        return
    stored: list[bytes] = []
    with suppress(*files.INVALID_DATA_ERRORS), safe_open(newest, "np") as tensors:
        names = {f"{kind}/{index}" for kind in CONTROLLER_KINDS} & {*tensors.keys()}
        stored = [tensors.get_tensor(name).tobytes() for name in names]
    if stored and trained_bytes(read_controller(folder)) not in stored:
        reason = "is not a controller of the newest checkpoint; allowed: the one that a resumed training writes"
        raise InputError(f"{command}: {str(file)!r} {reason}{resume_hint(run)}")


def _remove_old_checkpoints(folder: Path) -> None:
    files.remove_leftovers(folder)
    for old in _checkpoint_files(folder)[:-MAX_CHECKPOINTS]:
        with suppress(DiskError):
            files.remove(old)


def _checkpoint_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.is_file() and CHECKPOINT_NAME.fullmatch(path.name))
