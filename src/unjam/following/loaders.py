"""Reading car-following data: a plain table, and the public formats of NGSIM and OpenACC."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.errors import InputError, wrong_name
from unjam.following.recorded import COLUMNS, OPTIONAL, Recorded, trajectories_of

ALIASES = {
    "time": ("t",),
    "speed": ("v_foll",),
    "leader_speed": ("v_lead",),
}
"""other names under which a plain table may have a column"""
FOOT = 0.3048
"""[m]"""
VEHICLE_LENGTHS = (3.0, 8.0)
"""within which the median length of vehicles lies, if the units are right [m]"""

NGSIM = ("vehicle_id", "global_time", "local_y", "v_length", "v_vel", "lane_id", "preceding")
RECONSTRUCTED = ("vehicleid", "frameid", "laneid", "localy", "meanspeed", "vehiclelength", "leaderid")
RECONSTRUCTED_ORDER = (
    *("vehicleid", "frameid", "laneid", "localy", "meanspeed"),
    *("meanaccel", "vehiclelength", "vehicleclassid", "followerid", "leaderid"),
)
"""columns of its files, which have no header"""


@dataclass(frozen=True)
class Reading:
    """How a file is read."""

    cut_bad: bool = False
    """whether bad rows are cut out instead of refused"""
    shortest: float = 20.0
    """trajectories shorter than that are left out [s]"""
    driver: tuple[str, ...] = ()
    """plain tables: columns that together name the driver, where `driver` is not one"""
    kind: tuple[str, ...] = ()
    """plain tables: columns that together name the kind of driver, where `kind` is not one"""


def read_pairs(path: Path, format: str = "", reading: Reading | None = None) -> Recorded:
    """Return the trajectories of a file.

    Args:
        path: .parquet or .csv.
        format: a name in FORMATS; empty: told from the file's columns.
        reading: how it is read.

    Raises:
        InputError: the file is missing or of another format, its units are wrong, or a row is bad.
    """
    if format and format not in FORMATS:
        raise wrong_name("format", format, FORMATS)
    frame, about = _read(path)
    return FORMATS[format or _told_format(frame, path)](frame, about, path, reading or Reading())


def read_table(frame: pd.DataFrame, about: dict[str, str], path: Path, reading: Reading) -> Recorded:
    """Return the trajectories of a plain table with the columns COLUMNS, and OPTIONAL if there are such."""
    renamed = {other: name for name, others in ALIASES.items() for other in others if name not in frame}
    frame = frame.rename(columns=renamed)
    _check_columns(frame, COLUMNS, path)
    for name, columns in (("driver", reading.driver), ("kind", reading.kind)):
        if columns and name not in frame:
            _check_columns(frame, columns, path)
            frame[name] = _joined(frame, columns)
    kept = ["line", *COLUMNS, *(name for name in OPTIONAL if name in frame)]
    return trajectories_of(_numbers(frame.loc[:, kept], COLUMNS[1:]), path, reading.cut_bad, reading.shortest)


def read_ngsim(frame: pd.DataFrame, about: dict[str, str], path: Path, reading: Reading) -> Recorded:
    """Return the trajectories of the public NGSIM file (US DOT), which is in feet and milliseconds."""
    frame = frame.rename(columns=str.lower)
    _check_columns(frame, NGSIM, path)
    frame = _numbers(frame, NGSIM)
    place = frame["location"].astype(str) if "location" in frame else pd.Series("", frame.index)
    vehicles = pd.DataFrame(
        {
            "line": frame["line"],
            "place": place,
            "vehicle": frame["vehicle_id"],
            "leader": frame["preceding"],
            "lane": frame["lane_id"],
            "time": frame["global_time"] / 1000.0,
            "front": frame["local_y"] * FOOT,
            "speed": frame["v_vel"] * FOOT,
            "length": frame["v_length"] * FOOT,
        }
    )
    return _behind_leaders(vehicles, path, reading)


def read_reconstructed(frame: pd.DataFrame, about: dict[str, str], path: Path, reading: Reading) -> Recorded:
    """Return the trajectories of the reconstructed NGSIM I-80 (Montanino and Punzo 2015), in metres."""
    frame = frame.rename(columns=_plain)
    _check_columns(frame, RECONSTRUCTED, path)
    frame = _numbers(frame, RECONSTRUCTED)
    vehicles = pd.DataFrame(
        {
            "line": frame["line"],
            "place": path.stem,
            "vehicle": frame["vehicleid"],
            "leader": frame["leaderid"],
            "lane": frame["laneid"],
            "time": frame["frameid"] / 10.0,
            "front": frame["localy"],
            "speed": frame["meanspeed"],
            "length": frame["vehiclelength"],
        }
    )
    return _behind_leaders(vehicles, path, reading)


def read_openacc(frame: pd.DataFrame, about: dict[str, str], path: Path, reading: Reading) -> Recorded:
    """Return the trajectories of an OpenACC file (JRC): a platoon, each vehicle behind the one before it."""
    numbers = sorted(int(name[3:]) for name in frame.columns if re.fullmatch(r"IVS\d+", name))
    if not numbers:
        raise InputError(f"{path.name}: no column IVS1: not an OpenACC file")
    vehicles = [name.strip() for name in about.get("vehicle_order", "").split(",") if name.strip()]
    parts = []
    for number in numbers:
        columns = ["Time", f"Speed{number}", f"Speed{number + 1}", f"IVS{number}"]
        _check_columns(frame, columns, path)
        part = _numbers(frame.loc[:, ["line", *columns]], columns)
        part.columns = ["line", "time", "leader_speed", "speed", "gap"]
        driven = f"Driver{number + 1}"
        kind = frame[driven].astype(str) if driven in frame else pd.Series("", frame.index)
        name = vehicles[number] if number < len(vehicles) else f"vehicle {number + 1}"
        # Who takes over in mid-way is another driver.
        part = part.assign(
            pair=f"{path.stem}-{number + 1}" + np.where(kind == "", "", "-" + kind), driver=name, kind=kind
        )
        parts.append(part)
    return trajectories_of(pd.concat(parts), path, reading.cut_bad, reading.shortest)


FORMATS: dict[str, Callable[[pd.DataFrame, dict[str, str], Path, Reading], Recorded]] = {
    "table": read_table,
    "ngsim": read_ngsim,
    "ngsim-reconstructed": read_reconstructed,
    "openacc": read_openacc,
}


def _behind_leaders(vehicles: pd.DataFrame, path: Path, reading: Reading) -> Recorded:
    """Return the trajectories of a table of single vehicles, each of which names its leader."""
    low, high = VEHICLE_LENGTHS
    typical = float(np.nanmedian(vehicles["length"]))
    if not low <= typical <= high:
        raise InputError(
            f"{path.name}: the median length of its vehicles would be {typical:.1f} m; allowed: {low:g} to "
            f"{high:g} m; are the units those of this format?"
        )
    leaders = vehicles.loc[:, ["place", "time", "vehicle", "front", "speed", "length"]]
    leaders = leaders.drop_duplicates(subset=["place", "time", "vehicle"])
    joined = vehicles.merge(
        leaders,
        left_on=["place", "time", "leader"],
        right_on=["place", "time", "vehicle"],
        how="left",
        suffixes=("", "_ahead"),
    )
    alone = joined["front_ahead"].isna() & joined["front"].notna()
    joined = joined.loc[~alone]
    name = _joined(joined, ("place", "vehicle", "leader", "lane"))
    frame = pd.DataFrame(
        {
            "line": joined["line"],
            "pair": name,
            "driver": _joined(joined, ("place", "vehicle")),
            "kind": "human",
            "time": joined["time"],
            "speed": joined["speed"],
            "leader_speed": joined["speed_ahead"],
            "gap": joined["front_ahead"] - joined["length_ahead"] - joined["front"],
        }
    )
    left_out = {"nobody ahead, or not recorded": int(np.count_nonzero(alone))}
    return trajectories_of(frame, path, reading.cut_bad, reading.shortest, left_out)


def _read(path: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return a file's table with a column `line`, and what lines above its header say."""
    if not path.is_file():
        raise InputError(f"data: {str(path)!r} does not exist")
    about: dict[str, str] = {}
    try:
        if path.suffix == ".parquet":
            frame, header = pd.read_parquet(path), 0
        else:
            header = _header(path, about)
            names = list(RECONSTRUCTED_ORDER) if header < 0 else None
            frame = pd.read_csv(
                path, skiprows=max(0, header), names=names, header=None if names else 0, skipinitialspace=True
            )
    except (ValueError, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
    return frame.assign(line=np.arange(len(frame)) + header + 2), about


def _header(path: Path, about: dict[str, str]) -> int:
    """Return how many lines lie above a CSV file's header; -1: it has none, and its rows are numbers."""
    with open(path, encoding="utf-8-sig") as file:
        lines = [file.readline().strip() for _ in range(20)]
    first = lines[0].split(",")
    if len(first) == len(RECONSTRUCTED_ORDER) and all(
        re.fullmatch(r"\s*-?[\d.eE+-]+", cell) for cell in first
    ):
        return -1
    for number, line in enumerate(lines):
        if re.match(r"time\s*,\s*speed1\b", line, re.IGNORECASE):
            for above in lines[:number]:
                key, _, value = above.partition(",")
                about[key.strip(" :").lower()] = value.strip(",\" '")
            return number
    return 0


def _told_format(frame: pd.DataFrame, path: Path) -> str:
    names = set(map(str, frame.columns))
    if set(NGSIM) <= {name.lower() for name in names}:
        return "ngsim"
    if set(RECONSTRUCTED) <= {_plain(name) for name in names}:
        return "ngsim-reconstructed"
    return "openacc" if {"Speed1", "IVS1"} <= names else "table"


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower()) if name != "line" else name


def _check_columns(frame: pd.DataFrame, wanted: Any, path: Path) -> None:
    missing = [name for name in wanted if name not in frame]
    if missing:
        there = ", ".join(str(name) for name in frame.columns if name != "line")
        raise InputError(f"{path.name}: no column {missing[0]!r}; it has: {there}")


def _joined(frame: pd.DataFrame, columns: tuple[str, ...]) -> pd.Series:
    """Return the words of some columns joined, row by row; of the rows that are alike only once."""
    alike = frame.groupby(list(columns), sort=False, observed=True, dropna=False).ngroup()
    first = frame[list(columns)].loc[~alike.duplicated()]
    words = ["-".join(map(str, row)) for row in first.itertuples(index=False)]
    return pd.Series(np.array(words, object)[alike.to_numpy()], frame.index)


def _numbers(frame: pd.DataFrame, names: Any) -> pd.DataFrame:
    """Return the table with these columns as numbers; what is none becomes NaN, and so a bad row."""
    return frame.assign(**{name: pd.to_numeric(frame[name], errors="coerce") for name in names})
