"""Processes that end with their parent, and folders that only one process at a time can write."""

import atexit
import ctypes
import json
import os
import platform
import shutil
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from weakref import finalize

from unjam.errors import DiskError, InputError, LostWorkerError
from unjam.files import open_in_place, remove
from unjam.folders import PROTECTED_FOLDERS_VARIABLE, protect_folder, protected_folders
from unjam.sandbox import confine_process, limit_resources

PARENT_VARIABLE = "UNJAM_PARENT"  # environment variable with the id of the process with which a child ends
TRACI_VARIABLES = "LIBSUMO_AS_TRACI", "LIBTRACI_AS_TRACI"  # replace traci by a library that prints this
LOCK_FILE = ".lock"  # the file that locks a folder for its writer
HEARTBEAT_INTERVAL, MAX_MISSED_HEARTBEATS = 10.0, 6  # of a folder's owner [s], and how many it may miss
PRIVATE_FOLDER_PREFIX, PRIVATE_LOCK_FILE = "unjam-", ".temporary"
"""beginning of the names of private temporary folders, and the file that locks one for its process"""
PR_SET_PDEATHSIG = 1  # Linux's option of prctl
MAX_CHILD_MEMORY, MAX_CHILD_TIME = 8 * 2**30, 600  # limits of reading an untrusted file [bytes, s]
_is_command_line = False


def bind_to_parent(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process of unjam that ends with this one, and protects the same folders."""
    kept = {name: value for name, value in environment.items() if name not in TRACI_VARIABLES}
    folders = json.dumps(list(map(str, protected_folders())))
    return {**kept, PROTECTED_FOLDERS_VARIABLE: folders, PARENT_VARIABLE: str(os.getpid())}


def mark_as_command_line() -> None:
    """Mark this process as the command line, whose standard output is for results alone."""
    global _is_command_line
    _is_command_line = True
    for name in TRACI_VARIABLES:
        os.environ.pop(name, None)


def redirect_user_output() -> AbstractContextManager[object]:
    """Return a context for loading code of users: the command line sends its output to standard error."""
    return redirect_stdout(sys.stderr) if _is_command_line else nullcontext()


class ForkGuard(AbstractContextManager[None]):
    """Ends a fork that users' code makes within the block, where it would go on with the episode of this process."""

    def __enter__(self) -> None:
        self._process = os.getpid()

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if os.getpid() == self._process:
            return
        code = error.code if isinstance(error, SystemExit) else int(error is not None)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code if isinstance(code, int) else int(code is not None))


def exit_with_parent(signum: int) -> None:
    """Let Linux signal this process, even a busy one, when its parent ends, if the parent used `bind_to_parent`."""
    parent = os.environ.pop(PARENT_VARIABLE, "")
    if not parent or sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # a C library without it
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signum, 0, 0, 0)
    if _has_ended(int(parent)):  # before this process asked for the signal
        os.kill(os.getpid(), signum)


def _has_ended(process: int) -> bool:
    """Return whether a process has ended, even if its own parent has not yet asked for its exit code."""
    try:
        with suppress(PermissionError):  # it is of another user
            os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][:1] in ("Z", "X")
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # a system without /proc
        return False


def follow_parent(parent: int) -> None:
    """Let this child end when its parent does; the parent alone handles interrupts of the terminal."""
    os.environ[PARENT_VARIABLE] = str(parent)
    exit_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def capture_stderr(path: Path) -> Iterator[None]:
    """Write the standard error of this process, its libraries included, to a file within the block."""
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
    """Continue in a child with limited resources, which reads untrusted files; this process waits for it.

    If the kernel supports it, the child can write only into the folders `writable`, and has no network. On Windows
    nothing changes. This process exits with the child's code, or raises `InputError` if the child took too much memory
    or time, or crashed.
    """
    if not hasattr(os, "fork"):
        return
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        atexit.unregister(shutil.rmtree)  # this process removes temporary folders of libraries, such as matplotlib's
        follow_parent(parent)
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
        limits = f"{MAX_CHILD_MEMORY / 2**30:g} GiB and {MAX_CHILD_TIME:g} s"
        raise InputError(f"{description}: cannot be read within {limits}: signal {-code}")
    sys.exit(code)


def kernel_protections() -> list[str]:
    """Return the protections that the kernel offers for reading untrusted files; tested in a child."""
    if sys.platform != "linux":
        return []
    with tempfile.TemporaryDirectory() as folder:
        child = os.fork()
        if child == 0:
            confine_process()
            denied = 0
            for bit, action in ((1, Path(folder, "file").touch), (2, socket.socket)):
                try:
                    action()
                except PermissionError:
                    denied |= bit
            os._exit(denied)
        code = max(0, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    names = {1: "disk read-only (Landlock)", 2: "no network (seccomp)"}
    return [name for bit, name in names.items() if code & bit]


def has_display() -> bool:
    """Return whether a process can open a window on this machine."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock an existing folder for this process; `InputError` if another one has, or if an entry is a link.

    If machines share a folder but not its locks, the age of the lock shows that an owner elsewhere is alive. On
    Windows there is no lock. Within the block neither this process nor its children follow links inside the folder.
    """
    with protect_folder(folder), lock_file(folder / LOCK_FILE, f"run: {str(folder)!r}"):
        yield


@contextmanager
def lock_file(path: Path, target: str) -> Iterator[None]:
    """Lock what messages call `target` for this process, by a file that exists meanwhile; else as `lock_folder`."""
    with ExitStack() as stack:
        descriptor = _open_locked(path, target)
        while descriptor is not None and not _is_same_file(path, descriptor):  # its owner has just removed it
            os.close(descriptor)
            descriptor = _open_locked(path, target)
        if descriptor is not None:
            stack.callback(os.close, descriptor)
            _check_other_machine(descriptor, target)
            os.pwrite(descriptor, f"{platform.node()} {os.getpid()}\n".ljust(300).encode(), 0)
            stop = threading.Event()
            heart = threading.Thread(target=_send_heartbeats, args=(descriptor, stop), daemon=True)
            heart.start()
            stack.callback(remove, path)  # the last of these is called first
            stack.callback(heart.join)
            stack.callback(stop.set)
        yield


def _send_heartbeats(descriptor: int, stop: threading.Event) -> None:
    while not stop.wait(HEARTBEAT_INTERVAL):
        with suppress(OSError):  # a disk that is temporarily unavailable
            os.utime(descriptor)


def _check_other_machine(descriptor: int, target: str) -> None:
    """Raise `InputError` if a process of another machine has locked the file and is alive."""
    owner = _recent_owner(descriptor)
    if owner and owner[0] != platform.node():
        allowed = f"one at a time, or {MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL:g} s after its end"
        raise InputError(f"{target} is being written on {owner[0]}; allowed: {allowed}")


def _recent_owner(descriptor: int) -> list[str]:
    """Return machine and process that have locked a file; empty if they have sent no recent heartbeat."""
    age = time.time() - os.fstat(descriptor).st_mtime
    is_recent = abs(age) < MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
    return os.pread(descriptor, 300, 0).decode(errors="replace").split() if is_recent else []


def _check_this_machine(descriptor: int, target: str) -> None:
    """Raise `InputError` if a living process of this machine has named itself in a file that cannot be locked."""
    owner = _recent_owner(descriptor)
    if len(owner) == 2 and owner[0] == platform.node() and owner[1].isdecimal() and not _has_ended(int(owner[1])):
        raise InputError(f"{target} is being written by another process; allowed: one at a time")


def check_owner(owner: int, name: str) -> None:
    """Raise `LostWorkerError` in a fork of the process `owner`: both would read each other's answers."""
    if os.getpid() != owner:
        raise LostWorkerError(f"{name} belongs to another process (os.fork); allowed: to open one after the fork")


class PrivateFolder(AbstractContextManager[str]):
    """A temporary folder, removed at the end of its process, or by a later one if that is killed."""

    def __init__(self) -> None:
        self.name = tempfile.mkdtemp(prefix=PRIVATE_FOLDER_PREFIX)
        lock = _open_locked(Path(self.name, PRIVATE_LOCK_FILE))
        if lock is not None:
            os.write(lock, _folder_identity(Path(self.name)))
        self.cleanup = finalize(self, _remove_private_folder, Path(self.name), lock, os.getpid())
        """removes it; may be called twice, and has no effect in a fork of its process"""

    def __enter__(self) -> str:
        return self.name

    def __exit__(self, *error: object) -> None:
        self.cleanup()


def _remove_private_folder(folder: Path, lock: int | None, process: int) -> None:
    if os.getpid() != process:
        return
    remove(folder)
    if lock is not None:
        os.close(lock)


@cache
def remove_stale_private_folders() -> None:
    """Remove this user's private folders of processes that were killed, once in a process."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PRIVATE_FOLDER_PREFIX}*"):
        with suppress(OSError, AttributeError, InputError):  # Windows has no users; it is locked
            status, lock = folder.lstat(), folder / PRIVATE_LOCK_FILE
            is_old = time.time() - status.st_mtime >= MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
            is_own = status.st_uid == os.getuid() and stat.S_ISDIR(status.st_mode) and lock.is_file()
            if is_old and is_own and (descriptor := _open_locked(lock, needs_lock=True)) is not None:
                with suppress(DiskError):
                    if os.pread(descriptor, 100, 0) == _folder_identity(folder):  # else another program made it
                        remove(folder)
                os.close(descriptor)


def _folder_identity(folder: Path) -> bytes:
    """Return the identity of a folder, which no copy of it has."""
    status = folder.lstat()
    return f"unjam {status.st_dev} {status.st_ino}".encode()


def check_not_locked(folder: Path) -> None:
    """Raise `InputError` if a process has locked a folder; its lock is only read, never written or made."""
    path, target = folder / LOCK_FILE, f"run: {str(folder)!r}"
    with suppress(OSError):  # there is no lock, or it cannot be read
        is_file = stat.S_ISREG(path.lstat().st_mode)
        if not is_file or (descriptor := _open_locked(path, target, is_shared=True)) is None:
            return
        try:
            _check_other_machine(descriptor, target)
        finally:
            os.close(descriptor)


def is_locked(folder: Path) -> bool:
    """Return whether a process has locked a folder."""
    try:
        check_not_locked(folder)
    except InputError:
        return True
    return False


def _open_locked(path: Path, target: str = "", is_shared: bool = False, needs_lock: bool = False) -> int | None:
    """Return an open and locked file; None on a platform, and with `needs_lock` on a file system, without locks."""
    try:
        import fcntl
    except ImportError:
        return None
    descriptor = open_in_place(path, os.O_RDONLY if is_shared else os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise InputError(f"{target} is being written by another process; allowed: one at a time") from None
    except OSError:  # a file system without locks
        try:
            _check_this_machine(descriptor, target)
        except InputError:
            os.close(descriptor)
            raise
        if needs_lock:
            os.close(descriptor)
            return None
    return descriptor


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether an open file still has that name."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
