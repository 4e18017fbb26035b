"""What the user's own SUMO files say, read before SUMO starts: SUMO crashes on some that are broken."""

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite, nan
from pathlib import Path
from typing import IO, Literal, NamedTuple
from xml.etree import ElementTree

from unjam.errors import InputError

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of vehicles that name none"""
OTHER_DEFAULT_TYPES = {
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_RAILTYPE": "rail",
}
"""vehicle classes of SUMO's other types that no file need define"""
DEMAND = ("vehicle", "trip", "flow")
UNITS = (1.0, 60.0, 3600.0, 86400.0)
"""seconds, minutes, hours and days [s]: SUMO's times may be 1:30:00"""
SYNONYMS = {"net": "net-file", "routes": "route-files", "additional": "additional-files"}


@dataclass(frozen=True)
class SumoFiles:
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


def read_sumo_files(path: Path) -> SumoFiles:
    """Return what a .sumocfg file and the files that it names say.

    Raises:
        InputError: one is missing or broken, the network has no version, or there are no vehicles.
    """
    named = _named(path)
    files = [named.network, *named.additional, *named.routes]
    for file in (path, *files):
        if not file.is_file():
            raise InputError(f"{str(file)!r}: there is no such file")
    found = [file.stat() for file in (path, *files)]
    return _read(path, tuple((each.st_mtime_ns, each.st_size) for each in found))


@lru_cache
def _read(path: Path, changed: tuple[tuple[int, int], ...]) -> SumoFiles:
    """Read all files; `changed`, time and size of each, makes a changed one be read again."""
    options, network, additional, routes = _named(path)
    _check_network(network)
    demand = _Demand({}, {}, set())
    for file in [*additional, *routes]:
        _read_demand(file, demand)
    if not demand.wanted:
        raise InputError(f"{path.name}: its route and additional files have no vehicle, trip or flow")
    used = frozenset().union(*(demand.mixtures.get(name, {name}) for name in demand.wanted))
    demand.types.setdefault(DEFAULT_TYPE, {})
    for name, kind in OTHER_DEFAULT_TYPES.items():
        if name in used:
            demand.types.setdefault(name, {"vClass": kind})
    begin = _seconds(path, options, "begin", 0.0) or 0.0
    ends = _seconds(path, options, "end", None)
    if ends is not None and ends <= begin:
        raise InputError(f"{path.name}: end: {ends:g} s is not allowed; allowed: after begin, {begin:g} s")
    return SumoFiles(
        path,
        network,
        additional,
        begin,
        ends,
        _seconds(path, options, "step-length", 1.0) or 1.0,
        demand.types,
        used,
    )


class _Named(NamedTuple):
    """What a .sumocfg file says, and the files that it names."""

    options: dict[str, str]
    network: Path
    additional: tuple[Path, ...]
    routes: tuple[Path, ...]


def _named(path: Path) -> _Named:
    if not path.is_file():
        raise InputError(f"{str(path)!r}: there is no such file")
    options = {
        SYNONYMS.get(element.tag, element.tag): element.get("value", "")
        for element in _elements(path, "end")
        if element.get("value") is not None
    }
    if not options.get("net-file"):
        raise InputError(f"{path.name}: names no net-file")
    additional, routes = (
        tuple(path.parent / name for name in options.get(files, "").replace(",", " ").split())
        for files in ("additional-files", "route-files")
    )
    return _Named(options, path.parent / options["net-file"], additional, routes)


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
    if (
        not isfinite(value)
        or value < 0
        or len(parts) not in (1, 3, 4)
        or (name == "step-length" and not value)
    ):
        allowed = "seconds > 0" if name == "step-length" else "seconds, hours:minutes:seconds"
        raise InputError(f"{path.name}: {name}: {text!r} is not allowed; allowed: {allowed}")
    return value


def _check_network(path: Path) -> None:
    """Raise `InputError` unless it is whole, and a network with a version.

    SUMO itself would crash without a version, and says nothing of a file that is torn off.
    """
    elements = _elements(path, "start")
    root = next(elements)
    version = root.get("version")
    for _ in elements:
        root.clear()
    if root.tag != "net":
        raise InputError(f"{path.name}: is not a SUMO network: it begins with <{root.tag}>")
    if not version:
        raise InputError(
            f"{path.name}: the network has no version; make it anew: netconvert -s {path.name} -o"
        )


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
        with _open(path) as file:
            for _, element in ElementTree.iterparse(file, (event,)):
                yield element
    except (ElementTree.ParseError, OSError, EOFError, zlib.error, LookupError, ValueError) as error:
        raise InputError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None


def _open(path: Path) -> IO[bytes]:
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]
