"""A film of an episode, drawn without a display."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.errors import InputError, MissingPartError
from unjam.files import check_folder
from unjam.reports.figures import colour_table
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.traffic.record import Episode

FRAMES_PER_SECOND = 20
SIZE = 640
"""pixels of the square picture"""
MARGIN = 8.0
"""metres around the road"""
OVERSAMPLING = 2
"""drawn larger and scaled down, for smooth edges"""
CAV_COLOUR = "#d7263d"
FORMATS = (".gif", ".webp", ".mp4")


def write_video(episode: Episode, path: Path, title: str, pace: float = 10.0) -> None:
    """Write a film of an episode, `pace` times as fast as life; .gif, .webp, or .mp4 by the file's name.

    Raises:
        InputError: another kind of file.
        DiskError: there is no folder for it.
        MissingPartError: .mp4 without the extra `video`.
    """
    check_format(path)
    check_folder(path)
    every = max(1, round(pace / FRAMES_PER_SECOND / episode.step))
    frames = _frames(episode, title, every)
    seconds = every * episode.step / pace
    if path.suffix.lower() == ".mp4":
        _write_mp4(frames, path, 1 / seconds)
        return
    # A .gif counts in hundredths of a second: rounded one by one they would not add up to the whole.
    ends = np.round(100 * seconds * np.arange(1, 2 + (len(episode.speeds) - 1) // every))
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    next(frames).save(path, save_all=True, append_images=frames, duration=durations, loop=0)


def check_format(path: Path) -> None:
    """Raise `InputError` unless `write_video` can write such a file."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"video: {path.name!r} is not allowed; allowed: a name that ends in {', '.join(FORMATS)}"
        )


def _write_mp4(frames: Iterator[Image.Image], path: Path, rate: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingPartError("video: .mp4 needs imageio-ffmpeg: pip install 'unjam[video]'") from None
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (SIZE, SIZE),
        fps=rate,  # pyright: ignore[reportArgumentType]  ffmpeg takes fractions too
        ffmpeg_log_level="error",
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.asarray(frame.convert("RGB")).tobytes())
    writer.close()


def _frames(episode: Episode, title: str, every: int) -> Iterator[Image.Image]:
    """Yield the pictures, one after the other."""
    outline = episode.outline
    low, high = outline[:, 1:].min(0), outline[:, 1:].max(0)
    pixels = SIZE * OVERSAMPLING
    scale = pixels / (float((high - low).max()) + 2 * MARGIN)
    centre = (low + high) / 2

    def to_pixels(points: np.ndarray) -> np.ndarray:
        return (points - centre) * [scale, -scale] + pixels / 2

    colours = colour_table()
    fastest = max(1.0, float(np.nanmax(episode.speeds)))
    font = ImageFont.load_default(22 * OVERSAMPLING)
    road = [tuple(point) for point in to_pixels(outline[:, 1:])]
    for step in range(0, len(episode.speeds), every):
        image = Image.new("RGB", (pixels, pixels), "white")
        pen = ImageDraw.Draw(image)
        pen.line(road, fill="#dfe3e8", width=round(4 * scale), joint="curve")
        for column, name in enumerate(episode.vehicle_ids):
            speed = episode.speeds[step, column]
            if np.isnan(speed):
                continue
            corners = to_pixels(_corners(outline, episode.positions[step, column], episode.loop_length))
            shade = colours[min(len(colours) - 1, int(speed / fastest * len(colours)))]
            is_cav = name in episode.cav_ids
            pen.polygon(
                [tuple(corner) for corner in corners],
                fill=shade,
                outline=CAV_COLOUR if is_cav else None,
                width=3 * OVERSAMPLING if is_cav else 1,
            )
        mean = float(np.nanmean(episode.speeds[step]))
        text = f"{title}\n{step * episode.step:5.0f} s\nmean {mean:.1f} m/s"
        pen.multiline_text(
            (pixels / 2, pixels / 2), text, fill="#1f2933", font=font, anchor="mm", align="center", spacing=12
        )
        yield image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def _corners(outline: np.ndarray, position: float, loop_length: float) -> np.ndarray:
    """Return the four corners of a vehicle whose front bumper is at `position` along the road [m]."""
    front, rear = (_place(outline, (position - back) % loop_length) for back in (0.0, VEHICLE_LENGTH))
    along = front - rear
    across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * 1.3
    return np.array([front + across, front - across, rear - across, rear + across])


def _place(outline: np.ndarray, coordinate: float) -> np.ndarray:
    return np.array([np.interp(coordinate, outline[:, 0], outline[:, axis]) for axis in (1, 2)])
