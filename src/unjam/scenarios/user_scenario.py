"""The user's own scenarios: classes, instances and functions in Python files, `path.py:name`, and TOML files.

Python files run as `unjam.user_code` says, only when the user names them. TOML files have settings alone.
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
"""entry of a recipe with path, name and hash of the user's class"""
_class_recipes: dict[type[Scenario], dict[str, Any]] = {}
"""path, name and hash of the classes that Python files define"""


def load_python_scenario(text: str) -> Scenario:
    """Return the scenario `path.py:name`; a class has its default settings. Raise `InputError` if it is none."""
    scenario = _load_object(FileReference.parse(text))
    return build_dataclass(scenario, {}, text) if isinstance(scenario, type) else scenario


def _load_object(reference: FileReference) -> Scenario | type[Scenario]:
    """Return the class or instance with a name, or that of a function; a second run would make other classes."""
    loaded, reference = reference.load_object_once()
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
    """Return path, name and hash of a class of a Python file; raise `InputError` for others, which stay here."""
    if kind in _class_recipes:
        return _class_recipes[kind]
    reference = object_reference(kind)
    hint = f"; did you mean {reference!r}?" if reference else ", of a class in a Python file"
    reason = "is not allowed in a file or another process, which must import it"
    raise InputError(f"scenario: the class {object_label(kind)} {reason}; allowed: path.py:name{hint}")


def class_reference(code: Any) -> FileReference:
    """Return the reference to the class of a recipe, with its hash; raise `InputError` if it is none."""
    if not isinstance(code, dict) or not all(code.get(key) for key in ("path", "name", "sha256")):
        raise invalid_value("scenario.code", code, "a table with path, name and sha256")
    return FileReference(Path(str(code["path"])), str(code["name"]), sha256=str(code["sha256"]))


def load_class(code: Any) -> type[Scenario]:
    """Return the class of a recipe; raise `InputError` if its file has changed."""
    kind = _load_object(class_reference(code))
    return kind if isinstance(kind, type) else type(kind)


def load_toml_scenario(path: Path, kinds: dict[str, type[Scenario]]) -> tuple[Scenario, dict[str, Any]]:
    """Return the scenario of a TOML file, by default a motorway, and the settings that the file names."""
    values = read_toml(path, "scenario file")
    kind = values.pop("kind", "motorway")
    if kind not in kinds:
        raise invalid_value(f"scenario file {path}: kind", kind, ", ".join(kinds))
    return build_dataclass(kinds[kind], values, path.name), values
