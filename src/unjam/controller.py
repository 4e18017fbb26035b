"""The trained controller as one file, and every way to name a driver.

A `.unjam` file is a zip archive of `manifest.json` (what it is and how its driver is made) and
`weights.safetensors`. Nothing in it is ever executed. If its expert is in a user's Python file, the
manifest names that file and its hash.
"""

import hashlib
import io
import json
import lzma
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.numpy import load, save

from unjam import __version__
from unjam.drivers.driver import Driver
from unjam.drivers.from_file import is_file_reference
from unjam.drivers.mixed import Mixed
from unjam.drivers.registry import DRIVERS, driver_from_recipe, named_driver, recipe_of
from unjam.drivers.residual import ResidualDriver, observation_size
from unjam.errors import InputError

SUFFIX = ".unjam"
FORMAT = 1
LARGEST_PART = 64 * 2**20
"""bytes of one part, unpacked"""
_SEVERAL = re.compile(r"\+(?=[^\W\d]|[./~])")
"""between two drivers of a mixture; not the + of 1e+5"""
MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"


def controller_bytes(driver: Driver, about: dict[str, Any]) -> bytes:
    """Return the content of a `.unjam` file for a driver; `about` goes into its manifest."""
    recipe, arrays = recipe_of(driver)
    weights = save(arrays)
    manifest = {
        "format": FORMAT,
        "unjam": __version__,
        "driver": recipe,
        "sha256": {WEIGHTS: hashlib.sha256(weights).hexdigest()},
        **about,
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        # A fixed date, so that the same controller has the same bytes.
        archive.writestr(zipfile.ZipInfo(MANIFEST), json.dumps(manifest, indent=1))
        archive.writestr(zipfile.ZipInfo(WEIGHTS), weights)
    return content.getvalue()


def load_controller(path: Path | str) -> Driver:
    """Return the driver of a `.unjam` file, or of the run folder that holds one.

    Raises:
        InputError: there is none, or it is damaged, or it is not a controller.
    """
    path = Path(path)
    file = path / f"controller{SUFFIX}" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"controller: {str(file)!r} does not exist")
    try:
        with zipfile.ZipFile(file) as archive:
            manifest = json.loads(_read_part(archive, MANIFEST))
            weights = _read_part(archive, WEIGHTS)
        if manifest["format"] != FORMAT:
            raise InputError(f"controller {file.name}: format {manifest['format']!r} is unknown")
        if hashlib.sha256(weights).hexdigest() != manifest["sha256"][WEIGHTS]:
            raise InputError(f"controller {file.name}: damaged: its weights do not have the hash it names")
        driver = driver_from_recipe(manifest["driver"], load(weights))
        _check_inputs(driver)
        return driver
    except (
        zipfile.BadZipFile,
        zlib.error,
        lzma.LZMAError,
        SafetensorError,
        OSError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RuntimeError,  # encrypted, of a kind that zipfile does not know, or nested without end
    ) as error:
        raise InputError(f"controller {file.name}: not a controller: {error}") from None


def _check_inputs(driver: Driver) -> None:
    """Raise `InputError` where a network does not see as many numbers as its driver shows it."""
    while isinstance(driver, ResidualDriver):
        shown = observation_size(driver.parts, driver.expert)
        if driver.network.inputs != shown:
            raise InputError(f"network: {driver.network.inputs} inputs are not allowed; allowed: {shown}")
        driver = driver.expert


def _read_part(archive: zipfile.ZipFile, name: str) -> bytes:
    size = archive.getinfo(name).file_size
    if size > LARGEST_PART:
        raise InputError(f"controller: {name} has {size} bytes; allowed: at most {LARGEST_PART}")
    return archive.read(name)


def make_driver(text: str, time_step: float) -> Driver:
    """Return the driver that `text` names.

    Args:
        text: a name (`pi`), with parameters (`pi:time_constant=1,window=30`), your own (`path.py:name`), a
            run folder, or a `.unjam` file; or several of them joined by `+`, for CAVs side by side.
        time_step: time between two decisions of the road [s].

    Raises:
        InputError: there is no such driver, or a parameter is wrong.
    """
    path = Path(text)
    parts = [] if path.exists() else _SEVERAL.split(text)
    if len(parts) > 1:
        return Mixed(tuple(make_driver(part, time_step) for part in parts))
    named = text.partition(":")[0] in DRIVERS or is_file_reference(text)
    if not named and (text.endswith(SUFFIX) or path.is_dir()):
        return load_controller(path)
    return named_driver(text, time_step)
