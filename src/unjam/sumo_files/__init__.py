"""What the user's own SUMO files say, read before SUMO starts: SUMO crashes on some that are broken.

They are read in a process of their own with limits on memory and time: such files may come from anywhere.
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from unjam.errors import InputError
from unjam.sumo_files import reader
from unjam.sumo_files.reader import stamp

LARGEST_MEMORY = 4 * 2**30
"""bytes that reading may take"""
LONGEST_TIME = 120
"""seconds that reading may take"""


@dataclass(frozen=True)
class SumoFiles:
    """A .sumocfg file and what the files that it names hold."""

    path: Path
    network: Path
    additional_files: tuple[Path, ...]
    begin: float
    """[s]"""
    end: float | None
    """[s]; None: when the last vehicle has arrived"""
    step: float
    """[s]"""
    types: dict[str, dict[str, str]]
    """attributes of all vehicle types, by id"""
    used_types: frozenset[str]
    """types that vehicles have"""


_known: dict[Path, tuple[dict[Path, tuple[int, int]], SumoFiles]] = {}
"""what was read already, with the stamps of all files that were read for it"""


def read_sumo_files(path: Path) -> SumoFiles:
    """Return what a .sumocfg file and the files that it names say; read again where one has changed.

    Raises:
        InputError: one is missing, broken or too large, the network has no version, or there are no
            vehicles.
    """
    if path in _known:
        stamps, files = _known[path]
        if all(file.is_file() and stamp(file) == before for file, before in stamps.items()):
            return files
    found = _ask("configuration", path)
    stamps = {Path(file): (time, size) for file, (time, size) in found.pop("stamps").items()}
    paths = {
        "network": Path(found["network"]),
        "additional_files": tuple(map(Path, found["additional_files"])),
    }
    files = SumoFiles(path, **{**found, **paths, "used_types": frozenset(found["used_types"])})
    _known[path] = stamps, files
    return files


def read_lanes(path: Path) -> list[tuple[str, float, list[tuple[float, float]]]]:
    """Return edge, length [m] and centre line [(x, y), m] of each lane of a network file.

    Raises:
        InputError: it is broken, or too large.
    """
    try:
        return [
            (edge, float(length), [_point(point) for point in shape.split()])
            for edge, length, shape in _ask("lanes", path)
        ]
    except ValueError as error:
        raise InputError(f"{path.name}: cannot be read: {error}") from None


def _point(text: str) -> tuple[float, float]:
    x, y, *_ = text.split(",")
    return float(x), float(y)


def _ask(command: Literal["configuration", "lanes"], path: Path) -> Any:
    """Return what the reader answers; raise `InputError` where it says what is wrong, or is lost."""
    program = [sys.executable, "-I", "-S", reader.__file__, command, str(path)]
    try:
        done = subprocess.run(
            [*program, str(LARGEST_MEMORY), str(LONGEST_TIME)],
            capture_output=True,
            timeout=LONGEST_TIME,
            check=False,
        )
        answer = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        limits = f"{LARGEST_MEMORY / 2**30:g} GiB, {LONGEST_TIME:g} s"
        raise InputError(f"{path.name}: its files cannot be read within {limits}") from None
    if "broken" in answer:
        raise InputError(answer["broken"])
    return answer["found"]
