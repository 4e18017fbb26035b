"""All drivers by name, and the construction of every driver from its recipe, so that other processes can build it."""

from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import ACC, BCM, IDM, LACC, OVM, AdaptiveACC, Constant, FollowerStopper, Human
from unjam.drivers.driver import Driver, Recipe
from unjam.drivers.network import network_from_weights
from unjam.drivers.observation import FEATURES, FeatureName, check_user_files, observation_size
from unjam.drivers.onnx_policy import GRAPH_WEIGHTS, OnnxDriver
from unjam.drivers.pi_saturation import PIFromGap, PISaturation
from unjam.drivers.policy import PolicyDescription
from unjam.drivers.residual import EXPERT_KEY, ResidualDriver
from unjam.drivers.road_experts import Cruise, GapMaker, JamAbsorber, JamAhead, Pacer
from unjam.drivers.user_driver import FileDriver, FileReference, is_file_reference
from unjam.drivers.wrappers import COMPOSITE_CLASSES, INNER_KEY, MixedDriver
from unjam.errors import InputError, invalid_value, spelling_hint
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt, build_dataclass, split_parameters
from unjam.tree import Arrays, select_prefix

_DRIVER_CLASSES = (
    *(Human, IDM, PISaturation, PIFromGap, FollowerStopper, ACC, LACC, BCM, OVM),
    *(Pacer, JamAbsorber, Cruise, JamAhead, GapMaker, AdaptiveACC, Constant),
)
DRIVERS: dict[str, type[Driver]] = {kind.name: kind for kind in _DRIVER_CLASSES}

InnerDriverBuilder = Callable[[Any, str], Driver]
"""builds an inner driver from its recipe and the prefix of its networks' weights"""


def driver_names() -> str:
    """Return what `--driver` allows, for messages."""
    files = ["path.py:name", "a run folder", "a .unjam file", "an .onnx file", "unjam:ring-best"]
    return ", ".join([*DRIVERS, *files, "several joined by +"])


def driver_from_name(text: str, time_step: float) -> Driver:
    """Return the driver for `name`, `name:key=value,...` or `path.py:name`; `time_step` is the control step [s].

    Raise `InputError` for an unknown name or parameter, or a value out of range.
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
class _OnnxRecipe:
    kind: Literal["onnx"]
    label: str
    description: PolicyDescription
    time_step: Positive | None
    expert: dict[str, Any]


@dataclass(frozen=True, config=STRICT)
class _ResidualRecipe:
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
    """Return the recipe of a driver and the weights of its networks; `driver_from_recipe` is the inverse.

    Raise `InputError` if no other process could build such a driver.
    """
    recipe = driver.recipe()
    if any(part["kind"] == "named" and not part["name"] for part in _iterate_recipes(recipe)):
        raise invalid_value("driver", driver.describe(), f"{driver_names()} (put your class in a file: path.py:name)")
    return recipe, driver.weights()


def is_serializable(driver: Driver) -> bool:
    """Return whether another process can build a driver; drivers defined in a notebook drive in their own process."""
    try:
        return bool(driver_recipe(driver))
    except InputError:
        return False


def driver_from_recipe(recipe: Recipe, weights: Arrays) -> Driver:
    """Return the driver for a recipe of `driver_recipe`; raise `InputError` if the recipe is not valid."""

    def build_inner(recipe: Any, name: str) -> Driver:
        return driver_from_recipe(recipe, select_prefix(f"{name}.", weights))

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
    size = observation_size(found.inputs, expert)
    if network.input_size != size:
        raise InputError(f"network: {network.input_size} inputs are not allowed; allowed: {size}")
    return ResidualDriver(expert, network, found.action_limit, found.inputs, found.action_repeat)


def _build_onnx(recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder) -> Driver:
    found, graph = build_dataclass(_OnnxRecipe, recipe, "driver recipe"), weights.get(GRAPH_WEIGHTS)
    if graph is None or graph.dtype != np.uint8 or graph.ndim != 1:
        raise InputError(f"driver recipe: weights {GRAPH_WEIGHTS!r} are not bytes")
    expert = build_inner(found.expert, EXPERT_KEY)
    return OnnxDriver(found.label, found.description, expert, found.time_step, graph=graph.tobytes())


def _build_composite(
    driver_class: type[Driver], recipe: Recipe, weights: Arrays, build_inner: InnerDriverBuilder
) -> Driver:
    values = {key: value for key, value in recipe.items() if key not in ("kind", "drivers")}
    values |= {name: build_inner(part, name) for name, part in recipe.get("drivers", {}).items()}
    if "driver" in recipe:
        values["driver"] = build_inner(recipe["driver"], INNER_KEY)
    return build_dataclass(driver_class, values, "driver recipe")


RECIPE_BUILDERS: dict[str, Callable[[Recipe, Arrays, InnerDriverBuilder], Driver]] = {
    "named": _build_named,
    "file": lambda recipe, weights, build_inner: FileDriver(
        Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"], recipe["sha256"]
    ),
    "onnx": _build_onnx,
    "residual": _build_residual,
    "mixed": lambda recipe, weights, build_inner: MixedDriver(
        tuple(build_inner(part, str(number)) for number, part in enumerate(recipe["drivers"]))
    ),
    **{kind.kind: partial(_build_composite, kind) for kind in COMPOSITE_CLASSES},
}
"""functions that build a driver, by the kind of its recipe"""


def user_code_recipes(recipe: Any) -> list[Recipe]:
    """Return the parts of `recipe` that refer to the user's own files, which are Python code.

    Raise `InputError` if a network reads a feature from a file that is not listed with its hash.
    """
    parts = list(_iterate_recipes(recipe))
    for residual in (part for part in parts if part["kind"] == "residual"):
        found = build_dataclass(_ResidualRecipe, residual, "driver recipe")
        listed = [(file.get("path"), file.get("name")) for file in found.files if file.get("kind") == "file"]
        for name in found.inputs:
            reference = FileReference.parse(name)
            if name not in FEATURES and (str(reference.path), reference.name) not in listed:
                allowed = "features whose files the recipe lists with their hashes"
                raise invalid_value("driver recipe: input", name, allowed)
    return [part for part in parts if part["kind"] == "file"]


def _iterate_recipes(recipe: Any) -> Iterator[Recipe]:
    if isinstance(recipe, dict):
        if "kind" in recipe:
            yield recipe
        recipe = list(recipe.values())
    if isinstance(recipe, list):
        for part in recipe:
            yield from _iterate_recipes(part)


def unique_label(driver: Driver, drivers_by_label: dict[str, Driver]) -> str:
    """Return the description of a driver, with a number if another driver already has it."""
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
