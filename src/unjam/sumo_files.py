"""What the user's own SUMO files say, read before SUMO starts: SUMO crashes on some that are broken.

Such files may come from anywhere. So that none can harm who asks, this file is also the program that reads
them, in a process of its own with limits on memory and time, which answers one JSON document. As a program it
uses Python's own library alone, and starts in a twentieth of a second.
"""

import gzip
import json
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import isfinite, nan
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of vehicles that name none"""
OTHER_DEFAULT_TYPES = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail"}
"""vehicle classes of SUMO's other types that no file need define"""
DEMAND = ("vehicle", "trip", "flow")
UNITS = (1.0, 60.0, 3600.0, 86400.0)
"""seconds, minutes, hours and days [s]: SUMO's times may be 1:30:00"""
CHUNK = 65_536
"""bytes read at once"""
SYNONYMS = {"net": "net-file", "routes": "route-files", "additional": "additional-files"}


LARGEST_MEMORY = 4 * 2**30
"""bytes that reading may take"""
LONGEST_TIME = 120
"""seconds that reading may take"""

Lane = tuple[str, float, list[tuple[float, float]]]
"""edge, length [m] and centre line [(x, y), m]"""


class SumoFiles(NamedTuple):
    """A .sumocfg file and what the files that it names hold."""

    path: Path
    network: Path
    additional_files: tuple[Path, ...]
    begin: float
    """[s]"""
    end: float | None
    """[s]; None: when the last vehicle has arrived"""
    step: float
    """[s]"""
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
        if all(file.is_file() and _stamp(file) == before for file, before in stamps.items()):
            return files
    found = _ask("configuration", path)
    stamps = {Path(file): (time, size) for file, (time, size) in found.pop("stamps").items()}
    found["network"] = Path(found["network"])
    found["additional_files"] = tuple(map(Path, found["additional_files"]))
    found["used_types"] = frozenset(found["used_types"])
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


def _ask(command: Literal["configuration", "lanes"], path: Path) -> Any:
    """Return what the program answers; raise `InputError` where it says what is wrong, or is lost."""
    from unjam.errors import InputError  # the program has no packages

    program = [sys.executable, "-I", "-S", __file__, command, str(path)]
    try:
        done = subprocess.run(
            [*program, str(LARGEST_MEMORY), str(LONGEST_TIME)],
            capture_output=True,
            timeout=LONGEST_TIME,
            check=False,
        )
        answer = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        limits = f"{LARGEST_MEMORY / 2**30:g} GiB, {LONGEST_TIME:g} s"
        raise InputError(f"{path.name}: its files cannot be read within {limits}") from None
    if "broken" in answer:
        raise InputError(answer["broken"])
    return answer["found"]


# From here on: the program.


class Broken(Exception):
    """What is wrong with a file, in one line."""


def _configuration(path: Path) -> dict[str, Any]:
    """Return what a .sumocfg file and the files that it names say, as JSON; the fields of `SumoFiles`.

    Raises:
        Broken: one is missing or broken, the network has no version, or there are no vehicles.
    """
    if not path.is_file():
        raise Broken(f"{str(path)!r}: there is no such file")
    options = {
        SYNONYMS.get(element.tag, element.tag): element.get("value", "")
        for element in _elements(path, "end")
        if element.get("value") is not None
    }
    if not options.get("net-file"):
        raise Broken(f"{path.name}: names no net-file")
    network = path.parent / options["net-file"]
    additional, routes = (
        [path.parent / name for name in options.get(files, "").replace(",", " ").split()]
        for files in ("additional-files", "route-files")
    )
    files = [path, network, *additional, *routes]
    for file in files:
        if not file.is_file():
            raise Broken(f"{str(file)!r}: there is no such file")
    stamps = {str(file): _stamp(file) for file in files}
    _check_network(network)
    demand = _Demand({}, {}, set())
    for file in [*additional, *routes]:
        _read_demand(file, demand)
    if not demand.wanted:
        raise Broken(f"{path.name}: its route and additional files have no vehicle, trip or flow")
    used = set().union(*(demand.mixtures.get(name, {name}) for name in demand.wanted))
    demand.types.setdefault(DEFAULT_TYPE, {})
    for name, kind in OTHER_DEFAULT_TYPES.items():
        if name in used:
            demand.types.setdefault(name, {"vClass": kind})
    begin = _seconds(path, options, "begin", 0.0) or 0.0
    end = _seconds(path, options, "end", None)
    if end is not None and end <= begin:
        raise Broken(f"{path.name}: end: {end:g} s is not allowed; allowed: after begin, {begin:g} s")
    return {
        "network": str(network),
        "additional_files": [str(file) for file in additional],
        "begin": begin,
        "end": end,
        "step": _seconds(path, options, "step-length", 1.0) or 1.0,
        "types": demand.types,
        "used_types": sorted(used),
        "stamps": stamps,
    }


def _lanes(path: Path) -> list[Lane]:
    """Return all lanes of a network file."""
    lanes: list[Lane] = []
    try:
        for element in _elements(path, "end"):
            if element.tag == "lane":
                edge, length, shape = (element.get(name, "") for name in ("id", "length", "shape"))
                line = [tuple(map(float, point.split(",")[:2])) for point in shape.split()]
                lanes.append((edge.rpartition("_")[0], float(length), [(x, y) for x, y in line]))
            if element.tag == "edge":
                element.clear()
    except ValueError as error:
        raise Broken(f"{path.name}: cannot be read: {error}") from None
    return lanes


def _stamp(file: Path) -> tuple[int, int]:
    """Return time of change and size of a file: another content has another stamp."""
    found = file.stat()
    return found.st_mtime_ns, found.st_size


def _seconds(path: Path, options: dict[str, str], name: str, otherwise: float | None) -> float | None:
    """Return a time option [s]; SUMO writes -1 for no end."""
    text = options.get(name)
    if text is None or (name == "end" and text.strip() in ("-1", "-1.00")):
        return otherwise
    parts = text.split(":")
    try:
        value = sum(float(part) * unit for part, unit in zip(reversed(parts), UNITS, strict=False))
    except ValueError:
        value = nan
    positive = name == "step-length"
    if not isfinite(value) or value < 0 or len(parts) not in (1, 3, 4) or (positive and not value):
        allowed = "seconds > 0" if positive else "seconds, hours:minutes:seconds"
        raise Broken(f"{path.name}: {name}: {text!r} is not allowed; allowed: {allowed}")
    return value


def _check_network(path: Path) -> None:
    """Raise `Broken` unless it is whole, and a network with a version.

    SUMO itself would crash without a version, and says nothing of a file that is torn off.
    """
    elements = _elements(path, "start")
    root = next(elements)
    version = root.get("version")
    for _ in elements:
        root.clear()
    if root.tag != "net":
        raise Broken(f"{path.name}: is not a SUMO network: it begins with <{root.tag}>")
    if not version:
        raise Broken(f"{path.name}: the network has no version; make it anew: netconvert -s {path.name} -o")


class _Demand(NamedTuple):
    """What files of routes hold."""

    types: dict[str, dict[str, str]]
    mixtures: dict[str, set[str]]
    """types of each distribution; it may be used in another file than the one that defines it"""
    wanted: set[str]
    """types and distributions that vehicles have"""


def _read_demand(path: Path, demand: _Demand) -> None:
    """Add what a file defines, and what its vehicles have."""
    for element in _elements(path, "end"):
        name = element.get("id", "")
        if element.tag == "vType":
            demand.types[name] = dict(element.attrib)
        elif element.tag == "vTypeDistribution":
            inside = [child.get("id", "") for child in element if child.tag == "vType"]
            demand.mixtures[name] = {*inside, *element.get("vTypes", "").split()}
        elif element.tag in DEMAND:
            demand.wanted.add(element.get("type", DEFAULT_TYPE))


def _elements(path: Path, event: Literal["start", "end"]) -> Iterator[ElementTree.Element]:
    """Yield the elements of an XML file, also of a compressed one, as they end (or start)."""
    try:
        _refuse_definitions(path)
        with _open(path) as file:
            for _, element in ElementTree.iterparse(file, (event,)):
                yield element
    except (ElementTree.ParseError, OSError, EOFError, zlib.error, LookupError, ValueError) as error:
        raise Broken(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None


def _refuse_definitions(path: Path) -> None:
    """Raise `Broken` where a file has a document type: it can name other files, or grow without end.

    SUMO's own files have none, and SUMO itself would follow what it names.
    """
    seen = []
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = lambda *_: seen.append("doctype")
    parser.StartElementHandler = lambda *_: seen.append("root")
    with _open(path) as file, suppress(expat.ExpatError):  # what is broken is told when it is read
        while not seen and (chunk := file.read(CHUNK)):
            parser.Parse(chunk)
    if seen[:1] == ["doctype"]:
        raise Broken(f"{path.name}: a document type (<!DOCTYPE ...>) is not allowed")


def _open(path: Path) -> IO[bytes]:
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]


COMMANDS: dict[str, Callable[[Path], Any]] = {"configuration": _configuration, "lanes": _lanes}


def main(command: str, path: str, memory: str, seconds: str) -> None:
    """Print what a file says, or what is wrong with it, under limits on memory [bytes] and time [s]."""
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
    try:
        found = {"found": COMMANDS[command](Path(path))}
    except Broken as error:
        found = {"broken": str(error)}
    except (MemoryError, RecursionError):
        found = {"broken": f"{Path(path).name}: its files are too large to be read"}
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
