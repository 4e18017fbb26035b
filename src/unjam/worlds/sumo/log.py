"""What a road with ends keeps of who comes and goes: all speeds, and pictures as fine as anybody can see.

An on-ramp's hour has two thousand vehicles, a corridor ten thousands, each there for a few of all moments. A
table with a column for each would be empty but for a hundredth: where it would be large, those who are never
there together share a column.
"""

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.worlds.record import FRAMES, shared_columns

MOST_PICTURED = 600_000
"""vehicles at moments of which pictures are kept: of more, those of every second moment alone, then of every
fourth, and so on"""
MOST_CELLS = 2_000_000
"""cells of a table with a column for each vehicle; of larger ones columns are shared"""


class TrafficLog:
    """Who was on the road at each moment, and how fast; now and then also where."""

    def __init__(self) -> None:
        """Begin with no moment."""
        self.names: list[str] = []
        """who is there at the last moment that was noted"""
        self.every = 1
        """pictures are kept of every so many-th moment"""
        self._numbers: dict[str, int] = {}
        """of the vehicles, in order of entry"""
        self._row: NDArray[np.int32] = np.zeros(0, np.int32)
        self._rows: list[NDArray[np.int32]] = []
        self._speeds: list[Floats] = []
        self._pictures: dict[int, dict[str, Any]] = {}
        self._pictured = 0

    def __len__(self) -> int:
        """Return how many moments there are."""
        return len(self._rows)

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Whoever was there, in order of entry."""
        return tuple(self._numbers)

    def note(self, names: Sequence[str], speeds: Any) -> None:
        """Note the next moment: who is on the road, and how fast [m/s]."""
        if names != self.names:  # seldom: otherwise both moments share what says who is there
            self.names = list(names)
            for name in names:
                if name not in self._numbers:
                    self._numbers[name] = len(self._numbers)
            self._row = np.array(list(map(self._numbers.__getitem__, names)), np.int32)
        self._rows.append(self._row)
        self._speeds.append(np.array(speeds, np.float64))

    @property
    def is_pictured(self) -> bool:
        """Whether pictures are to be kept of the moment that was noted last."""
        return (len(self) - 1) % self.every == 0

    def picture(self, quantities: dict[str, Any]) -> None:
        """Keep what pictures show of the last moment: by name, of each vehicle in the order of `names`."""
        self._pictures[len(self) - 1] = quantities
        self._pictured += len(self.names)
        while self._pictured > MOST_PICTURED and len(self._pictures) > 2:
            self.every *= 2
            self._pictures = {time: each for time, each in self._pictures.items() if time % self.every == 0}
            self._pictured = sum(len(self._rows[time]) for time in self._pictures)

    def columns(self, groups: Sequence[Hashable]) -> NDArray[np.intp]:
        """Return a column for each vehicle; who shares one is of the same group, and never there with others.

        `groups` are those of the vehicles, in order of entry.
        """
        if len(self) * len(groups) <= MOST_CELLS:
            return np.arange(len(groups))
        first, last = np.full(len(groups), len(self)), np.zeros(len(groups), int)
        for time, row in enumerate(self._rows):
            first[row], last[row] = np.minimum(first[row], time), time
        return shared_columns(first, last, groups, max(self.every, len(self) // FRAMES))

    def speeds(self, columns: NDArray[np.intp]) -> Floats:
        """Return all speeds [m/s], shape (moments, columns); NaN where nobody is."""
        table = np.full((len(self), int(columns.max(initial=-1)) + 1), np.nan)
        for time, (row, speeds) in enumerate(zip(self._rows, self._speeds, strict=True)):
            table[time, columns[row]] = speeds
        return table

    def pictures(self, name: str, columns: NDArray[np.intp]) -> Floats:
        """Return a quantity of the pictured moments, shape (moments, columns, ...); NaN where nobody is."""
        shape = next((np.shape(each[name])[1:] for each in self._pictures.values()), ())
        table = np.full((len(self._pictures), int(columns.max(initial=-1)) + 1, *shape), np.nan)
        for number, (time, quantities) in enumerate(self._pictures.items()):
            table[number, columns[self._rows[time]]] = quantities[name]
        return table
