"""The log of all vehicles on a road with ends: speeds at every moment, and snapshots at the resolution of figures.

An hour of an on-ramp has 2,000 vehicles, a corridor 10,000, each on the road for a small part of the time. A table with
one column per vehicle would be 99 % empty: in large tables, vehicles of different times share a column.
"""

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.worlds.record import SHARED_COLUMN_FRAMES, assign_columns

MAX_SNAPSHOT_VEHICLES = 600_000
"""total number of vehicles in all snapshots: beyond it, only every second moment is kept, then every fourth, ..."""
MAX_UNSHARED_CELLS = 2_000_000
"""cells of a table with one column per vehicle; in larger tables columns are shared"""


class TrafficLog:
    """The vehicles on the road at each moment with their speeds, and snapshots at some moments."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.snapshot_stride = 1
        self._vehicle_numbers: dict[str, int] = {}
        self._current_numbers: NDArray[np.int32] = np.zeros(0, np.int32)
        self._numbers_by_moment: list[NDArray[np.int32]] = []
        self._speeds: list[Floats] = []
        self._snapshots: dict[int, dict[str, Any]] = {}
        self._snapshot_vehicle_count = 0

    def __len__(self) -> int:
        return len(self._numbers_by_moment)

    @property
    def vehicle_ids(self) -> tuple[str, ...]:
        """All vehicles, in order of entry."""
        return tuple(self._vehicle_numbers)

    def add(self, names: Sequence[str], speeds: Any) -> None:
        """Add a moment: the vehicles on the road, and their speeds [m/s]."""
        if names != self.names:  # rarely: otherwise both moments share an array
            self.names = list(names)
            for name in names:
                self._vehicle_numbers.setdefault(name, len(self._vehicle_numbers))
            self._current_numbers = np.array(list(map(self._vehicle_numbers.__getitem__, names)), np.int32)
        self._numbers_by_moment.append(self._current_numbers)
        self._speeds.append(np.array(speeds, np.float64))

    @property
    def needs_snapshot(self) -> bool:
        """Whether the last moment needs a snapshot."""
        return (len(self) - 1) % self.snapshot_stride == 0

    def add_snapshot(self, quantities: dict[str, Any]) -> None:
        """Add the snapshot of the last moment: quantities by name, each with values in the order of `names`."""
        self._snapshots[len(self) - 1] = quantities
        self._snapshot_vehicle_count += len(self.names)
        while self._snapshot_vehicle_count > MAX_SNAPSHOT_VEHICLES and len(self._snapshots) > 2:
            self.snapshot_stride *= 2
            self._snapshots = {time: each for time, each in self._snapshots.items() if time % self.snapshot_stride == 0}
            self._snapshot_vehicle_count = sum(len(self._numbers_by_moment[time]) for time in self._snapshots)

    def columns(self, groups: Sequence[Hashable]) -> NDArray[np.intp]:
        """Return a column for each vehicle, given the groups of vehicles that may share columns, in order of entry."""
        if len(self) * len(groups) <= MAX_UNSHARED_CELLS:
            return np.arange(len(groups))
        first, last = np.full(len(groups), len(self)), np.zeros(len(groups), int)
        for time, row in enumerate(self._numbers_by_moment):
            first[row], last[row] = np.minimum(first[row], time), time
        return assign_columns(first, last, groups, max(self.snapshot_stride, len(self) // SHARED_COLUMN_FRAMES))

    def speeds(self, columns: NDArray[np.intp]) -> Floats:
        """Return all speeds [m/s], shape (moments, columns); NaN without a vehicle."""
        return self._table(dict(enumerate(self._speeds)), columns)

    def snapshots(self, name: str, columns: NDArray[np.intp]) -> Floats:
        """Return a quantity of all snapshots, shape (snapshots, columns, ...); NaN without a vehicle."""
        return self._table({time: each[name] for time, each in self._snapshots.items()}, columns)

    def _table(self, values_by_moment: dict[int, Any], columns: NDArray[np.intp]) -> Floats:
        shape = next((np.shape(values)[1:] for values in values_by_moment.values()), ())
        table = np.full((len(values_by_moment), int(columns.max(initial=-1)) + 1, *shape), np.nan)
        for row, (time, values) in enumerate(values_by_moment.items()):
            table[row, columns[self._numbers_by_moment[time]]] = values
        return table
