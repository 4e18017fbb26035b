"""Write files completely or not at all, and never through a link out of a folder.

All of unjam writes, renames and removes files with these functions. They raise `InputError` for a link, or for a path
through a link inside a protected folder (`unjam.folders`), and `DiskError` if the disk is full or cannot be written.
"""

import errno
import hashlib
import json
import math
import os
import secrets
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from unjam.errors import DISK_ERRNOS, DiskError, InputError, disk_error
from unjam.folders import link_error, open_folder, protected_root

MAX_INTEGER_LENGTH = 20  # characters of an integer of 64 bits
PACKAGED_PREFIX = "unjam:"  # beginning of the names of controllers and populations that are part of the package
INVALID_DATA_ERRORS = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError),
    SafetensorError,
)  # raised by reading JSON and arrays that unjam did not write
UNREADABLE_ERRORS = (*INVALID_DATA_ERRORS, zipfile.BadZipFile, zlib.error, EOFError, MemoryError, RuntimeError)
"""raised by reading a damaged file; zipfile raises `RuntimeError` for an unknown compression"""
APPEND_FLAGS = os.O_WRONLY | os.O_APPEND | os.O_CREAT  # create a missing file, too


@contextmanager
def reject_damaged(name: str) -> Iterator[None]:
    """Raise `InputError` if the block reads data that are damaged or that unjam did not write."""
    try:
        yield
    except UNREADABLE_ERRORS as error:
        raise InputError(f"{name}: the controller is damaged: {' '.join(f'{error!r}'.split())}") from None


@contextmanager
def _disk_errors(path: Path, *extra_errnos: int) -> Iterator[None]:
    """Raise `DiskError` instead of an `OSError` of the disk, or of one with these error numbers."""
    try:
        yield
    except OSError as error:
        if error.errno in (*DISK_ERRNOS, *extra_errnos):
            raise disk_error(error, path) from None
        raise


def atomic_write(path: Path, content: bytes | str) -> None:
    """Write a complete file, or keep the previous one: write and sync a temporary file, then rename it.

    The file has the permissions of the previous one.
    """
    name, temporary = path.name or ".", f".{secrets.token_hex(8)}.part"  # impossible to guess; see `is_leftover`
    with _disk_errors(path), open_folder(path.parent) as folder:
        folder.check_writable(name)
        try:
            descriptor = folder.create(temporary)
            if permissions := folder.mode(name) & 0o777:
                with suppress(OSError):  # a file system without permissions
                    os.fchmod(descriptor, permissions)
            _write_and_sync(descriptor, content)
            folder.rename(temporary, name)
        except OSError:
            with suppress(OSError):
                folder.remove(temporary)
            raise


def write_new_file(path: Path, content: bytes, mode: int) -> None:
    """Write a complete new file, created with this `mode`, or none; raise `InputError` if it exists."""
    try:
        with _disk_errors(path), open_folder(path.parent) as folder:
            descriptor = folder.create(path.name, mode)
            try:
                _write_and_sync(descriptor, content)
                folder.sync()
            except BaseException:
                folder.remove(path.name)
                raise
    except FileExistsError:
        raise InputError(f"file: {str(path)!r} exists; allowed: a new one") from None


def is_leftover(path: Path) -> bool:
    """Return whether a file is an unfinished one of a killed process."""
    return path.name.startswith(".") and path.name.endswith(".part")


def _write_and_sync(descriptor: int, content: bytes | str) -> None:
    """Write an open file, sync it to the disk, and close it."""
    with open(descriptor, "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


def open_in_place(path: Path, flags: int, mode: int = 0o666) -> int:
    """Open a regular file with flags of `os.open`; raise `InputError` for writing a file with several hard links."""
    with open_folder(path.parent) as folder:
        folder.check_writable(path.name)
        descriptor = folder.open(path.name, flags, mode)
    link_count = os.fstat(descriptor).st_nlink
    if link_count > 1 and flags & (os.O_WRONLY | os.O_RDWR):
        os.close(descriptor)
        reason = f"has {link_count} names (hard links), and writing it would change the others"
        raise InputError(f"file: {str(path)!r} {reason}; allowed: a file with one name, such as a copy")
    return descriptor


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, and sync it to the disk."""
    with _disk_errors(path):
        _write_and_sync(open_in_place(path, APPEND_FLAGS), f"{line}\n")


def remove(path: Path) -> None:
    """Remove a file, a link itself, or a folder with its content, if it exists."""
    with _disk_errors(path), suppress(FileNotFoundError), open_folder(path.parent) as folder:
        folder.remove(path.name)


def remove_leftovers(folder: Path, min_age: float = -math.inf) -> None:
    """Remove unfinished files of killed processes from a folder if possible, and if older than `min_age` [s]."""
    for leftover in filter(is_leftover, [*folder.glob(".*")]):
        with suppress(FileNotFoundError, DiskError):  # another process has just removed it
            if time.time() - leftover.lstat().st_mtime > min_age:
                remove(leftover)


def remove_if_empty(folder: Path) -> None:
    """Remove a folder if it is empty."""
    with suppress(OSError, InputError), open_folder(folder.parent) as parent:
        os.rmdir(parent.entry_path(folder.name), dir_fd=parent.handle)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects in a file of JSON lines, without damaged lines and lines that a crash has cut short."""
    rows = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        with suppress(ValueError, RecursionError):
            if isinstance(row := json.loads(line), dict):
                rows.append(row)
    return rows


def check_parent_folder(path: Path) -> None:
    """Raise `DiskError` unless the folder of `path` exists."""
    if not path.absolute().parent.is_dir():
        raise DiskError(f"cannot write {path}: no such folder")


def make_folder(path: Path) -> None:
    """Make a folder and its parents, unless it exists."""
    absolute = path.absolute()
    with _disk_errors(path, errno.EEXIST):
        try:
            if protected_root(absolute) == absolute:
                path.mkdir(parents=True, exist_ok=True)
            else:
                with open_folder(absolute, create=True):
                    pass
        except OSError:
            if path.is_symlink():
                raise link_error(path) from None
            raise


def claim_folder(folder: Path) -> bool:
    """Make a folder and its parents for this process alone; return False if the folder exists."""
    make_folder(folder.parent)
    try:
        folder.mkdir()
    except OSError as error:  # the function that writes into the folder reports other reasons
        return not isinstance(error, FileExistsError)
    return True


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file that unjam wrote; raise `InputError` if it is damaged."""
    try:
        content = parse_json(path.read_bytes())
        if isinstance(content, dict):
            return content
        reason = "it contains no JSON object"
    except (ValueError, RecursionError) as error:
        reason = str(error)
    raise InputError(f"{path}: the file is damaged: {reason}; allowed: the file as unjam wrote it")


def parse_json(content: bytes | str) -> Any:
    """Return the document in strict JSON.

    Raise `ValueError` if it is not JSON in UTF-8, is nested too deep, names a key twice, or has a number that is not
    finite, or an integer of more than 64 bits.
    """
    text = content.decode() if isinstance(content, bytes) else content
    try:
        return json.loads(
            text,
            object_pairs_hook=_table_with_unique_keys,
            parse_float=_parse_finite_number,
            parse_int=_parse_64_bit_integer,
            parse_constant=_parse_finite_number,
        )
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def _table_with_unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        ((key, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"it names {key[:50]!r} twice")
    return table


def _parse_finite_number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"the number {text[:20]} is not finite")
    return value


def _parse_64_bit_integer(text: str) -> int:
    if len(text) > MAX_INTEGER_LENGTH or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"the integer {text[:20]}... has more than 64 bits")
    return value


def sha256_of(content: bytes) -> str:
    """Return the SHA-256 of some bytes in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits, without reading the complete file into memory."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class FileWatch:
    """Detects files that change, appear or disappear, so that no result mixes two versions of them."""

    def __init__(self, list_files: Callable[[], Iterable[Path]]) -> None:
        self._list_files = list_files
        self._versions = {path: (_file_stamp(path), sha256_of_file(path)) for path in list_files()}

    def check(self) -> None:
        """Raise `InputError` if a file has changed, appeared or disappeared since the watch began."""
        changed = [path for path, version in self._versions.items() if not _is_unchanged(path, *version)]
        if changed := changed or sorted(self._versions.keys() ^ set(self._list_files())):
            raise changed_file_error(changed[0].name)


def changed_file_error(name: str) -> InputError:
    """Return the error for a file that has changed while a command ran."""
    return InputError(f"{name}: has changed since the start; allowed: files that do not change meanwhile")


def _is_unchanged(path: Path, stamp: tuple[int, ...], sha256: str) -> bool:
    with suppress(OSError):
        return _file_stamp(path) == stamp or sha256_of_file(path) == sha256
    return False


def _file_stamp(path: Path) -> tuple[int, ...]:
    status = path.stat()
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size


def to_json(value: Any, indent: int | None = None) -> str:
    """Return `value` as strict JSON: NaN and infinities become null, and arrays become lists."""
    return json.dumps(_replace_nonfinite(value), indent=indent, allow_nan=False)


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nonfinite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replace_nonfinite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    to_list = getattr(value, "tolist", None)  # arrays of NumPy and torch
    if to_list is None:
        return value
    listed = to_list()
    return _replace_nonfinite(float(value) if type(listed) is type(value) else listed)  # `tolist` keeps long doubles
