"""Writing files so that nothing is lost or half-written, whatever happens in between."""

import errno
import json
import math
import os
import shutil
import sys
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from unjam.errors import DISK_ERRNOS, DiskError, InputError, disk_error

LONGEST_INTEGER = 20
"""characters of an integer of 64 bits"""
SHIPPED = "unjam:"
"""what the names of controllers and of people that are part of the package begin with"""
DAMAGED = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError),
    SafetensorError,
)
"""what reading JSON and arrays can raise where they are not what unjam writes"""
NONE_OF_OURS = (*DAMAGED, zipfile.BadZipFile, zlib.error, EOFError, MemoryError, RuntimeError)
"""what reading can raise where a file is none; `RuntimeError`: of a kind that zipfile does not know"""


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Raise `InputError` where something that is read within is none of ours, or damaged."""
    try:
        yield
    except NONE_OF_OURS as error:
        raise InputError(f"{what}: the controller is damaged: {' '.join(f'{error!r}'.split())}") from None


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all: to a temporary name, to the disk, then in place.

    Raises:
        DiskError: the disk is full or cannot be written; what was there before is still there.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.part")
    if path.exists() and not path.is_file():
        raise DiskError(f"cannot write {path}: it is no file")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise _disk(error, path) from None


def write_new(path: Path, content: bytes, mode: int) -> None:
    """Write a file that is not there yet, whole or not at all; from the first byte on it has this `mode`.

    Raises:
        InputError: there is one.
        DiskError: the disk is full or cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError:
        raise InputError(f"file: {str(path)!r} exists; allowed: a new one") from None
    except OSError as error:
        raise _disk(error, path) from None
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        sync_folder(path.parent)
    except BaseException as error:
        path.unlink(missing_ok=True)
        raise (_disk(error, path) if isinstance(error, OSError) else error) from None


def write_folder(folder: Path, files: dict[str, bytes | str]) -> None:
    """Write a folder of files whole or not at all: it appears by one change of its name, files and all.

    What has its name already is removed before.

    Raises:
        DiskError: the disk is full or cannot be written.
    """
    temporary = folder.with_name(f".{folder.name}.part")
    try:
        for old in (temporary, folder):
            if old.exists():
                shutil.rmtree(old)
        temporary.mkdir(parents=True)
        for name, content in files.items():
            write_whole(temporary / name, content)
        os.replace(temporary, folder)
        sync_folder(folder.parent)
    except (OSError, DiskError) as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise (_disk(error, folder) if isinstance(error, OSError) else error) from None


def is_leftover(path: Path) -> bool:
    """Return whether a file is what a process left behind that was killed while it wrote."""
    return path.name.startswith(".") and path.name.endswith(".part")


def sync_folder(folder: Path) -> None:
    """Let the disk keep the names of a folder's files too; on Windows that is the system's business."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, and to the disk; raise `DiskError` where it is full."""
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise _disk(error, path) from None


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the tables in a file of JSON lines; what is damaged, or cut short by a crash, is left out."""
    rows = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        with suppress(ValueError, RecursionError):
            if isinstance(row := json.loads(line), dict):
                rows.append(row)
    return rows


def check_folder(path: Path) -> None:
    """Raise `DiskError` unless the folder that `path` would be written to is there."""
    if not path.absolute().parent.is_dir():
        raise DiskError(f"cannot write {path}: no such folder")


def make_folder(path: Path) -> None:
    """Make a folder and those above it; raise `DiskError` where that is impossible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _disk(error, path, errno.EEXIST) from None


def _disk(error: OSError, path: Path, *more: int) -> OSError | DiskError:
    return disk_error(error, path) if error.errno in (*DISK_ERRNOS, *more) else error


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
            parse_int=_short_integer,
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


def _short_integer(text: str) -> int:
    if len(text) > LONGEST_INTEGER or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"the integer {text[:20]}... has more than 64 bits")
    return value


def to_json(value: Any, indent: int | None = None) -> str:
    """Return `value` as strict JSON: NaN and infinities, which JSON does not know, become null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
