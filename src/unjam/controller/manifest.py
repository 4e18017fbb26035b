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
from unjam.errors import InputError, wrong
from unjam.files import parse_json
from unjam.parameters import STRICT, build
from unjam.tree import leaves

FORMAT = 3
"""version of the schema; only this one is read"""
STATEMENTS = (
    *("about", "scenario", "time_step", "action_limit", "expert", "versions"),
    *("run", "iteration", "actual_steps", "metrics", "tuned"),
)
"""entries that only the maker can know: where a controller comes from, and what was measured of it"""
Table = dict[str, Any]
_StrictPositive = Annotated[StrictFloat, Field(gt=0)]


@dataclass(frozen=True, config=STRICT)
class Manifest:
    """Names and types of all entries of a manifest; no other entry is allowed."""

    format: StrictInt
    unjam: StrictStr
    driver: Table
    observation: list[Table]
    networks: dict[str, list[Table]]
    memory: list[Table]
    action: Table
    hold: StrictInt
    sha256: dict[str, StrictStr]
    about: StrictStr = ""
    scenario: Table = field(default_factory=dict)
    time_step: _StrictPositive = 1.0
    action_limit: _StrictPositive = 1.0
    expert: StrictStr = ""
    versions: Table = field(default_factory=dict)
    run: Table = field(default_factory=dict)
    iteration: StrictInt | None = None
    actual_steps: StrictInt | None = None
    metrics: Table | None = None
    tuned: Table = field(default_factory=dict)


def read_manifest(name: str, part: bytes) -> Table:
    """Return the manifest of the controller `name`, with entries of the right names and types.

    Raises:
        InputError: it is of another format, or an entry is missing, unknown or of another type.
        ValueError: it is not strict JSON.
    """
    manifest = parse_json(part)
    if not isinstance(manifest, dict):
        raise InputError(f"controller {name}: manifest: {shown(manifest)} is not allowed; allowed: a table")
    found = manifest.get("format")
    if type(found) is int and found != FORMAT:
        raise InputError(
            f"controller {name}: format {found}, written by unjam {shown(manifest.get('unjam'))}, is not "
            f"allowed; allowed: format {FORMAT}, which unjam {__version__} writes: export or train it again"
        )
    build(Manifest, manifest, f"controller {name}: manifest")
    road = manifest.get("scenario", {})
    step, steps, limit = (road.get(key) for key in ("simulation_step", "steps_per_decision", "action_limit"))
    step = step * steps if type(step) is float and type(steps) is int else None
    for key, of_road in (("time_step", step), ("action_limit", limit)):
        if key in manifest and of_road is not None and manifest[key] != of_road:
            raise wrong(f"controller {name}: manifest.{key}", manifest[key], f"{of_road}, as in its scenario")
    return manifest


def shown(value: Any) -> str:
    """Return a value of a file as a short text on one line; `...` stands for a value that is missing."""
    text = "nothing" if value is ... else repr(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def first_difference(
    said: Any, found: Any, tolerance: float = 0.0, defaults: bool = False, name: str = ""
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
    if isinstance(said, dict) and isinstance(found, dict):
        keys = said.keys() if defaults else said.keys() | found.keys()
        pairs = [
            (f"{name}.{key}".strip("."), said.get(key, ...), found.get(key, ...)) for key in sorted(keys)
        ]
    elif isinstance(said, list) and isinstance(found, list) and len(said) == len(found):
        pairs = [(f"{name}[{i}]", one, other) for i, (one, other) in enumerate(zip(said, found, strict=True))]
    elif type(said) is type(found) and said == found:
        return None
    else:
        numbers = {type(said), type(found)} <= {int, float} and not (type(said) is type(found) is int)
        one, other = (float(str(said)), float(str(found))) if numbers else (nan, nan)
        return None if abs(other - one) <= tolerance * max(1.0, abs(other)) else (name, said, found)
    differences = (first_difference(one, other, tolerance, defaults, key) for key, one, other in pairs)
    return next((each for each in differences if each is not None), None)


def description(driver: Driver, action_limit: float | None = None) -> Table:
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
        "observation": [{"name": name, "unit": STATE_UNITS[name]} for name in driver.perceives],
        "networks": _networks(driver),
        "memory": [_remembered(name, value[0]) for name, value in remembered],
        "action": {"name": "acceleration", "unit": "m/s2", "low": low, "high": high},
        "hold": driver.hold,
    }


def _networks(driver: Driver, prefix: str = "") -> dict[str, list[Table]]:
    shown = driver.shown
    own = {} if shown is None else {prefix: [number._asdict() for number in shown]}
    return own | {
        name: seen
        for below, held in driver.inner.items()
        for name, seen in _networks(held, f"{prefix}{below}.").items()
    }


def _remembered(name: str, value: Any) -> Table:
    """Return the name, shape and first value of what is remembered of one CAV."""
    values = np.asarray(value, np.float64)
    different = np.unique(values)  # NaN is one value
    first = different[0].item() if len(different) == 1 else values.tolist()
    return {"name": name, "shape": list(values.shape), "first": None if first != first else first}
