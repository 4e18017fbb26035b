"""Messages between processes over pipes: frames of JSON and arrays. Nothing is ever unpickled."""

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
    """Start `python -m module`, a process that answers requests, with changes to its environment."""
    return subprocess.Popen(
        python_command("-m", module),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=child_environment(**environment),
        start_new_session=True,  # the parent handles an interrupt in the terminal
    )


def open_answer_pipe() -> IO[bytes]:
    """Return the pipe for the answers of this process, which from now on prints to its standard error."""
    exit_with_parent(signal.SIGKILL)
    isolate_matplotlib()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    return output


def answer_requests(answer: Callable[[dict[str, Any], Arrays], None]) -> None:
    """Call `answer` with each request from standard input until the parent closes it, or one of the pipes."""
    with suppress(BrokenPipeError, EOFError):
        while True:
            answer(*read_message(sys.stdin.buffer))


def write_message(pipe: IO[bytes], content: dict[str, Any], arrays: Arrays | None = None) -> None:
    """Write `content` as JSON, and named arrays, which are removed once written: they may be hours of traffic."""
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
    """Return the next message; raise `EOFError` if the other side has closed the pipe."""
    lengths = _LENGTHS.unpack(_read_exactly(pipe, _LENGTHS.size))
    content, shapes = (json.loads(_read_exactly(pipe, length)) for length in lengths)
    arrays: Arrays = {}
    for name, kind, shape in shapes:
        dtype = np.dtype(kind)
        if dtype.kind not in ARRAY_KINDS:
            raise ValueError(f"{name}: an array of {dtype} is not allowed")
        arrays[name] = np.empty(shape, dtype)
        _read_into(pipe, _array_bytes(arrays[name]))
    return content, arrays


def has_message(pipe: IO[bytes], seconds: float) -> bool:
    """Return whether an answer or the end arrives within a time; True at once where pipes cannot be polled."""
    if not hasattr(select, "poll"):
        return True
    poller = select.poll()
    poller.register(pipe, select.POLLIN)
    return bool(poller.poll(1000 * seconds))


def _array_bytes(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data  # shares its memory


def _read_exactly(pipe: IO[bytes], length: int) -> bytes:
    data = bytearray(length)
    _read_into(pipe, memoryview(data))
    return bytes(data)


def _read_into(pipe: Any, buffer: memoryview) -> None:
    while buffer:
        count = pipe.readinto(buffer)
        if not count:
            raise EOFError("the other side closed the pipe")
        buffer = buffer[count:]
