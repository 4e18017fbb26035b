"""Read the speeds of recorded vehicles: plain tables of speeds, drives on I-24, and the leaders of trajectories."""

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError
from unjam.recordings import loaders
from unjam.recordings.leaders import LeaderRecording
from unjam.recordings.tables import check_unique, read_table
from unjam.sumo_files import file_stamp
from unjam.text import shorten_list

SPEED_COLUMN = re.compile("speed|(?:speed|velocity|vel|v)(?:ms|mps)|(?:speed|velocity|vel|v)?(kmh|kmph|kph|mph)")
"""columns of speeds in a table, in lower case without other signs, as `Speed [km/h]`; without a unit in m/s"""
METERS_PER_SECOND = {"mph": 0.44704, **dict.fromkeys(("kmh", "kmph", "kph"), 1.0 / 3.6)}
"""units of speed"""
MAX_SPEED_WITHOUT_UNIT = 45.0
"""highest speed in a column that does not name its unit [m/s]: above, it is probably in km/h or mph"""
UNIT_HINT = "name the column by its unit: speed_kmh, speed_mph or speed_ms"
VEHICLE_NAMES = {"pair", "id", "vehicle", "veh", "track", "car", "driver", "trip", "run"}
VEHICLE_NAMES |= {f"{name}id" for name in VEHICLE_NAMES}
"""columns of a table of speeds that tell its vehicles or drives apart, in lower case without underscores"""
I24_COLUMNS = ("Time", "Velocity", "SpaceGap", "DrivingDir")
"""columns by which drives of the CIRCLES experiment on I-24 are recognized; their speeds are in km/h"""
MIN_SECONDS = 20.0
"""shortest recording [s]"""
MAX_ACCELERATION = 8.0
"""acceleration that a vehicle may exceed in one of a thousand samples [m/s2]: in km/h, a jam would exceed it"""
RARE_SHARE = 1e-3


def read_leaders(path: Path) -> list[LeaderRecording]:
    """Return the recordings in a file, of leaders if it has some; `InputError` if it is missing or implausible."""
    return list(_read_leaders(path, file_stamp(path)))


@lru_cache(64)
def _read_leaders(path: Path, stamp: tuple[int, int]) -> tuple[LeaderRecording, ...]:
    frame, options = read_table(path), loaders.ReadOptions(min_seconds=MIN_SECONDS, bad_row_hint="")
    names = set(map(str, frame.columns))
    if names.issuperset(I24_COLUMNS):
        frame = pd.DataFrame({"line": frame["line"], "time": frame["Time"], "speed_kmh": frame["Velocity"]})
        names = set(frame.columns)
    frame = frame.rename(columns={name: "time" for name in ("t", "Time") if "time" not in names and name in names})
    check_unique(path, (name for name in map(str, frame.columns) if name == "time"))
    columns = [name for name in map(str, frame.columns) if SPEED_COLUMN.fullmatch(loaders.alphanumeric(name))]
    has_leaders = loaders.detect_format(frame) != "table" or names & {"leader_speed", "v_lead"}
    if not has_leaders and (len(columns) != 1 or "time" not in frame):
        shown = shorten_list(sorted(names - {"line"}))
        raise InputError(
            f"{path.name}: its columns are {shown}; required: time, and one of speed, speed_kmh and speed_mph; or a "
            "format of unjam fit-drivers"
        )
    if has_leaders:
        read = loaders.trajectories_of_table(frame, path, options)
    else:
        table = _follower_table(frame, columns[0], path.stem)
        if not bool(table["speed"].notna().to_numpy().any()):
            raise InputError(f"{path.name}: {columns[0]}: there are no numbers")
        fastest = float(np.nanmax(table["speed"].to_numpy(np.float64)))
        if loaders.alphanumeric(columns[0]) == "speed" and fastest > MAX_SPEED_WITHOUT_UNIT:
            allowed = f"<= {MAX_SPEED_WITHOUT_UNIT:g} m/s without a unit; {UNIT_HINT}"
            raise InputError(f"{path.name}: {columns[0]}: {fastest:g} is not allowed; allowed: {allowed}")
        read = loaders.split_trajectories(table, path, options)
    found = tuple(LeaderRecording(each.name, each.time_step, each.leader_speed) for each in read.trajectories)
    for each in found:
        changes = np.abs(np.diff(each.speed)) / each.time_step
        if float(np.mean(changes > MAX_ACCELERATION)) > RARE_SHARE:
            raise InputError(
                f"{path.name}: accelerations of {each.name} beyond {MAX_ACCELERATION:g} m/s2 are not allowed; if its "
                f"speeds are not in m/s, {UNIT_HINT}"
            )
    return found


def _follower_table(frame: pd.DataFrame, column: str, stem: str) -> pd.DataFrame:
    """Return a table of speeds as one of trajectories with each recorded vehicle as the leader."""
    names = [str(name) for name in frame.columns if loaders.alphanumeric(name) in VEHICLE_NAMES]
    # A column without equal values has the numbers of the rows.
    names = [name for name in names if 1 < len(frame[[name]].drop_duplicates()) < len(frame)]
    vehicles = stem + "-" + loaders.join_row_values(frame, tuple(names)) if names else stem
    table = loaders.to_numeric(frame.loc[:, ["line", "time", column]], ["time", column])
    match = SPEED_COLUMN.fullmatch(loaders.alphanumeric(column))
    speed = table[column] * METERS_PER_SECOND.get(match[1] if match else "", 1.0)
    return table.assign(pair=vehicles, speed=speed, leader_speed=speed, gap=0.0)
