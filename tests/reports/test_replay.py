import base64
import json
import zlib
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.reports.open_roads import merge_episode, plot_episode_of, user_episode
from tests.reports.test_figures import behind_recording
from unjam.reports.html import REPLAY_NAN, REPLAY_STEP, _encode_array, replay_data
from unjam.reports.results import PlotEpisode
from unjam.reports.space_time import speed_scale
from unjam.worlds.record import assign_columns


def decode(driver: dict[str, Any], name: str) -> np.ndarray:
    """Return the values that the page decodes, shape (frames, columns), and of poses (frames, columns, 3)."""
    arrays = []
    for each in driver[name]:
        changes = np.frombuffer(zlib.decompress(base64.b64decode(each["data"])), "<u2")
        steps = np.cumsum(changes.reshape(-1, driver["vehicles"]), axis=0, dtype=np.uint16)
        arrays.append(np.where(steps == REPLAY_NAN, np.nan, each["low"] + each["scale"] * steps))
    return np.stack(arrays, axis=-1) if name == "poses" else arrays[0]


@pytest.fixture(scope="module", params=["merge", "ramp"])
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PlotEpisode:
    if request.param == "merge":
        return plot_episode_of(merge_episode(), "pi")
    return plot_episode_of(user_episode(tmp_path_factory.mktemp("user")), "pi")


@pytest.mark.long
@given(hnp.arrays(np.bool_, (8, 12)), st.sets(st.integers(0, 11)), st.integers(1, 3))
def test_vehicles_in_one_column_are_never_present_together(is_present: np.ndarray, cavs: set[int], gap: int) -> None:
    for vehicle in range(is_present.shape[1]):  # each vehicle enters once
        moments = np.flatnonzero(is_present[:, vehicle])
        if len(moments):
            is_present[moments[0] : moments[-1] + 1, vehicle] = True
    vehicles = [vehicle for vehicle in range(12) if is_present[:, vehicle].any()]
    moments = [np.flatnonzero(is_present[:, vehicle]) for vehicle in vehicles]
    first, last = (np.array([moment[end] for moment in moments], int) for end in (0, -1))
    groups = [vehicle in cavs for vehicle in vehicles]
    columns = assign_columns(first, last, groups, gap)
    assert sorted(set(columns.tolist())) == list(range(len(set(columns.tolist()))))
    for one, other in combinations(range(len(vehicles)), 2):
        if columns[one] == columns[other]:
            # Empty frames are between them, or the page would interpolate between two vehicles.
            assert groups[one] == groups[other]
            assert max(first[one], first[other]) - min(last[one], last[other]) > gap


@pytest.mark.long
def test_replay_has_positions_and_speeds_of_all_vehicles(episode: PlotEpisode) -> None:
    data = replay_data([episode])
    (driver,) = data["drivers"]
    speeds, poses = decode(driver, "speeds"), decode(driver, "poses")
    assert len(speeds) == len(poses) == data["frames"]
    assert driver["vehicles"] < len(episode.vehicle_ids)
    moments = np.round(np.arange(data["frames"]) * data["step"] / episode.control_step).astype(int)
    for frame, moment in enumerate(moments):
        is_present = ~np.isnan(episode.speeds[moment])
        expected = np.column_stack([episode.poses[moment][is_present], episode.speeds[moment][is_present]])
        decoded = ~np.isnan(speeds[frame])
        found = np.column_stack([poses[frame][decoded], speeds[frame][decoded]])
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=0.03)
        cavs = [episode.poses[moment][column] for column in episode.cav_columns if is_present[column]]
        marked = [poses[frame][column] for column in driver["cavs"] if decoded[column]]
        assert len(marked) == len(cavs)
        if cavs:
            np.testing.assert_allclose(np.sort(marked, axis=0), np.sort(cavs, axis=0), atol=0.03)
    assert data["max_speed"] == speed_scale([episode]).vmax


def test_an_open_road_has_no_loop(episode: PlotEpisode) -> None:
    (driver,) = replay_data([episode])["drivers"]
    assert driver["loop_length"] is None
    assert "positions" not in driver


def test_lines_are_the_lanes(episode: PlotEpisode) -> None:
    (driver,) = replay_data([episode])["drivers"]
    points = np.concatenate([np.array(line)[:, 1:] for line in driver["lines"]])
    known = episode.lane_lines[~np.isnan(episode.lane_lines[:, 0])]
    assert all(len(line) >= 2 for line in driver["lines"])
    assert len(points) >= 0.9 * len(known)
    np.testing.assert_allclose(points.min(0), known.min(0), atol=0.06)
    np.testing.assert_allclose(points.max(0), known.max(0), atol=0.06)


def test_vehicles_stand_still_after_the_end_of_a_shorter_episode() -> None:
    short, long = (plot_episode_of(merge_episode(seconds), "pi") for seconds in (20, 100))
    first, second = replay_data([short, long])["drivers"]
    assert len(decode(first, "speeds")) == len(decode(second, "speeds"))
    np.testing.assert_array_equal(decode(first, "speeds")[30:], decode(first, "speeds")[29:-1])


@given(hnp.arrays(np.float32, (6, 3), elements=st.floats(-2000, 2000, width=32) | st.just(np.nan)))
def test_encoding_error_is_below_the_range_divided_by_65000(array: np.ndarray) -> None:
    found = decode({"vehicles": 3, "speeds": [_encode_array(array)]}, "speeds")
    np.testing.assert_allclose(found, array, atol=4000 / 65000)
    assert (np.isnan(found) == np.isnan(array)).all()


def test_an_encoded_replay_takes_less_than_a_third_of_its_values(episode: PlotEpisode) -> None:
    data = replay_data([episode])
    (driver,) = data["drivers"]
    sent = sum(len(each["data"]) for name in ("speeds", "poses") for each in driver[name])
    assert sent < 4 * 4 * driver["vehicles"] * data["frames"] / 3


def test_a_replay_of_many_vehicles_has_fewer_frames(episode: PlotEpisode) -> None:
    generator, times = np.random.default_rng(0), 3_000 // episode.speeds.shape[1]
    speeds = np.tile(episode.speeds, (1, times))
    offsets = generator.normal(size=(speeds.shape[1], 3)).astype(np.float32)
    poses = np.tile(episode.poses, (1, times, 1)) + 20.0 * offsets + speeds[..., None] * offsets
    names = [str(number) for number in range(speeds.shape[1])]
    crowd = replace(episode, speeds=speeds + offsets[:, 0], poses=poses, vehicle_ids=names, cav_ids=names[:9])
    data = replay_data([crowd, crowd])
    assert 10 < data["frames"] < episode.times[-1] / REPLAY_STEP
    assert len(json.dumps(data)) < 5e6


def test_a_replay_marks_the_places_where_ramps_join() -> None:
    merge = plot_episode_of(merge_episode(), "human")
    (place,) = replay_data([merge])["drivers"][0]["merges"]
    assert merge.merge_positions == (0.0,)
    at_merge = np.nanargmin(np.abs(merge.positions))
    assert place == pytest.approx(merge.poses.reshape(-1, 3)[at_merge, :2].tolist(), abs=0.1)
    far = replace(merge, merge_positions=(5000.0,))
    assert replay_data([far])["drivers"][0]["merges"] == []


def test_a_replay_has_the_scale_of_the_figures() -> None:
    panels = [behind_recording("human", 2.0), behind_recording("pi", 1.0)]
    data, scale = replay_data(panels), speed_scale(panels)
    assert (data["min_speed"], data["max_speed"]) == (scale.vmin, scale.vmax) == (18.0, 22.0)


def test_a_replay_without_episodes_is_empty() -> None:
    assert replay_data([]) == {"drivers": []}
