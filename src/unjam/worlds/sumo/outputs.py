"""SUMO's output: trip records (`tripinfo-output`, which take no measurable time), and warnings in its error log."""

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
TRIP_ATTRIBUTES = "departDelay", "duration", "timeLoss", "arrival", "departSpeed"
"""attributes of a trip that are read [s, m/s]"""
MIN_NOTED_DELAY, MIN_NOTED_VEHICLES = 2.0, 10
"""mean insertion delay [s] and number of vehicles from which an entrance is slow"""
FREE_SPEED_SHARE = 0.8
"""share of the speed limit from which vehicles depart into free traffic"""
MAX_LOG_BYTES = 2**20
"""bytes of a log that are read; SUMO writes one example and one total for most kinds"""
MAX_EXAMPLE_LENGTH = 300
MAX_EXAMPLES_OPTION = "1"
"""value of SUMO's option aggregate-warnings: further messages of a kind are only counted"""
_TOTAL_PATTERN = re.compile(rf"(\d{{1,12}}) {MESSAGE_TOTAL_MARKER} (.*)")
_VARIABLE_PATTERN = re.compile(r"'[^']*'|(?<==)[^\s,;]*[^\s,;.!]|[-+]?\b\d+(?:\.\d+)?\b")
"""variable parts of the messages of a kind: quoted names, values after =, and numbers"""
SEPARATELY_COUNTED = re.compile(
    r"Teleporting vehicle|ends teleporting|teleports beyond|collision with|performs emergency braking"
)
"""messages about teleports, collisions and hard braking, which unjam counts itself"""


def trip_options(path: Path) -> list[str]:
    """Return the options by which SUMO writes all trips to a file, including those that have not ended."""
    unfinished = (word for option in UNFINISHED_TRIPS_OPTIONS for word in (option, "true"))
    return ["--tripinfo-output", str(path), *unfinished]


def read_trips(
    path: Path, vehicle_classes: dict[str, str], warmup_end: float, end: float = 0.0, removes_jammed: bool = False
) -> Trips:
    """Return the trips in a file that SUMO has closed, except those that ended by `warmup_end` [s] or depart later.

    A vehicle that SUMO removed from a collision or a jam (`removes_jammed`: instead of teleporting it) has not arrived:
    its trip counts until `end` [s], or that of the last one in the file. `vehicle_classes` has the vehicle class of
    each vehicle type. Raise `DiskError` if the file is not complete.
    """
    ids, kinds, entrances, times = list[str](), list[str](), list[str](), list[list[float]]()
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
                kinds.append(find_vehicle_class(trip["vType"], vehicle_classes))
                entrances.append(trip["departLane"].rpartition("_")[0])
                times.append([float(trip[name]) for name in TRIP_ATTRIBUTES])
                reason, speed = trip.get("vaporized"), float(trip["arrivalSpeed"])
                # SUMO gives the same reason to vehicles that it teleports to the end of their route.
                is_jammed = removes_jammed and reason == "teleport" and speed <= HALTING_SPEED
                removed.append(reason == "collision" or is_jammed)
            element.clear()
    except ElementTree.ParseError:
        raise DiskError(f"SUMO has not written {path.name} whole; allowed: space in {path.parent}") from None
    delay, duration, time_loss, arrival, speed = np.array(times, np.float64).reshape(-1, len(TRIP_ATTRIBUTES)).T
    is_removed = np.array(removed, bool)
    rest = np.where(is_removed, end - arrival, 0.0)
    duration, time_loss, has_arrived = duration + rest, time_loss + rest, (arrival != NOT_ARRIVED) & ~is_removed
    return Trips(tuple(ids), tuple(kinds), delay, duration, time_loss, has_arrived, tuple(entrances), speed)


def find_slow_entrances(trips: Trips, speed_limits: dict[str, float]) -> tuple[SlowEntrance, ...]:
    """Return the edges on which vehicles wait for their insertion, but depart near the speed limit or all equally fast.

    In a jam, vehicles depart slowly, and with different speeds. `speed_limits` has those of the edges [m/s].
    """
    found = list[SlowEntrance]()
    for edge in sorted(set(trips.entrances) - {""}):
        is_here = np.array(trips.entrances) == edge
        delay, speeds = float(trips.depart_delay[is_here].mean()), trips.depart_speed[is_here]
        is_free = speeds.mean() >= FREE_SPEED_SHARE * speed_limits.get(edge, inf) or np.ptp(speeds) == 0.0
        if delay >= MIN_NOTED_DELAY and len(speeds) >= MIN_NOTED_VEHICLES and is_free:
            found.append(SlowEntrance(edge, len(speeds), delay, float(speeds.mean())))
    return tuple(found)


def find_vehicle_class(kind: str, vehicle_classes: dict[str, str]) -> str:
    """Return the class of a type, or of the type of which `kind` is SUMO's copy for one vehicle: `type@vehicle`."""
    names = kind, kind.rpartition("@")[0], kind.partition("@")[0]
    return next((vehicle_classes[name] for name in names if name in vehicle_classes), "")


def read_warnings(log_path: Path) -> tuple[SumoWarning, ...]:
    """Return warnings and errors in a closed log that unjam does not count itself; raise `EpisodeError` without it."""
    try:
        with log_path.open(errors="replace") as file:
            text = file.read(MAX_LOG_BYTES)
            text = text.rpartition("\n")[0] if file.read(1) else text  # without an incomplete message
    except OSError as error:
        raise EpisodeError(f"SUMO's warnings cannot be read: {error.strerror}") from error
    messages = re.findall(r"^(?:Warning|Error): (.*(?:\n(?!Warning:|Error:).*)*)", text, re.MULTILINE)
    examples, counts = dict[str, str](), Counter[str]()
    totals = list[tuple[int, str]]()
    for message in (" ".join(each.split()) for each in messages):
        if total := _TOTAL_PATTERN.fullmatch(message):
            totals.append((int(total[1]), total[2]))
        elif not SEPARATELY_COUNTED.search(message):
            kind = warning_kind(message)
            examples.setdefault(kind, message)
            counts[kind] += 1
    for count, form in totals:  # includes the example
        pattern = "*".join(map(glob.escape, form.split("%")))  # matched without backtracking
        for kind in [kind for kind, message in examples.items() if fnmatchcase(message, pattern)][:1]:
            counts[kind] += count - 1
    return tuple(SumoWarning(kind, message[:MAX_EXAMPLE_LENGTH], counts[kind]) for kind, message in examples.items())


def warning_kind(message: str) -> str:
    """Return a message with the placeholder % instead of quoted names, values and numbers."""
    return _VARIABLE_PATTERN.sub(lambda match: "'%'" if match[0].startswith("'") else "%", message)
