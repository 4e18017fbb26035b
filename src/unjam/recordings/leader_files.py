"""Read recorded speeds from files: plain tables of speeds, drives on I-24, and leaders in car-following data."""

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError
from unjam.recordings import loaders
from unjam.recordings.leaders import LeaderRecording
from unjam.recordings.tables import check_unique_columns, read_table
from unjam.sumo_files import file_stamp
from unjam.text import shorten_list

SPEED_COLUMN = re.compile("speed|(?:speed|velocity|vel|v)(?:ms|mps)|(?:speed|velocity|vel|v)?(kmh|kmph|kph|mph)")
"""pattern of columns of speeds, as `alphanumeric` returns them: `speedkmh` for `Speed [km/h]`; in m/s without a unit"""
METERS_PER_SECOND = {"mph": 0.44704, **dict.fromkeys(("kmh", "kmph", "kph"), 1.0 / 3.6)}
"""factor of each unit of speed to m/s"""
MAX_SPEED_WITHOUT_UNIT = 45.0
"""highest speed in a column without a unit [m/s]: higher speeds are probably in km/h or mph"""
UNIT_HINT = "name the column by its unit: speed_kmh, speed_mph or speed_ms"
VEHICLE_NAMES = {"pair", "id", "vehicle", "veh", "track", "car", "driver", "trip", "run"}
VEHICLE_NAMES |= {f"{name}id" for name in VEHICLE_NAMES}
"""columns of a table of speeds that identify its vehicles or drives, as `alphanumeric` returns them"""
I24_COLUMNS = ("Time", "Velocity", "SpaceGap", "DrivingDir")
"""columns of drives of the CIRCLES experiment on I-24, with speeds in km/h"""
MIN_SECONDS = 20.0
"""minimum duration of a recording [s]"""
MAX_ACCELERATION = 8.0
"""highest plausible acceleration [m/s2]: speeds in km/h exceed it in a jam"""
MAX_IMPLAUSIBLE_SHARE = 1e-3
"""maximum share of samples with a higher acceleration"""


def read_leaders(path: Path) -> list[LeaderRecording]:
    """Return the recordings in a file, only of leaders if it has some; `InputError` if it is missing or implausible."""
    return list(_read_leaders(path, file_stamp(path)))


@lru_cache(64)
def _read_leaders(path: Path, stamp: tuple[int, int]) -> tuple[LeaderRecording, ...]:
    frame, options = read_table(path), loaders.ReadOptions(min_seconds=MIN_SECONDS, bad_row_hint="")
    names = set(map(str, frame.columns))
    if names.issuperset(I24_COLUMNS):
        frame = pd.DataFrame({"line": frame["line"], "time": frame["Time"], "speed_kmh": frame["Velocity"]})
        names = set(frame.columns)
    frame = frame.rename(columns={name: "time" for name in ("t", "Time") if "time" not in names and name in names})
    check_unique_columns(path, (name for name in map(str, frame.columns) if name == "time"))
    columns = [name for name in map(str, frame.columns) if SPEED_COLUMN.fullmatch(loaders.alphanumeric(name))]
    has_leaders = loaders.detect_format(frame) != "table" or names & {"leader_speed", "v_lead"}
    if not has_leaders and (len(columns) != 1 or "time" not in frame):
        listed = shorten_list(sorted(names - {"line"}))
        raise InputError(
            f"{path.name}: its columns are {listed}; required: time, and one of speed, speed_kmh and speed_mph; or a "
            "format of unjam fit-drivers"
        )
    if has_leaders:
        result = loaders.trajectories_of_table(frame, path, options)
    else:
        table = _follower_table(frame, columns[0], path.stem)
        if not bool(table["speed"].notna().to_numpy().any()):
            raise InputError(f"{path.name}: {columns[0]}: there are no numbers")
        fastest = float(np.nanmax(table["speed"].to_numpy(np.float64)))
        if loaders.alphanumeric(columns[0]) == "speed" and fastest > MAX_SPEED_WITHOUT_UNIT:
            allowed = f"<= {MAX_SPEED_WITHOUT_UNIT:g} m/s without a unit; {UNIT_HINT}"
            raise InputError(f"{path.name}: {columns[0]}: {fastest:g} is not allowed; allowed: {allowed}")
        result = loaders.split_trajectories(table, path, options)
    leaders = tuple(LeaderRecording(pair.name, pair.time_step, pair.leader_speed) for pair in result.trajectories)
    for leader in leaders:
        accelerations = np.abs(np.diff(leader.speed)) / leader.time_step
        if float(np.mean(accelerations > MAX_ACCELERATION)) > MAX_IMPLAUSIBLE_SHARE:
            raise InputError(
                f"{path.name}: accelerations of {leader.name} beyond {MAX_ACCELERATION:g} m/s2 are not allowed; if its "
                f"speeds are not in m/s, {UNIT_HINT}"
            )
    return leaders


def _follower_table(frame: pd.DataFrame, column: str, stem: str) -> pd.DataFrame:
    """Return a table of car following in which each recorded vehicle is the leader, given a table of speeds."""
    names = [str(name) for name in frame.columns if loaders.alphanumeric(name) in VEHICLE_NAMES]
    # A column in which all values differ has indices of rows.
    names = [name for name in names if 1 < len(frame[[name]].drop_duplicates()) < len(frame)]
    vehicles = stem + "-" + loaders.join_row_values(frame, tuple(names)) if names else stem
    table = loaders.to_numeric(frame.loc[:, ["line", "time", column]], ["time", column])
    match = SPEED_COLUMN.fullmatch(loaders.alphanumeric(column))
    speed = table[column] * METERS_PER_SECOND.get(match[1] if match else "", 1.0)
    return table.assign(pair=vehicles, speed=speed, leader_speed=speed, gap=0.0)
