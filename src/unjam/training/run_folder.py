"""The folder of a run: begun, read, gone on with, and its checkpoints and what they belong to.

Free of torch until there is a checkpoint to write or read, so that what is wrong is told at once. Checkpoints
are made at the end of iterations: written whole, checked by hash, two generations kept.
"""

import json
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unjam.controller import make_driver
from unjam.controller.file import sha256_of
from unjam.drivers.driver import Driver
from unjam.drivers.observation import feature, observation_size
from unjam.errors import DiskError, InputError, invalid_value
from unjam.files import (
    INVALID_DATA_ERRORS,
    atomic_write,
    is_leftover,
    make_folder,
    remove,
    remove_if_empty,
    to_json,
    write_folder,
)
from unjam.manifest import manifest, package_versions
from unjam.parameters import build_dataclass
from unjam.processes import LOCK_FILE, lock_folder
from unjam.reports.results import read_progress
from unjam.scenarios import scenario_recipe
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig, load_config, read_toml, to_toml
from unjam.training.early_stopping import should_stop_early
from unjam.training.fingerprint import check_file_hashes, check_fingerprint, fingerprint
from unjam.worlds.episode import check_can_drive, check_policy_inputs
from unjam.worlds.reward import make_reward

if TYPE_CHECKING:
    from unjam.learners.learner import Tensors

CHECKPOINT_FORMAT = 5
"""format of run folders and their checkpoints; other formats are refused"""
MAX_CHECKPOINTS = 2
MANIFEST_FILE, PROGRESS_FILE = "manifest.json", "progress.jsonl"
CHECKPOINT_STATE_FILE, CHECKPOINT_TENSORS_FILE = "state.json", "tensors.safetensors"
ROW_MODEL_FIELDS = {"distance_to_crossing", "penetration_rate"}
"""of what a road tells a CAV, what virtual rows go on with"""


def check_config(config: RunConfig) -> None:
    """Raise `InputError` where an expert, what the network sees, a reward or a baseline is at fault."""
    for road in config.task_configs().values():
        scenario = road.make_scenario()
        check_policy_inputs(road.policy.inputs, scenario, "policy.inputs")
        expert = road.make_expert()
        check_can_drive(expert, scenario)
        observation_size(road.policy.inputs, expert)
        make_reward(road.reward or scenario.reward)
        for name in road.evaluation.baselines:
            make_driver(name, scenario.control_step)
        if config.model.model_ratio > 0 and config.model.kind == "row":
            _check_row_model(road, scenario, expert)
        elif config.model.model_ratio > 0:
            from unjam.models.motorway_model import check_motorway_model  # which needs torch
            from unjam.models.road_model import check_road_model

            if isinstance(scenario, OnRamp):
                check_motorway_model(scenario, config.model)
            else:
                check_road_model(scenario)
    config.make_tasks()


def _check_row_model(config: RunConfig, scenario: Scenario, expert: Driver) -> None:
    """Raise `InputError` where rows cannot go on with what a CAV is told, or with how it is driven."""
    told = set(expert.measured_fields).union(*(feature(name).required_fields for name in config.policy.inputs))
    missed = sorted(told & set(scenario.provided_fields) - ROW_MODEL_FIELDS)
    why = f"{expert.describe()} and the network ask for {', '.join(missed)}" if missed else ""
    if scenario.actuation == "cruise":
        why = "CAVs have an ACC of their own"
    if why:
        allowed = "allowed: road, or model.model_ratio 0"
        raise InputError(f"model.kind: row is not allowed on {scenario.title}, where {why}; {allowed}")


def make_new_folder(folder: Path, alternative: str = "") -> None:
    """Make a folder; raise `InputError` where it holds something already, `fallback` is allowed too.

    What somebody left who was killed before anything was written is nothing.
    """
    try:
        if folder.exists() and not (
            folder.is_dir() and all(is_leftover(path) or path.name == LOCK_FILE for path in folder.iterdir())
        ):
            raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder{alternative}")
        make_folder(folder)
    except OSError as error:  # no place for a folder at all: under /proc, or of a name too long
        why = f"cannot be made ({error.strerror})"
        raise InputError(f"out: {str(folder)!r} {why}; allowed: a new folder") from None


@contextmanager
def lock_new_folder(folder: Path, resumable_file: str = "") -> Iterator[None]:
    """Make a folder, and hold it for this process alone; one that stays empty is removed again.

    It may be an old one where it has a file `or_with`.

    Raises:
        InputError: it holds something already, or another process holds it.
    """

    def check() -> None:
        if not (resumable_file and (folder / resumable_file).is_file()):
            make_new_folder(folder)

    check()
    try:
        with lock_folder(folder):
            check()  # another may have written it until just now
            yield
    finally:
        remove_if_empty(folder)  # it holds something where all went well


def create_run_folder(folder: Path, config: RunConfig) -> None:
    """Make the folder of a new run and write what it is about.

    Raises:
        InputError: the folder holds something already.
    """
    make_new_folder(folder, f", or --resume {folder}")
    atomic_write(folder / "config.toml", to_toml(config))
    atomic_write(folder / MANIFEST_FILE, to_json(manifest(), indent=1))


def read_config(folder: Path, check_trust: bool = True) -> RunConfig:
    """Return the configuration of a run folder; raise `InputError` where it is none.

    With `to_run` also where it names Python code that is not trusted: else nothing of it may be made.
    """
    if not (folder / "config.toml").is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no config.toml")
    path = folder / "config.toml"
    return load_config(path) if check_trust else build_dataclass(RunConfig, read_toml(path), "")


def resume_run_folder(folder: Path, config: RunConfig) -> None:
    """Check that `config` may go on with the run in `folder`, and write down its new budget.

    Raises:
        InputError: something else than the budget or the number of workers differs, or the folder is that of
            one road of a run of several.
    """
    whole = folder.absolute().parent
    if folder.name in _task_names(whole):
        raise InputError(f"resume: {str(folder)!r} is one road of a run of several; allowed: {whole}")
    before = read_config(folder)
    if replace(before, steps=config.steps, workers=config.workers) != config:
        raise InputError("resume: only steps and workers may change; all else is the run's")
    if config.steps > before.steps and should_stop_early(before, read_progress(folder)):
        why = f"evaluation.patience or evaluation.convergence_window ended it; allowed: {before.steps}, or a new run"
        raise InputError(f"steps: {config.steps} is not allowed: {why}")
    if config.steps < before.steps:
        made = max((row.get("environment_steps", 0) for row in read_progress(folder)), default=0)
        if config.steps < made:
            raise invalid_value("steps", config.steps, f">= {made}, which are made")
    if config != before:
        atomic_write(folder / "config.toml", to_toml(config))
    if not (folder / MANIFEST_FILE).is_file():  # it was stopped before it had written that
        atomic_write(folder / MANIFEST_FILE, to_json(manifest(), indent=1))


def _task_names(folder: Path) -> Collection[str]:
    """Return the names of the roads of a run of several; what is none has none."""
    with suppress(InputError):
        if (folder / MANIFEST_FILE).is_file():
            return read_config(folder, check_trust=False).task_configs()
    return ()


def append_lineage(folder: Path, iteration: int) -> None:
    """Add to a run's manifest by what it goes on, and after which iteration."""
    path = folder / MANIFEST_FILE
    try:
        made = json.loads(path.read_text())
        lineage = [*made.get("lineage", []), {"iteration": iteration, **manifest()}]
    except (ValueError, AttributeError, TypeError) as error:
        raise InputError(f"run: {path} cannot be read: {error}") from None
    atomic_write(path, to_json({**made, "lineage": lineage}, indent=1))


def controller_origin(scenario: Scenario, expert: Driver) -> dict[str, Any]:
    """Return where a controller comes from, for its own manifest: the same for the same run."""
    return {
        "scenario": scenario_recipe(scenario),
        "time_step": scenario.control_step,
        "action_limit": scenario.action_limit,
        "expert": expert.describe(),
        "versions": package_versions(),
    }


def save_checkpoint(folder: Path, state: dict[str, Any], tensors: "Tensors") -> None:
    """Write the checkpoint of an iteration under `folder`, and remove all but the newest two.

    `state["iteration"]` names it. It appears whole or not at all; the state holds the hash of both parts.
    """
    from safetensors.torch import save

    state, data = {**state, "format": CHECKPOINT_FORMAT}, save(tensors)
    said = json.dumps({**state, "sha256": _checkpoint_hash(state, data)}, indent=1)
    write_folder(folder / f"{state['iteration']:06d}", {CHECKPOINT_TENSORS_FILE: data, CHECKPOINT_STATE_FILE: said})
    _remove_old_checkpoints(folder)


def restore_newest_checkpoint(
    folder: Path, progress_folders: Iterable[Path], expected: dict[str, Any] | None = None
) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest checkpoint of a run; None where it begins, or begins anew.

    What the checkpoint does not know is removed: rows of progress in any of `places`, which will be made
    again, and files that were not written to their end.

    Raises:
        InputError: none is whole, or it does not belong to what would go on with it, `belongs`.
    """
    found = load_checkpoint(folder / "checkpoint")
    if found and expected and "fingerprint" in found[0]:
        check_fingerprint(found[0]["fingerprint"], expected)
    _remove_old_checkpoints(folder / "checkpoint")
    for left in [path for place in progress_folders for path in place.glob(".*") if is_leftover(path)]:
        remove(left)
    done = found[0]["iteration"] if found else 0
    for place in progress_folders:
        if (place / PROGRESS_FILE).is_file():
            kept = [to_json(row) + "\n" for row in read_progress(place) if row["iteration"] <= done]
            atomic_write(place / PROGRESS_FILE, "".join(kept))
    return found


def load_checkpoint(folder: Path) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest checkpoint that is whole; None where there was never any.

    Raises:
        InputError: there are some, and all of them are damaged, or another unjam made them.
    """
    from safetensors.torch import load

    for place, state, data in _valid_checkpoints(folder):
        try:
            found, known = state.pop("format", 1), load(data)
        except INVALID_DATA_ERRORS:
            continue
        if found != CHECKPOINT_FORMAT:
            raise InputError(
                f"checkpoint: {place} has format {found!r}, of another version of unjam; allowed: {CHECKPOINT_FORMAT}"
            )
        return state, known
    if places := _checkpoint_folders(folder):
        raise InputError(f"checkpoint: all {len(places)} under {folder} are damaged")
    return None


def _valid_checkpoints(folder: Path) -> Iterator[tuple[Path, dict[str, Any], bytes]]:
    """Yield place, state and tensors of the checkpoints whose hash is right, the newest first."""
    for place in reversed(_checkpoint_folders(folder)):
        try:
            state = json.loads((place / CHECKPOINT_STATE_FILE).read_text())
            data = (place / CHECKPOINT_TENSORS_FILE).read_bytes()
            right = state.pop("sha256") == _checkpoint_hash(state, data)
        except INVALID_DATA_ERRORS:
            continue
        if right:
            yield place, state, data


def check_run_files(folder: Path, config: RunConfig) -> None:
    """Raise `InputError` where a run that is judged was trained with other files than there are now.

    Runs without a checkpoint that is whole do not tell.
    """
    newest = next((state for _, state, _ in _valid_checkpoints(folder / "checkpoint")), {})
    if before := newest.get("fingerprint"):
        check_file_hashes(before, fingerprint(config), "evaluate")


def _remove_old_checkpoints(folder: Path) -> None:
    """Remove all but the newest two checkpoints, and those that were not written to their end."""
    for old in [*_checkpoint_folders(folder)[:-MAX_CHECKPOINTS], *filter(is_leftover, folder.glob(".*"))]:
        with suppress(DiskError):
            remove(old)


def _checkpoint_hash(state: dict[str, Any], data: bytes) -> str:
    return sha256_of(json.dumps(state, sort_keys=True).encode() + data)


def _checkpoint_folders(folder: Path) -> list[Path]:
    return sorted(place for place in folder.glob("*") if place.is_dir() and place.name.isdigit())
