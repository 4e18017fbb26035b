"""Which Python code that a folder names may run: what its user ran before, as it is and where it is."""

import hashlib
import json
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import platformdirs

from unjam.errors import InputError, UnjamError
from unjam.files import make_folder, write_whole
from unjam.user_code import UserCode, read_code

TRUSTED = "UNJAM_TRUSTED"
"""the variable that tells this process and its children what may run beside what is remembered"""
ALL = "all"
FLAG = "--trust-code"
_lock = threading.Lock()
_blocks: list[str | None] = []
"""for each running block of `trusting_code` the variable before the first of them"""
EXPECTED = "UNJAM_EXPECTED_CODE"
"""the variable that tells a child the hashes of code, by path, with which its configuration was checked"""
_expected: dict[str, str] = json.loads(os.environ.get(EXPECTED, "{}"))


@contextmanager
def trusting_code() -> Iterator[None]:
    """Let the Python code that folders of others name run within the block; what runs is remembered.

    `with unjam.trusting_code(): unjam.drive("ring", "runs/downloaded")`

    It holds for all threads of the process, and for the processes that they start, until the last of several
    blocks ends.
    """
    with _lock:
        _blocks.append(_blocks[0] if _blocks else os.environ.get(TRUSTED))
        os.environ[TRUSTED] = ALL
    try:
        yield
    finally:
        with _lock:
            before = _blocks.pop()
            if not _blocks:
                os.environ.pop(TRUSTED)
                os.environ |= {} if before is None else {TRUSTED: before}


def is_all_trusted() -> bool:
    """Return whether code may run that nobody has named."""
    return ALL in _told()


def check_trusted(where: str, code: Path) -> str:
    """Return the hash of code that `where` names; of what is no file nothing.

    Raises:
        InputError: it has not run before as it is, with what it imports from its folder, nor may run unseen.
    """
    if not os.path.isfile(code) or is_all_trusted():
        return ""
    sha256 = read_code(code).sha256
    if not _is_known(_key(code, sha256)):
        why = "which you have not named yourself, or not as it is now"
        raise InputError(f"{where} names Python code ({str(code)!r}), {why}: it runs only with {FLAG}")
    return sha256


def check_values(where: str, values: Any) -> None:
    """Check as `check_trusted` all files that texts within `values` can name, and expect them to stay so."""
    if isinstance(values, str):
        for code in _files_within(values):
            if sha256 := check_trusted(where, code):
                _expected[str(code)] = sha256
    elif isinstance(values, dict | list):
        for value in values.values() if isinstance(values, dict) else values:
            check_values(where, value)


def check_expected(code: UserCode) -> None:
    """Raise `InputError` where code is another than when a configuration that names it was checked."""
    if _expected.get(str(code.path), code.sha256) != code.sha256 and not is_all_trusted():
        allowed = f"allowed: as it was then, or {FLAG}"
        raise InputError(f"{code.path.name}: has changed since the configuration was checked; {allowed}")


def expected_code() -> dict[str, str]:
    """Return the variable that tells a child what code must be."""
    return {EXPECTED: json.dumps(_expected)}


@contextmanager
def expecting_code() -> Iterator[None]:
    """Forget at the end what code was expected to be: a program's user may change it, and name it again."""
    try:
        yield
    finally:
        _expected.clear()


def remember(code: Path, sha256: str = "") -> None:
    """Keep for later, and for children, that this user runs this code; else, for children alone.

    The place belongs to it. Without a hash it is code as it is now.
    """
    try:
        key = _key(code, sha256 or read_code(code).sha256)
    except OSError:  # who loads it will be told
        return
    if _is_known(key):
        return
    try:
        make_folder(_folder())
        write_whole(_folder() / key, os.fsencode(code) + b"\n")
    except (OSError, UnjamError):
        with _lock:
            os.environ[TRUSTED] = " ".join([*_told(), key])


def _files_within(text: str) -> Iterable[Path]:
    """Return all files that a text can name as `path.py:name`, whatever else is in it."""
    if ".py:" not in text:
        return set()
    starts = [0, *(place + 1 for place, letter in enumerate(text) if letter == "+")]
    ends = [place for place, letter in enumerate(text) if letter == ":"]
    found = {text[start:end] for start in starts for end in ends if start < end}
    return {Path(name).resolve() for name in found if os.path.isfile(name)}


def _key(code: Path, sha256: str) -> str:
    """Return the hash of where code is and of what it is."""
    return hashlib.sha256(os.fsencode(code) + b"\0" + sha256.encode()).hexdigest()


def _is_known(key: str) -> bool:
    """Return whether code ran before."""
    return key in _told() or (_folder() / key).is_file()


def _told() -> list[str]:
    return os.environ.get(TRUSTED, "").split()


def _folder() -> Path:
    """Return where is kept what ran: below `$UNJAM_STATE`, or the user's folder for the state of programs."""
    return Path(os.environ.get("UNJAM_STATE") or platformdirs.user_state_dir("unjam"), "trusted")
