"""One moment of a road and a film of many, drawn without a display; environments render with it too."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.errors import DiskError, MissingPartError, invalid_value
from unjam.files import atomic_write, check_parent_folder
from unjam.processes import PrivateFolder
from unjam.reports.figures import CAV_PLOT_COLOR, TEXT_COLOR, color_table
from unjam.reports.results import to_plot_episode
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.closed_road import poses_along
from unjam.worlds.record import Episode
from unjam.worlds.sumo.traffic import RoadScene

FRAME_SIZE = 640
"""pixels of the square picture"""
ROAD_MARGIN = 8.0
"""metres around the road"""
OVERSAMPLING = 2
"""drawn larger and scaled down, for smooth edges"""
MIN_VEHICLE_PIXELS = 7.0
"""pixels of a vehicle's length on a large road, where a true one could not be seen"""
ROAD_COLOR = "#dfe3e8"
MAX_TITLE_WIDTH = 36
"""of a title in a line: it lies within a ring"""
MIN_EMPTY_CENTER = 0.15
"""share of the road's size that must be empty around its centre for words to stand there"""
FRAMES_PER_SECOND = 20
VIDEO_FORMATS = (".gif", ".webp", ".mp4")


def draw_road(scene: RoadScene, max_speed: float, caption: str) -> Image.Image:
    """Return the picture of one moment, vehicles coloured by speed, and a few lines of words.

    `fastest` is the speed of the brightest colour [m/s]; a vehicle whose speed is NaN is not on the road.
    """
    lines = split_lines(scene.lane_lines)
    points = np.concatenate(lines)
    low, high = points.min(0), points.max(0)
    size, centre = float((high - low).max()), (low + high) / 2
    pixels = FRAME_SIZE * OVERSAMPLING
    scale = pixels / (size + 2 * ROAD_MARGIN)
    enlarged = max(1.0, MIN_VEHICLE_PIXELS * OVERSAMPLING / scale / VEHICLE_LENGTH)

    def to_pixels(points: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (points - centre) * [scale, -scale] + pixels / 2]

    image = Image.new("RGB", (pixels, pixels), "white")
    pen = ImageDraw.Draw(image)
    for line in lines:
        pen.line(to_pixels(line), fill=ROAD_COLOR, width=max(OVERSAMPLING, round(4 * scale)), joint="curve")
    colours = color_table()
    for vehicle in np.flatnonzero(~np.isnan(scene.speeds)):
        is_cav = bool(scene.is_cav[vehicle])
        pen.polygon(
            to_pixels(_vehicle_corners(scene.poses[vehicle], enlarged)),
            fill=colours[min(len(colours) - 1, int(scene.speeds[vehicle] / max_speed * len(colours)))],
            outline=CAV_PLOT_COLOR if is_cav else None,
            width=3 * OVERSAMPLING if is_cav else 1,
        )
    along = np.concatenate([_densify_line(line, size / 100) for line in lines])
    inside = np.linalg.norm(along - centre, axis=1).min() > MIN_EMPTY_CENTER * size
    corner = 0.03 * pixels
    pen.multiline_text(
        (pixels / 2, pixels / 2) if inside else (corner, corner),
        caption,
        fill=TEXT_COLOR,
        font=ImageFont.load_default(22 * OVERSAMPLING),
        anchor="mm" if inside else "la",
        align="center" if inside else "left",
        spacing=12,
    )
    return image.resize((FRAME_SIZE, FRAME_SIZE), Image.Resampling.LANCZOS)


def split_lines(lines: np.ndarray) -> list[np.ndarray]:
    """Return the lines one by one: rows of NaN lie between them."""
    parts = np.split(lines, np.flatnonzero(np.isnan(lines[:, 0])))
    whole = [part[~np.isnan(part[:, 0])] for part in parts]
    return [part for part in whole if len(part) > 1]


def _vehicle_corners(pose: np.ndarray, scale: float) -> np.ndarray:
    """Return the four corners of a vehicle whose front bumper is at (x, y, heading)."""
    along = np.array([np.cos(pose[2]), np.sin(pose[2])])
    across = np.array([-along[1], along[0]]) * 1.3 * scale
    front, rear = pose[:2], pose[:2] - VEHICLE_LENGTH * scale * along
    return np.array([front + across, front - across, rear - across, rear + across])


def _densify_line(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return a line with more points, at most about `cav_spacing` metres apart."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.append(0.0, lengths.cumsum())
    wanted = np.linspace(0.0, along[-1], 2 + int(along[-1] / spacing))
    return np.column_stack([np.interp(wanted, along, line[:, axis]) for axis in (0, 1)])


def episode_scenes(episode: Episode, moments: Sequence[int]) -> Iterator[RoadScene]:
    """Yield moments of an episode as pictures show them."""
    lines, places = episode.lane_lines, episode.poses
    if len(episode.outline):
        lines = episode.outline[:, 1:]
        places = poses_along(episode.outline, episode.positions, episode.loop_length)
    cavs = np.isin(np.arange(episode.speeds.shape[1]), episode.cav_columns)
    for moment in moments:
        yield RoadScene(lines, places[moment], episode.speeds[moment], cavs)


def write_video(episode: Episode, path: Path, title: str, pace: float = 10.0) -> None:
    """Write a film of an episode, `pace` times as fast as life; .gif, .webp, or .mp4 by the file's name.

    Raises:
        InputError: another kind of file.
        DiskError: there is no folder for it, or no room: a file of before stays as it was.
        MissingPartError: .mp4 without imageio-ffmpeg.
    """
    check_video_format(path)
    check_parent_folder(path)
    episode = to_plot_episode("", episode)
    every = max(1, round(pace / FRAMES_PER_SECOND / episode.control_step))
    frames = _video_frames(episode, title, every)
    seconds = every * episode.control_step / pace
    if path.suffix.lower() == ".mp4":
        _write_mp4(frames, path, 1 / seconds)
        return
    # A .gif counts in hundredths of a second: rounded one by one they would not add up to the whole.
    ends = np.round(100 * seconds * np.arange(1, 2 + (len(episode.speeds) - 1) // every))
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    film, kind = io.BytesIO(), path.suffix.lower().removeprefix(".")
    next(frames).save(film, kind, save_all=True, append_images=frames, duration=durations, loop=0)
    atomic_write(path, film.getvalue())


def check_video_format(path: Path) -> None:
    """Raise `InputError` unless `write_video` can write such a file."""
    if path.suffix.lower() not in VIDEO_FORMATS:
        raise invalid_value("video", path.name, f"a name that ends in {', '.join(VIDEO_FORMATS)}")


def _write_mp4(frames: Iterator[Image.Image], path: Path, rate: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingPartError("video: .mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg") from None
    with PrivateFolder() as private:  # ffmpeg writes by itself, through links too, and says little
        film = Path(private, path.name)
        writer = imageio_ffmpeg.write_frames(
            str(film),
            (FRAME_SIZE, FRAME_SIZE),
            fps=rate,  # pyright: ignore[reportArgumentType]  ffmpeg takes fractions too
            ffmpeg_log_level="error",
        )
        writer.send(None)
        try:
            for frame in frames:
                writer.send(np.asarray(frame.convert("RGB")).tobytes())
            writer.close()
            imageio_ffmpeg.count_frames_and_secs(str(film))  # which one that was cut short does not survive
            content = film.read_bytes()
        except (OSError, RuntimeError) as error:
            words = " ".join(str(error).split())[:200]
            raise DiskError(f"video: {path.name} could not be written: {words}") from None
    atomic_write(path, content)


def _video_frames(episode: Episode, title: str, stride: int) -> Iterator[Image.Image]:
    """Yield the pictures, one after the other."""
    fastest = float(np.nanmax(episode.speeds, initial=1.0))
    moments = range(0, len(episode.speeds), stride)
    for moment, scene in zip(moments, episode_scenes(episode, moments), strict=True):
        there = scene.speeds[~np.isnan(scene.speeds)]
        mean = f"mean {there.mean():.1f} m/s" if len(there) else "nobody on the road"
        yield draw_road(
            scene, fastest, f"{fill(title, MAX_TITLE_WIDTH)}\n{moment * episode.control_step:5.0f} s\n{mean}"
        )
