"""What the user's own SUMO files say, read before SUMO starts: SUMO crashes on some that are broken."""

import gzip
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Literal
from xml.etree import ElementTree

from unjam.errors import InputError

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of vehicles that name none"""
DEMAND = ("vehicle", "trip", "flow")
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
    return _read(path, path.stat().st_mtime_ns) if path.is_file() else _missing(path)


@lru_cache
def _read(path: Path, changed: int) -> SumoFiles:
    options = {
        SYNONYMS.get(element.tag, element.tag): element.get("value", "")
        for element in _elements(path, "end")
        if element.get("value") is not None
    }
    if not options.get("net-file"):
        raise InputError(f"{path.name}: names no net-file")
    network = path.parent / options["net-file"]
    _check_network(network)
    additional = _files(path, options.get("additional-files", ""))
    types: dict[str, dict[str, str]] = {}
    used: set[str] = set()
    for file in [*additional, *_files(path, options.get("route-files", ""))]:
        _read_demand(file, types, used)
    if not used:
        raise InputError(f"{path.name}: its route and additional files have no vehicle, trip or flow")
    types.setdefault(DEFAULT_TYPE, {})
    return SumoFiles(
        path,
        network,
        additional,
        _seconds(path, options, "begin", 0.0) or 0.0,
        _seconds(path, options, "end", None),
        _seconds(path, options, "step-length", 1.0) or 1.0,
        types,
        frozenset(used),
    )


def _missing(path: Path) -> SumoFiles:
    raise InputError(f"{str(path)!r}: there is no such file")


def _files(path: Path, names: str) -> tuple[Path, ...]:
    return tuple(path.parent / name for name in names.replace(",", " ").split())


def _seconds(path: Path, options: dict[str, str], name: str, otherwise: float | None) -> float | None:
    """Return a time option [s]; SUMO writes -1 for `none`."""
    if name not in options:
        return otherwise
    try:
        parts = [float(part) for part in options[name].split(":")]  # also 1:30:00
    except ValueError:
        raise InputError(f"{path.name}: {name}: {options[name]!r} is not allowed; allowed: seconds") from None
    value = sum(part * 60.0**power for power, part in enumerate(reversed(parts)))
    return otherwise if value < 0 else value


def _check_network(path: Path) -> None:
    """Raise `InputError` unless the root is a network with a version: SUMO itself would crash."""
    if not path.is_file():
        _missing(path)
    root = next(_elements(path, "start"))
    if root.tag != "net":
        raise InputError(f"{path.name}: is not a SUMO network: it begins with <{root.tag}>")
    if not root.get("version"):
        raise InputError(
            f"{path.name}: the network has no version; make it anew: netconvert -s {path.name} -o"
        )


def _read_demand(path: Path, types: dict[str, dict[str, str]], used: set[str]) -> None:
    """Add the types that a file defines, and those that its vehicles have."""
    if not path.is_file():
        _missing(path)
    mixtures: dict[str, set[str]] = {}
    wanted: set[str] = set()
    for element in _elements(path, "end"):
        name = element.get("id", "")
        if element.tag == "vType":
            types[name] = dict(element.attrib)
        elif element.tag == "vTypeDistribution":
            inside = [child.get("id", "") for child in element if child.tag == "vType"]
            mixtures[name] = {*inside, *element.get("vTypes", "").split()}
        elif element.tag in DEMAND:
            wanted.add(element.get("type", DEFAULT_TYPE))
    for name in wanted:
        used |= mixtures.get(name, {name})


def _elements(path: Path, event: Literal["start", "end"]) -> Iterator[ElementTree.Element]:
    """Yield the elements of an XML file, also of a compressed one, as they end (or start)."""
    try:
        with _open(path) as file:
            for _, element in ElementTree.iterparse(file, (event,)):
                yield element
    except (ElementTree.ParseError, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name}: cannot be read: {error}") from None


def _open(path: Path) -> IO[bytes]:
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]
