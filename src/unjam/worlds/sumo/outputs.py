"""Read SUMO's output: trip records (`tripinfo-output`, which takes no measurable time), and warnings in its log."""

import glob
import re
from collections import Counter
from fnmatch import fnmatchcase
from math import inf
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from unjam.errors import DiskError, EpisodeError
from unjam.physics.kinematics import HALTING_SPEED
from unjam.scenarios.user_network import UNFINISHED_TRIPS_OPTIONS
from unjam.worlds.record import SlowEntrance, SumoWarning, Trips
from unjam.worlds.sumo.networks import MESSAGE_TOTAL_MARKER

NOT_ARRIVED = -1.0
"""arrival time of a trip that has not ended"""
TRIP_ATTRIBUTES = "departDelay", "duration", "timeLoss", "arrival", "departSpeed"
"""attributes of a trip that unjam reads [s, m/s]"""
MIN_NOTED_DELAY, MIN_NOTED_VEHICLES = 2.0, 10
"""minimum mean insertion delay [s] and minimum number of vehicles of a slow entrance"""
FREE_SPEED_SHARE = 0.8
"""minimum share of the speed limit at which vehicles depart into free traffic"""
MAX_LOG_BYTES = 2**20
"""maximum number of bytes that are read of a log; SUMO writes one example and one total for most kinds of messages"""
MAX_EXAMPLE_LENGTH = 300
"""maximum number of letters of the example of a warning"""
MAX_EXAMPLES_OPTION = "1"
"""value of SUMO's option aggregate-warnings: SUMO only counts further messages of a kind"""
_TOTAL_PATTERN = re.compile(rf"(\d{{1,12}}) {MESSAGE_TOTAL_MARKER} (.*)")
_VARIABLE_PATTERN = re.compile(r"'[^']*'|(?<==)[^\s,;]*[^\s,;.!]|[-+]?\b\d+(?:\.\d+)?\b")
"""parts in which messages of one kind differ: quoted names, values after =, and numbers"""
SEPARATELY_COUNTED = re.compile(
    r"Teleporting vehicle|ends teleporting|teleports beyond|collision with|performs emergency braking"
)
"""messages about events that unjam counts itself: teleports, collisions and hard braking"""


def trip_options(path: Path) -> list[str]:
    """Return the options by which SUMO writes all trips to a file, including unfinished ones."""
    unfinished_options = (word for option in UNFINISHED_TRIPS_OPTIONS for word in (option, "true"))
    return ["--tripinfo-output", str(path), *unfinished_options]


def read_trips(
    path: Path, vehicle_classes: dict[str, str], warmup_end: float, end: float = 0.0, removes_jammed: bool = False
) -> Trips:
    """Return the trips in a file that SUMO has closed, except those that ended by `warmup_end` [s] or begin later.

    A vehicle that SUMO removed after a collision or, if `removes_jammed`, out of a jam has not arrived. Its trip lasts
    until `end` [s], or the end of the last trip in the file if later. `vehicle_classes` has the vehicle class of each
    vehicle type. Raise `DiskError` if the file is not complete.
    """
    ids, classes, entrances, rows = list[str](), list[str](), list[str](), list[list[float]]()
    removed = list[bool]()
    try:
        for _, element in ElementTree.iterparse(path):
            trip = element.attrib
            if element.tag == "tripinfo":
                end = max(end, float(trip["depart"]) + float(trip["duration"]))
            if element.tag != "tripinfo" or NOT_ARRIVED < float(trip["arrival"]) <= warmup_end:
                continue
            if float(trip["depart"]) >= 0.0 or float(trip["departDelay"]) > 0.0:
                ids.append(trip["id"])
                classes.append(find_vehicle_class(trip["vType"], vehicle_classes))
                entrances.append(trip["departLane"].rpartition("_")[0])
                rows.append([float(trip[name]) for name in TRIP_ATTRIBUTES])
                reason, speed = trip.get("vaporized"), float(trip["arrivalSpeed"])
                # Vehicles that SUMO teleports to the end of their route have the same reason.
                is_jammed = removes_jammed and reason == "teleport" and speed <= HALTING_SPEED
                removed.append(reason == "collision" or is_jammed)
            element.clear()
    except ElementTree.ParseError:
        raise DiskError(f"SUMO could not write all of {path.name}; allowed: space in {path.parent}") from None
    delay, duration, time_loss, arrival, speed = np.array(rows, np.float64).reshape(-1, len(TRIP_ATTRIBUTES)).T
    is_removed = np.array(removed, bool)
    waiting = np.where(is_removed, end - arrival, 0.0)
    duration, time_loss, has_arrived = duration + waiting, time_loss + waiting, (arrival != NOT_ARRIVED) & ~is_removed
    return Trips(tuple(ids), tuple(classes), delay, duration, time_loss, has_arrived, tuple(entrances), speed)


def find_slow_entrances(trips: Trips, speed_limits: dict[str, float]) -> tuple[SlowEntrance, ...]:
    """Return the edges on which vehicles wait for their insertion although there is no jam.

    Then vehicles depart near the speed limit or all equally fast; in a jam, they depart slowly and with different
    speeds. `speed_limits` are the speed limits of the edges [m/s].
    """
    slow_entrances = list[SlowEntrance]()
    for edge in sorted(set(trips.entrances) - {""}):
        departs_here = np.array(trips.entrances) == edge
        delay, speeds = float(trips.depart_delay[departs_here].mean()), trips.depart_speed[departs_here]
        is_free = speeds.mean() >= FREE_SPEED_SHARE * speed_limits.get(edge, inf) or np.ptp(speeds) == 0.0
        if delay >= MIN_NOTED_DELAY and len(speeds) >= MIN_NOTED_VEHICLES and is_free:
            slow_entrances.append(SlowEntrance(edge, len(speeds), delay, float(speeds.mean())))
    return tuple(slow_entrances)


def find_vehicle_class(type_id: str, vehicle_classes: dict[str, str]) -> str:
    """Return the class of a vehicle type, or of SUMO's copy `type@vehicle` for one vehicle; empty if it is unknown."""
    names = type_id, type_id.rpartition("@")[0], type_id.partition("@")[0]
    return next((vehicle_classes[name] for name in names if name in vehicle_classes), "")


def read_warnings(log_path: Path) -> tuple[SumoWarning, ...]:
    """Return the warnings and errors in a closed log, except `SEPARATELY_COUNTED`; `EpisodeError` without a log."""
    try:
        with log_path.open(errors="replace") as file:
            text = file.read(MAX_LOG_BYTES)
            text = text.rpartition("\n")[0] if file.read(1) else text  # without an incomplete last line
    except OSError as error:
        raise EpisodeError(f"SUMO's warnings cannot be read: {error.strerror}") from error
    messages = re.findall(r"^(?:Warning|Error): (.*(?:\n(?!Warning:|Error:).*)*)", text, re.MULTILINE)
    examples, counts = dict[str, str](), Counter[str]()
    totals = list[tuple[int, str]]()
    for message in (" ".join(lines.split()) for lines in messages):
        if total := _TOTAL_PATTERN.fullmatch(message):
            totals.append((int(total[1]), total[2]))
        elif not SEPARATELY_COUNTED.search(message):
            kind = warning_kind(message)
            examples.setdefault(kind, message)
            counts[kind] += 1
    for count, template in totals:  # the count includes the example
        pattern = "*".join(map(glob.escape, template.split("%")))  # fnmatch matches it without backtracking
        for kind in [kind for kind, message in examples.items() if fnmatchcase(message, pattern)][:1]:
            counts[kind] += count - 1
    return tuple(SumoWarning(kind, message[:MAX_EXAMPLE_LENGTH], counts[kind]) for kind, message in examples.items())


def warning_kind(message: str) -> str:
    """Return the kind of a message: its text with % instead of quoted names, values and numbers."""
    return _VARIABLE_PATTERN.sub(lambda match: "'%'" if match[0].startswith("'") else "%", message)
