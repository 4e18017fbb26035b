"""Scenarios of users: classes, instances and functions in Python files, `path.py:name`, and TOML files.

A Python file runs only if the user names it, see `unjam.user_code`. A TOML file contains settings only.
"""

from inspect import isfunction
from pathlib import Path
from typing import Any

from unjam.drivers.user_driver import FileReference, UserFunction, object_label, object_reference
from unjam.errors import InputError, invalid_value
from unjam.parameters import build_dataclass, read_toml
from unjam.scenarios.scenario import Scenario
from unjam.tree import pack
from unjam.user_code import USER_MODULE_PREFIX

CODE_ENTRY = "code"
"""key of the path, name and hash of a user's class in a recipe"""
_class_recipes: dict[type[Scenario], dict[str, Any]] = {}
"""path, name and hash of each loaded class of a user"""


def load_python_scenario(reference: str) -> Scenario:
    """Return the scenario `path.py:name`, of a class with its default settings; raise `InputError` if it is invalid."""
    scenario = _load_object(FileReference.parse(reference))
    return build_dataclass(scenario, {}, reference) if isinstance(scenario, type) else scenario


def _load_object(reference: FileReference) -> Scenario | type[Scenario]:
    """Return the class or instance that a reference names, or that a named function returns."""
    loaded, reference = reference.load_object_once()  # a second run of the file would define other classes
    if isfunction(loaded):
        loaded = UserFunction(loaded, str(reference), str(reference.path))()
    kind: type[Any] = loaded if isinstance(loaded, type) else type(loaded)
    if not issubclass(kind, Scenario):
        allowed = "a class or an instance of unjam.scenarios.Scenario, or a function that returns one"
        raise InputError(f"{reference}: {loaded!r:.60} is not allowed; allowed: {allowed}")
    if kind.__module__.startswith(USER_MODULE_PREFIX):
        _class_recipes[kind], _ = pack(reference)
    return loaded


def class_recipe(kind: type[Scenario]) -> dict[str, Any]:
    """Return path, name and hash of a class in a Python file; raise `InputError` for a class that is not in one."""
    if kind in _class_recipes:
        return _class_recipes[kind]
    reference = object_reference(kind)
    hint = f"; did you mean {reference!r}?" if reference else ", of a class in a Python file"
    reason = "is not allowed in a file or another process, which must import it"
    raise InputError(f"scenario: the class {object_label(kind)} {reason}; allowed: path.py:name{hint}")


def class_reference(code: Any) -> FileReference:
    """Return the reference to the class in a recipe, with its hash; raise `InputError` if the entry is invalid."""
    if not isinstance(code, dict) or not all(code.get(key) for key in ("path", "name", "sha256")):
        raise invalid_value("scenario.code", code, "a table with path, name and sha256")
    return FileReference(Path(str(code["path"])), str(code["name"]), sha256=str(code["sha256"]))


def load_class(code: Any) -> type[Scenario]:
    """Return the class in a recipe; raise `InputError` if its file has changed."""
    kind = _load_object(class_reference(code))
    return kind if isinstance(kind, type) else type(kind)


def load_toml_scenario(path: Path, kinds: dict[str, type[Scenario]]) -> tuple[Scenario, dict[str, Any]]:
    """Return the scenario of a TOML file, by default a motorway, and the settings that the file names."""
    values = read_toml(path, "scenario file")
    kind = values.pop("kind", "motorway")
    if kind not in kinds:
        raise invalid_value(f"scenario file {path}: kind", kind, ", ".join(kinds))
    return build_dataclass(kinds[kind], values, path.name), values
