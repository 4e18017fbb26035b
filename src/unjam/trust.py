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
from unjam.files import atomic_write, make_folder
from unjam.user_code import UserCode, read_code

TRUSTED_VARIABLE = "UNJAM_TRUSTED"
"""the variable that tells this process and its children what may run beside what is remembered"""
TRUST_ALL = "all"
TRUST_CODE_OPTION = "--trust-code"
_lock = threading.Lock()
_saved_values: list[str | None] = []
"""for each running block of `trusting_code` the variable before the first of them"""
EXPECTED_CODE_VARIABLE = "UNJAM_EXPECTED_CODE"
"""the variable that tells a child the hashes of code, by path, with which its configuration was checked"""
_expected_hashes: dict[str, str] = json.loads(os.environ.get(EXPECTED_CODE_VARIABLE, "{}"))


@contextmanager
def trusting_code() -> Iterator[None]:
    """Let the Python code that folders of others name run within the block; what runs is remembered.

    `with unjam.trusting_code(): unjam.drive("ring", "runs/downloaded")`

    It holds for all threads of the process, and for the processes that they start, until the last of several
    blocks ends.
    """
    with _lock:
        _saved_values.append(_saved_values[0] if _saved_values else os.environ.get(TRUSTED_VARIABLE))
        os.environ[TRUSTED_VARIABLE] = TRUST_ALL
    try:
        yield
    finally:
        with _lock:
            before = _saved_values.pop()
            if not _saved_values:
                os.environ.pop(TRUSTED_VARIABLE)
                os.environ |= {} if before is None else {TRUSTED_VARIABLE: before}


def is_all_code_trusted() -> bool:
    """Return whether code may run that nobody has named."""
    return TRUST_ALL in _trusted_keys()


def check_trusted(context: str, code: Path) -> str:
    """Return the hash of code that `where` names; of what is no file nothing.

    Raises:
        InputError: it has not run before as it is, with what it imports from its folder, nor may run unseen.
    """
    if not os.path.isfile(code) or is_all_code_trusted():
        return ""
    sha256 = read_code(code).sha256
    if not _is_remembered(_trust_key(code, sha256)):
        why = "which you have not named yourself, or not as it is now"
        raise InputError(f"{context} names Python code ({str(code)!r}), {why}: it runs only with {TRUST_CODE_OPTION}")
    return sha256


def check_trusted_values(context: str, values: Any) -> None:
    """Check as `check_trusted` all files that texts within `values` can name, and expect them to stay so."""
    if isinstance(values, str):
        for code in _code_files(values):
            if sha256 := check_trusted(context, code):
                _expected_hashes[str(code)] = sha256
    elif isinstance(values, dict | list):
        for value in values.values() if isinstance(values, dict) else values:
            check_trusted_values(context, value)


def check_code_unchanged(code: UserCode) -> None:
    """Raise `InputError` where code is another than when a configuration that names it was checked."""
    if _expected_hashes.get(str(code.path), code.sha256) != code.sha256 and not is_all_code_trusted():
        allowed = f"allowed: as it was then, or {TRUST_CODE_OPTION}"
        raise InputError(f"{code.path.name}: has changed since the configuration was checked; {allowed}")


def expected_code_environment() -> dict[str, str]:
    """Return the variable that tells a child what code must be."""
    return {EXPECTED_CODE_VARIABLE: json.dumps(_expected_hashes)}


@contextmanager
def expecting_code() -> Iterator[None]:
    """Forget at the end what code was expected to be: a program's user may change it, and name it again."""
    try:
        yield
    finally:
        _expected_hashes.clear()


def remember_trusted(code: Path, sha256: str = "") -> None:
    """Keep for later, and for children, that this user runs this code; else, for children alone.

    The place belongs to it. Without a hash it is code as it is now.
    """
    try:
        key = _trust_key(code, sha256 or read_code(code).sha256)
    except OSError:  # who loads it will be told
        return
    if _is_remembered(key):
        return
    try:
        make_folder(_trust_folder())
        atomic_write(_trust_folder() / key, os.fsencode(code) + b"\n")
    except (OSError, UnjamError):
        with _lock:
            os.environ[TRUSTED_VARIABLE] = " ".join([*_trusted_keys(), key])


def _code_files(text: str) -> Iterable[Path]:
    """Return all files that a text can name as `path.py:name`, whatever else is in it."""
    if ".py:" not in text:
        return set()
    starts = [0, *(place + 1 for place, letter in enumerate(text) if letter == "+")]
    ends = [place for place, letter in enumerate(text) if letter == ":"]
    found = {text[start:end] for start in starts for end in ends if start < end}
    return {Path(name).resolve() for name in found if os.path.isfile(name)}


def _trust_key(code: Path, sha256: str) -> str:
    """Return the hash of where code is and of what it is."""
    return hashlib.sha256(os.fsencode(code) + b"\0" + sha256.encode()).hexdigest()


def _is_remembered(key: str) -> bool:
    """Return whether code ran before."""
    return key in _trusted_keys() or (_trust_folder() / key).is_file()


def _trusted_keys() -> list[str]:
    return os.environ.get(TRUSTED_VARIABLE, "").split()


def _trust_folder() -> Path:
    """Return where is kept what ran: below `$UNJAM_STATE`, or the user's folder for the state of programs."""
    return Path(os.environ.get("UNJAM_STATE") or platformdirs.user_state_dir("unjam"), "trusted")
