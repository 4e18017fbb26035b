"""Are lanes drawn where and as fast as vehicles drive in them?"""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, QuadMesh

from tests.reports.open_roads import merge_episode, ramp_episode, shown_from
from unjam.reports.lanes import MAX_LANE_MAPS, has_lane_maps, lane_map_figure, mean_speed_grid, space_time_figure
from unjam.reports.results import PlotEpisode, pack_episode, unpack_episode


@pytest.fixture(scope="module")
def shown() -> PlotEpisode:
    return shown_from(ramp_episode(), "jam-ahead")


def small(speeds: list[list[float]], lanes: list[list[float]], positions: list[list[float]]) -> PlotEpisode:
    """Vehicles on a road of two lanes, a row per second."""
    arrays = {
        name: np.array(values, np.float32)
        for name, values in (("speeds", speeds), ("lanes", lanes), ("positions", positions))
    }
    return replace(shown_from(ramp_episode(), "few"), step=1.0, lane_names=("left", "right"), **arrays)


def test_a_cell_has_the_mean_speed_of_all_who_were_in_it() -> None:
    nobody = float("nan")
    episode = small([[10, 20, 5], [10, 20, nobody]], [[0, 0, 1], [0, 1, nobody]], [[0, 5, 80], [10, 95, nobody]])
    left = mean_speed_grid(episode, 0, (1.0, 0.0, 100.0))
    right = mean_speed_grid(episode, 1, (1.0, 0.0, 100.0))
    assert left.shape == right.shape == (5, 1), "20 m a second: no cell is smaller"
    np.testing.assert_allclose(left[:, 0], [40 / 3, nobody, nobody, nobody, nobody], rtol=1e-6)
    np.testing.assert_allclose(right[:, 0], [nobody, nobody, nobody, nobody, 25 / 2], rtol=1e-6)


def test_lanes_are_those_on_which_vehicles_lie(shown: PlotEpisode) -> None:
    assert shown.lane_names == ("left lane", "right lane", "ramp")
    on_ramp = np.array(shown.branches) == "ramp"
    before = ~np.isnan(shown.positions) & (shown.positions < 0)
    assert set(np.unique(shown.lane_indices[before & on_ramp])) == {2}
    assert set(np.unique(shown.lane_indices[before & ~on_ramp])) == {0, 1}
    y = shown.poses[..., 1]
    assert y[before & (shown.lane_indices == 0)].min() > y[before & (shown.lane_indices == 1)].max(), "left is above"


def test_who_stays_in_a_lane_is_in_the_map_of_it_alone(shown: PlotEpisode) -> None:
    figure = lane_map_figure([shown])
    panels = [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]
    assert tuple(axes.get_ylabel().split("\n")[0] for axes in panels) == shown.lane_names
    for lane, axes in enumerate(panels):
        (mesh,) = [found for found in axes.collections if isinstance(found, QuadMesh)]
        speeds = shown.speeds[(shown.lane_indices == lane) & ~np.isnan(shown.positions)]
        drawn = np.asarray(mesh.get_array()).astype(float)
        assert speeds.min() - 0.01 <= np.nanmin(drawn) <= np.nanmax(drawn) <= speeds.max() + 0.01
        (cavs,) = [found for found in axes.collections if isinstance(found, LineCollection)]
        own = shown.lane_indices[:, shown.cav_columns] == lane
        assert len(cavs.get_segments()) == (own[1:] & own[:-1]).sum()


def test_lanes_come_back_from_a_folder_in_a_byte_each(shown: PlotEpisode) -> None:
    stored = pack_episode(shown)
    assert stored["lanes"].dtype == np.int8
    np.testing.assert_array_equal(unpack_episode(dict(stored))["lanes"], shown.lane_indices)


def test_roads_without_lanes_or_with_different_ones_are_drawn_as_lines(shown: PlotEpisode) -> None:
    merge = shown_from(merge_episode(), "pi")
    assert has_lane_maps([shown, shown])
    assert not has_lane_maps([merge])
    assert not has_lane_maps([shown, merge])
    assert not has_lane_maps([])
    panels = [axes for axes in space_time_figure([merge]).axes if axes.get_label() != "<colorbar>"]
    lines = [[each for each in axes.collections if isinstance(each, LineCollection)] for axes in panels]
    assert [len(of_panel) for of_panel in lines] == [2, 2]  # people's and the CAVs', on highway and ramp


def test_of_many_lanes_the_busiest_are_drawn(shown: PlotEpisode) -> None:
    lanes = np.where(np.isnan(shown.lane_indices), np.nan, np.arange(shown.lane_indices.shape[1]) % 7).astype(
        np.float32
    )
    many = replace(shown, lanes=lanes, lane_names=tuple(map(str, range(7))))
    labels = [axes.get_ylabel() for axes in lane_map_figure([many]).axes if axes.get_label() != "<colorbar>"]
    names = [label.split("\n")[0] for label in labels if label]
    assert len(names) == MAX_LANE_MAPS
    assert names == sorted(names)
