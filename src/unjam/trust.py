"""Trust in Python code that a folder names: it runs if its user has run the same code at the same path before."""

import json
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import platformdirs

from unjam.errors import InputError, UnjamError
from unjam.files import atomic_write, changed_file_error, make_folder, sha256_of
from unjam.text import to_one_line
from unjam.user_code import UserCode, read_code

TRUSTED_VARIABLE = "UNJAM_TRUSTED"  # variable with keys of trusted code, in addition to the remembered keys
TRUST_ALL = "all"
TRUST_CODE_OPTION = "--trust-code"
EXPECTED_CODE_VARIABLE = "UNJAM_EXPECTED_CODE"  # variable with files and hashes of code for a child
MAX_NAMED_FILES = 1000  # files that a text can name, for all meanings of its separators
_lock = threading.Lock()
_saved_values: list[str | None] = []
"""value of `TRUSTED_VARIABLE` before the first running block of `trusting_code`, once for each running block"""
_checked_files: dict[str, str]
"""resolved paths by absolute name at the check of a configuration: a link can change later"""
_expected_hashes: dict[str, str]  # hashes of code by resolved path; empty: there was no file
_checked_files, _expected_hashes = json.loads(os.environ.get(EXPECTED_CODE_VARIABLE, "[{}, {}]"))
_sent_hashes: dict[str, str] = {}
"""hashes of code by resolved path, from the request of another process"""


@contextmanager
def trusting_code() -> Iterator[None]:
    """Let untrusted Python code that folders name run within the block, and remember it as trusted.

    `with unjam.trusting_code(): unjam.drive("ring", "runs/downloaded")`

    It applies to all threads of the process and to their child processes, until the last of several blocks ends.
    """
    with _lock:
        _saved_values.append(_saved_values[0] if _saved_values else os.environ.get(TRUSTED_VARIABLE))
        os.environ[TRUSTED_VARIABLE] = TRUST_ALL
    try:
        yield
    finally:
        with _lock:
            saved = _saved_values.pop()
            if not _saved_values:
                os.environ.pop(TRUSTED_VARIABLE)
                os.environ |= {} if saved is None else {TRUSTED_VARIABLE: saved}


def is_all_code_trusted() -> bool:
    """Return whether all code may run, also unknown code."""
    return TRUST_ALL in _trusted_keys()


def check_trusted(context: str, code: UserCode) -> None:
    """Raise `InputError` if code that `context` names, including its imports from its folder, is not trusted."""
    if not is_all_code_trusted() and not _is_remembered(_trust_key(code.path, code.sha256)):
        reason = "which you have not run yourself in this version"
        message = f"{context} names Python code ({str(code.path)!r}), {reason}"
        raise InputError(f"{message}: it runs only with {TRUST_CODE_OPTION}")


def check_trusted_values(context: str, values: Any) -> None:
    """Check all files that texts in `values` can name as `check_trusted` does, and expect the same code from now on."""
    if isinstance(values, str) and not is_all_code_trusted():
        for name, path in _code_files(context, values):
            code = read_code(path) if os.path.isfile(path) else None
            if code is not None:
                check_trusted(context, code)
            _checked_files[name], _expected_hashes[str(path)] = str(path), code.sha256 if code else ""
    elif isinstance(values, dict | list):
        for value in values.values() if isinstance(values, dict) else values:
            check_trusted_values(context, value)


def resolve_code_path(name: str) -> Path:
    """Return the path of a file without links; for a file that a configuration names, the path that was checked."""
    return Path(_checked_files.get(os.path.join(os.getcwd(), name)) or os.path.realpath(name))


def check_code_unchanged(code: UserCode) -> None:
    """Raise `InputError` if code has changed since the check of a configuration that names it, or since a request."""
    if _sent_hashes.get(str(code.path), code.sha256) != code.sha256:
        raise changed_file_error(code.path.name)
    if _expected_hashes.get(str(code.path), code.sha256) != code.sha256 and not is_all_code_trusted():
        allowed = f"allowed: the code as checked, or {TRUST_CODE_OPTION}"
        raise InputError(f"{code.path.name}: has changed since the configuration was checked; {allowed}")


def expect_code(hashes: Mapping[str, str]) -> None:
    """Refuse code with other hashes than these, by resolved path, from now on in this process."""
    _sent_hashes.update(hashes)


def expected_code_environment() -> dict[str, str]:
    """Return the environment variable with the files and hashes of code that a child expects."""
    return {EXPECTED_CODE_VARIABLE: json.dumps([_checked_files, _expected_hashes])}


@contextmanager
def forget_expected_code() -> Iterator[None]:
    """Forget the expected code at the end of the block, so that the user can change it and name it again."""
    try:
        yield
    finally:
        _checked_files.clear()
        _expected_hashes.clear()


def remember_trusted(code: Path, sha256: str = "") -> None:
    """Remember code at this path, with `sha256` or its current hash, as trusted, at least for child processes."""
    try:
        key = _trust_key(code, sha256 or read_code(code).sha256)
    except OSError:  # loading the code will report the error
        return
    if _is_remembered(key):
        return
    try:
        make_folder(_trust_folder())
        atomic_write(_trust_folder() / key, os.fsencode(code) + b"\n")
    except (OSError, UnjamError):
        with _lock:
            os.environ[TRUSTED_VARIABLE] = " ".join([*_trusted_keys(), key])


def _code_files(context: str, text: str) -> Iterator[tuple[str, Path]]:
    """Yield the absolute name and the path without links of each file that a text can name as `path.py:name`."""
    if ".py:" not in text or "\0" in text:
        return
    starts = [0, *(index + 1 for index, letter in enumerate(text) if letter == "+")]
    ends = [index for index, letter in enumerate(text) if letter == ":"]
    if len(starts) * len(ends) > MAX_NAMED_FILES:
        raise InputError(f"{context}: {to_one_line(text, 60)!r} has too many parts; allowed: fewer + and :")
    for name in dict.fromkeys(text[start:end] for start in starts for end in ends if start < end):
        yield os.path.join(os.getcwd(), name), Path(os.path.realpath(name))


def _trust_key(code: Path, sha256: str) -> str:
    return sha256_of(os.fsencode(code) + b"\0" + sha256.encode())


def _is_remembered(key: str) -> bool:
    return key in _trusted_keys() or (_trust_folder() / key).is_file()


def _trusted_keys() -> list[str]:
    return os.environ.get(TRUSTED_VARIABLE, "").split()


def _trust_folder() -> Path:
    return Path(os.environ.get("UNJAM_STATE") or platformdirs.user_state_dir("unjam"), "trusted")
