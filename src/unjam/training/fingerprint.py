"""The fingerprint of a training: settings, hashes of experts and user files, and versions of packages."""

import json
import logging
import re
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from unjam.drivers.registry import driver_recipe
from unjam.drivers.user_driver import code_hashes
from unjam.errors import InputError, invalid_value
from unjam.files import sha256_of, sha256_of_file, to_json
from unjam.kernels import kernel_info
from unjam.manifest import package_versions
from unjam.parameters import flatten_keys
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_scenario import CODE_ENTRY
from unjam.training.config import RunConfig

_LOG = logging.getLogger(__name__)

ABSENT = "absent"
"""placeholder for the value of a missing setting"""


def fingerprint(config: RunConfig) -> dict[str, Any]:
    """Return everything on which the result of a training depends, as JSON.

    This is all settings except steps and workers, hashes of experts and user files, packages and kernels.
    """
    files = file_hashes(code_names(config))
    for task_config, task in zip(config.task_configs().values(), config.make_tasks(), strict=True):
        recipe, arrays = driver_recipe(task.expert)
        weights = b"".join(arrays[name].tobytes() for name in sorted(arrays))
        files[f"expert {task_config.expert}"] = sha256_of(json.dumps(recipe, sort_keys=True).encode() + weights)
        files |= file_hashes((), task.scenario)
    settings = flatten_keys(asdict(replace(config, steps=1, workers=1)))
    entries = {"settings": settings, "files": files, "packages": package_versions(), "kernels": kernel_info()}
    return json.loads(to_json(entries))


def check_fingerprint(stored: dict[str, Any], current: dict[str, Any]) -> None:
    """Raise `InputError` if a setting, an expert or a user file has changed; warn of other packages and kernels."""
    check_settings(stored, current, "resume")
    check_file_hashes(stored, current, "resume")
    for table in ("packages", "kernels"):
        if stored[table] != current[table]:
            _LOG.warning("resume: other %s than in the checkpoint: the result may differ", table)


def check_settings(
    stored: dict[str, Any], current: dict[str, Any], command: str, ignored_prefixes: tuple[str, ...] = ()
) -> None:
    """Raise `InputError` if a setting was changed, added or removed, unless it begins with an ignored prefix."""
    _check_tables(stored, command)
    for name in {**current["settings"], **stored["settings"]}:
        stored_value, value = (entries["settings"].get(name, ABSENT) for entries in (stored, current))
        if not name.startswith(ignored_prefixes) and _remove_folders(stored_value) != _remove_folders(value):
            raise invalid_value(f"{command}: {name}", value, f"{stored_value!r}, as in the checkpoint")


def code_names(config: RunConfig) -> list[str]:
    """Return the names of agent, backend, features, scenarios and rewards, some of which can be files of the user."""
    names = [name for task in config.task_configs().values() for name in (task.scenario, task.reward)]
    return [config.agent, config.backend, *config.policy.inputs, *names]


def check_file_hashes(stored: dict[str, Any], current: dict[str, Any], command: str) -> None:
    """Raise `InputError` if an expert or a file of the user has changed."""
    _check_tables(stored, command)
    old_names, new_names = (
        {(_remove_folders(name.removeprefix("expert ")), sha256): name for name, sha256 in entries["files"].items()}
        for entries in (stored, current)
    )
    # Files with equal names in several folders are compared in the order of their tasks, as folders may have moved.
    reordered = (old for old, new in zip(old_names, new_names, strict=True) if old != new)
    if changed := old_names.keys() ^ new_names.keys() or {*reordered}:
        name = {**new_names, **old_names}[min(changed)]
        raise InputError(f"{command}: {name} has changed since the checkpoint; allowed: as it was then")


def _check_tables(stored: Any, command: str) -> None:
    """Raise `InputError` unless a stored value has the tables of a fingerprint."""
    tables = ("settings", "files", "packages", "kernels")
    has_tables = isinstance(stored, dict) and all(isinstance(stored.get(name), dict) for name in tables)
    if not has_tables or not all(isinstance(sha256, str) for sha256 in stored["files"].values()):
        raise InputError(f"{command}: the checkpoint has no fingerprint of a run; allowed: a checkpoint of unjam")


def _remove_folders(value: Any) -> str:
    """Return a JSON value as text without the folders of files, which depend on the working folder."""
    return re.sub(r'(?<![^+"])[^+"]*/', "", json.dumps(value))


def file_hashes(names: Iterable[str], *scenarios: Scenario) -> dict[str, str]:
    """Return hashes of user code among the `names`, and of the user files of scenarios, by path."""
    paths, hashes = list[Path](), code_hashes(names)
    for scenario in scenarios:
        paths += scenario.user_files
        if code := scenario_recipe(scenario).get(CODE_ENTRY):
            hashes[code["path"]] = code["sha256"]
    return hashes | {str(path): sha256_of_file(path) for path in paths}
