"""One moment of a road and a film of many, drawn without a display; environments render with it too."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.errors import DiskError, MissingPartError, wrong
from unjam.files import check_folder, write_whole
from unjam.processes import PrivateFolder
from unjam.reports.figures import CAV_COLOUR, INK, colour_table
from unjam.reports.results import shown_of
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.closed import places_along
from unjam.worlds.record import Episode
from unjam.worlds.sumo.traffic import Scene

SIZE = 640
"""pixels of the square picture"""
MARGIN = 8.0
"""metres around the road"""
OVERSAMPLING = 2
"""drawn larger and scaled down, for smooth edges"""
SMALLEST_LENGTH = 7.0
"""pixels of a vehicle's length on a large road, where a true one could not be seen"""
ROAD = "#dfe3e8"
LETTERS = 36
"""of a title in a line: it lies within a ring"""
EMPTY_CENTRE = 0.15
"""share of the road's size that must be empty around its centre for words to stand there"""
FRAMES_PER_SECOND = 20
FORMATS = (".gif", ".webp", ".mp4")


def draw_road(scene: Scene, fastest: float, words: str) -> Image.Image:
    """Return the picture of one moment, vehicles coloured by speed, and a few lines of words.

    `fastest` is the speed of the brightest colour [m/s]; a vehicle whose speed is NaN is not on the road.
    """
    lines = split_lines(scene.lines)
    points = np.concatenate(lines)
    low, high = points.min(0), points.max(0)
    size, centre = float((high - low).max()), (low + high) / 2
    pixels = SIZE * OVERSAMPLING
    scale = pixels / (size + 2 * MARGIN)
    enlarged = max(1.0, SMALLEST_LENGTH * OVERSAMPLING / scale / VEHICLE_LENGTH)

    def to_pixels(places: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (places - centre) * [scale, -scale] + pixels / 2]

    image = Image.new("RGB", (pixels, pixels), "white")
    pen = ImageDraw.Draw(image)
    for line in lines:
        pen.line(to_pixels(line), fill=ROAD, width=max(OVERSAMPLING, round(4 * scale)), joint="curve")
    colours = colour_table()
    for vehicle in np.flatnonzero(~np.isnan(scene.speeds)):
        is_cav = bool(scene.cavs[vehicle])
        pen.polygon(
            to_pixels(_corners(scene.places[vehicle], enlarged)),
            fill=colours[min(len(colours) - 1, int(scene.speeds[vehicle] / fastest * len(colours)))],
            outline=CAV_COLOUR if is_cav else None,
            width=3 * OVERSAMPLING if is_cav else 1,
        )
    along = np.concatenate([_filled(line, size / 100) for line in lines])
    inside = np.linalg.norm(along - centre, axis=1).min() > EMPTY_CENTRE * size
    corner = 0.03 * pixels
    pen.multiline_text(
        (pixels / 2, pixels / 2) if inside else (corner, corner),
        words,
        fill=INK,
        font=ImageFont.load_default(22 * OVERSAMPLING),
        anchor="mm" if inside else "la",
        align="center" if inside else "left",
        spacing=12,
    )
    return image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def split_lines(lines: np.ndarray) -> list[np.ndarray]:
    """Return the lines one by one: rows of NaN lie between them."""
    parts = np.split(lines, np.flatnonzero(np.isnan(lines[:, 0])))
    whole = [part[~np.isnan(part[:, 0])] for part in parts]
    return [part for part in whole if len(part) > 1]


def _corners(place: np.ndarray, enlarged: float) -> np.ndarray:
    """Return the four corners of a vehicle whose front bumper is at (x, y, heading)."""
    along = np.array([np.cos(place[2]), np.sin(place[2])])
    across = np.array([-along[1], along[0]]) * 1.3 * enlarged
    front, rear = place[:2], place[:2] - VEHICLE_LENGTH * enlarged * along
    return np.array([front + across, front - across, rear - across, rear + across])


def _filled(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return a line with more points, at most about `spacing` metres apart."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.append(0.0, lengths.cumsum())
    wanted = np.linspace(0.0, along[-1], 2 + int(along[-1] / spacing))
    return np.column_stack([np.interp(wanted, along, line[:, axis]) for axis in (0, 1)])


def scenes(episode: Episode, moments: Sequence[int]) -> Iterator[Scene]:
    """Yield moments of an episode as pictures show them."""
    lines, places = episode.lines, episode.places
    if len(episode.outline):
        lines = episode.outline[:, 1:]
        places = places_along(episode.outline, episode.positions, episode.loop_length)
    cavs = np.isin(np.arange(episode.speeds.shape[1]), episode.cavs)
    for moment in moments:
        yield Scene(lines, places[moment], episode.speeds[moment], cavs)


def write_video(episode: Episode, path: Path, title: str, pace: float = 10.0) -> None:
    """Write a film of an episode, `pace` times as fast as life; .gif, .webp, or .mp4 by the file's name.

    Raises:
        InputError: another kind of file.
        DiskError: there is no folder for it, or no room: a file of before stays as it was.
        MissingPartError: .mp4 without imageio-ffmpeg.
    """
    check_format(path)
    check_folder(path)
    episode = shown_of("", episode)
    every = max(1, round(pace / FRAMES_PER_SECOND / episode.step))
    frames = _frames(episode, title, every)
    seconds = every * episode.step / pace
    if path.suffix.lower() == ".mp4":
        _write_mp4(frames, path, 1 / seconds)
        return
    # A .gif counts in hundredths of a second: rounded one by one they would not add up to the whole.
    ends = np.round(100 * seconds * np.arange(1, 2 + (len(episode.speeds) - 1) // every))
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    film, kind = io.BytesIO(), path.suffix.lower().removeprefix(".")
    next(frames).save(film, kind, save_all=True, append_images=frames, duration=durations, loop=0)
    write_whole(path, film.getvalue())


def check_format(path: Path) -> None:
    """Raise `InputError` unless `write_video` can write such a file."""
    if path.suffix.lower() not in FORMATS:
        raise wrong("video", path.name, f"a name that ends in {', '.join(FORMATS)}")


def _write_mp4(frames: Iterator[Image.Image], path: Path, rate: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingPartError("video: .mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg") from None
    with PrivateFolder() as private:  # ffmpeg writes by itself, through links too, and says little
        film = Path(private, path.name)
        writer = imageio_ffmpeg.write_frames(
            str(film),
            (SIZE, SIZE),
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
    write_whole(path, content)


def _frames(episode: Episode, title: str, every: int) -> Iterator[Image.Image]:
    """Yield the pictures, one after the other."""
    fastest = float(np.nanmax(episode.speeds, initial=1.0))
    moments = range(0, len(episode.speeds), every)
    for moment, scene in zip(moments, scenes(episode, moments), strict=True):
        there = scene.speeds[~np.isnan(scene.speeds)]
        mean = f"mean {there.mean():.1f} m/s" if len(there) else "nobody on the road"
        yield draw_road(scene, fastest, f"{fill(title, LETTERS)}\n{moment * episode.step:5.0f} s\n{mean}")
