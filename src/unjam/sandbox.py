"""Restrict a process that reads untrusted files: little memory and time, no writing, no network.

The kernel enforces it, for children too, and permanently: Landlock protects the disk, and a filter of system calls
(seccomp) blocks sockets. Run as a program, this file runs another one in this way, with the standard library alone.
"""

import ctypes
import os
import platform
import runpy
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446  # Landlock's system calls, the same on all processors
WRITE_FILE, TRUNCATE = 1 << 1, 1 << 14
REMOVE_AND_CREATE = 0b1_1111_1111 << 4  # folders, files, devices, sockets, pipes and links
REFER = 1 << 13  # moving to another folder
NO_NEW_PRIVILEGES, SET_SECCOMP, SECCOMP_FILTER_MODE = 38, 22, 2  # options of `prctl`
SOCKET_SYSCALLS = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198), "riscv64": (0xC00000F3, 198)}
"""number of the processor in the kernel and number of the system call `socket`, by name of the processor"""
IO_URING_SETUP = 425  # a system call that can open sockets too
X32_SYSCALL_BIT = 0x40000000  # marks other numbers of the same system calls (x32)
EPERM = 1
_limit_lock = threading.Lock()


def limit_resources(memory: int, seconds: int = 0) -> None:
    """End this process if it takes more memory [bytes] or time [s]; not on Windows."""
    with suppress(ImportError):
        import resource
        import signal

        for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
            limits = [old for old in resource.getrlimit(kind) if old != resource.RLIM_INFINITY]
            if limit:  # a smaller limit can exist already (ulimit -v)
                resource.setrlimit(kind, (smallest := min([limit, *limits]), smallest))
        if seconds:
            signal.alarm(seconds)  # also if it only waits


@contextmanager
def limit_memory_growth(memory: int) -> Iterator[None]:
    """Raise `MemoryError` if this process, with all its threads, takes so much more memory [bytes]; on Linux only."""
    if sys.platform != "linux":
        yield
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    with _limit_lock:
        before, hard = resource.getrlimit(resource.RLIMIT_AS)
        limits = [limit for limit in (before, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([pages * resource.getpagesize() + memory, *limits]), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (before, hard))


def confine_process(*writable: Path) -> None:
    """Permanently deny sockets to this thread and its children, and writing except into these folders, if possible."""
    restrict_writing(*writable)
    if sys.platform == "linux":
        _block_sockets(ctypes.CDLL(None))


def restrict_writing(*writable: Path) -> None:
    """Permanently deny writing to this thread and its children, except into these folders."""
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None)
    libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    version = libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return
    files = WRITE_FILE | (TRUNCATE if version > 2 else 0)
    handled = files | REMOVE_AND_CREATE | (REFER if version > 1 else 0)
    ruleset = libc.syscall(CREATE_RULESET, ctypes.byref(ctypes.c_uint64(handled)), ctypes.c_size_t(8), 0)
    folders = filter(Path.is_dir, writable)
    for path, allowed in {**dict.fromkeys(folders, handled), Path(os.devnull): files}.items():
        folder = os.open(path, os.O_PATH | os.O_CLOEXEC)
        libc.syscall(ADD_RULE, ruleset, 1, struct.pack("=Qi", allowed, folder), 0)
        os.close(folder)
    libc.syscall(RESTRICT_SELF, ruleset, 0)
    os.close(ruleset)


def _block_sockets(libc: ctypes.CDLL) -> None:
    if platform.machine() not in SOCKET_SYSCALLS or sys.maxsize < 2**32:
        return
    processor, socket = SOCKET_SYSCALLS[platform.machine()]
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    instructions = (
        (load, 0, 0, 4),
        (equal, 0, 5, processor),
        (load, 0, 0, 0),
        (at_least, 3, 0, X32_SYSCALL_BIT),
        (equal, 2, 0, socket),
        (equal, 1, 0, IO_URING_SETUP),
        (answer, 0, 0, 0x7FFF0000),  # allowed
        (answer, 0, 0, 0x00050000 | EPERM),
    )
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *instruction) for instruction in instructions))
    program = struct.pack("HP", len(instructions), ctypes.addressof(code))
    libc.prctl(SET_SECCOMP, SECCOMP_FILTER_MODE, program, 0, 0)


def run_sandboxed(memory: str, seconds: str, writable: str, program: str, *arguments: str) -> None:
    """Run a Python program with its arguments in a sandbox; `writable` is a folder or empty."""
    limit_resources(int(memory), int(seconds))
    confine_process(*map(Path, filter(None, [writable])))
    sys.argv = [program, *arguments]
    runpy.run_path(program, run_name="__main__")


if __name__ == "__main__":
    run_sandboxed(*sys.argv[1:])
