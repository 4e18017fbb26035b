"""Recorded speeds of vehicles that others follow, and the files that have them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from unjam.errors import invalid_value
from unjam.physics.arrays import Floats
from unjam.recordings.trajectories import even_times

FILE_SUFFIXES = (".csv", ".txt", ".tsv", ".parquet", ".xml", ".gz")


@dataclass(frozen=True, eq=False)
class LeaderRecording:
    """Speeds of one vehicle at equal intervals: T samples."""

    name: str
    time_step: float
    """time between two samples [s]"""
    speed: Floats = field(repr=False)
    """[m/s], shape (T,)"""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.time_step * (len(self.speed) - 1)

    def speeds_at(self, start: float, seconds: float, step: float) -> Floats:
        """Return speeds from `start` on, every `step` for at most `seconds` [s], between samples interpolated [m/s]."""
        times = start + even_times(min(seconds, self.seconds - start), step)
        return np.interp(times, self.time_step * np.arange(len(self.speed)), self.speed)


def recording_files(path: Path) -> list[Path]:
    """Return the files of a folder that can be recordings, ordered by name; or the file itself.

    Raise `InputError` if there is none.
    """
    if not path.is_dir():
        if not path.is_file():
            raise invalid_value("recordings", str(path), "a file with speeds, or a folder of them")
        return [path]
    found = sorted(each for each in path.iterdir() if each.suffix.lower() in FILE_SUFFIXES and each.is_file())
    if not found:
        raise invalid_value("recordings", str(path), f"a folder with files that end in {', '.join(FILE_SUFFIXES)}")
    return found
