import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.worlds.sumo.user_networks import straight
from unjam.errors import InputError
from unjam.following.loaders import METERS_PER_FOOT, ReadOptions, read_trajectories
from unjam.worlds.sumo.networks import sumo_program

SHORT = ReadOptions(min_seconds=1.0)
SPEED, LEADER, GAP = 10.0, 12.0, 20.0
SAMPLES = 30


def write_table_file(path: Path, **changes: object) -> Path:
    """Write a plain table of two pairs, the second of which starts later."""
    parts = []
    for pair, start in (("one", 0.0), ("two", 100.0)):
        times = start + 0.1 * np.arange(SAMPLES)
        gap = GAP + (LEADER - SPEED) * 0.1 * np.arange(SAMPLES)
        parts.append(pd.DataFrame({"pair": pair, "time": times, "speed": SPEED, "leader_speed": LEADER, "gap": gap}))
    frame = pd.concat(parts, ignore_index=True).assign(**changes)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    return path


def write_ngsim(path: Path, feet: float = METERS_PER_FOOT, **changes: object) -> Path:
    """Write two vehicles, the second behind the first, in the public format: feet and milliseconds."""
    rows = []
    for vehicle, preceding, front, speed in ((7, 0, 100.0, LEADER), (8, 7, 100.0 - GAP - 5.0, SPEED)):
        for sample in range(SAMPLES):
            rows.append(
                {
                    "Vehicle_ID": vehicle,
                    "Frame_ID": sample,
                    "Global_Time": 1118846980200 + 100 * sample,
                    "Local_Y": (front + speed * 0.1 * sample) / feet,
                    "v_Length": 5.0 / feet,
                    "v_Vel": speed / feet,
                    "Lane_ID": 2,
                    "Preceding": preceding,
                    "Location": "i-80",
                }
            )
    pd.DataFrame(rows).assign(**changes).to_csv(path, index=False)
    return path


def write_reconstructed(path: Path, header: bool) -> Path:
    """Write the same in meters, as in the reconstructed files."""
    rows = []
    for vehicle, leader, front, speed in ((7, 0, 100.0, LEADER), (8, 7, 100.0 - GAP - 5.0, SPEED)):
        for frame in range(SAMPLES):
            rows.append([vehicle, frame, 2, front + speed * 0.1 * frame, speed, 0.0, 5.0, 2, 0, leader])
    names = ["Vehicle_ID", "Frame_ID", "Lane_ID", "LocalY", "Mean_Speed", "Mean_Accel", "Vehicle_length"]
    names += ["Vehicle_Class_ID", "Follower_ID", "Leader_ID"]
    pd.DataFrame(rows, columns=names).to_csv(path, index=False, header=header)
    return path


def write_openacc(path: Path) -> Path:
    """Write a platoon of three vehicles, of which the third is driven by ACC."""
    times = 0.1 * np.arange(SAMPLES)
    gap = GAP + (LEADER - SPEED) * times
    frame = pd.DataFrame({"Time": times, "Speed1": LEADER, "Speed2": SPEED, "Speed3": SPEED})
    frame = frame.assign(IVS1=gap, IVS2=15.0, Driver1="Human", Driver2="Human", Driver3="ACC")
    above = 'Date,04/07/2019\nVehicle_order,"Audi(A8), Tesla(Model3), BMW(X5)"\n\n'
    path.write_text(above + frame.to_csv(index=False))
    return path


def write_highd(path: Path, sign: int = 1) -> Path:
    """Write two vehicles as in highD: x is the left end of a vehicle, whatever its direction."""
    rows = []
    for vehicle, leader, rear, speed in ((1, 0, 100.0, LEADER), (2, 1, 100.0 - GAP - 5.0, SPEED)):
        for frame in range(SAMPLES):
            start = rear + speed * frame / 25.0
            left = start if sign > 0 else 400.0 - start - 5.0
            row = {"frame": frame, "id": vehicle, "x": left, "y": 8.0, "width": 5.0, "height": 2.0}
            rows.append({**row, "xVelocity": sign * speed, "precedingId": leader, "laneId": 2})
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


@pytest.mark.parametrize("sign", [1, -1])
def test_highd_is_read_on_both_carriageways(tmp_path: Path, sign: int) -> None:
    (trajectory,) = read_trajectories(write_highd(tmp_path / "01_tracks.csv", sign), options=SHORT).trajectories
    assert trajectory.time_step == 0.04
    np.testing.assert_allclose(trajectory.speed, SPEED)
    np.testing.assert_allclose(trajectory.leader_speed, LEADER)
    np.testing.assert_allclose(trajectory.gap, GAP + (LEADER - SPEED) * 0.04 * np.arange(SAMPLES), atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_standing_vehicle_on_highd_keeps_its_position(tmp_path: Path, sign: int) -> None:
    path = write_highd(tmp_path / "01_tracks.csv", sign)
    write_table_file = pd.read_csv(path)
    leader, half = write_table_file["id"] == 1, SAMPLES // 2
    is_standing = leader & (write_table_file["frame"] >= half)
    write_table_file.loc[is_standing, "x"] = write_table_file.loc[
        leader & (write_table_file["frame"] == half), "x"
    ].item()
    write_table_file.loc[is_standing, "xVelocity"] = 0.0
    write_table_file.to_csv(path, index=False)
    (trajectory,) = read_trajectories(path, options=SHORT).trajectories
    assert np.abs(np.diff(trajectory.gap)).max() < 0.04 * max(SPEED, LEADER) + 1e-6


def test_fcd_output_of_sumo_has_consistent_gaps(tmp_path: Path) -> None:
    flow = '<flow id="f" type="van" route="along" begin="0" end="20" period="4"/>'
    options = ["--fcd-output", "fcd.csv", "--fcd-output.max-leader-distance", "200"]
    command = [sumo_program("sumo"), "-c", str(straight(tmp_path, flow)), *options]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    result = read_trajectories(tmp_path / "fcd.csv")
    assert {each.driver for each in result.trajectories} == {f"f.{number}" for number in range(1, 5)}
    for trajectory in result.trajectories:
        gap_changes = np.cumsum(trajectory.leader_speed - trajectory.speed)[1:] * trajectory.time_step
        np.testing.assert_allclose(trajectory.gap[1:] - trajectory.gap[0], gap_changes, atol=0.6)
        assert trajectory.gap.min() > 20
    frame = pd.read_csv(tmp_path / "fcd.csv", sep=";")
    frame.drop(columns="vehicle_leaderSpeed").to_csv(tmp_path / "without.csv", sep=";", index=False)
    with pytest.raises(InputError, match="no column 'vehicle_leaderSpeed'"):
        read_trajectories(tmp_path / "without.csv")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_plain_table_is_read(tmp_path: Path, suffix: str) -> None:
    result = read_trajectories(write_table_file(tmp_path / f"t{suffix}", kind="human", driver="me"), options=SHORT)
    assert [each.name for each in result.trajectories] == ["one", "two"]
    trajectory = result.trajectories[0]
    assert (trajectory.time_step, trajectory.kind, trajectory.driver) == (0.1, "human", "me")
    assert (trajectory.speed[0], trajectory.leader_speed[0], trajectory.gap[0]) == (SPEED, LEADER, GAP)
    assert result.summary_lines() == ["2 trajectories with 60 of 60 rows"]


@pytest.mark.parametrize(
    "make",
    [
        write_ngsim,
        lambda path: write_reconstructed(path, True),
        lambda path: write_reconstructed(path, False),
        write_openacc,
    ],
)
def test_public_formats_are_converted_to_si_units(tmp_path: Path, make) -> None:
    trajectory = read_trajectories(make(tmp_path / "data.csv"), options=SHORT).trajectories[0]
    assert len(trajectory.speed) == SAMPLES
    assert trajectory.time_step == 0.1
    np.testing.assert_allclose(trajectory.speed, SPEED)
    np.testing.assert_allclose(trajectory.leader_speed, LEADER)
    np.testing.assert_allclose(trajectory.gap, GAP + (LEADER - SPEED) * 0.1 * np.arange(SAMPLES), atol=1e-6)


def test_rows_without_leader_are_counted(tmp_path: Path) -> None:
    result = read_trajectories(write_ngsim(tmp_path / "data.csv"), options=SHORT)
    assert result.summary_lines() == [
        "1 trajectories with 30 of 60 rows",
        "skipped: 30 rows: no leader, or leader not recorded",
    ]


def test_meters_in_a_format_in_feet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a median vehicle length of 1\.5 m is not allowed"):
        read_trajectories(write_ngsim(tmp_path / "data.csv", feet=1.0), options=SHORT)


def test_openacc_drivers_have_the_names_of_their_vehicles(tmp_path: Path) -> None:
    result = read_trajectories(write_openacc(tmp_path / "platoon.csv"), options=SHORT)
    assert [(each.driver, each.kind) for each in result.trajectories] == [
        ("Tesla(Model3)", "Human"),
        ("BMW(X5)", "ACC"),
    ]


def test_change_of_kind_is_another_driver_and_a_bad_gap_ends_only_its_own_pair(tmp_path: Path) -> None:
    path = write_openacc(tmp_path / "platoon.csv")
    lines = path.read_text().splitlines()
    frame = pd.read_csv(path, skiprows=3)
    frame.loc[SAMPLES // 2 :, "Driver2"] = "ACC"
    frame.loc[SAMPLES // 2, "IVS2"] = np.nan
    path.write_text("\n".join([*lines[:3], frame.to_csv(index=False)]))
    result = read_trajectories(path, options=replace(SHORT, drop_bad_rows=True))
    trajectories = [(each.driver, len(each.speed)) for each in result.trajectories if each.driver.startswith("Tesla")]
    half = SAMPLES // 2
    assert trajectories == [("Tesla(Model3)-ACC", SAMPLES - half), ("Tesla(Model3)-Human", half)]
    third = [len(each.speed) for each in result.trajectories if each.driver == "BMW(X5)"]
    assert sorted(third) == [SAMPLES - half - 1, half]
    assert len(result.bad_rows) == 1


def table_with_bad_value(path: Path, row: int, column: str, value: object) -> Path:
    frame = pd.read_csv(write_table_file(path)).astype({column: object})
    frame.loc[row, column] = value
    frame.to_csv(path, index=False)
    return path


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("gap", "near", r"line 7: gap: nan is not allowed; allowed: 0 to 1000"),
        ("speed", -3, r"line 7: speed: -3 is not allowed; allowed: 0 to 70"),
        ("leader_speed", 300, r"line 7: leader_speed: 300 is not allowed"),
        ("time", 0.3, r"line 7: time: 0.3 occurs twice in its pair"),
    ],
)
def test_bad_row_is_refused_with_its_line(tmp_path: Path, column: str, value: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_trajectories(table_with_bad_value(tmp_path / "t.csv", 5, column, value), options=SHORT)


def test_bad_row_can_be_dropped_and_is_reported(tmp_path: Path) -> None:
    path = table_with_bad_value(tmp_path / "t.csv", 12, "gap", "")
    result = read_trajectories(path, options=ReadOptions(drop_bad_rows=True, min_seconds=1.0))
    assert [len(each.speed) for each in result.trajectories] == [12, 17, 30]
    assert len({each.name for each in result.trajectories}) == 3
    assert result.bad_rows == {14: "gap: nan is not allowed; allowed: 0 to 1000"}
    assert "dropped: line 14: gap: nan is not allowed; allowed: 0 to 1000" in result.summary_lines()


def test_short_trajectories_are_counted(tmp_path: Path) -> None:
    path = write_table_file(tmp_path / "t.csv")
    frame = pd.read_csv(path)
    frame.drop(index=[40]).to_csv(path, index=False)
    result = read_trajectories(path, options=ReadOptions(min_seconds=1.5))
    assert [len(each.speed) for each in result.trajectories] == [30, 19]
    assert result.skipped_rows == {"trajectories shorter than 1.5 s": 10}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path / "none.csv", "does not exist"),
        (lambda path: write_table_file(path / "t.csv").rename(path / "t.parquet"), "cannot be read"),
        (lambda path: write_openacc(path / "t.csv"), "no column 'pair'; it has: Time"),
    ],
)
def test_unreadable_files_are_refused(tmp_path: Path, make, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_trajectories(make(tmp_path), "table", SHORT)


def test_table_with_only_short_trajectories_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no trajectory lasts 20 s"):
        read_trajectories(write_table_file(tmp_path / "t.csv"))


def test_driver_columns_name_the_driver(tmp_path: Path) -> None:
    path = write_table_file(tmp_path / "t.csv", period=400, follower=5)
    trajectories = read_trajectories(
        path, options=ReadOptions(min_seconds=1.0, driver_columns=("period", "follower"))
    ).trajectories
    assert {each.driver for each in trajectories} == {"400-5"}


def test_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="format: 'ind' is not allowed"):
        read_trajectories(write_table_file(tmp_path / "t.csv"), "ind")


def test_reused_vehicle_number_is_another_driver(tmp_path: Path) -> None:
    first = pd.read_csv(write_ngsim(tmp_path / "first.csv"))
    reused = first.assign(Global_Time=first["Global_Time"] + 15 * 60 * 1000)
    pd.concat([reused, first]).to_csv(tmp_path / "both.csv", index=False)
    result = read_trajectories(tmp_path / "both.csv", options=SHORT).trajectories
    assert sorted(each.driver for each in result) == ["i-80-8", "i-80-8-2"]


def test_pair_without_driver_name_is_its_own_driver(tmp_path: Path) -> None:
    drivers = ["anna"] * SAMPLES + [None] * SAMPLES
    result = read_trajectories(write_table_file(tmp_path / "data.csv", driver=drivers, kind=None), options=SHORT)
    assert [(each.driver, each.kind) for each in result.trajectories] == [("anna", ""), ("two", "")]
