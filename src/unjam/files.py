"""Writing files so that nothing is lost or half-written, and nothing outside is written through a link.

All of unjam writes, renames and removes through these functions; `tests/test_layers.py` checks it.
"""

import errno
import json
import math
import os
import secrets
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from unjam.errors import DISK_ERRNOS, DiskError, InputError, disk_error
from unjam.folders import link_error, open_folder, protected_root

MAX_INTEGER_LENGTH = 20
"""characters of an integer of 64 bits"""
PACKAGED_PREFIX = "unjam:"
"""what the names of controllers and of people that are part of the package begin with"""
INVALID_DATA_ERRORS = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError),
    SafetensorError,
)
"""what reading JSON and arrays can raise where they are not what unjam writes"""
UNREADABLE_ERRORS = (*INVALID_DATA_ERRORS, zipfile.BadZipFile, zlib.error, EOFError, MemoryError, RuntimeError)
"""what reading can raise where a file is none; `RuntimeError`: of a kind that zipfile does not know"""

APPEND_FLAGS = os.O_WRONLY | os.O_APPEND | os.O_CREAT
"""flags of `open_in_place`: append to a file, and make a missing one"""


@contextmanager
def reject_damaged(name: str) -> Iterator[None]:
    """Raise `InputError` where something that is read within is none of ours, or damaged."""
    try:
        yield
    except UNREADABLE_ERRORS as error:
        raise InputError(f"{name}: the controller is damaged: {' '.join(f'{error!r}'.split())}") from None


def atomic_write(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all: to a random temporary name, to the disk, then in place.

    Raises:
        InputError: it is a link, or inside a held folder it is reached through one.
        DiskError: the disk is full or cannot be written; what was there before is still there.
    """
    name, temporary = path.name or ".", _temporary_name()
    try:
        with open_folder(path.parent) as folder:
            folder.check_writable(name)
            try:
                _write_and_sync(folder.create(temporary), content)
                folder.rename(temporary, name)
            except OSError:
                with suppress(OSError):
                    folder.remove(temporary)
                raise
    except OSError as error:
        raise _as_disk_error(error, path) from None


def write_new_file(path: Path, content: bytes, mode: int) -> None:
    """Write a file that is not there yet, whole or not at all; from the first byte on it has this `mode`.

    Raises:
        InputError: there is one.
        DiskError: the disk is full or cannot be written.
    """
    try:
        with open_folder(path.parent) as folder:
            descriptor = folder.create(path.name, mode)
            try:
                _write_and_sync(descriptor, content)
                folder.sync()
            except BaseException:
                folder.remove(path.name)
                raise
    except FileExistsError:
        raise InputError(f"file: {str(path)!r} exists; allowed: a new one") from None
    except OSError as error:
        raise _as_disk_error(error, path) from None


def write_folder(folder: Path, files: dict[str, bytes | str]) -> None:
    """Write a folder of files whole or not at all: it appears by one change of its name, files and all.

    What has its name already is removed before.

    Raises:
        InputError: inside a held folder it is reached through a link.
        DiskError: the disk is full or cannot be written.
    """
    remove(folder)
    make_folder(folder.parent)
    temporary = _temporary_name()
    try:
        with open_folder(folder.parent) as above:
            try:
                above.make_subfolder(temporary)
                with above.enter(temporary) as inner:
                    for name, content in files.items():
                        _write_and_sync(inner.create(name), content)
                    inner.sync()
                above.rename(temporary, folder.name)
            except OSError:
                with suppress(OSError):
                    above.remove(temporary)
                raise
    except OSError as error:
        raise _as_disk_error(error, folder) from None


def _temporary_name() -> str:
    """Return a name that nobody can guess, of what `is_leftover` where its process is killed."""
    return f".{secrets.token_hex(8)}.part"


def is_leftover(path: Path) -> bool:
    """Return whether a file is what a process left behind that was killed while it wrote."""
    return path.name.startswith(".") and path.name.endswith(".part")


def _write_and_sync(descriptor: int, content: bytes | str) -> None:
    """Write an open file, and to the disk, and close it."""
    with open(descriptor, "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


def open_in_place(path: Path, flags: int, mode: int = 0o666) -> int:
    """Open a file as it is, with the flags of `os.open`, and return its descriptor.

    Raises:
        InputError: it is a link, is reached through one inside a held folder, or is to be written and has
            other names (hard links), which may be those of a file elsewhere.
        DiskError: it is something else than a file.
        OSError: it cannot be opened.
    """
    with open_folder(path.parent) as folder:
        folder.check_writable(path.name)
        descriptor = folder.open(path.name, flags, mode)
    names = os.fstat(descriptor).st_nlink
    if names > 1 and flags & (os.O_WRONLY | os.O_RDWR):
        os.close(descriptor)
        why = f"has {names} names (hard links), and writing it would change the others"
        raise InputError(f"file: {str(path)!r} {why}; allowed: a file with one name, such as a copy")
    return descriptor


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, and to the disk.

    Raises:
        InputError: it is a link, or has other names (hard links).
        DiskError: the disk is full or cannot be written.
    """
    try:
        _write_and_sync(open_in_place(path, APPEND_FLAGS), f"{line}\n")
    except OSError as error:
        raise _as_disk_error(error, path) from None


def remove(path: Path) -> None:
    """Remove a file, or a folder with everything in it; of a link the link itself. It may be missing.

    Raises:
        InputError: inside a held folder it is reached through a link.
        DiskError: it cannot be removed.
    """
    try:
        with suppress(FileNotFoundError), open_folder(path.parent) as folder:
            folder.remove(path.name)
    except OSError as error:
        raise _as_disk_error(error, path) from None


def remove_if_empty(folder: Path) -> None:
    """Remove a folder that is empty; any other stays as it is."""
    with suppress(OSError):
        folder.rmdir()


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the tables in a file of JSON lines; what is damaged, or cut short by a crash, is left out."""
    rows = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        with suppress(ValueError, RecursionError):
            if isinstance(row := json.loads(line), dict):
                rows.append(row)
    return rows


def check_parent_folder(path: Path) -> None:
    """Raise `DiskError` unless the folder that `path` would be written to is there."""
    if not path.absolute().parent.is_dir():
        raise DiskError(f"cannot write {path}: no such folder")


def make_folder(path: Path) -> None:
    """Make a folder and those above it.

    Raises:
        InputError: it is a link that leads nowhere, or inside a held folder it is reached through a link.
        DiskError: it cannot be made.
    """
    whole = path.absolute()
    try:
        if protected_root(whole) != whole:
            with open_folder(whole, make=True):
                return
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if path.is_symlink():
            raise link_error(path) from None
        raise _as_disk_error(error, path, errno.EEXIST) from None


def _as_disk_error(error: OSError, path: Path, *extra_errnos: int) -> OSError | DiskError:
    return disk_error(error, path) if error.errno in (*DISK_ERRNOS, *extra_errnos) else error


def parse_json(content: bytes | str) -> Any:
    """Return the document in strict JSON.

    Raises:
        ValueError: it is none in UTF-8, nested too deep, names a key twice, or has a number that is not
            finite, or an integer of more than 64 bits.
    """
    text = content.decode() if isinstance(content, bytes) else content
    try:
        return json.loads(
            text,
            object_pairs_hook=_unique_keys,
            parse_float=_finite_number,
            parse_int=_integer_64_bits,
            parse_constant=_finite_number,
        )
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        ((key, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"it names {key[:50]!r} twice")
    return table


def _finite_number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"the number {text[:20]} is not finite")
    return value


def _integer_64_bits(text: str) -> int:
    if len(text) > MAX_INTEGER_LENGTH or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"the integer {text[:20]}... has more than 64 bits")
    return value


def to_json(value: Any, indent: int | None = None) -> str:
    """Return `value` as strict JSON: NaN and infinities, which JSON does not know, become null."""
    return json.dumps(_replace_nonfinite(value), indent=indent, allow_nan=False)


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nonfinite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replace_nonfinite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
