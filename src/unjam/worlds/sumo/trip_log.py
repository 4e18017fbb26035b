"""What a road with ends keeps of its CAVs: each stay of one is a trajectory of its own."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.worlds.record import Trajectory, make_trajectory
from unjam.worlds.world import DriverLog

TRIPS_PER_PROGRESS = 500
"""stays that are put in order between two signs of life"""


class TripLog:
    """Which CAVs were there at each moment, what they perceived, and what they were told after it."""

    def __init__(self) -> None:
        """Begin with no moment."""
        self.cav_ids: list[Sequence[str]] = []
        self.states: list[LocalState] = []
        self.applied_accelerations: list[list[float]] = []
        """[m/s2]; this and the next of each decision, one less than moments"""
        self.filter_brakings: list[list[float]] = []
        """what the safety filter took from it [m/s2]"""
        self.shield_brakings: list[list[float]] = []
        """braking that SUMO added to it [m/s2]"""

    def trajectories(
        self, driver_log: DriverLog, has_crashed: bool, on_progress: Callable[[], object]
    ) -> tuple[Trajectory, ...]:
        """Return the stays of at least one decision, in order of entry.

        `driven` is all that the driver decided, `crashed` whether a collision ended the episode; `on_stay` is
        called now and then.
        """
        stays = list[tuple[str, list[tuple[int, int]]]]()
        """of whom each is, and moment and row: one that SUMO lifts off the road and puts back has several"""
        newest = dict[str, list[tuple[int, int]]]()
        for time, names in enumerate(self.cav_ids):
            for row, name in enumerate(names):
                if name not in newest or newest[name][-1][0] < time - 1:
                    newest[name] = list[tuple[int, int]]()
                    stays.append((name, newest[name]))
                newest[name].append((time, row))
        states = list(zip(*self.states, strict=True))
        found = []
        for number, (name, places) in enumerate(stays):
            if number % TRIPS_PER_PROGRESS == 0:
                on_progress()
            start, steps = places[0][0], len(places) - 1
            if steps == 0:
                continue
            found.append(
                make_trajectory(
                    vehicle=name,
                    entry_number=number,
                    start_step=start,
                    rows=np.array([row for _, row in places]),
                    states=LocalState(*(_trip_values(values, places) for values in states)),
                    applied_acceleration=_trip_values(self.applied_accelerations, places[:-1]),
                    filter_braking=_trip_values(self.filter_brakings, places[:-1]),
                    shield_braking=_trip_values(self.shield_brakings, places[:-1]),
                    terminated=has_crashed and start + steps == len(self.applied_accelerations),
                    driver_log=driver_log,
                )
            )
        return tuple(found)


def _trip_values(values: Sequence[Any], entries: Sequence[tuple[int, int]]) -> Any:
    """Return what a CAV was told of one quantity at its moments and rows; None where the road offers none."""
    return None if values[0] is None else np.array([values[time][row] for time, row in entries])
