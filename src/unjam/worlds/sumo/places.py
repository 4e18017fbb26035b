"""Where vehicles are on the plane, for pictures."""

import numpy as np
from numpy.typing import NDArray

from unjam.scenarios.scenario import VEHICLE_LENGTH

Floats = NDArray[np.float64]


def places_along(outline: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return rows (x, y, heading) of vehicles whose front bumpers are at `positions` along a closed road.

    Args:
        outline: rows (coordinate along the road, x, y) [m].
        positions: not wrapped [m], any shape.
        loop_length: [m].

    Returns:
        Shape (..., 3): [m], and [rad] against the x axis; a vehicle lies between the places of its bumpers.
    """
    front = _on_line(outline, positions % loop_length)
    rear = _on_line(outline, (positions - VEHICLE_LENGTH) % loop_length)
    heading = np.arctan2(front[..., 1] - rear[..., 1], front[..., 0] - rear[..., 0])
    return np.concatenate([front, heading[..., None]], axis=-1)


def _on_line(outline: Floats, coordinates: Floats) -> Floats:
    columns = [np.interp(coordinates, outline[:, 0], outline[:, axis]) for axis in (1, 2)]
    return np.stack(columns, axis=-1)
