"""All drivers by name, and every driver from how it is written down, so that another process can make it."""

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.adaptive_acc import AdaptiveACC
from unjam.drivers.by_road import KINDS_OF_ROAD, ByRoad
from unjam.drivers.car_following import ACC, BCM, IDM, LACC, OVM, Constant, Human
from unjam.drivers.driver import Driver, Recipe
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.from_file import FileDriver, FileReference, is_file_reference
from unjam.drivers.network import network_from_arrays
from unjam.drivers.observation import FEATURES, FeatureName, check_own_files, observation_size
from unjam.drivers.pi_saturation import PIFromGap, PISaturation
from unjam.drivers.residual import EXPERT, ResidualDriver
from unjam.drivers.road_experts import Cruise, GapMaker, JamAbsorber, JamAhead, Pacer
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.speed_history import LONGEST
from unjam.drivers.while_gathered import LEADING, OTHERWISE, WhileGathered
from unjam.drivers.wrappers import INNER, Filtered, Impaired, Mixed, Remembering
from unjam.errors import InputError, did_you_mean, wrong
from unjam.parameters import STRICT, Count, NotNegative, Positive, build, split_parameters
from unjam.tree import Arrays

_KINDS = (
    *(Human, IDM, PISaturation, PIFromGap, FollowerStopper, ACC, LACC, BCM, OVM),
    *(Pacer, JamAbsorber, Cruise, JamAhead, GapMaker, AdaptiveACC),
    Constant,
)
DRIVERS: dict[str, type[Driver]] = {kind.name: kind for kind in _KINDS}

Held = Callable[[Recipe, str], Driver]
"""makes a driver that another one holds, by the name that its networks' weights begin with"""


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
        raise wrong("driver", name, f"{driver_names()}{did_you_mean(name, DRIVERS)}")
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
    lasts: bool = False
    files: list[dict[str, Any]] = Field(default_factory=list)


def recipe_of(driver: Driver) -> tuple[Recipe, Arrays]:
    """Return the recipe of a driver and the arrays of its networks; `driver_from_recipe` undoes it.

    Raises:
        InputError: no other process could make such a driver.
    """
    recipe = driver.recipe()
    for part in _within(recipe):
        if part["kind"] == "named" and not part["name"]:
            allowed = f"{driver_names()} (put your class in a file: path.py:name)"
            raise wrong("driver", driver.describe(), allowed)
    return recipe, driver.arrays()


def travels(driver: Driver) -> bool:
    """Return whether another process can make a driver; what a notebook defines drives where it is."""
    try:
        return bool(recipe_of(driver))
    except InputError:
        return False


def driver_from_recipe(recipe: Recipe, arrays: Arrays) -> Driver:
    """Return the driver that `recipe_of` wrote down; raise `InputError` where the recipe is not valid."""

    def held(recipe: Recipe, name: str) -> Driver:
        prefix = f"{name}."
        within = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        return driver_from_recipe(recipe, within)

    kind = recipe.get("kind") if isinstance(recipe, dict) else recipe
    if kind not in RECIPES:
        raise wrong("driver recipe", kind, ", ".join(RECIPES))
    return RECIPES[kind](recipe, arrays, held)


def _named(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    name = recipe["name"]
    if name not in DRIVERS:
        raise wrong("driver recipe", name, ", ".join(DRIVERS))
    return build(DRIVERS[name], recipe["parameters"], f"driver {name}")


def _residual(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    found = build(_ResidualRecipe, recipe, "driver recipe")
    expert = held(found.expert, EXPERT)
    own = {name: array for name, array in arrays.items() if not name.startswith(f"{EXPERT}.")}
    network = network_from_arrays(own, found.authority, found.exploration_std, found.lasts)
    if found.files:
        check_own_files(found.parts, found.files)
    shown = observation_size(found.parts, expert)
    if network.inputs != shown:
        raise InputError(f"network: {network.inputs} inputs are not allowed; allowed: {shown}")
    return ResidualDriver(expert, network, found.action_limit, found.parts, found.hold)


@dataclass(frozen=True, config=STRICT)
class _ImpairedRecipe:
    """How a driver with what is worse about it is written down."""

    kind: Literal["impaired"]
    driver: dict[str, Any]
    delay: NotNegative
    gap_noise: NotNegative
    time_step: Positive


def _impaired(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    found = build(_ImpairedRecipe, recipe, "driver recipe")
    if found.delay / found.time_step > LONGEST:
        raise wrong("delay", found.delay, f"at most {LONGEST:,} steps of {found.time_step:g} s")
    return Impaired(held(found.driver, INNER), found.delay, found.gap_noise, found.time_step)


@dataclass(frozen=True, config=STRICT)
class _WhileGatheredRecipe:
    """How a driver that leads while all are gathered is written down, with who drives otherwise."""

    kind: Literal["while-gathered"]
    drivers: dict[str, dict[str, Any]]
    time_step: Positive


def _while_gathered(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    found = build(_WhileGatheredRecipe, recipe, "driver recipe")
    leading, otherwise = (held(found.drivers[name], name) for name in (LEADING, OTHERWISE))
    return WhileGathered(leading, otherwise, found.time_step)


@dataclass(frozen=True, config=STRICT)
class _RememberingRecipe:
    """How a driver that remembers means is written down."""

    kind: Literal["remembering"]
    driver: dict[str, Any]
    time_step: Positive


def _remembering(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    found = build(_RememberingRecipe, recipe, "driver recipe")
    return Remembering(held(found.driver, INNER), found.time_step)


@dataclass(frozen=True, config=STRICT)
class _FilteredRecipe:
    """How a driver with its filter is written down."""

    kind: Literal["filtered"]
    driver: dict[str, Any]
    action_limit: Positive
    safety: SafetyFilter
    time_step: Positive


def _filtered(recipe: Recipe, arrays: Arrays, held: Held) -> Driver:
    found = build(_FilteredRecipe, recipe, "driver recipe")
    return Filtered(held(found.driver, INNER), found.action_limit, found.safety, found.time_step)


RECIPES: dict[str, Callable[[Recipe, Arrays, Held], Driver]] = {
    "named": _named,
    "file": lambda recipe, arrays, held: FileDriver(
        Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"], recipe["sha256"]
    ),
    "residual": _residual,
    "mixed": lambda recipe, arrays, held: Mixed(
        tuple(held(part, str(number)) for number, part in enumerate(recipe["drivers"]))
    ),
    "impaired": _impaired,
    "filtered": _filtered,
    "by-road": lambda recipe, arrays, held: ByRoad(
        **{kind: held(recipe["drivers"][kind], kind) for kind in KINDS_OF_ROAD if kind in recipe["drivers"]},
    ),
    "while-gathered": _while_gathered,
    "remembering": _remembering,
}
"""how each kind of recipe becomes a driver again"""


def code_of(recipe: Any) -> list[Recipe]:
    """Return what within `recipe` refers to the users' own files: it is Python code.

    Raises:
        InputError: a network sees a feature of a file that is not listed beside it with its hash.
    """
    held = list(_within(recipe))
    for part in held:
        if part["kind"] == "residual":
            _check_listed(part)
    return [part for part in held if part["kind"] == "file"]


def _check_listed(recipe: Recipe) -> None:
    """Raise `InputError` where a residual sees a feature whose file is not among those that it lists."""
    found = build(_ResidualRecipe, recipe, "driver recipe")
    listed = [(file.get("path"), file.get("name")) for file in found.files if file.get("kind") == "file"]
    for name in found.parts:
        if name not in FEATURES:
            reference = FileReference.of(name)
            if (str(reference.path), reference.name) not in listed:
                allowed = "features whose files the recipe lists with their hashes"
                raise wrong("driver recipe: part", name, allowed)


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
    label, number = driver.describe(), 1
    while label in taken and not _same(taken[label], driver):
        number += 1
        label = f"{driver.describe()} ({number})"
    return label


def _same(one: Driver, other: Driver) -> bool:
    if not (travels(one) and travels(other)):
        return one is other
    (recipe, arrays), (other_recipe, other_arrays) = recipe_of(one), recipe_of(other)
    return recipe == other_recipe and all(
        np.array_equal(array, other_arrays[name]) for name, array in arrays.items()
    )
