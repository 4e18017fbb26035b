import gzip
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pytest
from pyarrow.parquet import ParquetFile, ParquetWriter

from tests.worlds.sumo.user_networks import built
from unjam.errors import InputError
from unjam.recordings import loaders, tables
from unjam.recordings.loaders import METERS_PER_FOOT, ReadOptions, read_trajectories
from unjam.recordings.tables import NGSIM_COLUMN_ORDER, read_table
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


def write_ngsim_text(path: Path) -> Path:
    """Write the public format as NGSIM's text files have it: columns of equal width without a header."""
    frame = pd.read_csv(write_ngsim(path)).rename(columns=str.lower)
    frame.reindex(columns=list(NGSIM_COLUMN_ORDER), fill_value=0).to_csv(path, sep=" ", index=False, header=False)
    path.write_text("".join(f"   {line}\n" for line in path.read_text().replace(" ", "   ").splitlines()))
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


def test_fcd_output_of_sumo_has_consistent_gaps_across_edges(tmp_path: Path) -> None:
    nodes = "".join(f'<node id="{number}" x="{150 * number}" y="0"/>' for number in range(6))
    edges = "".join(
        f'<edge id="e{number}" from="{number}" to="{number + 1}" numLanes="{1 + number % 2}" speed="15"/>'
        for number in range(5)
    )
    flow = '<route id="along" edges="e0 e1 e2 e3 e4"/><flow id="f" route="along" begin="0" end="20" period="4"/>'
    file = built(tmp_path, nodes, edges, flow, '<end value="60"/><step-length value="0.1"/>')
    options = ["--fcd-output", "fcd.csv", "--fcd-output.max-leader-distance", "200"]
    for name in ("fcd.csv", "fcd.xml", "fcd.xml.gz"):
        options[1] = name
        subprocess.run([sumo_program("sumo"), "-c", str(file), *options], cwd=tmp_path, capture_output=True, check=True)
    result = read_trajectories(tmp_path / "fcd.csv")
    assert {each.driver for each in result.trajectories} == {f"f.{number}" for number in range(1, 5)}
    assert len(result.trajectories) == 4, "one each, over all edges"
    for each in result.trajectories:
        assert each.seconds > 30
        gap_changes = np.cumsum(each.leader_speed - each.speed)[1:] * each.time_step
        np.testing.assert_allclose(each.gap[1:] - each.gap[0], gap_changes, atol=0.6)
    for name in ("fcd.xml", "fcd.xml.gz"):
        for one, other in zip(read_trajectories(tmp_path / name).trajectories, result.trajectories, strict=True):
            assert (one.driver, one.time_step) == (other.driver, other.time_step)
            np.testing.assert_array_equal(one.gap, other.gap)
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
        *(write_ngsim, write_ngsim_text, write_openacc),
        *(lambda path: write_reconstructed(path, True), lambda path: write_reconstructed(path, False)),
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
        "1 trajectory with 30 of 60 rows",
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
        ("gap", "near", r"line 7: gap: 'near' is not allowed; allowed: 0 to 1000"),
        ("time", "2005-04-13 16:00", r"line 7: time: '2005-04-13 16:00' is not allowed; allowed: finite"),
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


def test_more_bad_rows_than_can_be_listed_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loaders, "MAX_BAD_ROWS", 10)
    path = write_table_file(tmp_path / "t.csv", gap=["near"] * 40 + [-1] * 20)
    with pytest.raises(InputError, match=r"line 2: gap: 'near' is .* \(60 bad rows\); 10 can be left out"):
        read_trajectories(path, options=replace(SHORT, drop_bad_rows=True))


def test_short_trajectories_are_counted(tmp_path: Path) -> None:
    path = write_table_file(tmp_path / "t.csv")
    frame = pd.read_csv(path)
    frame.drop(index=[40]).to_csv(path, index=False)
    result = read_trajectories(path, options=ReadOptions(min_seconds=1.5))
    assert [len(each.speed) for each in result.trajectories] == [30, 19]
    assert result.skipped_rows == {"trajectories shorter than 1.5 s": 10}


CONTENTS: dict[str, tuple[bytes, str]] = {
    "broken Parquet": (b"PAR1 and no more", "cannot be read"),
    "broken gzip": (gzip.compress(b"pair,time" * 99)[:-9], "cannot be read"),
    "JSON in one line": (
        b'[{"pair": "a", "speed": 1.0}' + b', {"pair": "a"}' * 200_000 + b"]",
        "it is JSON; allowed: CSV",
    ),
    "XML": (b'<?xml version="1.0"?><routes/>', "it is XML, but not SUMO's FCD output"),
    "broken FCD output": (b"<fcd-export><timestep", "cannot be read: unclosed token"),
    "entities": (b'<!DOCTYPE a [<!ENTITY b "c">]><fcd-export/>', "a document type .* is not allowed"),
    "one line": (b"pair," * 99_999, "line 1 is longer than 65,536 bytes"),
    "one line below the header": (b"pair,time\n" + b"1," * 3_000_000, "line 2 is longer than 65,536 bytes"),
    "a huge element": (b'<fcd-export><vehicle id="' + b"a" * 9_000_000, "line 1 is too long; allowed: an element has"),
    "more cells than columns": (b"pair,time\n1,2,\n1,2,3\n", "line 3 has more cells than columns have names"),
    "UTF-16": ("pair,time".encode("utf-16"), "it is not text in UTF-8"),
    "numbers alone": (b"1,2.5,3\n1,2.6,3\n", "its first line is not the names of its columns"),
    "nothing": (b"", "cannot be read: No columns"),
    "many columns": (
        ",".join(f"c{number}" for number in range(999)).encode(),
        r"it has: c0, .*, c19 and 979 more; req",
    ),
}


@pytest.mark.parametrize("name", CONTENTS)
def test_content_that_is_no_table_is_refused_at_once(name: str, tmp_path: Path) -> None:
    content, words = CONTENTS[name]
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_trajectories(tmp_path / "t.csv")


def test_missing_file_and_another_format_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_trajectories(tmp_path / "none.csv", "table")
    with pytest.raises(InputError, match="no column 'pair'; it has: Time"):
        read_trajectories(write_openacc(tmp_path / "t.csv"), "table")


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet"])
def test_a_table_that_unpacks_to_too_much_is_refused_before_it_takes_memory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MAX_TEXT_BYTES", 100_000)
    monkeypatch.setattr(tables, "MAX_CELLS", 100_000)
    frame = pd.DataFrame({"pair": np.zeros(99_999, int), "time": 0.0})
    (frame.to_parquet if name.endswith("parquet") else frame.to_csv)(tmp_path / name)
    monkeypatch.setattr(pd, "read_csv", pytest.fail)
    monkeypatch.setattr(ParquetFile, "read", pytest.fail)
    with pytest.raises(InputError, match=r"t\..*: cannot be read: it has more than 100,000 (cells|bytes of text)"):
        read_trajectories(tmp_path / name)


def test_long_text_that_parquet_stores_once_is_refused_before_it_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MAX_TEXT_BYTES", 100_000)
    pd.DataFrame({"pair": ["x" * 1001] * 100, "time": 0.0}).to_parquet(tmp_path / "t.parquet")
    monkeypatch.setattr(pd, "DataFrame", pytest.fail)
    with pytest.raises(InputError, match=r"t\.parquet: cannot be read: it has more than 100,000 bytes of text"):
        read_trajectories(tmp_path / "t.parquet")


def forge_footer(path: Path, value: int, forged: int, count: int) -> None:
    """Replace the first integers with this value in the footer of a Parquet file."""

    def encode(value: int, length: int = 0) -> bytes:
        groups = [2 * value >> shift & 127 for shift in range(0, max(7 * length, (2 * value).bit_length()), 7)]
        return bytes([*(group | 128 for group in groups[:-1]), groups[-1]])

    content = path.read_bytes()
    start = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    old = encode(value)
    assert old in content[start:]
    path.write_bytes(content[:start] + content[start:].replace(old, encode(forged, len(old)), count))


@pytest.mark.parametrize("count", [1, 2])
def test_numbers_of_rows_that_contradict_each_other_are_refused_before_reading(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pd.DataFrame({"pair": 1, "time": np.zeros(99_999)}).to_parquet(tmp_path / "t.parquet", index=False)
    forge_footer(tmp_path / "t.parquet", 99_999, 9, count)
    monkeypatch.setattr(ParquetFile, "read", pytest.fail)
    with pytest.raises(InputError, match=r"t\.parquet: cannot be read: its numbers of rows contradict each other"):
        read_trajectories(tmp_path / "t.parquet")


@pytest.fixture
def system_memory_pool() -> Iterator[None]:
    """Let Arrow take no memory in advance."""
    pool = pyarrow.default_memory_pool()
    pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    yield
    pyarrow.set_memory_pool(pool)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux only")
def test_pages_of_parquet_that_unpack_to_more_than_the_footer_says_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system_memory_pool: None
) -> None:
    monkeypatch.setattr(tables, "MAX_PARQUET_MEMORY", 128 << 20)
    good = write_table_file(tmp_path / "good.parquet")
    table = pyarrow.Table.from_pydict({"pair": [str(number).zfill(100_000) for number in range(100)]})
    with ParquetWriter(tmp_path / "t.parquet", table.schema, compression="gzip") as writer:
        for _ in range(30):  # 300 MB of text
            writer.write_table(table)
    size = ParquetFile(tmp_path / "t.parquet").metadata.row_group(0).column(0).total_uncompressed_size
    forge_footer(tmp_path / "t.parquet", size, 1000, -1)
    with pytest.raises(InputError, match=r"t\.parquet: cannot be read: it takes more than 0\.125 GiB of memory"):
        read_trajectories(tmp_path / "t.parquet")
    assert len(read_trajectories(good, options=SHORT).trajectories) == 2
    assert resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY


def test_nested_columns_of_parquet_are_not_read(tmp_path: Path) -> None:
    rows = pd.read_parquet(write_table_file(tmp_path / "t.parquet"))
    rows.assign(extra=[[1.0] * 99] * len(rows), gap=[{"m": 1.0}] * len(rows)).to_parquet(tmp_path / "t.parquet")
    with pytest.raises(InputError, match="no column 'gap'; it has: pair, time, speed, leader_speed; required"):
        read_trajectories(tmp_path / "t.parquet")


def test_fcd_output_is_read_in_parts_that_take_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "FCD_PART_ROWS", 10_000)
    rows = "".join(f'<timestep time="{n}.12345"><vehicle id="v{n}" speed="{n}.1"/></timestep>' for n in range(50_000))
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{rows}</fcd-export>")
    read_table(tmp_path / "fcd.xml")
    tracemalloc.start()
    frame = read_table(tmp_path / "fcd.xml")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert list(frame.columns) == ["timestep_time", "vehicle_id", "vehicle_speed", "line"]
    assert frame.iloc[-1].tolist() == ["49999.12345", "v49999", "49999.1", 1]
    assert peak < 300 * len(frame)


@pytest.mark.parametrize("limit", ["MAX_FCD_VEHICLES", "MAX_CELLS"])
def test_short_rows_that_take_much_memory_are_counted(
    limit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, limit, 1000)
    content = {"MAX_FCD_VEHICLES": b"<fcd-export>" + b"<vehicle/>" * 1001, "MAX_CELLS": b"pair\n" + b"1\n" * 1001}[
        limit
    ]
    (tmp_path / "t.gz").write_bytes(gzip.compress(content))
    with pytest.raises(InputError, match=r"it has more than 1,000 (elements 'vehicle'|cells); allowed"):
        read_trajectories(tmp_path / "t.gz")


WRITERS: dict[str, Callable[[pd.DataFrame, Path], object]] = {
    "gzip": lambda frame, path: path.write_bytes(gzip.compress(frame.to_csv(index=False).encode())),
    "semicolons": lambda frame, path: frame.to_csv(path, index=False, sep=";"),
    "tabs": lambda frame, path: frame.to_csv(path, index=False, sep="\t"),
    "spaces": lambda frame, path: path.write_text(frame.to_string(index=False)),
    "separators at the ends of lines": lambda frame, path: path.write_text(
        frame.to_csv(index=False, lineterminator=",\n").replace(",\n", "\n", 1)
    ),
    "decimal commas": lambda frame, path: frame.to_csv(path, index=False, sep=";", decimal=","),
    "a byte-order mark": lambda frame, path: frame.to_csv(path, index=False, encoding="utf-8-sig"),
    "commas between thousands": lambda frame, path: frame.assign(
        time=[f"{1_118_847 + time:,.1f}" for time in frame["time"]]
    ).to_csv(path, index=False),
}


@pytest.mark.parametrize("name", WRITERS)
def test_tables_are_read_in_every_form(name: str, tmp_path: Path) -> None:
    expected = read_trajectories(write_table_file(tmp_path / "plain.csv"), options=SHORT).trajectories
    WRITERS[name](pd.read_csv(tmp_path / "plain.csv"), tmp_path / "t.csv")
    found = read_trajectories(tmp_path / "t.csv", options=SHORT).trajectories
    for one, other in zip(found, expected, strict=True):
        assert (one.name, one.time_step) == (other.name, other.time_step)
        np.testing.assert_allclose(one.gap, other.gap)


def waves(times: np.ndarray, stamps: np.ndarray, pair: str = "a") -> pd.DataFrame:
    """A pair in waves of half a minute, the samples of which have other time stamps than their times."""
    leader, speed = 12 + 3 * np.sin(times / 5), 12 + 3 * np.sin((times - 1.2) / 5)
    gap = 40 + 15 * (np.cos((times - 1.2) / 5) - np.cos(times / 5))
    return pd.DataFrame({"pair": pair, "time": stamps, "speed": speed, "leader_speed": leader, "gap": gap})


@pytest.mark.parametrize("rate", [5, 12, 15, 24, 25, 29.97, 30, 60])
@pytest.mark.parametrize("decimals", [2, 3, 4])
def test_rows_with_rounded_time_stamps_are_read_unchanged(rate: float, decimals: int, tmp_path: Path) -> None:
    times = np.arange(0, 40, 1 / rate)
    rows = waves(times, times.round(decimals) + 1_118_847_000)
    rows.to_csv(tmp_path / "t.csv", index=False)
    (found,) = read_trajectories(tmp_path / "t.csv").trajectories
    assert found.time_step == pytest.approx(1 / rate, rel=5e-4)
    for name in ("speed", "leader_speed", "gap"):
        np.testing.assert_array_equal(getattr(found, name), rows[name])


TIMES = np.arange(0, 40, 0.1)
OTHER_UNITS: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str]] = {
    "dates": (
        lambda rows: rows.assign(time=pd.to_datetime(rows["time"], unit="s")),
        "line 2: time: '1970-01-01 00:00:00' is not allowed; allowed: finite numbers of seconds",
    ),
    "durations": (
        lambda rows: rows.assign(time=pd.to_timedelta(rows["time"].to_numpy(), "s")),
        "line 2: time: '0 days 00:00:00' is",
    ),
    "milliseconds": (lambda rows: rows.assign(time=1000 * rows["time"]), "time: steps of 100 s are .* in seconds"),
    "minutes": (lambda rows: waves(35 * TIMES, 35 * TIMES / 60), r"gap, speed, .*, time: gaps that change 63 times"),
    "feet": (lambda rows: rows.assign(gap=rows["gap"] / METERS_PER_FOOT), r"gap, .*: gaps that change 3\.3 times as"),
    "km/h": (
        lambda rows: rows.assign(speed=3.6 * rows["speed"], leader_speed=3.6 * rows["leader_speed"]),
        r"0\.28 times",
    ),
    "km/h of one vehicle": (
        lambda rows: rows.assign(speed=3.6 * rows["speed"]),
        r"speed, leader_speed: .* ratio of 0\.28",
    ),
    "swapped speeds": (
        lambda rows: rows.rename(columns={"speed": "leader_speed", "leader_speed": "speed"}),
        "change -1 tim",
    ),
    "columns of one name": (
        lambda rows: rows.assign(v_lead=1.0).rename(columns={"v_lead": "gap"}),
        "2 columns have the .* 'gap'",
    ),
}


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_units_that_do_not_fit_each_other_are_refused(name: str, tmp_path: Path) -> None:
    change, words = OTHER_UNITS[name]
    changed, is_date = change(waves(TIMES, TIMES)), name in ("dates", "durations")
    path = tmp_path / ("t.parquet" if is_date else "t.csv")
    changed.to_parquet(path) if is_date else changed.to_csv(path, index=False)
    with pytest.raises(InputError, match=words):
        read_trajectories(path)


@pytest.mark.parametrize("seed", range(5))
def test_noise_at_constant_speed_is_no_wrong_unit(seed: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(seed).normal(0.0, 0.2, (3, len(TIMES)))
    rows = {"pair": "a", "time": TIMES, "speed": 20 + noise[0], "leader_speed": 20 + noise[1], "gap": 30 + noise[2]}
    pd.DataFrame(rows).to_csv(tmp_path / "t.csv", index=False)
    assert len(read_trajectories(tmp_path / "t.csv").trajectories) == 1


@pytest.mark.parametrize("rate", [10, 30])
def test_samples_of_an_irregular_clock_are_interpolated(rate: float, tmp_path: Path) -> None:
    times = np.arange(0, 40, 1 / rate)
    times = np.sort(times + np.random.default_rng(0).uniform(-0.2, 0.2, len(times)) / rate)
    waves(times, times).to_csv(tmp_path / "t.csv", index=False)
    (found,) = read_trajectories(tmp_path / "t.csv").trajectories
    assert found.time_step == pytest.approx(1 / rate, rel=1e-3)
    even = times[0] + found.time_step * np.arange(len(found.speed))
    np.testing.assert_allclose(found.speed, waves(even, even)["speed"], atol=0.001)
    assert found.seconds == pytest.approx(40, abs=0.3)


def test_each_pair_has_its_own_time_step_and_a_missing_row_ends_a_trajectory(tmp_path: Path) -> None:
    fast, slow = np.arange(0, 60, 1 / 30), np.arange(0, 30, 0.1)
    rows = pd.concat([waves(fast, fast.round(3), "a"), waves(slow, slow, "b")])
    rows.drop(index=[900]).to_csv(tmp_path / "t.csv", index=False)
    found = read_trajectories(tmp_path / "t.csv").trajectories
    assert [(each.name, len(each.speed)) for each in found] == [("a", 900), ("a/2", 899), ("b", 300)]
    assert [each.time_step for each in found] == [found[0].time_step] * 2 + [0.1]
    assert found[0].time_step == pytest.approx(1 / 30, rel=1e-4)


@pytest.mark.parametrize("jump", [-30.0, 6.0])
def test_a_jump_of_the_gap_ends_a_trajectory_and_is_counted(jump: float, tmp_path: Path) -> None:
    times = np.arange(0, 60, 0.1)
    rows = waves(times, times, "a")
    rows.loc[rows.index[300:], "gap"] += jump
    rows["gap"] += 40.0
    rows.to_csv(tmp_path / "t.csv", index=False)
    found = read_trajectories(tmp_path / "t.csv")
    assert [(each.name, len(each.speed)) for each in found.trajectories] == [("a", 300), ("a/2", 300)]
    assert any("split at 1 jump of the gap by more than 5 m" in line for line in found.summary_lines())


def test_table_with_only_short_trajectories_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no trajectory lasts 20 s; the longest lasts 2\.9 s; rows are"):
        read_trajectories(write_table_file(tmp_path / "t.csv"))
    times = np.arange(0, 60, 0.1)
    rows = waves(times, times, "a")
    rows.loc[rows.index[::2], "gap"] += 20.0
    rows.to_csv(tmp_path / "two.csv", index=False)
    with pytest.raises(InputError, match="rows are missing at 0 places, the gap jumps at 599 places"):
        read_trajectories(tmp_path / "two.csv")


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


def test_a_change_of_the_kind_within_a_pair_ends_a_trajectory(tmp_path: Path) -> None:
    kinds = np.where(np.arange(2 * SAMPLES) < SAMPLES // 2, "ACC", "human")
    read = read_trajectories(write_table_file(tmp_path / "table.csv", kind=kinds), options=SHORT)
    assert [(each.kind, len(each.speed)) for each in read.trajectories] == [
        ("ACC", SAMPLES // 2),
        ("human", SAMPLES // 2),
        ("human", SAMPLES),
    ]


def test_pair_without_driver_name_is_its_own_driver(tmp_path: Path) -> None:
    drivers = ["anna"] * SAMPLES + [None] * SAMPLES
    result = read_trajectories(write_table_file(tmp_path / "data.csv", driver=drivers, kind=None), options=SHORT)
    assert [(each.driver, each.kind) for each in result.trajectories] == [("anna", ""), ("two", "")]
