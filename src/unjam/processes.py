"""Processes that end with their parent, and locks of folders for one process at a time."""

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

PARENT_VARIABLE = "UNJAM_PARENT"  # variable with the id of the parent, with which a child ends
TRACI_VARIABLES = "LIBSUMO_AS_TRACI", "LIBTRACI_AS_TRACI"  # if they are set, traci is a library that prints so
LOCK_FILE = ".lock"  # the file that locks a folder for its writer
HEARTBEAT_INTERVAL, MAX_MISSED_HEARTBEATS = 10.0, 6
"""interval of heartbeats of the owner of a folder [s], and how many may be missing"""
PRIVATE_FOLDER_PREFIX, PRIVATE_LOCK_FILE = "unjam-", ".temporary"
"""beginning of the names of private temporary folders, and the file that locks such a folder for its process"""
PR_SET_PDEATHSIG = 1  # option of prctl on Linux
MAX_CHILD_MEMORY, MAX_CHILD_TIME = 8 * 2**30, 600  # limits for reading an untrusted file [bytes, s]
_is_command_line = False


def bind_to_parent(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a child of unjam that ends with this process, and protects the same folders."""
    variables = {name: value for name, value in environment.items() if name not in TRACI_VARIABLES}
    folders = json.dumps(list(map(str, protected_folders())))
    return {**variables, PROTECTED_FOLDERS_VARIABLE: folders, PARENT_VARIABLE: str(os.getpid())}


def mark_as_command_line() -> None:
    """Mark this process as the command line, which prints only results on standard output."""
    global _is_command_line
    _is_command_line = True
    for name in TRACI_VARIABLES:
        os.environ.pop(name, None)


def redirect_user_output() -> AbstractContextManager[object]:
    """Return a context for code of users: in the command line its output goes to standard error."""
    return redirect_stdout(sys.stderr) if _is_command_line else nullcontext()


class ForkGuard(AbstractContextManager[None]):
    """Ends forks made by code of users at the end of the block, where they would continue the episode."""

    def __enter__(self) -> None:
        self._process_id = os.getpid()

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if os.getpid() == self._process_id:
            return
        code = error.code if isinstance(error, SystemExit) else int(error is not None)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code if isinstance(code, int) else int(code is not None))


def exit_with_parent(signum: int) -> None:
    """Let Linux send this process a signal when its parent ends, if the parent used `bind_to_parent`."""
    parent = os.environ.pop(PARENT_VARIABLE, "")
    if not parent or sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # a C library without prctl
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signum, 0, 0, 0)
    if _has_ended(int(parent)):  # it ended before the call of prctl
        os.kill(os.getpid(), signum)


def _has_ended(process: int) -> bool:
    """Return whether a process has ended, even if its parent has not yet read the exit code."""
    try:
        with suppress(PermissionError):  # a process of another user
            os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][:1] in ("Z", "X")
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # a system without /proc
        return False


def follow_parent(parent: int) -> None:
    """Let this child end with its parent; only the parent handles interrupts from the terminal."""
    os.environ[PARENT_VARIABLE] = str(parent)
    exit_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def capture_stderr(path: Path) -> Iterator[None]:
    """Write the standard error of this process and its libraries to a file within the block."""
    original_stderr, descriptor = os.dup(2), open_in_place(path, os.O_WRONLY | os.O_CREAT)
    os.ftruncate(descriptor, 0)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    try:
        yield
    finally:
        os.dup2(original_stderr, 2)
        os.close(original_stderr)


def continue_in_limited_child(description: str, *writable: Path) -> None:
    """Continue in a child with limited resources, to read untrusted files, while this process waits for the child.

    If the kernel supports it, the child can write only into the folders `writable`, and has no network. On Windows
    there is no child. This process exits with the code of the child, or raises `InputError` if the child took too much
    memory or time, or crashed.
    """
    if not hasattr(os, "fork"):
        return
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        atexit.unregister(shutil.rmtree)  # the parent removes temporary folders of libraries, such as matplotlib
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
    """Test in a child how the kernel can restrict it, and return the available protections."""
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
    """Lock an existing folder for this process; raise `InputError` if it is locked already, or if an entry is a link.

    If machines share a folder but not its locks, heartbeats in the lock file show that its owner is alive. On Windows
    there is no lock. Within the block neither this process nor its children follow links inside the folder.
    """
    with protect_folder(folder), lock_file(folder / LOCK_FILE, f"run: {str(folder)!r}"):
        yield


@contextmanager
def lock_file(path: Path, target: str) -> Iterator[None]:
    """Lock `target`, its name in messages, for this process by a file within the block; see `lock_folder`."""
    with ExitStack() as stack:
        descriptor = _open_locked(path, target)
        while descriptor is not None and not _is_same_file(path, descriptor):  # the previous owner has just removed it
            os.close(descriptor)
            descriptor = _open_locked(path, target)
        if descriptor is not None:
            stack.callback(os.close, descriptor)
            _check_other_machine(descriptor, target)
            os.pwrite(descriptor, f"{platform.node()} {os.getpid()}\n".ljust(300).encode(), 0)
            stop = threading.Event()
            heartbeat_thread = threading.Thread(target=_send_heartbeats, args=(descriptor, stop), daemon=True)
            heartbeat_thread.start()
            stack.callback(remove, path)  # callbacks run in reverse order
            stack.callback(heartbeat_thread.join)
            stack.callback(stop.set)
        yield


def _send_heartbeats(descriptor: int, stop: threading.Event) -> None:
    while not stop.wait(HEARTBEAT_INTERVAL):
        with suppress(OSError):  # the disk is temporarily unavailable
            os.utime(descriptor)


def _check_other_machine(descriptor: int, target: str) -> None:
    """Raise `InputError` if a living process of another machine has locked the file."""
    owner = _recent_owner(descriptor)
    if owner and owner[0] != platform.node():
        allowed = f"one at a time, or {MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL:g} s after its end"
        raise InputError(f"{target} is being written on {owner[0]}; allowed: {allowed}")


def _recent_owner(descriptor: int) -> list[str]:
    """Return the machine and process id of the owner of a lock file; empty without a recent heartbeat."""
    age = time.time() - os.fstat(descriptor).st_mtime
    is_recent = abs(age) < MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
    return os.pread(descriptor, 300, 0).decode(errors="replace").split() if is_recent else []


def _check_this_machine(descriptor: int, target: str) -> None:
    """Raise `InputError` if a living process of this machine owns a file on a file system without locks."""
    owner = _recent_owner(descriptor)
    if len(owner) == 2 and owner[0] == platform.node() and owner[1].isdecimal() and not _has_ended(int(owner[1])):
        raise InputError(f"{target} is being written by another process; allowed: one at a time")


def check_owner(owner: int, name: str) -> None:
    """Raise `LostWorkerError` in a fork of the process `owner`: each would read the answers for the other."""
    if os.getpid() != owner:
        raise LostWorkerError(f"{name} belongs to another process (os.fork); allowed: to open one after the fork")


class PrivateFolder(AbstractContextManager[str]):
    """A temporary folder that its process removes at its end, or a later process if the first is killed."""

    def __init__(self) -> None:
        self.name = tempfile.mkdtemp(prefix=PRIVATE_FOLDER_PREFIX)
        lock = _open_locked(Path(self.name, PRIVATE_LOCK_FILE))
        if lock is not None:
            os.write(lock, _folder_identity(Path(self.name)))
        self.cleanup = finalize(self, _remove_private_folder, Path(self.name), lock, os.getpid())
        """removes the folder; may be called twice, and has no effect in a fork"""

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
    """Remove private folders of killed processes of this user; calls after the first have no effect."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PRIVATE_FOLDER_PREFIX}*"):
        with suppress(OSError, AttributeError, InputError):  # Windows has no getuid; the folder is locked
            status, lock = folder.lstat(), folder / PRIVATE_LOCK_FILE
            is_old = time.time() - status.st_mtime >= MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
            is_private = status.st_uid == os.getuid() and stat.S_ISDIR(status.st_mode) and lock.is_file()
            if is_old and is_private and (descriptor := _open_locked(lock, needs_lock=True)) is not None:
                with suppress(DiskError):
                    if os.pread(descriptor, 100, 0) == _folder_identity(folder):  # not of another program
                        remove(folder)
                os.close(descriptor)


def _folder_identity(folder: Path) -> bytes:
    """Return the identity of a folder, which differs from that of its copies."""
    status = folder.lstat()
    return f"unjam {status.st_dev} {status.st_ino}".encode()


def check_not_locked(folder: Path) -> None:
    """Raise `InputError` if a process has locked a folder; the lock file is only read."""
    path, target = folder / LOCK_FILE, f"run: {str(folder)!r}"
    with suppress(OSError):  # the lock is missing or cannot be read
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
    """Open and lock a file; return None if the system, or with `needs_lock` its file system, has no locks."""
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
    """Return whether `path` still names an open file."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
