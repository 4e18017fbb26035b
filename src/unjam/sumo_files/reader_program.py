"""The program of the resource-limited subprocess that reads users' SUMO files; it prints one JSON document."""

import json
import os
import re
import sys
from functools import partial
from math import inf, isfinite, nan
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote
from xml.parsers import expat

_PROGRAM_FOLDER = Path(__file__).parent
if __name__ == "__main__":  # to start in 50 ms, do not run the code of these packages, which imports much more
    for name, folder in (("unjam", _PROGRAM_FOLDER.parent), ("unjam.sumo_files", _PROGRAM_FOLDER)):
        sys.modules[name] = ModuleType(name)
        sys.modules[name].__path__ = [str(folder)]

from unjam.sumo_files import reader  # noqa: E402
from unjam.sumo_files.reader import BrokenFileError, XmlAttributes, XmlReader  # noqa: E402

DEFAULT_VEHICLE_TYPE = "DEFAULT_VEHTYPE"  # type of vehicles for which the files define none
MODE_TYPES = {"car": DEFAULT_VEHICLE_TYPE, "bicycle": "DEFAULT_BIKETYPE"}
"""vehicle type of a person's trip, by mode"""
OTHER_DEFAULT_TYPES = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail"}
"""vehicle classes of SUMO's other predefined vehicle types"""
DEMAND_ELEMENTS = {"vehicle": "depart", "trip": "depart", "flow": "begin"}
"""elements that create vehicles, with the attribute for the first departure"""
TIME_UNITS = (1.0, 60.0, 3600.0, 86400.0)  # second, minute, hour and day [s], as SUMO's times can be 1:30:00
FILE_OPTIONS = ("net-file", "additional-files", "route-files", "weight-files")  # options that name files
SYNONYMS = {
    synonym: name
    for name, synonyms in {
        **{"net-file": "n net", "route-files": "r routes", "additional-files": "a additional"},
        **{"weight-files": "w weights", "weight-attribute": "x measure", "begin": "b", "end": "e"},
        **{"route-steps": "s", "seed": "srand", "random": "abs-rand", "default.carfollowmodel": "carfollow.model"},
        **{"railsignal-moving-block": "railsignal.moving-block", "device.rerouting.with-taz": "with-taz"},
        **{"device.rerouting.threads": "routing-threads", "device.taxi.vclasses": "taxi.vclasses"},
        **{"device.fcd-replay.files": "device.fcd-replay.file"},
        **{"meso-ignore-lanes-by-vclass": "meso.ignore-lanes.by-vclass"},
    }.items()
    for synonym in synonyms.split()
}
"""SUMO's main name of an option, by synonym"""
_MODELS = """
Krauss KraussOrig1 KraussPS KraussX IDM IDMM EIDM SmartSK Daniel1 PWagner2009 BKerner Wiedemann W99 ACC CACC CC Rail
"""
READ_ELEMENTS = (
    *(*DEMAND_ELEMENTS, "lane", "neigh", "param", "person", "personFlow", "personTrip", "calibrator"),
    *("vType", "/vType", "vTypeDistribution", "/vTypeDistribution"),
    *(f"{reader.FOLLOWING_MODEL_PREFIX}{name}" for name in _MODELS.split()),  # within types, in older files
)
"""elements that `_Demand` reads; `/` marks the end of an element"""
MAX_VEHICLE_TYPES = 100_000  # maximum number, as unjam derives types of CAVs from them
TRUE_VALUES = ("true", "t", "yes", "on", "1", "x")  # texts that SUMO reads as true


def _read_configuration(path: Path) -> dict[str, Any]:
    """Return the fields of `SumoFiles` for a .sumocfg file and the files that it names, as JSON values."""
    reader.check_file_exists(path)
    stamps = {path: reader.file_stamp(path)}
    options = _read_options(path)
    if options.get("mesosim", "").lower() in TRUE_VALUES:
        raise BrokenFileError(
            f"{path.name}: mesosim: true is not allowed; allowed: false, as vehicles obey no commands"
        )
    networks, additional, routes, weights = (
        [_resolve_file_name(path, option, name.strip()) for name in options.pop(option, "").split(",") if name.strip()]
        for option in FILE_OPTIONS
    )
    if len(networks) != 1:
        raise BrokenFileError(f"{path.name}: it names {'more than one' if networks else 'no'} net-file")
    (network,), demand = networks, _Demand()
    files = [network, *additional, *routes, *weights]
    for file in files:
        reader.check_file_exists(file)
    readers = {file: XmlReader(demand.handlers()) for file in files}
    for file, xml_reader in readers.items():
        xml_reader.read(file)
        stamps = {**xml_reader.sources, **stamps}
    if (root := readers[network].root) != reader.NETWORK_ELEMENT:
        raise BrokenFileError(f"{network.name}: it is not a SUMO network: it begins with <{root}>")
    if not readers[network].version:  # SUMO would crash
        convert = f"convert it: netconvert -s {network.name} -o"
        raise BrokenFileError(f"{network.name}: the network has no version; {convert}")
    if not demand.used_names:
        elements = "vehicle, trip, flow or personal car"
        raise BrokenFileError(f"{path.name}: its route and additional files have no {elements}")
    begin = _read_seconds(path, options, "begin", 0.0) or 0.0
    end = _read_seconds(path, options, "end", None)
    if end is not None and end <= begin:
        raise BrokenFileError(f"{path.name}: end: {end:g} s is not allowed; allowed: after begin, {begin:g} s")
    copied_files = {file: xml_reader.sources for file, xml_reader in readers.items() if xml_reader.needs_copy}
    return {
        "network": str(network),
        "additional_files": list(map(str, additional)),
        "route_files": list(map(str, routes)),
        "weight_files": list(map(str, weights)),
        "options": options,
        "dropped_items": sorted({item for xml_reader in readers.values() for item in xml_reader.dropped_items}),
        "copy_sources": {str(file): list(map(str, sources)) for file, sources in copied_files.items()},
        "begin": begin,
        "end": end,
        "first_departure": demand.first_departure,
        "calibrated_until": demand.last_end if demand.has_calibrators else 0.0,
        "step": _read_seconds(path, options, "step-length", 1.0) or 1.0,
        "used_types": sorted(demand.used_types()),
        "removes_jammed_vehicles": options.get("time-to-teleport.remove", "").lower() in TRUE_VALUES,
        "has_bicycle_lanes": demand.has_bicycle_lanes,
        "has_opposite_lanes": demand.has_opposite_lanes,
        "has_spread_flows": demand.has_spread_flows,
        "types": demand.types,
        "type_parameters": demand.type_parameters,
        "stamps": {str(file): stamps[file] for file in [path, *files, *sorted(stamps.keys() - {path, *files})]},
    }


def _read_options(path: Path) -> dict[str, str]:
    """Return the options in a configuration that have a value, by SUMO's main names of the options."""
    options: dict[str, str] = {}

    def add_option(tag: str, attributes: XmlAttributes) -> None:
        for value in filter(None, map(attributes.get, ("value", "v"))):
            name = canonical_option(tag)
            if name in options:
                raise BrokenFileError(f"{path.name}: {tag}: it is set twice")
            options[name] = _substitute_variables(value)

    def refuse_text(text: str) -> None:
        if text.strip():
            raise BrokenFileError(f'{path.name}: {text.strip()[:60]!r} is not allowed; allowed: <option value="..."/>')

    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler, parser.CharacterDataHandler = add_option, refuse_text
    reader.parse_xml(path, parser, [path.read_bytes()])
    return options


def canonical_option(name: str) -> str:
    """Return SUMO's main name of an option, which may have synonyms."""
    for old, new in (("device.routing.", "device.rerouting."), (".knownveh", ".explicit")):
        name = name.replace(old, new)
    return SYNONYMS.get(name, name)


def _resolve_file_name(path: Path, option: str, name: str) -> Path:
    """Return the path of a file that an option names, with all variables replaced.

    Only names of existing files may contain unknown variables: messages must not show the values.
    """
    file = path.parent / unquote(reader.UNKNOWN_VARIABLE.sub(lambda match: os.environ.get(match[0][2:-1], ""), name))
    if (variable := reader.UNKNOWN_VARIABLE.search(name)) and not os.path.isfile(file):
        allowed = f"{reader.ALLOWED_VARIABLES}, and others in names of existing files"
        raise BrokenFileError(f"{path.name}: {option}: {variable[0]!r} is not allowed; allowed: {allowed}")
    return file


def _substitute_variables(text: str) -> str:
    """Replace `~` and the allowed variables as SUMO does; others may have secrets that a strange file asks for."""
    text = re.sub("(^|,)~", r"\1${HOME}", text)
    for name in reader.SUBSTITUTED_VARIABLES:
        text = text.replace(f"${{{name}}}", os.environ.get(name, ""))
    return text


def _read_lanes(path: Path) -> list[tuple[str, float, float, list[tuple[float, float]]]]:
    """Return edge, length [m], speed limit [m/s] and center line [(x, y), m] of all lanes of a network file."""
    lanes: list[tuple[str, float, float, list[tuple[float, float]]]] = []

    def add_lane(attributes: XmlAttributes) -> None:
        lane_id, length, limit, shape = (attributes.get(name, "") for name in ("id", "length", "speed", "shape"))
        line = [tuple(map(float, point.split(",")[:2])) for point in shape.split()]
        lanes.append((lane_id.rpartition("_")[0], float(length), float(limit), [(x, y) for x, y in line]))

    XmlReader({"lane": add_lane}).read(path)
    return lanes


def _read_seconds(path: Path, options: dict[str, str], name: str, default: float | None) -> float | None:
    """Return the value of a time option [s], or a default; SUMO writes -1 for an absent end."""
    text = options.get(name)
    if text is None or (name == "end" and text.strip() in ("-1", "-1.00")):
        return default
    value, must_be_positive = _parse_time(text), name == "step-length"
    if value < 0 or not isfinite(value) or (must_be_positive and not value):
        allowed = "seconds > 0" if must_be_positive else "seconds, hours:minutes:seconds"
        raise BrokenFileError(f"{path.name}: {name}: {text!r} is not allowed; allowed: {allowed}")
    return value


def _parse_time(text: str) -> float:
    """Return a time [s] from a text such as 90, 1:30:00 or 1:00:00:00; NaN if the text is not a time."""
    parts = text.split(":")
    try:
        value = sum(float(part) * unit for part, unit in zip(reversed(parts), TIME_UNITS, strict=False))
    except ValueError:
        return nan
    return value if len(parts) in (1, 3, 4) else nan


class _Demand:
    """Collector of the vehicle types, vehicles and special lanes in the files of a configuration."""

    def __init__(self) -> None:
        self.types: dict[str, XmlAttributes] = {}
        self.type_parameters: dict[str, XmlAttributes] = {}  # values of the parameters of each type, by key
        self.used_names: set[str] = set()  # ids of types and distributions that vehicles have
        self.first_departure: float | None = inf  # earliest departure of a vehicle [s]; None: unknown
        self.has_bicycle_lanes = self.has_opposite_lanes = False
        self.has_calibrators = False  # calibrators may add vehicles that SUMO does not yet expect
        self.last_end = 0.0  # latest end of a flow, within calibrators and elsewhere [s]
        self.has_spread_flows = False  # whether SUMO spreads the vehicles of a flow until the end of the simulation
        self._distributions: dict[str, set[str]] = {}  # types of each distribution, for all files
        self._current_type = ""  # id of the type that is being read; empty: none
        self._current_distribution: set[str] = set()  # types of the distribution that is being read

    def handlers(self) -> reader.XmlHandlers:
        """Return the functions that receive the attributes of elements, by name of the element."""
        return {tag: partial(self._on_element, tag) for tag in READ_ELEMENTS}

    def _on_element(self, tag: str, attributes: XmlAttributes) -> None:
        match tag:
            case "vehicle" | "trip" | "flow":
                self._add_vehicles(attributes, DEMAND_ELEMENTS[tag])
            case "lane":
                self.has_bicycle_lanes |= attributes.get("allow") == "bicycle"
            case "neigh":
                self.has_opposite_lanes = True
            case "param":
                if self._current_type:
                    self.type_parameters[self._current_type][attributes.get("key", "")] = attributes.get("value", "")
            case "person" | "personFlow":
                self.first_departure = None  # unknown, as persons may drive their own car
                self.has_spread_flows |= tag == "personFlow" and _is_spread(attributes)
            case "personTrip":
                modes = attributes.get("modes", "").replace(",", " ").split()
                default_types = {MODE_TYPES[mode] for mode in modes if mode in MODE_TYPES}
                self.used_names |= set(attributes.get("vTypes", "").split()) or default_types
            case "calibrator":
                self.has_calibrators = True
            case "vType":
                name = attributes.get("refId") or attributes.get("id", "")
                self._current_distribution.add(name)
                if not name:  # SUMO would report each of millions of such elements
                    raise BrokenFileError("vType: an element without id is not allowed; allowed: an id for each type")
                if "refId" not in attributes:
                    if len(self.types) == MAX_VEHICLE_TYPES:
                        limit = f"at most {MAX_VEHICLE_TYPES:,} vehicle types"
                        raise BrokenFileError(f"vType: type {name[:60]!r} is not allowed; allowed: {limit}")
                    self._current_type, self.types[name], self.type_parameters[name] = name, dict(attributes), {}
            case "/vType":
                self._current_type = ""
            case "vTypeDistribution":
                self._current_distribution = set(attributes.get("vTypes", "").split())
                self._distributions[attributes.get("id", "")] = self._current_distribution
            case "/vTypeDistribution":
                self._current_distribution = set()
            case _:  # in older files, the car-following attributes of a type are in a separate element
                if self._current_type:
                    self.types[self._current_type] |= attributes

    def _add_vehicles(self, attributes: XmlAttributes, depart_attribute: str) -> None:
        if "speed" in attributes and "vehsPerHour" not in attributes:
            return  # the flow of a calibrator that changes only speeds
        self.used_names.add(attributes.get("type", DEFAULT_VEHICLE_TYPE))
        self.has_spread_flows |= depart_attribute == "begin" and _is_spread(attributes)
        if (end := attributes.get("end")) and isfinite(last := _parse_time(end)):
            self.last_end = max(self.last_end, last)
        if self.first_departure is not None:
            time = _parse_time(attributes.get(depart_attribute) or "0")
            self.first_departure = min(self.first_departure, time) if isfinite(time) else None

    def used_types(self) -> set[str]:
        """Return the types that vehicles have, and add SUMO's predefined types among them to `types`."""
        used, remaining = set[str](), set(self.used_names)
        while remaining:
            name = remaining.pop()
            used.add(name)
            remaining |= self._distributions.get(name, set()) - used
        used -= self._distributions.keys()
        self.types.setdefault(DEFAULT_VEHICLE_TYPE, {})
        for name in used & OTHER_DEFAULT_TYPES.keys():
            self.types.setdefault(name, {"vClass": OTHER_DEFAULT_TYPES[name]})
        return used


def _is_spread(flow: XmlAttributes) -> bool:
    """Return whether a flow has a number of vehicles that SUMO spreads until the end of the simulation."""
    return "number" in flow and not flow.keys() & {"end", "period", "probability", "vehsPerHour", "perHour"}


def _write_copy(path: Path, copy: str, driver_count: str, types: str = "") -> None:
    changes = json.loads(Path(types).read_bytes()) if types else {}
    with open(copy, "w", encoding="utf-8") as out:
        XmlReader({}, out, changes, int(driver_count)).read(path)


def _main(command: str, path: str, *arguments: str) -> None:
    commands = {"configuration": _read_configuration, "lanes": _read_lanes, "copy": _write_copy}
    try:
        answer = {"result": commands[command](Path(path), *arguments)}
    except BrokenFileError as error:
        answer = {"error": str(error)}
    except OSError as error:  # the copy cannot be written; errors of the files that are read have other classes
        answer = {"disk_error": [error.errno, error.strerror]}
    except (MemoryError, RecursionError):
        answer = {"error": f"{Path(path).name}: its files are too large to be read"}
    sys.stdout.write(json.dumps(answer))


if __name__ == "__main__":
    _main(*sys.argv[1:])
