"""Read the speeds of recorded vehicles: plain tables of speeds, drives on I-24, and the leaders of trajectories."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError, shorten_list
from unjam.recordings.leaders import LeaderRecording
from unjam.recordings.loaders import (
    ReadOptions,
    alphanumeric,
    detect_format,
    join_row_values,
    split_trajectories,
    to_numeric,
    trajectories_of_table,
)
from unjam.recordings.tables import check_unique, read_table
from unjam.sumo_files import file_stamp

SPEED_UNITS = {"speed": 1.0, "speed_kmh": 1.0 / 3.6, "speed_mph": 0.44704}
"""columns of a table of speeds, one of them, and their unit in m/s"""
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
    frame, options = read_table(path), ReadOptions(min_seconds=MIN_SECONDS, bad_row_hint="")
    names = set(map(str, frame.columns))
    if names.issuperset(I24_COLUMNS):
        frame = pd.DataFrame({"line": frame["line"], "time": frame["Time"], "speed_kmh": frame["Velocity"]})
        names = set(frame.columns)
    frame = frame.rename(columns={name: "time" for name in ("t", "Time") if "time" not in names and name in names})
    check_unique(path, (name for name in map(str, frame.columns) if name == "time"))
    columns = [name for name in SPEED_UNITS if name in names]
    has_leaders = detect_format(frame) != "table" or names & {"leader_speed", "v_lead"}
    if not has_leaders and (len(columns) != 1 or "time" not in frame):
        shown = shorten_list(sorted(names - {"line"}))
        raise InputError(
            f"{path.name}: its columns are {shown}; required: time, and one of {', '.join(SPEED_UNITS)}; or a format "
            "of unjam fit-drivers"
        )
    if has_leaders:
        read = trajectories_of_table(frame, path, options)
    else:
        read = split_trajectories(_follower_table(frame, columns[0], path.stem), path, options)
    found = tuple(LeaderRecording(each.name, each.time_step, each.leader_speed) for each in read.trajectories)
    for each in found:
        changes = np.abs(np.diff(each.speed)) / each.time_step
        if float(np.mean(changes > MAX_ACCELERATION)) > RARE_SHARE:
            raise InputError(
                f"{path.name}: accelerations of {each.name} beyond {MAX_ACCELERATION:g} m/s2 are not allowed; are its "
                f"speeds in m/s? other units have columns of their own: {', '.join(list(SPEED_UNITS)[1:])}"
            )
    return found


def _follower_table(frame: pd.DataFrame, column: str, stem: str) -> pd.DataFrame:
    """Return a table of speeds as one of trajectories with each recorded vehicle as the leader."""
    names = [str(name) for name in frame.columns if alphanumeric(name) in VEHICLE_NAMES]
    # A column without equal values has the numbers of the rows.
    names = [name for name in names if 1 < len(frame[[name]].drop_duplicates()) < len(frame)]
    vehicles = stem + "-" + join_row_values(frame, tuple(names)) if names else stem
    table = to_numeric(frame.loc[:, ["line", "time", column]], ["time", column])
    speed = table[column] * SPEED_UNITS[column]
    return table.assign(pair=vehicles, speed=speed, leader_speed=speed, gap=0.0)
