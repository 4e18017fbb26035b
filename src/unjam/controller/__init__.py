"""The controller as one file that can be shipped, and every way to name a driver.

A `.unjam` file is an uncompressed zip archive of a manifest in JSON (what it is, what it observes and
remembers, how its driver is made), weights in safetensors and, where it was exported, a recorded sample
and an ONNX graph. Nothing in it is ever executed.
"""

import os
import re
from importlib.resources import files
from pathlib import Path

from unjam.controller.file import SUFFIX, controller_bytes, hash_of, load_controller
from unjam.drivers.driver import Driver
from unjam.drivers.from_file import is_file_reference
from unjam.drivers.registry import DRIVERS, named_driver
from unjam.drivers.wrappers import Mixed
from unjam.errors import wrong, wrong_name
from unjam.files import SHIPPED

__all__ = [
    "BEST",
    "SHIPPED",
    "SUFFIX",
    "controller_bytes",
    "load_controller",
    "make_driver",
    "make_expert",
    "shipped_file",
    "shipped_names",
]

BEST = "unjam:best"
"""who drives where nobody is named: the controller for every road"""
SHIPPED_FOLDER = Path(str(files("unjam") / "controllers"))

_SEVERAL = re.compile(r"\+(?=[^\W\d]|[./~])")
"""between two drivers of a mixture; not the + of 1e+5"""


def make_driver(text: str, time_step: float) -> Driver:
    """Return the driver that `text` names.

    Args:
        text: a name (`pi`), with parameters (`pi:time_constant=1,window=30`), your own (`path.py:name`), a
            run folder, a `.unjam` file, or a shipped controller (`unjam:ring-best`); or several of them
            joined by `+`, for CAVs side by side.
        time_step: time between two decisions of the road [s].

    Raises:
        InputError: there is no such driver, or a parameter is wrong.
    """
    is_one = os.path.exists(text) or os.path.exists(text.rpartition(":")[0])
    parts = [] if is_one else _SEVERAL.split(text)
    if len(parts) > 1:
        return Mixed(tuple(make_driver(part, time_step) for part in parts))
    if text.startswith(SHIPPED):
        return load_controller(shipped_file(text.removeprefix(SHIPPED)))
    is_folder = os.path.isdir(text)  # whatever it is called, it is no file with code
    named = text.partition(":")[0] in DRIVERS or (is_file_reference(text) and not is_folder)
    if not named and (text.endswith(SUFFIX) or is_folder):
        return load_controller(text)
    return named_driver(text, time_step)


def make_expert(text: str, time_step: float) -> Driver:
    """Return the driver that `text` names, for something to be added to it; arguments as `make_driver`.

    Raises:
        InputError: there is no such driver, or the simulator itself drives it.
    """
    driver = make_driver(text, time_step)
    if driver.native:
        raise wrong("expert", text, "drivers that unjam asks; idm drives like people")
    return driver


def file_of(text: str) -> Path | None:
    """Return the controller's file that a driver's name stands for; None where it is none."""
    path = Path(text)
    if text.startswith(SHIPPED):
        path = shipped_file(text.removeprefix(SHIPPED))
    elif os.path.isdir(text):
        path = path / f"controller{SUFFIX}"
    return path if path.suffix == SUFFIX and os.path.isfile(path) else None


def hash_of_controller(text: str) -> str | None:
    """Return the SHA-256 of the controller's file that a driver's name stands for; None where it is none."""
    path = file_of(text)
    return None if path is None else hash_of(path.read_bytes())


def shipped_names() -> list[str]:
    """Return the names of the controllers that are part of the package: `ring-best`."""
    return sorted(path.stem for path in SHIPPED_FOLDER.glob(f"*{SUFFIX}"))


def shipped_file(name: str) -> Path:
    """Return the file of a shipped controller; raise `InputError` where there is none of that name."""
    if name not in shipped_names():
        raise wrong_name("driver", f"{SHIPPED}{name}", [f"{SHIPPED}{known}" for known in shipped_names()])
    return SHIPPED_FOLDER / f"{name}{SUFFIX}"
