"""Reading car-following data: a plain table, the public formats of NGSIM, highD and OpenACC, and SUMO's own.

Every number is checked, and nothing is left out without a word.
"""

import re
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError, unknown_name
from unjam.following.pairs import BadRow, Pair, ReadOptions, ReadResult

PAIR_COLUMNS = ("pair", "time", "speed", "leader_speed", "gap")
"""what every row must have: [s], [m/s], [m/s], [m]"""
OPTIONAL_COLUMNS = ("driver", "kind", "split")
COLUMN_ALIASES = {"t": "time", "v_foll": "speed", "v_lead": "leader_speed"}
"""other names under which a plain table may have a column"""
VALUE_LIMITS = {"speed": (0.0, 70.0), "leader_speed": (0.0, 70.0), "gap": (0.0, 1000.0)}
"""what a vehicle on a road can do; beyond it the units are wrong, or the row is"""
TIME_STEP_TOLERANCE = 0.01
"""by how much moments may be unevenly spaced, relative to the time step"""
METERS_PER_FOOT = 0.3048
"""[m]"""
MEDIAN_LENGTH_LIMITS = (3.0, 8.0)
"""within which the median length of vehicles lies, if the units are right [m]"""

NGSIM_COLUMNS = {
    **{"vehicle_id": "vehicle", "global_time": "time", "local_y": "front", "v_length": "length"},
    **{"v_vel": "speed", "lane_id": "lane", "preceding": "leader"},
}
"""our names of the columns of the public NGSIM file (US DOT), by its own in small letters"""
RECONSTRUCTED_COLUMNS = {
    **{"vehicleid": "vehicle", "frameid": "time", "laneid": "lane", "localy": "front"},
    **{"meanspeed": "speed", "vehiclelength": "length", "leaderid": "leader"},
}
"""of those of the reconstructed NGSIM I-80 (Montanino and Punzo 2015), by letters alone"""
HIGHD_COLUMNS = {
    **{"id": "vehicle", "frame": "time", "x": "front", "width": "length", "xVelocity": "speed"},
    **{"laneId": "lane", "precedingId": "leader"},
}
"""of those of the tracks of highD (Krajewski et al. 2018)"""
HIGHD_FRAME_RATE = 25.0
"""frames of highD per second"""
MAX_VEHICLE_ABSENCE = 60.0
"""who was not seen for longer is somebody else with the same number [s]"""
FCD_COLUMNS = {
    **{"timestep_time": "time", "vehicle_speed": "speed"},
    **{"vehicle_leaderSpeed": "leader_speed", "vehicle_leaderGap": "gap"},
}
"""of those of SUMO's FCD output as CSV, which has leaders with --fcd-output.max-leader-distance"""
RECONSTRUCTED_COLUMN_ORDER = (
    *("vehicleid", "frameid", "laneid", "localy", "meanspeed"),
    *("meanaccel", "vehiclelength", "vehicleclassid", "followerid", "leaderid"),
)
"""columns of its files, which have no header"""


def read_pairs(path: Path, format: str = "", options: ReadOptions | None = None) -> ReadResult:
    """Return the trajectories of a file.

    Args:
        path: .parquet or .csv.
        format: a name in FORMATS; empty: told from the file's columns.
        reading: how it is read.

    Raises:
        InputError: the file is missing or of another format, its units are wrong, or a row is bad.
    """
    if format and format not in PAIR_FORMATS:
        raise unknown_name("format", format, PAIR_FORMATS)
    frame = _read_frame(path)
    return PAIR_FORMATS[format or _detect_format(frame)](frame, path, options or ReadOptions())


def _read_table(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a plain table with the columns COLUMNS, and OPTIONAL if there are such."""
    frame = frame.rename(columns={other: name for other, name in COLUMN_ALIASES.items() if name not in frame})
    _check_columns(frame, PAIR_COLUMNS, path)
    for name, columns in (("driver", options.driver_columns), ("kind", options.kind_columns)):
        if columns and name not in frame:
            _check_columns(frame, columns, path)
            frame[name] = _join_columns(frame, columns)
    return _split_trajectories(_to_numeric(frame, PAIR_COLUMNS[1:]), path, options)


def _read_ngsim(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of the public NGSIM file, which is in feet and milliseconds."""
    frame = frame.rename(columns=str.lower)
    site = frame["location"].astype(str) if "location" in frame else ""
    vehicles = _select_columns(frame, NGSIM_COLUMNS, path)
    lengths = {name: vehicles[name] * METERS_PER_FOOT for name in ("front", "speed", "length")}
    vehicles = vehicles.assign(site=site, time=vehicles["time"] / 1000.0, **lengths)
    return _pairs_from_vehicles(vehicles, path, options)


def _read_reconstructed(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of the reconstructed NGSIM I-80, in metres and tenths of a second."""
    vehicles = _select_columns(frame.rename(columns=_alphanumeric), RECONSTRUCTED_COLUMNS, path)
    vehicles = vehicles.assign(site=path.stem, time=vehicles["time"] / 10.0)
    return _pairs_from_vehicles(vehicles, path, options)


def _read_highd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a file of highD, in which x is the left end of a vehicle's box.

    On one of the two carriageways all drive towards smaller x: there places count the other way.
    """
    vehicles = _select_columns(frame, HIGHD_COLUMNS, path)
    # Of a whole lane: who stands has no direction.
    onwards = vehicles.groupby("lane")["speed"].transform("sum").to_numpy() >= 0
    front = (vehicles["front"] + vehicles["length"]).where(onwards, -vehicles["front"])
    moving = {"front": front, "speed": vehicles["speed"].abs(), "time": vehicles["time"] / HIGHD_FRAME_RATE}
    return _pairs_from_vehicles(vehicles.assign(site=path.stem, **moving), path, options)


def _read_fcd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of SUMO's FCD output: a vehicle behind one leader in one lane is a pair."""
    told = ("vehicle_id", "vehicle_leaderID", "vehicle_lane")
    vehicles = _select_columns(frame, FCD_COLUMNS, path)
    _check_columns(frame, told, path)
    alone = vehicles["gap"] < 0
    vehicles = vehicles.assign(
        pair=_join_columns(frame, told), driver=frame["vehicle_id"].astype(str), kind="simulated"
    )
    return _split_trajectories(vehicles.loc[~alone], path, options, {"no leader": int(np.count_nonzero(alone))})


def _pairs_from_vehicles(vehicles: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a table of single vehicles, each of which names its leader."""
    low, high = MEDIAN_LENGTH_LIMITS
    typical = float(np.nanmedian(vehicles["length"]))
    if not low <= typical <= high:
        raise InputError(
            f"{path.name}: the median length of its vehicles would be {typical:.1f} m; allowed: {low:g} to "
            f"{high:g} m; are the units those of this format?"
        )
    key = ["site", "time", "leader"]
    leaders = vehicles.loc[:, ["site", "time", "vehicle", "front", "speed", "length"]]
    leaders = leaders.rename(columns={"vehicle": "leader"}).drop_duplicates(key)
    vehicles = vehicles.merge(leaders, on=key, how="left", suffixes=("", "_ahead"))
    alone = vehicles["front_ahead"].isna() & vehicles["front"].notna()
    vehicles = vehicles.loc[~alone]
    frame = vehicles.assign(
        pair=_join_columns(vehicles, ("site", "vehicle", "leader", "lane")),
        driver=_join_columns(
            vehicles.assign(suffix=_reused_number_suffix(vehicles)), ("site", "vehicle", "suffix")
        ).str.rstrip("-"),
        kind="human",
        leader_speed=vehicles["speed_ahead"],
        gap=vehicles["front_ahead"] - vehicles["length_ahead"] - vehicles["front"],
    )
    return _split_trajectories(frame, path, options, {"no leader, or leader not recorded": int(np.count_nonzero(alone))})


def _reused_number_suffix(vehicles: pd.DataFrame) -> pd.Series:
    """Return "2" for the second with a number, and so on: NGSIM's begin anew every quarter of an hour."""
    ordered = vehicles.sort_values(by="time", kind="stable")
    who = [ordered["site"], ordered["vehicle"]]
    longer = ordered["time"].groupby(who, dropna=False).diff() > MAX_VEHICLE_ABSENCE
    before = longer.groupby(who, dropna=False).cumsum().to_numpy(int)
    return pd.Series(np.where(before > 0, (before + 1).astype(str), ""), ordered.index)


def _read_openacc(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of an OpenACC file (JRC): a platoon, each vehicle behind the one before it."""
    numbers = sorted(int(name[3:]) for name in frame.columns if re.fullmatch(r"IVS\d+", name))
    if not numbers:
        raise InputError(f"{path.name}: no column IVS1: not an OpenACC file")
    vehicles = [name.strip() for name in frame.attrs.get("vehicle_order", "").split(",") if name.strip()]
    parts = []
    for number in numbers:
        speeds = {f"Speed{number}": "leader_speed", f"Speed{number + 1}": "speed"}
        part = _select_columns(frame, {"Time": "time", **speeds, f"IVS{number}": "gap"}, path)
        driver = f"Driver{number + 1}"
        kind = frame[driver].astype(str) if driver in frame else pd.Series("", frame.index)
        # Who takes over in mid-way is another driver.
        marks = np.where(kind == "", "", "-" + kind)
        name = vehicles[number] if number < len(vehicles) else f"vehicle {number + 1}"
        who = name + marks if len(set(kind)) > 1 else name
        parts.append(part.assign(pair=f"{path.stem}-{number + 1}" + marks, driver=who, kind=kind))
    return _split_trajectories(pd.concat(parts), path, options)


PAIR_FORMATS: dict[str, Callable[[pd.DataFrame, Path, ReadOptions], ReadResult]] = {
    "table": _read_table,
    "ngsim": _read_ngsim,
    "ngsim-reconstructed": _read_reconstructed,
    "openacc": _read_openacc,
    "highd": _read_highd,
    "fcd": _read_fcd,
}


def _read_frame(path: Path) -> pd.DataFrame:
    """Return a file's table with a column `line`; its `attrs` are what lines above its header say."""
    if not path.is_file():
        raise InputError(f"data: {str(path)!r} does not exist")
    header, about = 0, dict[Hashable, str]()
    try:
        if path.suffix == ".parquet":
            frame = pd.read_parquet(path)
        else:
            header, about = _find_header(path)
            bare = {"names": list(RECONSTRUCTED_COLUMN_ORDER), "header": None} if header < 0 else {}
            with open(path, encoding="utf-8-sig") as file:
                mark = ";" if file.readline().startswith("timestep_") else ","  # SUMO's, and everybody's
            frame = pd.read_csv(path, sep=mark, skiprows=max(0, header), skipinitialspace=True, **bare)
    except (ValueError, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
    frame = frame.assign(line=np.arange(len(frame)) + header + 2)
    frame.attrs = about
    return frame


def _find_header(path: Path) -> tuple[int, dict[Hashable, str]]:
    """Return how many lines lie above a CSV file's header (-1: it has none), and what these say."""
    with open(path, encoding="utf-8-sig") as file:
        lines = [file.readline().strip() for _ in range(20)]
    first = lines[0].split(",")
    numbers = all(re.fullmatch(r"\s*-?[\d.eE+-]+", cell) for cell in first)
    if numbers and len(first) == len(RECONSTRUCTED_COLUMN_ORDER):
        return -1, {}
    for number, line in enumerate(lines):
        if re.match(r"time\s*,\s*speed1\b", line, re.IGNORECASE):
            above = [line.partition(",") for line in lines[:number]]
            return number, {key.strip(" :").lower(): value.strip(",\" '") for key, _, value in above}
    return 0, {}


def _detect_format(frame: pd.DataFrame) -> str:
    names = set(map(str, frame.columns))
    if NGSIM_COLUMNS.keys() <= {name.lower() for name in names}:
        return "ngsim"
    if RECONSTRUCTED_COLUMNS.keys() <= set(map(_alphanumeric, names)):
        return "ngsim-reconstructed"
    for name, columns in (("highd", HIGHD_COLUMNS), ("fcd", {"timestep_time", "vehicle_id"})):
        if names >= set(columns):
            return name
    return "openacc" if {"Speed1", "IVS1"} <= names else "table"


def _alphanumeric(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _select_columns(frame: pd.DataFrame, new_names: dict[str, str], path: Path) -> pd.DataFrame:
    """Return some columns of a file as numbers, and `line`, by our names."""
    _check_columns(frame, new_names, path)
    return _to_numeric(frame.loc[:, ["line", *new_names]], new_names).rename(columns=new_names)


def _check_columns(frame: pd.DataFrame, required: Iterable[str], path: Path) -> None:
    missing = [name for name in required if name not in frame]
    if missing:
        there = ", ".join(str(name) for name in frame.columns if name != "line")
        needed = ", ".join(required)
        raise InputError(f"{path.name}: no column {missing[0]!r}; it has: {there}; needed: {needed}")


def _join_columns(frame: pd.DataFrame, columns: tuple[str, ...]) -> pd.Series:
    """Return the words of some columns joined, row by row; of the rows that are alike only once."""
    alike = frame.groupby(list(columns), sort=False, observed=True, dropna=False).ngroup()
    first = frame[list(columns)].loc[~alike.duplicated()]
    words = ["-".join(map(str, row)) for row in first.itertuples(index=False)]
    return pd.Series(np.array(words, object)[alike.to_numpy()], frame.index)


def _to_numeric(frame: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Return the table with these columns as numbers; what is none becomes NaN, and so a bad row."""
    return frame.assign(**{name: pd.to_numeric(frame[name], errors="coerce") for name in names})


def _split_trajectories(
    frame: pd.DataFrame, path: Path, options: ReadOptions, skipped_rows: dict[str, int] | None = None
) -> ReadResult:
    """Return the trajectories of a table with the columns `line`, COLUMNS and OPTIONAL, SI units.

    A trajectory is a run of evenly spaced rows of one pair; where a moment is missing, another begins. Rows
    may be in any order; `left_out` are those that are left out already.

    Raises:
        InputError: a row is bad, or nothing is left.
    """
    (wrong, bad), skipped_rows = _find_bad_rows(frame), skipped_rows or {}
    if bad and not options.drop_bad_rows:
        more = f" ({len(bad)} bad rows)" if len(bad) > 1 else ""
        raise InputError(f"{path.name}: line {bad[0].line}: {bad[0].reason}{more}; --drop-bad-rows leaves them out")
    good = frame.loc[~wrong].sort_values(by=["pair", "time"], kind="stable")
    passed = good.groupby("pair", sort=False, dropna=False)["time"].diff()
    if passed.isna().all():
        raise InputError("time: no pair has two rows")
    step = round(float(passed.median()), 4)  # times in single precision are no better
    begins = ~((passed - step).abs() <= TIME_STEP_TOLERANCE * step)
    pairs, parts, short = list[Pair](), dict[str, int](), 0
    for _, rows in good.groupby(begins.cumsum(), sort=False):
        if (len(rows) - 1) * step < options.min_seconds or len(rows) < 2:
            short += len(rows)
            continue
        pair = str(rows["pair"].iloc[0])
        speed, leader_speed, gap = (rows[name].to_numpy(np.float64) for name in PAIR_COLUMNS[2:])
        said = {name: rows[name].head(1).dropna() for name in OPTIONAL_COLUMNS if name in rows}
        driver, kind, split = ("".join(map(str, said.get(name, ()))) for name in OPTIONAL_COLUMNS)
        parts[pair] = parts.get(pair, 0) + 1
        name = pair if parts[pair] == 1 else f"{pair}/{parts[pair]}"
        pairs.append(Pair(name, driver or pair, step, speed, leader_speed, gap, kind, split))
    if not pairs:
        raise InputError(f"{path.name}: no trajectory lasts {options.min_seconds:g} s")
    why = {**skipped_rows, f"trajectories shorter than {options.min_seconds:g} s": short}
    return ReadResult(pairs, len(frame) + sum(skipped_rows.values()), bad, why)


def _find_bad_rows(frame: pd.DataFrame) -> tuple[np.ndarray, list[BadRow]]:
    """Return which rows cannot be used, shape (rows,), and their lines, each once."""
    found: dict[int, str] = {}
    bad = np.zeros(len(frame), bool)
    for name in PAIR_COLUMNS[1:]:
        values = frame[name].to_numpy(np.float64)
        low, high = VALUE_LIMITS.get(name, (-np.inf, np.inf))
        wrong = ~np.isfinite(values) | (values < low) | (values > high)
        allowed = f"{low:g} to {high:g}" if name in VALUE_LIMITS else "finite"
        bad |= wrong
        for line, value in zip(frame["line"][wrong], values[wrong], strict=True):
            found.setdefault(int(line), f"{name}: {value:g} is not allowed; allowed: {allowed}")
    twice = frame.assign(time=frame["time"].round(6)).duplicated(["pair", "time"])
    for line, time in zip(frame["line"][twice], frame["time"][twice], strict=True):
        found.setdefault(int(line), f"time: {time:g} is there twice in its pair")
    return bad | twice.to_numpy(), [BadRow(line, found[line]) for line in sorted(found)]
