"""All drivers by name, and how a driver is written down so that another process can make it again."""

from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unjam.drivers.acc import ACC, LACC
from unjam.drivers.bilateral import BCM
from unjam.drivers.constant import Constant
from unjam.drivers.driver import Driver
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.from_file import FileDriver, is_file_reference
from unjam.drivers.idm import IDM, Human
from unjam.drivers.network import network_arrays, network_from_arrays
from unjam.drivers.ovm import OVM
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.errors import wrong
from unjam.parameters import build, parse_assignments

DRIVERS: dict[str, type[Driver]] = {
    "human": Human,
    "idm": IDM,
    "pi": PISaturation,
    "follower-stopper": FollowerStopper,
    "acc": ACC,
    "lacc": LACC,
    "bcm": BCM,
    "ovm": OVM,
    "constant": Constant,
}

Recipe = dict[str, Any]
"""What a driver is made from, as JSON; the weights of its networks travel beside it as arrays."""


def driver_names() -> str:
    """Return what `--driver` allows, for messages."""
    return ", ".join([*DRIVERS, "path.py:name", "a run folder", "a .unjam file"])


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
    if isinstance(driver, FileDriver):
        recipe = {
            "kind": "file",
            "path": str(driver.path),
            "name": driver.name,
            "parameters": driver.parameters,
            "time_step": driver.time_step,
        }
        return recipe, {}
    for name, kind in DRIVERS.items():
        if type(driver) is kind:
            return {"kind": "named", "name": name, "parameters": asdict(driver)}, {}  # pyright: ignore[reportArgumentType]
    raise wrong("driver", type(driver).__name__, f"{driver_names()} (put your class in a file: path.py:name)")


def driver_from_recipe(recipe: Recipe, arrays: dict[str, np.ndarray], prefix: str = "") -> Driver:
    """Return the driver that `recipe_of` wrote down; raise `InputError` where the recipe is not valid."""
    kind = recipe.get("kind")
    if kind == "named" and recipe["name"] in DRIVERS:
        return build(DRIVERS[recipe["name"]], recipe["parameters"], f"driver {recipe['name']}")
    if kind == "file":
        return FileDriver(Path(recipe["path"]), recipe["name"], recipe["parameters"], recipe["time_step"])
    if kind == "residual":
        expert_prefix = f"{prefix}expert."
        own = {
            name.removeprefix(prefix): array
            for name, array in arrays.items()
            if name.startswith(prefix) and not name.startswith(expert_prefix)
        }
        return ResidualDriver(
            driver_from_recipe(recipe["expert"], arrays, expert_prefix),
            network_from_arrays(own, recipe["authority"], recipe["exploration_std"]),
            recipe["action_limit"],
            tuple(recipe["parts"]),
            recipe["hold"],
        )
    raise wrong("driver recipe", kind, "named, file, residual")


def describe(driver: Driver) -> str:
    """Return a driver in a few words: its name and the parameters that differ from the defaults."""
    if isinstance(driver, ResidualDriver):
        return f"{describe(driver.expert)} + residual"
    if isinstance(driver, FileDriver):
        return f"{driver.path.name}:{driver.name}"
    recipe, _ = recipe_of(driver)
    default = {field.name: field.default for field in fields(driver)}  # pyright: ignore[reportArgumentType]
    changed = [
        f"{key}={value}"
        for key, value in recipe["parameters"].items()
        if value != default[key] and key != "time_step"
    ]
    return ":".join([recipe["name"], *([",".join(changed)] if changed else [])])
