"""Write, read and check `.unjam` files: archive, manifest and recorded sample."""

import io
import os
import stat
import zipfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load, save

from unjam import __version__
from unjam.controller.manifest import ACTION_NAME, MANIFEST_FORMAT, driver_interface, read_manifest
from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import COMMON_FIELDS, FIELD_SIZES, LocalState
from unjam.drivers.registry import driver_from_recipe, driver_recipe, user_code_recipes
from unjam.drivers.user_driver import FileReference
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.files import PACKAGED_PREFIX, UNREADABLE_ERRORS, atomic_write, sha256_of, to_json
from unjam.physics.arrays import Floats
from unjam.trust import check_trusted, resolve_code_path
from unjam.worlds.drive import drive_world
from unjam.worlds.world import RecordedWorld

if TYPE_CHECKING:
    from unjam.controller.signature import Ed25519PrivateKey

SUFFIX = ".unjam"
PACKAGED_FOLDER = Path(str(files("unjam") / "controllers"))
MANIFEST_PART, WEIGHTS_PART = "manifest.json", "weights.safetensors"
SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART = "sample.safetensors", "controller.onnx", "certificate.json"
SIGNATURE_PART = "signature.json"
ARCHIVE_PARTS = (MANIFEST_PART, WEIGHTS_PART, SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART, SIGNATURE_PART)
"""all parts of an archive, in the order of signed archives. Exported controllers have a sample and may have a graph,
certified controllers have a certificate, and signed controllers a signature"""
MAX_PART_BYTES, MAX_JSON_BYTES = 64 * 2**20, {MANIFEST_PART: 2**20, CERTIFICATE_PART: 2**20, SIGNATURE_PART: 10_000}
"""largest size of a part, and of the parts in JSON, which need many times their size in memory"""
LOCAL_HEADER_BYTES, INDEX_ENTRY_BYTES, ARCHIVE_END_BYTES = 30, 46, 22  # sizes in a zip archive without extra fields
MAX_SAMPLE_STEPS = 1000  # largest number of control steps in a sample


@dataclass(frozen=True)
class Controller:
    """The content of a `.unjam` file."""

    driver: Driver
    manifest: dict[str, Any]
    parts: dict[str, bytes]  # parts of the archive by name
    signed_by: str | None = None  # fingerprint of the key of the signature; None without a signature


def controller_bytes(driver: Driver, metadata: dict[str, Any], parts: dict[str, bytes] | None = None) -> bytes:
    """Return the content of a `.unjam` file; `metadata` are `PROVENANCE_ENTRIES`, `parts` optional further parts."""
    recipe, arrays = driver_recipe(driver)
    manifest = {"format": MANIFEST_FORMAT, "unjam": __version__, "driver": recipe}
    manifest |= driver_interface(driver, metadata.get("action_limit")) | metadata
    return _pack_with_hashes(manifest, {WEIGHTS_PART: save(arrays), **(parts or {})})


def _pack_with_hashes(manifest: dict[str, Any], parts: dict[str, bytes]) -> bytes:
    manifest = {**manifest, "sha256": {name: sha256_of(part) for name, part in parts.items()}}
    return pack_parts({MANIFEST_PART: to_json(manifest, indent=1).encode(), **parts})


def trained_bytes(controller: Controller) -> bytes:
    """Return the content of a controller's file after training: only its manifest and weights."""
    return _pack_with_hashes(controller.manifest, {WEIGHTS_PART: controller.parts[WEIGHTS_PART]})


def add_certificate(file: Path, controller: Controller, certificate: dict[str, Any]) -> None:
    """Add a certificate to the file of a controller; raise `InputError` if the file is signed, or has changed."""
    check_unsigned(controller)
    _check_unchanged(file, controller)
    parts = {**controller.parts, CERTIFICATE_PART: to_json(certificate, indent=1).encode()}
    del parts[MANIFEST_PART]
    atomic_write(file, _pack_with_hashes(controller.manifest, parts))


def check_unsigned(controller: Controller) -> None:
    """Raise `InputError` if a controller is signed, so that it must not change."""
    if controller.signed_by is not None:
        reason = f"controller: a file that is signed (by {controller.signed_by}) is not allowed"
        raise InputError(f"{reason}; allowed: one that is not: certify it first, then sign it")


def add_signature(file: Path, controller: Controller, key: "Ed25519PrivateKey") -> None:
    """Sign the file of a controller in place of an earlier signature; raise `InputError` if the file has changed."""
    from unjam.controller.signature import signature_of

    _check_unchanged(file, controller)
    parts = _ordered_parts({name: part for name, part in controller.parts.items() if name != SIGNATURE_PART})
    atomic_write(file, pack_parts({**parts, SIGNATURE_PART: signature_of(parts, key)}))


def _check_unchanged(file: Path, controller: Controller) -> None:
    """Raise `InputError` if another process has replaced or signed the file of a controller since it was read."""
    if unpack_parts(file) != controller.parts:
        raise InputError(f"controller: {str(file)!r} has changed meanwhile, and is not replaced; repeat the command")


def _ordered_parts(parts: dict[str, bytes]) -> dict[str, bytes]:
    return {name: parts[name] for name in ARCHIVE_PARTS if name in parts}


def load_controller(path: Path | str) -> Driver:
    """Return the driver of a `.unjam` file, a run folder or a packaged controller; `InputError` if it is not valid."""
    return read_controller(path).driver


def read_controller(path: Path | str) -> Controller:
    """Return the checked content of a `.unjam` file, a run folder, or a packaged controller.

    Raise `InputError` if the file does not exist, is damaged or not a controller, or refers to Python code that is not
    trusted. Only controllers in run folders may refer to Python code.
    """
    path, file = Path(path), controller_file(path)
    if not os.path.isfile(file):
        raise InputError(f"controller: {str(file)!r} does not exist")
    try:
        parts = unpack_parts(file)
        manifest = read_manifest(file.name, parts[MANIFEST_PART])
        if manifest["sha256"].keys() != parts.keys() - {MANIFEST_PART, SIGNATURE_PART}:
            raise InputError(f"controller {file.name}: damaged: its parts are not those that it names")
        for part, expected in manifest["sha256"].items():
            if sha256_of(parts[part]) != expected:
                raise InputError(f"controller {file.name}: damaged: {part} does not have the hash that it names")
        signed_by = _check_signature(file, parts) if SIGNATURE_PART in parts else None
        _check_code(file.name, manifest["driver"], path.is_dir())
        arrays = load(parts[WEIGHTS_PART])
        driver = driver_from_recipe(manifest["driver"], arrays)
        if unused_weights := arrays.keys() - driver_recipe(driver)[1].keys():
            raise InputError(f"controller {file.name}: weights {min(unused_weights)!r} belong to no network")
        return Controller(driver, manifest, parts, signed_by)
    except UNREADABLE_ERRORS as error:
        hint = "" if file.suffix == SUFFIX else "; allowed: a .unjam file, which unjam export writes"
        raise InputError(f"controller {file.name}: not a controller: {error}{hint}") from None


def controller_file(path: Path | str) -> Path:
    """Return the file for `unjam:NAME`, a packaged controller, or for a run folder; otherwise the path itself."""
    if str(path).startswith(PACKAGED_PREFIX):
        return packaged_file(str(path).removeprefix(PACKAGED_PREFIX))
    return Path(path, f"controller{SUFFIX}") if os.path.isdir(path) else Path(path)


def packaged_names() -> list[str]:
    """Return the names of the packaged controllers, such as `ring-best`."""
    return sorted(path.stem for path in PACKAGED_FOLDER.glob(f"*{SUFFIX}"))


def packaged_file(name: str) -> Path:
    """Return the file of a packaged controller; raise `InputError` for another name."""
    if name not in packaged_names():
        raise unknown_name("driver", f"{PACKAGED_PREFIX}{name}", map(f"{PACKAGED_PREFIX}{{}}".format, packaged_names()))
    return PACKAGED_FOLDER / f"{name}{SUFFIX}"


def _check_signature(file: Path, parts: dict[str, bytes]) -> str:
    """Return the fingerprint of the key that signed `parts`; raise `InputError` if the signature does not fit."""
    from unjam.controller.signature import forged_error, signer_of  # slow to import, and rarely needed

    ordered_parts = _ordered_parts(parts)
    signed_parts = {name: part for name, part in ordered_parts.items() if name != SIGNATURE_PART}
    fingerprint = signer_of(file.name, signed_parts, parts[SIGNATURE_PART])
    if file.read_bytes() != pack_parts(ordered_parts):  # the archive may contain other bytes
        raise forged_error(file.name)
    return fingerprint


def _check_code(name: str, recipe: Any, is_in_folder: bool) -> None:
    """Raise `InputError` if a driver contains Python code outside of a run folder, changed code, or untrusted code."""
    for reference in user_code_recipes(recipe):
        path = resolve_code_path(reference["path"])
        if not is_in_folder:
            reason = "which a file by itself may not run; use the run folder"
            raise InputError(f"controller {name}: part of it is Python code ({path.name}), {reason}")
        code = FileReference(path, reference["name"]).read_code()
        if code.sha256 != reference["sha256"]:
            allowed = "allowed: as it was when it was trained, or train again"
            raise InputError(f"controller {name}: its code {str(path)!r} has changed since; {allowed}")
        check_trusted(f"controller {name}", code)


def pack_parts(parts: dict[str, bytes]) -> bytes:
    """Return the archive of `parts`; equal parts give equal bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, part in parts.items():
            entry = zipfile.ZipInfo(name)  # with a fixed date
            entry.create_system = 3  # Unix, on any system
            archive.writestr(entry, part)
    return content.getvalue()


def unpack_parts(file: Path) -> dict[str, bytes]:
    """Return the parts of an archive by name; raise `InputError` for a part that is not allowed, or further bytes.

    Raise `zipfile.BadZipFile`, `OSError`, `EOFError` or `RuntimeError` if the file is not an archive, or is damaged.
    """
    size, max_size = file.stat().st_size, len(ARCHIVE_PARTS) * MAX_PART_BYTES
    if size > max_size:
        raise InputError(f"controller {file.name}: {size} bytes; allowed: at most {max_size}")
    parts: dict[str, bytes] = {}
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.filename in parts:
                raise InputError(f"controller {file.name}: has {entry.filename} twice")
            if reason := _entry_error(entry):
                raise InputError(f"controller {file.name}: part {entry.filename!r} {reason}")
            parts[entry.filename] = archive.read(entry)
        # Hashes and signature do not protect bytes outside of the parts. Headers of a part, in front of it and in the
        # index, contain its name.
        header_size = LOCAL_HEADER_BYTES + INDEX_ENTRY_BYTES
        sizes = (header_size + 2 * len(entry.filename.encode()) + entry.compress_size for entry in archive.infolist())
        if size != ARCHIVE_END_BYTES + sum(sizes):
            raise InputError(f"controller {file.name}: has bytes outside its parts; allowed: none, as unjam writes it")
    for name in (MANIFEST_PART, WEIGHTS_PART):
        if name not in parts:
            raise InputError(f"controller {file.name}: not a controller: it has no {name}")
    return parts


def _entry_error(entry: zipfile.ZipInfo) -> str:
    """Return why an entry is not allowed; empty if it is allowed."""
    if entry.filename not in ARCHIVE_PARTS:
        return f"is unknown; allowed: {', '.join(ARCHIVE_PARTS)}"
    if stat.S_ISLNK(entry.external_attr >> 16):
        return "is a link"
    is_stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
    if not is_stored or entry.flag_bits & 1:
        return "is compressed or encrypted; allowed: neither"
    max_size = MAX_JSON_BYTES.get(entry.filename, MAX_PART_BYTES)
    return f"has {entry.file_size} bytes; allowed: at most {max_size}" if entry.file_size > max_size else ""


def sample_bytes(driver: Driver, states: LocalState, action_limit: float) -> bytes:
    """Return the sample part of an archive: `states`, arrays of shape (T,), and the accelerations of `driver`."""
    arrays = {name: np.array(values, np.float64) for name, values in states._asdict().items() if values is not None}
    return save({**arrays, ACTION_NAME: replay_states(driver, states, action_limit)})


def read_sample(part: bytes) -> tuple[LocalState, Floats]:
    """Return the states of a sample and its accelerations [m/s2], shape (T,); `InputError` for a wrong array."""
    arrays: dict[str, Any] = load(part)
    required_names, known_names = {*COMMON_FIELDS, ACTION_NAME}, {*LocalState._fields, ACTION_NAME}
    if wrong_names := (required_names - arrays.keys()) | (arrays.keys() - known_names):
        name = min(wrong_names)
        raise InputError(f"sample: {name!r} is {'missing' if name in required_names else 'unknown'}")
    accelerations = arrays.pop(ACTION_NAME)
    for name, array in {**arrays, ACTION_NAME: accelerations}.items():
        shape = (len(array), FIELD_SIZES[name]) if name in FIELD_SIZES else accelerations.shape
        if array.ndim != len(shape) or array.shape != shape or array.dtype != np.float64:
            raise InputError(f"sample: {name!r} has shape {array.shape} of {array.dtype}; allowed: numbers")
    if not 1 <= len(accelerations) <= MAX_SAMPLE_STEPS:
        raise invalid_value("sample: control steps", len(accelerations), f"1 to {MAX_SAMPLE_STEPS}")
    if not np.isfinite(accelerations).all():
        raise InputError("sample: a recorded acceleration is not finite")
    return LocalState(**arrays), accelerations


def replay_states(driver: Driver, states: LocalState, action_limit: float) -> Floats:
    """Return a driver's accelerations within a limit [m/s2] for consecutive states of one CAV, shape (T,)."""
    world = RecordedWorld(states.select(np.s_[:, None]), Limits.symmetric(action_limit))
    return drive_world(world, driver).ravel()
