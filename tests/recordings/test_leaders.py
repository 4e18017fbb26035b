from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.recordings.synthetic_trajectories import idm_driver, write_table
from unjam.errors import InputError
from unjam.physics.idm import IDMParameters
from unjam.recordings.leader_files import read_leaders
from unjam.recordings.leaders import recording_files

TIMES = 0.1 * np.arange(600)
SPEEDS = 15.0 + 5.0 * np.sin(TIMES / 8.0)


def write(path: Path, **columns: object) -> Path:
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


KMH, MPH = 3.6, 1.0 / 0.44704


@pytest.mark.parametrize(
    ("column", "unit"),
    [
        *(("speed", 1.0), ("Speed", 1.0), ("speed_ms", 1.0), ("Speed (m/s)", 1.0), ("v_mps", 1.0)),
        *((name, KMH) for name in ("speed_kmh", "km/h", "kph", "Speed [km/h]", "velocity_kmh")),
        *((name, MPH) for name in ("speed_mph", "mph", "MPH", "Velocity (mph)")),
    ],
)
def test_a_table_of_speeds_names_its_unit(tmp_path: Path, column: str, unit: float) -> None:
    (found,) = read_leaders(write(tmp_path / "drive.csv", time=TIMES, **{column: unit * SPEEDS}))
    assert found.name == "drive"
    assert found.time_step == pytest.approx(0.1)
    np.testing.assert_allclose(found.speed, SPEEDS, atol=1e-9)


def test_drives_on_i24_are_in_kilometers_per_hour(tmp_path: Path) -> None:
    path = tmp_path / "2021-03-08.csv"
    times = 1615244286.2 + TIMES
    write(path, Time=times, Velocity=3.6 * SPEEDS, SpaceGap=30.0, DrivingDir="West")
    (found,) = read_leaders(path)
    np.testing.assert_allclose(found.speed, SPEEDS, atol=1e-5)


def test_of_trajectories_the_leaders_are_replayed(tmp_path: Path) -> None:
    write_table(path := tmp_path / "pairs.csv", [{}])
    (found,) = read_leaders(path)
    expected = idm_driver(IDMParameters(time_headway=0.9), seconds=20.0).leader_speed
    np.testing.assert_allclose(found.speed, expected, atol=1e-6)


def test_speeds_in_another_unit_are_refused_by_their_accelerations(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="if its speeds are not in m/s, name the column by its unit"):
        read_leaders(write(tmp_path / "drive.csv", time=TIMES, speed=20.0 + 20.0 * np.sin(TIMES)))


def test_high_speeds_without_a_unit_are_refused_with_the_names_of_columns_that_have_one(tmp_path: Path) -> None:
    fast = SPEEDS + 30.0
    for column in ("speed", "Speed"):
        reason = f"drive.csv: {column}: 50 is not allowed; .*speed_kmh, speed_mph or"
        with pytest.raises(InputError, match=reason) as caught:
            read_leaders(write(tmp_path / "drive.csv", time=TIMES, **{column: fast}))
        assert "\n" not in str(caught.value)
    (found,) = read_leaders(write(tmp_path / "drive.csv", time=TIMES, speed_ms=fast))
    np.testing.assert_allclose(found.speed, fast, atol=1e-9)


def test_a_missing_second_ends_a_recording(tmp_path: Path) -> None:
    times = np.where(TIMES < 30.0, TIMES, TIMES + 5.0)
    names = [each.name for each in read_leaders(write(tmp_path / "drive.csv", time=times, speed=SPEEDS))]
    assert names == ["drive", "drive/2"]


@pytest.mark.parametrize("name", ["vehicle", "Vehicle_ID", "id", "track_id"])
@pytest.mark.parametrize("start", [0.05, 60.0])
def test_each_vehicle_is_a_recording_of_its_own(start: float, name: str, tmp_path: Path) -> None:
    columns = {"time": np.r_[TIMES, start + TIMES], "speed": np.r_[SPEEDS, SPEEDS + 5.0], name: np.repeat([1, 2], 600)}
    found = read_leaders(write(tmp_path / "drive.csv", **columns))
    assert [each.name for each in found] == ["drive-1", "drive-2"]
    np.testing.assert_allclose(found[1].speed, SPEEDS + 5.0, atol=1e-9)


def test_numbers_of_rows_are_no_vehicles(tmp_path: Path) -> None:
    (found,) = read_leaders(write(tmp_path / "drive.csv", id=np.arange(600), time=TIMES, speed=SPEEDS))
    assert found.name == "drive"


def test_other_steps_are_interpolated(tmp_path: Path) -> None:
    (found,) = read_leaders(write(tmp_path / "drive.csv", time=TIMES, speed=SPEEDS))
    speeds = found.speeds_at(2.0, 10.0, 0.25)
    assert len(speeds) == 41
    np.testing.assert_allclose(speeds, np.interp(2.0 + 0.25 * np.arange(41), TIMES, SPEEDS))


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"time": TIMES, "pace": SPEEDS}, "its columns are pace, time; required: time, and one of speed, speed_kmh"),
        ({"time": TIMES, "speed": SPEEDS, "speed_kmh": SPEEDS}, "its columns are speed, speed_kmh, time; required"),
        ({"time": 1000.0 * TIMES, "speed": SPEEDS}, "time: steps of 100 s are not allowed; .* in seconds"),
        ({"time": TIMES, "speed": np.where(TIMES == 3.0, np.nan, SPEEDS)}, "line 32: speed: nan is not allowed"),
        ({"time": TIMES[:50], "speed": SPEEDS[:50]}, "no trajectory lasts 20 s"),
        ({"time": TIMES[:0], "speed": SPEEDS[:0]}, "drive.csv: speed: there are no numbers"),
        ({"time": TIMES, "speed": np.full(len(TIMES), np.nan)}, "drive.csv: speed: there are no numbers"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, columns: dict[str, object], reason: str) -> None:
    with pytest.raises(InputError, match=reason) as caught:
        read_leaders(write(tmp_path / "drive.csv", **columns))
    assert "\n" not in str(caught.value)


def test_a_folder_has_files_with_known_suffixes(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"recordings: .* allowed: a folder or a pattern with at least one file that ends in \.csv"
    ):
        recording_files(tmp_path)
    for name in ("b.csv", "a.csv", "notes.md"):
        (tmp_path / name).touch()
    assert [path.name for path in recording_files(tmp_path)] == ["a.csv", "b.csv"]
    for missing in (tmp_path / "missing.csv", tmp_path / "missing" / "*.csv"):
        with pytest.raises(InputError, match=r"recordings: .* a pattern like"):
            recording_files(missing)


def test_a_pattern_chooses_files_of_a_folder(tmp_path: Path) -> None:
    for name in ("march_b.csv", "march_a.csv", "april.csv", "march.md", "march[1].csv"):
        (tmp_path / name).touch()
    assert [path.name for path in recording_files(tmp_path / "march_*")] == ["march_a.csv", "march_b.csv"]
    assert recording_files(tmp_path / "march[1].csv") == [tmp_path / "march[1].csv"]  # a file is no pattern
    with pytest.raises(InputError, match=r"at least one file .*; .* has april\.csv, march\.md, "):
        recording_files(tmp_path / "may*")
