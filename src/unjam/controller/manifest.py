"""The manifest of a `.unjam` file: its schema, and the description of a driver that is compared with it."""

from dataclasses import field
from math import nan
from typing import Annotated, Any

import numpy as np
from pydantic import Field, StrictFloat, StrictInt, StrictStr
from pydantic.dataclasses import dataclass

from unjam import __version__
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import STATE_UNITS
from unjam.errors import InputError, invalid_value
from unjam.files import parse_json
from unjam.parameters import STRICT, build_dataclass
from unjam.tree import leaves

MANIFEST_FORMAT = 4
"""version of the schema; only this one is read"""
PROVENANCE_ENTRIES = (
    *("summary", "scenario", "time_step", "action_limit", "expert", "versions"),
    *("run", "iteration", "environment_steps", "metrics", "tuning"),
)
"""entries that only the maker can know: where a controller comes from, and what was measured of it"""
JsonObject = dict[str, Any]
_StrictPositive = Annotated[StrictFloat, Field(gt=0)]


@dataclass(frozen=True, config=STRICT)
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


def read_manifest(name: str, part: bytes) -> JsonObject:
    """Return the manifest of the controller `name`, with entries of the right names and types.

    Raises:
        InputError: it is of another format, or an entry is missing, unknown or of another type.
        ValueError: it is not strict JSON.
    """
    manifest = parse_json(part)
    if not isinstance(manifest, dict):
        raise InputError(f"controller {name}: manifest: {short_text(manifest)} is not allowed; allowed: a table")
    found = manifest.get("format")
    if type(found) is int and found != MANIFEST_FORMAT:
        raise InputError(
            f"controller {name}: format {found}, written by unjam {short_text(manifest.get('unjam'))}, is not "
            f"allowed; allowed: format {MANIFEST_FORMAT}, which unjam {__version__} writes: export or train it again"
        )
    build_dataclass(Manifest, manifest, f"controller {name}: manifest")
    road = manifest.get("scenario", {})
    step, steps, limit = (road.get(key) for key in ("simulation_step", "steps_per_control_step", "action_limit"))
    step = step * steps if type(step) is float and type(steps) is int else None
    for key, of_road in (("time_step", step), ("action_limit", limit)):
        if key in manifest and of_road is not None and manifest[key] != of_road:
            raise invalid_value(f"controller {name}: manifest.{key}", manifest[key], f"{of_road}, as in its scenario")
    return manifest


def short_text(value: Any) -> str:
    """Return a value of a file as a short text on one line; `...` stands for a value that is missing."""
    text = "nothing" if value is ... else repr(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def first_difference(
    expected: Any, actual: Any, tolerance: float = 0.0, allows_missing: bool = False, name: str = ""
) -> tuple[str, Any, Any] | None:
    """Return the first place at which two JSON documents differ, and both values; None where none does.

    A Boolean is no number, and null is not a missing entry, which is `...`. Integers are compared exactly.

    Args:
        said: one document.
        found: the other.
        tolerance: allowed deviation of floats, relative for those above 1.
        defaults: whether `said` may leave out entries of `found`.
        name: place of both within a larger document.
    """
    if isinstance(expected, dict) and isinstance(actual, dict):
        keys = expected.keys() if allows_missing else expected.keys() | actual.keys()
        pairs = [(f"{name}.{key}".strip("."), expected.get(key, ...), actual.get(key, ...)) for key in sorted(keys)]
    elif isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        pairs = [(f"{name}[{i}]", one, other) for i, (one, other) in enumerate(zip(expected, actual, strict=True))]
    elif type(expected) is type(actual) and expected == actual:
        return None
    else:
        numbers = {type(expected), type(actual)} <= {int, float} and not (type(expected) is type(actual) is int)
        one, other = (float(str(expected)), float(str(actual))) if numbers else (nan, nan)
        return None if abs(other - one) <= tolerance * max(1.0, abs(other)) else (name, expected, actual)
    differences = (first_difference(one, other, tolerance, allows_missing, key) for key, one, other in pairs)
    return next((each for each in differences if each is not None), None)


def driver_interface(driver: Driver, action_limit: float | None = None) -> JsonObject:
    """Return what a user of a controller must know in addition to the recipe of its driver, as JSON.

    `action_limit` is that of the road it is for [m/s2], where the driver has none of its own.

    Returns:
        `observation`: what it is given at each decision, in order, in SI units; `networks`: what each of its
        networks sees, in order, by the prefix of its weights: each number is divided by its scale;
        `memory`: what it remembers of each CAV, with its value before the first decision, null where that
        is NaN; `action`: the acceleration that it answers, clipped to these bounds; `hold`: decisions for
        which a residual is held.
    """
    low, high = driver.limits or (None if action_limit is None else -action_limit, action_limit)
    remembered = leaves(driver.initial_memory(1))
    return {
        "observation": [{"name": name, "unit": STATE_UNITS[name]} for name in driver.input_fields],
        "networks": _network_inputs(driver),
        "memory": [_memory_entry(name, value[0]) for name, value in remembered],
        "action": {"name": "acceleration", "unit": "m/s2", "low": low, "high": high},
        "action_repeat": driver.action_repeat,
    }


def _network_inputs(driver: Driver, prefix: str = "") -> dict[str, list[JsonObject]]:
    shown = driver.network_inputs
    own = {} if shown is None else {prefix: [number._asdict() for number in shown]}
    return own | {
        name: seen
        for below, held in driver.inner_drivers.items()
        for name, seen in _network_inputs(held, f"{prefix}{below}.").items()
    }


def _memory_entry(name: str, value: Any) -> JsonObject:
    """Return the name, shape and first value of what is remembered of one CAV."""
    values = np.asarray(value, np.float64)
    different = np.unique(values)  # NaN is one value
    first = different[0].item() if len(different) == 1 else values.tolist()
    return {"name": name, "shape": list(values.shape), "initial": None if first != first else first}
