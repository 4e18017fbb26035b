"""All drivers by name, and the conversion of drivers to recipes and back, so that other processes can build them."""

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
DRIVERS: dict[str, type[Driver]] = {driver_class.name: driver_class for driver_class in _DRIVER_CLASSES}
"""classes of drivers by their names for `--driver`"""
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
"""classes of drivers by their names in recipes; files and messages to workers contain recipes"""


def driver_names() -> str:
    """Return the allowed values of `--driver`, for messages."""
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
    driver_class = DRIVERS[name]
    if "time_step" in signature(driver_class).parameters:
        parameters = {"time_step": time_step, **parameters}
    return build_dataclass(driver_class, parameters, f"driver {name}")


def driver_recipe(driver: Driver) -> tuple[Recipe, Arrays]:
    """Return the recipe of a driver, and weights of networks; `InputError` if other processes cannot build it."""
    for component in _iterate_drivers(driver):
        if not _is_portable(component):
            reason = "is not allowed here: it drives in its own process only"
            raise InputError(f"driver: {component.describe()!r} {reason}; allowed: {component.portable_form}")
        for name, part in (named_parts(component) or {}).items():
            if not isinstance(part, Driver):
                check_part(f"driver {component.describe()}: {name}", part)
    return pack(driver, classes={Driver: DRIVER_CLASSES})


def _iterate_drivers(driver: Driver) -> Iterator[Driver]:
    """Yield a driver and all drivers within it."""
    yield driver
    for inner_driver in driver.inner_drivers.values():
        yield from _iterate_drivers(inner_driver)


def is_serializable(driver: Driver) -> bool:
    """Return whether other processes can build a driver; they cannot build drivers that a notebook defines."""
    return all(map(_is_portable, _iterate_drivers(driver)))


def _is_portable(driver: Driver) -> bool:
    """Return whether other processes have the class of a driver: a registered class of unjam."""
    return type(driver) in DRIVER_CLASSES.values() and is_packaged(type(driver))


def driver_from_recipe(recipe: Recipe, weights: Arrays) -> Driver:
    """Return the driver for a recipe of `driver_recipe`; raise `InputError` if the recipe is not valid."""
    check_values(recipe, "driver recipe")
    try:
        driver = unpack(Driver, recipe, weights, {Driver: DRIVER_CLASSES})
    except ValueError as error:
        raise InputError(f"driver recipe: {error}") from None
    for component in _iterate_drivers(driver):
        if isinstance(component, ResidualDriver):
            input_size, size = component.network.input_size, observation_size(component.features, component.expert)
            if input_size != size:
                raise InputError(f"network: {input_size} inputs are not allowed; allowed: {size}")
    return driver


def user_code_recipes(recipe: Any) -> list[Recipe]:
    """Return the parts of a driver's recipe that refer to Python files of the user.

    Raise `InputError` if the recipe does not list the file of a feature with its hash, and `LookupError` or `TypeError`
    if the recipe is not valid.
    """
    recipes = list(_iterate_recipes(recipe))
    file_recipes = [part for part in recipes if part["kind"] == "file"]
    for residual in (part for part in recipes if part["kind"] == "residual"):
        listed_files = residual.get("files", [])
        inputs = residual.get("inputs", [])
        if not listed_files and (user_features := [name for name in inputs if name not in FEATURES]):
            allowed = "features whose files the recipe lists with their hashes"
            raise invalid_value("driver recipe: input", user_features[0], allowed)
        file_recipes += listed_files
    return file_recipes


def _iterate_recipes(json_value: Any) -> Iterator[Recipe]:
    """Yield each dict with a `kind` within JSON."""
    if isinstance(json_value, dict):
        if "kind" in json_value:
            yield json_value
        json_value = list(json_value.values())
    if isinstance(json_value, list):
        for item in json_value:
            yield from _iterate_recipes(item)


def unique_label(driver: Driver, drivers_by_label: dict[str, Driver]) -> str:
    """Return the description of a driver, followed by a number if a different driver already has this label."""
    label, number = driver.describe(), 1
    while label in drivers_by_label and not _is_same_driver(drivers_by_label[label], driver):
        number += 1
        label = f"{driver.describe()} ({number})"
    return label


def _is_same_driver(driver: Driver, other: Driver) -> bool:
    if not (is_serializable(driver) and is_serializable(other)):
        return driver is other
    (recipe, arrays), (other_recipe, other_arrays) = driver_recipe(driver), driver_recipe(other)
    is_same_recipe = to_json(recipe) == to_json(other_recipe)  # in JSON, NaN is equal to itself
    return is_same_recipe and all(np.array_equal(array, other_arrays[name]) for name, array in arrays.items())
