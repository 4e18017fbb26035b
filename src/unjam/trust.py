"""Which Python code that a folder names may run: what its user ran before, as it is and where it is."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import platformdirs

from unjam.errors import InputError, UnjamError
from unjam.files import make_folder, write_whole

TRUSTED = "UNJAM_TRUSTED"
"""the variable that tells this process and its children what may run beside what is remembered"""
ALL = "all"
FLAG = "--trust-code"


@contextmanager
def trusting_code() -> Iterator[None]:
    """Let the Python code that folders of others name run within the block; what runs is remembered.

    `with unjam.trusting_code(): unjam.drive("ring", "runs/downloaded")`
    """
    before = os.environ.get(TRUSTED)
    os.environ[TRUSTED] = ALL
    try:
        yield
    finally:
        if before is None:
            del os.environ[TRUSTED]
        else:
            os.environ[TRUSTED] = before


def is_all_trusted() -> bool:
    """Return whether code may run that nobody has named."""
    return ALL in _told()


def check_trusted(where: str, code: Path) -> None:
    """Raise `InputError` where code that `where` names has not run before as it is, nor may run unseen."""
    if os.path.isfile(code) and not is_all_trusted() and not _is_known(_key(code)):
        why = "which you have not named yourself, or not as it is now"
        raise InputError(f"{where} names Python code ({str(code)!r}), {why}: it runs only with {FLAG}")


def check_values(where: str, values: Any) -> None:
    """Raise `InputError` as `check_trusted` for all files that texts within `values` can name."""
    if isinstance(values, str):
        for code in _files_within(values):
            check_trusted(where, code)
    elif isinstance(values, dict | list):
        for value in values.values() if isinstance(values, dict) else values:
            check_values(where, value)


def remember(code: Path, imported: Iterable[Path] = ()) -> None:
    """Keep for later, and for children, that this user runs this code; else, for children alone.

    The place belongs to it: beside the same file elsewhere may lie other modules that it imports. Those that
    it `imported` are kept with it.
    """
    try:
        key, others = _key(code), {_key(each): each for each in imported}
    except OSError:  # who loads it will be told
        return
    if _is_known(key) and (key in _told() or others.keys() <= _kept(key).keys()):
        return
    lines = [os.fsencode(code), *(each.encode() + b" " + os.fsencode(path) for each, path in others.items())]
    try:
        make_folder(_folder())
        write_whole(_folder() / key, b"\n".join(lines) + b"\n")
    except (OSError, UnjamError):
        os.environ[TRUSTED] = " ".join([*_told(), key])


def _files_within(text: str) -> Iterable[Path]:
    """Return all files that a text can name as `path.py:name`, whatever else is in it."""
    if ".py:" not in text:
        return set()
    starts = [0, *(place + 1 for place, letter in enumerate(text) if letter == "+")]
    ends = [place for place, letter in enumerate(text) if letter == ":"]
    found = {text[start:end] for start in starts for end in ends if start < end}
    return {Path(name).resolve() for name in found if os.path.isfile(name)}


def _key(code: Path) -> str:
    """Return the hash of where code is and of what it is."""
    return hashlib.sha256(os.fsencode(code) + b"\0" + code.read_bytes()).hexdigest()


def _is_known(key: str) -> bool:
    """Return whether code ran before, and what it imported then is as it was."""
    if key in _told():
        return True
    try:
        return all(_key(path) == kept for kept, path in _kept(key).items())
    except OSError:
        return False


def _kept(key: str) -> dict[str, Path]:
    """Return what code imported that ran before, by key; raise `OSError` where it never ran."""
    others = (_folder() / key).read_bytes().splitlines()[1:]
    return {line[:64].decode(): Path(os.fsdecode(line[65:])) for line in others}


def _told() -> list[str]:
    return os.environ.get(TRUSTED, "").split()


def _folder() -> Path:
    """Return where is kept what ran: below `$UNJAM_STATE`, or the user's folder for the state of programs."""
    return Path(os.environ.get("UNJAM_STATE") or platformdirs.user_state_dir("unjam"), "trusted")
