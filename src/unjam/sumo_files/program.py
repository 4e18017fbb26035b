"""The program that reads users' own SUMO files: in a process of its own, limited by `unjam.sandbox`.

It answers one JSON document, uses Python's own library alone, and starts in a twentieth of a second.
"""

import gzip
import json
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import isfinite, isnan, nan
from pathlib import Path
from typing import IO, Any, NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of vehicles that name none"""
OTHER_DEFAULT_TYPES = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail"}
"""vehicle classes of SUMO's other types that no file need define"""
DEMAND = ("vehicle", "trip", "flow")
UNITS = (1.0, 60.0, 3600.0, 86400.0)
"""seconds, minutes, hours and days [s]: SUMO's times may be 1:30:00"""
CHUNK = 65_536
"""bytes read at once"""
FILES = {
    **dict.fromkeys(("net-file", "net", "n"), "net-file"),
    **dict.fromkeys(("route-files", "routes", "r"), "route-files"),
    **dict.fromkeys(("additional-files", "additional", "a"), "additional-files"),
}
"""options that name files which SUMO reads, also by their short names"""
OTHER_NAMES = {"b": "begin", "e": "end", "carfollow.model": "default.carfollowmodel"}
ONLY_WRITERS = {"edgeData", "laneData", "vTypeProbe", "timedEvent", "instantInductionLoop", "include"}
"""elements that do nothing but write files, and the one that reads another file into this one"""
DETECTORS = ("Detector", "inductionLoop", "routeProbe", "detector")
"""how elements end that signals and calibrators ask too: they stay, and write to nowhere"""
NOWHERE = "NUL"
"""the file that SUMO never makes"""
TO_FILES = ("file", "output", "dest", "href")
"""attributes that name files, beside those that end in `File`"""
IN_PARAMETERS = ("file", "output", "log", "ssm")
"""what is in the names of parameters of vehicles and signals that name files, or write one by themselves"""
PLAIN_ENCODINGS = (None, "utf-8", "us-ascii", "ascii", "iso-8859-1")
"""in which SUMO's parser cannot see another element than the one here"""
YES = ("true", "t", "yes", "on", "1", "x")
"""what SUMO takes for yes"""
UNREADABLE = (SyntaxError, expat.ExpatError, OSError, EOFError, zlib.error, LookupError, ValueError)
"""what reading can raise where a file is broken; ElementTree's errors are syntax errors"""

Lane = tuple[str, float, list[tuple[float, float]]]
"""edge, length [m] and centre line [(x, y), m]"""


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
        {**FILES, **OTHER_NAMES}.get(element.tag, element.tag): value
        for element in _elements(path)
        if (value := element.get("value", element.get("v"))) is not None
    }
    if not options.get("net-file"):
        raise Broken(f"{path.name}: names no net-file")
    if options.get("mesosim", "").lower() in YES:
        raise Broken(f"{path.name}: mesosim: true is not allowed; allowed: false, for it obeys no commands")
    network = path.parent / options["net-file"]
    additional, routes = (
        [path.parent / name.strip() for name in options.get(files, "").split(",") if name.strip()]
        for files in ("additional-files", "route-files")
    )
    files = [path, network, *additional, *routes]
    for file in files:
        if not file.is_file():
            raise Broken(f"{str(file)!r}: there is no such file")
    stamps = {str(file): _stamp(file) for file in files}
    filters = {file: _filtered(file) for file in (network, *additional, *routes)}
    _check_network(network, filters[network])
    demand = _Demand({}, {}, {})
    for file in [*additional, *routes]:
        _read_demand(file, demand)
    if not demand.wanted:
        raise Broken(f"{path.name}: its route and additional files have no vehicle, trip or flow")
    used = set().union(*(demand.mixtures.get(name, {name}) for name in demand.wanted))
    demand.types.setdefault(DEFAULT_TYPE, {})
    for name in used & OTHER_DEFAULT_TYPES.keys():
        demand.types.setdefault(name, {"vClass": OTHER_DEFAULT_TYPES[name]})
    begin = _seconds(path, options, "begin", 0.0) or 0.0
    end = _seconds(path, options, "end", None)
    if end is not None and end <= begin:
        raise Broken(f"{path.name}: end: {end:g} s is not allowed; allowed: after begin, {begin:g} s")
    return {
        "network": str(network),
        "additional_files": [str(file) for file in additional],
        "route_files": [str(file) for file in routes],
        "options": {name: value for name, value in options.items() if name not in FILES},
        "dropped": sorted({name for found in filters.values() for name in found.dropped}),
        "to_copy": [str(file) for file, found in filters.items() if found.to_copy],
        "begin": begin,
        "end": end,
        "step": _seconds(path, options, "step-length", 1.0) or 1.0,
        "first_departure": min(demand.wanted.values()),
        "types": demand.types,
        "used_types": sorted(used),
        "stamps": stamps,
    }


def _lanes(path: Path) -> list[Lane]:
    """Return all lanes of a network file."""
    lanes: list[Lane] = []
    try:
        for element in _elements(path):
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
    value, positive = _time(text), name == "step-length"
    if not isfinite(value) or value < 0 or (positive and not value):
        allowed = "seconds > 0" if positive else "seconds, hours:minutes:seconds"
        raise Broken(f"{path.name}: {name}: {text!r} is not allowed; allowed: {allowed}")
    return value


def _time(text: str) -> float:
    """Return a time [s], of seconds or as 1:30:00; NaN where it is neither."""
    parts = text.split(":")
    try:
        value = sum(float(part) * unit for part, unit in zip(reversed(parts), UNITS, strict=False))
    except ValueError:
        return nan
    return value if len(parts) in (1, 3, 4) else nan


def _check_network(path: Path, found: "_Filter") -> None:
    """Raise `Broken` unless it is a network with a version: SUMO itself would crash without."""
    if found.root != "net":
        raise Broken(f"{path.name}: is not a SUMO network: it begins with <{found.root}>")
    if not found.version:
        raise Broken(f"{path.name}: the network has no version; make it anew: netconvert -s {path.name} -o")


class _Filter:
    """Follows an XML file, and writes what is harmless of it to `out`, if there is one.

    Names are those in the file, with their prefixes, as SUMO takes them. Vehicle types get the attributes
    that `types` has for their ids.
    """

    def __init__(self, path: Path, out: IO[str] | None, types: dict[str, dict[str, str]]) -> None:
        self._write = out.write if out else lambda text: None
        self._within, self._types = 0, types
        """open elements within one that was dropped, itself included"""
        self.root, self.version = "", ""
        self.dropped: set[str] = set()
        self.to_copy = path.suffix == ".gz" or any(sign in str(path) for sign in ",; \t$%")
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.XmlDeclHandler = self._declared
        self.parser.StartElementHandler = self._started
        self.parser.EndElementHandler = self._ended
        self.parser.CharacterDataHandler = lambda text: self._within or self._write(escape(text))

    def _declared(self, version: str, encoding: str | None, standalone: int) -> None:
        self.to_copy |= (encoding and encoding.lower()) not in PLAIN_ENCODINGS

    def _started(self, tag: str, attributes: dict[str, str]) -> None:
        if not self.root:
            self.root, self.version = tag, attributes.get("version", "")
        kept = None if self._within else self._harmless(tag, attributes)
        if kept is None:
            self._within += 1
        else:
            kept |= self._types.get(kept.get("id", ""), {}) if tag == "vType" else {}
            inside = "".join(f" {name}={quoteattr(value)}" for name, value in kept.items())
            self._write(f"<{tag}{inside}>")

    def _ended(self, tag: str) -> None:
        if self._within:
            self._within -= 1
        else:
            self._write(f"</{tag}>")

    def _harmless(self, tag: str, attributes: dict[str, str]) -> dict[str, str] | None:
        """Return which attributes of an element are harmless; None where the element is not."""
        key = attributes.get("key", "").lower()
        if tag in ONLY_WRITERS or (tag == "param" and any(word in key for word in IN_PARAMETERS)):
            self._drop(tag if tag != "param" else f"parameter {attributes['key']}")
            return None
        kept = dict(attributes)
        for name in [name for name in attributes if name in TO_FILES or name.endswith("File")]:
            if name == "file" and tag.endswith(DETECTORS):
                if kept[name] != NOWHERE:
                    kept[name] = NOWHERE
                    self._drop(f"{name} of {tag}")
            else:
                del kept[name]
                self._drop(f"{name} of {tag}")
        return kept

    def _drop(self, name: str) -> None:
        self.dropped.add(name)
        self.to_copy = True


def _filtered(path: Path, out: IO[str] | None = None, types: dict[str, Any] | None = None) -> _Filter:
    """Follow an XML file to its end; raise `Broken` where it has a document type, or is no XML."""
    try:
        _refuse_definitions(path)
        found = _Filter(path, out, types or {})
        with _open(path) as file:
            while chunk := file.read(CHUNK):
                found.parser.Parse(chunk, False)
            found.parser.Parse(b"", True)
    except UNREADABLE as error:
        raise _unreadable(path, error) from None
    return found


def _copy(path: Path, copy: Path, types: Path | None = None) -> None:
    """Write an XML file again without what is not harmless, vehicle types changed as a JSON file says."""
    changes = json.loads(types.read_bytes()) if types else {}
    with open(copy, "w", encoding="utf-8") as out:
        _filtered(path, out, changes)


class _Demand(NamedTuple):
    """What files of routes hold."""

    types: dict[str, dict[str, str]]
    mixtures: dict[str, set[str]]
    """types of each distribution; it may be used in another file than the one that defines it"""
    wanted: dict[str, float]
    """types and distributions that vehicles have, with the first time at which one departs [s]"""


def _read_demand(path: Path, demand: _Demand) -> None:
    """Add what a file defines, and what its vehicles have."""
    for element in _elements(path):
        name = element.get("id", "")
        if element.tag == "vType":
            demand.types[name] = dict(element.attrib)
        elif element.tag == "vTypeDistribution":
            inside = [child.get("id", "") for child in element if child.tag == "vType"]
            demand.mixtures[name] = {*inside, *element.get("vTypes", "").split()}
        elif element.tag in DEMAND:
            kind, time = element.get("type", DEFAULT_TYPE), element.get("depart", element.get("begin", "0"))
            first = 0.0 if isnan(found := _time(time)) else found  # with a person: only SUMO knows when
            demand.wanted[kind] = min(first, demand.wanted.get(kind, first))


def _elements(path: Path) -> Iterator[ElementTree.Element]:
    """Yield the elements of an XML file, also of a compressed one, as they end."""
    try:
        _refuse_definitions(path)
        with _open(path) as file:
            for _, element in ElementTree.iterparse(file, ("end",)):
                yield element
    except UNREADABLE as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> Broken:
    return Broken(f"{path.name}: cannot be read: {' '.join(str(error).split())}")


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


COMMANDS: dict[str, Callable[..., Any]] = {"configuration": _configuration, "lanes": _lanes, "copy": _copy}


def main(command: str, *paths: str) -> None:
    """Print what a file says, or what is wrong with it."""
    try:
        found = {"found": COMMANDS[command](*map(Path, paths))}
    except Broken as error:
        found = {"broken": str(error)}
    except (MemoryError, RecursionError):
        found = {"broken": f"{Path(paths[0]).name}: its files are too large to be read"}
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
