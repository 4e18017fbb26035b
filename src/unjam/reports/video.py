"""A film of an episode, drawn without a display."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from unjam.errors import InputError, MissingPartError
from unjam.files import check_folder
from unjam.reports.road_picture import SIZE, draw_road, scenes
from unjam.worlds.record import Episode

FRAMES_PER_SECOND = 20
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
    fastest = float(np.nanmax(episode.speeds, initial=1.0))
    moments = range(0, len(episode.speeds), every)
    for moment, scene in zip(moments, scenes(episode, moments), strict=True):
        there = scene.speeds[~np.isnan(scene.speeds)]
        mean = f"mean {there.mean():.1f} m/s" if len(there) else "nobody on the road"
        yield draw_road(scene, fastest, f"{title}\n{moment * episode.step:5.0f} s\n{mean}")
