"""All drivers by name, and every driver from how it is written down, so that another process can make it."""

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.acc import ACC, LACC
from unjam.drivers.bilateral import BCM
from unjam.drivers.constant import Constant
from unjam.drivers.driver import Driver, Recipe
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.from_file import FileDriver, FileReference, is_file_reference
from unjam.drivers.idm import IDM, Human
from unjam.drivers.jam_absorber import JamAbsorber
from unjam.drivers.network import network_from_arrays
from unjam.drivers.observation import FeatureName, observation_size
from unjam.drivers.ovm import OVM
from unjam.drivers.pacer import Pacer
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.wrappers import Impaired, Mixed
from unjam.errors import InputError, wrong
from unjam.parameters import STRICT, Count, NotNegative, Positive, build, split_parameters
from unjam.tree import Arrays

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


def driver_names() -> str:
    """Return what `--driver` allows, for messages."""
    return ", ".join(
        [*DRIVERS, "path.py:name", "a run folder", "a .unjam file", "unjam:ring-best", "several joined by +"]
    )


def named_driver(text: str, time_step: float) -> Driver:
    """Return the driver for `name`, `name:key=value,...` or `path.py:name`.

    `time_step` is the time between two decisions of the road [s].

    Raises:
        InputError: unknown name or parameter, or a value out of range.
    """
    name, parameters = split_parameters(text)
    if is_file_reference(name):
        reference = FileReference.of(name)
        return FileDriver(reference.path, reference.name, parameters, time_step)
    if name not in DRIVERS:
        raise wrong("driver", name, driver_names())
    return _make(name, parameters, time_step)


def _make(name: str, parameters: dict[str, Any], time_step: float) -> Driver:
    kind = DRIVERS[name]
    if any(field.name == "time_step" for field in fields(kind)):  # pyright: ignore[reportArgumentType]
        parameters = {"time_step": time_step, **parameters}
    return build(kind, parameters, f"driver {name}")


@dataclass(frozen=True, config=STRICT)
class _ResidualRecipe:
    """How a residual driver is written down, without its weights."""

    kind: Literal["residual"]
    expert: dict[str, Any]
    action_limit: Positive
    parts: Annotated[tuple[FeatureName, ...], Field(min_length=1)]
    hold: Count
    authority: Positive
    exploration_std: NotNegative
    files: list[dict[str, Any]] = Field(default_factory=list)


def _named(recipe: Recipe, arrays: Arrays, prefix: str) -> Driver:
    if recipe["name"] not in DRIVERS:
        raise wrong("driver recipe", recipe["name"], ", ".join(DRIVERS))
    return build(DRIVERS[recipe["name"]], recipe["parameters"], f"driver {recipe['name']}")


def _from_file(recipe: Recipe, arrays: Arrays, prefix: str) -> Driver:
    return FileDriver(Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"])


def _mixed(recipe: Recipe, arrays: Arrays, prefix: str) -> Driver:
    parts = enumerate(recipe["drivers"])
    return Mixed(tuple(driver_from_recipe(part, arrays, f"{prefix}{number}.") for number, part in parts))


def _impaired(recipe: Recipe, arrays: Arrays, prefix: str) -> Driver:
    worse = {key: float(recipe[key]) for key in ("delay", "gap_noise", "time_step")}
    return Impaired(driver_from_recipe(recipe["driver"], arrays, f"{prefix}inner."), **worse)


def _residual(recipe: Recipe, arrays: Arrays, prefix: str) -> Driver:
    found, expert = build(_ResidualRecipe, recipe, "driver recipe"), f"{prefix}expert."
    own = {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix) and not name.startswith(expert)
    }
    base = driver_from_recipe(found.expert, arrays, expert)
    network = network_from_arrays(own, found.authority, found.exploration_std)
    shown = observation_size(found.parts, base)
    if network.inputs != shown:
        raise InputError(f"network: {network.inputs} inputs are not allowed; allowed: {shown}")
    return ResidualDriver(base, network, found.action_limit, found.parts, found.hold)


RECIPES: dict[str, Callable[[Recipe, Arrays, str], Driver]] = {
    "named": _named,
    "file": _from_file,
    "residual": _residual,
    "mixed": _mixed,
    "impaired": _impaired,
}
"""how each kind of recipe becomes a driver again, the prefix being that of its networks' weights"""


def recipe_of(driver: Driver) -> tuple[Recipe, Arrays]:
    """Return the recipe of a driver and the arrays of its networks; `driver_from_recipe` undoes it.

    Raises:
        InputError: no other process could make such a driver.
    """
    recipe = driver.recipe()
    for part in _within(recipe):
        if part["kind"] == "named" and not part["name"]:
            allowed = f"{driver_names()} (put your class in a file: path.py:name)"
            raise wrong("driver", type(driver).__name__, allowed)
    return recipe, driver.arrays()


def driver_from_recipe(recipe: Recipe, arrays: Arrays, prefix: str = "") -> Driver:
    """Return the driver that `recipe_of` wrote down; raise `InputError` where the recipe is not valid."""
    kind = recipe.get("kind") if isinstance(recipe, dict) else recipe
    if kind not in RECIPES:
        raise wrong("driver recipe", kind, ", ".join(RECIPES))
    return RECIPES[kind](recipe, arrays, prefix)


def files_of(recipe: Any) -> list[Recipe]:
    """Return what within `recipe` refers to the users' own files: it is Python code."""
    return [part for part in _within(recipe) if part["kind"] == "file"]


def _within(recipe: Any) -> Iterator[Recipe]:
    """Yield a recipe and all that it holds."""
    if isinstance(recipe, dict):
        if "kind" in recipe:
            yield recipe
        for part in recipe.values():
            yield from _within(part)
    elif isinstance(recipe, list):
        for part in recipe:
            yield from _within(part)


def free_label(driver: Driver, taken: dict[str, Driver]) -> str:
    """Return the description of a driver, numbered where another driver has it already."""
    recipe_of(driver)  # what no worker could make has no place among others
    label, number = driver.describe(), 1
    while label in taken and not _same(taken[label], driver):
        number += 1
        label = f"{driver.describe()} ({number})"
    return label


def _same(one: Driver, other: Driver) -> bool:
    (recipe, arrays), (other_recipe, other_arrays) = recipe_of(one), recipe_of(other)
    return recipe == other_recipe and all(
        np.array_equal(array, other_arrays[name]) for name, array in arrays.items()
    )
