"""Trips on a road with ends, as in SUMO's own trip records."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats

VEHICLE_GROUPS = {
    "cars": ("passenger", "private", "hov", "taxi", "evehicle", "custom1", "custom2"),
    "trucks": ("truck", "trailer", "delivery"),
    "buses": ("bus", "coach"),
}
"""SUMO's vehicle classes by group; travel times are reported for each group"""


@dataclass(frozen=True)
class Trips:
    """The trips of all n vehicles that were to depart in an episode; arrays have shape (n,).

    A trip that has not ended counts with its duration so far. Source:
    https://sumo.dlr.de/docs/Simulation/Output/TripInfo.html
    """

    vehicle_ids: tuple[str, ...] = ()
    vehicle_classes: tuple[str, ...] = ()
    depart_delay: Floats = field(default_factory=lambda: np.zeros(0))
    """time that each vehicle waited for its insertion, `departDelay` [s]"""
    duration: Floats = field(default_factory=lambda: np.zeros(0))
    """time since insertion [s]; 0 of a vehicle that was not inserted"""
    time_loss: Floats = field(default_factory=lambda: np.zeros(0))
    """time lost by driving below the desired speed, `timeLoss` [s]"""
    has_arrived: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    @property
    def delay(self) -> Floats:
        """Delay of each trip: `timeLoss` plus `departDelay` [s]."""
        return self.time_loss + self.depart_delay

    @property
    def travel_time(self) -> Floats:
        """Travel time of each trip, including the time that the vehicle waited for its insertion [s]."""
        return self.duration + self.depart_delay

    def mean_travel_time(self, group: str) -> float:
        """Return the mean travel time of a group of `VEHICLE_GROUPS` [s]; NaN if it has no vehicles."""
        is_in_group = np.isin(self.vehicle_classes, VEHICLE_GROUPS[group])
        return float(self.travel_time[is_in_group].mean()) if is_in_group.any() else float("nan")
