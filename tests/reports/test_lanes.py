"""Are lanes drawn where and as fast as vehicles drive in them?"""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, QuadMesh

from tests.reports.open_roads import merge_episode, ramp_episode, shown_from
from unjam.reports.lanes import MOST_LANES, drawn_by_lane, lane_maps, mean_speeds, space_time_of
from unjam.reports.results import Shown, packed, unpacked


@pytest.fixture(scope="module")
def shown() -> Shown:
    return shown_from(ramp_episode(), "jam-ahead")


def small(speeds: list[list[float]], lanes: list[list[float]], positions: list[list[float]]) -> Shown:
    """Vehicles on a road of two lanes, a row per second."""
    arrays = {
        name: np.array(values, np.float32)
        for name, values in (("speeds", speeds), ("lanes", lanes), ("positions", positions))
    }
    return replace(shown_from(ramp_episode(), "few"), step=1.0, lane_names=("left", "right"), **arrays)


def test_a_cell_has_the_mean_speed_of_all_who_were_in_it() -> None:
    nobody = float("nan")
    episode = small(
        [[10, 20, 5], [10, 20, nobody]], [[0, 0, 1], [0, 1, nobody]], [[0, 5, 80], [10, 95, nobody]]
    )
    left = mean_speeds(episode, 0, (1.0, 0.0, 100.0))
    right = mean_speeds(episode, 1, (1.0, 0.0, 100.0))
    assert left.shape == right.shape == (5, 1), "20 m a second: no cell is smaller"
    np.testing.assert_allclose(left[:, 0], [40 / 3, nobody, nobody, nobody, nobody], rtol=1e-6)
    np.testing.assert_allclose(right[:, 0], [nobody, nobody, nobody, nobody, 25 / 2], rtol=1e-6)


def test_lanes_are_those_on_which_vehicles_lie(shown: Shown) -> None:
    assert shown.lane_names == ("left lane", "right lane", "ramp")
    on_ramp = np.array(shown.branches) == "ramp"
    before = ~np.isnan(shown.positions) & (shown.positions < 0)
    assert set(np.unique(shown.lanes[before & on_ramp])) == {2}
    assert set(np.unique(shown.lanes[before & ~on_ramp])) == {0, 1}
    y = shown.places[..., 1]
    assert y[before & (shown.lanes == 0)].min() > y[before & (shown.lanes == 1)].max(), "left is above"


def test_who_stays_in_a_lane_is_in_the_map_of_it_alone(shown: Shown) -> None:
    figure = lane_maps([shown])
    panels = [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]
    assert tuple(axes.get_ylabel().split("\n")[0] for axes in panels) == shown.lane_names
    for lane, axes in enumerate(panels):
        (mesh,) = [found for found in axes.collections if isinstance(found, QuadMesh)]
        speeds = shown.speeds[(shown.lanes == lane) & ~np.isnan(shown.positions)]
        drawn = np.asarray(mesh.get_array()).astype(float)
        assert speeds.min() - 0.01 <= np.nanmin(drawn) <= np.nanmax(drawn) <= speeds.max() + 0.01
        (cavs,) = [found for found in axes.collections if isinstance(found, LineCollection)]
        own = shown.lanes[:, shown.cavs] == lane
        assert len(cavs.get_segments()) == (own[1:] & own[:-1]).sum()


def test_lanes_come_back_from_a_folder_in_a_byte_each(shown: Shown) -> None:
    stored = packed(shown)
    assert stored["lanes"].dtype == np.int8
    np.testing.assert_array_equal(unpacked(dict(stored))["lanes"], shown.lanes)


def test_roads_without_lanes_or_with_different_ones_are_drawn_as_lines(shown: Shown) -> None:
    merge = shown_from(merge_episode(), "pi")
    assert drawn_by_lane([shown, shown])
    assert not drawn_by_lane([merge])
    assert not drawn_by_lane([shown, merge])
    assert not drawn_by_lane([])
    panels = [axes for axes in space_time_of([merge]).axes if axes.get_label() != "<colorbar>"]
    lines = [[each for each in axes.collections if isinstance(each, LineCollection)] for axes in panels]
    assert [len(of_panel) for of_panel in lines] == [2, 2]  # people's and the CAVs', on highway and ramp


def test_of_many_lanes_the_busiest_are_drawn(shown: Shown) -> None:
    lanes = np.where(np.isnan(shown.lanes), np.nan, np.arange(shown.lanes.shape[1]) % 7).astype(np.float32)
    many = replace(shown, lanes=lanes, lane_names=tuple(map(str, range(7))))
    labels = [axes.get_ylabel() for axes in lane_maps([many]).axes if axes.get_label() != "<colorbar>"]
    names = [label.split("\n")[0] for label in labels if label]
    assert len(names) == MOST_LANES
    assert names == sorted(names)
