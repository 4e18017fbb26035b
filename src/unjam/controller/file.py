"""Writing and reading a `.unjam` file."""

import hashlib
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.numpy import load, save

from unjam import __version__
from unjam.controller.archive import MANIFEST, WEIGHTS, pack_parts, unpack_parts
from unjam.controller.manifest import FORMAT, READABLE, description
from unjam.drivers.driver import Driver
from unjam.drivers.observation import observation_size
from unjam.drivers.registry import driver_from_recipe, files_of, recipe_of
from unjam.drivers.residual import ResidualDriver
from unjam.errors import InputError
from unjam.files import to_json

SUFFIX = ".unjam"


@dataclass(frozen=True)
class Controller:
    """What a `.unjam` file holds."""

    driver: Driver
    manifest: dict[str, Any]
    parts: dict[str, bytes]
    """content of the archive, by name"""


def controller_bytes(driver: Driver, about: dict[str, Any], parts: dict[str, bytes] | None = None) -> bytes:
    """Return the content of a `.unjam` file.

    Args:
        driver: what it drives by.
        about: where it comes from, for its manifest; `action_limit` [m/s2] is what the road allows.
        parts: further parts of the archive, by name.
    """
    recipe, arrays = recipe_of(driver)
    parts = {WEIGHTS: save(arrays), **(parts or {})}
    manifest = {
        "format": FORMAT,
        "unjam": __version__,
        "driver": recipe,
        **description(driver, about.get("action_limit")),
        **about,
        "sha256": {name: hash_of(part) for name, part in parts.items()},
    }
    return pack_parts({MANIFEST: to_json(manifest, indent=1).encode(), **parts})


def load_controller(path: Path | str) -> Driver:
    """Return the driver of a `.unjam` file, or of the run folder that holds one.

    Raises:
        InputError: there is none, or it is damaged, or it is not a controller, or a file by itself wants
            to run Python code.
    """
    return read_controller(path).driver


def read_controller(path: Path | str) -> Controller:
    """Return what a `.unjam` file holds, checked; raise `InputError` as `load_controller`."""
    path = Path(path)
    file = path / f"controller{SUFFIX}" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"controller: {str(file)!r} does not exist")
    try:
        parts = unpack_parts(file)
        manifest = json.loads(parts[MANIFEST])
        if manifest["format"] not in READABLE:
            raise InputError(f"controller {file.name}: format {manifest['format']!r} is unknown")
        _check_hashes(file.name, manifest["sha256"], parts)
        _check_code(file.name, manifest["driver"], own=path.is_dir())
        arrays = load(parts[WEIGHTS])
        driver = driver_from_recipe(manifest["driver"], arrays)
        unknown = arrays.keys() - recipe_of(driver)[1].keys()
        if unknown:
            raise InputError(f"controller {file.name}: weights {min(unknown)!r} belong to no network")
        _check_inputs(driver)
        return Controller(driver, manifest, parts)
    except (
        zipfile.BadZipFile,
        zlib.error,
        SafetensorError,
        OSError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        ArithmeticError,
        MemoryError,
        RuntimeError,  # of a kind that zipfile does not know, or nested without end
    ) as error:
        raise InputError(f"controller {file.name}: not a controller: {error}") from None


def hash_of(part: bytes) -> str:
    """Return the SHA-256 of a part, as the manifest names it."""
    return hashlib.sha256(part).hexdigest()


def _check_hashes(name: str, hashes: dict[str, str], parts: dict[str, bytes]) -> None:
    """Raise `InputError` unless the manifest names the hash of every other part, and of nothing else."""
    if hashes.keys() != parts.keys() - {MANIFEST}:
        raise InputError(f"controller {name}: damaged: its parts are not those that it names")
    for part, content in parts.items():
        if part != MANIFEST and hash_of(content) != hashes[part]:
            raise InputError(f"controller {name}: damaged: {part} does not have the hash that it names")


def _check_code(name: str, recipe: Any, own: bool) -> None:
    """Raise `InputError` where a driver is Python code that a stranger may have named, or that has changed.

    What lies in a run folder is the user's `own`; a file by itself may come from anywhere.
    """
    for found in files_of(recipe):
        code = Path(found["path"])
        if not own:
            raise InputError(
                f"controller {name}: its expert is Python code ({code.name}), which a file by itself may not "
                f"run; use the run folder"
            )
        if code.is_file() and hash_of(code.read_bytes()) != found["sha256"]:
            raise InputError(f"controller {name}: its expert {str(code)!r} has changed since")


def _check_inputs(driver: Driver) -> None:
    """Raise `InputError` where a network does not see as many numbers as its driver shows it."""
    while isinstance(driver, ResidualDriver):
        shown = observation_size(driver.parts, driver.expert)
        if driver.network.inputs != shown:
            raise InputError(f"network: {driver.network.inputs} inputs are not allowed; allowed: {shown}")
        driver = driver.expert
