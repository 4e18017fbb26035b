"""Recorded speeds of leaders, and the files with these recordings."""

from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from unjam.errors import invalid_value
from unjam.physics.arrays import Floats
from unjam.recordings.trajectories import regular_times
from unjam.text import shorten_list

FILE_SUFFIXES = (".csv", ".txt", ".tsv", ".parquet", ".xml", ".gz")
WILDCARDS = {*"*?["}


@dataclass(frozen=True, eq=False)
class LeaderRecording:
    """Recorded speeds of one vehicle at equal intervals: T samples."""

    name: str
    time_step: float
    """time between two samples [s]"""
    speed: Floats = field(repr=False)
    """speeds [m/s], shape (T,)"""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.time_step * (len(self.speed) - 1)

    def speeds_at(self, start: float, seconds: float, step: float) -> Floats:
        """Return interpolated speeds [m/s] at times from `start` on, every `step` for at most `seconds` [s]."""
        times = start + regular_times(min(seconds, self.seconds - start), step)
        return np.interp(times, self.time_step * np.arange(len(self.speed)), self.speed)


def recording_files(path: Path) -> list[Path]:
    """Return the files at a path that may be recordings; raise `InputError` if there are none.

    The path is a file, a folder, or a pattern such as `drives/2021-03*`.
    """
    if path.is_file():
        return [path]
    folder, pattern = (path, "*") if path.is_dir() else (path.parent, path.name)
    if not folder.is_dir() or not WILDCARDS & {*pattern}:
        allowed = "a file with speeds, a folder of them, or a pattern like 'drives/2021-03*'"
        raise invalid_value("recordings", str(path), allowed)
    files = (file for file in folder.iterdir() if fnmatchcase(file.name, pattern) and file.is_file())
    recordings = sorted(file for file in files if file.suffix.lower() in FILE_SUFFIXES)
    if not recordings:
        endings, names = ", ".join(FILE_SUFFIXES), sorted(file.name for file in folder.iterdir())
        allowed = f"a folder or a pattern with at least one file that ends in {endings}"
        content = f"; {folder.name or '.'} has {shorten_list(names)}" if names else ""
        raise invalid_value("recordings", str(path), f"{allowed}{content}")
    return recordings
