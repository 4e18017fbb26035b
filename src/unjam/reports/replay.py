"""What the page's replay needs: positions and speeds at a few frames a second."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.reports.figures import colour_table, speed_scale
from unjam.reports.results import Shown
from unjam.reports.road_picture import split_lines
from unjam.scenarios.scenario import VEHICLE_LENGTH

REPLAY_SECONDS = 0.5
"""time between two frames [s]"""


def replay_data(panels: Sequence[Shown]) -> dict[str, Any]:
    """Return what the page's replay needs: positions and speeds at a few frames a second."""
    if not panels:
        return {"drivers": []}
    step = max(REPLAY_SECONDS, *(episode.step for episode in panels))
    frames = 1 + int(max(episode.times[-1] for episode in panels) / step + 1e-9)
    return {
        "step": step,
        "frames": frames,
        "start": 0,
        "fastest": speed_scale(panels).vmax,
        "colours": colour_table(),
        "vehicle_length": VEHICLE_LENGTH,
        "drivers": [
            {"name": episode.driver, **_vehicles(episode, step, frames), "lines": _lines(episode)}
            for episode in panels
        ],
    }


def _vehicles(episode: Shown, step: float, frames: int) -> dict[str, Any]:
    """Return where the vehicles are and how fast: along a loop, or on the plane."""
    speeds = _frames(episode, episode.speeds, step, frames)
    if episode.closed:
        return {
            "vehicles": speeds.shape[1],
            "cavs": episode.cavs,
            "loop_length": episode.loop_length,
            "speeds": _base64(speeds),
            "positions": _base64(_frames(episode, episode.positions, step, frames)),
        }
    places = _frames(episode, episode.places, step, frames)
    is_cav = np.isin(np.arange(speeds.shape[1]), episode.cavs)
    cavs, people = (_share(~np.isnan(speeds), chosen) for chosen in (is_cav, ~is_cav))
    columns = [*cavs, *people]
    packed_speeds = np.full((frames, len(columns)), np.nan, np.float32)
    packed_places = np.full((frames, len(columns), 3), np.nan, np.float32)
    for number, vehicles in enumerate(columns):
        for vehicle in vehicles:
            there = ~np.isnan(speeds[:, vehicle])
            packed_speeds[there, number] = speeds[there, vehicle]
            packed_places[there, number] = places[there, vehicle]
    return {
        "vehicles": len(columns),
        "cavs": list(range(len(cavs))),
        "loop_length": None,
        "speeds": _base64(packed_speeds),
        "places": _base64(packed_places),
    }


def _share(there: np.ndarray, chosen: np.ndarray) -> list[list[int]]:
    """Return groups of the `chosen` vehicles that are never on the road together: a column for each will do.

    `there`, shape (frames, vehicles), says when each is on the road; an empty frame lies between two.
    """
    groups: list[list[int]] = []
    ends: list[int] = []
    seen = [vehicle for vehicle in np.flatnonzero(chosen) if there[:, vehicle].any()]
    for vehicle in sorted(seen, key=lambda vehicle: int(np.argmax(there[:, vehicle]))):
        first, last = np.flatnonzero(there[:, vehicle])[[0, -1]]
        for number, end in enumerate(ends):
            if end + 1 < first:
                groups[number].append(int(vehicle))
                ends[number] = int(last)
                break
        else:
            groups.append([int(vehicle)])
            ends.append(int(last))
    return groups


def _lines(episode: Shown) -> list[Any]:
    """Return the road's lines, each as rows (coordinate along the road, x, y) [m]."""
    if episode.closed:
        return [np.round(episode.outline, 2).tolist()]
    lines = split_lines(episode.lines)
    return [np.column_stack([np.zeros(len(line)), line]).round(1).tolist() for line in lines]


def _frames(episode: Shown, values: np.ndarray, step: float, frames: int) -> np.ndarray:
    """Return `values` at the moments of the replay; an episode that ended before stays as at its end."""
    moments = np.round(np.arange(frames) * step / episode.step).astype(int)
    return values[moments.clip(max=len(values) - 1)]


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array, "<f4").tobytes()).decode()
