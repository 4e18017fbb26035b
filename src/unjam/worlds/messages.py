"""What processes tell each other over pipes: frames of JSON and arrays. Nothing is ever unpickled."""

import json
import struct
from typing import IO, Any

import numpy as np
from safetensors.numpy import load, save

from unjam.tree import Arrays

_LENGTHS = struct.Struct(">QQ")


def write_message(pipe: IO[bytes], facts: dict[str, Any], arrays: Arrays | None = None) -> None:
    """Write one message: `facts` as JSON, and arrays by name."""
    text = json.dumps(facts).encode()
    data = save({name: np.asarray(array, order="C") for name, array in arrays.items()}) if arrays else b""
    pipe.write(_LENGTHS.pack(len(text), len(data)) + text)
    pipe.write(data)  # apart: joined, hours of traffic would be in memory twice
    pipe.flush()


def read_message(pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
    """Return the next message; raise `EOFError` where the other side is gone."""
    text_length, data_length = _LENGTHS.unpack(_read_exactly(pipe, _LENGTHS.size))
    facts = json.loads(_read_exactly(pipe, text_length))
    data = _read_exactly(pipe, data_length)
    return facts, load(data) if data else {}


def _read_exactly(pipe: IO[bytes], length: int) -> bytes:
    parts = []
    while length:
        part = pipe.read(length)
        if not part:
            raise EOFError("the other side closed the pipe")
        parts.append(part)
        length -= len(part)
    return b"".join(parts)
