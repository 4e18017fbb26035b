"""Recorded rows as trajectories: every number is checked, and nothing is left out without a word."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError
from unjam.following.pairs import Pair

COLUMNS = ("pair", "time", "speed", "leader_speed", "gap")
"""what every row must have: [s], [m/s], [m/s], [m]"""
OPTIONAL = ("driver", "kind", "split")
ALLOWED = {"speed": (0.0, 70.0), "leader_speed": (0.0, 70.0), "gap": (0.0, 1000.0)}
"""what a vehicle on a road can do; beyond it the units are wrong, or the row is"""
ROUGHNESS = 0.01
"""by how much moments may be unevenly spaced, relative to the time step"""
LISTED = 5
"""bad rows that a message names"""


@dataclass(frozen=True)
class BadRow:
    """A row that cannot be used."""

    line: int
    """in the file, its header being line 1"""
    why: str


@dataclass(frozen=True)
class Recorded:
    """What a file holds."""

    pairs: list[Pair] = field(repr=False)
    rows: int
    """in the file"""
    bad: list[BadRow]
    """rows that were cut out, with what was wrong"""
    left_out: dict[str, int]
    """rows that are not wrong but of no use, by reason"""

    def words(self) -> list[str]:
        """Return lines that say what was read and what was not."""
        moments = sum(len(pair.speed) for pair in self.pairs)
        lines = [f"{len(self.pairs)} trajectories with {moments:,} of {self.rows:,} rows"]
        lines += [f"left out: {count:,} rows: {why}" for why, count in self.left_out.items() if count]
        lines += [f"cut out: line {row.line}: {row.why}" for row in self.bad[:LISTED]]
        if len(self.bad) > LISTED:
            lines.append(f"cut out: {len(self.bad) - LISTED} more bad rows")
        return lines


def trajectories_of(
    frame: pd.DataFrame,
    path: Path,
    cut_bad: bool,
    shortest: float,
    left_out: dict[str, int] | None = None,
) -> Recorded:
    """Return the trajectories of a table with the columns `line`, COLUMNS and OPTIONAL, SI units.

    A trajectory is a run of evenly spaced rows of one pair; where a moment is missing, another begins.

    Args:
        frame: rows in any order; `line` is where each was in the file.
        path: of the file, for messages.
        cut_bad: whether bad rows are cut out, and end their trajectory; if not, they are an error.
        shortest: trajectories shorter than that are left out, and counted [s].
        left_out: what the loader has left out already.

    Raises:
        InputError: a row is bad, or nothing is left.
    """
    bad = _bad_rows(frame)
    if bad and not cut_bad:
        more = f" ({len(bad)} bad rows)" if len(bad) > 1 else ""
        raise InputError(f"{path.name}: line {bad[0].line}: {bad[0].why}{more}; --cut-bad leaves them out")
    good = frame.loc[~frame["line"].isin([row.line for row in bad])]
    good = good.sort_values(by=["pair", "time"], kind="stable")
    step = _step(good)
    runs = _runs(good, step)
    pairs: list[Pair] = []
    parts: dict[str, int] = {}
    short = 0
    for _, rows in good.groupby(runs, sort=False):
        if (len(rows) - 1) * step < shortest or len(rows) < 2:
            short += len(rows)
            continue
        pair = str(rows["pair"].iloc[0])
        speed, leader_speed, gap = (rows[name].to_numpy(np.float64) for name in COLUMNS[2:])
        driver, kind, split = (str(rows[name].iloc[0]) if name in rows else "" for name in OPTIONAL)
        parts[pair] = parts.get(pair, 0) + 1
        name = pair if parts[pair] == 1 else f"{pair}/{parts[pair]}"
        pairs.append(Pair(name, driver or pair, step, speed, leader_speed, gap, kind, split))
    if not pairs:
        raise InputError(f"{path.name}: no trajectory lasts {shortest:g} s")
    why = {**(left_out or {}), f"trajectories shorter than {shortest:g} s": short}
    return Recorded(pairs, len(frame) + sum((left_out or {}).values()), bad, why)


def _bad_rows(frame: pd.DataFrame) -> list[BadRow]:
    found: dict[int, str] = {}
    for name in COLUMNS[1:]:
        values = frame[name].to_numpy(np.float64)
        low, high = ALLOWED.get(name, (-np.inf, np.inf))
        wrong = ~np.isfinite(values) | (values < low) | (values > high)
        allowed = f"{low:g} to {high:g}" if name in ALLOWED else "finite"
        for line, value in zip(frame["line"][wrong], values[wrong], strict=True):
            found.setdefault(int(line), f"{name}: {value:g} is not allowed; allowed: {allowed}")
    twice = frame.assign(time=frame["time"].round(6)).duplicated(["pair", "time"])
    for line, time in zip(frame["line"][twice], frame["time"][twice], strict=True):
        found.setdefault(int(line), f"time: {time:g} is there twice in its pair")
    return [BadRow(line, found[line]) for line in sorted(found)]


def _step(frame: pd.DataFrame) -> float:
    """Return the time between two rows [s]: that of most of them."""
    steps = np.diff(frame["time"].to_numpy())[np.diff(frame["pair"].astype("category").cat.codes) == 0]
    if len(steps) == 0:
        raise InputError("time: no pair has two rows")
    return round(float(np.median(steps)), 4)  # times in single precision are no better


def _runs(frame: pd.DataFrame, step: float) -> np.ndarray:
    """Return a number for each row that grows where a moment is missing."""
    same = np.diff(frame["pair"].astype("category").cat.codes) == 0
    even = np.abs(np.diff(frame["time"].to_numpy()) - step) <= ROUGHNESS * step
    return np.r_[0, np.cumsum(~(same & even))]
