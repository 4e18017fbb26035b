"""Pictures and videos of a road, also for rendering of environments; they require no display."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.errors import DiskError, InputError, import_optional, invalid_value
from unjam.files import atomic_write, check_parent_folder
from unjam.processes import PrivateFolder
from unjam.reports.figures import CAV_PLOT_COLOR, TEXT_COLOR, speed_colors
from unjam.reports.results import PlotEpisode, to_plot_episode
from unjam.reports.space_time import speed_scale
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.ordered_road import poses_along
from unjam.worlds.record import Episode
from unjam.worlds.road_world import RoadScene

FRAME_SIZE = 640  # width and height of a frame [pixels]
ROAD_MARGIN = 8.0  # margin around the road [m]
OVERSAMPLING = 2  # pictures are drawn larger by this factor and then reduced, for smooth edges
MIN_VEHICLE_PIXELS = 7.0  # minimum length of a vehicle, which would be invisible on a large road
ROAD_COLOR = "#dfe3e8"
MAX_TITLE_WIDTH = 36  # maximum width of a line of the title, which must fit into a ring [characters]
MIN_EMPTY_CENTER = 0.15  # minimum radius for a caption in the center, relative to the size of the road
LEGEND_WIDTH, LEGEND_HEIGHT = 110, 10  # size of the scale of speeds [pixels]
FRAMES_PER_SECOND = 20
VIDEO_FORMATS = (".gif", ".webp", ".mp4")


def draw_road(scene: RoadScene, max_speed: float, caption: str) -> Image.Image:
    """Return the picture of a road with vehicles colored by speed, and a caption of a few lines.

    `max_speed` is the speed of the brightest color [m/s]; vehicles with speed NaN are not on the road.
    """
    lines = split_lines(scene.lane_lines)
    points = np.concatenate(lines)
    low, high = points.min(0), points.max(0)
    size, center = float((high - low).max()), (low + high) / 2
    pixels = FRAME_SIZE * OVERSAMPLING
    scale = pixels / (size + 2 * ROAD_MARGIN)
    enlargement = max(1.0, MIN_VEHICLE_PIXELS * OVERSAMPLING / scale / VEHICLE_LENGTH)

    def to_pixels(points: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (points - center) * [scale, -scale] + pixels / 2]

    image = Image.new("RGB", (pixels, pixels), "white")
    pen = ImageDraw.Draw(image)
    for line in lines:
        pen.line(to_pixels(line), fill=ROAD_COLOR, width=max(OVERSAMPLING, round(4 * scale)), joint="curve")
    colors = speed_colors()
    for vehicle in np.flatnonzero(~np.isnan(scene.speeds)):
        color = colors[min(len(colors) - 1, int(scene.speeds[vehicle] / max_speed * len(colors)))]
        outline, width = (CAV_PLOT_COLOR, 3 * OVERSAMPLING) if scene.is_cav[vehicle] else (None, 1)
        corners = to_pixels(_vehicle_corners(scene.poses[vehicle], enlargement))
        pen.polygon(corners, fill=color, outline=outline, width=width)
    distances = np.linalg.norm(np.concatenate([_densify_line(line, size / 100) for line in lines]) - center, axis=1)
    is_centered = distances.min() > MIN_EMPTY_CENTER * size
    position, anchor, align = (0.5, "mm", "center") if is_centered else (0.03, "la", "left")
    style: dict[str, Any] = {"fill": TEXT_COLOR, "font": ImageFont.load_default(22 * OVERSAMPLING), "spacing": 12}
    pen.multiline_text((position * pixels, position * pixels), caption, anchor=anchor, align=align, **style)
    _draw_legend(pen, max_speed, pixels)
    return image.reduce(OVERSAMPLING)


def _draw_legend(pen: ImageDraw.ImageDraw, max_speed: float, pixels: int) -> None:
    """Draw the scale of speeds into the bottom right corner, where roads of the package are not."""
    colors, font = speed_colors(), ImageFont.load_default(14 * OVERSAMPLING)
    width, bottom = LEGEND_WIDTH * OVERSAMPLING, 0.97 * pixels
    left = bottom - width
    top = bottom - LEGEND_HEIGHT * OVERSAMPLING
    for index, color in enumerate(colors):
        start, end = (left + width * position / len(colors) for position in (index, index + 1))
        pen.rectangle((start, top, end, bottom), fill=color)
    for x, anchor, text in ((left, "ld", "0"), (left + width, "rd", f"{max_speed:.0f} m/s")):
        pen.text((x, top - 4 * OVERSAMPLING), text, fill=TEXT_COLOR, font=font, anchor=anchor)
    pen.text((left - 8 * OVERSAMPLING, bottom), "red: CAV", fill=TEXT_COLOR, font=font, anchor="rs")


def split_lines(lines: np.ndarray) -> list[np.ndarray]:
    """Split an array of points into lines at rows of NaN, without single points."""
    parts = np.split(lines, np.flatnonzero(np.isnan(lines[:, 0])))
    finite_parts = [part[~np.isnan(part[:, 0])] for part in parts]
    return [part for part in finite_parts if len(part) > 1]


def _vehicle_corners(pose: np.ndarray, scale: float) -> np.ndarray:
    """Return the four corners of a vehicle with its front bumper at (x, y, heading)."""
    along = np.array([np.cos(pose[2]), np.sin(pose[2])])
    across = np.array([-along[1], along[0]]) * 1.3 * scale
    front, rear = pose[:2], pose[:2] - VEHICLE_LENGTH * scale * along
    return np.array([front + across, front - across, rear - across, rear + across])


def _densify_line(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return a line with more points, with distances of at most about `spacing` [m]."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.append(0.0, lengths.cumsum())
    grid = np.linspace(0.0, along[-1], 2 + int(along[-1] / spacing))
    return np.column_stack([np.interp(grid, along, line[:, axis]) for axis in (0, 1)])


def episode_scenes(episode: Episode, steps: Sequence[int]) -> Iterator[RoadScene]:
    """Yield the scenes of an episode at these steps."""
    lines, poses = episode.lane_lines, episode.poses
    if len(episode.outline):
        lines = episode.outline[:, 1:]
        poses = poses_along(episode.outline, episode.positions, episode.loop_length)
    is_cav = np.isin(np.arange(episode.speeds.shape[1]), episode.cav_columns)
    for step in steps:
        yield RoadScene(lines, poses[step], episode.speeds[step], is_cav)


def write_video(episode: Episode, path: Path, title: str, pace: float = 10.0) -> None:
    """Write a video of an episode, `pace` times as fast as real time; the file name ends in .gif, .webp or .mp4.

    Raise `InputError` for another file format or an episode without poses, `DiskError` if its folder does not exist or
    the disk is full (a previous file is unchanged), and `MissingPartError` for .mp4 without imageio-ffmpeg.
    """
    check_video_format(path)
    check_parent_folder(path)
    episode = to_plot_episode("", episode)
    if not episode.has_poses:
        raise InputError("video: the backend does not record where vehicles are in the plane; allowed: backend=sumo")
    stride = max(1, round(pace / FRAMES_PER_SECOND / episode.control_step))
    frames = _video_frames(episode, title, stride)
    seconds = stride * episode.control_step / pace
    if path.suffix.lower() == ".mp4":
        _write_mp4(frames, path, 1 / seconds)
        return
    # A .gif has durations in hundredths of a second; rounding each separately would change their sum.
    ends = np.round(100 * seconds * np.arange(1, 2 + (len(episode.speeds) - 1) // stride))
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    content, kind = io.BytesIO(), path.suffix.lower().removeprefix(".")
    next(frames).save(content, kind, save_all=True, append_images=frames, duration=durations, loop=0)
    atomic_write(path, content.getvalue())


def check_video_format(path: Path) -> None:
    """Raise `InputError` unless `write_video` supports the format of `path`, `MissingPartError` without ffmpeg."""
    if path.suffix.lower() not in VIDEO_FORMATS:
        raise invalid_value("video", path.name, f"a name that ends in {', '.join(VIDEO_FORMATS)}")
    if path.suffix.lower() == ".mp4":
        import_optional("imageio_ffmpeg")


def _write_mp4(frames: Iterator[Image.Image], path: Path, rate: float) -> None:
    imageio_ffmpeg = import_optional("imageio_ffmpeg")
    with PrivateFolder() as private:  # ffmpeg writes the file itself, follows links and hides errors
        video = Path(private, path.name)
        writer = imageio_ffmpeg.write_frames(str(video), (FRAME_SIZE, FRAME_SIZE), fps=rate, ffmpeg_log_level="error")
        writer.send(None)
        try:
            for frame in frames:
                writer.send(np.asarray(frame.convert("RGB")).tobytes())
            writer.close()
            imageio_ffmpeg.count_frames_and_secs(str(video))  # fails for a truncated video
            content = video.read_bytes()
        except (OSError, RuntimeError) as error:
            text = " ".join(str(error).split())[:200]
            raise DiskError(f"video: {path.name} could not be written: {text}") from None
    atomic_write(path, content)


def _video_frames(episode: PlotEpisode, title: str, stride: int) -> Iterator[Image.Image]:
    max_speed = float(speed_scale([episode]).vmax or 1.0)
    steps, title = range(0, len(episode.speeds), stride), fill(title, MAX_TITLE_WIDTH)
    for step, scene in zip(steps, episode_scenes(episode, steps), strict=True):
        speeds = scene.speeds[~np.isnan(scene.speeds)]
        mean = f"mean {speeds.mean():.1f} m/s" if len(speeds) else "no vehicle on the road"
        yield draw_road(scene, max_speed, f"{title}\n{step * episode.control_step:5.0f} s\n{mean}")
