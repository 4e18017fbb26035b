import errno
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from PIL import Image, ImageSequence

from tests.measures.test_metrics import episode_of
from tests.reports.open_roads import merge_episode, user_episode
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
from unjam.worlds.road_world import RoadScene

SECONDS = 20.0


def make_episode(seconds: float = SECONDS, cavs: int = 1) -> Episode:
    steps = round(seconds / 0.1)
    return episode_of(np.tile([4.0, 3.0, 3.5, 2.5], (steps + 1, 1)), cavs=cavs)


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as video:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(video)]


def seconds_of(path: Path) -> float:
    with Image.open(path) as video:
        return sum(frame.info["duration"] for frame in ImageSequence.Iterator(video)) / 1000


def count_color(frame: np.ndarray, color: str) -> int:
    """Return the number of pixels of about this color."""
    rgb = [int(color[start : start + 2], 16) for start in (1, 3, 5)]
    return int((np.abs(frame.astype(int) - rgb).max(axis=-1) < 40).sum())


def count_reddish(frame: np.ndarray) -> int:
    """Return the number of reddish pixels; no color of speed is reddish."""
    red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
    return int(((red - green > 40) & (red - blue > 30)).sum())


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_frames_of_a_video_differ(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"wave{suffix}"
    write_video(make_episode(), path, "pi", pace=40.0)
    frames = frames_of(path)
    assert len(frames) == SECONDS / 40.0 * FRAMES_PER_SECOND + 1
    assert all(frame.shape == (FRAME_SIZE, FRAME_SIZE, 3) for frame in frames)
    for before, after in pairwise(frames):
        assert (before != after).any(axis=-1).sum() > 200


def test_a_video_can_be_an_mp4(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install imageio-ffmpeg")
    path = tmp_path / "wave.MP4"
    write_video(make_episode(), path, "pi", pace=40.0)
    reader: Iterator = ffmpeg.read_frames(str(path))
    properties = next(reader)
    frames = [np.frombuffer(data, np.uint8).reshape(FRAME_SIZE, FRAME_SIZE, 3) for data in reader]
    assert properties["size"] == (FRAME_SIZE, FRAME_SIZE)
    assert properties["fps"] == FRAMES_PER_SECOND
    assert len(frames) == SECONDS / 40.0 * FRAMES_PER_SECOND + 1
    assert (frames[0] != frames[-1]).any()
    assert count_color(frames[0], CAV_PLOT_COLOR) > 50


@pytest.mark.long
@pytest.mark.parametrize("pace", [1.0, 10.0, *(pytest.param(pace, marks=pytest.mark.slow) for pace in (3.0, 5.0))])
def test_pace_is_the_speed_relative_to_real_time(tmp_path: Path, pace: float) -> None:
    path = tmp_path / "wave.gif"
    write_video(make_episode(seconds=pace * 0.8), path, "pi", pace)
    assert seconds_of(path) == pytest.approx(0.8, abs=0.11)  # plus the duration of the last frame


def test_only_cavs_are_marked(tmp_path: Path) -> None:
    counts = {}
    for cavs in (0, 1, 2):
        path = tmp_path / f"{cavs}.webp"
        write_video(make_episode(0.1, cavs), path, "pi")
        counts[cavs] = count_reddish(frames_of(path)[0])
    assert counts[0] == 0
    assert counts[1] > 50
    assert counts[2] == pytest.approx(2 * counts[1], rel=0.3)


def test_the_cav_is_at_its_position(tmp_path: Path) -> None:
    path = tmp_path / "wave.webp"
    write_video(make_episode(0.1), path, "pi")
    frame = frames_of(path)[0].astype(int)
    rgb = [int(CAV_PLOT_COLOR[start : start + 2], 16) for start in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(frame - rgb).max(axis=-1) < 40)
    assert columns.mean() > FRAME_SIZE * 0.85, "coordinate 0 of the ring is its rightmost point"
    assert FRAME_SIZE / 2 < rows.mean() < FRAME_SIZE * 0.6, "its front is at coordinate 0 and its rear below"


def test_vehicles_that_are_not_on_the_road_are_not_drawn(tmp_path: Path) -> None:
    episode = make_episode(0.1)
    episode.speeds[:, 0] = np.nan
    write_video(episode, tmp_path / "wave.webp", "pi")
    assert count_color(frames_of(tmp_path / "wave.webp")[0], CAV_PLOT_COLOR) == 0


def test_an_episode_of_one_step_is_a_video_of_one_frame(tmp_path: Path) -> None:
    write_video(make_episode(0.1), tmp_path / "wave.gif", "pi")
    assert len(frames_of(tmp_path / "wave.gif")) == 1


@pytest.mark.parametrize("name", ["wave.avi", "wave", "gif", "wave.gif.txt"])
def test_other_file_formats_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"allowed: a name that ends in \.gif, \.webp, \.mp4"):
        check_video_format(Path(name))
    with pytest.raises(InputError, match="video:"):
        write_video(make_episode(), tmp_path / name, "pi")
    assert not (tmp_path / name).exists()


def test_a_long_title_fits_into_the_draw(tmp_path: Path) -> None:
    write_video(make_episode(1.0), tmp_path / "wave.gif", "pi:" + ",".join(f"parameter_{n}={n}" for n in range(12)))
    frame = np.asarray(Image.open(tmp_path / "wave.gif").convert("L"))
    assert frame[:, :4].min() == frame[:, -4:].min() == 255
    assert frame.min() < 100


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4"])
def test_a_video_that_cannot_be_written_is_refused(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(DiskError, match="cannot write"):
        write_video(make_episode(1.0), tmp_path / "nowhere" / f"wave{suffix}", "pi")


def test_a_video_of_the_merge_shows_the_present_vehicles(tmp_path: Path) -> None:
    path = tmp_path / "merge.webp"
    episode = merge_episode(20)
    write_video(episode, path, "pi", pace=100.0)
    frames = frames_of(path)
    assert len(frames) == 1 + 20 // 5
    is_present = (~np.isnan(episode.speeds[::5])).sum(1)
    vehicles = [int((frame[150:].sum(-1) < 600).sum()) for frame in frames]  # below the caption; lanes are light
    assert np.corrcoef(is_present, vehicles)[0, 1] > 0.9


@pytest.fixture(scope="module", params=["merge", "ramp"])
def episode(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    return merge_episode() if request.param == "merge" else user_episode(tmp_path_factory.mktemp("own"))


def draw(scene: RoadScene) -> np.ndarray:
    return np.asarray(draw_road(scene, 20.0, "caption"))


def test_lines_are_split_at_nan() -> None:
    gap = [np.nan, np.nan]
    lines = np.array([[0.0, 0], [1, 0], gap, gap, [5, 5], gap, [2, 2], [3, 3], [4, 4]])
    assert [part.tolist() for part in split_lines(lines)] == [[[0, 0], [1, 0]], [[2, 2], [3, 3], [4, 4]]]


@pytest.mark.long
def test_a_picture_of_an_open_road_shows_lanes_and_present_vehicles(episode: Episode) -> None:
    (scene,) = episode_scenes(episode, [episode.control_steps])
    is_present = ~np.isnan(scene.speeds)
    assert 0 < is_present.sum() < len(is_present)
    assert np.isfinite(scene.poses[is_present]).all()
    assert scene.is_cav[is_present].sum() == len(
        {trajectory.vehicle for trajectory in episode.trajectories if at_end(trajectory, episode)}
    )
    full, empty = draw(scene), draw(scene._replace(speeds=np.full(len(is_present), np.nan)))
    assert full.shape == (FRAME_SIZE, FRAME_SIZE, 3)
    changed = (full != empty).any(-1)
    assert 10 * is_present.sum() < changed.sum() < 0.2 * FRAME_SIZE**2
    assert count_color(full, CAV_PLOT_COLOR) > 0
    assert count_color(empty, CAV_PLOT_COLOR) == 0


def at_end(trajectory: object, episode: Episode) -> bool:
    column = episode.vehicle_ids.index(trajectory.vehicle)  # pyright: ignore[reportAttributeAccessIssue]
    return not np.isnan(episode.speeds[-1, column])


def test_vehicles_are_on_the_lanes(episode: Episode) -> None:
    lines = episode.lane_lines
    for scene in episode_scenes(episode, [0, episode.control_steps // 2, episode.control_steps]):
        for x, y, _ in scene.poses[~np.isnan(scene.speeds)]:
            starts, ends = lines[:-1], lines[1:]
            along = ends - starts
            valid = ~np.isnan(along[:, 0]) & (np.abs(along).sum(1) > 0)
            offset = np.array([x, y]) - starts[valid]
            part = ((offset * along[valid]).sum(1) / (along[valid] ** 2).sum(1)).clip(0, 1)
            distance = np.linalg.norm(offset - part[:, None] * along[valid], axis=1).min()
            assert distance < 1.7  # a vehicle that changes lanes is between two


def test_a_picture_of_an_empty_road_has_only_lanes() -> None:
    lines = np.array([[0.0, 0.0], [100.0, 0.0]])
    scene = RoadScene(lines, np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))
    picture = draw(scene)
    middle = picture[FRAME_SIZE // 2 - 3 : FRAME_SIZE // 2 + 3, 100:-100]
    assert (middle != 255).any(-1).mean() > 0.5


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_full_disk_leaves_the_previous_video(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install imageio-ffmpeg")

    def full(*arguments: object, **options: object) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / f"wave{suffix}"
    path.write_text("previous")
    monkeypatch.setattr("unjam.files.os.fsync", full)
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", full)
    with pytest.raises(DiskError, match="No space left on device"):
        write_video(make_episode(1.0), path, "pi")
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "previous"
