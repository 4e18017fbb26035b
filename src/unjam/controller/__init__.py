"""Controllers as files, and the construction of drivers from names.

A `.unjam` file is an uncompressed zip archive of a manifest in JSON (observation, memory, recipe of the driver),
weights in safetensors and, in exported files, a recorded sample and an ONNX graph. It contains no code to execute.
"""

import os
from pathlib import Path

from unjam.controller.file import (
    SUFFIX,
    controller_bytes,
    controller_file,
    load_controller,
    packaged_file,
    packaged_names,
)
from unjam.drivers.driver import Driver
from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.drivers.user_driver import DriverLike, as_driver, is_file_reference
from unjam.drivers.wrappers import MixedDriver
from unjam.errors import invalid_value, unknown_name
from unjam.file_names import split_names
from unjam.files import PACKAGED_PREFIX, sha256_of
from unjam.parameters import split_parameters

__all__ = ["controller_bytes", "load_controller", "make_driver", "make_expert", "packaged_file", "packaged_names"]

DEFAULT_DRIVER = "unjam:best"  # driver of commands without `--driver`: the controller for all roads


def make_driver(name: str, time_step: float) -> Driver:
    """Return the driver with a name; raise `InputError` if no driver has the name, or a parameter is wrong.

    Args:
        name: a name (`pi`), with parameters (`pi:time_constant=1,window=30`), your own driver (`path.py:name`), a run
            folder, a `.unjam` file, a `.zip` file of Stable-Baselines3 with a model that observes `local`, also with
            its control step (`ppo.zip:policy_time_step=1.0`), an `.onnx` file with a description (`policy.toml`), or a
            packaged controller (`unjam:ring-best`); or several names joined by `+`: CAVs use these drivers in rotation.
        time_step: control step of the road [s].
    """
    single_names = split_names(name)
    if len(single_names) > 1:
        return MixedDriver(tuple(make_driver(single_name, time_step) for single_name in single_names))
    if name.startswith(PACKAGED_PREFIX):
        return load_controller(name)
    is_folder = os.path.isdir(name)  # also with a name that ends like a file with code
    file, parameters = split_parameters(name)
    if file.endswith(".zip") and not is_folder:
        from unjam.adapters.policies import policy_driver

        if unknown := parameters.keys() - {"policy_time_step"}:
            raise unknown_name(f"driver {Path(file).name}", min(unknown), ["policy_time_step"])
        return policy_driver(file, time_step=time_step, **parameters)
    if name.endswith((".onnx", ".toml")) and not is_folder:
        from unjam.adapters.onnx_file import onnx_driver

        return onnx_driver(name, time_step=time_step)
    is_driver_name = name.partition(":")[0] in DRIVERS or (is_file_reference(name) and not is_folder)
    if not is_driver_name and (name.endswith(SUFFIX) or is_folder):
        return load_controller(name)
    return driver_from_name(name, time_step)


def make_expert(name: str | DriverLike, time_step: float) -> Driver:
    """Return a driver to which a residual can be added; raise `InputError` as `make_driver`, and for `human`."""
    driver = make_driver(name, time_step) if isinstance(name, str) else as_driver(name, time_step)
    if driver.is_driven_by_simulator:
        raise invalid_value("expert", name, "drivers outside of the simulator; 'idm' drives like a human driver")
    return driver


def controller_path(driver_name: str) -> Path | None:
    """Return the `.unjam` file of a driver's name; None if the driver is not a controller."""
    path = controller_file(driver_name)
    return path if path.suffix == SUFFIX and os.path.isfile(path) else None


def controller_hash(driver_name: str) -> str | None:
    """Return the SHA-256 of the `.unjam` file of a driver's name; None if the driver is not a controller."""
    path = controller_path(driver_name)
    return None if path is None else sha256_of(path.read_bytes())
