"""A user's network with detectors, and the factors on its human drivers and demand that can be varied."""

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
from unjam.worlds.sumo.networks import network_geometry
from unjam.worlds.sumo.simulation import InductionLoop

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
"""defaults of passenger types"""
NORMAL_DISTRIBUTION = re.compile(r"(normc?)\(([^()]*)\)")
"""a speed factor that is drawn for each vehicle"""

CalibrationFactors = dict[str, float]
"""by the names of `FACTOR_RANGES`"""


@dataclass(frozen=True)
class Corridor:
    """A network and its detector measurements, both checked."""

    files: SumoFiles
    detectors: Path
    begin: float
    """[s]"""
    end: float
    """[s]"""
    measurements: tuple[Measurement, ...]
    """intervals between `begin` and `end`"""
    excluded_count: int
    """number of other intervals"""
    loops: tuple[InductionLoop, ...]
    loop_numbers: tuple[tuple[int, ...], ...]
    """numbers of the loops of each measurement"""

    def scenario(self, file: Path) -> UserNetwork:
        """Return the human-only traffic of a variant of the network, until the last measurement."""
        options = {"penetration_rate": ZERO_PENETRATION_RATE, "cav_types": (), "begin": self.begin, "end": self.end}
        return load_user_network(str(file), options)

    def metadata(self) -> dict[str, Any]:
        """Return names and hashes of the files, and the times of the measurements."""
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
    """Return a network and its detector measurements, both checked.

    Args:
        file: a .sumocfg file.
        detectors: a CSV file, as for `measures.detectors.read_detectors`.
        begin: start time [s]; None: that of the configuration.
        end: end time [s]; None: that of the configuration, or of the last interval.

    Raise `InputError` if an argument is wrong, a detector is not on the network, or nothing can be varied.
    """
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    kind, rows = read_detectors(detectors)
    # The penetration rate is so small that no vehicle is a CAV.
    times = {name: time for name, time in (("begin", begin), ("end", end)) if time is not None}
    checked = load_user_network(file, {"penetration_rate": ZERO_PENETRATION_RATE, "cav_classes": ROAD_CLASSES, **times})
    files = read_sumo_files(Path(checked.file))
    first = files.begin if begin is None else begin
    last = next((limit for limit in (end, files.end) if limit is not None), inf)
    used = [row for row in rows if row.begin >= first and row.end <= last]
    if not used:
        raise InputError(f"{detectors.name}: no interval lies between {first:g} s and {last:g} s")
    if not passenger_types(files):
        known = ", ".join(sorted(files.used_types))
        raise InputError(f"{files.path.name}: no vehicle type is a passenger car; its types are {known}")
    row_loops = [_detector_loops(files.network, kind, row) for row in used]
    numbers = {loop: number for number, loop in enumerate(dict.fromkeys(loop for each in row_loops for loop in each))}
    loop_numbers = tuple(tuple(numbers[loop] for loop in each) for each in row_loops)
    end_time = max(row.end for row in used)
    excluded = len(rows) - len(used)
    return Corridor(files, detectors, first, end_time, tuple(used), excluded, tuple(numbers), loop_numbers)


def _detector_loops(network: Path, kind: str, row: Measurement) -> list[InductionLoop]:
    """Return the loops of a detector; raise `InputError` if the network has no such place."""
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
    """Return the changed attributes of all passenger types multiplied by `factors`, by id.

    A reaction time never falls below the simulation step, because vehicles would collide. Raise `InputError` if an
    attribute is not a number.
    """
    scaled: dict[str, dict[str, str]] = {}
    for name in passenger_types(files):
        attributes = {**{key: str(value) for key, value in SUMO_TYPE_DEFAULTS.items()}, **files.types.get(name, {})}
        changes = {
            key: _scale_attribute(f"vType {name}: {key}", attributes[key], factor, files.step if key == "tau" else 0.0)
            for key, factor in factors.items()
            if key != FLOW_FACTOR and factor != 1
        }
        if changes:
            scaled[name] = changes
    return scaled


def _scale_attribute(field: str, text: str, factor: float, minimum: float) -> str:
    drawn = NORMAL_DISTRIBUTION.fullmatch(text.replace(" ", ""))
    try:
        if drawn:  # mean, deviation and bounds: this multiplies the value of each vehicle
            return f"{drawn[1]}({','.join(f'{float(part) * factor:.6g}' for part in drawn[2].split(','))})"
        value = float(text)
    except ValueError:
        raise invalid_value(field, text, "a number, or norm(...) or normc(...) of numbers") from None
    return f"{max(value * factor, min(value, minimum)):.6g}"


def parse_factor_space(texts: list[str]) -> SearchSpace:
    """Return a search space from texts `tau=0.5..2` or `tau=0.5..2:log`; without any, `FACTOR_RANGES`.

    Raise `InputError` for unknown names and for values that are not positive ranges.
    """
    space: SearchSpace = {}
    for name, values in (parse_search_space(texts) if texts else FACTOR_RANGES).items():
        if name not in FACTOR_RANGES:
            raise unknown_name("vary", name, FACTOR_RANGES)
        if not isinstance(values, NumericRange) or not values.low > 0:
            raise invalid_value(f"vary {name}", values.boundary_values, "a range of factors > 0, as 0.5..2")
        space[name] = NumericRange(float(values.low), float(values.high), values.log)
    return space
