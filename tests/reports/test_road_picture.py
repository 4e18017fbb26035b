from pathlib import Path

import numpy as np
import pytest

from tests.reports.open_roads import merge_episode, own_episode
from tests.reports.test_video import near
from unjam.reports.road_picture import CAV_COLOUR, SIZE, draw_road, scenes, split_lines
from unjam.worlds.record import Episode
from unjam.worlds.sumo.traffic import Scene


@pytest.fixture(scope="module", params=["merge", "ramp"])
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    return merge_episode() if request.param == "merge" else own_episode(tmp_path_factory.mktemp("own"))


def picture(scene: Scene) -> np.ndarray:
    return np.asarray(draw_road(scene, 20.0, "words"))


def test_lines_are_split_where_there_is_none() -> None:
    nothing = [np.nan, np.nan]
    lines = np.array([[0.0, 0], [1, 0], nothing, nothing, [5, 5], nothing, [2, 2], [3, 3], [4, 4]])
    assert [part.tolist() for part in split_lines(lines)] == [[[0, 0], [1, 0]], [[2, 2], [3, 3], [4, 4]]]


def test_a_moment_of_a_road_with_ends_shows_its_lanes_and_those_who_are_there(episode: Episode) -> None:
    (scene,) = scenes(episode, [episode.steps])
    there = ~np.isnan(scene.speeds)
    assert 0 < there.sum() < len(there)
    assert np.isfinite(scene.places[there]).all()
    assert scene.cavs[there].sum() == len(
        {each.vehicle for each in episode.trajectories if at_end(each, episode)}
    )
    full, empty = picture(scene), picture(scene._replace(speeds=np.full(len(there), np.nan)))
    assert full.shape == (SIZE, SIZE, 3)
    changed = (full != empty).any(-1)
    assert 10 * there.sum() < changed.sum() < 0.2 * SIZE**2
    assert near(full, CAV_COLOUR) > 0
    assert near(empty, CAV_COLOUR) == 0


def at_end(trajectory: object, episode: Episode) -> bool:
    column = episode.vehicle_ids.index(trajectory.vehicle)  # pyright: ignore[reportAttributeAccessIssue]
    return not np.isnan(episode.speeds[-1, column])


def test_vehicles_lie_on_the_lanes(episode: Episode) -> None:
    lines = episode.lines
    for scene in scenes(episode, [0, episode.steps // 2, episode.steps]):
        for x, y, _ in scene.places[~np.isnan(scene.speeds)]:
            starts, ends = lines[:-1], lines[1:]
            along = ends - starts
            whole = ~np.isnan(along[:, 0]) & (np.abs(along).sum(1) > 0)
            offset = np.array([x, y]) - starts[whole]
            part = ((offset * along[whole]).sum(1) / (along[whole] ** 2).sum(1)).clip(0, 1)
            distance = np.linalg.norm(offset - part[:, None] * along[whole], axis=1).min()
            assert distance < 1.7  # a vehicle that changes lanes is between two


def test_pictures_of_an_empty_road_have_its_lanes_alone(tmp_path: Path) -> None:
    lines = np.array([[0.0, 0.0], [100.0, 0.0]])
    scene = Scene(lines, np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))
    drawn = picture(scene)
    middle = drawn[SIZE // 2 - 3 : SIZE // 2 + 3, 100:-100]
    assert (middle != 255).any(-1).mean() > 0.5
