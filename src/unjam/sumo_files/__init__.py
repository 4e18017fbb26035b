"""What the user's own SUMO files say, read before SUMO starts: SUMO crashes on some that are broken.

Such files may come from anywhere. So that none can harm who asks, `program.py` reads them in a process of its
own that `unjam.sandbox` limits, and answers one JSON document. What SUMO would write, and where it would
listen, is never passed on to it: see `copy_harmless`.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal, NamedTuple

from unjam import sandbox
from unjam.errors import InputError

PROGRAM = Path(__file__).with_name("program.py")
LARGEST_MEMORY = 4 * 2**30
"""bytes that reading may take"""
LONGEST_TIME = 120
"""seconds that reading may take"""

Lane = tuple[str, float, list[tuple[float, float]]]
"""edge, length [m] and centre line [(x, y), m]"""
PASSED = {
    *("begin", "end", "junction-taz", "weight-attribute", "step-method.ballistic", "extrapolate-departpos"),
    *("lateral-resolution", "route-steps", "no-internal-links", "ignore-junction-blocker"),
    *("ignore-route-errors", "ignore-accidents", "intermodal-collision.action", "collision.stoptime"),
    *("collision.action", "collision.mingap-factor", "collision.check-junctions"),
    *("intermodal-collision.stoptime", "collision.check-junctions.mingap", "keep-after-arrival"),
    *("max-num-vehicles", "max-num-persons", "max-num-teleports", "scale", "scale-suffix"),
    *("sloppy-insert", "eager-insert", "emergency-insert", "insertion-checks"),
    *("random-depart-offset", "waiting-time-memory", "startup-wait-threshold", "slope-centered"),
    *("time-to-impatience", "pedestrian.model", "pedestrian.timegap-crossing", "mesosim"),
    *("use-stop-ended", "use-stop-started", "routing-algorithm", "replay-rerouting", "time-to-teleport"),
}
"""options that only say how to simulate"""
PASSED_GROUPS = (
    *("time-to-teleport.", "lanechange.", "tls.", "railsignal.", "railsignal-moving-block", "default."),
    *("overhead-wire.", "emergencydecel.", "parking.", "pedestrian.striping.", "ride.", "mapmatch."),
    *("weights.", "persontrip.", "railway.", "device.rerouting.", "person-device.rerouting."),
    *("device.driverstate.", "device.bluelight.", "device.glosa.", "device.toc.", "device.taxi."),
    *("device.emissions.", "device.battery.", "device.friction.", "meso-"),
)
"""what the names of others of them begin with"""
OTHERWISE = {
    *("seed", "step-length", "no-step-log", "no-warnings", "aggregate-warnings", "verbose", "start"),
    *("duration-log.disable", "duration-log.statistics"),
    *("xml-validation", "xml-validation.net", "xml-validation.routes", "gui-settings-file", "quit-on-end"),
    *("delay", "precision", "step-log.period", "print-options", "human-readable-time", "registry-viewport"),
}
"""options that unjam decides itself, or that change nothing: of no interest where they are left out"""
FILED = ("file", "output", "threads")
"""what is in the names of options that belong to these groups and are harmful all the same"""


class SumoFiles(NamedTuple):
    """A .sumocfg file and what the files that it names hold."""

    path: Path
    network: Path
    additional_files: tuple[Path, ...]
    route_files: tuple[Path, ...]
    begin: float
    """[s]"""
    end: float | None
    """[s]; None: when the last vehicle has arrived"""
    step: float
    """[s]"""
    first_departure: float
    """the first time at which a vehicle departs or a flow begins [s]; 0 where only SUMO knows it"""
    options: dict[str, str]
    """what else SUMO may be told of it, by name: harmless ways of simulating"""
    dropped: tuple[str, ...]
    """what it is not told: options and elements that write, listen, or read other files"""
    to_copy: frozenset[Path]
    """files that SUMO gets a harmless copy of; it reads the others themselves"""
    types: dict[str, dict[str, str]]
    """attributes of all vehicle types, by id"""
    used_types: frozenset[str]
    """types that vehicles have"""


_known: dict[Path, tuple[dict[Path, tuple[int, int]], SumoFiles]] = {}
"""what was read already, with the stamps of all files that were read for it"""


def read_sumo_files(path: Path) -> SumoFiles:
    """Return what a .sumocfg file and the files that it names say; read again where one has changed.

    Raises:
        InputError: one is missing, broken or too large, the network has no version, or there are no
            vehicles.
    """
    if path in _known:
        stamps, files = _known[path]
        if all(file.is_file() and stamp_of(file) == before for file, before in stamps.items()):
            return files
    found = _ask("configuration", path)
    stamps = {Path(file): (time, size) for file, (time, size) in found.pop("stamps").items()}
    found["network"] = Path(found["network"])
    for name, kind in {"additional_files": tuple, "route_files": tuple, "to_copy": frozenset}.items():
        found[name] = kind(map(Path, found[name]))
    found["used_types"] = frozenset(found["used_types"])
    options = found["options"]
    found["options"] = {name: value for name, value in options.items() if is_passed(name)}
    found["dropped"] = (*(f"option {name}" for name in options if is_missed(name)), *found["dropped"])
    files = SumoFiles(path, **found)
    _known[path] = stamps, files
    return files


def read_lanes(path: Path) -> list[Lane]:
    """Return all lanes of a network file.

    Raises:
        InputError: it is broken, or too large.
    """
    lanes = _ask("lanes", path)
    return [(edge, length, [(x, y) for x, y in line]) for edge, length, line in lanes]


def copy_harmless(path: Path, copy: Path, types: Path | None = None) -> None:
    """Write one of SUMO's files again without what makes SUMO write a file, listen, or read another file.

    Vehicle types get the attributes that a JSON file `types` has for them, by id.

    Raises:
        InputError: it is broken, or too large.
    """
    _ask("copy", path, copy, *([types] if types else []))


def stamp_of(file: Path) -> tuple[int, int]:
    """Return time of change and size of a file: another content has another stamp."""
    found = file.stat()
    return found.st_mtime_ns, found.st_size


def _ask(command: Literal["configuration", "lanes", "copy"], path: Path, *more: Path) -> Any:
    """Return what the program answers; raise `InputError` where it says what is wrong, or is lost."""
    limits = [str(LARGEST_MEMORY), str(LONGEST_TIME), str(more[0].parent) if more else ""]
    program = [sys.executable, "-I", "-S", sandbox.__file__, *limits, str(PROGRAM), command]
    try:
        done = subprocess.run(
            [*program, str(path), *map(str, more)], capture_output=True, timeout=LONGEST_TIME, check=False
        )
        answer = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        limits = f"{LARGEST_MEMORY / 2**30:g} GiB, {LONGEST_TIME:g} s"
        raise InputError(f"{path.name}: its files cannot be read within {limits}") from None
    if "broken" in answer:
        raise InputError(answer["broken"])
    return answer["found"]


def is_passed(name: str) -> bool:
    """Return whether SUMO may be told an option: it only says how to simulate."""
    return name in PASSED or (name.startswith(PASSED_GROUPS) and not any(word in name for word in FILED))


def is_missed(name: str) -> bool:
    """Return whether it matters that SUMO is not told an option."""
    return not is_passed(name) and name not in OTHERWISE
