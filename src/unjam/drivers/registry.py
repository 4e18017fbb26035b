"""All drivers by name, and the construction of every driver from its recipe, so that other processes can build it."""

from collections.abc import Iterator
from inspect import signature
from typing import Any

import numpy as np

from unjam.drivers import wrappers
from unjam.drivers.car_following import ACC, BCM, IDM, LACC, OVM, AdaptiveACC, Constant, FollowerStopper, Human
from unjam.drivers.driver import Driver, Recipe
from unjam.drivers.observation import FEATURES, observation_size
from unjam.drivers.onnx_policy import OnnxDriver
from unjam.drivers.pi_saturation import PIFromGap, PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.road_experts import AdvisorySpeed, Cruise, GapMaker, JamAbsorber, JamAhead, Pacer
from unjam.drivers.smooth_acc import SmoothACC
from unjam.drivers.user_driver import FileDriver, FileReference, is_file_reference
from unjam.errors import InputError, invalid_value
from unjam.files import to_json
from unjam.parameters import build_dataclass, check_part, check_values, is_packaged, split_parameters
from unjam.text import spelling_hint
from unjam.tree import Arrays, named_parts, pack, unpack

_DRIVER_CLASSES = (
    *(Human, IDM, PISaturation, PIFromGap, FollowerStopper, ACC, SmoothACC, LACC, BCM, OVM),
    *(Pacer, JamAbsorber, Cruise, AdvisorySpeed, JamAhead, GapMaker, AdaptiveACC, Constant),
)
DRIVERS: dict[str, type[Driver]] = {kind.name: kind for kind in _DRIVER_CLASSES}
DRIVER_CLASSES: dict[str, type[Driver]] = {
    **DRIVERS,
    "file": FileDriver,
    "residual": ResidualDriver,
    "onnx": OnnxDriver,
    "mixed": wrappers.MixedDriver,
    "impaired": wrappers.ImpairedDriver,
    "filtered": wrappers.FilteredDriver,
    "history": wrappers.HistoryDriver,
    "queue-fallback": wrappers.QueueFallback,
    "road-type-switch": wrappers.RoadTypeSwitch,
}
"""dataclasses of drivers by their names in recipes, which files and messages to workers contain"""


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
    if "time_step" in signature(kind).parameters:
        parameters = {"time_step": time_step, **parameters}
    return build_dataclass(kind, parameters, f"driver {name}")


def driver_recipe(driver: Driver) -> tuple[Recipe, Arrays]:
    """Return the recipe of a driver and its networks' weights; `InputError` if no other process could build it."""
    for component in _all_drivers(driver):
        if not _is_portable(component):
            reason = "is not allowed here: it drives in its own process only"
            raise InputError(f"driver: {component.describe()!r} {reason}; allowed: {component.portable_form}")
        for name, part in (named_parts(component) or {}).items():
            if not isinstance(part, Driver):
                check_part(f"driver {component.describe()}: {name}", part)
    return pack(driver, classes={Driver: DRIVER_CLASSES})


def _all_drivers(driver: Driver) -> Iterator[Driver]:
    yield driver
    for inner in driver.inner_drivers.values():
        yield from _all_drivers(inner)


def is_serializable(driver: Driver) -> bool:
    """Return whether another process can build a driver; drivers defined in a notebook drive in their own process."""
    return all(map(_is_portable, _all_drivers(driver)))


def _is_portable(driver: Driver) -> bool:
    """Return whether other processes have the class of a driver; what this process alone registers is unknown there."""
    return type(driver) in DRIVER_CLASSES.values() and is_packaged(type(driver))


def driver_from_recipe(recipe: Recipe, weights: Arrays) -> Driver:
    """Return the driver for a recipe of `driver_recipe`; raise `InputError` if the recipe is not valid."""
    check_values(recipe, "driver recipe")
    try:
        driver = unpack(Driver, recipe, weights, {Driver: DRIVER_CLASSES})
    except ValueError as error:
        raise InputError(f"driver recipe: {error}") from None
    for part in (part for part in _all_drivers(driver) if isinstance(part, ResidualDriver)):
        if part.network.input_size != (size := observation_size(part.features, part.expert)):
            raise InputError(f"network: {part.network.input_size} inputs are not allowed; allowed: {size}")
    return driver


def user_code_recipes(recipe: Any) -> list[Recipe]:
    """Return the parts of `recipe` that refer to the user's own files, which are Python code.

    Raise `InputError` if a feature's file is not listed with its hash, `LookupError` or `TypeError` if it is not valid.
    """
    parts = list(_iterate_recipes(recipe))
    files = [part for part in parts if part["kind"] == "file"]
    for residual in (part for part in parts if part["kind"] == "residual"):
        listed = residual.get("files", [])
        if not listed and (user_features := [name for name in residual.get("inputs", []) if name not in FEATURES]):
            allowed = "features whose files the recipe lists with their hashes"
            raise invalid_value("driver recipe: input", user_features[0], allowed)
        files += listed
    return files


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
    is_equal = to_json(recipe) == to_json(other_recipe)  # in JSON, NaN is equal to itself
    return is_equal and all(np.array_equal(array, other_arrays[name]) for name, array in arrays.items())
