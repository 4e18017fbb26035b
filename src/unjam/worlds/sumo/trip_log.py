"""The log of CAVs on a road with ends: each trip of a CAV is a trajectory."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.worlds.record import Trajectory, make_trajectory
from unjam.worlds.world import DriverLog

TRIPS_PER_PROGRESS = 500
"""trips that are processed between two reports of progress"""


class TripLog:
    """The CAVs on the road at each moment, their states, and their commands in the control step that follows."""

    def __init__(self) -> None:
        """Start without a moment."""
        self.cav_ids: list[Sequence[str]] = []
        self.states: list[LocalState] = []
        self.applied_accelerations: list[list[float]] = []
        """[m/s2]; this and the following lists have one entry per control step"""
        self.filter_brakings: list[list[float]] = []
        """reduction by the safety filter [m/s2]"""
        self.shield_brakings: list[list[float]] = []
        """braking that SUMO added [m/s2]"""

    def trajectories(
        self, driver_log: DriverLog, has_crashed: bool, on_progress: Callable[[], object]
    ) -> tuple[Trajectory, ...]:
        """Return the trips of at least one control step, in order of entry.

        `has_crashed`: a collision ended the episode. `on_progress` is called now and then.
        """
        trips = list[tuple[str, list[tuple[int, int]]]]()
        """vehicle, and its moments and rows; a teleported vehicle that is reinserted starts another trip"""
        latest = dict[str, list[tuple[int, int]]]()
        for time, names in enumerate(self.cav_ids):
            for row, name in enumerate(names):
                if name not in latest or latest[name][-1][0] < time - 1:
                    latest[name] = list[tuple[int, int]]()
                    trips.append((name, latest[name]))
                latest[name].append((time, row))
        states = list(zip(*self.states, strict=True))
        trajectories = list[Trajectory]()
        for number, (name, entries) in enumerate(trips):
            if number % TRIPS_PER_PROGRESS == 0:
                on_progress()
            start, steps = entries[0][0], len(entries) - 1
            if steps == 0:
                continue
            trajectories.append(
                make_trajectory(
                    vehicle=name,
                    entry_number=number,
                    start_step=start,
                    rows=np.array([row for _, row in entries]),
                    states=LocalState(*(_trip_values(values, entries) for values in states)),
                    applied_acceleration=_trip_values(self.applied_accelerations, entries[:-1]),
                    filter_braking=_trip_values(self.filter_brakings, entries[:-1]),
                    shield_braking=_trip_values(self.shield_brakings, entries[:-1]),
                    terminated=has_crashed and start + steps == len(self.applied_accelerations),
                    driver_log=driver_log,
                )
            )
        return tuple(trajectories)


def _trip_values(values: Sequence[Any], entries: Sequence[tuple[int, int]]) -> Any:
    """Return a CAV's values of one quantity at its moments and rows; None if the road does not provide it."""
    return None if values[0] is None else np.array([values[time][row] for time, row in entries])
