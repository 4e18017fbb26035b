"""Restrict a process that reads untrusted files: little memory and time, no writing, no network.

The kernel enforces the limits permanently, also for children: Landlock protects the disk, and a filter of system calls
(seccomp) blocks sockets. As a program, this file runs another program with these limits; it imports only the standard
library.
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

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446  # system calls of Landlock on all processors
WRITE_FILE, TRUNCATE = 1 << 1, 1 << 14
REMOVE_AND_CREATE = 0b1_1111_1111 << 4  # folders, files, devices, sockets, pipes and links
REFER = 1 << 13  # moving to another folder
NO_NEW_PRIVILEGES, SET_SECCOMP, SECCOMP_FILTER_MODE = 38, 22, 2  # options of `prctl`
SOCKET_SYSCALLS = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198), "riscv64": (0xC00000F3, 198)}
"""number of the processor in the kernel, and number of the system call `socket`, by name of the processor"""
IO_URING_SETUP = 425  # a system call that can open sockets too
X32_SYSCALL_BIT = 0x40000000  # marks the numbers of system calls for x32
EPERM = 1
_limit_lock = threading.Lock()


def limit_resources(memory: int, seconds: int = 0) -> None:
    """End this process if it takes more memory [bytes] or time [s]; Windows has no such limits."""
    with suppress(ImportError):
        import resource
        import signal

        for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
            present_limits = [present for present in resource.getrlimit(kind) if present != resource.RLIM_INFINITY]
            if limit:  # a smaller limit can exist already (ulimit -v)
                resource.setrlimit(kind, (smallest := min([limit, *present_limits]), smallest))
        if seconds:
            signal.alarm(seconds)  # RLIMIT_CPU does not count time of waiting


@contextmanager
def limit_memory_growth(memory: int) -> Iterator[None]:
    """Raise `MemoryError` if this process, with all its threads, takes `memory` more [bytes] in the block; on Linux."""
    if sys.platform != "linux":
        yield
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    with _limit_lock:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        limits = [limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([pages * resource.getpagesize() + memory, *limits]), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def confine_process(*writable: Path) -> None:
    """Permanently deny this thread and its children sockets, and writing outside of these folders, if possible."""
    restrict_writing(*writable)
    if sys.platform == "linux":
        _block_sockets(ctypes.CDLL(None))


def restrict_writing(*writable: Path) -> None:
    """Permanently deny this thread and its children writing outside of these folders, if possible."""
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None)
    libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    version = libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return
    file_rights = WRITE_FILE | (TRUNCATE if version > 2 else 0)
    all_rights = file_rights | REMOVE_AND_CREATE | (REFER if version > 1 else 0)
    ruleset = libc.syscall(CREATE_RULESET, ctypes.byref(ctypes.c_uint64(all_rights)), ctypes.c_size_t(8), 0)
    folders = filter(Path.is_dir, writable)
    for path, rights in {**dict.fromkeys(folders, all_rights), Path(os.devnull): file_rights}.items():
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        libc.syscall(ADD_RULE, ruleset, 1, struct.pack("=Qi", rights, descriptor), 0)
        os.close(descriptor)
    libc.syscall(RESTRICT_SELF, ruleset, 0)
    os.close(ruleset)


def _block_sockets(libc: ctypes.CDLL) -> None:
    if platform.machine() not in SOCKET_SYSCALLS or sys.maxsize < 2**32:
        return
    processor, socket = SOCKET_SYSCALLS[platform.machine()]
    load, equal, at_least, return_value = 0x20, 0x15, 0x35, 0x06
    instructions = (
        (load, 0, 0, 4),
        (equal, 0, 5, processor),
        (load, 0, 0, 0),
        (at_least, 3, 0, X32_SYSCALL_BIT),
        (equal, 2, 0, socket),
        (equal, 1, 0, IO_URING_SETUP),
        (return_value, 0, 0, 0x7FFF0000),  # allowed
        (return_value, 0, 0, 0x00050000 | EPERM),  # refused
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
