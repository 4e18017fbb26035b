"""The controller as one file that can be shipped, and every way to name a driver.

A `.unjam` file is an uncompressed zip archive of a manifest in JSON (what it is, what it observes and
remembers, how its driver is made), weights in safetensors and, where it was exported, a recorded sample
and an ONNX graph. Nothing in it is ever executed.
"""

import os
import re
from importlib.resources import files
from pathlib import Path

from unjam.controller.file import SUFFIX, controller_bytes, load_controller, sha256_of
from unjam.drivers.driver import Driver
from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.drivers.user_driver import is_file_reference
from unjam.drivers.wrappers import MixedDriver
from unjam.errors import invalid_value, unknown_name
from unjam.files import PACKAGED_PREFIX

__all__ = [
    "DEFAULT_DRIVER",
    "PACKAGED_PREFIX",
    "SUFFIX",
    "controller_bytes",
    "load_controller",
    "make_driver",
    "make_expert",
    "packaged_file",
    "packaged_names",
]

DEFAULT_DRIVER = "unjam:best"
"""who drives where nobody is named: the controller for every road"""
PACKAGED_FOLDER = Path(str(files("unjam") / "controllers"))

_MIXTURE_SEPARATOR = re.compile(r"\+(?=[^\W\d]|[./~])")
"""between two drivers of a mixture; not the + of 1e+5"""


def make_driver(name: str, time_step: float) -> Driver:
    """Return the driver that `text` names.

    Args:
        text: a name (`pi`), with parameters (`pi:time_constant=1,window=30`), your own (`path.py:name`), a
            run folder, a `.unjam` file, or a shipped controller (`unjam:ring-best`); or several of them
            joined by `+`, for CAVs side by side.
        time_step: time between two decisions of the road [s].

    Raises:
        InputError: there is no such driver, or a parameter is wrong.
    """
    is_one = os.path.exists(name) or os.path.exists(name.rpartition(":")[0])
    parts = [] if is_one else _MIXTURE_SEPARATOR.split(name)
    if len(parts) > 1:
        return MixedDriver(tuple(make_driver(part, time_step) for part in parts))
    if name.startswith(PACKAGED_PREFIX):
        return load_controller(packaged_file(name.removeprefix(PACKAGED_PREFIX)))
    is_folder = os.path.isdir(name)  # whatever it is called, it is no file with code
    named = name.partition(":")[0] in DRIVERS or (is_file_reference(name) and not is_folder)
    if not named and (name.endswith(SUFFIX) or is_folder):
        return load_controller(name)
    return driver_from_name(name, time_step)


def make_expert(name: str, time_step: float) -> Driver:
    """Return the driver that `text` names, for something to be added to it; arguments as `make_driver`.

    Raises:
        InputError: there is no such driver, or the simulator itself drives it.
    """
    driver = make_driver(name, time_step)
    if driver.is_native:
        raise invalid_value("expert", name, "drivers that unjam asks; idm drives like people")
    return driver


def controller_path(driver_name: str) -> Path | None:
    """Return the controller's file that a driver's name stands for; None where it is none."""
    path = Path(driver_name)
    if driver_name.startswith(PACKAGED_PREFIX):
        path = packaged_file(driver_name.removeprefix(PACKAGED_PREFIX))
    elif os.path.isdir(driver_name):
        path = path / f"controller{SUFFIX}"
    return path if path.suffix == SUFFIX and os.path.isfile(path) else None


def controller_hash(driver_name: str) -> str | None:
    """Return the SHA-256 of the controller's file that a driver's name stands for; None where it is none."""
    path = controller_path(driver_name)
    return None if path is None else sha256_of(path.read_bytes())


def packaged_names() -> list[str]:
    """Return the names of the controllers that are part of the package: `ring-best`."""
    return sorted(path.stem for path in PACKAGED_FOLDER.glob(f"*{SUFFIX}"))


def packaged_file(name: str) -> Path:
    """Return the file of a shipped controller; raise `InputError` where there is none of that name."""
    if name not in packaged_names():
        raise unknown_name(
            "driver", f"{PACKAGED_PREFIX}{name}", [f"{PACKAGED_PREFIX}{known}" for known in packaged_names()]
        )
    return PACKAGED_FOLDER / f"{name}{SUFFIX}"
