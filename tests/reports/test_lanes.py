"""Lane maps show the positions and speeds of vehicles."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, QuadMesh

from tests.reports.open_roads import merge_episode, plot_episode_of, ramp_episode
from unjam.reports.results import PlotEpisode, pack_episode, unpack_episode
from unjam.reports.space_time import MAX_LANE_MAPS, has_lane_maps, lane_map_figure, mean_speed_grid, space_time_figure


@pytest.fixture(scope="module")
def episode() -> PlotEpisode:
    return plot_episode_of(ramp_episode(), "jam-ahead")


def small(speeds: list[list[float]], lanes: list[list[float]], positions: list[list[float]]) -> PlotEpisode:
    """Vehicles on a road of two lanes, a row per second."""
    arrays = {
        name: np.array(values, np.float32)
        for name, values in (("speeds", speeds), ("lane_indices", lanes), ("positions", positions))
    }
    return replace(plot_episode_of(ramp_episode(), "few"), control_step=1.0, lane_names=("left", "right"), **arrays)


def test_a_cell_has_the_mean_speed_of_its_vehicles() -> None:
    absent = float("nan")
    episode = small([[10, 20, 5], [10, 20, absent]], [[0, 0, 1], [0, 1, absent]], [[0, 5, 80], [10, 95, absent]])
    left = mean_speed_grid(episode, 0, (1.0, 0.0, 100.0))
    right = mean_speed_grid(episode, 1, (1.0, 0.0, 100.0))
    assert left.shape == right.shape == (5, 1), "at 20 m/s no cell is shorter than 20 m"
    np.testing.assert_allclose(left[:, 0], [40 / 3, absent, absent, absent, absent], rtol=1e-6)
    np.testing.assert_allclose(right[:, 0], [absent, absent, absent, absent, 25 / 2], rtol=1e-6)


def test_lane_indices_match_the_poses_of_vehicles(episode: PlotEpisode) -> None:
    assert episode.lane_names == ("left lane", "right lane", "ramp")
    on_ramp = np.array(episode.branches) == "ramp"
    upstream = ~np.isnan(episode.positions) & (episode.positions < 0)
    assert set(np.unique(episode.lane_indices[upstream & on_ramp])) == {2}
    assert set(np.unique(episode.lane_indices[upstream & ~on_ramp])) == {0, 1}
    y = episode.poses[..., 1]
    assert y[upstream & (episode.lane_indices == 0)].min() > y[upstream & (episode.lane_indices == 1)].max(), (
        "left is above"
    )


def test_vehicles_are_only_in_the_map_of_their_lane(episode: PlotEpisode) -> None:
    figure = lane_map_figure([episode])
    panels = [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]
    assert tuple(axes.get_ylabel().split("\n")[0] for axes in panels) == episode.lane_names
    for lane, axes in enumerate(panels):
        (mesh,) = [collection for collection in axes.collections if isinstance(collection, QuadMesh)]
        speeds = episode.speeds[(episode.lane_indices == lane) & ~np.isnan(episode.positions)]
        drawn = np.asarray(mesh.get_array()).astype(float)
        assert speeds.min() - 0.01 <= np.nanmin(drawn) <= np.nanmax(drawn) <= speeds.max() + 0.01
        (cavs,) = [collection for collection in axes.collections if isinstance(collection, LineCollection)]
        own = episode.lane_indices[:, episode.cav_columns] == lane
        assert len(cavs.get_segments()) == (own[1:] & own[:-1]).sum()


def test_lane_indices_are_stored_in_one_byte_each(episode: PlotEpisode) -> None:
    stored = pack_episode(episode)
    assert stored["lane_indices"].dtype == np.int8
    np.testing.assert_array_equal(unpack_episode(stored)["lane_indices"], episode.lane_indices)


def test_roads_without_common_lanes_are_drawn_as_trajectories(episode: PlotEpisode) -> None:
    merge = plot_episode_of(merge_episode(), "pi")
    assert has_lane_maps([episode, episode])
    assert not has_lane_maps([merge])
    assert not has_lane_maps([episode, merge])
    assert not has_lane_maps([])
    panels = [axes for axes in space_time_figure([merge]).axes if axes.get_label() != "<colorbar>"]
    lines = [
        [collection for collection in axes.collections if isinstance(collection, LineCollection)] for axes in panels
    ]
    assert [len(of_panel) for of_panel in lines] == [2, 2]  # human drivers and CAVs, on highway and ramp


def test_only_the_busiest_lanes_are_drawn(episode: PlotEpisode) -> None:
    lanes = np.where(np.isnan(episode.lane_indices), np.nan, np.arange(episode.lane_indices.shape[1]) % 7).astype(
        np.float32
    )
    many = replace(episode, lane_indices=lanes, lane_names=tuple(map(str, range(7))))
    labels = [axes.get_ylabel() for axes in lane_map_figure([many]).axes if axes.get_label() != "<colorbar>"]
    names = [label.split("\n")[0] for label in labels if label]
    assert len(names) == MAX_LANE_MAPS
    assert names == sorted(names)
