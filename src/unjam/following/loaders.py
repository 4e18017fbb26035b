"""Reads car-following data: plain tables, NGSIM, highD, OpenACC and SUMO's FCD output; reports skipped rows."""

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.errors import InputError, unknown_name
from unjam.following.pairs import Pair, ReadOptions, ReadResult

PAIR_COLUMNS = ("pair", "time", "speed", "leader_speed", "gap")
"""required columns: [s], [m/s], [m/s], [m]"""
OPTIONAL_COLUMNS = ("driver", "kind", "split")
COLUMN_ALIASES = {"t": "time", "v_foll": "speed", "v_lead": "leader_speed"}
"""alternative column names of plain tables"""
VALUE_LIMITS = {"speed": (0.0, 70.0), "leader_speed": (0.0, 70.0), "gap": (0.0, 1000.0)}
"""possible values on roads; others have wrong units or are errors"""
TIME_STEP_TOLERANCE = 0.01
"""relative tolerance of the time step"""
METERS_PER_FOOT = 0.3048
MEDIAN_LENGTH_LIMITS = (3.0, 8.0)
"""plausible median length of vehicles [m]"""
VEHICLE_COLUMNS = ("vehicle", "time", "front", "length", "speed", "lane", "leader")
"""columns of a table of single vehicles"""
NGSIM_COLUMNS = ("vehicle_id", "global_time", "local_y", "v_length", "v_vel", "lane_id", "preceding")
"""the same of the public NGSIM file (US DOT), in lower case"""
RECONSTRUCTED_COLUMNS = ("vehicleid", "frameid", "localy", "vehiclelength", "meanspeed", "laneid", "leaderid")
"""the same of the reconstructed NGSIM I-80 (Montanino and Punzo 2015), only letters"""
HIGHD_COLUMNS = ("id", "frame", "x", "width", "xVelocity", "laneId", "precedingId")
"""the same of the tracks of highD (Krajewski et al. 2018)"""
HIGHD_FRAME_RATE = 25.0
"""[1/s]"""
MAX_VEHICLE_ABSENCE = 60.0
"""absence after which a vehicle number belongs to another vehicle [s]"""
FCD_COLUMNS = ("timestep_time", "vehicle_speed", "vehicle_leaderSpeed", "vehicle_leaderGap")
"""`PAIR_COLUMNS[1:]` of SUMO's FCD output as CSV, which has leaders with --fcd-output.max-leader-distance"""
RECONSTRUCTED_COLUMN_ORDER = (
    *("vehicleid", "frameid", "laneid", "localy", "meanspeed"),
    *("meanaccel", "vehiclelength", "vehicleclassid", "followerid", "leaderid"),
)
"""columns of its files, which have no header"""


def read_pairs(path: Path, format: str = "", options: ReadOptions | None = None) -> ReadResult:
    """Return the trajectories of a .parquet or .csv file.

    `format` is a name in `PAIR_FORMATS`; empty: detected from the columns.

    Raises:
        InputError: the file is missing or has another format, its units are wrong, or a row is bad.
    """
    if format and format not in PAIR_FORMATS:
        raise unknown_name("format", format, PAIR_FORMATS)
    frame = _read_frame(path)
    return PAIR_FORMATS[format or _detect_format(frame)](frame, path, options or ReadOptions())


def _read_table(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a plain table with `PAIR_COLUMNS` and any of `OPTIONAL_COLUMNS`."""
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
    vehicles = _select_columns(frame, NGSIM_COLUMNS, VEHICLE_COLUMNS, path)
    lengths = {name: vehicles[name] * METERS_PER_FOOT for name in ("front", "speed", "length")}
    vehicles = vehicles.assign(site=site, time=vehicles["time"] / 1000.0, **lengths)
    return _pairs_from_vehicles(vehicles, path, options)


def _read_reconstructed(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of the reconstructed NGSIM I-80, in meters and tenths of a second."""
    vehicles = _select_columns(frame.rename(columns=_alphanumeric), RECONSTRUCTED_COLUMNS, VEHICLE_COLUMNS, path)
    vehicles = vehicles.assign(site=path.stem, time=vehicles["time"] / 10.0)
    return _pairs_from_vehicles(vehicles, path, options)


def _read_highd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a file of highD, where x is a vehicle's left end, and decreases in one direction."""
    vehicles = _select_columns(frame, HIGHD_COLUMNS, VEHICLE_COLUMNS, path)
    # The direction is that of the whole lane, because a standing vehicle has none.
    is_forward = vehicles.groupby("lane")["speed"].transform("sum").to_numpy() >= 0
    front = (vehicles["front"] + vehicles["length"]).where(is_forward, -vehicles["front"])
    motion = {"front": front, "speed": vehicles["speed"].abs(), "time": vehicles["time"] / HIGHD_FRAME_RATE}
    return _pairs_from_vehicles(vehicles.assign(site=path.stem, **motion), path, options)


def _read_fcd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of SUMO's FCD output, one for each vehicle, leader and lane."""
    key = ("vehicle_id", "vehicle_leaderID", "vehicle_lane")
    vehicles = _select_columns(frame, FCD_COLUMNS, PAIR_COLUMNS[1:], path)
    _check_columns(frame, key, path)
    is_free = vehicles["gap"] < 0
    driver = frame["vehicle_id"].astype(str)
    vehicles = vehicles.assign(pair=_join_columns(frame, key), driver=driver, kind="simulated")
    return _split_trajectories(vehicles.loc[~is_free], path, options, {"no leader": int(np.sum(is_free))})


def _pairs_from_vehicles(vehicles: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a table of single vehicles with the numbers of their leaders."""
    low, high = MEDIAN_LENGTH_LIMITS
    median = float(np.nanmedian(vehicles["length"]))
    if not low <= median <= high:
        raise InputError(
            f"{path.name}: a median vehicle length of {median:.1f} m is not allowed; allowed: {low:g} to {high:g} m; "
            "are the units those of this format?"
        )
    key = ["site", "time", "leader"]
    leaders = vehicles.loc[:, ["site", "time", "vehicle", "front", "speed", "length"]]
    leaders = leaders.rename(columns={"vehicle": "leader"}).drop_duplicates(key)
    vehicles = vehicles.merge(leaders, on=key, how="left", suffixes=("", "_ahead"))
    is_free = vehicles["front_ahead"].isna() & vehicles["front"].notna()
    vehicles = vehicles.loc[~is_free]
    numbered = vehicles.assign(suffix=_reused_number_suffix(vehicles))
    frame = vehicles.assign(
        pair=_join_columns(vehicles, ("site", "vehicle", "leader", "lane")),
        driver=_join_columns(numbered, ("site", "vehicle", "suffix")).str.rstrip("-"),
        kind="human",
        leader_speed=vehicles["speed_ahead"],
        gap=vehicles["front_ahead"] - vehicles["length_ahead"] - vehicles["front"],
    )
    return _split_trajectories(frame, path, options, {"no leader, or leader not recorded": int(np.sum(is_free))})


def _reused_number_suffix(vehicles: pd.DataFrame) -> pd.Series:
    """Return "2" for the second vehicle with a number, and so on: NGSIM's numbers restart every 15 minutes."""
    ordered = vehicles.sort_values(by="time", kind="stable")
    key = [ordered["site"], ordered["vehicle"]]
    is_new = ordered["time"].groupby(key, dropna=False).diff() > MAX_VEHICLE_ABSENCE
    count = is_new.groupby(key, dropna=False).cumsum().to_numpy(int)
    return pd.Series(np.where(count > 0, (count + 1).astype(str), ""), ordered.index)


def _read_openacc(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of an OpenACC file (JRC): a platoon, each vehicle behind the previous one."""
    numbers = sorted(int(name[3:]) for name in frame.columns if re.fullmatch(r"IVS\d+", name))
    if not numbers:
        raise InputError(f"{path.name}: no column IVS1: not an OpenACC file")
    vehicles = [name.strip() for name in frame.attrs.get("vehicle_order", "").split(",") if name.strip()]
    parts = []
    for number in numbers:
        columns = ("Time", f"Speed{number + 1}", f"Speed{number}", f"IVS{number}")
        part = _select_columns(frame, columns, PAIR_COLUMNS[1:], path)
        label = f"Driver{number + 1}"
        kind = frame[label].astype(str) if label in frame else pd.Series("", frame.index)
        suffix = np.where(kind == "", "", "-" + kind)
        name = vehicles[number] if number < len(vehicles) else f"vehicle {number + 1}"
        driver = name + suffix if len(set(kind)) > 1 else name  # another kind that takes over is another driver
        parts.append(part.assign(pair=f"{path.stem}-{number + 1}" + suffix, driver=driver, kind=kind))
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
    """Return the table of a file with a column `line`; its `attrs` hold the lines above its header."""
    if not path.is_file():
        raise InputError(f"data: {str(path)!r} does not exist")
    header, attributes = 0, dict[Hashable, str]()
    try:
        if path.suffix == ".parquet":
            frame = pd.read_parquet(path)
        else:
            header, attributes = _find_header(path)
            columns = {"names": list(RECONSTRUCTED_COLUMN_ORDER), "header": None} if header < 0 else {}
            with open(path, encoding="utf-8-sig") as file:
                separator = ";" if file.readline().startswith("timestep_") else ","  # ; only in SUMO's files
            frame = pd.read_csv(path, sep=separator, skiprows=max(0, header), skipinitialspace=True, **columns)
    except (ValueError, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
    frame = frame.assign(line=np.arange(len(frame)) + header + 2)
    frame.attrs = attributes
    return frame


def _find_header(path: Path) -> tuple[int, dict[Hashable, str]]:
    """Return the number of lines above the header of a CSV file (-1: no header), and their content."""
    with open(path, encoding="utf-8-sig") as file:
        lines = [file.readline().strip() for _ in range(20)]
    first = lines[0].split(",")
    if len(first) == len(RECONSTRUCTED_COLUMN_ORDER) and all(re.fullmatch(r"\s*-?[\d.eE+-]+", cell) for cell in first):
        return -1, {}
    for number, line in enumerate(lines):
        if re.match(r"time\s*,\s*speed1\b", line, re.IGNORECASE):
            above = [line.partition(",") for line in lines[:number]]
            return number, {key.strip(" :").lower(): value.strip(",\" '") for key, _, value in above}
    return 0, {}


def _detect_format(frame: pd.DataFrame) -> str:
    names = set(map(str, frame.columns))
    if {name.lower() for name in names}.issuperset(NGSIM_COLUMNS):
        return "ngsim"
    if set(map(_alphanumeric, names)).issuperset(RECONSTRUCTED_COLUMNS):
        return "ngsim-reconstructed"
    columns = {"highd": HIGHD_COLUMNS, "fcd": ("timestep_time", "vehicle_id"), "openacc": ("Speed1", "IVS1")}
    return next((format for format, required in columns.items() if names.issuperset(required)), "table")


def _alphanumeric(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _select_columns(
    frame: pd.DataFrame, names: tuple[str, ...], new_names: tuple[str, ...], path: Path
) -> pd.DataFrame:
    """Return some columns of a file as numbers with new names, and `line`."""
    _check_columns(frame, names, path)
    numbers = _to_numeric(frame.loc[:, ["line", *names]], names)
    return numbers.rename(columns=dict(zip(names, new_names, strict=True)))


def _check_columns(frame: pd.DataFrame, required: Iterable[str], path: Path) -> None:
    missing = [name for name in required if name not in frame]
    if missing:
        columns = ", ".join(str(name) for name in frame.columns if name != "line")
        raise InputError(f"{path.name}: no column {missing[0]!r}; it has: {columns}; required: {', '.join(required)}")


def _join_columns(frame: pd.DataFrame, columns: tuple[str, ...]) -> pd.Series:
    """Return the values of some columns joined by hyphens in each row; equal rows are joined only once."""
    group = frame.groupby(list(columns), sort=False, observed=True, dropna=False).ngroup()
    first = frame[list(columns)].loc[~group.duplicated()]
    names = ["-".join(map(str, row)) for row in first.itertuples(index=False)]
    return pd.Series(np.array(names, object)[group.to_numpy()], frame.index)


def _to_numeric(frame: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Return the table with these columns as numbers; other values become NaN, and thereby bad rows."""
    return frame.assign(**{name: pd.to_numeric(frame[name], errors="coerce") for name in names})


def _split_trajectories(
    frame: pd.DataFrame, path: Path, options: ReadOptions, skipped_rows: dict[str, int] | None = None
) -> ReadResult:
    """Return the trajectories of a table with the columns `line`, `PAIR_COLUMNS` and any of `OPTIONAL_COLUMNS`.

    A trajectory consists of evenly spaced rows of one pair; a missing moment starts another one. Rows may be in any
    order; `skipped_rows` were skipped before.

    Raises:
        InputError: a row is bad, or no trajectory remains.
    """
    (is_bad, bad_rows), skipped_rows = _find_bad_rows(frame), skipped_rows or {}
    if bad_rows and not options.drop_bad_rows:
        more = f" ({len(bad_rows)} bad rows)" if len(bad_rows) > 1 else ""
        line, reason = next(iter(bad_rows.items()))
        raise InputError(f"{path.name}: line {line}: {reason}{more}; --drop-bad-rows leaves them out")
    good = frame.loc[~is_bad].sort_values(by=["pair", "time"], kind="stable")
    steps = good.groupby("pair", sort=False, dropna=False)["time"].diff()
    if steps.isna().all():
        raise InputError("time: no pair has two rows")
    step = round(float(steps.median()), 4)  # the precision of times in single precision
    starts = ~((steps - step).abs() <= TIME_STEP_TOLERANCE * step)
    pairs, part_counts, short_count = list[Pair](), Counter[str](), 0
    for _, rows in good.groupby(starts.cumsum(), sort=False):
        if (len(rows) - 1) * step < options.min_seconds or len(rows) < 2:
            short_count += len(rows)
            continue
        pair = str(rows["pair"].iloc[0])
        speed, leader_speed, gap = (rows[name].to_numpy(np.float64) for name in PAIR_COLUMNS[2:])
        known = {name: rows[name].head(1).dropna() for name in OPTIONAL_COLUMNS if name in rows}
        driver, kind, split = ("".join(map(str, known.get(name, ()))) for name in OPTIONAL_COLUMNS)
        part_counts[pair] += 1
        name = pair if part_counts[pair] == 1 else f"{pair}/{part_counts[pair]}"
        pairs.append(Pair(name, driver or pair, step, speed, leader_speed, gap, kind, split))
    if not pairs:
        raise InputError(f"{path.name}: no trajectory lasts {options.min_seconds:g} s")
    reasons = {**skipped_rows, f"trajectories shorter than {options.min_seconds:g} s": short_count}
    return ReadResult(pairs, len(frame) + sum(skipped_rows.values()), bad_rows, reasons)


def _find_bad_rows(frame: pd.DataFrame) -> tuple[np.ndarray, dict[int, str]]:
    """Return whether each row is bad, shape (rows,), and the first reason of each line with bad rows."""
    reasons: dict[int, str] = {}
    is_bad = np.zeros(len(frame), bool)
    for name in PAIR_COLUMNS[1:]:
        values = frame[name].to_numpy(np.float64)
        low, high = VALUE_LIMITS.get(name, (-np.inf, np.inf))
        is_wrong = ~np.isfinite(values) | (values < low) | (values > high)
        allowed = f"{low:g} to {high:g}" if name in VALUE_LIMITS else "finite"
        is_bad |= is_wrong
        for line, value in zip(frame["line"][is_wrong], values[is_wrong], strict=True):
            reasons.setdefault(int(line), f"{name}: {value:g} is not allowed; allowed: {allowed}")
    is_repeated = frame.assign(time=frame["time"].round(6)).duplicated(["pair", "time"])
    for line, time in zip(frame["line"][is_repeated], frame["time"][is_repeated], strict=True):
        reasons.setdefault(int(line), f"time: {time:g} occurs twice in its pair")
    return is_bad | is_repeated.to_numpy(), dict(sorted(reasons.items()))
