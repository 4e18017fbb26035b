"""A road of the user's own with detectors, and what of its people and their number can be varied."""

import re
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

from unjam.controller.file import sha256_of_file
from unjam.errors import InputError, invalid_value, spelling_hint, unknown_name
from unjam.measures.detectors import Measurement, read_detectors
from unjam.scenarios.user_network import ROAD_CLASSES, UserNetwork, load_user_network, passenger_types
from unjam.sumo_files import SumoFiles, read_sumo_files
from unjam.training.assess import ZERO_PENETRATION_RATE
from unjam.training.search_space import NumericRange, SearchSpace, parse_search_space
from unjam.worlds.sumo.detectors import InductionLoop
from unjam.worlds.sumo.networks import network_geometry

FLOW_FACTOR = "flow"
"""factor on the number of vehicles, of all types"""
FACTOR_RANGES: SearchSpace = {
    "tau": NumericRange(0.5, 2.0, log=True),
    "accel": NumericRange(0.5, 2.0, log=True),
    "decel": NumericRange(0.5, 2.0, log=True),
    "minGap": NumericRange(0.5, 2.0, log=True),
    "speedFactor": NumericRange(0.8, 1.25, log=True),
    FLOW_FACTOR: NumericRange(0.67, 1.5, log=True),
}
"""factors on the attributes of passenger vehicle types, and on flows"""
SUMO_TYPE_DEFAULTS = {"tau": 1.0, "accel": 2.6, "decel": 4.5, "minGap": 2.5, "speedFactor": 1.0}
"""of passenger types that do not say otherwise"""
NORMAL_DISTRIBUTION = re.compile(r"(normc?)\(([^()]*)\)")
"""a speed factor that each vehicle draws"""

CalibrationFactors = dict[str, float]
"""by the names of `FACTOR_RANGES`"""


@dataclass(frozen=True)
class Corridor:
    """A network and what its detectors measured; everything in it has been checked."""

    files: SumoFiles
    detectors: Path
    begin: float
    """[s]"""
    end: float
    """[s]"""
    measurements: tuple[Measurement, ...]
    """intervals that lie between these two"""
    excluded_count: int
    """intervals that do not"""
    loops: tuple[InductionLoop, ...]
    loop_numbers: tuple[tuple[int, ...], ...]
    """numbers of the loops of each interval"""

    def scenario(self, file: Path) -> UserNetwork:
        """Return a network's traffic, people alone, until nothing more is measured."""
        changes = {"penetration_rate": ZERO_PENETRATION_RATE, "cav_types": (), "begin": self.begin, "end": self.end}
        return load_user_network(str(file), changes)

    def metadata(self) -> dict[str, Any]:
        """Return what a calibration is about: names and hashes of the files, and what is measured when."""
        files = self.files
        return {
            "scenario": files.path.name,
            "detectors": self.detectors.name,
            "files": [{"name": path.name, "sha256": sha256_of_file(path)} for path in (self.detectors, *files.sources)],
            "begin": self.begin,
            "end": self.end,
            "intervals": {"used": len(self.measurements), "excluded": self.excluded_count},
        }


def load_corridor(file: str, detectors: Path, begin: float | None = None, end: float | None = None) -> Corridor:
    """Return a network and what its detectors measured, once both have been checked.

    Args:
        file: a .sumocfg file.
        detectors: a CSV file, as `measures.detectors.read_detectors` reads it.
        begin: when to begin [s]; None: as the configuration says.
        end: when to end [s]; None: as the configuration says, or with the last interval.

    Raises:
        InputError: one of them is wrong, a detector has no place on the road, or nothing can be varied.
    """
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    kind, rows = read_detectors(detectors)
    # People alone: the share is so small that nobody has it.
    times = {name: time for name, time in (("begin", begin), ("end", end)) if time is not None}
    checked = load_user_network(file, {"penetration_rate": ZERO_PENETRATION_RATE, "cav_classes": ROAD_CLASSES, **times})
    files = read_sumo_files(Path(checked.file))
    first = files.begin if begin is None else begin
    last = next((limit for limit in (end, files.end) if limit is not None), inf)
    kept = [row for row in rows if row.begin >= first and row.end <= last]
    if not kept:
        raise InputError(f"{detectors.name}: no interval lies between {first:g} s and {last:g} s")
    if not passenger_types(files):
        known = ", ".join(sorted(files.used_types))
        raise InputError(f"{files.path.name}: no vehicle type is a passenger car; its types are {known}")
    lanes = [_detector_loops(files.network, kind, row) for row in kept]
    loops = {loop: number for number, loop in enumerate(dict.fromkeys(loop for each in lanes for loop in each))}
    return Corridor(
        files,
        detectors,
        first,
        max(row.end for row in kept),
        tuple(kept),
        len(rows) - len(kept),
        tuple(loops),
        tuple(tuple(loops[loop] for loop in each) for each in lanes),
    )


def _detector_loops(network: Path, kind: str, row: Measurement) -> list[InductionLoop]:
    """Return the loops of a detector; raise `InputError` where the network has no such place."""
    _, lengths, counts = network_geometry(network)
    edge = row.place if kind == "edge" else row.place.rpartition("_")[0]
    all_lanes = [f"{edge}_{number}" for number in range(counts.get(edge, 0))]
    lanes = all_lanes if kind == "edge" else [lane for lane in all_lanes if lane == row.place]
    if not lanes:
        raise invalid_value(kind, row.place, f"one of {network.name}{spelling_hint(row.place, all_lanes or counts)}")
    if row.position > lengths[edge]:
        raise invalid_value(f"{kind} {row.place}: position", row.position, f"<= {lengths[edge]:g} m, its length")
    return [InductionLoop(lane, row.position) for lane in lanes]


def scale_vehicle_types(files: SumoFiles, factors: CalibrationFactors) -> dict[str, dict[str, str]]:
    """Return the attributes of all passenger types once they are multiplied by `factors`, by id.

    What would stay as it is is left out. A reaction time never falls below the simulation step: people would
    collide.

    Raises:
        InputError: an attribute is no number.
    """
    found: dict[str, dict[str, str]] = {}
    for name in passenger_types(files):
        own = {**{key: str(value) for key, value in SUMO_TYPE_DEFAULTS.items()}, **files.types.get(name, {})}
        changed = {
            key: _scale_attribute(f"vType {name}: {key}", own[key], factor, files.step if key == "tau" else 0.0)
            for key, factor in factors.items()
            if key != FLOW_FACTOR and factor != 1
        }
        if changed:
            found[name] = changed
    return found


def _scale_attribute(field: str, text: str, factor: float, minimum: float) -> str:
    drawn = NORMAL_DISTRIBUTION.fullmatch(text.replace(" ", ""))
    try:
        if drawn:  # mean, deviation and bounds alike: every vehicle's own is multiplied
            return f"{drawn[1]}({','.join(f'{float(part) * factor:.6g}' for part in drawn[2].split(','))})"
        value = float(text)
    except ValueError:
        raise invalid_value(field, text, "a number, or norm(...) or normc(...) of numbers") from None
    return f"{max(value * factor, min(value, minimum)):.6g}"


def parse_factor_space(texts: list[str]) -> SearchSpace:
    """Return what is varied, from texts `tau=0.5..2` or `tau=0.5..2:log`; without any, all.

    Raises:
        InputError: a name is unknown, or these are no factors.
    """
    found: SearchSpace = {}
    for name, values in (parse_search_space(texts) if texts else FACTOR_RANGES).items():
        if name not in FACTOR_RANGES:
            raise unknown_name("vary", name, FACTOR_RANGES)
        if not isinstance(values, NumericRange) or not values.low > 0:
            raise invalid_value(f"vary {name}", values.boundary_values, "a range of factors > 0, as 0.5..2")
        found[name] = NumericRange(float(values.low), float(values.high), values.log)
    return found
