"""Detectors: what a file may hold, what passages make of it, and how near two traffics are."""

from contextlib import suppress
from math import isnan, nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from unjam.errors import InputError
from unjam.measures.detectors import (
    DETECTOR_COLUMNS,
    Measurement,
    aggregate_passages,
    compute_agreement,
    geh,
    read_detectors,
)
from unjam.worlds.sumo.simulation import DetectorPassage

HEAD = "edge,position,begin,end,flow_veh_per_h,speed"


def file_of(folder: Path, *lines: str) -> Path:
    """A file with these lines."""
    path = folder / "detectors.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


number = st.floats(0, 1e6)
measurements = st.builds(
    lambda location, position, begin, length, flow, speed: Measurement(
        location, position, begin, begin + length, flow, speed
    ),
    st.from_regex(r"[A-Za-z0-9_:#.-]{1,9}", fullmatch=True),
    *(number, number, st.floats(1, 3600), st.floats(1, 1e6), number | st.just(nan)),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(measurements, min_size=1, max_size=5, unique_by=lambda row: row.location),
    kind=st.sampled_from(["edge", "lane"]),
)
def test_written_measurements_are_read_back(rows: list[Measurement], kind: str, tmp_path: Path) -> None:
    texts = [["" if isnan(value) else repr(value) for value in list(vars(row).values())[1:]] for row in rows]
    lines = [",".join([row.location, *values]) for row, values in zip(rows, texts, strict=True)]
    found_kind, found = read_detectors(file_of(tmp_path, ",".join((kind, *DETECTOR_COLUMNS)), *lines))
    assert found_kind == kind
    assert str(found) == str(rows)  # NaN is not equal to itself


def test_additional_columns_any_order_and_a_byte_order_mark_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "detectors.csv"
    path.write_text("speed,name,lane,position,begin,end,flow_veh_per_h\n20,a,e_0,5,0,60,900\n", encoding="utf-8-sig")
    assert read_detectors(path) == ("lane", [Measurement("e_0", 5.0, 0.0, 60.0, 900.0, 20.0)])


def test_an_interval_without_vehicles_has_no_speed_whatever_the_detector_writes(tmp_path: Path) -> None:
    _, rows = read_detectors(file_of(tmp_path, HEAD, "a,1,0,60,0,0", "a,1,60,90,0,30,", "a,1,90,120,60,0"))
    assert [row.speed for row in rows] == pytest.approx([nan, nan, 0.0], nan_ok=True)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([HEAD], "has no rows"),
        (["edge,begin"], "columns: 'edge, begin' is not allowed; allowed: edge or lane, position"),
        ([f"lane,{HEAD}"], "columns"),
        ([""], "columns"),
        ([HEAD, "a,1,0,60,-5,20"], "line 2: flow_veh_per_h: '-5' is not allowed; allowed: a number >= 0"),
        ([HEAD, "a,1,0,60,5,20", "a,1,0,60,many,20"], "line 3: flow_veh_per_h: 'many'"),
        ([HEAD, "a,1,0,60,,20"], "flow_veh_per_h: ''"),
        ([HEAD, "a,1,0,60"], "line 2: has fewer cells than the header; allowed: as many"),
        ([HEAD, "a,1,0,60,1000"], "line 2: has fewer cells than the header"),
        ([HEAD, "a,1,0,60,1,000,30"], "line 2: has more cells than the header"),
        ([f"{HEAD},speed", "a,1,0,60,1000,30,108"], "columns named speed: 2 is not allowed; allowed: one"),
        ([f"{HEAD},edge", "a,1,0,60,1000,30,b"], "columns named edge: 2"),
        ([HEAD, "a,1,0,60,5,nan"], "speed: 'nan'"),
        ([HEAD, "a,inf,0,60,5,20"], "position: 'inf'"),
        ([HEAD, "a,1,0,60,1e308,20"], "flow_veh_per_h: '1e308' is not allowed; allowed: a number >= 0, <= 1e+09"),
        ([HEAD, "a,1,0,60,1_00,20"], "flow_veh_per_h: '1_00'"),
        ([HEAD, "a,1,30,90,5,20", "a,2,0,60,5,20", "a,1,0,60,5,20"], "line 2: overlaps the interval of line 4"),
        ([HEAD, "a,1,60,60,5,20"], "end: 60.0 is not allowed; allowed: after begin, 60 s"),
        ([HEAD, ",1,0,60,5,20"], "edge: ''"),
        (
            [HEAD, "a,1,0,60,5,20", "a,1,60,90,5,", "a,1.0,0,60,9,21"],
            "line 4: overlaps the interval of line 2; allowed",
        ),
    ],
)
def test_error_message_has_the_line_of_the_wrong_value(lines: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_detectors(file_of(tmp_path, *lines))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=200))
def test_any_file_content_is_read_or_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "detectors.csv"
    path.write_bytes(HEAD.encode() + b"\n" + content)
    with suppress(InputError):
        assert read_detectors(path)[1]


def test_device_is_refused_as_a_file_of_measurements() -> None:
    with pytest.raises(InputError, match="is not a file"):
        read_detectors(Path("/dev/zero"))


def test_geh_matches_the_design_manual() -> None:
    # Worked by hand: sqrt(2 * 100^2 / 2100) and sqrt(2 * 50^2 / 150).
    found = geh(np.array([1100.0, 100.0, 0.0]), np.array([1000.0, 50.0, 0.0]))
    assert found == pytest.approx([3.0861, 5.7735, 0.0], abs=1e-4)


def test_agreement_matches_a_manual_calculation() -> None:
    rows = [Measurement("a", 0, 0, 60, 1000, 20), Measurement("a", 0, 60, 120, 50, nan)]
    found = compute_agreement(rows, np.array([1100.0, 100.0]), np.array([17.0, 30.0]))
    assert found.geh == pytest.approx((3.0861 + 5.7735) / 2, abs=1e-4)
    assert found.geh_below_5 == 0.5
    assert found.flow_rmse == pytest.approx(np.sqrt((100**2 + 50**2) / 2))
    assert found.speed_rmse == pytest.approx(3.0)
    assert found.score == pytest.approx(found.geh / 5 + 3 / 20)


def test_intervals_without_vehicles_count_as_speed_zero() -> None:
    found = compute_agreement([Measurement("a", 0, 0, 60, 600, 20)], np.array([0.0]), np.array([nan]))
    assert found.speed_rmse == 20.0


def test_passages_are_aggregated_to_flow_and_speed_by_interval() -> None:
    rows = [Measurement("a", 0, 0, 60, 0, 0), Measurement("a", 0, 60, 180, 0, 0), Measurement("b", 0, 0, 60, 0, 0)]
    passed = [
        DetectorPassage(0, "x", 0.0, 10.0),
        DetectorPassage(1, "y", 59.9, 20.0),
        DetectorPassage(0, "z", 60.0, 30.0),
    ]
    flows, speeds = aggregate_passages(rows, [(0, 1), (0, 1), (2,)], passed)
    assert list(flows) == [120.0, 30.0, 0.0]
    assert speeds[:2] == pytest.approx([15.0, 30.0])
    assert isnan(speeds[2])


def test_lane_change_over_the_loops_of_an_edge_counts_once() -> None:
    rows = [Measurement("a", 0, 0, 600, 0, 0)]
    passed = [
        DetectorPassage(0, "x", 1.0, 10.0),
        DetectorPassage(1, "x", 1.4, 12.0),
        DetectorPassage(0, "x", 300.0, 14.0),
    ]
    flows, speeds = aggregate_passages(rows, [(0, 1)], passed)
    assert flows[0] == 2 * 6  # a lap later it passes once more
    assert speeds[0] == 12.0


def test_passage_of_unknown_speed_counts_only_for_flow() -> None:
    rows = [Measurement("a", 0, 0, 60, 0, 0), Measurement("a", 0, 60, 120, 0, 0)]
    passed = [DetectorPassage(0, "x", 1.0, nan), DetectorPassage(1, "x", 1.4, 12.0), DetectorPassage(0, "y", 5.0, nan)]
    flows, speeds = aggregate_passages(rows, [(0, 1)] * 2, [*passed, DetectorPassage(0, "z", 70.0, nan)])
    assert list(flows) == [120.0, 60.0]
    assert speeds[0] == 12.0
    assert isnan(speeds[1])


def test_speed_error_is_nan_without_measured_speeds() -> None:
    found = compute_agreement([Measurement("a", 0, 0, 60, 600, nan)], np.array([600.0]), np.array([20.0]))
    assert isnan(found.speed_rmse)
    assert found.score == 0.0
