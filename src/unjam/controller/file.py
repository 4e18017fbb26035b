"""Writing and reading a `.unjam` file: archive, manifest, recorded sample, and what is checked of them."""

import hashlib
import io
import os
import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load, save

from unjam import __version__
from unjam.controller.manifest import MANIFEST_FORMAT, driver_interface, read_manifest
from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import COMMON_FIELDS, FIELD_SIZES, LocalState
from unjam.drivers.registry import driver_from_recipe, driver_recipe, user_code_recipes
from unjam.errors import InputError, invalid_value
from unjam.files import UNREADABLE_ERRORS, atomic_write, to_json
from unjam.physics.arrays import Floats
from unjam.trust import check_trusted
from unjam.user_code import read_code
from unjam.worlds.drive import drive_world
from unjam.worlds.world import RecordedWorld

if TYPE_CHECKING:
    from unjam.controller.signature import Ed25519PrivateKey

SUFFIX = ".unjam"
MANIFEST_PART, WEIGHTS_PART = "manifest.json", "weights.safetensors"
SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART = "sample.safetensors", "controller.onnx", "certificate.json"
SIGNATURE_PART = "signature.json"
ARCHIVE_PARTS = (MANIFEST_PART, WEIGHTS_PART, SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART, SIGNATURE_PART)
"""all that an archive may hold; sample and graph are there where it was exported, the certificate where it
was certified, the signature where it was signed: in this order then"""
MAX_PART_BYTES = 64 * 2**20
"""bytes of one part"""
MAX_JSON_BYTES = {MANIFEST_PART: 2**20, CERTIFICATE_PART: 2**20, SIGNATURE_PART: 10_000}
"""bytes of parts in JSON, which takes many times its size to be read"""
MAX_SAMPLE_STEPS = 1000
"""decisions in a recorded sample"""

ZIP_SYSTEM_UNIX = 3
"""of the systems that an archive can name"""

ACTION_NAME = "acceleration"
"""the answer's name in a sample and in a graph"""


@dataclass(frozen=True)
class Controller:
    """What a `.unjam` file holds."""

    driver: Driver
    manifest: dict[str, Any]
    parts: dict[str, bytes]
    """content of the archive, by name"""
    signed_by: str | None = None
    """fingerprint of the key that signed it; None where nobody did"""


def controller_bytes(driver: Driver, metadata: dict[str, Any], parts: dict[str, bytes] | None = None) -> bytes:
    """Return the content of a `.unjam` file.

    `about` says where it comes from, for its manifest; its `action_limit` [m/s2] is what the road allows.
    """
    recipe, arrays = driver_recipe(driver)
    parts = {WEIGHTS_PART: save(arrays), **(parts or {})}
    manifest = {
        "format": MANIFEST_FORMAT,
        "unjam": __version__,
        "driver": recipe,
        **driver_interface(driver, metadata.get("action_limit")),
        **metadata,
        "sha256": {name: sha256_of(part) for name, part in parts.items()},
    }
    return pack_parts({MANIFEST_PART: to_json(manifest, indent=1).encode(), **parts})


def add_certificate(file: Path, controller: Controller, certificate: dict[str, Any]) -> None:
    """Write a controller's file once more, with its certificate among its parts and their hashes.

    Raises:
        InputError: it is signed: it would no longer be what was signed.
    """
    check_unsigned(controller)
    parts = {**controller.parts, CERTIFICATE_PART: to_json(certificate, indent=1).encode()}
    del parts[MANIFEST_PART]
    manifest = {**controller.manifest, "sha256": {name: sha256_of(part) for name, part in parts.items()}}
    atomic_write(file, pack_parts({MANIFEST_PART: to_json(manifest, indent=1).encode(), **parts}))


def check_unsigned(controller: Controller) -> None:
    """Raise `InputError` where a controller is signed, and must stay as it is."""
    if controller.signed_by is not None:
        signed = f"controller: a file that is signed (by {controller.signed_by}) is not allowed"
        raise InputError(f"{signed}; allowed: one that is not: certify it first, then sign it")


def add_signature(file: Path, controller: Controller, key: "Ed25519PrivateKey") -> None:
    """Write a controller's file once more, signed with `key` and by nobody else."""
    from unjam.controller.signature import signature_of

    parts = {
        name: controller.parts[name] for name in ARCHIVE_PARTS if name in controller.parts.keys() - {SIGNATURE_PART}
    }
    atomic_write(file, pack_parts({**parts, SIGNATURE_PART: signature_of(parts, key)}))


def load_controller(path: Path | str) -> Driver:
    """Return the driver of a `.unjam` file, or of the run folder that holds one.

    Raises:
        InputError: there is none, or it is damaged, or it is not a controller, or a file by itself wants
            to run Python code.
    """
    return read_controller(path).driver


def read_controller(path: Path | str) -> Controller:
    """Return what a `.unjam` file holds, checked; raise `InputError` as `load_controller`.

    Python code that it names runs only where the file lies in a run folder, and the code is trusted.
    """
    path, file = Path(path), controller_file(path)
    if not os.path.isfile(file):
        raise InputError(f"controller: {str(file)!r} does not exist")
    try:
        parts = unpack_parts(file)
        manifest = read_manifest(file.name, parts[MANIFEST_PART])
        _check_hashes(file.name, manifest["sha256"], parts)
        signed_by = _check_signature(file, parts) if SIGNATURE_PART in parts else None
        _check_code(file.name, manifest["driver"], path.is_dir())
        arrays = load(parts[WEIGHTS_PART])
        driver = driver_from_recipe(manifest["driver"], arrays)
        unknown = arrays.keys() - driver_recipe(driver)[1].keys()
        if unknown:
            raise InputError(f"controller {file.name}: weights {min(unknown)!r} belong to no network")
        return Controller(driver, manifest, parts, signed_by)
    except UNREADABLE_ERRORS as error:
        raise InputError(f"controller {file.name}: not a controller: {error}") from None


def controller_file(path: Path | str) -> Path:
    """Return the file of a controller: that of a run folder, or the path itself."""
    path = Path(path)
    return path / f"controller{SUFFIX}" if path.is_dir() else path


def sha256_of(part: bytes) -> str:
    """Return the SHA-256 of a part, as the manifest names it."""
    return hashlib.sha256(part).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of a file, of which never more than a block is in memory."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_hashes(name: str, hashes: dict[str, str], parts: dict[str, bytes]) -> None:
    """Raise `InputError` unless the manifest names the hash of every other part, and of nothing else.

    The signature, which is over the manifest, has none there.
    """
    if hashes.keys() != parts.keys() - {MANIFEST_PART, SIGNATURE_PART}:
        raise InputError(f"controller {name}: damaged: its parts are not those that it names")
    for part, content in parts.items():
        if part in hashes and sha256_of(content) != hashes[part]:
            raise InputError(f"controller {name}: damaged: {part} does not have the hash that it names")


def _check_signature(file: Path, parts: dict[str, bytes]) -> str:
    """Return the fingerprint of the key that signed `parts`; raise `InputError` where that does not fit."""
    from unjam.controller.signature import forged_error, signer_of  # which takes its time, and few need

    ordered = {name: parts[name] for name in ARCHIVE_PARTS if name in parts}
    signed = {name: part for name, part in ordered.items() if name != SIGNATURE_PART}
    fingerprint = signer_of(file.name, signed, parts[SIGNATURE_PART])
    if file.read_bytes() != pack_parts(ordered):  # an archive has room for more than its parts
        raise forged_error(file.name)
    return fingerprint


def _check_code(name: str, recipe: Any, is_in_folder: bool) -> None:
    """Raise `InputError` where a driver is Python code that a stranger may have named, or has changed."""
    for found in user_code_recipes(recipe):
        code = Path(found["path"]).resolve()
        if not is_in_folder:
            alone = "a file by itself may not run; use the run folder"
            raise InputError(f"controller {name}: part of it is Python code ({code.name}), which {alone}")
        if code.is_file() and read_code(code).sha256 != found["sha256"]:
            once = "allowed: as it was when it was trained, or train anew"
            raise InputError(f"controller {name}: its code {str(code)!r} has changed since; {once}")
        check_trusted(f"controller {name}", code)


def pack_parts(parts: dict[str, bytes]) -> bytes:
    """Return the archive of `parts`; the same parts have the same bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, part in parts.items():
            entry = zipfile.ZipInfo(name)  # of a fixed date
            entry.create_system = ZIP_SYSTEM_UNIX  # on any system
            archive.writestr(entry, part)
    return content.getvalue()


def unpack_parts(file: Path) -> dict[str, bytes]:
    """Return the parts of an archive, in memory: nothing is written.

    Raises:
        InputError: it holds what no controller has: an unknown, second, compressed or too large part, a link.
        zipfile.BadZipFile, OSError, EOFError, RuntimeError: it is not an archive, or damaged.
    """
    size, largest = file.stat().st_size, len(ARCHIVE_PARTS) * MAX_PART_BYTES
    if size > largest:
        raise InputError(f"controller {file.name}: {size} bytes; allowed: at most {largest}")
    parts: dict[str, bytes] = {}
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.filename in parts:
                raise InputError(f"controller {file.name}: has {entry.filename} twice")
            if reason := _entry_error(entry):
                raise InputError(f"controller {file.name}: part {entry.filename!r} {reason}")
            parts[entry.filename] = archive.read(entry)
    for name in (MANIFEST_PART, WEIGHTS_PART):
        if name not in parts:
            raise InputError(f"controller {file.name}: not a controller: it has no {name}")
    return parts


def _entry_error(entry: zipfile.ZipInfo) -> str:
    """Return why an entry is not let in; empty where it is."""
    if entry.filename not in ARCHIVE_PARTS:
        return f"is unknown; allowed: {', '.join(ARCHIVE_PARTS)}"
    if stat.S_ISLNK(entry.external_attr >> 16):
        return "is a link"
    stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
    if not stored or entry.flag_bits & 1:
        return "is compressed or encrypted; allowed: neither"
    largest = MAX_JSON_BYTES.get(entry.filename, MAX_PART_BYTES)
    if entry.file_size > largest:
        return f"has {entry.file_size} bytes; allowed: at most {largest}"
    return ""


def sample_bytes(driver: Driver, states: LocalState, action_limit: float) -> bytes:
    """Return the part of an archive with `states`, arrays of shape (T,), and the answers of `driver`."""
    seen = {name: values for name, values in states._asdict().items() if values is not None}
    arrays = {name: np.array(values, np.float64) for name, values in seen.items()}
    return save({**arrays, ACTION_NAME: replay_states(driver, states, action_limit)})


def read_sample(part: bytes) -> tuple[LocalState, Floats]:
    """Return the states of a sample and the recorded accelerations [m/s2], all of shape (T,).

    Raises:
        InputError: an array is missing, unknown, of another shape or type, or an acceleration is not finite;
            or there are no decisions, or more than `MAX_SAMPLE_STEPS`.
    """
    arrays: dict[str, Any] = load(part)
    needed, known = {*COMMON_FIELDS, ACTION_NAME}, {*LocalState._fields, ACTION_NAME}
    unfit = (needed - arrays.keys()) | (arrays.keys() - known)
    if unfit:
        first = min(unfit)
        raise InputError(f"sample: {first!r} is {'missing' if first in needed else 'unknown'}")
    answers = arrays.pop(ACTION_NAME)
    for name, values in {**arrays, ACTION_NAME: answers}.items():
        shape = (len(values), FIELD_SIZES[name]) if name in FIELD_SIZES else answers.shape
        if values.ndim != len(shape) or values.shape != shape or values.dtype != np.float64:
            raise InputError(f"sample: {name!r} has shape {values.shape} of {values.dtype}; allowed: numbers")
    if not 1 <= len(answers) <= MAX_SAMPLE_STEPS:
        raise invalid_value("sample: decisions", len(answers), f"1 to {MAX_SAMPLE_STEPS}")
    if not np.isfinite(answers).all():
        raise InputError("sample: a recorded acceleration is not finite")
    return LocalState(**arrays), answers


def replay_states(driver: Driver, states: LocalState, action_limit: float) -> Floats:
    """Return what a driver answers when it perceives `states` one after the other, from its first memory.

    States are of one CAV, arrays of shape (T,), as the answers are: within `limit` [m/s2].
    """
    world = RecordedWorld(states.select(np.s_[:, None]), Limits.symmetric(action_limit))
    return drive_world(world, driver).ravel()
