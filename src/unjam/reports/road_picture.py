"""One moment of a road, drawn without a display: for films, and for environments that render."""

from collections.abc import Collection
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from unjam.reports.figures import colour_table
from unjam.scenarios.scenario import VEHICLE_LENGTH

SIZE = 640
"""pixels of the square picture"""
MARGIN = 8.0
"""metres around the road"""
OVERSAMPLING = 2
"""drawn larger and scaled down, for smooth edges"""
CAV_COLOUR = "#d7263d"
INK, ROAD = "#1f2933", "#dfe3e8"
EMPTY_CENTRE = 0.15
"""share of the road's size that must be empty around its centre for words to stand there"""


def draw_road(
    outline: np.ndarray,
    loop_length: float,
    speeds: np.ndarray,
    positions: np.ndarray,
    cavs: Collection[int],
    fastest: float,
    words: str,
) -> Image.Image:
    """Return the picture of one moment, vehicles coloured by speed.

    Args:
        outline: the road's centre line: rows (coordinate along the road, x, y) [m].
        loop_length: [m].
        speeds: [m/s], shape (vehicles,); NaN where a vehicle is not on the road.
        positions: front bumpers along the road [m], shape (vehicles,).
        cavs: places of the CAVs.
        fastest: the speed of the brightest colour [m/s].
        words: a few lines, written beside the road.
    """
    low, high = outline[:, 1:].min(0), outline[:, 1:].max(0)
    size, centre = float((high - low).max()), (low + high) / 2
    pixels = SIZE * OVERSAMPLING
    scale = pixels / (size + 2 * MARGIN)

    def to_pixels(points: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (points - centre) * [scale, -scale] + pixels / 2]

    image = Image.new("RGB", (pixels, pixels), "white")
    pen = ImageDraw.Draw(image)
    pen.line(to_pixels(outline[:, 1:]), fill=ROAD, width=round(4 * scale), joint="curve")
    colours = colour_table()
    for place in np.flatnonzero(~np.isnan(speeds)):
        pen.polygon(
            to_pixels(_corners(outline, positions[place], loop_length)),
            fill=colours[min(len(colours) - 1, int(speeds[place] / fastest * len(colours)))],
            outline=CAV_COLOUR if place in cavs else None,
            width=3 * OVERSAMPLING if place in cavs else 1,
        )
    along = np.linspace(outline[0, 0], outline[-1, 0], 400)
    line = np.column_stack([np.interp(along, outline[:, 0], outline[:, axis]) for axis in (1, 2)])
    inside = np.linalg.norm(line - centre, axis=1).min() > EMPTY_CENTRE * size
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


@lru_cache(maxsize=1)
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(22 * OVERSAMPLING)


def _corners(outline: np.ndarray, position: float, loop_length: float) -> np.ndarray:
    """Return the four corners of a vehicle whose front bumper is at `position` along the road [m]."""
    front, rear = (_place(outline, (position - back) % loop_length) for back in (0.0, VEHICLE_LENGTH))
    along = front - rear
    across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * 1.3
    return np.array([front + across, front - across, rear - across, rear + across])


def _place(outline: np.ndarray, coordinate: float) -> np.ndarray:
    return np.array([np.interp(coordinate, outline[:, 0], outline[:, axis]) for axis in (1, 2)])
