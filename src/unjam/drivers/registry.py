"""All drivers by name, and how a driver is written down so that another process can make it again."""

import hashlib
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.acc import ACC, LACC
from unjam.drivers.bilateral import BCM
from unjam.drivers.constant import Constant
from unjam.drivers.driver import Driver
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.from_file import FileDriver, is_file_reference
from unjam.drivers.idm import IDM, Human
from unjam.drivers.jam_absorber import JamAbsorber
from unjam.drivers.local_state import ObservationPart
from unjam.drivers.mixed import Mixed
from unjam.drivers.network import network_arrays, network_from_arrays
from unjam.drivers.ovm import OVM
from unjam.drivers.pacer import Pacer
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.errors import wrong
from unjam.parameters import STRICT, Count, NotNegative, Positive, build, parse_assignments

DRIVERS: dict[str, type[Driver]] = {
    "human": Human,
    "idm": IDM,
    "pi": PISaturation,
    "follower-stopper": FollowerStopper,
    "acc": ACC,
    "lacc": LACC,
    "bcm": BCM,
    "ovm": OVM,
    "pacer": Pacer,
    "jam-absorber": JamAbsorber,
    "constant": Constant,
}

Recipe = dict[str, Any]
"""What a driver is made from, as JSON; the weights of its networks travel beside it as arrays."""


def driver_names() -> str:
    """Return what `--driver` allows, for messages."""
    return ", ".join(
        [*DRIVERS, "path.py:name", "a run folder", "a .unjam file", "unjam:ring-best", "several joined by +"]
    )


def split_parameters(text: str) -> tuple[str, dict[str, Any]]:
    """Split `name:key=value,key=value` (or `path.py:name:key=value`) into the name and the parameters."""
    head, _, tail = text.rpartition(":")
    if not head or "=" not in tail:
        return text, {}
    return head, parse_assignments(_split_commas(tail), "driver")


def _split_commas(text: str) -> list[str]:
    """Split at commas outside brackets: `gaps=[1,2,3],window=38` has two parts."""
    parts, depth, start = [], 0, 0
    for index, letter in enumerate(text):
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and depth == 0:
            parts.append(text[start:index])
            start = index + 1
    return [*parts, text[start:]]


def named_driver(text: str, time_step: float) -> Driver:
    """Return the driver for `name`, `name:key=value,...` or `path.py:name`.

    `time_step` is the time between two decisions of the road [s].

    Raises:
        InputError: unknown name or parameter, or a value out of range.
    """
    name, parameters = split_parameters(text)
    if is_file_reference(name):
        path, _, attribute = name.rpartition(":")
        return FileDriver(Path(path), attribute, parameters, time_step)
    if name not in DRIVERS:
        raise wrong("driver", name, driver_names())
    return _make(name, parameters, time_step)


def _make(name: str, parameters: dict[str, Any], time_step: float) -> Driver:
    kind = DRIVERS[name]
    if is_dataclass(kind) and any(field.name == "time_step" for field in fields(kind)):
        parameters = {"time_step": time_step, **parameters}
    return build(kind, parameters, f"driver {name}")


@dataclass(frozen=True, config=STRICT)
class _ResidualRecipe:
    """How a residual driver is written down, without its weights."""

    kind: Literal["residual"]
    expert: dict[str, Any]
    action_limit: Positive
    parts: Annotated[tuple[ObservationPart, ...], Field(min_length=1)]
    hold: Count
    authority: Positive
    exploration_std: NotNegative


def recipe_of(driver: Driver, prefix: str = "") -> tuple[Recipe, dict[str, np.ndarray]]:
    """Return the recipe of a driver and the arrays of its networks; `driver_from_recipe` undoes it."""
    if isinstance(driver, ResidualDriver):
        expert, arrays = recipe_of(driver.expert, f"{prefix}expert.")
        network = {f"{prefix}{name}": array for name, array in network_arrays(driver.network).items()}
        recipe = {
            "kind": "residual",
            "expert": expert,
            "action_limit": driver.action_limit,
            "parts": list(driver.parts),
            "hold": driver.hold,
            "authority": driver.network.authority,
            "exploration_std": driver.network.exploration_std,
        }
        return recipe, {**arrays, **network}
    if isinstance(driver, Mixed):
        parts = [recipe_of(part, f"{prefix}{number}.") for number, part in enumerate(driver.drivers)]
        arrays = {name: array for _, own in parts for name, array in own.items()}
        return {"kind": "mixed", "drivers": [recipe for recipe, _ in parts]}, arrays
    if isinstance(driver, FileDriver):
        recipe = {
            "kind": "file",
            "path": str(driver.path),
            "name": driver.name,
            "sha256": hashlib.sha256(driver.path.read_bytes()).hexdigest(),
            "parameters": driver.parameters,
            "time_step": driver.time_step,
        }
        return recipe, {}
    for name, kind in DRIVERS.items():
        if type(driver) is kind:
            return {"kind": "named", "name": name, "parameters": asdict(driver)}, {}  # pyright: ignore[reportArgumentType]
    raise wrong("driver", type(driver).__name__, f"{driver_names()} (put your class in a file: path.py:name)")


def files_of(recipe: Any) -> list[Recipe]:
    """Return the recipes of the users' own files within `recipe`: their drivers are Python code."""
    if not isinstance(recipe, dict):
        return []
    parts = recipe.get("drivers", [])
    inner = [recipe.get("expert"), *(parts if isinstance(parts, list) else [])]
    own = [recipe] if recipe.get("kind") == "file" else []
    return own + [found for part in inner for found in files_of(part)]


def driver_from_recipe(recipe: Recipe, arrays: dict[str, np.ndarray], prefix: str = "") -> Driver:
    """Return the driver that `recipe_of` wrote down; raise `InputError` where the recipe is not valid."""
    kind = recipe.get("kind") if isinstance(recipe, dict) else recipe
    if kind == "named" and recipe["name"] in DRIVERS:
        return build(DRIVERS[recipe["name"]], recipe["parameters"], f"driver {recipe['name']}")
    if kind == "file":
        return FileDriver(Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"])
    if kind == "mixed":
        parts = enumerate(recipe["drivers"])
        made = (driver_from_recipe(part, arrays, f"{prefix}{number}.") for number, part in parts)
        return Mixed(tuple(made))
    if kind == "residual":
        expert_prefix = f"{prefix}expert."
        own = {
            name.removeprefix(prefix): array
            for name, array in arrays.items()
            if name.startswith(prefix) and not name.startswith(expert_prefix)
        }
        found = build(_ResidualRecipe, recipe, "driver recipe")
        return ResidualDriver(
            driver_from_recipe(found.expert, arrays, expert_prefix),
            network_from_arrays(own, found.authority, found.exploration_std),
            found.action_limit,
            found.parts,
            found.hold,
        )
    raise wrong("driver recipe", kind, "named, file, residual, mixed")


def describe(driver: Driver) -> str:
    """Return a driver in a few words: its name and the parameters that differ from the defaults."""
    if isinstance(driver, ResidualDriver):
        return f"{describe(driver.expert)} + residual"
    if isinstance(driver, Mixed):
        return "+".join(map(describe, driver.drivers))
    if isinstance(driver, FileDriver):
        return ":".join([driver.path.name, driver.name, *_listed(driver.parameters)])
    recipe, _ = recipe_of(driver)
    default = {field.name: field.default for field in fields(driver)}  # pyright: ignore[reportArgumentType]
    changed = {
        key: value
        for key, value in recipe["parameters"].items()
        if value != default[key] and key != "time_step"
    }
    return ":".join([recipe["name"], *_listed(changed)])


def _listed(parameters: dict[str, Any]) -> list[str]:
    return [",".join(f"{key}={value}" for key, value in parameters.items())] if parameters else []


def free_label(driver: Driver, taken: dict[str, Driver]) -> str:
    """Return the description of a driver, numbered where another driver has it already."""
    label, number = describe(driver), 1
    while label in taken and not _same(taken[label], driver):
        number += 1
        label = f"{describe(driver)} ({number})"
    return label


def _same(one: Driver, other: Driver) -> bool:
    (recipe, arrays), (other_recipe, other_arrays) = recipe_of(one), recipe_of(other)
    return recipe == other_recipe and all(
        np.array_equal(array, other_arrays[name]) for name, array in arrays.items()
    )
