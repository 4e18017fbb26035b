"""Read car-following trajectories from files: plain tables, NGSIM, highD, OpenACC and SUMO's FCD output."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from unjam.errors import InputError, unknown_name
from unjam.physics.arrays import Floats
from unjam.recordings.tables import check_unique_columns, read_table
from unjam.recordings.trajectories import FollowingTrajectory, regular_times
from unjam.text import format_count, shorten_list

TABLE_COLUMNS = ("pair", "time", "speed", "leader_speed", "gap")
"""required columns of a plain table: `pair` identifies follower and leader; the units are s, m/s, m/s and m"""
OPTIONAL_COLUMNS = ("driver", "kind", "split")
"""optional columns of a plain table, which become fields of `FollowingTrajectory`"""
COLUMN_ALIASES = {"t": "time", "v_foll": "speed", "v_lead": "leader_speed"}
"""alternative column names of plain tables"""
VALUE_LIMITS = {"speed": (0.0, 70.0), "leader_speed": (0.0, 70.0), "gap": (0.0, 1000.0)}
"""minimum and maximum value of a column [m/s, m/s, m]; other values are errors, or have another unit"""
TIME_STEP_TOLERANCE, MISSING_ROW_INTERVAL = 0.01, 1.5
"""maximum relative difference of equal intervals, and minimum ratio to the median interval where a row is missing"""
MAX_PAIR_JUMP = 5.0
"""maximum difference between the change of the gap from row to row and the change that follows from the speeds [m]; a
larger difference means that the leader has changed"""
MAX_TIME_STEP, MIN_TRAJECTORY_SAMPLES = 1.5, 3
"""maximum time between two samples, as waves last a few seconds [s], and minimum number of samples of a trajectory"""
UNIT_RATIO_LIMITS = (2 / 3, 1.5)
"""minimum and maximum ratio of quantities that are equal if the units of all columns are consistent"""
CHANGE_SECONDS, MIN_GAP_CHANGE, MIN_CORRELATION = 5.0, 1.0, 0.7
"""conditions for the check of units by changes of gaps: interval of a change [s], minimum root mean square of changes
[m], and their minimum correlation with the speeds, which is 1.00 in NGSIM and OpenACC"""
MAX_TIME_DECIMALS = 6
"""maximum number of decimals of time stamps that may be rounded"""
METERS_PER_FOOT = 0.3048
MEDIAN_LENGTH_LIMITS = (3.0, 8.0)
"""minimum and maximum plausible median of the vehicle lengths in a file [m]"""
VEHICLE_COLUMNS = ("vehicle", "time", "front", "length", "speed", "lane", "leader")
"""columns of a table with a row for each vehicle and time; `leader` is the number of the vehicle ahead"""
NGSIM_COLUMNS = ("vehicle_id", "global_time", "local_y", "v_length", "v_vel", "lane_id", "preceding")
"""names of `VEHICLE_COLUMNS` in the public NGSIM file (US DOT), in lower case"""
RECONSTRUCTED_COLUMNS = ("vehicleid", "frameid", "localy", "vehiclelength", "meanspeed", "laneid", "leaderid")
"""names of `VEHICLE_COLUMNS` in the reconstructed NGSIM I-80 data (Montanino and Punzo 2015), without underscores"""
HIGHD_COLUMNS = ("id", "frame", "x", "width", "xVelocity", "laneId", "precedingId")
"""names of `VEHICLE_COLUMNS` in the tracks of highD (Krajewski et al. 2018)"""
HIGHD_FRAME_RATE, MAX_VEHICLE_ABSENCE = 25.0, 60.0
"""frames per second of highD [1/s], and maximum absence of a vehicle [s], after which its number is used again"""
FCD_COLUMNS = ("timestep_time", "vehicle_speed", "vehicle_leaderSpeed", "vehicle_leaderGap")
"""names of `TABLE_COLUMNS[1:]` in SUMO's FCD output as CSV; it contains leaders if SUMO has the option
--fcd-output.max-leader-distance"""
GROUPED_NUMBER = re.compile(r"-?\d{1,3}(,\d{3})+(\.\d+)?")
"""pattern of a number with commas between thousands"""
MAX_LISTED_ROWS, MAX_TEXT_LENGTH, MAX_BAD_ROWS = 5, 40, 1 << 20
"""maximum number of bad rows in a summary, of characters of a value in a message, and of bad rows with a reason"""


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a file."""

    drop_bad_rows: bool = False
    """whether to drop bad rows, which end trajectories, instead of refusing the file"""
    bad_row_hint: str = "; --drop-bad-rows leaves them out"
    """end of the message about a bad row, which says how to drop it"""
    min_seconds: float = 20.0
    """minimum duration of a trajectory [s]; shorter ones are skipped and counted"""
    driver_columns: tuple[str, ...] = ()
    """columns of a plain table that together identify the driver, if it has no column `driver`"""


@dataclass(frozen=True)
class ReadResult:
    """The trajectories in a file, and the rows that are not used."""

    trajectories: list[FollowingTrajectory] = field(repr=False)
    rows: int
    """number of rows in the file"""
    bad_rows: dict[int, str]
    """reason why a row was dropped, by its line in the file; the header is line 1"""
    skipped_rows: dict[str, int]
    """number of valid rows that are not used, by reason"""
    jump_count: int = 0
    """number of rows at which a new trajectory begins because the gap jumps"""

    def summary_lines(self) -> list[str]:
        """Return the lines of a summary: rows that are used, skipped and dropped."""
        used = sum(len(trajectory.speed) for trajectory in self.trajectories)
        count_text = format_count(len(self.trajectories), "trajectory", "trajectories")
        skipped = [(reason, format_count(count, "row")) for reason, count in self.skipped_rows.items() if count]
        lines = [f"{count_text} with {used:,} of {self.rows:,} rows"]
        lines += [f"skipped: {rows}: {reason}" for reason, rows in skipped]
        if self.jump_count:
            jumps = f"split at {format_count(self.jump_count, 'jump')} of the gap by more than {MAX_PAIR_JUMP:g} m"
            lines.append(f"{jumps} beyond the speeds: does a pair have several vehicles?")
        dropped = [f"dropped: line {line}: {reason}" for line, reason in self.bad_rows.items()]
        unlisted = len(dropped) - MAX_LISTED_ROWS
        last_line = [f"dropped: {format_count(unlisted, 'more bad row')}"] if unlisted > 0 else []
        return [*lines, *dropped[:MAX_LISTED_ROWS], *last_line]


def read_trajectories(path: Path, format: str = "", options: ReadOptions | None = None) -> ReadResult:
    """Return the trajectories of a file in a format of `FILE_FORMATS`; if empty, the columns show the format.

    Raise `InputError` if the file is missing or has another format, its units are wrong, or a row is bad.
    """
    if format and format not in FILE_FORMATS:
        raise unknown_name("format", format, FILE_FORMATS)
    return trajectories_of_table(read_table(path), path, options or ReadOptions(), format)


def trajectories_of_table(frame: pd.DataFrame, path: Path, options: ReadOptions, format: str = "") -> ReadResult:
    """Return the trajectories of the table of a file; `format` is that of `read_trajectories`."""
    return FILE_FORMATS[format or detect_format(frame)](frame, path, options)


def _convert_table(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    frame = frame.rename(columns={alias: name for alias, name in COLUMN_ALIASES.items() if name not in frame})
    _check_columns(frame, TABLE_COLUMNS, path)
    if options.driver_columns and "driver" not in frame:
        _check_columns(frame, options.driver_columns, path)
        frame["driver"] = join_row_values(frame, options.driver_columns)
    return split_trajectories(to_numeric(frame, TABLE_COLUMNS[1:]), path, options)


def _convert_ngsim(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of the public NGSIM file, which is in feet and milliseconds."""
    frame = frame.rename(columns=str.lower)
    site = frame["location"].astype(str) if "location" in frame else ""
    vehicles = _select_columns(frame, NGSIM_COLUMNS, VEHICLE_COLUMNS, path)
    lengths = {name: vehicles[name] * METERS_PER_FOOT for name in ("front", "speed", "length")}
    vehicles = vehicles.assign(site=site, time=vehicles["time"] / 1000.0, **lengths)
    return _trajectories_from_vehicles(vehicles, path, options)


def _convert_reconstructed(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of the reconstructed NGSIM I-80 data, which are in meters and tenths of a second."""
    vehicles = _select_columns(frame.rename(columns=alphanumeric), RECONSTRUCTED_COLUMNS, VEHICLE_COLUMNS, path)
    vehicles = vehicles.assign(site=path.stem, time=vehicles["time"] / 10.0)
    return _trajectories_from_vehicles(vehicles, path, options)


def _convert_highd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a highD file, in which x is the left end of a vehicle in both driving directions."""
    vehicles = _select_columns(frame, HIGHD_COLUMNS, VEHICLE_COLUMNS, path)
    # All vehicles of a lane give its direction, because a standing vehicle has none.
    is_forward = vehicles.groupby("lane")["speed"].transform("sum").to_numpy() >= 0
    front = (vehicles["front"] + vehicles["length"]).where(is_forward, -vehicles["front"])
    motion = {"front": front, "speed": vehicles["speed"].abs(), "time": vehicles["time"] / HIGHD_FRAME_RATE}
    return _trajectories_from_vehicles(vehicles.assign(site=path.stem, **motion), path, options)


def _convert_fcd(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of SUMO's FCD output, one for each pair of a vehicle and its leader."""
    id_columns = ("vehicle_id", "vehicle_leaderID")
    vehicles = _select_columns(frame, FCD_COLUMNS, TABLE_COLUMNS[1:], path)
    _check_columns(frame, id_columns, path)
    is_free = vehicles["gap"] < 0
    driver = frame["vehicle_id"].astype(str)
    vehicles = vehicles.assign(pair=join_row_values(frame, id_columns), driver=driver, kind="simulated")
    return split_trajectories(vehicles.loc[~is_free], path, options, {"no leader": int(np.sum(is_free))})


def _trajectories_from_vehicles(vehicles: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of a table with `VEHICLE_COLUMNS` and the column `site`."""
    low, high = MEDIAN_LENGTH_LIMITS
    median = float(np.nanmedian(vehicles["length"]))
    if not low <= median <= high:
        raise InputError(
            f"{path.name}: a median vehicle length of {median:.1f} m is not allowed; allowed: {low:g} to {high:g} m; "
            "does the file have the units of this format?"
        )
    key = ["site", "time", "leader"]
    leaders = vehicles.loc[:, ["site", "time", "vehicle", "front", "speed", "length"]]
    leaders = leaders.rename(columns={"vehicle": "leader"}).drop_duplicates(key)
    vehicles = vehicles.merge(leaders, on=key, how="left", suffixes=("", "_ahead"))
    is_free = vehicles["front_ahead"].isna() & vehicles["front"].notna()
    vehicles = vehicles.loc[~is_free]
    numbered = vehicles.assign(suffix=_reused_number_suffix(vehicles))
    frame = vehicles.assign(
        pair=join_row_values(vehicles, ("site", "vehicle", "leader", "lane")),
        driver=join_row_values(numbered, ("site", "vehicle", "suffix")).str.rstrip("-"),
        kind="human",
        leader_speed=vehicles["speed_ahead"],
        gap=vehicles["front_ahead"] - vehicles["length_ahead"] - vehicles["front"],
    )
    return split_trajectories(frame, path, options, {"no leader, or leader not recorded": int(np.sum(is_free))})


def _reused_number_suffix(vehicles: pd.DataFrame) -> pd.Series:
    """Return "" for the first vehicle with a number, "2" for the second: NGSIM's numbers restart every 15 minutes."""
    ordered = vehicles.sort_values(by="time", kind="stable")
    key = [ordered["site"], ordered["vehicle"]]
    is_new = ordered["time"].groupby(key, dropna=False).diff() > MAX_VEHICLE_ABSENCE
    count = is_new.groupby(key, dropna=False).cumsum().to_numpy(int)
    return pd.Series(np.where(count > 0, (count + 1).astype(str), ""), ordered.index)


def _convert_openacc(frame: pd.DataFrame, path: Path, options: ReadOptions) -> ReadResult:
    """Return the trajectories of an OpenACC file (JRC): a platoon in which each vehicle follows the previous one."""
    numbers = sorted(int(name[3:]) for name in frame.columns if re.fullmatch(r"IVS\d+", name))
    if not numbers:
        raise InputError(f"{path.name}: it has no column IVS1, as files of OpenACC have")
    vehicles = [name.strip() for name in frame.attrs.get("vehicle_order", "").split(",") if name.strip()]
    platoon = []
    for number in numbers:
        columns = ("Time", f"Speed{number + 1}", f"Speed{number}", f"IVS{number}")
        pair = _select_columns(frame, columns, TABLE_COLUMNS[1:], path)
        label = f"Driver{number + 1}"
        kind = frame[label].astype(str) if label in frame else pd.Series("", frame.index)
        suffix = np.where(kind == "", "", "-" + kind)
        name = vehicles[number] if number < len(vehicles) else f"vehicle {number + 1}"
        driver = name + suffix if len(set(kind)) > 1 else name  # a change of kind is a change of driver
        platoon.append(pair.assign(pair=f"{path.stem}-{number + 1}" + suffix, driver=driver, kind=kind))
    return split_trajectories(pd.concat(platoon), path, options)


FILE_FORMATS: dict[str, Callable[[pd.DataFrame, Path, ReadOptions], ReadResult]] = {
    "table": _convert_table,
    "ngsim": _convert_ngsim,
    "ngsim-reconstructed": _convert_reconstructed,
    "openacc": _convert_openacc,
    "highd": _convert_highd,
    "fcd": _convert_fcd,
}


def detect_format(frame: pd.DataFrame) -> str:
    """Return the name in `FILE_FORMATS` of the format that has the columns of a table."""
    names = set(map(str, frame.columns))
    if {name.lower() for name in names}.issuperset(NGSIM_COLUMNS):
        return "ngsim"
    if set(map(alphanumeric, names)).issuperset(RECONSTRUCTED_COLUMNS):
        return "ngsim-reconstructed"
    columns = {"highd": HIGHD_COLUMNS, "fcd": ("timestep_time", "vehicle_id"), "openacc": ("Speed1", "IVS1")}
    return next((format for format, required in columns.items() if names.issuperset(required)), "table")


def alphanumeric(name: str) -> str:
    """Return the letters and digits of a column name, in lower case."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _select_columns(frame: pd.DataFrame, names: tuple[str, ...], labels: tuple[str, ...], path: Path) -> pd.DataFrame:
    """Return the column `line`, and the columns `names` as numbers under the names `labels`."""
    _check_columns(frame, names, path)
    numbers = to_numeric(frame.loc[:, ["line", *names]], names)
    return numbers.rename(columns=dict(zip(names, labels, strict=True)))


def _check_columns(frame: pd.DataFrame, required: Iterable[str], path: Path) -> None:
    missing = [name for name in required if name not in frame]
    if missing:
        columns = shorten_list(str(name) for name in frame.columns if name != "line")
        raise InputError(f"{path.name}: no column {missing[0]!r}; it has: {columns}; required: {', '.join(required)}")
    check_unique_columns(path, [str(name) for name in frame.columns if name in required])


def join_row_values(frame: pd.DataFrame, columns: tuple[str, ...]) -> pd.Series:
    """Return the values of these columns joined by hyphens, for each row; equal rows are joined once, for speed."""
    group = frame.groupby(list(columns), sort=False, observed=True, dropna=False).ngroup()
    first = frame[list(columns)].loc[~group.duplicated()]
    names = ["-".join(map(str, row)) for row in first.itertuples(index=False)]
    return pd.Series(np.array(names, object)[group.to_numpy()], frame.index)


def to_numeric(frame: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Return the table with these columns as numbers; other values than numbers become NaN.

    Numbers may have commas between thousands. The column `not_numeric` has the first other value of each row.
    """
    columns, not_numeric = dict[str, pd.Series](), pd.Series("", frame.index)
    for name in names:
        is_date = frame[name].dtype.kind in "mM"  # pandas would return nanoseconds
        numeric = np.nan if is_date else pd.to_numeric(frame[name], errors="coerce")
        columns[name] = pd.Series(numeric, frame.index)
        is_text = columns[name].isna() & frame[name].notna()
        texts = frame.loc[is_text, name].map(lambda value: str(value).strip())
        if texts.empty:
            continue
        is_grouped = texts.map(lambda text: bool(GROUPED_NUMBER.fullmatch(text)))
        numbers = texts[is_grouped].map(lambda text: float(text.replace(",", "")))
        columns[name] = columns[name].astype(np.float64).fillna(numbers)
        bad_values = f"{name}: " + texts[~is_grouped].head(MAX_BAD_ROWS).map(lambda text: repr(text[:MAX_TEXT_LENGTH]))
        not_numeric = not_numeric.where(not_numeric != "", bad_values.reindex(frame.index).fillna(""))
    return frame.assign(**columns, not_numeric=not_numeric)


def split_trajectories(
    frame: pd.DataFrame, path: Path, options: ReadOptions, skipped_rows: dict[str, int] | None = None
) -> ReadResult:
    """Return the trajectories of a table with the columns `line`, `TABLE_COLUMNS` and any of `OPTIONAL_COLUMNS`.

    A trajectory consists of successive rows of one pair. It ends where a row is missing or the gap jumps. All
    trajectories of a pair have the same time step. Rows may be in any order. `skipped_rows` has the number of rows that
    the caller has skipped, by reason. Raise `InputError` if a row is bad, or no trajectory remains.
    """
    (is_bad, bad_rows), skipped_rows = _find_bad_rows(frame), skipped_rows or {}
    bad_count = int(np.sum(is_bad))
    if bad_count > (MAX_BAD_ROWS if options.drop_bad_rows else 0):
        count_text = f" ({bad_count} bad rows)" if bad_count > 1 else ""
        line, reason = next(iter(bad_rows.items()))
        hint = f"; {MAX_BAD_ROWS:,} can be left out" if options.drop_bad_rows else options.bad_row_hint
        raise InputError(f"{path.name}: line {line}: {reason}{count_text}{hint}")
    good = frame.loc[~is_bad].sort_values(by=["pair", "time"], kind="stable")
    groups = [rows for _, rows in good.groupby("pair", sort=False, dropna=False) if len(rows) > 1]
    if not groups:
        raise InputError(f"{path.name}: time: there are no two rows of one vehicle")
    intervals = [np.diff(rows["time"].to_numpy(np.float64)) for rows in groups]
    has_missing = [times > MISSING_ROW_INTERVAL * np.median(times) for times in intervals]
    pairs = [*zip(groups, intervals, has_missing, strict=True)]
    has_jump = [(_find_jumps(rows, times) | _find_label_changes(rows)) & ~missing for rows, times, missing in pairs]
    regular = [times[~missing] for _, times, missing in pairs]
    steps = _common_time_steps([float(times.mean()) for times in regular], [float(times.sum()) for times in regular])
    trajectories, trajectory_counts, short_count, longest = list[FollowingTrajectory](), Counter[str](), len(good), 0.0
    for rows, missing, jumps, step in zip(groups, has_missing, has_jump, steps, strict=True):
        for first, last in pairwise([0, *(np.flatnonzero(missing | jumps) + 1).tolist(), len(rows)]):
            seconds = (last - first - 1) * step
            longest = max(longest, seconds)
            if seconds < options.min_seconds - step / 2 or last - first < MIN_TRAJECTORY_SAMPLES:
                continue
            if step > MAX_TIME_STEP:
                allowed = f"<= {MAX_TIME_STEP:g} s; are its times in seconds?"
                raise InputError(f"{path.name}: time: steps of {step:g} s are not allowed; allowed: {allowed}")
            segment = rows.iloc[first:last]
            short_count -= len(segment)
            pair = str(segment["pair"].iloc[0])
            speed, leader_speed, gap = _resample_rows(segment, step)
            labels = {name: segment[name].head(1).dropna() for name in OPTIONAL_COLUMNS if name in segment}
            driver, kind, split = ("".join(map(str, labels.get(name, ()))) for name in OPTIONAL_COLUMNS)
            trajectory_counts[pair] += 1
            name = pair if trajectory_counts[pair] == 1 else f"{pair}/{trajectory_counts[pair]}"
            trajectories.append(FollowingTrajectory(name, driver or pair, step, speed, leader_speed, gap, kind, split))
    limit = f"{options.min_seconds:g} s"
    if not trajectories:
        breaks = {"rows are missing": has_missing, "the gap jumps": has_jump}
        counts = ", ".join(f"{reason} at {sum(map(np.sum, masks)):,} places" for reason, masks in breaks.items())
        raise InputError(f"{path.name}: no trajectory lasts {limit}; the longest lasts {longest:.3g} s; {counts}")
    _check_units(trajectories, path)
    reasons = {**skipped_rows, f"trajectories shorter than {limit}": short_count}
    jump_count = int(sum(jumps.sum() for jumps in has_jump))
    return ReadResult(trajectories, len(frame) + sum(skipped_rows.values()), bad_rows, reasons, jump_count)


def _find_label_changes(rows: pd.DataFrame) -> NDArray[np.bool_]:
    """Return after which rows the driver, kind or split changes."""
    columns = [rows[name].astype(object).fillna("").to_numpy() for name in OPTIONAL_COLUMNS if name in rows]
    changes = [labels[1:] != labels[:-1] for labels in columns]
    return np.logical_or.reduce(changes) if changes else np.zeros(len(rows) - 1, bool)


def _find_jumps(rows: pd.DataFrame, intervals: Floats) -> NDArray[np.bool_]:
    """Return after which rows the gap jumps, given the intervals to the next rows [s]: see `MAX_PAIR_JUMP`."""
    speed, leader_speed, gap = (rows[name].to_numpy(np.float64) for name in ("speed", "leader_speed", "gap"))
    approach_rate = speed - leader_speed
    expected = -0.5 * (approach_rate[1:] + approach_rate[:-1]) * intervals
    return np.abs(np.diff(gap) - expected) > MAX_PAIR_JUMP


def _check_units(trajectories: Sequence[FollowingTrajectory], path: Path) -> None:
    """Raise `InputError` if the gaps do not change as speeds and times imply, so that a unit must be wrong."""
    low, high = UNIT_RATIO_LIMITS
    follower_distance, leader_distance = 0, 0
    for pair in trajectories:
        follower_distance += pair.speed[1:].sum() * pair.time_step
        leader_distance += pair.leader_speed[1:].sum() * pair.time_step - (pair.gap[-1] - pair.gap[0])
    if follower_distance > MIN_GAP_CHANGE and not low <= (ratio := leader_distance / follower_distance) <= high:
        raise InputError(
            f"{path.name}: speed, leader_speed: a ratio of {ratio:.2g} of the distances of leader and follower "
            f"is not allowed; allowed: {low:.2g} to {high:g}, as in m/s"
        )
    expected, recorded = list[Floats](), list[Floats]()
    for pair in trajectories:
        gap_rate = pair.leader_speed - pair.speed
        implied = np.cumsum((gap_rate[1:] + gap_rate[:-1]) / 2.0) * pair.time_step
        lag = min(max(1, round(CHANGE_SECONDS / pair.time_step)), len(implied) - 1)
        expected.append(implied[lag:] - implied[:-lag])
        recorded.append(pair.gap[1:][lag:] - pair.gap[1:][:-lag])
    implied, change = np.concatenate(expected), np.concatenate(recorded)
    squares, product = (float(implied @ implied), float(change @ change)), float(implied @ change)
    is_clear = abs(product) >= MIN_CORRELATION * np.sqrt(squares[0] * squares[1])
    if max(squares) < MIN_GAP_CHANGE**2 * len(change) or not min(squares) or not is_clear:
        return
    if not low <= product / squares[0] <= high:
        raise InputError(
            f"{path.name}: gap, speed, leader_speed, time: gaps that change {product / squares[0]:.2g} times as fast "
            "as the speeds imply are not allowed; allowed: gaps in m, speeds in m/s and times in s"
        )


def _common_time_steps(steps: Sequence[float], seconds: Sequence[float]) -> list[float]:
    """Return the time step of each pair [s]; nearly equal ones become their mean, weighted by durations (`seconds`)."""
    common = np.array(steps)
    order = np.argsort(common, kind="stable")
    starts = np.flatnonzero(np.diff(common[order], prepend=0.0) > TIME_STEP_TOLERANCE * common[order])
    for indices in np.split(order, starts[1:]):
        mean = float(np.average(common[indices], weights=np.array(seconds)[indices]))
        short = round(mean, 4)  # times in single precision have this precision
        common[indices] = short if abs(mean - short) <= 1e-4 * mean else round(mean, MAX_TIME_DECIMALS)
    return common.tolist()


def _resample_rows(rows: pd.DataFrame, step: float) -> list[Floats]:
    """Return speed, leader speed and gap at equal intervals, interpolated unless the times are only rounded."""
    times, *columns = (rows[name].to_numpy(np.float64) for name in TABLE_COLUMNS[1:])
    times = times - times[0]
    if np.all(np.abs(np.diff(times) - step) <= TIME_STEP_TOLERANCE * step):
        return columns
    indices = np.arange(len(times))
    deviation = np.abs(times - np.polyval(np.polyfit(indices, times, 1), indices)).max()
    units = (10.0**-digits for digits in range(MAX_TIME_DECIMALS + 1))
    resolution = next((unit for unit in units if np.all(np.abs(times / unit - np.round(times / unit)) < 0.01)), 0.0)
    if deviation <= 0.75 * resolution:  # an error of rounding is up to half of it; the fitted line has an error, too
        return columns
    return [np.interp(regular_times(times[-1], step), times, column) for column in columns]


def _find_bad_rows(frame: pd.DataFrame) -> tuple[np.ndarray, dict[int, str]]:
    """Return which rows are bad, and the reasons by line of the file."""
    reasons: dict[int, str] = {}
    is_bad = np.zeros(len(frame), bool)
    for name in TABLE_COLUMNS[1:]:
        values = frame[name].to_numpy(np.float64)
        low, high = VALUE_LIMITS.get(name, (-np.inf, np.inf))
        is_wrong = ~np.isfinite(values) | (values < low) | (values > high)
        allowed = f"{low:g} to {high:g}" if name in VALUE_LIMITS else "finite numbers of seconds"
        is_bad |= is_wrong
        described = frame.loc[is_wrong, ["line", name, "not_numeric"]].head(MAX_BAD_ROWS)
        for line, value, text in zip(*described.to_numpy().T, strict=True):
            reasons.setdefault(int(line), f"{text or f'{name}: {value:g}'} is not allowed; allowed: {allowed}")
    is_repeated = frame.assign(time=frame["time"].round(6)).duplicated(["pair", "time"])
    for line, time in frame.loc[is_repeated, ["line", "time"]].head(MAX_BAD_ROWS).to_numpy().tolist():
        reasons.setdefault(int(line), f"time: {time:g} occurs twice in its pair")
    return is_bad | is_repeated.to_numpy(), dict(sorted(reasons.items()))
