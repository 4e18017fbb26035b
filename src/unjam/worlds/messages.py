"""Messages between processes over pipes: JSON and arrays, without pickle."""

import json
import os
import select
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

import numpy as np

from unjam.child_processes import child_environment, isolate_matplotlib, python_command
from unjam.processes import exit_with_parent
from unjam.tree import Arrays

_LENGTHS = struct.Struct(">QQ")
ARRAY_KINDS = "biuf"
"""kinds of arrays in messages: Booleans and numbers"""


def start_child(module: str, stderr: IO[bytes] | None = None, **environment: str) -> subprocess.Popen[bytes]:
    """Start `python -m module`, a process that answers requests; `environment` has additional variables."""
    return subprocess.Popen(
        python_command("-m", module),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=child_environment(**environment),
        start_new_session=True,  # the parent handles an interrupt in the terminal
    )


def open_answer_pipe() -> IO[bytes]:
    """Return the pipe for the answers of this process, and redirect its standard output to its standard error."""
    exit_with_parent(signal.SIGKILL)
    isolate_matplotlib()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what SUMO and user code print must not mix with the answers
    return output


def answer_requests(answer: Callable[[dict[str, Any], Arrays], None]) -> None:
    """Call `answer` with each request from standard input until the parent closes a pipe."""
    with suppress(BrokenPipeError, EOFError):
        while True:
            answer(*read_message(sys.stdin.buffer))


def write_message(pipe: IO[bytes], content: dict[str, Any], arrays: Arrays | None = None) -> None:
    """Write `content` as JSON, then `arrays` by name; each is removed when written, because arrays may be large."""
    unwritten = {} if arrays is None else arrays
    for name, array in unwritten.items():
        unwritten[name] = array = np.asarray(array, order="C")
        if array.dtype.kind not in ARRAY_KINDS:
            raise TypeError(f"{name}: an array of {array.dtype} cannot be sent")
    shapes = [[name, array.dtype.str, array.shape] for name, array in unwritten.items()]
    text, header = json.dumps(content).encode(), json.dumps(shapes).encode()
    pipe.write(_LENGTHS.pack(len(text), len(header)) + text + header)
    for name in list(unwritten):
        pipe.write(_array_bytes(unwritten.pop(name)))
    pipe.flush()


def read_message(pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
    """Return content and arrays of the next message; raise `EOFError` if the other process has closed the pipe."""
    lengths = _LENGTHS.unpack(_read_exactly(pipe, _LENGTHS.size))
    content, shapes = (json.loads(_read_exactly(pipe, length)) for length in lengths)
    arrays: Arrays = {}
    for name, type_text, shape in shapes:
        dtype = np.dtype(type_text)
        if dtype.kind not in ARRAY_KINDS:
            raise ValueError(f"{name}: an array of {dtype} is not allowed")
        arrays[name] = np.empty(shape, dtype)
        _read_into(pipe, _array_bytes(arrays[name]))
    return content, arrays


def has_message(pipe: IO[bytes], seconds: float) -> bool:
    """Return whether a message or the end of the pipe arrives in time; True where pipes cannot be polled."""
    if not hasattr(select, "poll"):
        return True
    poller = select.poll()
    poller.register(pipe, select.POLLIN)
    return bool(poller.poll(1000 * seconds))


def _array_bytes(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data  # shares the memory of the array


def _read_exactly(pipe: IO[bytes], length: int) -> bytes:
    data = bytearray(length)
    _read_into(pipe, memoryview(data))
    return bytes(data)


def _read_into(pipe: Any, buffer: memoryview) -> None:
    while buffer:
        count = pipe.readinto(buffer)
        if not count:
            raise EOFError("the other process has closed the pipe")
        buffer = buffer[count:]
