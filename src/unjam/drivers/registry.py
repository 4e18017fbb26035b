"""All drivers by name, and every driver from how it is written down, so that another process can make it."""

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.adaptive_acc import AdaptiveACC
from unjam.drivers.car_following import ACC, BCM, IDM, LACC, OVM, Constant, Human
from unjam.drivers.driver import Driver, Recipe
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.network import network_from_weights
from unjam.drivers.observation import FEATURES, FeatureName, check_user_files, observation_size
from unjam.drivers.pi_saturation import PIFromGap, PISaturation
from unjam.drivers.queue_fallback import FALLBACK_KEY, PRIMARY_KEY, QueueFallback
from unjam.drivers.residual import EXPERT_KEY, ResidualDriver
from unjam.drivers.road_experts import Cruise, GapMaker, JamAbsorber, JamAhead, Pacer
from unjam.drivers.road_type_switch import ROAD_TYPES, RoadTypeSwitch
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.speed_history import MAX_WINDOW_STEPS
from unjam.drivers.user_driver import FileDriver, FileReference, is_file_reference
from unjam.drivers.wrappers import INNER_KEY, FilteredDriver, HistoryDriver, ImpairedDriver, MixedDriver
from unjam.errors import InputError, invalid_value, spelling_hint
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt, build_dataclass, split_parameters
from unjam.tree import Arrays

_DRIVER_CLASSES = (
    *(Human, IDM, PISaturation, PIFromGap, FollowerStopper, ACC, LACC, BCM, OVM),
    *(Pacer, JamAbsorber, Cruise, JamAhead, GapMaker, AdaptiveACC),
    Constant,
)
DRIVERS: dict[str, type[Driver]] = {kind.name: kind for kind in _DRIVER_CLASSES}

InnerDriverBuilder = Callable[[Recipe, str], Driver]
"""makes a driver that another one holds, by the name that its networks' weights begin with"""


def driver_names() -> str:
    """Return what `--driver` allows, for messages."""
    return ", ".join(
        [*DRIVERS, "path.py:name", "a run folder", "a .unjam file", "unjam:ring-best", "several joined by +"]
    )


def driver_from_name(text: str, time_step: float) -> Driver:
    """Return the driver for `name`, `name:key=value,...` or `path.py:name`.

    `time_step` is the time between two decisions of the road [s].

    Raises:
        InputError: unknown name or parameter, or a value out of range.
    """
    name, parameters = split_parameters(text)
    if is_file_reference(name):
        reference = FileReference.parse(name)
        return FileDriver(reference.path, reference.name, parameters, time_step)
    if name not in DRIVERS:
        raise invalid_value("driver", name, f"{driver_names()}{spelling_hint(name, DRIVERS)}")
    kind = DRIVERS[name]
    if any(field.name == "time_step" for field in fields(kind)):  # pyright: ignore[reportArgumentType]
        parameters = {"time_step": time_step, **parameters}
    return build_dataclass(kind, parameters, f"driver {name}")


@dataclass(frozen=True, config=STRICT)
class _ResidualRecipe:
    """How a residual driver is written down, without its weights."""

    kind: Literal["residual"]
    expert: dict[str, Any]
    action_limit: Positive
    inputs: Annotated[tuple[FeatureName, ...], Field(min_length=1)]
    action_repeat: PositiveInt
    authority: Positive
    exploration_std: NonNegative
    episode_noise: bool = False
    files: list[dict[str, Any]] = Field(default_factory=list)


def driver_recipe(driver: Driver) -> tuple[Recipe, Arrays]:
    """Return the recipe of a driver and the arrays of its networks; `driver_from_recipe` undoes it.

    Raises:
        InputError: no other process could make such a driver.
    """
    recipe = driver.recipe()
    for part in _iterate_recipes(recipe):
        if part["kind"] == "named" and not part["name"]:
            allowed = f"{driver_names()} (put your class in a file: path.py:name)"
            raise invalid_value("driver", driver.describe(), allowed)
    return recipe, driver.weights()


def is_serializable(driver: Driver) -> bool:
    """Return whether another process can make a driver; what a notebook defines drives where it is."""
    try:
        return bool(driver_recipe(driver))
    except InputError:
        return False


def driver_from_recipe(recipe: Recipe, weights: Arrays) -> Driver:
    """Return the driver that `recipe_of` wrote down; raise `InputError` where the recipe is not valid."""

    def build_inner(recipe: Recipe, name: str) -> Driver:
        prefix = f"{name}."
        within = {key.removeprefix(prefix): array for key, array in weights.items() if key.startswith(prefix)}
        return driver_from_recipe(recipe, within)

    kind = recipe.get("kind") if isinstance(recipe, dict) else recipe
    if kind not in RECIPE_BUILDERS:
        raise invalid_value("driver recipe", kind, ", ".join(RECIPE_BUILDERS))
    return RECIPE_BUILDERS[kind](recipe, weights, build_inner)


def _build_named(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    name = recipe["name"]
    if name not in DRIVERS:
        raise invalid_value("driver recipe", name, ", ".join(DRIVERS))
    return build_dataclass(DRIVERS[name], recipe["parameters"], f"driver {name}")


def _build_residual(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found = build_dataclass(_ResidualRecipe, recipe, "driver recipe")
    expert = build_inner(found.expert, EXPERT_KEY)
    own = {name: array for name, array in weights.items() if not name.startswith(f"{EXPERT_KEY}.")}
    network = network_from_weights(own, found.authority, found.exploration_std, found.episode_noise)
    if found.files:
        check_user_files(found.inputs, found.files)
    shown = observation_size(found.inputs, expert)
    if network.input_size != shown:
        raise InputError(f"network: {network.input_size} inputs are not allowed; allowed: {shown}")
    return ResidualDriver(expert, network, found.action_limit, found.inputs, found.action_repeat)


@dataclass(frozen=True, config=STRICT)
class _ImpairedRecipe:
    """How a driver with what is worse about it is written down."""

    kind: Literal["impaired"]
    driver: dict[str, Any]
    delay: NonNegative
    gap_noise: NonNegative
    time_step: Positive


def _build_impaired(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found = build_dataclass(_ImpairedRecipe, recipe, "driver recipe")
    if found.delay / found.time_step > MAX_WINDOW_STEPS:
        raise invalid_value("delay", found.delay, f"at most {MAX_WINDOW_STEPS:,} steps of {found.time_step:g} s")
    return ImpairedDriver(build_inner(found.driver, INNER_KEY), found.delay, found.gap_noise, found.time_step)


@dataclass(frozen=True, config=STRICT)
class _QueueFallbackRecipe:
    """How a driver that leads while all are gathered is written down, with who drives otherwise."""

    kind: Literal["queue-fallback"]
    drivers: dict[str, dict[str, Any]]
    time_step: Positive


def _build_queue_fallback(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found = build_dataclass(_QueueFallbackRecipe, recipe, "driver recipe")
    leading, otherwise = (build_inner(found.drivers[name], name) for name in (PRIMARY_KEY, FALLBACK_KEY))
    return QueueFallback(leading, otherwise, found.time_step)


@dataclass(frozen=True, config=STRICT)
class _HistoryRecipe:
    """How a driver that remembers means is written down."""

    kind: Literal["history"]
    driver: dict[str, Any]
    time_step: Positive


def _build_history(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found = build_dataclass(_HistoryRecipe, recipe, "driver recipe")
    return HistoryDriver(build_inner(found.driver, INNER_KEY), found.time_step)


@dataclass(frozen=True, config=STRICT)
class _FilteredRecipe:
    """How a driver with its filter is written down."""

    kind: Literal["filtered"]
    driver: dict[str, Any]
    action_limit: Positive
    safety: SafetyFilter
    time_step: Positive


def _build_filtered(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found = build_dataclass(_FilteredRecipe, recipe, "driver recipe")
    return FilteredDriver(build_inner(found.driver, INNER_KEY), found.action_limit, found.safety, found.time_step)


RECIPE_BUILDERS: dict[str, Callable[[Recipe, Arrays, InnerDriverBuilder], Driver]] = {
    "named": _build_named,
    "file": lambda recipe, arrays, held: FileDriver(
        Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"], recipe["sha256"]
    ),
    "residual": _build_residual,
    "mixed": lambda recipe, arrays, held: MixedDriver(
        tuple(held(part, str(number)) for number, part in enumerate(recipe["drivers"]))
    ),
    "impaired": _build_impaired,
    "filtered": _build_filtered,
    "road-type-switch": lambda recipe, arrays, held: RoadTypeSwitch(
        **{kind: held(recipe["drivers"][kind], kind) for kind in ROAD_TYPES if kind in recipe["drivers"]}
    ),
    "queue-fallback": _build_queue_fallback,
    "history": _build_history,
}
"""how each kind of recipe becomes a driver again"""


def user_code_recipes(recipe: Any) -> list[Recipe]:
    """Return what within `recipe` refers to the users' own files: it is Python code.

    Raises:
        InputError: a network sees a feature of a file that is not listed beside it with its hash.
    """
    held = list(_iterate_recipes(recipe))
    for part in held:
        if part["kind"] == "residual":
            _check_user_features_listed(part)
    return [part for part in held if part["kind"] == "file"]


def _check_user_features_listed(recipe: Recipe) -> None:
    """Raise `InputError` where a residual sees a feature whose file is not among those that it lists."""
    found = build_dataclass(_ResidualRecipe, recipe, "driver recipe")
    listed = [(file.get("path"), file.get("name")) for file in found.files if file.get("kind") == "file"]
    for name in found.inputs:
        if name not in FEATURES:
            reference = FileReference.parse(name)
            if (str(reference.path), reference.name) not in listed:
                allowed = "features whose files the recipe lists with their hashes"
                raise invalid_value("driver recipe: input", name, allowed)


def _iterate_recipes(recipe: Any) -> Iterator[Recipe]:
    """Yield a recipe and all that it holds."""
    if isinstance(recipe, dict):
        if "kind" in recipe:
            yield recipe
        for part in recipe.values():
            yield from _iterate_recipes(part)
    elif isinstance(recipe, list):
        for part in recipe:
            yield from _iterate_recipes(part)


def unique_label(driver: Driver, drivers_by_label: dict[str, Driver]) -> str:
    """Return the description of a driver, numbered where another driver has it already."""
    label, number = driver.describe(), 1
    while label in drivers_by_label and not _is_same_driver(drivers_by_label[label], driver):
        number += 1
        label = f"{driver.describe()} ({number})"
    return label


def _is_same_driver(driver: Driver, other: Driver) -> bool:
    if not (is_serializable(driver) and is_serializable(other)):
        return driver is other
    (recipe, arrays), (other_recipe, other_arrays) = driver_recipe(driver), driver_recipe(other)
    return recipe == other_recipe and all(np.array_equal(array, other_arrays[name]) for name, array in arrays.items())
