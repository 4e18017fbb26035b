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
from unjam.worlds.record import SHARED_COLUMN_FRAMES, assign_columns

MAX_SNAPSHOT_VEHICLES = 600_000
"""vehicles at moments of which pictures are kept: of more, those of every second moment alone, then of every
fourth, and so on"""
MAX_UNSHARED_CELLS = 2_000_000
"""cells of a table with a column for each vehicle; of larger ones columns are shared"""


class TrafficLog:
    """Who was on the road at each moment, and how fast; now and then also where."""

    def __init__(self) -> None:
        """Begin with no moment."""
        self.names: list[str] = []
        """who is there at the last moment that was noted"""
        self.snapshot_stride = 1
        """pictures are kept of every so many-th moment"""
        self._vehicle_numbers: dict[str, int] = {}
        """of the vehicles, in order of entry"""
        self._current_numbers: NDArray[np.int32] = np.zeros(0, np.int32)
        self._numbers_by_moment: list[NDArray[np.int32]] = []
        self._speeds: list[Floats] = []
        self._snapshots: dict[int, dict[str, Any]] = {}
        self._snapshot_vehicle_count = 0

    def __len__(self) -> int:
        """Return how many moments there are."""
        return len(self._numbers_by_moment)

    @property
    def vehicle_ids(self) -> tuple[str, ...]:
        """Whoever was there, in order of entry."""
        return tuple(self._vehicle_numbers)

    def add(self, names: Sequence[str], speeds: Any) -> None:
        """Note the next moment: who is on the road, and how fast [m/s]."""
        if names != self.names:  # seldom: otherwise both moments share what says who is there
            self.names = list(names)
            for name in names:
                if name not in self._vehicle_numbers:
                    self._vehicle_numbers[name] = len(self._vehicle_numbers)
            self._current_numbers = np.array(list(map(self._vehicle_numbers.__getitem__, names)), np.int32)
        self._numbers_by_moment.append(self._current_numbers)
        self._speeds.append(np.array(speeds, np.float64))

    @property
    def needs_snapshot(self) -> bool:
        """Whether pictures are to be kept of the moment that was noted last."""
        return (len(self) - 1) % self.snapshot_stride == 0

    def add_snapshot(self, quantities: dict[str, Any]) -> None:
        """Keep what pictures show of the last moment: by name, of each vehicle in the order of `names`."""
        self._snapshots[len(self) - 1] = quantities
        self._snapshot_vehicle_count += len(self.names)
        while self._snapshot_vehicle_count > MAX_SNAPSHOT_VEHICLES and len(self._snapshots) > 2:
            self.snapshot_stride *= 2
            self._snapshots = {time: each for time, each in self._snapshots.items() if time % self.snapshot_stride == 0}
            self._snapshot_vehicle_count = sum(len(self._numbers_by_moment[time]) for time in self._snapshots)

    def columns(self, groups: Sequence[Hashable]) -> NDArray[np.intp]:
        """Return a column for each vehicle; who shares one is of the same group, and never there with others.

        `groups` are those of the vehicles, in order of entry.
        """
        if len(self) * len(groups) <= MAX_UNSHARED_CELLS:
            return np.arange(len(groups))
        first, last = np.full(len(groups), len(self)), np.zeros(len(groups), int)
        for time, row in enumerate(self._numbers_by_moment):
            first[row], last[row] = np.minimum(first[row], time), time
        return assign_columns(first, last, groups, max(self.snapshot_stride, len(self) // SHARED_COLUMN_FRAMES))

    def speeds(self, columns: NDArray[np.intp]) -> Floats:
        """Return all speeds [m/s], shape (moments, columns); NaN where nobody is."""
        table = np.full((len(self), int(columns.max(initial=-1)) + 1), np.nan)
        for time, (row, speeds) in enumerate(zip(self._numbers_by_moment, self._speeds, strict=True)):
            table[time, columns[row]] = speeds
        return table

    def snapshots(self, name: str, columns: NDArray[np.intp]) -> Floats:
        """Return a quantity of the pictured moments, shape (moments, columns, ...); NaN where nobody is."""
        shape = next((np.shape(each[name])[1:] for each in self._snapshots.values()), ())
        table = np.full((len(self._snapshots), int(columns.max(initial=-1)) + 1, *shape), np.nan)
        for number, (time, quantities) in enumerate(self._snapshots.items()):
            table[number, columns[self._numbers_by_moment[time]]] = quantities[name]
        return table
