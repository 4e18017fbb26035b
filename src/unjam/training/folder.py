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
from unjam.controller.file import hash_of
from unjam.drivers.driver import Driver
from unjam.drivers.observation import feature, observation_size
from unjam.errors import DiskError, InputError, wrong
from unjam.files import (
    DAMAGED,
    is_leftover,
    make_folder,
    remove,
    remove_if_empty,
    to_json,
    write_folder,
    write_whole,
)
from unjam.manifest import manifest, package_versions
from unjam.parameters import build
from unjam.processes import LOCK, owned
from unjam.reports.results import read_progress
from unjam.scenarios import scenario_recipe
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.scenario import Scenario
from unjam.training.belonging import belonging, check_belongs, check_files
from unjam.training.config import RunConfig, load_config, read_toml, to_toml
from unjam.training.stopping import ends_early
from unjam.worlds.episode import check_can_drive, check_can_see
from unjam.worlds.reward import make_reward

if TYPE_CHECKING:
    from unjam.learners.learner import Tensors

FORMAT = 4
"""of what a checkpoint holds; one of another unjam is refused"""
GENERATIONS = 2
MANIFEST, PROGRESS = "manifest.json", "progress.jsonl"
STATE, TENSORS = "state.json", "tensors.safetensors"
ROWS_TELL = {"to_crossing", "cav_share"}
"""of what a road tells a CAV, what virtual rows go on with"""


def check_possible(config: RunConfig) -> None:
    """Raise `InputError` where an expert, what the network sees, a reward or a baseline is at fault."""
    for road in config.roads().values():
        scenario = road.make_scenario()
        check_can_see(road.policy.observe, scenario, "policy.observe")
        expert = road.make_expert()
        check_can_drive(expert, scenario)
        observation_size(road.policy.observe, expert)
        make_reward(road.reward or scenario.reward)
        for name in road.evaluation.baselines:
            make_driver(name, scenario.decision_step)
        if config.virtual.virtual_ratio > 0 and config.virtual.model == "row":
            _check_rows(road, scenario, expert)
        elif config.virtual.virtual_ratio > 0:
            from unjam.virtual.motorways import check_motorways  # which needs torch
            from unjam.virtual.roads import check_roads

            if isinstance(scenario, OnRamp):
                check_motorways(scenario, config.virtual)
            else:
                check_roads(scenario)
    config.make_tasks()


def _check_rows(road: RunConfig, scenario: Scenario, expert: Driver) -> None:
    """Raise `InputError` where rows cannot go on with what a CAV is told, or with how it is driven."""
    told = set(expert.asks).union(*(feature(name).told for name in road.policy.observe))
    missed = sorted(told & set(scenario.tells) - ROWS_TELL)
    why = f"{expert.describe()} and the network ask for {', '.join(missed)}" if missed else ""
    if scenario.actuation == "cruise":
        why = "CAVs have an ACC of their own"
    if why:
        allowed = "allowed: road, or virtual.virtual_ratio 0"
        raise InputError(f"virtual.model: row is not allowed on {scenario.title}, where {why}; {allowed}")


def make_new_folder(folder: Path, otherwise: str = "") -> None:
    """Make a folder; raise `InputError` where it holds something already, `otherwise` is allowed too.

    What somebody left who was killed before anything was written is nothing.
    """
    try:
        if folder.exists() and not (
            folder.is_dir() and all(is_leftover(path) or path.name == LOCK for path in folder.iterdir())
        ):
            raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder{otherwise}")
        make_folder(folder)
    except OSError as error:  # no place for a folder at all: under /proc, or of a name too long
        why = f"cannot be made ({error.strerror})"
        raise InputError(f"out: {str(folder)!r} {why}; allowed: a new folder") from None


@contextmanager
def new_and_owned(folder: Path, or_with: str = "") -> Iterator[None]:
    """Make a folder, and hold it for this process alone; one that stays empty is removed again.

    It may be an old one where it has a file `or_with`.

    Raises:
        InputError: it holds something already, or another process holds it.
    """

    def check() -> None:
        if not (or_with and (folder / or_with).is_file()):
            make_new_folder(folder)

    check()
    try:
        with owned(folder):
            check()  # another may have written it until just now
            yield
    finally:
        remove_if_empty(folder)  # it holds something where all went well


def start_folder(folder: Path, config: RunConfig) -> None:
    """Make the folder of a new run and write what it is about.

    Raises:
        InputError: the folder holds something already.
    """
    make_new_folder(folder, f", or --resume {folder}")
    write_whole(folder / "config.toml", to_toml(config))
    write_whole(folder / MANIFEST, to_json(manifest(), indent=1))


def read_config(folder: Path, to_run: bool = True) -> RunConfig:
    """Return the configuration of a run folder; raise `InputError` where it is none.

    With `to_run` also where it names Python code that is not trusted: else nothing of it may be made.
    """
    if not (folder / "config.toml").is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no config.toml")
    path = folder / "config.toml"
    return load_config(path) if to_run else build(RunConfig, read_toml(path), "")


def continue_folder(folder: Path, config: RunConfig) -> None:
    """Check that `config` may go on with the run in `folder`, and write down its new budget.

    Raises:
        InputError: something else than the budget or the number of workers differs, or the folder is that of
            one road of a run of several.
    """
    whole = folder.absolute().parent
    if folder.name in _roads_of(whole):
        raise InputError(f"resume: {str(folder)!r} is one road of a run of several; allowed: {whole}")
    before = read_config(folder)
    if replace(before, steps=config.steps, workers=config.workers) != config:
        raise InputError("resume: only steps and workers may change; all else is the run's")
    if config.steps > before.steps and ends_early(before, read_progress(folder)):
        why = f"evaluation.patience or evaluation.converged ended it; allowed: {before.steps}, or a new run"
        raise InputError(f"steps: {config.steps} is not allowed: {why}")
    if config.steps < before.steps:
        made = max((row.get("actual_steps", 0) for row in read_progress(folder)), default=0)
        if config.steps < made:
            raise wrong("steps", config.steps, f">= {made}, which are made")
    if config != before:
        write_whole(folder / "config.toml", to_toml(config))
    if not (folder / MANIFEST).is_file():  # it was stopped before it had written that
        write_whole(folder / MANIFEST, to_json(manifest(), indent=1))


def _roads_of(folder: Path) -> Collection[str]:
    """Return the names of the roads of a run of several; what is none has none."""
    with suppress(InputError):
        if (folder / MANIFEST).is_file():
            return read_config(folder, to_run=False).roads()
    return ()


def note_lineage(folder: Path, iteration: int) -> None:
    """Add to a run's manifest by what it goes on, and after which iteration."""
    path = folder / MANIFEST
    try:
        made = json.loads(path.read_text())
        lineage = [*made.get("lineage", []), {"iteration": iteration, **manifest()}]
    except (ValueError, AttributeError, TypeError) as error:
        raise InputError(f"run: {path} cannot be read: {error}") from None
    write_whole(path, to_json({**made, "lineage": lineage}, indent=1))


def origin(scenario: Scenario, expert: Driver) -> dict[str, Any]:
    """Return where a controller comes from, for its own manifest: the same for the same run."""
    return {
        "scenario": scenario_recipe(scenario),
        "time_step": scenario.decision_step,
        "action_limit": scenario.action_limit,
        "expert": expert.describe(),
        "versions": package_versions(),
    }


def save_checkpoint(folder: Path, state: dict[str, Any], tensors: "Tensors") -> None:
    """Write the checkpoint of an iteration under `folder`, and remove all but the newest two.

    `state["iteration"]` names it. It appears whole or not at all; the state holds the hash of both parts.
    """
    from safetensors.torch import save

    state, data = {**state, "format": FORMAT}, save(tensors)
    said = json.dumps({**state, "sha256": _hash(state, data)}, indent=1)
    write_folder(folder / f"{state['iteration']:06d}", {TENSORS: data, STATE: said})
    _sweep(folder)


def last_state(
    folder: Path, places: Iterable[Path], belongs: dict[str, Any] | None = None
) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest checkpoint of a run; None where it begins, or begins anew.

    What the checkpoint does not know is removed: rows of progress in any of `places`, which will be made
    again, and files that were not written to their end.

    Raises:
        InputError: none is whole, or it does not belong to what would go on with it, `belongs`.
    """
    found = load_checkpoint(folder / "checkpoint")
    if found and belongs and "belongs" in found[0]:
        check_belongs(found[0]["belongs"], belongs)
    _sweep(folder / "checkpoint")
    for left in [path for place in places for path in place.glob(".*") if is_leftover(path)]:
        remove(left)
    done = found[0]["iteration"] if found else 0
    for place in places:
        if (place / PROGRESS).is_file():
            kept = [to_json(row) + "\n" for row in read_progress(place) if row["iteration"] <= done]
            write_whole(place / PROGRESS, "".join(kept))
    return found


def load_checkpoint(folder: Path) -> "tuple[dict[str, Any], Tensors] | None":
    """Return the newest checkpoint that is whole; None where there was never any.

    Raises:
        InputError: there are some, and all of them are damaged, or another unjam made them.
    """
    from safetensors.torch import load

    for place, state, data in _whole(folder):
        try:
            found, known = state.pop("format", 1), load(data)
        except DAMAGED:
            continue
        if found != FORMAT:
            raise InputError(
                f"checkpoint: {place} has format {found!r}, of another version of unjam; allowed: {FORMAT}"
            )
        return state, known
    if places := _places(folder):
        raise InputError(f"checkpoint: all {len(places)} under {folder} are damaged")
    return None


def _whole(folder: Path) -> Iterator[tuple[Path, dict[str, Any], bytes]]:
    """Yield place, state and tensors of the checkpoints whose hash is right, the newest first."""
    for place in reversed(_places(folder)):
        try:
            state = json.loads((place / STATE).read_text())
            data = (place / TENSORS).read_bytes()
            right = state.pop("sha256") == _hash(state, data)
        except DAMAGED:
            continue
        if right:
            yield place, state, data


def check_files_of(folder: Path, config: RunConfig) -> None:
    """Raise `InputError` where a run that is judged was trained with other files than there are now.

    Runs without a checkpoint that is whole do not tell.
    """
    newest = next((state for _, state, _ in _whole(folder / "checkpoint")), {})
    if before := newest.get("belongs"):
        check_files(before, belonging(config), "evaluate")


def _sweep(folder: Path) -> None:
    """Remove all but the newest two checkpoints, and those that were not written to their end."""
    for old in [*_places(folder)[:-GENERATIONS], *filter(is_leftover, folder.glob(".*"))]:
        with suppress(DiskError):
            remove(old)


def _hash(state: dict[str, Any], data: bytes) -> str:
    return hash_of(json.dumps(state, sort_keys=True).encode() + data)


def _places(folder: Path) -> list[Path]:
    return sorted(place for place in folder.glob("*") if place.is_dir() and place.name.isdigit())
