"""What processes tell each other over pipes: frames of JSON and arrays. Nothing is ever unpickled."""

import json
import struct
from typing import IO, Any

import numpy as np

from unjam.tree import Arrays

_LENGTHS = struct.Struct(">QQ")
ARRAY_KINDS = "biuf"
"""kinds of arrays that travel: truth values and numbers"""


def write_message(pipe: IO[bytes], content: dict[str, Any], arrays: Arrays | None = None) -> None:
    """Write one message: `facts` as JSON, and arrays of numbers by name.

    An array is written from where it lies, and then taken out of `weights`: hours of traffic that nobody else
    holds are not in memory twice, here and where they are read.
    """
    made = {} if arrays is None else arrays
    for name, array in made.items():
        made[name] = array = np.asarray(array, order="C")
        if array.dtype.kind not in ARRAY_KINDS:
            raise TypeError(f"{name}: an array of {array.dtype} cannot travel")
    shapes = [[name, array.dtype.str, array.shape] for name, array in made.items()]
    text, about = json.dumps(content).encode(), json.dumps(shapes).encode()
    pipe.write(_LENGTHS.pack(len(text), len(about)) + text + about)
    for name in list(made):
        pipe.write(_array_bytes(made.pop(name)))
    pipe.flush()


def read_message(pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
    """Return the next message; raise `EOFError` where the other side is gone."""
    lengths = _LENGTHS.unpack(_read_exactly(pipe, _LENGTHS.size))
    facts, shapes = (json.loads(_read_exactly(pipe, length)) for length in lengths)
    arrays: Arrays = {}
    for name, kind, shape in shapes:
        dtype = np.dtype(kind)
        if dtype.kind not in ARRAY_KINDS:
            raise ValueError(f"{name}: an array of {dtype} is not allowed")
        arrays[name] = np.empty(shape, dtype)
        _read_into(pipe, _array_bytes(arrays[name]))
    return facts, arrays


def _array_bytes(array: np.ndarray) -> memoryview:
    """Return the memory of an array; what is written there is in the array."""
    return array.reshape(-1).view(np.uint8).data


def _read_exactly(pipe: IO[bytes], length: int) -> bytes:
    parts = []
    while length:
        part = pipe.read(length)
        if not part:
            raise EOFError("the other side closed the pipe")
        parts.append(part)
        length -= len(part)
    return b"".join(parts)


def _read_into(pipe: Any, buffer: memoryview) -> None:
    while buffer:
        count = pipe.readinto(buffer)
        if not count:
            raise EOFError("the other side closed the pipe")
        buffer = buffer[count:]
