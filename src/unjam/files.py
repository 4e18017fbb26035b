"""Writing files so that nothing is lost or half-written, whatever happens in between."""

import errno
import json
import math
import os
from pathlib import Path
from typing import Any

from unjam.errors import DISK_ERRNOS, DiskError, disk_error


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all: to a temporary name, to the disk, then in place.

    Raises:
        DiskError: the disk is full or cannot be written; what was there before is still there.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.part")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise _disk(error, path) from None


def append_line(path: Path, line: str) -> None:
    """Append a line to a file; raise `DiskError` where the disk is full."""
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write(line + "\n")
    except OSError as error:
        raise _disk(error, path) from None


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
