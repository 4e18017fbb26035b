import errno
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from PIL import Image, ImageSequence

from tests.measures.test_metrics import episode_of
from tests.reports.open_roads import merge_episode, own_episode
from unjam.errors import DiskError, InputError
from unjam.reports.video import (
    CAV_PLOT_COLOR,
    FRAME_SIZE,
    FRAMES_PER_SECOND,
    check_video_format,
    draw_road,
    episode_scenes,
    split_lines,
    write_video,
)
from unjam.worlds.record import Episode
from unjam.worlds.sumo.traffic import RoadScene

SECONDS = 20.0


def driven(seconds: float = SECONDS, cavs: int = 1) -> Episode:
    steps = round(seconds / 0.1)
    return episode_of(np.tile([4.0, 3.0, 3.5, 2.5], (steps + 1, 1)), cavs=cavs)


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]


def seconds_of(path: Path) -> float:
    with Image.open(path) as film:
        return sum(frame.info["duration"] for frame in ImageSequence.Iterator(film)) / 1000


def near(frame: np.ndarray, colour: str) -> int:
    """How many pixels are of about this colour."""
    wanted = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
    return int((np.abs(frame.astype(int) - wanted).max(axis=-1) < 40).sum())


def reddish(frame: np.ndarray) -> int:
    """How many pixels lean to red, as no colour of speed does."""
    red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
    return int(((red - green > 40) & (red - blue > 30)).sum())


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_has_frames_that_differ(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"wave{suffix}"
    write_video(driven(), path, "pi", pace=40.0)
    frames = frames_of(path)
    assert len(frames) == SECONDS / 40.0 * FRAMES_PER_SECOND + 1
    assert all(frame.shape == (FRAME_SIZE, FRAME_SIZE, 3) for frame in frames)
    for before, after in pairwise(frames):
        assert (before != after).any(axis=-1).sum() > 200


def test_a_film_can_be_an_mp4(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install imageio-ffmpeg")
    path = tmp_path / "wave.MP4"
    write_video(driven(), path, "pi", pace=40.0)
    reader: Iterator = ffmpeg.read_frames(str(path))
    about = next(reader)
    frames = [np.frombuffer(data, np.uint8).reshape(FRAME_SIZE, FRAME_SIZE, 3) for data in reader]
    assert about["size"] == (FRAME_SIZE, FRAME_SIZE)
    assert about["fps"] == FRAMES_PER_SECOND
    assert len(frames) == SECONDS / 40.0 * FRAMES_PER_SECOND + 1
    assert (frames[0] != frames[-1]).any()
    assert near(frames[0], CAV_PLOT_COLOR) > 50


@pytest.mark.long
@pytest.mark.parametrize("pace", [1.0, 10.0, *(pytest.param(pace, marks=pytest.mark.slow) for pace in (3.0, 5.0))])
def test_a_film_runs_as_many_times_as_fast_as_life_as_asked(tmp_path: Path, pace: float) -> None:
    path = tmp_path / "wave.gif"
    write_video(driven(seconds=pace * 0.8), path, "pi", pace)
    assert seconds_of(path) == pytest.approx(0.8, abs=0.11)  # and what the last frame lasts


def test_the_cav_is_marked_and_nobody_else_is(tmp_path: Path) -> None:
    counts = {}
    for cavs in (0, 1, 2):
        path = tmp_path / f"{cavs}.webp"
        write_video(driven(0.1, cavs), path, "pi")
        counts[cavs] = reddish(frames_of(path)[0])
    assert counts[0] == 0
    assert counts[1] > 50
    assert counts[2] == pytest.approx(2 * counts[1], rel=0.3)


def test_the_cav_is_where_it_should_be(tmp_path: Path) -> None:
    path = tmp_path / "wave.webp"
    write_video(driven(0.1), path, "pi")
    frame = frames_of(path)[0].astype(int)
    wanted = [int(CAV_PLOT_COLOR[start : start + 2], 16) for start in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(frame - wanted).max(axis=-1) < 40)
    assert columns.mean() > FRAME_SIZE * 0.85, "coordinate 0 of the ring is its rightmost point"
    assert FRAME_SIZE / 2 < rows.mean() < FRAME_SIZE * 0.6, "its front is at 0 and its tail behind, that is below"


def test_vehicles_that_are_not_on_the_road_are_not_drawn(tmp_path: Path) -> None:
    episode = driven(0.1)
    episode.speeds[:, 0] = np.nan
    write_video(episode, tmp_path / "wave.webp", "pi")
    assert near(frames_of(tmp_path / "wave.webp")[0], CAV_PLOT_COLOR) == 0


def test_an_episode_of_one_step_is_a_film_too(tmp_path: Path) -> None:
    write_video(driven(0.1), tmp_path / "wave.gif", "pi")
    assert len(frames_of(tmp_path / "wave.gif")) == 1


@pytest.mark.parametrize("name", ["wave.avi", "wave", "gif", "wave.gif.txt"])
def test_another_kind_of_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"allowed: a name that ends in \.gif, \.webp, \.mp4"):
        check_video_format(Path(name))
    with pytest.raises(InputError, match="video:"):
        write_video(driven(), tmp_path / name, "pi")
    assert not (tmp_path / name).exists()


def test_a_long_title_stays_in_the_picture(tmp_path: Path) -> None:
    write_video(driven(1.0), tmp_path / "film.gif", "pi:" + ",".join(f"parameter_{n}={n}" for n in range(12)))
    frame = np.asarray(Image.open(tmp_path / "film.gif").convert("L"))
    assert frame[:, :4].min() == frame[:, -4:].min() == 255
    assert frame.min() < 100


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4"])
def test_a_film_that_cannot_be_written_gets_one_clear_line(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(DiskError, match="cannot write"):
        write_video(driven(1.0), tmp_path / "nowhere" / f"wave{suffix}", "pi")


def test_a_film_of_the_merge_shows_who_is_there_at_each_moment(tmp_path: Path) -> None:
    path = tmp_path / "merge.webp"
    episode = merge_episode(20)
    write_video(episode, path, "pi", pace=100.0)
    frames = frames_of(path)
    assert len(frames) == 1 + 20 // 5
    there = (~np.isnan(episode.speeds[::5])).sum(1)
    vehicles = [int((frame[150:].sum(-1) < 600).sum()) for frame in frames]  # below the words; lanes are light
    assert np.corrcoef(there, vehicles)[0, 1] > 0.9


@pytest.fixture(scope="module", params=["merge", "ramp"])
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    return merge_episode() if request.param == "merge" else own_episode(tmp_path_factory.mktemp("own"))


def picture(scene: RoadScene) -> np.ndarray:
    return np.asarray(draw_road(scene, 20.0, "words"))


def test_lines_are_split_where_there_is_none() -> None:
    nothing = [np.nan, np.nan]
    lines = np.array([[0.0, 0], [1, 0], nothing, nothing, [5, 5], nothing, [2, 2], [3, 3], [4, 4]])
    assert [part.tolist() for part in split_lines(lines)] == [[[0, 0], [1, 0]], [[2, 2], [3, 3], [4, 4]]]


@pytest.mark.long
def test_a_moment_of_a_road_with_ends_shows_its_lanes_and_those_who_are_there(episode: Episode) -> None:
    (scene,) = episode_scenes(episode, [episode.control_steps])
    there = ~np.isnan(scene.speeds)
    assert 0 < there.sum() < len(there)
    assert np.isfinite(scene.poses[there]).all()
    assert scene.is_cav[there].sum() == len({each.vehicle for each in episode.trajectories if at_end(each, episode)})
    full, empty = picture(scene), picture(scene._replace(speeds=np.full(len(there), np.nan)))
    assert full.shape == (FRAME_SIZE, FRAME_SIZE, 3)
    changed = (full != empty).any(-1)
    assert 10 * there.sum() < changed.sum() < 0.2 * FRAME_SIZE**2
    assert near(full, CAV_PLOT_COLOR) > 0
    assert near(empty, CAV_PLOT_COLOR) == 0


def at_end(trajectory: object, episode: Episode) -> bool:
    column = episode.vehicle_ids.index(trajectory.vehicle)  # pyright: ignore[reportAttributeAccessIssue]
    return not np.isnan(episode.speeds[-1, column])


def test_vehicles_lie_on_the_lanes(episode: Episode) -> None:
    lines = episode.lane_lines
    for scene in episode_scenes(episode, [0, episode.control_steps // 2, episode.control_steps]):
        for x, y, _ in scene.poses[~np.isnan(scene.speeds)]:
            starts, ends = lines[:-1], lines[1:]
            along = ends - starts
            whole = ~np.isnan(along[:, 0]) & (np.abs(along).sum(1) > 0)
            offset = np.array([x, y]) - starts[whole]
            part = ((offset * along[whole]).sum(1) / (along[whole] ** 2).sum(1)).clip(0, 1)
            distance = np.linalg.norm(offset - part[:, None] * along[whole], axis=1).min()
            assert distance < 1.7  # a vehicle that changes lanes is between two


def test_pictures_of_an_empty_road_have_its_lanes_alone(tmp_path: Path) -> None:
    lines = np.array([[0.0, 0.0], [100.0, 0.0]])
    scene = RoadScene(lines, np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))
    drawn = picture(scene)
    middle = drawn[FRAME_SIZE // 2 - 3 : FRAME_SIZE // 2 + 3, 100:-100]
    assert (middle != 255).any(-1).mean() > 0.5


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_that_finds_no_room_leaves_the_one_of_before(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install imageio-ffmpeg")

    def full(*arguments: object, **options: object) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / f"wave{suffix}"
    path.write_text("of before")
    monkeypatch.setattr("unjam.files.os.fsync", full)
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", full)
    with pytest.raises(DiskError, match="No space left on device"):
        write_video(driven(1.0), path, "pi")
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "of before"
