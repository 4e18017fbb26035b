import base64
import json
import zlib
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.reports.open_roads import merge_episode, own_episode, shown_from
from unjam.reports.html import REPLAY_NAN, REPLAY_STEP, _encode_array, replay_data
from unjam.reports.results import PlotEpisode
from unjam.worlds.record import assign_columns


def unpacked(driver: dict[str, Any], name: str) -> np.ndarray:
    """What the page makes of a replay's numbers, shape (frames, columns), for places with an axis more."""
    arrays = []
    for each in driver[name]:
        changes = np.frombuffer(zlib.decompress(base64.b64decode(each["data"])), "<u2")
        steps = np.cumsum(changes.reshape(-1, driver["vehicles"]), axis=0, dtype=np.uint16)
        arrays.append(np.where(steps == REPLAY_NAN, np.nan, each["low"] + each["scale"] * steps))
    return np.stack(arrays, axis=-1) if name == "places" else arrays[0]


@pytest.fixture(scope="module", params=["merge", "ramp"])
def shown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PlotEpisode:
    if request.param == "merge":
        return shown_from(merge_episode(), "pi")
    return shown_from(own_episode(tmp_path_factory.mktemp("own")), "pi")


@given(hnp.arrays(np.bool_, (8, 12)), st.sets(st.integers(0, 11)), st.integers(1, 3))
def test_vehicles_that_share_a_column_are_never_there_together(there: np.ndarray, chosen: set[int], apart: int) -> None:
    for vehicle in range(there.shape[1]):  # each comes once and stays in between
        moments = np.flatnonzero(there[:, vehicle])
        if len(moments):
            there[moments[0] : moments[-1] + 1, vehicle] = True
    stays = [vehicle for vehicle in range(12) if there[:, vehicle].any()]
    moments = [np.flatnonzero(there[:, vehicle]) for vehicle in stays]
    first, last = (np.array([each[end] for each in moments], int) for end in (0, -1))
    groups = [vehicle in chosen for vehicle in stays]
    columns = assign_columns(first, last, groups, apart)
    assert sorted(set(columns.tolist())) == list(range(len(set(columns.tolist()))))
    for one, other in combinations(range(len(stays)), 2):
        if columns[one] == columns[other]:
            # Empty frames lie between: or the page would draw one vehicle that flies.
            assert groups[one] == groups[other]
            assert max(first[one], first[other]) - min(last[one], last[other]) > apart


@pytest.mark.long
def test_all_that_were_there_are_in_the_replay_where_they_were_and_as_fast(shown: PlotEpisode) -> None:
    data = replay_data([shown])
    (driver,) = data["drivers"]
    speeds, places = unpacked(driver, "speeds"), unpacked(driver, "places")
    assert len(speeds) == len(places) == data["frames"]
    assert driver["vehicles"] < len(shown.vehicle_ids)
    moments = np.round(np.arange(data["frames"]) * data["step"] / shown.control_step).astype(int)
    for frame, moment in enumerate(moments):
        there = ~np.isnan(shown.speeds[moment])
        expected = np.column_stack([shown.poses[moment][there], shown.speeds[moment][there]])
        seen = ~np.isnan(speeds[frame])
        found = np.column_stack([places[frame][seen], speeds[frame][seen]])
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=0.03)
        cavs = [shown.poses[moment][column] for column in shown.cav_columns if there[column]]
        marked = [places[frame][column] for column in driver["cavs"] if seen[column]]
        assert len(marked) == len(cavs)
        if cavs:
            np.testing.assert_allclose(np.sort(marked, axis=0), np.sort(cavs, axis=0), atol=0.03)
    assert data["fastest"] >= np.nanmax(shown.speeds)


def test_a_loop_is_not_asked_for_where_there_is_none(shown: PlotEpisode) -> None:
    (driver,) = replay_data([shown])["drivers"]
    assert driver["loop_length"] is None
    assert "positions" not in driver


def test_lines_are_those_of_the_lanes(shown: PlotEpisode) -> None:
    (driver,) = replay_data([shown])["drivers"]
    points = np.concatenate([np.array(line)[:, 1:] for line in driver["lines"]])
    known = shown.lane_lines[~np.isnan(shown.lane_lines[:, 0])]
    assert all(len(line) >= 2 for line in driver["lines"])
    assert len(points) >= 0.9 * len(known)
    np.testing.assert_allclose(points.min(0), known.min(0), atol=0.06)
    np.testing.assert_allclose(points.max(0), known.max(0), atol=0.06)


def test_the_replay_of_a_shorter_episode_stays_as_at_its_end() -> None:
    short, long = (shown_from(merge_episode(seconds), "pi") for seconds in (20, 100))
    first, second = replay_data([short, long])["drivers"]
    assert len(unpacked(first, "speeds")) == len(unpacked(second, "speeds"))
    np.testing.assert_array_equal(unpacked(first, "speeds")[30:], unpacked(first, "speeds")[29:-1])


@given(hnp.arrays(np.float32, (6, 3), elements=st.floats(-2000, 2000, width=32) | st.just(np.nan)))
def test_a_squeezed_number_is_off_by_less_than_its_range_in_65000_parts(array: np.ndarray) -> None:
    found = unpacked({"vehicles": 3, "speeds": [_encode_array(array)]}, "speeds")
    np.testing.assert_allclose(found, array, atol=4000 / 65000)
    assert (np.isnan(found) == np.isnan(array)).all()


def test_a_replay_takes_less_than_a_third_of_its_numbers(shown: PlotEpisode) -> None:
    data = replay_data([shown])
    (driver,) = data["drivers"]
    sent = sum(len(each["data"]) for name in ("speeds", "places") for each in driver[name])
    assert sent < 4 * 4 * driver["vehicles"] * data["frames"] / 3


def test_a_replay_of_a_crowd_can_be_sent(shown: PlotEpisode) -> None:
    generator, times = np.random.default_rng(0), 3_000 // shown.speeds.shape[1]
    speeds = np.tile(shown.speeds, (1, times))
    unlike = generator.normal(size=(speeds.shape[1], 3)).astype(np.float32)
    places = np.tile(shown.poses, (1, times, 1)) + 20.0 * unlike + speeds[..., None] * unlike
    names = [str(number) for number in range(speeds.shape[1])]
    crowd = replace(shown, speeds=speeds + unlike[:, 0], places=places, vehicle_ids=names, cav_ids=names[:9])
    data = replay_data([crowd, crowd])
    assert 10 < data["frames"] < shown.times[-1] / REPLAY_STEP
    assert len(json.dumps(data)) < 5e6


def test_of_nobody_there_is_nothing_to_play(tmp_path: Path) -> None:
    assert replay_data([]) == {"drivers": []}
