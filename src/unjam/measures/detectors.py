"""Detector measurements, and the agreement of simulated traffic with them: GEH and root mean square errors."""

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np

from unjam.errors import InputError, invalid_value
from unjam.physics.arrays import Floats
from unjam.worlds.sumo.simulation import DetectorPassage

DETECTOR_COLUMNS = ("position", "begin", "end", "flow_veh_per_h", "speed")
"""columns of a file of measurements, in addition to `edge` or `lane`"""
MAX_NUMBER = 1e9  # largest allowed number in a file
TIME_TOLERANCE = 1e-6
"""time by which intervals may overlap because their ends are rounded [s]"""
GEH_LIMIT = 5.0  # GEH below which a simulated flow agrees with the measured flow
SAME_PASSAGE_SECONDS = 10.0  # time within which a second passage on an edge is only a lane change [s]


@dataclass(frozen=True)
class Measurement:
    """The measurement of a detector in one interval."""

    location: str  # id of a lane, or of an edge, on which all lanes are counted
    position: float  # position on the edge or lane [m]
    begin: float  # begin of the interval, in simulation time [s]
    end: float  # end of the interval, in simulation time [s]
    flow: float  # flow [veh/h]
    speed: float  # mean speed of the vehicles that passed [m/s]; NaN if unknown


@dataclass(frozen=True)
class Agreement:
    """Agreement of simulated traffic with measurements."""

    geh: float  # mean GEH over all intervals of all detectors
    geh_below_5: float  # share of the intervals with a GEH below 5
    flow_rmse: float  # root mean square error of the flow [veh/h]
    speed_rmse: float  # root mean square error of the speed [m/s]; NaN if no speed was measured
    score: float  # objective of calibration, to minimize: mean GEH / 5 + speed RMSE / mean measured speed


def read_detectors(path: Path) -> tuple[str, list[Measurement]]:
    """Return `edge` or `lane`, the column of a CSV file that locates detectors, and the measurements of the file.

    The file needs this column and `DETECTOR_COLUMNS`; other columns are ignored. Speeds are unknown if they are empty
    or if the flow is 0. Raise `InputError` if the file, a column or all rows are missing, and if a column is repeated.
    Raise it with the line if a value is wrong, a row and the header differ in length, or intervals of a detector
    overlap.
    """
    if not path.is_file():  # reading a device would never end
        raise InputError(f"detectors: {str(path)!r} is not a file; allowed: a CSV file")
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or ()
            kinds = [kind for kind in ("edge", "lane") if kind in columns]
            if len(kinds) != 1 or not set(DETECTOR_COLUMNS) <= set(columns):
                allowed = f"edge or lane, {', '.join(DETECTOR_COLUMNS)}"
                raise invalid_value(f"{path.name}: columns", ", ".join(columns), allowed)
            for name in (kinds[0], *DETECTOR_COLUMNS):
                if columns.count(name) > 1:
                    raise invalid_value(f"{path.name}: columns named {name}", columns.count(name), "one")
            lines = [(reader.line_num, _parse_measurement(path.name, reader.line_num, kinds[0], row)) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"detectors: {str(path)!r} cannot be read: {reason}") from None
    if not lines:
        raise InputError(f"{path.name}: has no rows; allowed: one measurement at least")
    lines_by_detector = sorted(lines, key=lambda entry: (*_detector(entry[1]), entry[1].begin, entry[0]))
    for (previous_line, previous_row), (line, row) in pairwise(lines_by_detector):
        if _detector(row) == _detector(previous_row) and row.begin < previous_row.end - TIME_TOLERANCE:
            allowed = "intervals of a detector that do not overlap"
            raise InputError(
                f"{path.name}: line {line}: overlaps the interval of line {previous_line}; allowed: {allowed}"
            )
    return kinds[0], [row for _, row in lines]


def _detector(measurement: Measurement) -> tuple[str, float]:
    return measurement.location, measurement.position


def _parse_measurement(file: str, line: int, kind: str, row: dict[str, str | None]) -> Measurement:
    context = f"{file}: line {line}"
    surplus: Any = row.get(None) or ()  # pyright: ignore[reportArgumentType]  (the key of cells without a column)
    if any(surplus) or None in row.values():
        relation = "more" if any(surplus) else "fewer"
        raise InputError(f"{context}: has {relation} cells than the header; allowed: as many")
    location = (row[kind] or "").strip()
    if not location:
        raise invalid_value(f"{context}: {kind}", location, f"the id of one {kind}")
    values = []
    for name in DETECTOR_COLUMNS:
        text = (row[name] or "").strip()
        try:
            value = nan if name == "speed" and not text else float(text)
        except ValueError:
            value = nan
        if (text or name != "speed") and not (0 <= value <= MAX_NUMBER and "_" not in text):
            raise invalid_value(f"{context}: {name}", text, f"a number >= 0, <= {MAX_NUMBER:g}")
        values.append(value)
    measurement = Measurement(location, *values)
    if measurement.flow == 0:  # without vehicles, detectors write 0 or the speed limit
        measurement = replace(measurement, speed=nan)
    if measurement.end <= measurement.begin:
        raise invalid_value(f"{context}: end", measurement.end, f"after begin, {measurement.begin:g} s")
    return measurement


def aggregate_passages(
    measurements: Sequence[Measurement], loops: Sequence[Sequence[int]], passages: Sequence[DetectorPassage]
) -> tuple[Floats, Floats]:
    """Return the flow [veh/h] and the mean speed [m/s] that each detector would have measured.

    Both arrays have the order of `measurements`; the speed is NaN without a passage of known speed. `loops` has the
    indices of the loops of each measurement: one loop, or one in each lane of an edge, where a vehicle counts once.
    """
    passages_by_loop: defaultdict[int, list[DetectorPassage]] = defaultdict(list)
    for passage in passages:
        passages_by_loop[passage.loop].append(passage)
    detectors: dict[tuple[int, ...], Floats] = {}
    flows, speeds = np.full((2, len(measurements)), np.nan)
    for index, (row, detector) in enumerate(zip(measurements, map(tuple, loops), strict=True)):
        if detector not in detectors:
            detectors[detector] = _unique_passages([entry for loop in detector for entry in passages_by_loop[loop]])
        times, passage_speeds = detectors[detector]
        begin, end = np.searchsorted(times, (row.begin, row.end))
        flows[index] = (end - begin) * 3600 / (row.end - row.begin)
        known_speeds = passage_speeds[begin:end][np.isfinite(passage_speeds[begin:end])]
        if known_speeds.size:
            speeds[index] = known_speeds.mean()
    return flows, speeds


def _unique_passages(passages: Sequence[DetectorPassage]) -> Floats:
    """Return times and speeds of passages, sorted by time, shape (2, n); a lane change is no second passage.

    A vehicle that passes several loops has the time of the first loop and the first known speed.
    """
    last_passages: dict[str, tuple[float, int]] = {}
    rows: list[tuple[float, float]] = []
    for passage in sorted(passages, key=lambda entry: entry.time):
        last_time, row = last_passages.get(passage.vehicle, (-np.inf, len(rows)))
        if passage.time - last_time > SAME_PASSAGE_SECONDS:
            row = len(rows)
            rows.append((passage.time, passage.speed))
        elif isnan(rows[row][1]):
            rows[row] = rows[row][0], passage.speed
        last_passages[passage.vehicle] = passage.time, row
    return np.array(rows, np.float64).reshape(-1, 2).T


def geh(simulated: Floats, measured: Floats) -> Floats:
    """Return the GEH statistic of flows [veh/h], elementwise: sqrt(2 (M - C)² / (M + C)), 0 if both are 0.

    Source: Design Manual for Roads and Bridges, volume 12, section 2, part 1 (UK, 1996).
    """
    total = simulated + measured
    return np.sqrt(2 * (simulated - measured) ** 2 / np.where(total > 0, total, 1.0))


def compute_agreement(measurements: Sequence[Measurement], flows: Floats, speeds: Floats) -> Agreement:
    """Return the agreement of simulated flows [veh/h] and speeds [m/s] with the measurements, in their order.

    The simulated speed of an interval without vehicles is NaN and counts as 0, because traffic may stand still.
    """
    measured_flows = np.array([row.flow for row in measurements])
    measured_speeds = np.array([row.speed for row in measurements])
    errors = geh(flows, measured_flows)
    is_measured = np.isfinite(measured_speeds)
    speed_errors = np.nan_to_num(speeds[is_measured]) - measured_speeds[is_measured]
    speed_rmse = float(np.sqrt(np.mean(speed_errors**2))) if is_measured.any() else nan
    mean_speed = float(np.mean(measured_speeds[is_measured])) if is_measured.any() else 0.0
    score = float(np.mean(errors)) / GEH_LIMIT + (speed_rmse / mean_speed if mean_speed else 0.0)
    flow_rmse = float(np.sqrt(np.mean((flows - measured_flows) ** 2)))
    return Agreement(float(np.mean(errors)), float(np.mean(errors < GEH_LIMIT)), flow_rmse, speed_rmse, score)
