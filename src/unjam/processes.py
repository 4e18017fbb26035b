"""Processes that do not outlive the one that wants them, and folders that one process writes at a time."""

import ctypes
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from unjam.errors import InputError

PARENT = "UNJAM_PARENT"
"""the variable that tells a process by whose side it ends"""
LOCK = ".lock"
"""the file that holds a folder for who writes it"""
SIGNAL_OF_PARENTS_DEATH = 1
"""Linux's PR_SET_PDEATHSIG"""


def bound(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process that is to end with this one."""
    return {**environment, PARENT: str(os.getpid())}


def end_with_parent(signum: int) -> None:
    """Let the system send this process a signal when the one that started it is gone; on Linux alone.

    It comes whatever this process is busy with. It is sent only where whoever started it asked for it.
    """
    parent = os.environ.pop(PARENT, "")
    if not parent or sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # a C library without it
        ctypes.CDLL(None).prctl(SIGNAL_OF_PARENTS_DEATH, signum, 0, 0, 0)
    try:
        os.kill(int(parent), 0)
    except ProcessLookupError:  # it was gone before
        os.kill(os.getpid(), signum)


def has_display() -> bool:
    """Return whether a process can open a window here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Hold a folder that is there for this process alone; it is free again when the process ends, however.

    On Windows, and where the file system has no locks, nothing is held.

    Raises:
        InputError: another process holds it.
    """
    path = folder / LOCK
    descriptor = _locked(path)
    while descriptor is not None and not _is_file(path, descriptor):  # its owner removed it just now
        os.close(descriptor)
        descriptor = _locked(path)
    try:
        yield
    finally:
        if descriptor is not None:
            path.unlink(missing_ok=True)
            os.close(descriptor)


def is_owned(folder: Path) -> bool:
    """Return whether a process holds a folder now."""
    if not (folder / LOCK).is_file():
        return False
    try:
        with owned(folder):
            return False
    except InputError:
        return True
    except OSError:  # somebody else's folder, which cannot be held
        return False


def _locked(path: Path) -> int | None:
    """Return an open and locked file; None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        held = f"run: {str(path.parent)!r} is being written by another process"
        raise InputError(f"{held}; allowed: one at a time") from None
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _is_file(path: Path, descriptor: int) -> bool:
    """Return whether an open file still is the one of that name."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
