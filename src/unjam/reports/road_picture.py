"""One moment of a road, drawn without a display: for films, and for environments that render."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.reports.figures import colour_table
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.sumo.neighbours import places_along
from unjam.worlds.sumo.traffic import Scene

SIZE = 640
"""pixels of the square picture"""
MARGIN = 8.0
"""metres around the road"""
OVERSAMPLING = 2
"""drawn larger and scaled down, for smooth edges"""
SMALLEST_LENGTH = 7.0
"""pixels of a vehicle's length on a large road, where a true one could not be seen"""
CAV_COLOUR = "#d7263d"
INK, ROAD = "#1f2933", "#dfe3e8"
EMPTY_CENTRE = 0.15
"""share of the road's size that must be empty around its centre for words to stand there"""


def draw_road(scene: Scene, fastest: float, words: str) -> Image.Image:
    """Return the picture of one moment, vehicles coloured by speed.

    Args:
        scene: the road's lines and its vehicles; one whose speed is NaN is not on the road.
        fastest: the speed of the brightest colour [m/s].
        words: a few lines, written beside the road.
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
        font=_font(),
        anchor="mm" if inside else "la",
        align="center" if inside else "left",
        spacing=12,
    )
    return image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def scenes(episode: Any, moments: Sequence[int]) -> Iterator[Scene]:
    """Yield the moments of an episode as pictures show them: an `Episode`, or what a folder has of one."""
    closed = len(episode.outline) > 0
    lines = episode.outline[:, 1:] if closed else episode.lines
    cavs = np.isin(episode.vehicle_ids, episode.cav_ids)
    for moment in moments:
        positions = episode.positions[moment]
        places = places_along(episode.outline, positions, episode.loop_length) if closed else None
        yield Scene(lines, episode.places[moment] if places is None else places, episode.speeds[moment], cavs)


def split_lines(lines: np.ndarray) -> list[np.ndarray]:
    """Return the lines one by one: rows of NaN lie between them."""
    gaps = np.flatnonzero(np.isnan(lines[:, 0]))
    parts = np.split(lines, gaps)
    return [part[~np.isnan(part[:, 0])] for part in parts if (~np.isnan(part[:, 0])).sum() > 1]


def _filled(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return a line with more points, at most about `spacing` metres apart."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.append(0.0, lengths.cumsum())
    wanted = np.linspace(0.0, along[-1], 2 + int(along[-1] / spacing))
    return np.column_stack([np.interp(wanted, along, line[:, axis]) for axis in (0, 1)])


@lru_cache(maxsize=1)
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(22 * OVERSAMPLING)


def _corners(place: np.ndarray, enlarged: float) -> np.ndarray:
    """Return the four corners of a vehicle whose front bumper is at (x, y, heading)."""
    along = np.array([np.cos(place[2]), np.sin(place[2])])
    across = np.array([-along[1], along[0]]) * 1.3 * enlarged
    front, rear = place[:2], place[:2] - VEHICLE_LENGTH * enlarged * along
    return np.array([front + across, front - across, rear - across, rear + across])
