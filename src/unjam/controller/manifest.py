"""The manifest of a `.unjam` file: its schema, and the description of a driver with which it is compared."""

from dataclasses import field
from inspect import signature
from math import nan
from typing import Annotated, Any

import numpy as np
from pydantic import Field, StrictFloat, StrictInt, StrictStr

from unjam import __version__
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import STATE_UNITS
from unjam.errors import InputError, invalid_value
from unjam.files import parse_json
from unjam.parameters import STRICT, build_dataclass, parameter_dataclass
from unjam.tree import leaves

MANIFEST_FORMAT = 5  # version of the schema; files with other versions are refused
ACTION_NAME = "acceleration"  # name of the recorded accelerations in a sample, and of the output of a graph
JsonObject = dict[str, Any]
_StrictPositive = Annotated[StrictFloat, Field(gt=0)]


@parameter_dataclass(frozen=True, config=STRICT)
class Manifest:
    """Names and types of all entries of a manifest; no other entry is allowed."""

    format: StrictInt
    unjam: StrictStr
    driver: JsonObject
    observation: list[JsonObject]
    networks: dict[str, list[JsonObject]]
    memory: list[JsonObject]
    action: JsonObject
    action_repeat: StrictInt
    sha256: dict[str, StrictStr]
    summary: StrictStr = ""
    scenario: JsonObject = field(default_factory=dict)
    time_step: _StrictPositive = 1.0
    action_limit: _StrictPositive = 1.0
    expert: StrictStr = ""
    versions: JsonObject = field(default_factory=dict)
    run: JsonObject = field(default_factory=dict)
    iteration: StrictInt | None = None
    environment_steps: StrictInt | None = None
    metrics: JsonObject | None = None
    tuning: JsonObject = field(default_factory=dict)


PROVENANCE_ENTRIES = tuple(
    parameter.name for parameter in signature(Manifest).parameters.values() if parameter.default != parameter.empty
)
"""optional entries that only the maker of a controller can know: origin and measured results"""


def read_manifest(name: str, part: bytes) -> JsonObject:
    """Return the manifest of a controller; `InputError` for a wrong format or entry, `ValueError` if it is not JSON."""
    manifest = parse_json(part)
    if not isinstance(manifest, dict):
        raise InputError(f"controller {name}: manifest: {short_text(manifest)} is not allowed; allowed: a table")
    version = manifest.get("format")
    if type(version) is int and version != MANIFEST_FORMAT:
        allowed = f"format {MANIFEST_FORMAT}, which unjam {__version__} writes: export or train it again"
        maker = f"unjam {short_text(manifest.get('unjam'))}"
        raise InputError(f"controller {name}: format {version}, written by {maker}, is not allowed; allowed: {allowed}")
    build_dataclass(Manifest, manifest, f"controller {name}: manifest")
    scenario = manifest.get("scenario", {})
    step, count, limit = (scenario.get(key) for key in ("simulation_step", "steps_per_control_step", "action_limit"))
    control_step = step * count if type(step) is float and type(count) is int else None
    for key, expected in (("time_step", control_step), ("action_limit", limit)):
        if key in manifest and expected is not None and manifest[key] != expected:
            raise invalid_value(f"controller {name}: manifest.{key}", manifest[key], f"{expected}, as in its scenario")
    return manifest


def short_text(value: Any) -> str:
    """Return a value of a file as a short text on one line; `...` is a missing value."""
    text = "nothing" if value is ... else repr(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def first_difference(
    expected: Any, actual: Any, tolerance: float = 0.0, allows_missing: bool = False, name: str = ""
) -> tuple[str, Any, Any] | None:
    """Return the name of the first entry in which two JSON documents differ, and its values; None if they are equal.

    A Boolean is not a number. A missing entry has the value `...`, and differs from null. Integers are compared
    exactly, floats with a `tolerance`, which is relative for values above 1. With `allows_missing`, `expected` may omit
    entries of `actual`. `name` is the name of both values within a larger document.
    """
    if isinstance(expected, dict) and isinstance(actual, dict):
        keys = expected.keys() if allows_missing else expected.keys() | actual.keys()
        entries = [(f"{name}.{key}".strip("."), expected.get(key, ...), actual.get(key, ...)) for key in sorted(keys)]
    elif isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        entries = [(f"{name}[{index}]", *pair) for index, pair in enumerate(zip(expected, actual, strict=True))]
    elif type(expected) is type(actual) and expected == actual:
        return None
    else:
        is_number = {type(expected), type(actual)} <= {int, float} and not (type(expected) is type(actual) is int)
        x, y = (float(str(expected)), float(str(actual))) if is_number else (nan, nan)
        return None if abs(y - x) <= tolerance * max(1.0, abs(y)) else (name, expected, actual)
    differences = (first_difference(x, y, tolerance, allows_missing, entry_name) for entry_name, x, y in entries)
    return next((difference for difference in differences if difference is not None), None)


def driver_interface(driver: Driver, action_limit: float | None = None) -> JsonObject:
    """Return the interface of a controller as JSON: entries of the manifest that follow from its driver.

    `observation`: inputs in each control step, in order, in SI units; `networks`: inputs of each network, in order,
    each divided by its scale, by the prefix of the network's memory; `memory`: entries for each CAV, with initial
    values, null for NaN; `action`: the acceleration with its bounds; `action_repeat`: control steps for which a
    residual is repeated. `action_limit` is the limit of the road [m/s2], for drivers without their own limits.
    """
    low, high = driver.limits or (None if action_limit is None else -action_limit, action_limit)
    return {
        "observation": [{"name": name, "unit": STATE_UNITS[name]} for name in driver.requirements().input_fields],
        "networks": _network_inputs(driver),
        "memory": [_memory_entry(name, rows[0]) for name, rows in leaves(driver.initial_memory(1))],
        "action": {"name": ACTION_NAME, "unit": "m/s2", "low": low, "high": high},
        "action_repeat": driver.action_repeat,
    }


def graph_names(driver: Driver) -> tuple[list[str], list[str]]:
    """Return the names of a graph's inputs (state, memory) and outputs (acceleration, new memory)."""
    memory_names = [name for name, _ in leaves(driver.initial_memory(1))]
    inputs = [*driver.requirements().input_fields, *(f"memory.{name}" for name in memory_names)]
    return inputs, [ACTION_NAME, *(f"next.{name}" for name in memory_names)]


def _network_inputs(driver: Driver, prefix: str = "") -> dict[str, list[JsonObject]]:
    inputs = driver.network_inputs
    entries = {} if inputs is None else {prefix: [entry._asdict() for entry in inputs]}
    for name, inner_driver in driver.inner_drivers.items():
        entries |= _network_inputs(inner_driver, f"{prefix}{name}.")
    return entries


def _memory_entry(name: str, initial_values: Any) -> JsonObject:
    array = np.asarray(initial_values, np.float64)
    unique_values = np.unique(array)  # all NaN count as one value
    initial = unique_values[0].item() if len(unique_values) == 1 else array.tolist()
    return {"name": name, "shape": list(array.shape), "initial": None if initial != initial else initial}
