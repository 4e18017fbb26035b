"""What detectors measured, and how near simulated traffic comes to it: GEH and root mean square errors."""

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, isnan, nan
from pathlib import Path

import numpy as np

from unjam.errors import InputError, invalid_value
from unjam.physics.arrays import Floats
from unjam.worlds.sumo.detectors import DetectorPassage

DETECTOR_COLUMNS = ("position", "begin", "end", "flow_veh_per_h", "speed")
"""of a file of measurements, beside `edge` or `lane`"""
GEH_LIMIT = 5.0
"""a flow counts as met below this"""
SAME_PASSAGE_SECONDS = 10.0
"""time within which who comes over loops of the same edge again only changes lanes [s]"""


@dataclass(frozen=True)
class Measurement:
    """What a detector measured in an interval."""

    place: str
    """an edge, all of whose lanes are counted, or a lane"""
    position: float
    """along it [m]"""
    begin: float
    """[s], in the simulation's time"""
    end: float
    """[s]"""
    flow: float
    """[veh/h]"""
    speed: float
    """mean of the vehicles that passed [m/s]; NaN where it is not known"""


@dataclass(frozen=True)
class Agreement:
    """How near simulated traffic is to what was measured."""

    geh: float
    """mean over all intervals of all detectors"""
    geh_below_5: float
    """share of these"""
    flow_rmse: float
    """[veh/h]"""
    speed_rmse: float
    """[m/s]; NaN where no speed was measured"""
    score: float
    """mean GEH over 5, plus the error of speed over the mean measured speed: what calibration makes small"""


def read_detectors(path: Path) -> tuple[str, list[Measurement]]:
    """Return whether a CSV file names places by `edge` or by `lane`, and what it holds; all in SI units.

    Its columns are that one and `COLUMNS`; an empty speed is not known. Other columns are ignored.

    Raises:
        InputError: it is missing, lacks a column, has no rows, or a value is wrong; the line says which.
    """
    if not path.is_file():  # a device would never end
        raise InputError(f"detectors: {str(path)!r} is not a file; allowed: a CSV file")
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            given = reader.fieldnames or ()
            kinds = [kind for kind in ("edge", "lane") if kind in given]
            missing = [name for name in DETECTOR_COLUMNS if name not in given]
            if len(kinds) != 1 or missing:
                allowed = f"edge or lane, {', '.join(DETECTOR_COLUMNS)}"
                raise invalid_value(f"{path.name}: columns", ", ".join(given), allowed)
            rows = [_parse_measurement(path.name, reader.line_num, kinds[0], row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"detectors: {str(path)!r} cannot be read: {why}") from None
    if not rows:
        raise InputError(f"{path.name}: has no rows; allowed: one measurement at least")
    return kinds[0], rows


def _parse_measurement(file: str, line: int, kind: str, row: dict[str, str | None]) -> Measurement:
    where = f"{file}: line {line}"
    place = (row[kind] or "").strip()
    if not place:
        raise invalid_value(f"{where}: {kind}", place, f"the id of one {kind}")
    values = []
    for name in DETECTOR_COLUMNS:
        text = (row[name] or "").strip()
        try:
            value = nan if name == "speed" and not text else float(text)
        except ValueError:
            raise invalid_value(f"{where}: {name}", text, "a number >= 0") from None
        if text and not (isfinite(value) and value >= 0):
            raise invalid_value(f"{where}: {name}", text, "a number >= 0")
        values.append(value)
    found = Measurement(place, *values)
    if found.end <= found.begin:
        raise invalid_value(f"{where}: end", found.end, f"after begin, {found.begin:g} s")
    return found


def aggregate_passages(
    measurements: Sequence[Measurement], loops: Sequence[Sequence[int]], passages: Sequence[DetectorPassage]
) -> tuple[Floats, Floats]:
    """Return the flow [veh/h] and the mean speed [m/s] that each detector would have measured.

    Args:
        measured: place and time of each interval.
        loops: numbers of its loops: one, or one in each lane of an edge, where a vehicle is counted once.
        passed: who passed them.

    Returns:
        Two arrays in the order of `measured`; the speed is NaN where nobody passed who tells one.
    """
    by_loop: defaultdict[int, list[DetectorPassage]] = defaultdict(list)
    for passage in passages:
        by_loop[passage.loop].append(passage)
    known: dict[tuple[int, ...], Floats] = {}
    flows, speeds = np.full((2, len(measurements)), np.nan)
    for number, (row, places) in enumerate(zip(measurements, map(tuple, loops), strict=True)):
        if places not in known:
            known[places] = _unique_passages([passage for place in places for passage in by_loop[place]])
        times, found = known[places]
        first, last = np.searchsorted(times, (row.begin, row.end))
        flows[number] = (last - first) * 3600 / (row.end - row.begin)
        told = found[first:last][np.isfinite(found[first:last])]
        if told.size:
            speeds[number] = told.mean()
    return flows, speeds


def _unique_passages(passages: Sequence[DetectorPassage]) -> Floats:
    """Return times and speeds of passages in the order of time, each vehicle's once, shape (2, n).

    Of passages that are one the first counts, with the speed of the first that tells one.
    """
    before: dict[str, tuple[float, int]] = {}
    kept: list[tuple[float, float]] = []
    for passage in sorted(passages, key=lambda one: one.time):
        last, row = before.get(passage.vehicle, (-np.inf, len(kept)))
        if passage.time - last > SAME_PASSAGE_SECONDS:
            row = len(kept)
            kept.append((passage.time, passage.speed))
        elif isnan(kept[row][1]):
            kept[row] = kept[row][0], passage.speed
        before[passage.vehicle] = passage.time, row
    return np.array(kept, np.float64).reshape(-1, 2).T


def geh(simulated: Floats, measured: Floats) -> Floats:
    """Return the GEH statistic of flows [veh/h], elementwise: sqrt(2 (M - C)² / (M + C)), 0 where both are 0.

    Source: Design Manual for Roads and Bridges, volume 12, section 2, part 1 (UK, 1996).
    """
    both = simulated + measured
    return np.sqrt(2 * (simulated - measured) ** 2 / np.where(both > 0, both, 1.0))


def compute_agreement(measurements: Sequence[Measurement], flows: Floats, speeds: Floats) -> Agreement:
    """Return how near simulated flows [veh/h] and speeds [m/s] are to what was measured, in the same order.

    Where nobody passed the simulated speed is NaN and counts as 0: traffic that stands still is not forgiven.
    """
    counted = np.array([row.flow for row in measurements])
    wanted = np.array([row.speed for row in measurements])
    errors = geh(flows, counted)
    known = np.isfinite(wanted)
    missed = np.nan_to_num(speeds[known]) - wanted[known]
    speed_rmse = float(np.sqrt(np.mean(missed**2))) if known.any() else nan
    typical = float(np.mean(wanted[known])) if known.any() else 0.0
    score = float(np.mean(errors)) / GEH_LIMIT + (speed_rmse / typical if typical else 0.0)
    flow_rmse = float(np.sqrt(np.mean((flows - counted) ** 2)))
    return Agreement(float(np.mean(errors)), float(np.mean(errors < GEH_LIMIT)), flow_rmse, speed_rmse, score)
