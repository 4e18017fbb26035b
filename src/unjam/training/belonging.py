"""What a training belongs to: its settings, and hashes of the code, networks and packages in it."""

import json
import logging
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from unjam.controller.file import hash_of, hash_of_file
from unjam.drivers.from_file import FileReference, is_file_reference
from unjam.drivers.registry import recipe_of
from unjam.errors import InputError, wrong
from unjam.files import to_json
from unjam.kernels import kernels
from unjam.manifest import package_versions
from unjam.parameters import flat
from unjam.scenarios.own_network import OwnNetwork
from unjam.scenarios.population import population_file
from unjam.scenarios.scenario import Scenario
from unjam.sumo_files import read_sumo_files
from unjam.training.config import RunConfig
from unjam.worlds.episode import Task

LOG = logging.getLogger(__name__)


def belonging(config: RunConfig) -> dict[str, Any]:
    """Return what a training's result depends on, as JSON.

    Returns:
        `settings`: all but steps and workers, by name; `files`: hashes of the expert, and of the user's own
        code and networks; `packages` and `kernels`: what it computes with.
    """
    roads = zip(config.roads().values(), config.make_tasks(), strict=True)
    files = {name: sha256 for road, task in roads for name, sha256 in _files(road, task).items()}
    settings = flat(asdict(replace(config, steps=1, workers=1)))
    found = {"settings": settings, "files": files, "packages": package_versions(), "kernels": kernels()}
    return json.loads(to_json(found))


def check_belongs(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Compare what a checkpoint belongs to with what would go on; other packages and kernels are only told.

    Raises:
        InputError: a setting, the expert, or a file of the user's own is another one.
    """
    for name, value in now["settings"].items():
        if name in before["settings"] and before["settings"][name] != value:
            raise wrong(f"resume: {name}", value, f"{before['settings'][name]!r}, as in the checkpoint")
    check_files(before, now, "resume")
    for part in ("packages", "kernels"):
        if before[part] != now[part]:
            LOG.warning("resume: other %s than the checkpoint's: the result is not what it would be", part)


def check_files(before: dict[str, Any], now: dict[str, Any], doing: str) -> None:
    """Raise `InputError` where the expert, or a file of the user's own, is another one."""
    for name in sorted(before["files"].keys() | now["files"].keys()):
        if before["files"].get(name) != now["files"].get(name):
            raise InputError(f"{doing}: {name} has changed since the checkpoint; allowed: as it was then")


def _files(road: RunConfig, task: Task) -> dict[str, str]:
    """Return hashes by what they are of."""
    recipe, arrays = recipe_of(task.expert)
    weights = b"".join(arrays[name].tobytes() for name in sorted(arrays))
    found = {f"expert {road.expert}": hash_of(json.dumps(recipe, sort_keys=True).encode() + weights)}
    return found | hashes_of_files((road.reward, *road.policy.observe), task.scenario)


def hashes_of_files(names: Iterable[str], *scenarios: Scenario) -> dict[str, str]:
    """Return hashes of the code that `names` refer to and of the files of scenarios, by path."""
    codes = [FileReference.of(name).read() for name in names if is_file_reference(name)]
    paths = list[Path]()
    for scenario in scenarios:
        if isinstance(scenario, OwnNetwork):
            paths += read_sumo_files(Path(scenario.file)).sources
        if scenario.population:
            paths.append(population_file(scenario.population))
    hashes = {str(code.path): code.sha256 for code in codes}
    return hashes | {str(path): hash_of_file(path) for path in paths}
