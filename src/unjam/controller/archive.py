"""The archive around a controller: its parts by name, and nothing else let in."""

import io
import stat
import zipfile
from pathlib import Path

from unjam.errors import InputError

MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"
SAMPLE, GRAPH = "sample.safetensors", "controller.onnx"
PARTS = (MANIFEST, WEIGHTS, SAMPLE, GRAPH)
"""all that an archive may hold; the last two are there where it was exported"""
LARGEST_PART = 64 * 2**20
"""bytes of one part"""


def pack_parts(parts: dict[str, bytes]) -> bytes:
    """Return the archive of `parts`; the same parts have the same bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(name), part)  # of a fixed date
    return content.getvalue()


def unpack_parts(file: Path) -> dict[str, bytes]:
    """Return the parts of an archive, in memory: nothing is written.

    Raises:
        InputError: it holds what no controller has: an unknown, second, compressed or too large part, a link.
        zipfile.BadZipFile, OSError, EOFError, RuntimeError: it is not an archive, or damaged.
    """
    size, largest = file.stat().st_size, len(PARTS) * LARGEST_PART
    if size > largest:
        raise InputError(f"controller {file.name}: {size} bytes; allowed: at most {largest}")
    parts: dict[str, bytes] = {}
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.filename in parts:
                raise InputError(f"controller {file.name}: has {entry.filename} twice")
            wrong = _what_is_wrong(entry)
            if wrong:
                raise InputError(f"controller {file.name}: part {entry.filename!r} {wrong}")
            parts[entry.filename] = archive.read(entry)
    for name in (MANIFEST, WEIGHTS):
        if name not in parts:
            raise InputError(f"controller {file.name}: not a controller: it has no {name}")
    return parts


def _what_is_wrong(entry: zipfile.ZipInfo) -> str:
    """Return why an entry is not let in; empty where it is."""
    if entry.filename not in PARTS:
        return f"is unknown; allowed: {', '.join(PARTS)}"
    if stat.S_ISLNK(entry.external_attr >> 16):
        return "is a link"
    if (
        entry.compress_type != zipfile.ZIP_STORED
        or entry.flag_bits & 1
        or entry.compress_size != entry.file_size
    ):
        return "is compressed or encrypted; allowed: neither"
    if entry.file_size > LARGEST_PART:
        return f"has {entry.file_size} bytes; allowed: at most {LARGEST_PART}"
    return ""
