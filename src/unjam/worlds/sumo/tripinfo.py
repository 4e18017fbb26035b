"""SUMO's trip records (`tripinfo-output`), which take no measurable time during a simulation."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from unjam.worlds.trips import Trips

NOT_ARRIVED = -1.0
"""SUMO's arrival time of a vehicle that has not arrived"""
TRIP_TIME_ATTRIBUTES = "departDelay", "duration", "timeLoss", "arrival"
"""attributes of a trip that are read [s]"""


def trip_options(path: Path) -> list[str]:
    """Return the options by which SUMO writes all trips to a file, including those that have not ended."""
    unfinished = ("--tripinfo-output.write-unfinished", "--tripinfo-output.write-undeparted")
    return ["--tripinfo-output", str(path), *(word for option in unfinished for word in (option, "true"))]


def read_trips(path: Path, vehicle_classes: dict[str, str], warmup_end: float) -> Trips:
    """Return the trips in a file that SUMO has closed, in SUMO's order.

    `vehicle_classes` has the vehicle class of each vehicle type. Trips that ended during the warm-up, which ends at
    `warmup_end` [s], and trips of vehicles that were to depart later are left out.
    """
    ids, kinds, times = list[str](), list[str](), list[list[float]]()
    for _, element in ElementTree.iterparse(path):
        trip = element.attrib
        if element.tag != "tripinfo" or NOT_ARRIVED < float(trip["arrival"]) <= warmup_end:
            continue
        if float(trip["depart"]) >= 0.0 or float(trip["departDelay"]) > 0.0:
            ids.append(trip["id"])
            kinds.append(_vehicle_class(trip["vType"], vehicle_classes))
            times.append([float(trip[name]) for name in TRIP_TIME_ATTRIBUTES])
        element.clear()
    depart_delay, duration, time_loss, arrival = np.array(times, np.float64).reshape(-1, len(TRIP_TIME_ATTRIBUTES)).T
    return Trips(tuple(ids), tuple(kinds), depart_delay, duration, time_loss, arrival != NOT_ARRIVED)


def _vehicle_class(kind: str, vehicle_classes: dict[str, str]) -> str:
    """Return the class of a type, or of the type of which `kind` is SUMO's copy for one vehicle: `type@vehicle`."""
    names = kind, kind.rpartition("@")[0], kind.partition("@")[0]
    return next((vehicle_classes[name] for name in names if name in vehicle_classes), "")
