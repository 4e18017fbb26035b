"""Processes that do not outlive the one that wants them, and folders that one process writes at a time."""

import ctypes
import json
import os
import platform
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout, suppress
from functools import cache
from pathlib import Path

from unjam.errors import DiskError, InputError
from unjam.files import open_in_place, remove
from unjam.folders import PROTECTED_FOLDERS_VARIABLE, protect_folder, protected_folders
from unjam.sandbox import confine_process, limit_resources

PARENT_VARIABLE = "UNJAM_PARENT"
"""the variable that tells a process by whose side it ends"""
TRACI_VARIABLES = "LIBSUMO_AS_TRACI", "LIBTRACI_AS_TRACI"
"""variables that make another library of traci, which says so on standard output"""
LOCK_FILE = ".lock"
"""the file that holds a folder for who writes it"""
HEARTBEAT_INTERVAL, MAX_MISSED_HEARTBEATS = 10.0, 6
"""seconds between two signs of life of a folder's owner, and how many it may miss"""
PRIVATE_FOLDER_PREFIX, PRIVATE_LOCK_FILE = "unjam-", ".temporary"
"""what the names of private temporary folders begin with, and the file by which a process holds its own"""
PR_SET_PDEATHSIG = 1
"""Linux's PR_SET_PDEATHSIG"""
MAX_CHILD_MEMORY = 8 * 2**30
"""bytes that reading a file of others may take"""
MAX_CHILD_TIME = 600
"""seconds that it may take"""
_is_command_line = False


def bind_to_parent(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process of unjam that ends with this one, and holds the same folders."""
    kept = {name: value for name, value in environment.items() if name not in TRACI_VARIABLES}
    held = json.dumps([str(folder) for folder in protected_folders()])
    return {**kept, PROTECTED_FOLDERS_VARIABLE: held, PARENT_VARIABLE: str(os.getpid())}


def mark_as_command_line() -> None:
    """Note that this process is the command line's: its standard output is for results alone.

    Only in such a process may unjam change what holds for all threads.
    """
    global _is_command_line
    _is_command_line = True
    for name in TRACI_VARIABLES:
        os.environ.pop(name, None)


def redirect_user_output() -> AbstractContextManager[object]:
    """Return the block for loading code of users: the command line prints what it says to standard error."""
    return redirect_stdout(sys.stderr) if _is_command_line else nullcontext()


def exit_with_parent(signum: int) -> None:
    """Let the system send this process a signal when the one that started it is gone; on Linux alone.

    It comes whatever this process is busy with. It is sent only where whoever started it asked for it.
    """
    parent = os.environ.pop(PARENT_VARIABLE, "")
    if not parent or sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # a C library without it
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signum, 0, 0, 0)
    try:
        os.kill(int(parent), 0)
    except ProcessLookupError:  # it was gone before
        os.kill(os.getpid(), signum)


@contextmanager
def capture_stderr(path: Path) -> Iterator[None]:
    """Let a file have what this process, its libraries included, prints as errors meanwhile."""
    before, descriptor = os.dup(2), open_in_place(path, os.O_WRONLY | os.O_CREAT)
    os.ftruncate(descriptor, 0)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def continue_in_limited_child(description: str, *writable: Path) -> None:
    """Go on in a child that reads `what` of others under limits; this process waits, and ends as that does.

    It may write under `writable` alone, and has no network, where the kernel sees to it. On Windows nothing
    changes.

    Raises:
        SystemExit: in this process, with the child's exit code.
        InputError: in this process: the child took too much memory or time, or crashed.
    """
    if not hasattr(os, "fork"):
        return
    sys.stdout.flush()
    sys.stderr.flush()
    here = str(os.getpid())
    child = os.fork()
    if child == 0:
        os.environ[PARENT_VARIABLE] = here
        exit_with_parent(signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # this process is told too, and ends it
        limit_resources(MAX_CHILD_MEMORY, MAX_CHILD_TIME)
        confine_process(*writable)
        return
    try:
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    except BaseException:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    if code < 0:
        how = f"{MAX_CHILD_MEMORY / 2**30:g} GiB and {MAX_CHILD_TIME:g} s: signal {-code}"
        raise InputError(f"{description}: cannot be read within {how}")
    sys.exit(code)


def kernel_protections() -> list[str]:
    """Return what the kernel does here for a process that reads files of others; tried in a child."""
    if sys.platform != "linux":
        return []
    with tempfile.TemporaryDirectory() as folder:
        child = os.fork()
        if child == 0:
            confine_process()
            refused = [_is_denied(act) for act in (Path(folder, "file").touch, socket.socket)]
            os._exit(sum(2**number for number, each in enumerate(refused) if each))
        found = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    names = ("disk read-only (Landlock)", "no network (seccomp)")
    return [name for number, name in enumerate(names) if found >= 0 and found & 2**number]


def _is_denied(action: Callable[[], object]) -> bool:
    try:
        action()
    except PermissionError:
        return True
    return False


def has_display() -> bool:
    """Return whether a process can open a window here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder that is there for this process alone; it is free again when the process ends, however.

    Where machines share a folder but not its locks, the lock's age tells that an owner elsewhere still lives.
    On Windows there is no lock. Inside the folder no link is followed meanwhile, by child processes neither.

    Raises:
        InputError: another process holds it, or one of its entries is a link.
    """
    with protect_folder(folder), _hold_lock(folder):
        yield


@contextmanager
def _hold_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder."""
    path = folder / LOCK_FILE
    descriptor = _open_locked(path)
    while descriptor is not None and not _is_same_file(path, descriptor):  # its owner removed it just now
        os.close(descriptor)
        descriptor = _open_locked(path)
    if descriptor is None:
        yield
        return
    ended = threading.Event()
    try:
        _check_other_machine(path, descriptor)
        os.pwrite(descriptor, f"{platform.node()} {os.getpid()}\n".ljust(300).encode(), 0)
        beats = threading.Thread(target=_send_heartbeats, args=(descriptor, ended), daemon=True)
        beats.start()
        try:
            yield
        finally:
            ended.set()
            beats.join()
            remove(path)
    finally:
        os.close(descriptor)


def _send_heartbeats(descriptor: int, stop: threading.Event) -> None:
    while not stop.wait(HEARTBEAT_INTERVAL):
        with suppress(OSError):  # a disk that is away for a while
            os.utime(descriptor)


def _check_other_machine(path: Path, descriptor: int) -> None:
    """Raise `InputError` where a process of another machine has held a lock until just now."""
    owner = os.pread(descriptor, 300, 0).decode(errors="replace").split()
    age = time.time() - os.fstat(descriptor).st_mtime
    if owner and owner[0] != platform.node() and abs(age) < MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL:
        held = f"run: {str(path.parent)!r} is being written on {owner[0]}"
        raise InputError(
            f"{held}; allowed: one at a time, or {MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL:g} s after its end"
        )


class PrivateFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder that a later process removes where this one was killed."""

    def __init__(self) -> None:
        """Make it, and hold it."""
        super().__init__(prefix=PRIVATE_FOLDER_PREFIX)
        self._lock_descriptor = _open_locked(Path(self.name, PRIVATE_LOCK_FILE))
        if self._lock_descriptor is not None:
            os.write(self._lock_descriptor, _folder_identity(Path(self.name)))

    def cleanup(self) -> None:
        """Remove it."""
        super().cleanup()
        if self._lock_descriptor is not None:
            os.close(self._lock_descriptor)
            self._lock_descriptor = None


@cache
def remove_stale_private_folders() -> None:
    """Remove this user's private folders whose processes were killed, once in a process."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PRIVATE_FOLDER_PREFIX}*"):
        with suppress(OSError, AttributeError, InputError):  # Windows has no users; somebody holds it
            found = folder.lstat()
            young = time.time() - found.st_mtime < MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
            if young or found.st_uid != os.getuid() or not stat.S_ISDIR(found.st_mode):
                continue
            if (folder / PRIVATE_LOCK_FILE).is_file() and (
                descriptor := _open_locked(folder / PRIVATE_LOCK_FILE)
            ) is not None:
                with suppress(DiskError):
                    if os.pread(descriptor, 100, 0) == _folder_identity(folder):  # or another program made it
                        remove(folder)
                os.close(descriptor)


def _folder_identity(folder: Path) -> bytes:
    """Return what no copy of a folder has."""
    found = folder.lstat()
    return f"unjam {found.st_dev} {found.st_ino}".encode()


def check_not_locked(folder: Path) -> None:
    """Raise `InputError` where a process holds a folder now; its lock is only read, never written or made."""
    path = folder / LOCK_FILE
    with suppress(OSError):  # there is none, or it cannot be read
        if not stat.S_ISREG(path.lstat().st_mode) or (descriptor := _open_locked(path, is_shared=True)) is None:
            return
        try:
            _check_other_machine(path, descriptor)
        finally:
            os.close(descriptor)


def is_locked(folder: Path) -> bool:
    """Return whether a process holds a folder now."""
    try:
        check_not_locked(folder)
    except InputError:
        return True
    return False


def _open_locked(path: Path, is_shared: bool = False) -> int | None:
    """Return an open and locked file, for one that only `reads` a shared lock; None without locks."""
    try:
        import fcntl
    except ImportError:
        return None
    descriptor = open_in_place(path, os.O_RDONLY if is_shared else os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        held = f"run: {str(path.parent)!r} is being written by another process"
        raise InputError(f"{held}; allowed: one at a time") from None
    except OSError:  # a file system without locks
        pass
    return descriptor


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether an open file still is the one of that name."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
